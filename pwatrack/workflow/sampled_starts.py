"""K of a sampled loop, made for the starts of a run where its errors are to settle with inputs at their limits."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from pwatrack.claims.ranges import ProgramRanges
from pwatrack.claims.registry import again
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_box import SampledBox, SampledBoxBounds
from pwatrack.claims.sampled_region import SampledRegion
from pwatrack.control.candidates import Candidates
from pwatrack.control.controller import Asked, ProvedController
from pwatrack.control.goal import AtLeast
from pwatrack.control.headroom import InputConstraint
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.sampled_search import work
from pwatrack.control.task import Task
from pwatrack.lmi.inequality import CONTROLLER

_OVER = (8.0, 4.0, 2.0)  # times what is left of an input: what a gain may ask of it from the starts
_MOST = 50_000  # what one of them may take to be proved: 15 s
_STARTS = (SampledLoop, SampledBounds, SampledRegion)  # what has to be proved, to know the starts
_OTHERS = (ProgramRanges, SampledBox, SampledBoxBounds)  # what else is about the program


def with_sampled_starts_inside(controller: ProvedController, asked: Asked) -> ProvedController:
    """Return a controller whose sampled loop settles from the starts of the run, its ensemble, or within sizes.

    The same where it does, or where no K is found with which it does. Only a K that was sought for a rate, or for
    nothing, is replaced, by a smaller one; with `within: region` by any that has more of the starts.
    """
    goal, share = asked.words.goals.get(CONTROLLER), _share(controller)
    if share is None or share >= 1 or not isinstance(goal, AtLeast) or asked.sampled is None or asked.room is None:
        return controller
    within, first = asked.room.around(controller.sizes.state), controller.claim(SampledLoop).gains
    much = sum(work(one.errors) * (1 + len(one.acts.squares)) for one in controller.claims_of(SampledBounds))
    if within is None or first.delay or much > _MOST:
        return controller
    best, whatever = controller, goal.within == "region"
    for gains in _sought(controller, within, asked.sampled):
        if not whatever and controller.sizes.norm(gains.K) > controller.sizes.norm(first.K):
            continue
        tried = again(controller, replace(asked, sampled=gains), _STARTS)
        more = _share(tried)
        if more is not None and (more >= 1 or (whatever and more > share)):
            best, share = tried, more
        if share >= 1:
            break
    return best if best is controller else again(best, asked, _OTHERS)


def _sought(controller: ProvedController, within: InputConstraint, made: SampledGains) -> Iterator[SampledGains]:
    """Yield gains made for starts with x̂ = x: within sizes, then those of the run or of its ensemble."""
    plant, sizes = controller.plant, controller.sizes
    candidates = Candidates(Task.of(plant, CONTROLLER, sizes=sizes))
    for starts, over in product(reversed(within.starts), _OVER):
        found = candidates.farthest_held(replace(within, starts=[starts], over=over), made.sample_time)
        if found is not None and np.isfinite(found.K).all():
            yield replace(made, K=found.K)


def _share(controller: ProvedController) -> float | None:
    """Return how much of the starts is proved: of the run or its ensemble where these are told; None without limits."""
    for region in controller.claims_of(SampledRegion):
        left, kinds = region.left, {one.kind for one in region.room.starts}
        if left is None:
            return None
        if region.from_this_start(controller) or any(one.starts.kind == "every" for one in region.found):
            return 1.0
        wanted = next((kind for kind in ("ensemble", "run") if kind in kinds), "exact")
        scales = [one.scale(left) for one in region.found if one.starts.kind == wanted]
        return max(scales, default=0.0)
    return None
