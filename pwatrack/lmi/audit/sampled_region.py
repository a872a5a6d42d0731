"""From which starts the errors of a sampled loop go to 0 although inputs are cut off at limits: forms that fall."""

from fractions import Fraction
from functools import reduce
from itertools import chain
from itertools import product as choices
from typing import Any

from .balls import Ball, stacked, unit, zero
from .bounds import SIGNALS, Loop
from .clocked import growing, predicted
from .matrices import AuditFault, added, definite, identity
from .reading import amount, distinct, matrix, number, packed, place
from .shape import NUMBER, PACKED, ROWS, TEXT, of
from .starts import held, kind_of, starts_of
from .ticks import AuditedErrors

REGION = of(TEXT, "of loop") | of(ROWS, "starts H T") | {"weights": [NUMBER], "P": [PACKED], "signals": SIGNALS}
SHAPE = {"sampled_regions": [REGION]}


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the regions of the sampled loop with limits active, and what they claim."""
    found = whole["sampled_regions"]
    if whole["sampled"] is None:
        raise AuditFault("there are regions of a sampled loop, and none is proved")
    distinct([[entry["of"]] for entry in found], "a region of the sampled loop")
    errors = AuditedErrors(whole["sampled"], loop, predicted(whole))
    if errors.estimates is not None:
        raise AuditFault("regions are not said of loads that do not only act at inputs")
    kind_of(loop, "joint")
    each = (wrong(errors, entry) for entry in found)
    faults = [f"sampled region {k}: {fault}" for k, some in enumerate(each, 1) for fault in some]
    every = any(entry["of"] == "every" for entry in found)
    starts = "every start" if every else amount(len(found), "box of starts", "boxes of starts")
    said = f"errors of the sampled loop, less what all that acts makes of them, go to 0 from {starts}, with inputs at"
    return faults, [f"{said} their limits too, as long as what that takes is left of these"]


def wrong(errors: AuditedErrors, entry: Any) -> list[str]:
    """Return what is wrong with one region."""
    H, P = matrix(entry["H"]), packed(entry["P"][-1])[0]
    inputs = [place(k, errors.m) for _, k, _ in entry["signals"]]
    distinct([signal[:2] for signal in entry["signals"]], "a signal")
    changing = [kind == "change" for kind, *_ in entry["signals"]]
    kinds = {kind for kind, *_ in entry["signals"]} - {"change"}
    if not inputs or len(kinds) > 1 or not kinds <= {"input", "drive"}:
        raise AuditFault("a region of the sampled loop is not of inputs")
    if len(H) != len(inputs) or any(len(row) != errors.order for row in H) or len(P) != errors.order:
        raise AuditFault("the rows of a region of the sampled loop do not fit")
    faults = list[str]()
    if entry["of"] == "every":
        if entry["weights"] or any(map(any, H)) or any(changing):
            raise AuditFault("a region of every start has no starts, and no rows")
    else:
        faults += around(errors, entry, P)
    for (kind, k, size), row in zip(entry["signals"], H, strict=True):
        most = number(size)
        if any(row) and not (most > 0 and definite(added(P, [[a * b / most**2 for b in row] for a in row], -1))):
            faults.append(f"{kind} {k} is not bounded by {size}")
    return faults + growing(errors, entry, ticks(errors, inputs, changing, H), Fraction(0))


def around(errors: AuditedErrors, entry: Any, P: Any) -> list[str]:
    """Return what is wrong with starts that are to be inside, z before a tick with nu = 0 and rho = 0."""
    (G, weights), n, m, N = starts_of(entry, errors.order, 1), errors.n, errors.m, errors.N
    if any(map(any, G[n : n + m])) or any(map(any, G[n + m + errors.predicted * N :])):
        raise AuditFault("a start of the sampled loop has an input that is held, or what a substep moves")
    return held(P, G, weights)


def ticks(errors: AuditedErrors, inputs: list[int], changing: list[bool], H: Any) -> list[Ball]:
    """Return what a tick makes of z with a row of H in place of what an input is made of, or none, for each input.

    A row of a change is added to what the input was before.
    """
    (J,), n, m = errors.ticks, errors.n, errors.m
    eye = Ball(identity(errors.order, 1))
    changes: dict[int, list[list[Ball]]] = {k: [[]] for k in inputs}
    for k, is_change, row in zip(inputs, changing, H, strict=True):
        made, before = J.row(n + k), eye.row(n + k)
        for load in range(len(errors.at)):
            if errors.at[load] == k and not errors.late:  # else it is in nu
                made, before = made - J.row(n + m + n + load), before - eye.row(n + m + n + load)
        rest = Ball([row]) + before - made if is_change else Ball([row]) - made
        changes[k].append([moved(errors, k) @ rest])
    return [reduce(Ball.__add__, chain(*chosen), J) for chosen in choices(*changes.values())]


def moved(errors: AuditedErrors, k: int) -> Ball:
    """Return what z is moved by for what limits cut off an input: its prediction by E, and nu so that that is put out.

    What is put out is nu, without delay less U (s_hat - s).
    """
    n, m, N, E, nu = errors.n, errors.m, errors.N, errors.E.column(k), unit(errors.m, k)
    if errors.at and not errors.late:
        nu = nu + errors.U @ E.rows(n, N)
    return stacked(zero(n, 1), nu, E, zero(errors.order - n - m - N, 1))
