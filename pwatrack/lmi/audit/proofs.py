"""The matrix inequalities: of a design, of a cost, and proofs that no gain can satisfy them."""

from fractions import Fraction
from functools import reduce
from typing import Any

from .balls import Ball, falls, unlike
from .matrices import AuditFault, Matrix, added, definite, identity, positive, product, rank, symmetric_part, transposed
from .reading import matrix, number, packed, symmetric


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
        if len(P) != len(M) or not falls(Ball(M), P, []):
            faults.append(f"the inequality fails for M_{int(i) + 1}")
        counts.add(positive(P))
    return faults if len(counts) > 1 else [*faults, "these cells have as many unstable modes"]


def no_P_by_Z(matrices: list[Ball], _: Matrix, proof: Any, __: Any) -> list[str]:
    """Return what is wrong with one proof of that by multipliers."""
    (Z, S), faults = multipliers(matrices, proof, Fraction(0)), no_P(proof)
    right = all(definite(Z_i, semi=True) for Z_i in Z) and any(any(map(any, Z_i)) for Z_i in Z)
    faults += [] if right else ["the Z are not positive semidefinite, or all 0"]
    return [*faults, "the sum of Z M + M^T Z is not 0"] if any(map(any, S)) else faults


def no_P(proof: Any) -> list[str]:
    """Return whether a proof speaks of a P of any sign of what has one."""
    right = proof["of"] == "generator" and proof["no_P"] == "of any sign"
    return [] if right else ["only a generator may have a P of any sign"]


def multipliers(matrices: list[Ball], proof: Any, rate: Fraction) -> tuple[list[Matrix], Matrix]:
    """Return the Z of a proof, which are symmetric, and the sum of Z (M + rate I) and its transpose."""
    n, found = len(matrices[0][0]), list[Matrix]()
    S = identity(n, 0)
    for i, content in proof["Z"].items():
        Z = symmetric(content, "Z")
        if len(Z) != n:
            raise AuditFault("Z is not of the order of the matrices")
        half = product(Z, added(matrices[int(i)][0], identity(n, rate)))
        S = added(S, symmetric_part(half))
        found.append(Z)
    return found, S


def failing(matrices: list[Ball], P: Matrix, powers: list[Fraction], rate: Fraction, margin: Fraction) -> list[str]:
    """Return the cells in which -(M P + P M^T) - 2 rate P - margin I is not positive definite."""
    rest = identity(len(P), margin)
    failed = (i for i, M in unlike(matrices) if not falls(M, P, powers, rest, rate=rate))
    return [f"the inequality fails for M_{i + 1}" for i in failed]


def cost(matrices: list[Ball], _: Matrix, proof: Any, K: Any) -> list[str]:
    """Return what is wrong with one bound of a cost."""
    X, Q, R = (symmetric(proof[name], name) for name in ("X", "Q", "R"))
    if not definite(X) or not definite(R) or not definite(Q, semi=True):
        return ["X, Q or R is not positive definite"]
    weight = added(Q, product(transposed(K), product(R, K)))
    sizes = [row[j].numerator.bit_length() - row[j].denominator.bit_length() for j, row in enumerate(X)]
    powers = [Fraction(2) ** (size // 2) for size in sizes]
    failed = (i for i, M in unlike(matrices) if not falls(M.T, X, powers, weight))
    return [f"the bound of the cost fails for M_{i + 1}" for i in failed]


def refuted(matrices: list[Ball], B: Matrix, proof: Any, _: Any) -> list[str]:
    """Return what is wrong with one proof of impossibility."""
    Z, S = multipliers(matrices, proof, number(proof["rate"]))
    total = reduce(added, Z, identity(len(S), 0))
    alone = len(Z) == 1 and not definite(total, semi=True, sign=-1)
    right = alone or (any(map(any, total)) and all(definite(Z_i, semi=True) for Z_i in Z))
    faults = [] if right else ["the Z are not positive semidefinite, or all 0"]
    if B and any(map(any, product(total, B))):
        faults.append("the sum of Z B is not 0")
    return faults if definite(S, semi=True) else [*faults, "the sum of Z M + M^T Z is not positive semidefinite"]


def between(matrices: list[Ball], B: Matrix, proof: Any, _: Any) -> list[str]:
    """Return what is wrong with a proof by a mean of cells with a mode that no gain moves and that does not decay.

    v' B = 0 and v' (sum of w_i M_i) = mu v' with v = N' z, mu >= 0, w_i >= 0 and sum w_i = 1 are impossible beside
    P > 0 and Y: v' times the sum of w_i times all left-hand sides times v is 2 mu v' P v. The root is shown to be near
    by Newton's method: F(x + d) = F(x) + J d + Q(d), and d -> d - C F(x + d) takes |d_k| <= r into itself (Brouwer).
    """
    n, N, C = len(matrices[0][0]), matrix(proof["rows"]), matrix(proof["inverse"])
    z, mu, r, rate = [number(v) for v in proof["mode"]], *(number(proof[k]) for k in ("eigenvalue", "radius", "rate"))
    w = {int(i): number(share) for i, share in proof["between"].items()}
    if not w or min(w) < 0 or not N or {len(row) for row in N} != {n} or len(z) != len(N) or 1 not in z:
        raise AuditFault("cells, rows and mode do not fit together")
    faults = [] if rank(N) == len(N) else ["the rows N are not independent"]
    if B and any(map(any, product(N, B))):
        faults.append("N B is not 0")
    if sum(w.values()) != 1 or min(w.values()) < (len(w) - 1) * r or mu < r or r < 0:
        faults.append("the weights, or the eigenvalue, may be negative, or their sum is not 1")
    *others, last = w
    A = {i: product(transposed(added(matrices[i][0], identity(n, rate))), transposed(N)) for i in w}
    changes = [added(A[i], A[last], -1) for i in others]
    M = added(A[last], transposed(N), -mu)
    for i, change in zip(others, changes, strict=True):
        M = added(M, change, w[i])
    one, column = z.index(Fraction(1)), [[v] for v in z]
    free = [list(row) for s, row in enumerate(transposed(M)) if s != one]
    moved = [[-v for (v,) in product(transposed(N), column)], *([v for (v,) in product(X, column)] for X in changes)]
    J = transposed([*free, *moved])
    if {len(row) for row in (*J, *C)} != {n} or len(C) != n:
        raise AuditFault("there are not as many equations as unknowns")
    step, off = product(C, product(M, column)), added(identity(n, 1), product(C, J), -1)
    terms = [[abs(v) for s, v in enumerate(row) if s != one] for X in (transposed(N), *changes) for row in X]
    bend = [sum((sum(row) for row in terms[j::n]), Fraction(0)) for j in range(n)]
    for j in range(n):
        share, curved = sum(map(abs, off[j])), sum(abs(c) * b for c, b in zip(C[j], bend, strict=True))
        if not share < 1 or abs(step[j][0]) + share * r + curved * r * r > r:
            return [*faults, "Newton's method does not show that there is such a mode"]
    return faults
