"""python-control's own simulation of exported loops against ours: every spec that designs.

    make control-bench
    python -m benchmarks.python_control [backlash tanks] [--part 0.1] [--limit 300]

Each is designed, and its loop simulated without limits, noise and sampling for a part of its duration, by us and by
python-control with tolerances of 1e-10 and at least 2,000 steps (DOP853, which knows nothing of cells). Printed is how
far y, u, x̂ and x_d are off, in the largest that they are here, or 1, and which is worst; in the end the worst of all.
"""

import argparse
import signal
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
from rich.console import Console

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.errors import PwatrackError
from pwatrack.model.conditions import NOMINAL

SAMPLES, STEPS = 200, 2000
CLOSE = 1e-6


def off(spec: Spec, part: float) -> dict[str, float]:
    """Return how far each of y, u, x̂ and x_d is off."""
    duration = part * spec.scenario.duration
    scenario = replace(spec.scenario, conditions=NOMINAL, duration=duration, sample_time=duration / SAMPLES)
    made = design(replace(spec, scenario=scenario))
    ours, loop = simulate(made.spec, made), made.to_control()
    theirs = control.input_output_response(
        loop,
        ours.t,
        0,
        [*loop.params["start"]],
        solve_ivp_method="DOP853",
        solve_ivp_kwargs={"rtol": 1e-10, "atol": 1e-11, "max_step": duration / STEPS},
    )
    signals = dict(zip(theirs.output_labels, theirs.outputs, strict=True))
    states = made.plant.states
    compared: dict[str, tuple[Any, list[str]]] = {
        "y": (ours.y, [*made.plant.outputs]),
        "u": (ours.u, [*made.plant.inputs]),
        "x_hat": (ours.x_hat, [f"{x}_hat" for x in states]),
        "x_d": (ours.x_d, [f"{x}_d" for x in states]),
    }
    return {
        name: float(np.abs(np.array([signals[label] for label in labels]).T - values).max())
        / max(1.0, float(np.abs(values).max()))
        for name, (values, labels) in compared.items()
    }


def late(*_: Any) -> None:
    """Give up."""
    raise TimeoutError


def main(asked: argparse.Namespace) -> int:
    """Print each and the worst, and return 1 if one is not close, or not done."""
    console, found, wrong, started = Console(width=120), dict[str, float](), 0, time.perf_counter()
    signal.signal(signal.SIGALRM, late)
    for path in (*sorted(Path("specs").glob("*.yaml")), *sorted(Path("specs/gallery").glob("*.yaml"))):
        if asked.names and not any(name in path.stem for name in asked.names):
            continue
        begun = time.perf_counter()
        signal.alarm(asked.limit)
        try:
            with warnings.catch_warnings(action="ignore"):
                parts = off(load_spec(path), asked.part)
            worst = max(parts, key=lambda name: parts[name])
            found[path.stem] = parts[worst]
            wrong += not parts[worst] < CLOSE
            verdict = f"{parts[worst]:.1e} in {worst}"
        except PwatrackError as refusal:
            verdict = f"left out: {refusal.problems[0].message.splitlines()[0][:60]}"
        except TimeoutError:
            verdict, wrong = f"not done in {asked.limit} s", wrong + 1
        finally:
            signal.alarm(0)
        console.print(f"{path.stem:40} {verdict}, {time.perf_counter() - begun:.0f} s", highlight=False)
    if found:
        name = max(found, key=lambda key: found[key])
        console.print(f"{len(found)} loops, {wrong} not within {CLOSE}; the worst: {found[name]:.1e}, {name}")
    console.print(f"{time.perf_counter() - started:.0f} s")
    return int(wrong > 0 or not found)


def arguments() -> argparse.Namespace:
    """Return what is asked for."""
    parser = argparse.ArgumentParser(description="Compare python-control's simulation of exported loops with ours.")
    parser.add_argument("names", nargs="*", help="parts of the names of specs; all if there is none")
    parser.add_argument("--part", type=float, default=0.1, help="of the duration that the spec has")
    parser.add_argument("--limit", type=int, default=300, help="seconds that one may take")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main(arguments()))
