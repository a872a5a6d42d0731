"""The loop that is sampled, for every plant of a box: forms that fall at a rate."""

from typing import Any

from .bounds import Loop
from .clocked import growing, predicted
from .corners import UncertainLoop
from .matrices import AuditFault
from .reading import number
from .shape import NUMBER, PACKED, of
from .ticks import AuditedErrors

KEY = "sampled_uncertain"
SHAPE = (None, of(NUMBER, "rate") | {"P": [PACKED]})


def decided(content: Any, loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the proof of the sampled loop for plants between some corners, and what it claims."""
    if content is None:
        return [], []
    if whole["sampled"] is None or whole["uncertain"] is None:
        raise AuditFault("there is a proof for uncertain parameters and sampling, and none for one of these")
    rate = number(content["rate"])
    if rate <= 0:
        raise AuditFault("the rate of the sampled loop for uncertain parameters is out of range")
    box = UncertainLoop(whole["plant"], whole["uncertain"]["corners"], loop.K, loop.L)
    errors = AuditedErrors(whole["sampled"], loop, predicted(whole), box.corners)
    faults = growing(errors, whole["sampled"], content["P"], errors.ticks, rate)
    said = f"the sampled loop for uncertain parameters: rate {content['rate']} 1/s, {len(errors.flows)} flows proved"
    return [f"the sampled loop for uncertain parameters: {fault}" for fault in faults], [said]
