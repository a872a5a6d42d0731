"""The loop that is sampled: forms that depend on the time since a tick fall, for any switching, decided at knots."""

from fractions import Fraction
from itertools import pairwise
from typing import Any

from .balls import Ball, enlarge, falls, sizes
from .bounds import Loop
from .boxes import squares
from .matrices import AuditFault, Matrix, added, definite, product, times, transposed
from .plant import AuditedPlant
from .reading import amount, matrix, number, packed
from .shape import NUMBER, PACKED, ROWS, WHOLE, of
from .ticks import AuditedErrors

SAMPLED = (
    of(ROWS, "K M E rows")
    | of(NUMBER, "sample_time jitter rate")
    | of(WHOLE, "substeps delay")
    | {"P": [PACKED], "T": ROWS}
)
SHAPE = {"sampled": (None, SAMPLED)}
Knot = tuple[Matrix, list[Fraction], list[Fraction]]  # a form, about the roots of its diagonal, the diagonal of T


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the proof of the sampled loop, and what it claims."""
    content = whole["sampled"]
    h, rate = number(content["sample_time"]), number(content["rate"])
    if h <= 0 or rate <= 0 or content["substeps"] < 1 or not 0 <= number(content["jitter"]) < h:
        raise AuditFault("a time, the rate or the number of substeps of the sampled loop is out of range")
    errors = AuditedErrors(content, loop, predicted(whole))
    faults, flows = growing(errors, content, errors.ticks, rate), errors.opened(len(content["T"][0]))
    every = f"every {content['sample_time']} s"
    if errors.late:
        every += f", inputs {amount(content['delay'], 'sample')} late"
    said = f"the sampled loop: {every}, {rate_said(content, content['jitter'])}, {amount(len(flows), 'flow')}"
    return [f"the sampled loop: {fault}" for fault in faults], [f"{said} proved at {len(content['P'])} knots"]


def rate_said(content: Any, jitter: Any) -> str:
    """Return a rate in words: with jitter it is as the program counts time, which may pass faster."""
    return f"rate {content['rate']} 1/s" + f" as its ticks count, give or take {jitter} s each" * (number(jitter) > 0)


def runs_of(errors: AuditedErrors, P: Any, T: Any, fault: str) -> list[list[Knot]]:
    """Return what stands at the knots of each substep."""
    forms, diagonals = [packed(P_k) for P_k in P], matrix(T)
    knots, rest = divmod(len(forms), errors.parts)
    if rest or knots < 2 or any(len(form) != errors.order for form, _ in forms) or len(diagonals) != len(forms):
        raise AuditFault(fault)
    counts = {0, len(errors.flows[0].edges)}
    if len({len(row) for row in diagonals}) != 1 or len(diagonals[0]) not in counts:
        raise AuditFault(fault)
    if not all(t > 0 for row in diagonals for t in row):
        raise AuditFault("the diagonals of the sampled loop are not positive")
    each = [(*form, row) for form, row in zip(forms, diagonals, strict=True)]
    return [each[j : j + knots] for j in range(0, len(each), knots)]


def growing(errors: AuditedErrors, content: Any, ticks: list[Ball], rate: Fraction) -> list[str]:
    """Return what is wrong with forms at knots that are to fall at a rate between ticks, and to shrink at these."""
    runs = runs_of(errors, content["P"], content["T"], "the forms of the sampled loop are not those of its knots")
    sound = all(definite(form) for run in runs for form, *_ in run)
    faults = [] if sound else ["a form is not positive definite"]
    jumps = (shrinks(tick, runs[0][0][:2], runs[-1][-1][:2]) for tick in ticks)
    faults += [] if all(jumps) else ["a tick makes its form grow"]
    ends = (shrinks(errors.substep, after[0][:2], before[-1][:2]) for before, after in pairwise(runs))
    faults += [] if all(ends) else ["the end of a substep makes its form grow"]
    for run in runs:
        for one, other in pairwise(run):
            rise = times(added(other[0], one[0], -1), (len(run) - 1) * errors.parts / errors.period)
            if not all(falling(errors, knot, rise, rate) for knot in (one, other)):
                faults.append("its form does not fall fast enough between ticks")
    return faults


def falling(errors: AuditedErrors, knot: Knot, rise: Matrix, rate: Fraction) -> bool:
    """Decide that a form that rises by so much falls in all boxes."""
    P, powers, T = knot
    for box in errors.opened(len(T)):
        U, V = box.factors
        more = squares(product(P, U), V, T) if T else []
        if not falls(box.middle.T, P, powers, added(rise, more) if more else rise, rate=rate):
            return False
    return True


def predicted(whole: Any) -> AuditedPlant | None:
    """Return the plant that a program predicts, where it is not that of the design, whose cells are merged."""
    split = whole["practical"]
    return None if split is None or split["observer_runs"] == "merged cells" else AuditedPlant(split["plant"])


def shrinks(jump: Ball, after: tuple[Matrix, list[Fraction]], before: tuple[Matrix, list[Fraction]]) -> bool:
    """Decide J^T P_after J < P_before for all J in a ball.

    With J + E, |E| <= R, it is more by E^T P J + J^T P E + E^T P E, in size at most R^T (|P J| + |P| R / 2) and that
    transposed.
    """
    (P, _), (Q, powers) = after, before
    J, R = jump
    lower = product(P, J)
    left = added(product(transposed(J), lower), Q, -1)
    if R:
        half = times(product(sizes(P), R), Fraction(1, 2))
        enlarge(left, product(transposed(R), added(sizes(lower), half)), powers)
    return definite(left, sign=-1)
