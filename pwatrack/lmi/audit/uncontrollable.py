"""A mean of cells with a mode that no gain moves and that does not decay."""

from fractions import Fraction
from typing import Any

from .balls import Ball
from .matrices import AuditFault, Matrix, added, identity, product, rank, transposed
from .reading import matrix, number


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
