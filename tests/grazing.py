"""Random trajectories that pass a guard by, or dip below it, by a hair."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.simulation.flow import Flow, SwitchedPart


@dataclass(frozen=True)
class Pass:
    """A sum of two oscillations near its minimum, and a guard just above it (crossed twice) or below (never)."""

    flow: Flow
    z0: Array
    duration: float
    depth: float
    crossings: int


def near_grazing(seed: int) -> Pass:
    """Return a pass of depth 1e-11 … 1e-2, above or below the guard."""
    random = np.random.default_rng(seed)
    while True:
        omega = 10.0 ** random.uniform(-1, 2) * np.array([1.0, random.uniform(1.2, 3.0)])
        amplitude, phase = random.uniform(0.5, 2.0, size=2), random.uniform(0, 2 * np.pi, size=2)

        def wave(
            t: float, order: int, omega: Array = omega, amplitude: Array = amplitude, phase: Array = phase
        ) -> float:
            return float((amplitude * omega**order * np.cos(omega * t + phase + order * np.pi / 2)).sum())

        low, high = 0.0, 0.0
        grid = np.linspace(0, 2 * np.pi / omega[0], 200)
        slopes = np.array([wave(t, 1) for t in grid])
        rises = np.flatnonzero((slopes[:-1] < 0) & (slopes[1:] >= 0))
        if not len(rises):
            continue
        low, high = grid[rises[0]], grid[rises[0] + 1]
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (middle, high) if wave(middle, 1) < 0 else (low, middle)
        before, after = random.uniform(0.4, 0.7, size=2) / omega[1]
        bends = [wave(t, 2) for t in np.linspace(low - before, low + after, 50)]
        depth = 10.0 ** random.uniform(-11, -2)
        if min(bends) > 0.2 * omega[1] ** 2 and 0.1 * (min(before, after) * omega[1]) ** 2 > depth:
            break
    crossings = int(random.choice([0, 2]))
    level = wave(low, 0) + (depth if crossings else -depth)
    F = np.zeros((5, 5))
    for i in range(2):
        F[2 * i, 2 * i + 1], F[2 * i + 1, 2 * i] = omega[i], -omega[i]
    turned = omega * (low - before) + phase
    z0 = np.array([*np.ravel([amplitude * np.cos(turned), -amplitude * np.sin(turned)], order="F"), 1.0])
    part = SwitchedPart(
        name="wave",
        cells=("below", "above"),
        guards=np.array([[1.0, 0, 1, 0, -level]]),
        signs=np.array([[-1], [1]]),
        F=np.zeros((2, 5, 5)),
    )
    return Pass(flow=Flow(F0=F, parts=(part,)), z0=z0, duration=float(before + after), depth=depth, crossings=crossings)
