"""What a solver proposes, decided: proof that a P works, in floating point or exactly.

In NumPy an eigenvalue counts as positive where it exceeds a bound on all rounding errors. Exactly P is in whole
numbers, and definite by balls: `audit` checks the same claim again with another method; the two share no code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import eigh

from pwatrack.arrays import EPS, Array, readonly, symmetric_part
from pwatrack.ball_matrix import BallMatrix, absolute
from pwatrack.lmi.inequality import Role
from pwatrack.lmi.presolve import distinct
from pwatrack.rational import (
    Rational,
    floats,
    fraction_of,
    identity,
    is_positive_definite,
    number,
    rational,
    scalar,
)

_LESS = (1e-9, 1e-6, 1e-3)  # of the rate, given up until a margin is left that rounding does not hide
RATE_GIVEN = 1e-4  # share of the rate that an exact proof gives up
GIVEN = (RATE_GIVEN, 1e-3, 1e-2, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5)  # likewise, more and more, until it can be proved
DIGITS = 9  # of a gain, and of what stands for one at limits
BITS = 40  # of the entries of P or Q, once its diagonal is about 1
_MORE_BITS = (BITS, 80, 160)  # the same, more where P is so ill-conditioned that fewer do not hold it

Whole = tuple[tuple[int, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """A common P ≻ 0 with M_i P + P M_iᵀ + 2 rate P ≺ 0 in every cell."""

    M: Array  # the matrices it speaks of, (l, n, n), as used: A_i + B K for (8), (A_i + L C)ᵀ for (9), A_ηiᵀ for (17)
    P: Array  # (n, n)
    rate: float  # certified decay rate in 1/s, positive
    # least eigenvalue over the cells of −(M_i P + P M_iᵀ + 2 rate P), less its rounding error, with the states scaled
    # by powers of two to make the diagonal of P about 1 (which changes no sign); positive
    margin: float
    precise: Rational | None = None  # P with more digits, where doubles do not hold what proves it; else None


def of_proof(M: Array, proof: "Proof") -> Certificate:
    """Return the certificate of an exact proof about M (l, n, n)."""
    P = readonly(floats(proof.P))
    return Certificate(M=readonly(M), P=P, rate=proof.rate, margin=proof.margin, precise=proof.P)


def prove(M: Array, P: Array) -> Certificate | None:
    """Return a certificate for the largest rate that the symmetric part of P proves, or None if it proves none."""
    scaled = _scaled(M, P)
    if scaled is None or not _least(scaled[1], np.abs(scaled[1])) > 0:
        return None
    scaled_M, scaled_P, left = scaled
    rate = _rate(left, scaled_P)
    size = np.abs(scaled_M) @ np.abs(scaled_P) + abs(rate) * np.abs(scaled_P)
    for shrunk in (rate * (1 - less) for less in _LESS):
        slack = -left - 2 * shrunk * scaled_P
        margin = min(_least(S, s) for S, s in zip(slack, size, strict=True))
        if shrunk > 0 and margin > 0:
            return Certificate(M=readonly(M), P=readonly(symmetric_part(P) / 2), rate=shrunk, margin=margin)
    return None


def likely_rate(M: Array, P: Array) -> float:
    """Return the rate in 1/s that a P seems to prove, as far as floating point can tell; 0 for none.

    Example: of so ill-conditioned a P only exact numbers can prove anything.

        >>> P = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-13]])
        >>> likely_rate(-np.eye(2)[None], P) > 0, prove(-np.eye(2)[None], P) is None
        (True, True)
    """
    scaled = _scaled(M, P)
    if scaled is None or not np.linalg.eigvalsh(scaled[1])[0] > 0:
        return 0.0
    try:
        return max(0.0, _rate(scaled[2], scaled[1]))
    except np.linalg.LinAlgError:  # P is not definite to working precision
        return 0.0


def _scaled(M: Array, P: Array) -> tuple[Array, Array, Array] | None:
    """Return each different M, P and M P + P Mᵀ, with states scaled by powers of two to make the diagonal of P about 1.

    None where they are not finite, or the diagonal is not positive.
    """
    diagonal = np.diag(P)
    if not (np.isfinite(P).all() and (diagonal > 0).all()):
        return None
    d = 2.0 ** np.round(np.log2(diagonal) / 2)
    scaled_M, scaled_P = distinct(M)[0] / d[:, None] * d, symmetric_part(P) / 2 / d[:, None] / d
    left = symmetric_part(scaled_M @ scaled_P)
    return (scaled_M, scaled_P, left) if np.isfinite(left).all() else None


def _rate(left: Array, P: Array) -> float:
    return min(-float(eigh(side, P, eigvals_only=True, check_finite=False)[-1]) / 2 for side in left)


def _least(X: Array, size: Array) -> float:
    """Return a lower bound of the least eigenvalue of X, computed with entries of magnitude `size`.

    Forming a product of order n errs by at most n eps |·||·| per entry, and the symmetric eigenvalue solver by a modest
    multiple of n eps ‖X‖ (Anderson et al., LAPACK Users' Guide, section 4.7): 16 n eps covers both with room.
    """
    n = len(X)
    bound = 16 * n * EPS * float(np.linalg.norm(size + size.T) + np.linalg.norm(X))
    return float(np.linalg.eigvalsh(X)[0]) - bound


@dataclass(frozen=True, kw_only=True)
class Packed:
    """A symmetric matrix in short numbers."""

    integers: Whole  # P_jk = integers_jk · 2^(exponents_j + exponents_k)
    exponents: tuple[int, ...]

    @classmethod
    def of(cls, X: Array | Rational, like: Array | None = None, bits: int = BITS) -> "Packed":
        """Round X (n, n) to whole numbers of about so many bits, for the diagonal of X or of another, both positive."""
        near = like if like is not None else X if isinstance(X, np.ndarray) else floats(X)
        sizes = np.maximum(np.diag(near), 1e-300)
        exponents = tuple((np.round(np.log2(sizes) / 2).astype(int) - bits // 2).tolist())
        return Packed(integers=whole(X, exponents), exponents=exponents)

    @cached_property
    def P(self) -> Rational:
        """The matrix, exactly."""
        n, scale = len(self.exponents), self.scale
        rows = zip(self.integers, scale, strict=True)
        return rational([[v * a * b for v, b in zip(row, scale, strict=True)] for row, a in rows], (n, n))

    @property
    def scale(self) -> list[Fraction]:
        """About the root of each entry of its diagonal, but for one factor."""
        return [Fraction(2) ** e for e in self.exponents]

    @property
    def parts(self) -> dict[str, Any]:
        """What makes another object that holds the same matrix."""
        return {"integers": self.integers, "exponents": self.exponents}


@dataclass(frozen=True, kw_only=True)
class Proof(Packed):
    """P ≻ 0 and −(M_i P + P M_iᵀ) − 2 rate P − margin I ≻ 0 for every i, proved exactly.

    Where M_i has irrational entries, for every matrix in its ball.
    """

    role: Role  # which inequality it is
    rate: float  # certified decay rate in 1/s, a short decimal
    margin: float  # μ > 0, a short decimal
    radius: float  # any change of the matrices M_i below it, in the spectral norm, is covered too: at most μ / (2 ‖P‖)

    @property
    def order(self) -> int:
        """That of the matrices it speaks of."""
        return len(self.exponents)

    @property
    def degree(self) -> int:
        """That of the quadratic form."""
        return 2


def prove_exactly(role: Role, M: Sequence[BallMatrix], P: Array | Rational, rate: float) -> Proof | None:
    """Round P, and the rate (1/s) that it seems to prove, to short numbers and prove it for them, or return None."""
    for bits in _MORE_BITS:
        short = Packed.of(P, bits=bits)
        left = [left_side(M_i, short) for M_i in M] if is_positive_definite(short.P) else []
        shown = proved_rate(left, short.P, 2, rate)
        if shown is not None:
            margin = margin_of([S - scalar(2 * shown) * short.P for S in left])
            radius = rounded_down(margin / (2 * float(np.linalg.norm(floats(short.P)))) * (1 - 1e-9), 3)
            return Proof(role=role, rate=shown, margin=margin, radius=radius, **short.parts)
    return None


def proved_rate(left: Sequence[Rational], P: Rational, degree: int, rate: float) -> float | None:
    """Return a short decimal, the rate or a little less, with S − degree · rate P ≻ 0 for every S in `left`, if any."""
    for shown in (rounded_down(rate * (1 - given), 6) for given in GIVEN if left):
        if shown > 0 and all(is_positive_definite(S - scalar(degree * shown) * P) for S in left):
            return shown
    return None


def whole(X: Array | Rational, exponents: Sequence[int]) -> Whole:
    """Return the whole numbers nearest to X_jk / 2^(exponents_j + exponents_k), of the symmetric part of X (n, n)."""
    if isinstance(X, np.ndarray):
        near = np.rint(np.ldexp((X + X.T) / 2, -np.add.outer(exponents, exponents)))
        return tuple(tuple(map(int, row)) for row in near.tolist())
    unit = [Fraction(2) ** e for e in exponents]
    rows = [[fraction_of(v) / 2 for v in row] for row in (X + X.transpose()).tolist()]
    return tuple(
        tuple(round(v / (a * b)) for v, b in zip(row, unit, strict=True)) for row, a in zip(rows, unit, strict=True)
    )


def left_side(M: BallMatrix, of: Packed) -> Rational:
    """Return −(M P + P Mᵀ), or what is below it for everything in the ball."""
    MP = M.centre * of.P
    left = -(MP + MP.transpose())
    return left if M.radius is None else left - unsure(M.radius, of.P, of.scale)


def unsure(radius: Rational | None, P: Rational, unit: Sequence[Fraction]) -> Rational:
    """Return a diagonal D ⪰ ±(E P + P Eᵀ) for every E with |E_jk| ≤ radius_jk.

    With X = radius |P| + |P| radiusᵀ and any s_j > 0, Σ X_jk |v_j v_k| ≤ Σ_j v_j² Σ_k X_jk s_j / s_k: the unit is s_j,
    about the root of P_jj. None stands for a radius of 0.
    """
    if radius is None:
        return identity(P.nrows()) * 0
    half, found = radius * absolute(P), identity(P.nrows()) * 0
    sums = (half + half.transpose()) * rational([[1 / s] for s in unit], (len(unit), 1))
    for j, s in enumerate(unit):
        found[j, j] = number(s) * sums[j, 0]
    return found


def margin_of(slack: Sequence[Rational]) -> float:
    """Return a short decimal μ > 0 with S − μ I ≻ 0 for every S, at least an eighth of the largest one."""
    eye = identity(slack[0].nrows())
    nearest = np.array([floats(S) for S in slack])
    estimate = float(np.linalg.eigvalsh(nearest).min())
    margin = rounded_down(estimate / 2 if estimate > 0 else float(np.abs(nearest).max()), 3)
    while not all(is_positive_definite(S - scalar(margin) * eye) for S in slack):
        margin = rounded_down(margin / 4, 3)
    return margin


def short(X: Array, digits: int = DIGITS) -> Array:
    """Return a matrix with so many significant digits, none of them −0: what is printed is what is proved and used.

    Example:
        >>> short(np.array([[-1 / 3, -0.0]])).tolist()
        [[-0.333333333, 0.0]]
    """
    return np.array([[float(f"{v:.{digits - 1}e}") + 0.0 for v in row] for row in X]).reshape(X.shape)


def rounded_down(value: float, digits: int) -> float:
    """Return the value with so many significant digits, not larger."""
    shown = float(f"{value:.{digits - 1}e}")
    return shown if shown <= value else float(f"{value * (1 - 10.0 ** (1 - digits)):.{digits - 1}e}")
