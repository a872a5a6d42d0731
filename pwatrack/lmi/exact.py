"""Exact proof of a solution: whole-number P, decimals as printed, positive definiteness decided by balls.

`audit` checks the same claim again with another method; the two share no code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, absolute
from pwatrack.lmi.role import Role
from pwatrack.rational import Rational, floats, fraction_of, identity, is_positive_definite, rational, scalar

RATE_GIVEN = 1e-4  # share of the rate that an exact proof gives up
GIVEN = (RATE_GIVEN, 1e-3, 1e-2, 0.1, 0.5)  # the same, more and more, until a margin is left that can be proved
BITS = 40  # of the entries of P or Q, once its diagonal is about 1
_MORE_BITS = (BITS, 80, 160)  # the same, more where P is so ill-conditioned that fewer do not hold it


@dataclass(frozen=True, kw_only=True)
class Proof:
    """P ≻ 0 and −(M_i P + P M_iᵀ) − 2 rate P − margin I ≻ 0 for every i, proved exactly.

    Where M_i has irrational entries, for every matrix in its ball.

    Attributes:
        role: Which inequality it is.
        integers, exponents: P_jk = integers_jk · 2^(exponents_j + exponents_k).
        rate: Certified decay rate in 1/s, a short decimal.
        margin: μ > 0, a short decimal.
        radius: Any change of the matrices M_i below it, in the spectral norm, is covered too: at most μ / (2 ‖P‖).
    """

    role: Role
    integers: tuple[tuple[int, ...], ...]
    exponents: tuple[int, ...]
    rate: float
    margin: float
    radius: float

    @property
    def order(self) -> int:
        """That of the matrices it speaks of."""
        return len(self.exponents)

    @property
    def degree(self) -> int:
        """That of the quadratic form."""
        return 2

    @cached_property
    def P(self) -> Rational:
        """The matrix, exactly."""
        return unpacked(self.integers, self.exponents)


def prove_exactly(role: Role, M: Sequence[BallMatrix], P: Array | Rational, rate: float) -> Proof | None:
    """Round P and the rate to short numbers and prove the inequality for them, or return None.

    Args:
        role: Which inequality it is.
        M: The matrices M_i.
        P: A solution, (n, n), in floating point or with more digits.
        rate: The rate that it seems to prove, in 1/s.
    """
    proofs = (_proved(role, M, P, rate, bits) for bits in _MORE_BITS)
    return next((proof for proof in proofs if proof is not None), None)


def _proved(role: Role, M: Sequence[BallMatrix], P: Array | Rational, rate: float, bits: int) -> Proof | None:
    """Round P to so many bits and prove the inequality for that, or return None."""
    exponents = exponents_of(P if isinstance(P, np.ndarray) else floats(P), bits)
    unit = [Fraction(2) ** e for e in exponents]
    integers = whole(P, exponents)
    exact_P = unpacked(integers, exponents)
    if not is_positive_definite(exact_P):
        return None
    left = [left_side(M_i, exact_P, unit) for M_i in M]
    size = float(np.linalg.norm(floats(exact_P)))
    for shrink in GIVEN:
        short_rate = rounded_down(rate * (1 - shrink), 6)
        slack = [S - scalar(2 * short_rate) * exact_P for S in left]
        if short_rate > 0 and all(is_positive_definite(S) for S in slack):
            margin = margin_of(slack)
            return Proof(
                role=role,
                integers=integers,
                exponents=exponents,
                rate=short_rate,
                margin=margin,
                radius=rounded_down(margin / (2 * size) * (1 - 1e-9), 3),
            )
    return None


def exponents_of(P: Array, bits: int = BITS) -> tuple[int, ...]:
    """Return those with which P (n, n), of positive diagonal, has whole numbers of about so many bits."""
    return tuple((np.round(np.log2(np.diag(P)) / 2).astype(int) - bits // 2).tolist())


def whole(X: Array | Rational, exponents: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Return the whole numbers nearest to X_jk / 2^(exponents_j + exponents_k), of the symmetric part of X (n, n)."""
    unit = [Fraction(2) ** e for e in exponents]
    if isinstance(X, np.ndarray):
        rows = [[Fraction(v) for v in row] for row in ((X + X.T) / 2).tolist()]
    else:
        rows = [[fraction_of(v) / 2 for v in row] for row in (X + X.transpose()).tolist()]
    return tuple(
        tuple(round(v / (a * b)) for v, b in zip(row, unit, strict=True)) for row, a in zip(rows, unit, strict=True)
    )


def left_side(M: BallMatrix, P: Rational, unit: Sequence[Fraction]) -> Rational:
    """Return −(M P + P Mᵀ), or what is below it for everything in the ball."""
    MP = M.centre * P
    left = -(MP + MP.transpose())
    return left if M.radius is None else left - unsure(M.radius, P, unit)


def unsure(radius: Rational | None, P: Rational, unit: Sequence[Fraction]) -> Rational:
    """Return a diagonal D ⪰ ±(E P + P Eᵀ) for every E with |E_jk| ≤ radius_jk.

    With X = radius |P| + |P| radiusᵀ and any s_j > 0, Σ X_jk |v_j v_k| ≤ Σ_j v_j² Σ_k X_jk s_j / s_k.

    Args:
        radius: (n, n); None for 0.
        P: (n, n).
        unit: s_j, about the root of P_jj.
    """
    n = P.nrows()
    if radius is None:
        return identity(n) * 0
    half = radius * absolute(P)
    D, X = [[Fraction(0)] * n for _ in range(n)], (half + half.transpose()).tolist()
    for j, row in enumerate(X):
        D[j][j] = sum((fraction_of(v) * unit[j] / s for v, s in zip(row, unit, strict=True)), Fraction(0))
    return rational(D, (n, n))


def unpacked(integers: Sequence[Sequence[int]], exponents: Sequence[int]) -> Rational:
    """Return the matrix P of a `Proof`: P_jk = integers_jk · 2^(exponents_j + exponents_k)."""
    n = len(exponents)
    entries = [
        [v * Fraction(2) ** (a + b) for v, b in zip(row, exponents, strict=True)]
        for row, a in zip(integers, exponents, strict=True)
    ]
    return rational(entries, (n, n))


def margin_of(slack: Sequence[Rational]) -> float:
    """Return a short decimal μ > 0 with S − μ I ≻ 0 for every S, at least an eighth of the largest one."""
    eye = identity(slack[0].nrows())
    nearest = np.array([floats(S) for S in slack])
    estimate = float(np.linalg.eigvalsh(nearest).min())
    margin = rounded_down(estimate / 2 if estimate > 0 else float(np.abs(nearest).max()), 3)
    while not all(is_positive_definite(S - scalar(margin) * eye) for S in slack):
        margin = rounded_down(margin / 4, 3)
    return margin


def rounded_down(value: float, digits: int) -> float:
    """Return the value with so many significant digits, not larger."""
    shown = float(f"{value:.{digits - 1}e}")
    return shown if shown <= value else float(f"{value * (1 - 10.0 ** (1 - digits)):.{digits - 1}e}")
