"""What is left of the errors of a loop that is sampled, for every plant of a box: tubes."""

from typing import Any

from .bounds import Loop
from .clocked import predicted
from .corners import UncertainLoop
from .matrices import AuditFault
from .ticks import AuditedErrors
from .tubes import SHAPE as TUBES
from .tubes import Tubes, left

KEY = "sampled_uncertain_bounds"
SHAPE = TUBES


def decided(found: Any, loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the tubes, and what they claim."""
    if not found:
        return [], []
    if whole["sampled_uncertain"] is None or whole["practical"] is not None:
        raise AuditFault("there are bounds for uncertain parameters and sampling, and no proof, or cells are merged")
    box = UncertainLoop(whole["plant"], whole["uncertain"]["corners"], loop.K, loop.L)
    errors = AuditedErrors(whole["sampled"], loop, predicted(whole), box.corners)
    return left(found, Tubes(errors, whole["sampled"], []), " for uncertain parameters")
