"""Forms that prove a loop that is sampled, looked for with as many substeps and knots as it takes, within a budget."""

from dataclasses import replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.estimated_loads import OnEstimates
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains, sampled_gains
from pwatrack.control.vertices import boxes, outermost_cells
from pwatrack.lmi.bisection import bisected
from pwatrack.lmi.clocked import ClockedProof, clocked_proof, fastest
from pwatrack.lmi.exact import rounded_down
from pwatrack.model.conditions import Sampling
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes

_TRIED = ((1, 1), (2, 1), (2, 2), (4, 2))  # times as many substeps, and segments of each: what is tried
_OF_ONE = ((1, 1), (1, 2), (1, 4))  # the same of a prediction without substeps
_MOST_WORK = 100_000  # inequalities times the square of their order: an auditor takes about 10 steps for each
_MOST_UNKNOWNS = 2_100  # of all forms: a step of the search takes a tenth of a second then
_MOST_ALONE = 6_000  # the same of the only search there is
_MOST_OF_MANY = 13_000, 700  # the same where many sample times are looked at: each takes half a second then
_NEAR = 0.05  # of the longest sample time: how near to it one is looked for
_DIGITS = 3  # of a sample time that is looked at
_FACTOR, _OFTEN = 4.0, 3  # by which a sample time is changed, and how often, until one is proved and one is not
_MOST_TURNED = 20.0  # h times the size of what x_d and u_ff are made of: beyond it a sample is no short time
_SHARES_OF_BOX = (0.5, 0.25, 0.1)  # of the rate that parts of z have by themselves: what is asked for a box
_MOST_CELLS = 256  # of a hull, that are looked at one by one


def too_much(plant: PWASystem, gains: SampledGains, estimates: OnEstimates | None = None) -> str:
    """Say why nothing is tried; "" where it is."""
    if not (np.isfinite(gains.K).all() and np.isfinite(gains.M).all()):
        return "its gains are out of range: a sample is too long"
    if _least_work(plant, gains) > _MOST_WORK:
        return "its cells are too many"
    if estimates is not None and estimates.turned(gains.sample_time) > _MOST_TURNED:
        return "what x_d is made of turns too far in a sample"
    errors = SampledErrors.of(plant, gains, estimates)
    if work(errors) > _most(errors):
        return _much(errors)
    return ""


def with_forms(
    plant: PWASystem, gains: SampledGains, estimates: OnEstimates | None = None, sizes: Sizes | None = None
) -> tuple[SampledGains, ClockedProof] | None:
    """Return gains with as many substeps as a proof needs, and that proof; None where none is found."""
    errors = SampledErrors.of(plant, gains, estimates, sizes)
    most = _most(errors)
    for finer, knots in _tried(errors, most, _MOST_UNKNOWNS) or _tried(errors, most, _MOST_ALONE)[:1]:
        proof = fastest(finer.clocked, knots=knots)
        if proof is not None:
            return finer.gains, proof
    return None


def with_corners(errors: SampledErrors, knots: int) -> tuple[ClockedProof | None, str]:
    """Return forms that prove the loop for all plants of a box, with so many segments or more; else why not."""
    missing = ""
    for finer in (knots, 2 * knots, 4 * knots):
        if work(errors) * finer > _MOST_WORK:
            return None, missing or _much(errors)
        if (proof := fastest(errors.clocked, knots=finer, shares=_SHARES_OF_BOX)) is not None:
            return proof, ""
        missing = "no forms were found that prove it"
    return None, missing


def longest(
    plant: PWASystem,
    K: Array,
    L: Array,
    near: SampledGains,
    estimates: OnEstimates | None = None,
    sizes: Sizes | None = None,
) -> float | None:
    """Return the longest sample time (s) that is found, to 5 %, for which gains made of K and L for it are proved.

    That of `near` is looked at first; its delay and jitter are those of the others.
    """
    too_long = dict[int, float]()  # for the fewest substeps and knots, and for the most

    def at(h: float) -> tuple[float, None] | None:
        h = rounded_down(h, _DIGITS)
        if not h > near.jitter:
            return None
        gains = sampled_gains(plant, K, L, Sampling(sample_time=h, delay=near.delay, jitter=near.jitter))
        if too_much(plant, gains, estimates):
            return None
        tried = _tried(SampledErrors.of(plant, gains, estimates, sizes), *_MOST_OF_MANY)
        for k in (0, len(tried) - 1)[: len(tried)]:
            errors, knots = tried[k]
            if h < too_long.get(k, np.inf):
                if clocked_proof(errors.clocked, knots=knots) is not None:
                    return h, None
                too_long[k] = h
        return None

    def between(found: tuple[float, None], without: float) -> float:
        return bisected(found, without, at, near=_NEAR, middle=lambda one, other: (one * other) ** 0.5)[0]

    h, found = near.sample_time, at(near.sample_time)
    factor = 1 / _FACTOR if found is None else _FACTOR
    for k in range(1, _OFTEN + 1):
        seen = at(h * factor**k)
        if found is None and seen is not None:
            return between(seen, h * factor ** (k - 1))
        if found is not None and seen is None:
            return between(found, h * factor**k)
        found = seen
    return None if found is None else found[0]


def _tried(errors: SampledErrors, most: int, unknowns: int) -> list[tuple[SampledErrors, int]]:
    """Return errors with as many substeps as are tried, and the segments of each, as far as that is not too much."""
    gains = errors.gains
    finer = [
        (replace(errors, gains=replace(gains, substeps=more * gains.substeps)), knots)
        for more, knots in (_TRIED if gains.substeps > 1 else _OF_ONE)
    ]
    size = errors.order * (errors.order + 1) // 2
    few = [(one, knots) for one, knots in finer if one.parts * (knots + 1) * size <= unknowns]
    return [(one, knots) for one, knots in few if work(one) * knots <= most]


def work(errors: SampledErrors) -> int:
    """Return how much one segment in each substep takes."""
    flows, edges = errors.flows
    return 2 * errors.parts * flows * errors.order * (errors.order + edges)


def _most(errors: SampledErrors) -> int:
    """Return how much an auditor may have to do: with estimates numbers are long, and take twice as many steps."""
    return _MOST_WORK if errors.estimates is None else _MOST_WORK // 2


def _much(errors: SampledErrors) -> str:
    return f"it takes {2 * errors.parts * errors.flows[0]} inequalities of order {errors.order}, which is too much"


def _least_work(plant: PWASystem, gains: SampledGains) -> int:
    """Return what inequalities times the square of their order are at least, without looking for changes.

    Where cells are no box there are as many of these as cells at least: a hull of differences has no fewer corners than
    the hull.
    """
    of = plant.model
    cells = len(of.hull) if len(of.hull) > _MOST_CELLS else len(boxes(outermost_cells(of)))
    parts, predicted = gains.substeps if len(of.hull) > 1 else 1, max(1, gains.delay)
    order = sum(plant.B.shape) + predicted * (plant.observed.C.shape[1] + (len(of.hull) > 1))
    own = cells if plant.watched is None else 1
    return int(2 * parts * own * cells ** (2 * predicted) * order**2)
