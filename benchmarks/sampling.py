"""Random designs, sampled as slowly as no cell by itself forbids, and as is offered: does the loop run away?

    .venv/bin/python -m benchmarks.sampling [designs]

Each design runs 4,000 samples with four kinds of controller; an error that is larger in the last 500 of them than ever
before, by more than 5 %, counts as unstable.
"""

import sys
from dataclasses import replace

import numpy as np
from rich.console import Console

from pwatrack.errors import CheckFailed, PwatrackError
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.simulation.closed_loop import ClosedLoop, closed_loop
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.simulation.sampled_runs import SampleMaps, dying_out
from tests.plants import random_plant
from tests.promises import track

KINDS = {
    "corrected": Sampling(sample_time=1e3),
    "corrected, late by a sample": Sampling(sample_time=1e3, delay=1),
    "emulated": Sampling(sample_time=1e3, method="emulated"),
    "Euler": Sampling(sample_time=1e3, method="euler"),
}


def design(seed: int) -> ClosedLoop | None:
    """Return a loop with up to 6 states and 8 cells, None where no gain is found; springs are weak or strong."""
    random = np.random.default_rng(1000 + seed)
    r = 1 + seed % 4
    n, k = int(random.integers(r, 7)), int(random.integers(1, 4))
    try:
        plant = random_plant(seed, n=n, k=k, r=r, strength=(0.05, 0.4)[seed // 4 % 2])
        return track(plant, "0.2 + sin(2*t) + 0.5*cos(3*t)")
    except PwatrackError:
        return None


def growth(loop: ClosedLoop, sampling: Sampling, seed: int, samples: int = 4000) -> float:
    """Return the largest error of the last eighth over the largest before; NaN where a run has too many crossings."""
    run, x_0 = closed_loop(loop.controller, Conditions(sampling=sampling)), np.random.default_rng(seed)
    n, p, end = len(loop.plant.states), len(loop.controller.trajectory.names), samples * sampling.sample_time
    start = run.start(plant=x_0.normal(size=n), observer=np.zeros(n), generator=np.zeros(p))
    try:
        trace = simulate_flow(run.flow, start, duration=end, sample_time=sampling.sample_time, resets=run.resets(end))
    except CheckFailed:
        return np.nan
    response = run.response(trace)
    error = np.abs(response.x - response.x_d).max(axis=1)
    return float(error[-samples // 8 :].max() / error[: -samples // 8].max())


def main(count: int) -> None:
    """Print how many loops were stable, and the largest growth."""
    found: dict[str, list[float]] = {name: [] for kind in KINDS for name in (kind, f"{kind}, offered")}
    for seed in range(count):
        loop = design(seed)
        for kind, sampling in KINDS.items() if loop else ():
            assert loop is not None
            maps = SampleMaps(loop.controller, loop.plant, sampling)
            longest = maps.longest(sampling.sample_time)
            offer = None if longest is None else dying_out(maps, longest)
            for name, time in ((kind, longest), (f"{kind}, offered", offer and offer[0])):
                if time:
                    found[name].append(growth(loop, replace(sampling, sample_time=time), seed))
    console = Console()
    for kind, growths in found.items():
        known = [value for value in growths if not np.isnan(value)]
        stable, left_out = sum(value <= 1.05 for value in known), len(growths) - len(known)
        said = f"{stable} of {len(known)} loops stable; largest growth {max(known, default=0.0):.4f}"
        console.print(f"{kind:38} {said}{f'; {left_out} with too many crossings to run' if left_out else ''}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
