"""How far a box of uncertain parameters can be scaled about the values of the design."""

from dataclasses import dataclass, replace

from pwatrack.claims.robust import Robust
from pwatrack.control.controller import ProvedController
from pwatrack.errors import OutsideTheory, Undecided
from pwatrack.lmi.bisection import bisected
from pwatrack.lmi.solve import asking
from pwatrack.model.box import Box
from pwatrack.real import Real
from pwatrack.spec.spec import Spec
from pwatrack.workflow.pipeline import asked_of

_NEAR = 1 / 99  # of the factor: where the search ends
_DOUBLED = tuple(2.0**k for k in range(7))  # factors that are tried first
_TRIALS = 16  # together with these: ten halvings


@dataclass(frozen=True, kw_only=True)
class LargestBox:
    """The largest box that was proved."""

    factor: float  # all ends are so many times as far from the values of the design as the spec has them
    beyond: float | None  # the least factor for which no proof was found; None up to 64
    box: Box  # the box itself


def largest_box(spec: Spec, controller: ProvedController) -> LargestBox:
    """Find it by bisection, with a proof for each box that is kept; a box within one that is proved is proved too.

    The controller is a design for the spec, whether it is proved for its box or not. Raises Undecided if none was
    proved.
    """
    uncertain, refusals = spec.objectives.uncertain, [Undecided()]

    def box(factor: float) -> Box:
        return tuple(interval.scaled(Real.of(factor)) for interval in uncertain)

    def at(factor: float) -> tuple[float, None] | None:
        try:
            asked = replace(spec, objectives=replace(spec.objectives, uncertain=box(factor)))
            with spec.located(), asking(spec.objectives.solver):
                next(Robust.prove(controller, asked_of(asked, None, controller)))
        except (Undecided, OutsideTheory) as error:
            refusals.append(Undecided(*error.problems))
            return None
        return factor, None

    low, beyond = 0.0, None
    for tried, factor in enumerate(_DOUBLED, 1):
        if at(factor) is None:
            low, _, beyond = bisected(
                (low, None),
                factor,
                at,
                near=_NEAR,
                most=_TRIALS - tried,
                middle=lambda one, other: float(f"{(one + other) / 2:.4g}"),
            )
            break
        low = factor
    if not low:
        raise refusals[-1]
    return LargestBox(factor=low, beyond=beyond, box=box(low))
