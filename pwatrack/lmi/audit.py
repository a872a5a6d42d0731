"""Check a pwatrack certificate from the bytes of its file, with whole numbers only.

This file runs alone, on Python's standard library: python audit.py certificate.json

Every number is read as the decimal it is. With P_jk = integers_jk * 2**(exponents_j + exponents_k)
it is checked, by fraction-free elimination in whole numbers, that for every i

    P > 0   and   -(M_i P + P M_i^T) - 2 rate P - margin I > 0   (positive definite).

So every x' = A(t) x with A(t) in the convex hull of the M_i, or of their transposes,
decays at least as fast as exp(-rate t).
"""

import json
import sys
from fractions import Fraction
from math import lcm
from typing import Any

FORMAT = "pwatrack certificate 1"
Matrix = list[list[Fraction]]


def audit(text: str) -> list[str]:
    """Return what is wrong with a certificate, in sentences; nothing if it proves what it says."""
    try:
        content = json.loads(text, parse_float=Fraction, parse_int=Fraction, parse_constant=_no_number)
        if content["format"] != FORMAT:
            return [f"the format is not '{FORMAT}'"]
        faults = []
        for proof in content["proofs"]:
            matrices = closed_loops(content, proof["of"])
            faults += [f"{proof['of']}: {fault}" for fault in check(matrices, proof)]
        return faults if content["proofs"] else ["there is no proof in it"]
    except (KeyError, TypeError, ValueError, IndexError, ZeroDivisionError) as error:
        return [f"not a certificate: {type(error).__name__}: {error}"]


def closed_loops(content: Any, of: str) -> list[Matrix]:
    """Return the matrices M_i that a proof speaks of."""
    if of == "generator":
        return [transposed(A) for A in content["A_eta"]]
    if of == "controller":
        BK = product(content["B"], content["K"])
        return [added(A, BK) for A in content["A"]]
    if of == "observer":
        LC = product(content["L"], content["C"])
        return [transposed(added(A, LC)) for A in content["A"]]
    raise ValueError(f"unknown proof '{of}'")


def check(matrices: list[Matrix], proof: Any) -> list[str]:
    """Return what is wrong with one proof."""
    rate, margin, radius = (Fraction(proof[name]) for name in ("rate", "margin", "radius"))
    powers = [int(e) for e in proof["P"]["exponents"]]
    P = [
        [Fraction(v) * Fraction(2) ** (powers[j] + powers[k]) for k, v in enumerate(row)]
        for j, row in enumerate(proof["P"]["integers"])
    ]
    n = len(powers)
    if transposed(P) != P or len(P) != n or not matrices or any(len(M) != n for M in matrices):
        return ["P is not symmetric of the order of the matrices"]
    faults = [] if rate > 0 and margin > 0 and radius >= 0 else ["rate, margin and radius must be positive"]
    if not positive_definite(P):
        faults.append("P is not positive definite")
    for i, M in enumerate(matrices):
        MP = product(M, P)
        S = [
            [-MP[j][k] - MP[k][j] - 2 * rate * P[j][k] - (margin if j == k else 0) for k in range(n)] for j in range(n)
        ]
        if not positive_definite(S):
            faults.append(f"the inequality fails in cell {i + 1}")
    if 4 * radius**2 * sum(v * v for row in P for v in row) > margin**2:
        faults.append("the radius is larger than margin / (2 |P|)")
    return faults


def positive_definite(X: Matrix) -> bool:
    """Decide whether a symmetric rational matrix is positive definite, by Bareiss' elimination in integers."""
    scale = lcm(*(v.denominator for row in X for v in row))
    rows = [[int(v * scale) for v in row] for row in X]
    previous = 1
    for k, pivot_row in enumerate(rows):
        if (pivot := pivot_row[k]) <= 0:
            return False
        for row in rows[k + 1 :]:
            factor = row[k]
            row[k + 1 :] = [
                (v * pivot - factor * p) // previous for v, p in zip(row[k + 1 :], pivot_row[k + 1 :], strict=True)
            ]
        previous = pivot
    return True


def product(X: Matrix, Y: Matrix) -> Matrix:
    """Return X Y."""
    columns = transposed(Y)
    return [[sum((a * b for a, b in zip(row, c, strict=True) if a and b), Fraction(0)) for c in columns] for row in X]


def added(X: Matrix, Y: Matrix) -> Matrix:
    """Return X + Y."""
    return [[a + b for a, b in zip(one, two, strict=True)] for one, two in zip(X, Y, strict=True)]


def transposed(X: Matrix) -> Matrix:
    """Return the transpose."""
    return [list(column) for column in zip(*X, strict=True)]


def _no_number(name: str) -> Fraction:
    raise ValueError(f"'{name}' is no number")


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as file:  # noqa: PTH123
        found = audit(file.read())
    print("\n".join(found) or "proved")  # noqa: T201
    sys.exit(6 if found else 0)
