"""Multipliers in exact numbers: what they prove, and how those of floating point are rounded.

If Z_i ⪰ 0, not all 0, Σ Z_i B = 0 and Σ (Z_i A_i + A_iᵀ Z_i) ⪰ 0, then no P ≻ 0 and Y have
A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ ≺ 0 for all i: multiplied by Z_i and summed, the traces would be
both negative and not (the theorem of alternatives for (8); for given gains B is empty). Where only one Z_i
is not 0 it need not be ⪰ 0, it is enough that it is not ⪯ 0: A + BK with Z (A + BK) + (·)ᵀ ⪰ 0 is
then not Hurwitz, since for a Hurwitz matrix Lyapunov's equation would make Z ⪯ 0.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from math import lcm
from typing import Any

import numpy as np
from scipy.linalg import qr

from pwatrack.arrays import Array
from pwatrack.rational import Rational, column_space, decimals, floats, is_positive_semidefinite, rational

_BITS = 48  # of the entries of a rounded multiplier
_INDEPENDENT = 1e-10  # of the largest pivot: equations with smaller ones follow from the others


def refutes(A: Sequence[Rational], B: Rational, Z: Mapping[int, Rational], *, kernel: Rational | None = None) -> bool:
    """Check exactly that multipliers prove that there is no solution.

    Args:
        A: The matrices A_i, exact.
        B: Exact.
        Z: Multipliers by cell; 0 for the others.
        kernel: Columns that all Z_i may be 0 on, by default those of B: to be fast, whatever they are.
    """
    total, n = total_of([Z_i * A[i] for i, Z_i in Z.items()]), B.nrows()
    zero, kernel = decimals(np.zeros((n, n))), column_space(B) if kernel is None else kernel
    if any(Z_i != Z_i.transpose() for Z_i in Z.values()):
        return False
    if not is_positive_semidefinite(total + total.transpose(), kernel):
        return False
    if total_of(list(Z.values())) * B != decimals(np.zeros((n, B.ncols()))):
        return False
    if len(Z) == 1:
        (single,) = Z.values()
        return not is_positive_semidefinite(-single)
    return all(is_positive_semidefinite(Z_i, kernel) for Z_i in Z.values()) and any(Z_i != zero for Z_i in Z.values())


def exact_multipliers(
    A: Sequence[Rational], N: Sequence[Rational], bases: Sequence[Array], R: Rational, U: Sequence[Array]
) -> list[Rational] | None:
    """Round Z_i = Q_i U_i Q_iᵀ to rationals N_iᵀ V_i N_i that fulfil Σ (Z_i A_i + A_iᵀ Z_i) R = 0 exactly."""
    V = []
    for N_i, Q, U_i in zip(N, bases, U, strict=True):
        T = np.linalg.lstsq(floats(N_i).T, Q, rcond=None)[0]
        V.append(rounded(T @ U_i @ T.T))
    if R.ncols() and not _mended(V, A, N, R):
        return None
    whole = lcm(*(int(v.q) for V_i in V for v in V_i.entries()))  # whole numbers are multiplied much faster
    return [N_i.transpose() * (V_i * whole) * N_i for N_i, V_i in zip(N, V, strict=True)]


def _mended(V: Sequence[Rational], A: Sequence[Rational], N: Sequence[Rational], R: Rational) -> bool:
    """Change as few entries of the V_i as it takes that Σ (Z_i A_i + A_iᵀ Z_i) R = 0, and say whether that worked."""
    import flint

    ends = [(N_i * A_i, N_i * A_i * R, N_i * R) for N_i, A_i in zip(N, A, strict=True)]
    lists = [[X.tolist() for X in (N_i, *end)] for N_i, end in zip(N, ends, strict=True)]
    unknowns = [(i, j, k) for i, V_i in enumerate(V) for j in range(V_i.nrows()) for k in range(j, V_i.nrows())]
    columns = []
    for i, j, k in unknowns:
        N_i, NA, NAR, NR = lists[i]
        pairs = [(N_i[j], NAR[k]), (NA[j], NR[k])] + ([(N_i[k], NAR[j]), (NA[k], NR[j])] if j != k else [])
        columns.append(_outer(pairs).entries())
    residual = total_of(
        [
            N_i.transpose() * V_i * NAR + NA.transpose() * V_i * NR
            for N_i, V_i, (NA, NAR, NR) in zip(N, V, ends, strict=True)
        ]
    )
    G = flint.fmpq_mat(len(columns), residual.nrows() * residual.ncols(), [v for c in columns for v in c])
    chosen, rows = _pivots(floats(G))
    square = flint.fmpq_mat(len(rows), len(chosen), [G[c, r] for r in rows for c in chosen])
    try:
        step = square.solve(column([-residual.entries()[r] for r in rows])).entries() if rows else []
    except ZeroDivisionError:
        return False
    for c, dx in zip(chosen, step, strict=True):
        i, j, k = unknowns[c]
        V[i][j, k] += dx
        if j != k:
            V[i][k, j] += dx
    return True


def _pivots(G: Array) -> tuple[list[int], list[int]]:
    """Return as many independent rows and columns as G has rank."""
    _, triangle, order = qr(G.T, pivoting=True, mode="economic")
    diagonal = np.abs(np.diag(triangle))
    rank = int((diagonal > _INDEPENDENT * diagonal.max(initial=0.0)).sum())
    rows = order[:rank]
    columns = qr(G[rows], pivoting=True, mode="economic")[2][:rank]
    return rows.tolist(), columns.tolist()


def _outer(pairs: Sequence[tuple[Sequence[Any], Sequence[Any]]]) -> Rational:
    """Return the sum of x yᵀ."""
    return total_of([column(x) * column(y).transpose() for x, y in pairs])


def rounded(X: Array) -> Rational:
    """Return a symmetric matrix rounded to a grid finer than its largest entry by 2^-48."""
    grid = Fraction(2) ** (int(np.ceil(np.log2(np.abs(X).max(initial=1e-300)))) - _BITS)
    return rational([[round(Fraction(v) / grid) * grid for v in row] for row in ((X + X.T) / 2).tolist()], X.shape)


def whole(Z: Mapping[int, Rational]) -> dict[int, tuple[tuple[int, ...], ...]]:
    """Return the multipliers times one number that makes all entries whole."""
    scale = lcm(*(int(v.q) for Z_i in Z.values() for v in Z_i.entries()))
    return {i: tuple(tuple(int((v * scale).p) for v in row) for row in Z_i.tolist()) for i, Z_i in Z.items()}


def symmetric(upper: Sequence[Any], n: int) -> Rational:
    """Return the symmetric matrix with this upper triangle, row by row."""
    import flint

    X, entries = flint.fmpq_mat(n, n), iter(upper)
    for j in range(n):
        for k in range(j, n):
            X[j, k] = X[k, j] = next(entries)
    return X


def total_of(terms: Sequence[Rational]) -> Rational:
    """Return the sum of at least one matrix."""
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def column(entries: Sequence[Any]) -> Rational:
    """Return entries as a column."""
    import flint

    return flint.fmpq_mat(len(entries), 1, list(entries))
