"""Every plant of the specs, sampled: how far off is the loop with either program, and is it proved?

    make sampled [SPECS="specs/gallery/gantry.yaml …"]

The sample time is a 25th of the period of the fastest mode of A_i + B K, to one digit. Each plant runs under the
conditions of its spec, without noise and steps: with the program that predicts and corrects, and with the observer of
the theorems stepped under a held y. Printed is the largest error of the last tenth of both runs, the rate that is
proved in continuous time and of the sampled loop, and how long that proof took; then of the bounds of what is tracked,
per 1 of each disturbance and noise, how many times those in continuous time these are, and what random switchings
reach of them with what acts at its worst. Last are medians.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from pwatrack import Spec, load_spec
from pwatrack.arrays import Array
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds, seen
from pwatrack.control.controller import Asked, ProvedController
from pwatrack.control.sampled_disturbances import row
from pwatrack.errors import PwatrackError
from pwatrack.model.conditions import Method, Sampling
from pwatrack.model.pwa import PWASystem
from pwatrack.workflow.outcome import SimulatedLoop
from pwatrack.workflow.pipeline import asked_of, design, simulate
from tests.sampled import all_of_size_one, tubes_alone, worst_found

SPECS = [*sorted(Path("specs").glob("*.yaml")), *sorted(Path("specs/gallery").glob("*.yaml"))]
_SAMPLES = 25  # in a period of the fastest mode
_MOST = 20_000  # samples of a run
_SWITCHINGS = 100  # that are tried against each bound


def sample_time(plant: PWASystem, K: Array) -> float:
    """Return the sample time that is taken, in s."""
    fastest = max(float(np.abs(np.linalg.eigvals(A + plant.B @ K)).max()) for A in plant.A)
    return float(f"{2 * np.pi / (_SAMPLES * fastest):.1g}")


def sampled(spec: Spec, sampling: Sampling) -> Spec:
    """Return a spec whose controller is sampled, for as long as is simulated here."""
    conditions = replace(spec.scenario.conditions, sampling=sampling, noise=None, quanta=None)
    duration = min(spec.scenario.duration, _MOST * sampling.sample_time)
    scenario = replace(spec.scenario, conditions=conditions, duration=duration, sample_time=duration / 2000)
    return replace(spec, scenario=scenario)


def left(result: SimulatedLoop) -> float:
    """Return the largest error of the last tenth."""
    error = result.response.error_norm
    return float(error[-len(error) // 10 :].max())


def errors(spec: Spec, controller: ProvedController, h: float) -> list[float]:
    """Return what is left with either program, not a number where it is refused."""
    found, methods = list[float](), list[Method](["corrected", "emulated"])
    for method in methods:
        try:
            found.append(left(simulate(sampled(spec, Sampling(sample_time=h, method=method)), controller)))
        except PwatrackError:
            found.append(np.nan)
    return found


def beside_continuous(controller: ProvedController, asked: Asked) -> tuple[list[float], list[float]]:
    """Return how many times those in continuous time bounds of the sampled loop are, and what is reached of them."""
    times, reached = list[float](), list[float]()
    for claim in SampledBounds.prove(controller, replace(asked, acting=all_of_size_one)):
        known = {bounds.channel: bounds.sizes for bounds in controller.claim(SignalBounds).acting}
        for channel, (tube, *_) in tubes_alone(claim).items():
            for form, size in zip(seen(controller), tube.sizes, strict=True):
                if form[0] == controller.tracking and known.get(channel, {}).get(form):
                    times.append(size / known[channel][form])
                    c = row(claim.errors, form).floats
                    reached += [worst_found(claim, channel, c, seed) / size for seed in range(_SWITCHINGS)]
    return times, reached


def main(paths: list[Path]) -> None:
    """Print a line for each plant."""
    console, shares, rates, seconds = Console(width=140), list[float](), list[float](), list[float]()
    found, worst = list[float](), list[float]()
    for path in paths:
        try:
            spec = load_spec(path)
            conditions = replace(spec.scenario.conditions, sampling=None)
            controller = design(replace(spec, scenario=replace(spec.scenario, conditions=conditions)))
        except PwatrackError as error:
            console.print(f"{path.stem:28} {str(error)[:100]}")
            continue
        h = sample_time(controller.plant, controller.K)
        start = time.perf_counter()
        asked = asked_of(sampled(spec, Sampling(sample_time=h)), None, controller)
        (claim,) = SampledLoop.prove(controller, asked)
        seconds.append(time.perf_counter() - start)
        controller = replace(controller, claims=(*controller.claims, claim))
        start, (times, reached) = time.perf_counter(), beside_continuous(controller, asked)
        tubes, found, worst = time.perf_counter() - start, [*found, *reached], [*worst, *times]
        corrected, emulated = errors(spec, controller, h)
        shares.append(emulated / corrected)
        said = claim.missing
        if claim.proof is not None:
            rates.append(claim.proof.rate / controller.guarantees.rate)
            said = f"rate {claim.proof.rate:.3g} of {controller.guarantees.rate:.3g} 1/s"
        console.print(
            f"{path.stem:28} {h:7.0e} s  left {corrected:8.2g}, emulated {emulated:8.2g}  {seconds[-1]:5.1f} s  {said}"
        )
        if times:
            said = f"bounds {np.median(times):.3g} to {max(times):.3g} times those in continuous time"
            console.print(f"{'':28} {said}, {max(reached):.2g} of one reached, {tubes:.1f} s")
    console.print(
        f"emulated leaves {np.nanmedian(shares):.3g} times as much (median), least {np.nanmin(shares):.2g} times"
    )
    console.print(
        f"{len(rates)} of {len(seconds)} proved, at {np.median(rates):.2g} of the rate in continuous time (median)"
    )
    if worst:
        said = f"bounds are {np.median(worst):.3g} times those in continuous time (median), {max(worst):.3g} at most"
        console.print(f"{said}; {len(found)} switchings reach {max(found):.2g} of one at most")
    console.print(f"proof or its refusal: median {np.median(seconds):.2g} s, longest {max(seconds):.3g} s")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]] or SPECS)
