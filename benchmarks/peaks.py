"""Enclosed peaks of feedforwards against another, fine walk, of random specs and the gallery's; prints the counts.

    .venv/bin/python -m benchmarks.peaks [specs [seconds]]

The other walk knows no events and no enclosure: it goes in 200,000 equal steps, each by the exponential of the cell
that it begins in, a thousand where it ends in another, and takes u_ff at each. What is said may not be below that, and
at most 1e-6 of the largest u_ff above it; near the times that are said it goes in steps a thousand times finer.
"""

import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from rich.console import Console
from scipy.linalg import expm

from pwatrack import load_spec
from pwatrack.arrays import Array
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import PwatrackError
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.desired import desired_flow, desired_peak
from pwatrack.workflow.tracking import desired_trajectory, generator_start

_STEPS = 200_000
_FINER = 1_000  # steps in the place of one that ends in another cell
_BELOW = 1e-9  # of the largest u_ff: what a fine step over a facet, and rounding, can be off by
_ABOVE = 1e-6  # likewise: what is claimed
_SPECS = Path("specs")

Peaked = tuple[PWASystem, DesiredTrajectory, Array, float]


def main(count: int, seconds: float) -> None:
    """Print the counts of so many random specs, and of the gallery's, for so long at most."""
    console, until = Console(), time.perf_counter() + seconds
    for name, cases in (("random", random_cases(count)), ("gallery", gallery())):
        parts = []
        for case in cases:
            if time.perf_counter() > until:
                console.print("time is up")
                break
            if (found := compared(*case)) is not None:
                parts.append(found)
        below, above = np.array(parts).reshape(-1, 2).T
        console.print(
            f"{name}: {len(below)} peaks; {int((below > _BELOW).sum())} below, {int((above > _ABOVE).sum())} more than "
            f"{_ABOVE:g} above; furthest below {below.max(initial=0):.2e}, above {above.max(initial=0):.2e}"
        )


def compared(
    plant: PWASystem, trajectory: DesiredTrajectory, start: Array, duration: float
) -> tuple[float, float] | None:
    """Return by how much a peak is below and above that of the other walk, in parts of the largest u_ff."""
    peak = desired_peak(plant, trajectory, trajectory.u_ff, start, duration)
    if peak is None:
        return None
    walk = Walked(plant, trajectory, start, duration)
    u = np.concatenate([walk.u, *(walk.near(time) for time in peak.times.flat)])
    size, bend = np.maximum(np.abs(u).max(axis=0), 1e-300), np.abs(np.diff(walk.u, 2, axis=0))
    between = np.quantile(bend, 0.9999, axis=0) / 8 / _FINER  # but for the steps over kinks and jumps
    below = np.maximum(u.max(axis=0) - peak.high, peak.low - u.min(axis=0)) / size
    above = (np.maximum(peak.high - u.max(axis=0), u.min(axis=0) - peak.low) - between) / size
    return float(below.max()), float(above.max())


class Walked:
    """u_ff at the ends of equal steps, (K, m), and in far smaller ones near a time."""

    def __init__(self, plant: PWASystem, trajectory: DesiredTrajectory, start: Array, duration: float) -> None:
        system, flow = trajectory.exosystem, desired_flow(plant, trajectory)
        self.trajectory, self.matrices = trajectory, [flow.matrix((i,)) for i in range(len(trajectory.rate))]
        self.t = np.linspace(0.0, duration if system.end is None else min(duration, system.end), _STEPS + 1)
        self.p = len(start)
        self.z, self.u = self._walked(start, self.t)

    def near(self, time: float) -> Array:
        """Return it in small steps, from a step before to a step after the one that a time is in."""
        first = max(0, int(time / self.t[1]) - 1)
        t = np.linspace(self.t[first], self.t[min(first + 3, _STEPS)], 3 * _FINER + 1)
        return self._walked(self.z[first, : self.p], t)[1]

    def _walked(self, start: Array, t: Array) -> tuple[Array, Array]:
        """Return (η, w, 1) and u_ff at equal steps."""
        trajectory, p, step = self.trajectory, self.p, t[1] - t[0]
        z = np.hstack([np.zeros((len(t), p)), trajectory.exosystem.states(t), np.ones((len(t), 1))])
        z[0, :p] = start
        turns, finer = (np.array([expm(F * h) for F in self.matrices]) for h in (step, step / _FINER))
        guards, signs = np.ascontiguousarray(trajectory.guards), trajectory.signs.astype(float)
        cells = _walk(z, p, turns, finer, guards, signs)
        return z, np.asarray(np.einsum("kms,ks->km", trajectory.u_ff[cells], z))


@njit
def _walk(z: Array, p: int, turns: Array, finer: Array, guards: Array, signs: Array) -> Array:  # pragma: no cover
    """Fill in η of all rows of z, and return their cells; a step into another cell is made again in finer ones."""
    cells = np.zeros(len(z), dtype=np.int64)
    cells[0] = _cell(z[0], guards, signs)
    for k in range(len(z) - 1):
        z[k + 1, :p] = (turns[cells[k]] @ z[k])[:p]
        cells[k + 1] = _cell(z[k + 1], guards, signs)
        if cells[k + 1] != cells[k]:
            at, cell = z[k].copy(), cells[k]
            for _ in range(_FINER):
                at = finer[cell] @ at
                cell = _cell(at, guards, signs)
            z[k + 1, :p] = at[:p]
            cells[k + 1] = _cell(z[k + 1], guards, signs)
    return cells


@njit
def _cell(at: Array, guards: Array, signs: Array) -> int:  # pragma: no cover
    """Return the cell that a state is least outside of."""
    best, least = 0, np.inf
    for i in range(len(signs)):
        off = 0.0
        for j in range(len(guards)):
            off = max(off, -signs[i, j] * (guards[j] @ at))
        if off < least:
            best, least = i, off
    return best


def random_cases(count: int) -> Iterator[Peaked]:
    """Yield plants with two internal states, a spring on one of them, and a start off the steady state."""
    for seed in range(count):
        random = np.random.default_rng(seed)
        turn, damping = 10.0 ** random.uniform(0, 3), 10.0 ** random.uniform(-1.5, 0)
        c = np.round(random.normal(size=6), 3).tolist()
        stop = {"name": "stop", "kind": "spring", "of": "p", "start": 0.01 + abs(c[4]) / 5, "slope": turn * damping}
        spec = {
            "name": f"random {seed}",
            "system": {
                "states": ["x", "p", "q"],
                "inputs": ["u"],
                "outputs": ["y"],
                "A": [[c[0], 10 * c[1], c[2]], [0, 0, turn], [c[3], -turn, -2 * damping * turn]],
                "B": [[1], [0], [0]],
                "C": [[1, 0, 0]],
                "nonlinearities": [stop | {"into": {"q": -1}}],
            },
            "reference": {"output": f"{c[5]} + 0.1*sin({10.0 ** random.uniform(-0.5, 1.5):.4g}*t)"},
            "simulation": {"duration": 1 + 200 / turn, "sample_time": 0.01},
        }
        yield from _case(spec, random.normal(size=2))


def gallery() -> Iterator[Peaked]:
    """Yield the specs of the gallery that have a feedforward."""
    for path in sorted(_SPECS.rglob("*.yaml")):
        yield from _case(path, None)


def _case(source: Path | Mapping[str, Any], start: Array | None) -> Iterator[Peaked]:
    try:
        spec = load_spec(source)
        trajectory = desired_trajectory(spec, True)
        if start is None and trajectory.generator is not None and trajectory.names:
            start = generator_start(spec, trajectory)
    except PwatrackError:
        return
    start = trajectory.eta0 if start is None else start
    start = np.zeros(trajectory.rate.shape[1]) if start is None else start
    yield spec.problem.plant, trajectory, start, spec.scenario.duration


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100, float(sys.argv[2]) if len(sys.argv) > 2 else 600.0)
