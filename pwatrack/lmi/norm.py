"""The norm that a proof speaks of, how large a matrix is in it, and by how much a gain may change: proved exactly."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.linalg import eigh

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.exact import Proof, unsure
from pwatrack.lmi.polynomial import AnyProof
from pwatrack.rational import (
    Rational,
    diagonal,
    doubles,
    floats,
    fraction_of,
    identity,
    is_positive_definite,
    near,
    number,
    scalar,
    solved,
)

_LEAST = 1e-15  # of the largest eigenvalue of P: below that the least one is rounding
_ABOVE = Fraction(1) + Fraction(1, 10**9)  # more than the rounding of a power


@dataclass(frozen=True)
class Norm:
    """‖e‖ = √(eᵀ Q e) with an exact Q ≻ 0, FLINT's rational matrix of order n."""

    Q: Rational

    @classmethod
    def euclidean(cls, n: int) -> "Norm":
        """Return the norm with Q = I: the length of a vector in the units given."""
        return cls(identity(n))

    @classmethod
    def in_sizes(cls, sizes: Array) -> "Norm":
        """Return the norm with Q = diag(1 / size²): the length of a vector whose entries are counted in sizes (n,).

        Example:
            >>> 5.0 <= Norm.in_sizes(np.array([0.5, 2.0]))(np.array([1.5, 8.0])) < 5.0 + 1e-14
            True
        """
        return cls(diagonal([1 / Fraction(size) ** 2 for size in sizes.tolist()]))

    @classmethod
    def of(cls, proof: Proof) -> "Norm":
        """Return the norm in which a proof says that errors shrink: Q = P⁻¹ for (8), Q = P for (9) and (17).

        From M P + P Mᵀ ⪯ −2αP follows QM + MᵀQ ⪯ −2αQ for Q = P⁻¹; (9) and (17) are stated for M = Aᵀ.
        """
        P = proof.P
        return cls(P if proof.role.transposed else P.inv())

    def __call__(self, vector: Array) -> float:
        """Return ‖vector‖, rounded up."""
        column = doubles(np.asarray(vector)[:, None])
        return root_above((column.transpose() * self.Q * column)[0, 0])


def largest_gain(X: Rational, of: Norm, to: Norm) -> float:
    """Return c with ‖X d‖_to ≤ c ‖d‖_of for every d, a little above the least: c² Q_of − Xᵀ Q_to X ≻ 0 is proved.

    Example:
        >>> from pwatrack.rational import decimals
        >>> 4.0 < largest_gain(decimals(np.diag([3.0, 4.0])), Norm.euclidean(2), Norm.euclidean(2)) < 4.0 + 1e-8
        True
    """
    size = X.transpose() * to.Q * X
    if not any(size.entries()):
        return 0.0
    c = _estimate(size, of.Q)

    def above(grow: float) -> bool:
        return is_positive_definite(of.Q * number(Fraction(c * (1 + grow)) ** 2) - size)

    return c * (1 + _until(1e-9, 10, above))  # of its rounding


@dataclass(frozen=True, kw_only=True)
class Gauge:
    """W(e) ≥ 0 with d/dt W ≤ −rate W + ‖w‖_driven along e' = A(t) e + w, and ‖e‖_below ≤ W(e) ≤ ‖e‖_above.

    Of a quadratic proof W is a norm, and all three are it. Of a polynomial one W = V^(1/2d), and with
    λ |z|^2d ≤ V ≤ Λ |z|^2d they are multiples of |z| = |T e|: λ^(1/2d), Λ^(1/2d) and √Λ λ^(−(d−1)/2d). The last since
    V = mᵀ P m gives |∇V w| = 2 |mᵀ P ∇m w| ≤ 2 √V √Λ |∇m w|, and |∇m w| ≤ d |z|^(d−1) |w|, as m is z ⊗ … ⊗ z in other
    coordinates.
    """

    above: Norm
    below: Norm
    driven: Norm

    @classmethod
    def of(cls, proof: AnyProof) -> "Gauge":
        """Return that of a proof.

        Example: (e₁² + e₂²)² measures as the length does.

            >>> from pwatrack.lmi.inequality import OBSERVER
            >>> from pwatrack.lmi.polynomial import PolynomialProof
            >>> P = ((2**39, 0, 0), (0, 2**40, 0), (0, 0, 2**39))
            >>> proof = PolynomialProof(role=OBSERVER, degree=4, T=np.eye(2), integers=P, exponents=(0, 0, 0), N=(),
            ...     N_exponents=(), rate=1.0)
            >>> found = Gauge.of(proof)
            >>> [round(norm(np.array([3.0, 4.0])) / 2**9.75, 5) for norm in (found.above, found.below, found.driven)]
            [5.0, 5.0, 5.0]
        """
        if isinstance(proof, Proof):
            norm = Norm.of(proof)
            return cls(above=norm, below=norm, driven=norm)
        d, monomials, P = proof.degree // 2, proof.monomials, proof.P
        scale = 1 / monomials.weights
        values = np.linalg.eigvalsh(floats(P) * scale[:, None] * scale)
        length = diagonal([Fraction(square) for square in monomials.squares])
        least, most = float(max(values[0], _LEAST * values[-1])) * (1 - 1e-6), float(values[-1]) * (1 + 1e-6)
        low = _until(least, 0.5, lambda low: is_positive_definite(P - length * number(Fraction(low))))
        high = _until(most, 2.0, lambda high: is_positive_definite(length * number(Fraction(high)) - P))
        T = BallMatrix.of(proof.T).centre
        square = T.transpose() * T
        return cls(
            above=Norm(square * number(Fraction(high ** (1 / d)) * _ABOVE)),
            below=Norm(square * number(Fraction(low ** (1 / d)) / _ABOVE)),
            driven=Norm(square * number(Fraction(high / low ** ((d - 1) / d)) * _ABOVE)),
        )


def largest_share(slack: Sequence[Rational], U: BallMatrix, V: BallMatrix, gain: Array) -> float:
    """Return ρ ≤ 1 such that S_i − U δ Vᵀ − V δᵀ Uᵀ ≻ 0 for all i and all δ with |δ_jk| ≤ ρ |gain_jk|, proved exactly.

    For any t_jk > 0, U δ Vᵀ + V δᵀ Uᵀ ⪯ ρ R with R = Σ_jk |gain_jk| (t_jk u_j u_jᵀ + v_k v_kᵀ / t_jk): so S_i − ρ R ≻ 0
    is enough. The t_jk make both terms alike where the slack is least.

    S_i (n, n) is positive definite; U is (n, a) and V (n, b): where they have irrational entries, it is proved for
    everything in their balls. The gain (a, b) counts as printed.
    """
    S, u, v = np.array([floats(S_i) for S_i in slack]), U.floats, V.floats
    size = np.abs(gain)
    d = 1 / np.sqrt(S.diagonal(axis1=1, axis2=2).mean(axis=0))
    try:
        inverse = np.linalg.inv((S * d[:, None] * d).mean(axis=0))
    except np.linalg.LinAlgError:
        inverse = np.eye(len(d))
    lengths = [np.einsum("ij,ik,kj->j", X, inverse, X) for X in (u * d[:, None], v * d[:, None])]
    used = (size > 0) & (lengths[0][:, None] > 0) & (lengths[1] > 0)
    if not used.any():
        return 1.0
    ratio = np.divide(lengths[1], lengths[0][:, None], out=np.ones_like(size), where=used)
    t = np.sqrt(ratio)
    unit = [Fraction(2) ** int(e) for e in np.round(-np.log2(d))]
    R = square_above(U, _weights(size, t), unit) + square_above(V, _weights(size.T, t.T, inverse=True), unit)
    change = floats(R) * d[:, None] * d
    try:
        share = 1 / max(float(eigh(change, S_i * d[:, None] * d, eigvals_only=True)[-1]) for S_i in S)
    except np.linalg.LinAlgError:
        share = 1.0
    share = min(share, 1.0)
    for _ in range(200):
        share = float(f"{0.99 * share:.2e}")
        if all(is_positive_definite(S_i - scalar(share) * R) for S_i in slack):
            return share
        share *= 0.9
    return 0.0


def _estimate(size: Rational, Q: Rational) -> float:
    """Return about the root of the largest eigenvalue of Q⁻¹ size, not far below it."""
    n, S, W = Q.nrows(), floats(size), floats(Q)
    d = np.sqrt(np.diag(W))
    try:
        largest = float(eigh(S / d[:, None] / d, W / d[:, None] / d, eigvals_only=True)[-1])
    except np.linalg.LinAlgError:  # too ill-conditioned for floats: the trace is above it, at most n times
        largest = 0.0
    trace = float(np.trace(near(solved(Q, size))))
    return float(np.sqrt(largest if trace / (2 * n) <= largest <= trace else trace))


def square_above(U: BallMatrix, weights: Sequence[Fraction], unit: Sequence[Fraction]) -> Rational:
    """Return U diag(weights) Uᵀ, no weight negative, or what is above it for every U in the ball."""
    return form_above(U, diagonal(weights), unit)


def form_above(U: BallMatrix, W: Rational, unit: Sequence[Fraction]) -> Rational:
    """Return U W Uᵀ, W positive semidefinite, or what is above it for every U in the ball: see `unsure`."""
    square = U @ BallMatrix(W) @ U.transpose()
    return square.centre + unsure(square.radius, identity(len(unit)), unit)  # twice what is needed


def sizes_in(Q: Rational, rows: BallMatrix) -> tuple[float, ...]:
    """Return (c Q cᵀ)^½ for each row c, or the largest in its ball, rounded up."""
    square = rows @ BallMatrix(Q) @ rows.transpose()
    most = square.centre if square.radius is None else square.centre + square.radius
    return tuple(root_above(most[k, k]) for k in range(rows.shape[0]))


def root_above(value: Any) -> float:
    """Return a float just above the root of a rational number.

    Example: numbers whose squares are no floats.

        >>> [root_above(number(Fraction(10) ** k)) for k in (-600, 0, 600)]
        [1e-300, 1.0, 1e+300]
    """
    exact = fraction_of(value)
    shift = (exact.denominator.bit_length() - exact.numerator.bit_length()) // 2  # keeps floats away from their limits
    root = float(np.ldexp(np.sqrt(float(exact * Fraction(4) ** shift)), -shift))
    while Fraction(root) ** 2 < exact:
        root = float(np.nextafter(root, np.inf))
    return root


def _until(value: float, factor: float, holds: Callable[[float], bool]) -> float:
    """Return the first number, further and further away by a factor, for which something is proved."""
    while not holds(value):
        value *= factor
    return value


def _weights(size: Array, t: Array, *, inverse: bool = False) -> list[Fraction]:
    """Return Σ_k size_jk t_jk, or with 1 / t_jk, for each j, exactly: sizes as printed, t to four bits."""
    mantissa, exponent = np.frexp(t)
    short = np.ldexp(np.round(16 * mantissa), exponent - 4)
    return [
        sum((Fraction(repr(v)) * Fraction(w) ** (-1 if inverse else 1) for v, w in zip(*row, strict=True)), Fraction(0))
        for row in zip(size.tolist(), short.tolist(), strict=True)
    ]
