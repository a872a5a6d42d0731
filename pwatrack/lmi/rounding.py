"""Multipliers of floating point -> rational ones that fulfil the linear conditions exactly."""

from collections.abc import Sequence
from typing import Any

import flint
import numpy as np
from scipy.linalg import qr

from pwatrack.arrays import Array
from pwatrack.lmi.multipliers import column, denominator, rounded, total_of
from pwatrack.rational import Rational, floats

_INDEPENDENT = 1e-10  # of the largest pivot: equations with smaller ones follow from the others


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
    scale = denominator(V)  # whole numbers are multiplied much faster
    return [N_i.transpose() * (V_i * scale) * N_i for N_i, V_i in zip(N, V, strict=True)]


def _mended(V: Sequence[Rational], A: Sequence[Rational], N: Sequence[Rational], R: Rational) -> bool:
    """Change as few entries of the V_i as it takes that Σ (Z_i A_i + A_iᵀ Z_i) R = 0, and say whether that worked."""
    ends = [(N_i * A_i, N_i * A_i * R, N_i * R) for N_i, A_i in zip(N, A, strict=True)]
    unknowns = [(i, j, k) for i, V_i in enumerate(V) for j in range(V_i.nrows()) for k in range(j, V_i.nrows())]
    residual = total_of(
        [
            N_i.transpose() * V_i * NAR + NA.transpose() * V_i * NR
            for N_i, V_i, (NA, NAR, NR) in zip(N, V, ends, strict=True)
        ]
    ).entries()
    chosen, rows = _pivots(np.vstack([_equations(N_i, *end) for N_i, end in zip(N, ends, strict=True)]))
    lists = [[X.tolist() for X in (N_i, *end)] for N_i, end in zip(N, ends, strict=True)]
    columns = []
    for i, j, k in (unknowns[c] for c in chosen):
        N_i, NA, NAR, NR = lists[i]
        pairs = [(N_i[j], NAR[k]), (NA[j], NR[k])] + ([(N_i[k], NAR[j]), (NA[k], NR[j])] if j != k else [])
        columns.append(_outer(pairs).entries())
    square = flint.fmpq_mat(len(rows), len(chosen), [entries[r] for r in rows for entries in columns])
    try:
        step = square.solve(column([-residual[r] for r in rows])).entries() if rows else []
    except ZeroDivisionError:
        return False
    for c, dx in zip(chosen, step, strict=True):
        i, j, k = unknowns[c]
        V[i][j, k] += dx
        if j != k:
            V[i][k, j] += dx
    return True


def _equations(N: Rational, NA: Rational, NAR: Rational, NR: Rational) -> Array:
    """Return in doubles what each entry V_jk with j ≤ k adds to Σ (Z_i A_i + A_iᵀ Z_i) R, a row each."""
    left, left_A, right_A, right = (floats(X) for X in (N, NA, NAR, NR))
    each = np.einsum("ja,kb->jkab", left, right_A) + np.einsum("ja,kb->jkab", left_A, right)
    both = each + each.swapaxes(0, 1)
    j, k = np.triu_indices(len(left))
    return np.asarray(np.where((j == k)[:, None, None], each[j, k], both[j, k]).reshape(len(j), -1))


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
