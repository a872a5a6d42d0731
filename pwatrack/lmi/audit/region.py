"""From which starts errors go to 0 although inputs are cut off at limits: regions in which forms fall."""

from functools import reduce
from itertools import compress
from itertools import product as choices
from typing import Any

from .balls import Ball, falls, outermost, stacked, zero
from .bounds import Loop
from .matrices import AuditFault, Matrix, definite, product
from .polynomials import coefficients, exponents, polynomial, substituted
from .reading import amount, distinct, matrix, number, packed
from .shape import PROOFS, ROWS
from .starts import STARTS, around, bounded, held, kind_of, loop_of, starts_of

BY_ELLIPSOID = STARTS | {"H": ROWS}
BY_POLYNOMIAL = {key: shape for key, shape in BY_ELLIPSOID.items() if key != "Q"} | {"V": PROOFS["polynomial"]}
SHAPE = {"regions": [(BY_ELLIPSOID, BY_POLYNOMIAL)]}


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the regions with limits active, and what they claim."""
    found = whole["regions"]
    distinct([[entry["of"]] for entry in found], "a region")
    faults = [f"region {k}: {fault}" for k, entry in enumerate(found, 1) for fault in wrong(loop, entry)]
    every = any(entry["of"] == "every" for entry in found)
    starts = "every start" if every else amount(len(found), "box of starts", "boxes of starts")
    said = f"errors go to 0 from {starts}, with inputs at their limits too"
    return faults, [f"{said}, as long as what that takes is left of these"]


def wrong(loop: Loop, entry: Any) -> list[str]:
    """Return what is wrong with one region."""
    name, H = loop_of(entry), matrix(entry["H"])
    wanted, matrices = kind_of(loop, name), loop.matrices(name)
    inputs = [k for _, k, _ in entry["signals"]]
    if not inputs:
        raise AuditFault("a region of no input")
    if len(H) != len(inputs) or any(len(row) != len(matrices[0][0]) for row in H):
        raise AuditFault("the rows of a region do not fit")
    matrices = outermost(matrices) if "V" in entry else matrices
    limited = vertices(loop, name, wanted, matrices, inputs, H)
    if "V" in entry:
        return by_polynomial(entry, wanted, limited, H)
    Q, powers = packed(entry["Q"])
    if len(Q) != len(H[0]):
        raise AuditFault("the form of a region does not fit")
    faults = bounded(entry, (wanted,), [Ball([row]) for row in H], Q)
    if entry["of"] == "every":
        if entry["weights"] or any(map(any, H)) or name != "controller":
            raise AuditFault("a region of every start has no starts, and no rows")
        faults += [] if definite(Q) else ["its form is not positive definite"]
    else:
        faults += around(entry, Q)
    return faults + [LEFT for X in limited if not falls(X, Q, powers)]


LEFT = "errors can leave it, or do not go to 0"


def vertices(loop: Loop, name: str, wanted: str, matrices: list[Ball], inputs: list[int], H: Matrix) -> list[Ball]:
    """Return the matrices of the loop with rows H in place of what inputs are made of, for all sets of inputs."""
    B = stacked(loop.plant.B, zero(len(H[0]) - len(loop.plant.B.centre), len(loop.K)))
    pairs = zip(inputs, H, strict=True)
    changes = [B.column(k) @ (Ball([row]) - loop.row(name, wanted, k)) for k, row in pairs]
    sets = choices((False, True), repeat=len(inputs))
    return [reduce(Ball.__add__, compress(changes, chosen), M) for chosen in sets for M in matrices]


def by_polynomial(entry: Any, wanted: str, limited: list[Ball], H: Matrix) -> list[str]:
    """Return what is wrong with a region {V <= 1}, V = m^T P m, m the monomials of degree d of z = T e."""
    proof = entry["V"]
    if entry["of"] == "every" or proof["of"] != "controller":
        raise AuditFault("a polynomial holds a region of some starts, of the loop as it is")
    faults = [f"{LEFT}: {fault}" for fault in polynomial(limited, [], proof, None)]
    P, T = packed(proof["P"])[0], matrix(proof["T"])
    d = int(number(proof["degree"]) / 2)
    monomials, back = exponents(len(T), d), Ball(T).inverse().centre
    G, weights = starts_of(entry, len(T), d)
    S = substituted(product(T, G), monomials, exponents(len(G[0]), d))
    faults += held(P, S, weights)
    distinct([signal[:2] for signal in entry["signals"]], "a signal")
    if any(kind != wanted for kind, *_ in entry["signals"]):
        raise AuditFault(f"limits are said of '{wanted}' here")
    for (kind, k, size), row in zip(entry["signals"], H, strict=True):
        h, most = coefficients(product([row], back)[0], monomials), number(size) ** (2 * d)
        larger = [[most * P[i][j] - a * b for j, b in enumerate(h)] for i, a in enumerate(h)]
        if number(size) < 0 or (any(row) and not definite(larger)):
            faults.append(f"{kind} {k} is not bounded by {size}")
    return faults
