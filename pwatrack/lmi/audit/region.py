"""From which starts errors go to 0 although inputs are cut off at limits: ellipsoids in which forms fall."""

from itertools import product as choices
from typing import Any

from .balls import Ball, falls, stacked
from .bounds import Loop
from .matrices import AuditFault, definite, identity
from .reading import distinct, matrix, packed
from .shape import ROWS
from .starts import SHAPE as STARTS
from .starts import around, bounded, kind_of, loop_of

KEY = "regions"
SHAPE = [STARTS[0] | {"H": ROWS}]


def decided(found: Any, loop: Loop, _: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the regions with limits active, and what they claim."""
    distinct([[entry["of"]] for entry in found], "a region")
    faults = [f"region {k}: {fault}" for k, entry in enumerate(found, 1) for fault in wrong(loop, entry)]
    every = any(entry["of"] == "every" for entry in found)
    said = "with inputs at their limits errors go to 0 from " + (
        "every start" if every else f"{len(found)} boxes of starts"
    )
    return faults, [said] if found else []


def wrong(loop: Loop, entry: Any) -> list[str]:
    """Return what is wrong with one region."""
    name, (Q, powers), H = loop_of(entry), packed(entry["Q"]), matrix(entry["H"])
    wanted = kind_of(loop, name)
    inputs = [k for _, k, _ in entry["signals"]]
    if not inputs:
        raise AuditFault("a region of no input")
    if len(H) != len(inputs) or any(len(row) != len(Q) for row in H):
        raise AuditFault("the rows of a region do not fit")
    faults = bounded(entry, (wanted,), [Ball([row]) for row in H], Q)
    if entry["of"] == "every":
        if entry["weights"] or any(map(any, H)) or name != "controller":
            raise AuditFault("a region of every start has no starts, and no rows")
        faults += [] if definite(Q) else ["its form is not positive definite"]
    else:
        faults += around(entry, Q)
    nothing = identity(1, 0)[0] * len(inputs)
    for M in loop.matrices(name):
        for chosen in choices((0, 1), repeat=len(inputs)):
            X = M
            for k, row, is_chosen in zip(inputs, H, chosen, strict=True):
                if is_chosen:
                    enters = loop.plant.B.column(k)
                    zero = [nothing[:1]] * (len(Q) - len(enters.centre))
                    X += (stacked(enters, Ball(zero)) if zero else enters) @ (Ball([row]) - loop.row(name, wanted, k))
            if not falls(X, Q, powers, None):
                faults.append("errors can leave it, or do not go to 0")
    return faults
