"""Enclosed peaks of feedforwards against another, fine walk, of random specs and the gallery's; prints the counts.

    .venv/bin/python -m benchmarks.peaks [specs [seconds]]

The other walk knows no events and no enclosure: it goes in 200,000 equal steps, each by the exponential of the cell
that it begins in, and takes u_ff at each. What is said may not be below that, and at most 1e-6 of the largest u_ff
above it, but for what a parabola between samples can add.
"""

import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from scipy.linalg import expm

from pwatrack import load_spec
from pwatrack.arrays import Array
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import PwatrackError
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.mode_sequence import desired_flow
from pwatrack.simulation.peak import feedforward_peak
from pwatrack.workflow.starting import generator_start
from pwatrack.workflow.tracking import desired_trajectory

_STEPS = 200_000
_BELOW = 1e-7  # of the largest u_ff: what a step over a facet can be off by
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
    peak = feedforward_peak(plant, trajectory, start, duration)
    if peak is None:
        return None
    u = walked(plant, trajectory, start, duration)
    size, bend = np.abs(u).max(axis=0), np.abs(np.diff(u, 2, axis=0))
    between = np.quantile(bend, 0.9999, axis=0) / 8  # but for the steps over kinks and jumps
    size = np.maximum(size, 1e-300)
    below = np.maximum(u.max(axis=0) - peak.high, peak.low - u.min(axis=0)) / size
    above = (np.maximum(peak.high - u.max(axis=0), u.min(axis=0) - peak.low) - between) / size
    return float(below.max()), float(above.max())


def walked(plant: PWASystem, trajectory: DesiredTrajectory, start: Array, duration: float) -> Array:
    """Return u_ff at the ends of equal steps, (K, m)."""
    system, p, flow = trajectory.exosystem, len(start), desired_flow(plant, trajectory)
    t = np.linspace(0.0, duration if system.end is None else min(duration, system.end), _STEPS + 1)
    turns = [expm(flow.matrix((i,)) * t[1]) for i in range(len(trajectory.rate))]
    z = np.hstack([np.zeros((len(t), p)), system.states(t), np.ones((len(t), 1))])
    cells, eta = np.zeros(len(t), dtype=np.int64), start
    for k, row in enumerate(z):
        row[:p] = eta
        sides = trajectory.guards @ row
        cells[k] = int(np.argmin(np.maximum(-trajectory.signs * sides, 0.0).max(axis=1, initial=0.0)))
        eta = turns[cells[k]][:p] @ row
    return np.asarray(np.einsum("kms,ks->km", trajectory.u_ff[cells], z))


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
        trajectory, generator = desired_trajectory(spec, True)
        if start is None and generator is not None and trajectory.names:
            start = generator_start(spec, trajectory, generator)
    except PwatrackError:
        return
    start = trajectory.eta0 if start is None else start
    yield spec.problem.plant, trajectory, np.zeros(0) if start is None else start, spec.scenario.duration


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100, float(sys.argv[2]) if len(sys.argv) > 2 else 600.0)
