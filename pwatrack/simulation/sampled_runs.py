"""Sample times that are refused, and one at which runs from many starts are seen to die out, which is no proof."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.claims.sampled import SampledLoop
from pwatrack.control.controller import ProvedController
from pwatrack.errors import CheckFailed, InvalidSpec, ProblemPart, Remedy, Way
from pwatrack.model.conditions import Conditions
from pwatrack.simulation.closed_loop import ClosedLoop, Response, closed_loop
from pwatrack.simulation.propagate import Propagator
from pwatrack.simulation.sample_map import SampleMaps, unstable_cell

_SCALES = 0.01, 1.0, 100.0  # of the way to the farthest facet: in one cell, across facets, and where they look near
_DIRECTIONS = 6  # at each of these
_MOST_CELLS = 8  # whose slowest deviation is a start, and facets that runs start at
_BESIDE = 1e-3  # of the way to a facet: how far from it, with the observer on its other side
_GONE = 1e-3  # of a start: what is left of one that died out
_LONGER = 2.0  # than the slowest of the cells would take to that
_FEWEST, _MOST = 60, 8_000  # samples of a run: one that takes more is not seen to the end
_NEXT = 0.8  # from one sample time that is tried to the next
_TRIES = 12  # of them: down to a twelfth
_SEED = 1  # of the directions: the same ones each time


def sampling_remarks(controller: ProvedController, conditions: Conditions) -> tuple[str, ...]:
    """Say beforehand that a simulation will be refused for its sample time, and which ones could be proved."""
    found = unstable_cell(controller, conditions)
    said = [] if found is None else [f"{found[0]}; so it is not simulated"]
    for claim in controller.claims_of(SampledLoop):
        if claim.longest is not None:
            h = claim.gains.sample_time
            but = f"{h:g} s are too long for a proof: " if claim.proof is None and claim.longest < h else ""
            said.append(
                f"{but}with other gains, made for it, a proof was found up to a sample time of {claim.longest:g} s; "
                "it is not about these gains"
            )
    return tuple(said)


def check_sample_time(controller: ProvedController, conditions: Conditions) -> None:
    """Refuse a sample time at which the loop is unstable in some cell, where no cell is at a shorter one.

    Raises:
        CheckFailed: With the cell, the spectral radius there, and a time at which runs die out if one is found.
    """
    found = unstable_cell(controller, conditions)
    if found is None:
        return
    message, maps, longest = found
    offer = dying_out(maps, longest)
    if offer is None:
        message += f"; shorter times were tried down to {_tried(longest)[-1]:g} s, and with none do all "
        message += "simulated runs from other starts die out"
        remedy = Remedy(Way.SLOWER_GAINS)
    else:
        message += f"; at {longest:g} s no cell by itself is unstable, "
        message += f"and at {offer[0]:g} s all of {offer[1]} simulated runs from other starts died out"
        remedy = Remedy(Way.FASTER_SAMPLES, (offer[0],))
    raise CheckFailed(message, subject=(ProblemPart.SAMPLE_TIME,), remedy=remedy)


def dying_out(maps: SampleMaps, longest: float) -> tuple[float, int] | None:
    """Return a sample time (s) at which all runs are seen to die out, and how many; None if none is found.

    They do at a time that is a quarter longer, too. Up to `longest` (s) it is stable in each cell by itself.
    """
    before = False
    for time in _tried(longest):
        count = _all_die_out(maps, time)
        if before and count:
            return time, count
        before = bool(count)
    return None


def _tried(longest: float) -> list[float]:
    """Return the sample times that are tried, in s, the longest first."""
    return [float(f"{longest * _NEXT**k:.2g}") for k in range(_TRIES)]


def _all_die_out(maps: SampleMaps, h: float) -> int:
    """Return how many runs there were, 0 where one did not die out.

    What is off is the difference to the run that begins on x_d with x̂ = x: what a moving reference leaves of an error
    in a sampled loop is in both.
    """
    _, radius = maps.worst(h)
    if not 0 < radius < 1:
        return 0
    ticks = max(_FEWEST, int(np.ceil(_LONGER * np.log(_GONE) / np.log(radius))))
    controller, end = maps.controller, maps.controller.trajectory.exosystem.end
    if ticks > _MOST or (end is not None and ticks * h > end):
        return 0
    sampling = replace(maps.sampling, sample_time=h, jitter=0.0)
    other = None if maps.plant is controller.plant else maps.plant
    loop = closed_loop(controller, Conditions(plant=other, sampling=sampling))
    at_rest = np.zeros(2 * len(controller.sizes.state))
    try:
        propagator = Propagator(loop.flow, duration=ticks * h, sample_time=h)
        nominal, found = _run(loop, propagator, at_rest), 0
        for away in _starts(maps, h, nominal.x_d[0]):
            run, sizes = _run(loop, propagator, away), controller.sizes.state
            off = np.hstack([run.x - nominal.x, run.x_hat - nominal.x_hat]) / np.tile(sizes, 2)
            left = np.linalg.norm(off[-ticks // 10 :], axis=1).max()
            if not left <= _GONE * np.linalg.norm(off[0]):
                return 0
            found += 1
    except (CheckFailed, InvalidSpec):  # it runs away, or floating point does not resolve it
        return 0
    return found


def _run(loop: ClosedLoop, propagator: Propagator, away: Array) -> Response:
    """Run the loop from (x, x̂) that are so far from x_d, (2 n,)."""
    trajectory = loop.controller.trajectory
    eta = np.zeros(len(trajectory.names)) if trajectory.eta0 is None else trajectory.eta0
    x_d = trajectory.state(np.concatenate([eta, trajectory.exosystem.w0, [1.0]]))
    x, x_hat = np.split(np.tile(x_d, 2) + away, 2)
    start, end = loop.start(plant=x, observer=x_hat, generator=eta), propagator.samples * propagator.sample_time
    return loop.response(propagator.walk(start, loop.resets(end)).trace())


def _starts(maps: SampleMaps, h: float, x_d: Array) -> Iterator[Array]:
    """Yield how far (x, x̂) begin from x_d: in all directions, in the slowest of each cell, and on facets."""
    sizes, partition = maps.controller.sizes.state, maps.controller.plant.partition
    both, n, random = np.tile(sizes, 2), len(sizes), np.random.default_rng(_SEED)
    distance = (partition.H @ x_d + partition.h) / np.maximum(np.linalg.norm(partition.H * sizes, axis=1), 1e-300)
    far = max(1.0, float(np.abs(distance).max(initial=0.0)))
    for scale in _SCALES:
        for direction in random.normal(size=(_DIRECTIONS, 2 * n)):
            yield scale * far * both * direction / np.linalg.norm(direction)
    for cell in sorted(maps.cells, key=lambda cell: -maps.radius(cell, h))[:_MOST_CELLS]:
        values, vectors = np.linalg.eig(maps.loop(cell, h))
        slowest = vectors[: 2 * n, np.argmax(np.abs(values))].real
        if slowest.any():
            yield _SCALES[-1] * far * slowest / np.linalg.norm(slowest / both)
    for row, away in [*zip(partition.H, distance, strict=True)][:_MOST_CELLS]:
        step = sizes**2 * row / max(np.linalg.norm(sizes * row), 1e-300)
        beside = _BESIDE * max(abs(away), 1.0)
        yield np.concatenate([-(away - beside) * step, -(away + beside) * step])
