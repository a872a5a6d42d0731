"""The matrix inequalities: of a design, of a cost, and multipliers that no gain can stand against."""

from fractions import Fraction
from typing import Any

from .balls import Ball, falls, unlike
from .matrices import AuditFault, Matrix, added, definite, identity, positive, product, transposed
from .reading import number, packed, symmetric


def check(matrices: list[Ball], _: Matrix, proof: Any, __: Any) -> list[str]:
    """Return what is wrong with one proof of a design."""
    rate, margin, radius = (number(proof[name]) for name in ("rate", "margin", "radius"))
    P, powers = packed(proof["P"])
    if not P or not definite(P) or not matrices or any(len(M) != len(P) for M, _ in matrices):
        return ["P is not symmetric and positive definite, of the order of the matrices"]
    faults = [] if rate > 0 and margin > 0 and radius >= 0 else ["rate, margin and radius must be positive"]
    faults += failing(matrices, P, powers, rate, margin)
    if 4 * radius**2 * sum(v * v for row in P for v in row) > margin**2:
        faults.append("the radius is larger than margin / (2 |P|)")
    return faults


def both_ways(matrices: list[Ball], _: Matrix, proof: Any, __: Any) -> list[str]:
    """Return what is wrong with one proof that there is one bounded solution: the same with a P of any sign."""
    margin, (P, powers) = number(proof["margin"]), packed(proof["P"])
    if proof["of"] != "generator" or proof["bounded"] != "both ways":
        return ["only a generator is played back, bounded both ways"]
    if not P or not matrices or any(len(M) != len(P) for M, _ in matrices):
        return ["P is not of the order of the matrices"]
    faults = [] if margin > 0 else ["the margin must be positive"]
    return faults + failing(matrices, P, powers, Fraction(0), margin)


def no_P_by_modes(matrices: list[Ball], _: Matrix, proof: Any, __: Any) -> list[str]:
    """Return what is wrong with one proof that the same has no P of any sign, by numbers of unstable modes."""
    faults, counts = no_P(proof), set[int]()
    for i, content in proof["P"].items():
        P, M = packed(content)[0], matrices[int(i)][0]
        if len(P) != len(M) or not falls(Ball(M), P, [], None):
            faults.append(f"the inequality fails for M_{int(i) + 1}")
        counts.add(positive(P))
    return faults if len(counts) > 1 else [*faults, "these cells have as many unstable modes"]


def no_P_by_Z(matrices: list[Ball], _: Matrix, proof: Any, __: Any) -> list[str]:
    """Return what is wrong with one proof of that by multipliers."""
    Z, faults = multipliers(proof, len(matrices[0][0])), no_P(proof)
    S = identity(len(matrices[0][0]), 0)
    for i, Z_i in Z.items():
        half = product(Z_i, matrices[i][0])
        S = added(S, added(half, transposed(half)))
    right = all(definite(Z_i, semi=True) for Z_i in Z.values()) and any(any(map(any, Z_i)) for Z_i in Z.values())
    faults += [] if right else ["the Z are not positive semidefinite, or all 0"]
    return [*faults, "the sum of Z M + M^T Z is not 0"] if any(map(any, S)) else faults


def no_P(proof: Any) -> list[str]:
    """Return whether a proof speaks of a P of any sign of what has one."""
    right = proof["of"] == "generator" and proof["no_P"] == "of any sign"
    return [] if right else ["only a generator may have a P of any sign"]


def multipliers(proof: Any, n: int) -> dict[int, Matrix]:
    """Return the Z of a proof by cell: symmetric, of order n."""
    Z = {int(i): symmetric(Z_i, "Z") for i, Z_i in proof["Z"].items()}
    if any(len(Z_i) != n for Z_i in Z.values()):
        raise AuditFault("Z is not of the order of the matrices")
    return Z


def failing(matrices: list[Ball], P: Matrix, powers: list[Fraction], rate: Fraction, margin: Fraction) -> list[str]:
    """Return the cells in which -(M P + P M^T) - 2 rate P - margin I is not positive definite."""
    shift, rest = identity(len(P), rate), identity(len(P), margin)
    return [
        f"the inequality fails for M_{i + 1}"
        for i, (M, R) in unlike(matrices)
        if not falls(Ball(added(M, shift), R), P, powers, rest)
    ]


def cost(matrices: list[Ball], _: Matrix, proof: Any, K: Any) -> list[str]:
    """Return what is wrong with one bound of a cost."""
    X, Q, R = (symmetric(proof[name], name) for name in ("X", "Q", "R"))
    if not definite(X) or not definite(R) or not definite(Q, semi=True):
        return ["X, Q or R is not positive definite"]
    weight = added(Q, product(transposed(K), product(R, K)))
    powers = [
        Fraction(2) ** ((row[j].numerator.bit_length() - row[j].denominator.bit_length()) // 2)
        for j, row in enumerate(X)
    ]
    return [
        f"the bound of the cost fails for M_{i + 1}" for i, M in unlike(matrices) if not falls(M.T, X, powers, weight)
    ]


def refuted(matrices: list[Ball], B: Matrix, proof: Any, _: Any) -> list[str]:
    """Return what is wrong with one proof of impossibility."""
    n = len(matrices[0][0])
    Z = multipliers(proof, n)
    total = S = identity(n, 0)
    for i, Z_i in Z.items():
        half = product(Z_i, added(matrices[i][0], identity(n, number(proof["rate"]))))
        total, S = added(total, Z_i), added(S, added(half, transposed(half)))
    alone = len(Z) == 1 and not definite(total, semi=True, sign=-1)
    right = alone or (any(map(any, total)) and all(definite(Z_i, semi=True) for Z_i in Z.values()))
    faults = [] if right else ["the Z are not positive semidefinite, or all 0"]
    if B and any(map(any, product(total, B))):
        faults.append("the sum of Z B is not 0")
    return faults if definite(S, semi=True) else [*faults, "the sum of Z M + M^T Z is not positive semidefinite"]
