"""The claims that there are, in the order in which they are proved and said. Nothing else lists them."""

from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any

from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.cost import Costs
from pwatrack.claims.decay import Decay
from pwatrack.claims.kept import KeptLimits
from pwatrack.claims.limits import NoSaturation
from pwatrack.claims.practical import Practical
from pwatrack.claims.ranges import ProgramRanges
from pwatrack.claims.region import LimitedRegion
from pwatrack.claims.robust import Robust
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_box import SampledBox, SampledBoxBounds
from pwatrack.claims.sampled_region import SampledRegion
from pwatrack.claims.set_points import SetPoints
from pwatrack.claims.stable_inversion import StableInversion
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.words import Words

CLAIMS: tuple[type[Claim], ...] = (
    Practical,
    SampledLoop,
    SampledBounds,
    ProgramRanges,
    Decay,
    Costs,
    SetPoints,
    NoSaturation,
    LimitedRegion,
    SampledRegion,
    SignalBounds,
    Robust,
    SampledBox,
    SampledBoxBounds,
    StableInversion,
    KeptLimits,
)

IMPOSSIBLE = (
    "Multipliers Z_i prove, for the numbers as they are written, that no such P exists for any gain, or for the one "
    "that is given; no P of any sign, where it says so: there either Z_i >= 0 and the sum of Z_i M_i + M_i^T Z_i is 0, "
    "or two cells have a P_i each with M_i P_i + P_i M_i^T < 0, and these have different numbers of positive "
    "eigenvalues."
)
STATEMENT = " ".join(
    [
        *(claim.statement for claim in CLAIMS if claim.statement),
        IMPOSSIBLE,
        "The file can be checked with pwatrack verify, or with the folder audit of pwatrack alone.",
    ]
)


def proved(
    controller: ProvedController, asked: Asked, kinds: Collection[type[Claim]] = CLAIMS, *, told: Told = None
) -> ProvedController:
    """Return a controller with all claims that can be made of it, or some kinds of them, beside those that it has.

    From a certificate, if there is one, without a solver. Raises PwatrackError if a claim was asked for and is not so,
    or not proved; ValueError if one that is told does not fit to the controller.
    """
    for kind in (kind for kind in CLAIMS if kind in kinds):
        controller = replace(controller, claims=(*controller.claims, *kind.prove(controller, asked, told)))
    return controller


def again(controller: ProvedController, asked: Asked, kinds: Collection[type[Claim]]) -> ProvedController:
    """Return a controller with claims of some kinds proved anew, for what is asked now, and all others as they are."""
    kept = tuple(claim for claim in controller.claims if type(claim) not in kinds)
    found = proved(replace(controller, claims=kept), asked, kinds)
    return replace(found, claims=tuple(sorted(found.claims, key=lambda claim: CLAIMS.index(type(claim)))))


def data(controller: ProvedController) -> dict[str, Any]:
    """Return what a certificate holds of the claims of a controller."""
    content = {key: value for claim in CLAIMS for key, value in claim.nothing.items()}
    for claim in controller.claims:
        for key, value in claim.data(controller).items():
            content[key] = [*content[key], *value] if content.get(key) else value
    return content


def figures(words: Words, controller: ProvedController) -> dict[str, Any]:
    """Return what run.json says of the claims of a controller."""
    return {key: value for claim in controller.claims for key, value in claim.figures(words, controller).items()}


def rows(words: Words, controller: ProvedController) -> Iterator[Row]:
    """Yield what a summary says of the claims of a controller."""
    for claim in controller.claims:
        yield from claim.rows(words, controller)


def brief(words: Words, controller: ProvedController) -> Iterator[Row]:
    """Yield what the first screen says of the claims of a controller."""
    for claim in controller.claims:
        yield from claim.brief(words, controller)
