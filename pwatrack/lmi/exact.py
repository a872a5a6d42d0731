"""Exact proof of a solution: whole-number P, decimals as printed, positive definiteness decided by balls.

`audit` checks the same claim again with another method; the two share no code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from pwatrack.arrays import Array

_BITS = 40  # of the entries of P, once its diagonal is about 1
_MOST_BITS = 8192  # precision at which the balls give up


@dataclass(frozen=True, kw_only=True)
class Proof:
    """P ≻ 0 and −(M_i P + P M_iᵀ) − 2 rate P − margin I ≻ 0 for every i, proved exactly.

    Attributes:
        of: "controller" for (8), "observer" for (9), "generator" for (17).
        integers, exponents: P_jk = integers_jk · 2^(exponents_j + exponents_k).
        rate: Certified decay rate in 1/s, a short decimal.
        margin: μ > 0, a short decimal.
        radius: Any change of the matrices M_i below it, in the spectral norm, is covered too: at most μ / (2 ‖P‖).
    """

    of: str
    integers: tuple[tuple[int, ...], ...]
    exponents: tuple[int, ...]
    rate: float
    margin: float
    radius: float


def decimals(X: Array) -> list[list[Fraction]]:
    """Return a matrix as the decimals that its entries are printed as.

    Example:
        >>> decimals(np.array([[0.1]]))
        [[Fraction(1, 10)]]
    """
    return [[Fraction(repr(float(v))) for v in row] for row in X]


def prove_exactly(of: str, M: Sequence[list[list[Fraction]]], P: Array, rate: float) -> Proof | None:
    """Round P and the rate to short numbers and prove the inequality for them, or return None.

    Args:
        of: What the proof is of.
        M: The matrices M_i, exact.
        P: A solution in floating point, (n, n).
        rate: The rate that it proves in floating point, in 1/s.
    """
    exponents = np.round(np.log2(np.diag(P)) / 2).astype(int) - _BITS // 2
    integers = [
        [round(Fraction(float(v)) / Fraction(2) ** int(a + b)) for v, b in zip(row, exponents, strict=True)]
        for row, a in zip((P + P.T) / 2, exponents, strict=True)
    ]
    exact_P = to_matrix(unpacked(integers, exponents.tolist()))
    if not positive_definite(exact_P):
        return None
    products = [to_matrix(M_i) * exact_P for M_i in M]
    left = [-(MP + MP.transpose()) for MP in products]
    size = float(np.linalg.norm(P))
    for shrink in (1e-3, 1e-2, 0.1, 0.5):  # the rate gives way a little, so that a margin is left
        short_rate = _rounded_down(rate * (1 - shrink), 6)
        slack = [S - to_fmpq(2 * Fraction(repr(short_rate))) * exact_P for S in left]
        if short_rate > 0 and all(positive_definite(S) for S in slack):
            margin = _margin(slack)
            radius = _rounded_down(margin / (2 * size) * (1 - 1e-9), 3)
            rows = tuple(tuple(row) for row in integers)
            return Proof(
                of=of,
                integers=rows,
                exponents=tuple(int(e) for e in exponents),
                rate=short_rate,
                margin=margin,
                radius=radius,
            )
    return None


def is_hurwitz(M: list[list[Fraction]]) -> bool:
    """Decide exactly whether all eigenvalues have negative real parts: Routh's array of the characteristic polynomial.

    Where it is false, no P ≻ 0 has M P + P Mᵀ ≺ 0 (Lyapunov).

    Example:
        >>> is_hurwitz(decimals(np.array([[-1.0, 5.0], [0.0, -1e-30]])))
        True
        >>> is_hurwitz(decimals(np.array([[0.0, 1.0], [-1.0, 0.0]])))
        False
    """
    import flint

    polynomial = to_matrix(M).charpoly()
    falling = [polynomial[k] for k in range(len(M), -1, -1)]
    above, here = falling[0::2], falling[1::2]
    while here:
        if not here[0] > 0:
            return False
        ratio = above[0] / here[0]
        padded = here[1:] + [flint.fmpq(0)] * (len(above) - len(here))
        above, here = here, [a - ratio * b for a, b in zip(above[1:], padded, strict=True)]
    return True


def unreachable_part(A: list[list[Fraction]], B: list[list[Fraction]]) -> list[list[Fraction]]:
    """Return A on the states that B never reaches, an exact (k, k) matrix; k = 0 if (A, B) is controllable.

    With N the left null space of [B, AB, …, Aⁿ⁻¹B], N A = A_u N. No gain changes A_u.
    """
    import flint

    n = len(A)
    exact_A, column = to_matrix(A), to_matrix(B)
    reached = column
    for _ in range(n - 1):
        column = exact_A * column
        reached = flint.fmpq_mat([r + c for r, c in zip(reached.tolist(), column.tolist(), strict=True)])
    N = _left_null_space(reached)
    if not N:
        return []
    rows = flint.fmpq_mat(N)
    gram = rows * rows.transpose()
    A_u = rows * exact_A * rows.transpose() * gram.inv()
    return [[Fraction(int(v.p), int(v.q)) for v in row] for row in A_u.tolist()]


def _left_null_space(X: Any) -> list[list[Any]]:
    """Return a basis of the rows v with v X = 0."""
    import flint

    reduced, rank = X.transpose().rref()
    rows, n = reduced.tolist(), X.nrows()
    pivots = [next(j for j, v in enumerate(row) if v != 0) for row in rows[:rank]]
    basis = []
    for free in (j for j in range(n) if j not in pivots):
        v = [flint.fmpq(int(j == free)) for j in range(n)]
        for row, pivot in zip(rows, pivots, strict=False):
            v[pivot] = -row[free]
        basis.append(v)
    return basis


def _margin(slack: Sequence[Any]) -> float:
    """Return a short decimal μ > 0 with S − μ I ≻ 0 for every S, at least an eighth of the largest one."""
    import flint

    n = slack[0].nrows()
    eye = flint.fmpq_mat([[int(j == k) for k in range(n)] for j in range(n)])
    floats = np.array([[[to_float(S[j, k]) for k in range(n)] for j in range(n)] for S in slack])
    estimate = float(np.linalg.eigvalsh(floats).min())
    margin = _rounded_down(estimate / 2 if estimate > 0 else float(np.abs(floats).max()), 3)
    while not all(positive_definite(S - to_fmpq(Fraction(repr(margin))) * eye) for S in slack):
        margin = _rounded_down(margin / 4, 3)
    return margin


def positive_definite(X: Any) -> bool:
    """Decide by the pivots of LDLᵀ in ball arithmetic, with ever more bits until every sign is sure."""
    import flint

    n = X.nrows()
    before, bits = flint.ctx.prec, 128
    try:
        while bits <= _MOST_BITS:
            flint.ctx.prec = bits
            sign = _pivots([[flint.arb(X[j, k]) for k in range(j + 1)] for j in range(n)])
            if sign is not None:
                return sign
            bits *= 2
        return False
    finally:
        flint.ctx.prec = before


def _pivots(rows: list[list[Any]]) -> bool | None:
    """Return whether all pivots of a lower triangle are positive; None if a ball holds 0."""
    for k in range(len(rows)):
        pivot = rows[k][k]
        if not pivot > 0:
            return False if pivot < 0 else None
        for row in rows[k + 1 :]:
            factor = row[k] / pivot
            for j in range(k + 1, len(row)):
                row[j] -= factor * rows[j][k]
    return True


def _rounded_down(value: float, digits: int) -> float:
    """Return the value with so many significant digits, not larger."""
    shown = float(f"{value:.{digits - 1}e}")
    return shown if shown <= value else float(f"{value * (1 - 10.0 ** (1 - digits)):.{digits - 1}e}")


def unpacked(integers: Sequence[Sequence[int]], exponents: Sequence[int]) -> list[list[Fraction]]:
    """Return the matrix P of a `Proof`: P_jk = integers_jk · 2^(exponents_j + exponents_k)."""
    return [
        [Fraction(v) * Fraction(2) ** (a + b) for v, b in zip(row, exponents, strict=True)]
        for row, a in zip(integers, exponents, strict=True)
    ]


def to_matrix(X: Sequence[Sequence[Fraction]]) -> Any:
    """Return a rational matrix as FLINT's."""
    import flint

    return flint.fmpq_mat([[to_fmpq(v) for v in row] for row in X])


def to_fmpq(value: Fraction) -> Any:
    """Return a rational number as FLINT's."""
    import flint

    return flint.fmpq(value.numerator, value.denominator)


def to_float(value: Any) -> float:
    """Return FLINT's rational number as the nearest float."""
    return float(Fraction(int(value.p), int(value.q)))
