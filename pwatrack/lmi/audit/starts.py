"""From which starts inputs stay near their feedforward: ellipsoids around them that the errors do not leave."""

from fractions import Fraction
from typing import Any

from .balls import Ball, falls
from .bounds import SIGNALS, Loop
from .matrices import AuditFault, added, definite, product, transposed
from .reading import distinct, matrix, number, packed
from .shape import NUMBER, PACKED, ROWS, TEXT, of

KEY = "limits"
SHAPE = [of(TEXT, "of loop") | {"starts": ROWS, "weights": [NUMBER], "Q": PACKED, "signals": SIGNALS}]


def decided(found: Any, loop: Loop, _: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the bounds of inputs from all boxes of starts, and what they claim."""
    faults = [f"starts {k}: {fault}" for k, entry in enumerate(found, 1) for fault in near(loop, entry)]
    return faults, [f"the bounds of inputs from {len(found)} boxes of starts are proved"] if found else []


def near(loop: Loop, entry: Any) -> list[str]:
    """Return what is wrong with the bounds of inputs from one box of starts, z(0) = G v, |v_k| <= 1."""
    name, (Q, powers), G = entry["loop"], packed(entry["Q"]), matrix(entry["starts"])
    wanted = "drive" if name == "joint" and loop.plant.loads is not None else "input"
    square = len(loop.plant.tracked[0]) == len(loop.plant.B[0][0])
    if wanted == "drive" and loop.X is not None and (not square or any(map(any, (*loop.X[0], *loop.X[1])))):
        raise AuditFault("loads do not only act at inputs, one for each tracked output")
    weights = [number(w) for w in entry["weights"]]
    if min(weights) <= 0 or sum(weights) > 1 or any(len(row) != len(weights) for row in G) or len(G) != len(Q):
        raise AuditFault("the weights of the starts are not positive, or more than 1 together")
    widened = [[v / w for v, w in zip(row, weights, strict=True)] for row in G]
    around = product(widened, transposed(G))
    faults = [] if definite(Q) and definite(added(Q, around, -1)) else ["a start is not in the ellipsoid"]
    faults += ["an ellipsoid can be left" for M in loop.matrices(name) if not falls(M, Q, powers, None)]
    distinct([signal[:2] for signal in entry["signals"]], "a signal")
    for kind, k, size in entry["signals"]:
        if kind != wanted:
            raise AuditFault(f"limits of inputs are said of '{wanted}' here")
        c = loop.row(name, kind, k)
        value, radius = c @ Ball(Q) @ c.T
        largest: Fraction = value[0][0] + (radius[0][0] if radius else 0)
        if number(size) < 0 or largest > number(size) ** 2:
            faults.append(f"{kind} {k} is not bounded by {size}")
    return faults if entry["signals"] else [*faults, "it bounds nothing"]
