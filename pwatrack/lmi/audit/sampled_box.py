"""The loop that is sampled, for every plant of a box: forms that fall at a rate, and tubes of what is left."""

from typing import Any

from .bounds import Loop
from .clocked import growing, predicted, rate_said
from .corners import UncertainLoop
from .matrices import AuditFault
from .reading import amount, number
from .shape import NUMBER, PACKED, ROWS, of
from .ticks import AuditedErrors
from .tubes import TUBES, Tubes, left

SHAPE = {
    "sampled_uncertain": (None, of(NUMBER, "rate") | {"P": [PACKED], "T": ROWS}),
    "sampled_uncertain_bounds": TUBES,
}


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the proofs of the sampled loop for plants between some corners, and what they claim."""
    content, found = whole["sampled_uncertain"], whole["sampled_uncertain_bounds"]
    if found and (content is None or whole["practical"] is not None):
        raise AuditFault("there are bounds for uncertain parameters and sampling, and no proof, or cells are merged")
    if whole["sampled"] is None or whole["uncertain"] is None:
        raise AuditFault("there is a proof for uncertain parameters and sampling, and none for one of these")
    rate = number(content["rate"])
    if rate <= 0:
        raise AuditFault("the rate of the sampled loop for uncertain parameters is out of range")
    box = UncertainLoop(whole["plant"], whole["uncertain"]["corners"], loop.K, loop.L)
    errors = AuditedErrors(whole["sampled"], loop, predicted(whole), box.corners)
    wrong, flows = growing(errors, content, errors.ticks, rate), errors.opened(len(content["T"][0]))
    rated = rate_said(content, whole["sampled"]["jitter"])
    said = f"the sampled loop for uncertain parameters: {rated}, {amount(len(flows), 'flow')} proved"
    faults, more = [f"the sampled loop for uncertain parameters: {fault}" for fault in wrong], [said]
    if found:
        outside, claimed = left(found, Tubes(errors, []), " for uncertain parameters")
        faults, more = faults + outside, more + claimed
    return faults, more
