"""Gains of a sampled loop, made for the starts of a run where its errors are to settle with inputs at their limits."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from pwatrack.claims.ranges import ProgramRanges
from pwatrack.claims.registry import again
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_box import SampledBox, SampledBoxBounds
from pwatrack.claims.sampled_region import SampledRegion, against_windup, if_alone
from pwatrack.control.candidates import Candidates
from pwatrack.control.controller import Asked, Claim, ProvedController
from pwatrack.control.goal import AtLeast
from pwatrack.control.headroom import InputConstraint
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.sampled_search import work
from pwatrack.control.task import Task
from pwatrack.lmi.inequality import CONTROLLER

_OVER = (8.0, 4.0, 2.0)  # times what is left of an input: what a gain may ask of it from the starts
_MOST = 50_000  # what one of them may take to be proved: 15 s
_HOPELESS = 0.05  # of the starts
_MORE = 1.02  # times the starts, from which on a gain against windup is worth it
_STARTS = (SampledLoop, SampledBounds, SampledRegion)  # what has to be proved, to know the starts
_OTHERS = (ProgramRanges, SampledBox, SampledBoxBounds)  # what else is about the program


def with_sampled_starts_inside(controller: ProvedController, asked: Asked) -> ProvedController:
    """Return a controller whose sampled loop settles from the starts of the run, its ensemble, or within sizes.

    The same where it does. Else K is kept, with a gain against windup that makes the region larger; another K is taken
    where that is not enough, and this is.
    """
    share = _share(controller)
    much = sum(work(one.errors) * (1 + len(one.acts.squares)) for one in controller.claims_of(SampledBounds))
    if share is None or share >= 1 or much > _MOST:
        return controller
    kept, share = _with_gain_against_windup(controller, asked, share)
    if share >= 1:
        return kept
    made, share = _with_another_gain(controller, asked, share)
    if made is controller:
        return kept
    return made if share >= 1 else _with_gain_against_windup(made, asked, share)[0]


def _with_gain_against_windup(
    controller: ProvedController, asked: Asked, share: float
) -> tuple[ProvedController, float]:
    """Return a controller of the same K and M, with the gain against windup that has most of the starts, and how much.

    The same where none has more of them to speak of.
    """
    best, least = None, share * _MORE
    for gains, more in against_windup(controller, asked, _wanted(controller, controller.claim(SampledRegion))):
        if more > least:
            best, least = gains, more
        if least >= 1:
            break
    if best is None:
        return controller, share
    claims = tuple(_running_with(best, claim) for claim in controller.claims)
    return again(replace(controller, claims=claims), asked, (SampledRegion,)), least


def _running_with(gains: SampledGains, claim: Claim) -> Claim:
    """Return a claim of a loop in which another gain against windup runs, which changes nothing off limits."""
    if isinstance(claim, SampledLoop):
        return replace(claim, gains=gains)
    return replace(claim, errors=replace(claim.errors, gains=gains)) if isinstance(claim, SampledBounds) else claim


def _with_another_gain(controller: ProvedController, asked: Asked, share: float) -> tuple[ProvedController, float]:
    """Return a controller with a K that was made for the starts, and how much of them it has.

    The same where none has all of them. Only a K that was sought for a rate, or for nothing, is replaced, by a smaller
    one; with `within: region` by any that has more of the starts.
    """
    goal, first = asked.words.goals.get(CONTROLLER), controller.claim(SampledLoop).gains
    within = None if asked.room is None else asked.room.around(controller.sizes.state)
    if within is None or not isinstance(goal, AtLeast) or asked.sampled is None or first.delay:
        return controller, share
    best, whatever = controller, goal.within == "region"
    kinds = ("run", _wanted(controller, controller.claim(SampledRegion)))
    for starts in reversed(within.starts):
        for gains in _sought(controller, replace(within, starts=[starts]), asked.sampled):
            if not whatever and controller.sizes.norm(gains.K) > controller.sizes.norm(first.K):
                continue
            wanted = replace(asked, sampled=gains)
            tried = again(controller, wanted, _STARTS[:1])
            alone = _share(tried, if_alone(tried, wanted, kinds)) or 0.0
            if alone < _HOPELESS and not whatever:
                break  # a smaller one has not so many times more
            if alone < (share if whatever else 1):
                continue
            tried = again(tried, wanted, _STARTS[1:])
            more = _share(tried) or 0.0
            if more >= 1:
                return again(tried, asked, _OTHERS), more
            if whatever and more > share:
                best, share = tried, more
    return best if best is controller else again(best, asked, _OTHERS), share


def _sought(controller: ProvedController, within: InputConstraint, made: SampledGains) -> Iterator[SampledGains]:
    """Yield gains made for starts with x̂ = x, smaller and smaller ones."""
    plant, sizes = controller.plant, controller.sizes
    candidates = Candidates(Task.of(plant, CONTROLLER, sizes=sizes))
    for over in _OVER:
        found = candidates.farthest_held(replace(within, over=over), made.sample_time)
        if found is not None and np.isfinite(found.K).all():
            yield replace(made, K=found.K)


def _share(controller: ProvedController, regions: Iterable[SampledRegion] | None = None) -> float | None:
    """Return how much of the starts is proved: of the run or its ensemble where these are told; None without limits.

    That is, in the regions that the controller has, or in others.
    """
    for region in controller.claims_of(SampledRegion) if regions is None else regions:
        left = region.left
        if left is None:
            return None
        if region.from_this_start(controller) or any(one.starts.kind == "every" for one in region.found):
            return 1.0
        wanted = _wanted(controller, region)
        scales = [one.scale(left) for one in region.found if one.starts.kind == wanted]
        return max(scales, default=0.0)
    return None


def _wanted(controller: ProvedController, region: SampledRegion) -> str:
    """Return which starts count: where inputs are late that of the run, if it is known as the first one acts."""
    kinds = ["ensemble", "run"]
    if region.late:
        kinds = ["run"] * any(bounds.begun is not None for bounds in controller.claims_of(SampledBounds))
    known = {one.kind for one in region.room.starts}
    return next((kind for kind in kinds if kind in known), "exact")
