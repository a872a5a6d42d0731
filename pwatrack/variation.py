"""A closed loop varied: many members of one design, and what became of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pwatrack.errors import InvalidSpec, Problem, Subject
from pwatrack.pipeline import Result
from pwatrack.simulation.ensemble import Ensemble, Member, simulate_ensemble
from pwatrack.simulation.propagate import sample_count
from pwatrack.simulation.region import Box, Region

Over = Literal["initial"]

_MOST_KEPT = 250_000_000  # tracking errors: 2 GB


@dataclass(frozen=True, kw_only=True)
class EnsembleResult:
    """What became of a closed loop in many variations.

    Attributes:
        nominal: The run that was varied.
        over: What differs between members.
        regions: Where they start, by part.
        given: Whether the spec says where; else it is the default.
        seed: Of the random numbers.
        ensemble: The members; number k in files and messages is index k − 1.
    """

    nominal: Result
    over: Over
    regions: dict[str, Region]
    given: bool
    seed: int
    ensemble: Ensemble


def ensemble(
    result: Result,
    count: int,
    *,
    over: Over = "initial",
    seed: int = 1,
    workers: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> EnsembleResult:
    """Run a simulated closed loop again in many variations, each as exactly as `simulate` does.

    Args:
        result: What `simulate(spec)` returned.
        count: How many members; the first members of a larger ensemble are the same.
        over: What differs: "initial", the initial states, drawn uniformly from the regions of the spec. Where it
            says none, each state of the plant starts within the largest size it has in `result` of its nominal start.
        seed: Of the random numbers, at least 0.
        workers: Threads; None for one on each core. The result does not depend on it.
        progress: Called with the number of members done, after each.

    Raises:
        InvalidSpec: If there is too much to keep, or a region does not fit the generator.
        CheckFailed: If a member has more than 1,000 events without progress in time.

    Example:
        >>> from pwatrack import load_spec, simulate
        >>> result = simulate(load_spec("specs/two_mass_paper_gains.yaml"))
        >>> many = ensemble(result, 4)
        >>> many.ensemble.error.shape, bool(many.ensemble.final.max() < 1e-3)
        ((4, 6001), True)
    """
    spec = result.spec
    samples = sample_count(spec.duration, spec.sample_time)
    if count * samples > _MOST_KEPT:
        message = f"{count:,} members with {samples:,} samples each, at most {_MOST_KEPT:,} samples in all are kept"
        raise InvalidSpec(
            Problem(message=message, subject=None, hint="fewer members, or a longer sample_time: events stay exact")
        )
    with spec.located():
        regions = dict(spec.regions) or _around(result)
        return EnsembleResult(
            nominal=result,
            over=over,
            regions=regions,
            given=bool(spec.regions),
            seed=seed,
            ensemble=simulate_ensemble(
                other_starts(result, regions, count, seed),
                duration=spec.duration,
                sample_time=spec.sample_time,
                workers=workers,
                progress=progress,
            ),
        )


def other_starts(result: Result, regions: dict[str, Region], count: int, seed: int) -> list[Member]:
    """Return the loop from initial states drawn from regions; parts without one start as in `result`.

    Raises:
        InvalidSpec: If there is a region for a generator whose start is fixed or has another number of entries.
    """
    loop, starts = result.loop, np.tile(result.start, (count, 1))
    places = {"plant": loop.at.x, "observer": loop.at.x_hat, "generator": loop.at.eta_hat}
    for number, (part, where) in enumerate(places.items()):
        if part not in regions:
            continue
        random = np.random.default_rng([seed, number])  # so that no part depends on another
        drawn = regions[part].draw(random, count)
        if part == "generator":
            _check_generator(result, drawn.shape[1])
        starts[:, where] = drawn
    error, resets = loop.tracking_error, tuple(loop.resets(result.spec.duration))
    return [Member(flow=loop.flow, z0=z0, error=error, resets=resets) for z0 in starts]


def _around(result: Result) -> dict[str, Region]:
    """Return the default: within the largest size of each state of the plant in a run of where that run starts."""
    x = result.response.x
    size = np.abs(x).max(axis=0)
    return {"plant": Box(low=x[0] - size, high=x[0] + size)}


def _check_generator(result: Result, entries: int) -> None:
    subject: Subject = ("simulation", "ensemble", "initial", "generator")
    where, fixed = ".".join(map(str, subject)), result.generator_start_fixed
    expected = result.response.eta_hat.shape[1]
    if fixed:
        message = f"{where}: the reference itself says where the desired trajectory starts"
        raise InvalidSpec(Problem(message=message, subject=subject, hint="leave it out"))
    if entries != expected:
        found = f"{entries} interval" + "s" * (entries != 1)
        message = f"{where}: {found}, expected {expected}, one for each state of the generator"
        raise InvalidSpec(Problem(message=message, subject=subject))
