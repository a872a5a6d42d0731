"""Check a pwatrack certificate with whole numbers only; runs alone: python audit.py certificate.json .

Every number is read as the decimal it is. A design has P_jk = integers_jk * 2**(exponents_j + exponents_k), P > 0 and
-(M_i P + P M_i^T) - 2 rate P - margin I > 0 for every i: so every x' = A(t) x with A(t) in the convex hull of the M_i,
or of their transposes, decays at least as fast as exp(-rate t). An impossibility has Z_i with sum Z_i B = 0 and
sum Z_i (M_i + rate I) + transpose >= 0, where all Z_i >= 0 and not all are 0, or there is one alone and it is not <= 0:
so no P > 0 and Y have M_i P + P M_i^T + B Y + Y^T B^T + 2 rate P < 0 for all i.
"""

import json
import sys
from fractions import Fraction
from math import lcm
from typing import Any

FORMAT = "pwatrack certificate 2"
Matrix = list[list[Fraction]]


def audit(text: str) -> list[str]:
    """Return what is wrong with a certificate, in sentences; nothing if it proves what it says."""
    try:
        content = json.loads(text, parse_float=Fraction, parse_int=Fraction, parse_constant=Fraction)
        if content["format"] != FORMAT:
            return [f"the format is not '{FORMAT}'"]
        faults = []
        for proof in content["proofs"]:
            decide = refuted if "Z" in proof else check
            faults += [f"{proof['of']}: {fault}" for fault in decide(*problem(content, proof["of"]), proof)]
        return faults if content["proofs"] else ["there is no proof in it"]
    except (KeyError, TypeError, ValueError, IndexError, ZeroDivisionError) as error:
        return [f"not a certificate: {error}" + " is missing" * isinstance(error, KeyError)]


def problem(content: Any, of: str) -> tuple[list[Matrix], Matrix]:
    """Return the matrices M_i that a proof speaks of, and B where the gain is free (else an empty one)."""
    if of in ("generator", "plant"):
        return [transposed(A) for A in content["A_eta" if of == "generator" else "A"]], []
    dual = [transposed(A) for A in content["A"]], transposed(content["C"]), transposed(content["L"] or [])
    A, B, K = {"controller": (content["A"], content["B"], content["K"]), "observer": dual}[of]
    return ([added(M, product(B, K)) for M in A], []) if K else (A, B)


def check(matrices: list[Matrix], _: Matrix, proof: Any) -> list[str]:
    """Return what is wrong with one proof of a design."""
    rate, margin, radius = (Fraction(proof[name]) for name in ("rate", "margin", "radius"))
    powers = [Fraction(2) ** int(e) for e in proof["P"]["exponents"]]
    rows = zip(proof["P"]["integers"], powers, strict=True)
    P = [[v * a * b for v, b in zip(row, powers, strict=True)] for row, a in rows]
    if transposed(P) != P or not definite(P) or not matrices or any(len(M) != len(P) for M in matrices):
        return ["P is not symmetric and positive definite, of the order of the matrices"]
    faults = [] if rate > 0 and margin > 0 and radius >= 0 else ["rate, margin and radius must be positive"]
    for i, M in enumerate(matrices):
        half = product(added(M, identity(len(P), rate)), P)
        if not definite(added(added(half, transposed(half)), identity(len(P), margin)), sign=-1):
            faults.append(f"the inequality fails in cell {i + 1}")
    if 4 * radius**2 * sum(v * v for row in P for v in row) > margin**2:
        faults.append("the radius is larger than margin / (2 |P|)")
    return faults


def refuted(matrices: list[Matrix], B: Matrix, proof: Any) -> list[str]:
    """Return what is wrong with one proof of impossibility."""
    n, Z = len(matrices[0]), {int(i): Z_i for i, Z_i in proof["Z"].items()}
    total = S = identity(n, 0)
    for i, Z_i in Z.items():
        if len(Z_i) != n or transposed(Z_i) != Z_i or i < 0:
            return ["Z is not symmetric of the order of the matrices"]
        half = product(Z_i, added(matrices[i], identity(n, proof["rate"])))
        total, S = added(total, Z_i), added(S, added(half, transposed(half)))
    alone = len(Z) == 1 and not definite(total, semi=True, sign=-1)
    right = alone or (any(map(any, total)) and all(definite(Z_i, semi=True) for Z_i in Z.values()))
    faults = [] if right else ["the Z are not positive semidefinite, or all 0"]
    if B and any(map(any, product(total, B))):
        faults.append("the sum of Z B is not 0")
    return faults if definite(S, semi=True) else [*faults, "the sum of Z M + M^T Z is not positive semidefinite"]


def definite(X: Matrix, *, semi: bool = False, sign: int = 1) -> bool:
    """Decide whether sign X, symmetric, is positive (semi)definite, by Bareiss' elimination in integers."""
    scale = sign * lcm(*(v.denominator for row in X for v in row))
    rows, previous = [[int(v * scale) for v in row] for row in X], 1
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if pivot < 0 or (pivot == 0 and (not semi or any(pivot_row[k + 1 :]))):
            return False
        for row in rows[k + 1 :] if pivot else []:
            factor, pairs = row[k], zip(row[k + 1 :], pivot_row[k + 1 :], strict=True)
            row[k + 1 :] = [(v * pivot - factor * p) // previous for v, p in pairs]
        previous = pivot or previous
    return True


def identity(n: int, factor: Any) -> Matrix:
    """Return factor I."""
    return [[Fraction(factor) * (j == k) for k in range(n)] for j in range(n)]


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


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as file:  # noqa: PTH123
        found = audit(file.read())
    print("\n".join(found) or "proved")  # noqa: T201
    sys.exit(6 if found else 0)
