"""From which starts signals stay near what they are to be: ellipsoids around them that the errors do not leave."""

from collections.abc import Sequence
from fractions import Fraction
from math import comb
from typing import Any

from .balls import Ball, beyond, falls
from .bounds import SIGNALS, Loop
from .matrices import AuditFault, Matrix, added, definite, product, transposed
from .reading import amount, distinct, matrix, number, packed
from .shape import NUMBER, PACKED, ROWS, TEXT, of

OF_STATE = ("output", "state", "measured")  # signals of x - x_d alone
STARTS = of(TEXT, "of loop") | {"starts": ROWS, "weights": [NUMBER], "Q": PACKED, "signals": SIGNALS}
SHAPE = {"limits": [STARTS]}


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the bounds of signals from all boxes of starts, and what they claim."""
    found = whole["limits"]
    faults = [f"starts {k}: {fault}" for k, entry in enumerate(found, 1) for fault in near(loop, entry)]
    starts = amount(len(found), "box of starts", "boxes of starts")
    return faults, [f"the bounds of signals with limits from {starts} are proved"]


def near(loop: Loop, entry: Any) -> list[str]:
    """Return what is wrong with the bounds of signals from one box of starts, z(0) = G v, |v_k| <= 1."""
    name, (Q, powers) = loop_of(entry), packed(entry["Q"])
    of_state = bool(entry["signals"]) and all(kind in OF_STATE for kind, *_ in entry["signals"])
    wanted = OF_STATE if of_state else (kind_of(loop, name),)
    faults = around(entry, Q)
    faults += ["an ellipsoid can be left" for M in loop.matrices(name) if not falls(M, Q, powers)]
    rows = [loop.row(name, kind, k) for kind, k, _ in entry["signals"] if kind in wanted]
    faults += bounded(entry, wanted, rows, Q)
    return faults if entry["signals"] else [*faults, "it bounds nothing"]


def loop_of(entry: Any) -> str:
    """Return the loop of an entry, which is of e, or of (e, Delta): the observer's alone tells no signal."""
    if entry["loop"] not in ("joint", "controller"):
        raise AuditFault(f"limits are not said of the loop '{entry['loop']}'")
    return str(entry["loop"])


def kind_of(loop: Loop, name: str) -> str:
    """Return what limits of inputs are said of: with loads that are constants at inputs of what drives the plant."""
    wanted = "drive" if name == "joint" and loop.plant.loads is not None else "input"
    square = len(loop.plant.tracked[0]) == len(loop.plant.B[0][0])
    if wanted == "drive" and loop.X is not None and (not square or any(map(any, (*loop.X[0], *loop.X[1])))):
        raise AuditFault("loads do not only act at inputs, one for each tracked output")
    return wanted


def around(entry: Any, Q: Matrix) -> list[str]:
    """Return what is wrong with an ellipsoid that is to be around a box of starts."""
    G, weights = starts_of(entry, len(Q), 1)
    widened = [[v / w for v, w in zip(row, weights, strict=True)] for row in G]
    inside = definite(Q) and definite(added(Q, product(widened, transposed(G)), -1))
    return [] if inside else ["a start is not in the ellipsoid"]


def starts_of(entry: Any, order: int, d: int) -> tuple[Matrix, list[Fraction]]:
    """Return G of starts, and positive weights of sum 1 at most, one for each monomial of degree d of its columns."""
    G, weights = matrix(entry["starts"]), [number(w) for w in entry["weights"]]
    fits = weights and min(weights) > 0 and sum(weights) <= 1 and len(G) == order and len({*map(len, G)}) == 1
    if not fits or comb(len(G[0]) + d - 1, d) != len(weights):
        raise AuditFault("the weights of the starts are not positive, or more than 1 together")
    return G, weights


def held(P: Matrix, S: Matrix, weights: list[Fraction]) -> list[str]:
    """Return what is wrong with S^T P S < diag(weights), which has all starts in a region."""
    box = [[w * (j == k) for k in range(len(weights))] for j, w in enumerate(weights)]
    inside = definite(added(box, product(transposed(S), product(P, S)), -1))
    return [] if inside else ["a start is not in the region"]


def bounded(entry: Any, wanted: Sequence[str], rows: list[Ball], Q: Matrix) -> list[str]:
    """Return which sizes of rows are too small in an ellipsoid."""
    faults = list[str]()
    distinct([signal[:2] for signal in entry["signals"]], "a signal")
    if any(kind not in wanted for kind, *_ in entry["signals"]):
        raise AuditFault(f"limits are said of '{wanted[0]}' here")
    for (kind, k, size), c in zip(entry["signals"], rows, strict=True):
        if beyond(c, Q, number(size)):
            faults.append(f"{kind} {k} is not bounded by {size}")
    return faults
