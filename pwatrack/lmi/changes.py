"""By how much the entries of a gain may change, each by a share of itself, while an inequality stays proved."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from scipy.linalg import eigh

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.norm import square_above
from pwatrack.rational import Rational, floats, is_positive_definite, scalar


def largest_share(slack: Sequence[Rational], U: BallMatrix, V: BallMatrix, gain: Array) -> float:
    """Return ρ ≤ 1 such that S_i − U δ Vᵀ − V δᵀ Uᵀ ≻ 0 for all i and all δ with |δ_jk| ≤ ρ |gain_jk|, proved exactly.

    For any t_jk > 0, U δ Vᵀ + V δᵀ Uᵀ ⪯ ρ R with R = Σ_jk |gain_jk| (t_jk u_j u_jᵀ + v_k v_kᵀ / t_jk): so S_i − ρ R ≻ 0
    is enough. The t_jk make both terms alike where the slack is least.

    Args:
        slack: S_i (n, n), positive definite.
        U, V: (n, a) and (n, b); where they have irrational entries, it is proved for everything in their balls.
        gain: (a, b), as printed.

    Example: −2 (−3 + δ) − 2 > 0 for |δ| < 2, two thirds of 3.

        >>> one = BallMatrix.of([[1]])
        >>> 0.65 < largest_share([4 * one.centre], one, one, np.array([[3.0]])) < 2 / 3
        True
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


def _weights(size: Array, t: Array, *, inverse: bool = False) -> list[Fraction]:
    """Return Σ_k size_jk t_jk, or with 1 / t_jk, for each j, exactly: sizes as printed, t to four bits."""
    mantissa, exponent = np.frexp(t)
    short = np.ldexp(np.round(16 * mantissa), exponent - 4)
    return [
        sum((Fraction(repr(v)) * Fraction(w) ** (-1 if inverse else 1) for v, w in zip(*row, strict=True)), Fraction(0))
        for row in zip(size.tolist(), short.tolist(), strict=True)
    ]
