"""Which faces of the cone all multipliers lie in: exactly, as far as it follows from the data, or guessed."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import flint
import numpy as np
from scipy.linalg import qr

from pwatrack.arrays import Array
from pwatrack.lmi.multipliers import column
from pwatrack.rational import Rational, column_space, floats, identity, left_null_space, rational, stacked

_SINGULAR = 1e-5  # eigenvalues below this share of the largest are taken for 0 when faces are guessed
_SIMPLE = 1000  # denominators of guessed directions


def faces(A: Sequence[Rational], B: Rational) -> tuple[Rational, list[Rational]]:
    """Return R (n, ρ) and N_i (k_i, n): every solution has Z_i R = 0 and Z_i = N_iᵀ U_i N_i with some U_i ⪰ 0.

    Σ Z_i B = 0 with Z_i ⪰ 0 makes Z_i B = 0. Where Z_i r = 0 for all i, rᵀ S r = 0 for
    S = Σ (Z_i A_i + A_iᵀ Z_i), so S ⪰ 0 needs S r = Σ Z_i A_i r = 0. If every Z_i A_i r is Z_i w
    times a number c_i ≥ 0, then wᵀ S r = 0 makes Z_i w = 0 wherever c_i > 0.
    """
    R, N = column_space(B), [left_null_space(B) for _ in A]
    while True:
        for r in _candidates(A, R, N):
            images = [A_i * r for A_i in A]
            seen = [N_i * x for N_i, x in zip(N, images, strict=True)]
            w = next((x for x, y in zip(images, seen, strict=True) if any(y.entries())), None)
            if w is None:
                continue
            factors = [_factor(y, N_i * w) for N_i, y in zip(N, seen, strict=True)]
            if any(c is None or c < 0 for c in factors):
                continue
            N = [left_null_space(N_i * w) * N_i if c > 0 else N_i for N_i, c in zip(N, factors, strict=True)]
            if not any(any((N_i * w).entries()) for N_i in N):
                R = stacked([R.transpose(), w.transpose()]).transpose()
            break
        else:
            return R, N


def _candidates(A: Sequence[Rational], R: Rational, N: Sequence[Rational]) -> list[Rational]:
    """Return vectors in the range of R: those that all cells map alike, then the columns."""
    if not R.ncols():
        return []
    differences = [N[0] * (A_i - A[0]) * R for A_i in A[1:] if N[0].nrows()]
    alike = left_null_space(stacked(differences).transpose()) if differences else identity(R.ncols())
    rows = stacked([alike * R.transpose(), R.transpose()]).tolist()
    return [column(row) for row in rows]


def _factor(y: Rational, x: Rational) -> Any:
    """Return c with y = c x, or None."""
    if not any(y.entries()):
        return flint.fmpq(0)
    at = next((k for k, v in enumerate(x.entries()) if v != 0), None)
    if at is None:
        return None
    c = y[at, 0] / x[at, 0]
    return c if y == x * c else None


def guessed_faces(
    A: Array, N: Sequence[Rational], bases: Sequence[Array], U: Mapping[int, Array]
) -> tuple[Rational, list[Rational]]:
    """Return smaller faces and more blind directions, read off a marginal solution; whether they are right shows later.

    Where the best margin is exactly 0 the multipliers are singular, often in rational directions.
    """
    smaller, S = list(N), np.zeros(A.shape[1:])
    for i, U_i in U.items():
        values, vectors = np.linalg.eigh(U_i)
        T = np.linalg.lstsq(floats(N[i]).T, bases[i], rcond=None)[0]
        smaller[i] = _simple_span(T @ vectors[:, values > _SINGULAR * values[-1]]).transpose() * N[i]
        ZA = bases[i] @ U_i @ bases[i].T @ A[i]
        S += ZA + ZA.T
    values, vectors = np.linalg.eigh(S)
    blind = _simple_span(vectors[:, np.abs(values) <= _SINGULAR * np.abs(values).max()])
    return blind, smaller


def _simple_span(columns: Array) -> Rational:
    """Return columns of the same span, a unit matrix in some rows and simple fractions in the others."""
    rank = columns.shape[1]
    if not rank:
        return rational([], columns.shape)
    rows = qr(columns.T, pivoting=True)[2][:rank]
    basis = columns @ np.linalg.inv(columns[rows])
    fractions = [[Fraction(v).limit_denominator(_SIMPLE) for v in row] for row in basis.tolist()]
    return rational(fractions, columns.shape)
