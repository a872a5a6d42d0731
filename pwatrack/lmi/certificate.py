"""What a solver proposes, decided: proof that a P works.

The proof is made in NumPy with a bound on every rounding error: an
eigenvalue counts as positive only where it exceeds that bound.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from pwatrack.arrays import EPS, Array, readonly, symmetric_part
from pwatrack.lmi.presolve import distinct
from pwatrack.rational import Rational

_LESS = (1e-9, 1e-6, 1e-3)  # of the rate, given up until a margin is left that rounding does not hide


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """A common P ≻ 0 with M_i P + P M_iᵀ + 2 rate P ≺ 0 in every cell.

    Attributes:
        M: The matrices it speaks of, (l, n, n), as used: A_i + B K for (8),
            (A_i + L C)ᵀ for (9), A_ηiᵀ for (17).
        P: (n, n).
        rate: Certified decay rate in 1/s, positive.
        margin: Least eigenvalue over the cells of −(M_i P + P M_iᵀ + 2 rate P), less
            its rounding error, with the states scaled by powers of two to make the
            diagonal of P about 1 (which changes no sign); positive.
        precise: P with more digits, where doubles do not hold what proves it; else None.
    """

    M: Array
    P: Array
    rate: float
    margin: float
    precise: Rational | None = None


def prove(M: Array, P: Array) -> Certificate | None:
    """Return a certificate for the largest rate that this P proves, or None if it proves none.

    Args:
        M: (l, n, n).
        P: A candidate (n, n); only its symmetric part counts.

    Example:
        >>> prove(np.array([[[-1.0]], [[-3.0]]]), np.eye(1)).rate > 0.999
        True
        >>> prove(np.array([[[-1.0]], [[0.0]]]), np.eye(1)) is None
        True
    """
    scaled = _scaled(M, P)
    if scaled is None or not _definite(scaled[1], np.abs(scaled[1])):
        return None
    scaled_M, scaled_P = scaled
    left = symmetric_part(scaled_M @ scaled_P)
    if not np.isfinite(left).all():
        return None
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

    Args:
        M, P: As for `prove`.

    Example: of so ill-conditioned a P only exact numbers can prove anything.

        >>> P = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-13]])
        >>> likely_rate(-np.eye(2)[None], P) > 0, prove(-np.eye(2)[None], P) is None
        (True, True)
    """
    scaled = _scaled(M, P)
    if scaled is None or not np.linalg.eigvalsh(scaled[1])[0] > 0:
        return 0.0
    left = symmetric_part(scaled[0] @ scaled[1])
    try:
        return max(0.0, _rate(left, scaled[1])) if np.isfinite(left).all() else 0.0
    except np.linalg.LinAlgError:  # P is not definite to working precision
        return 0.0


def _scaled(M: Array, P: Array) -> tuple[Array, Array] | None:
    """Return each different M, and P, with states scaled by powers of two so that the diagonal of P is about 1."""
    diagonal = np.diag(P)
    if not (np.isfinite(P).all() and (diagonal > 0).all()):
        return None
    d = 2.0 ** np.round(np.log2(diagonal) / 2)
    return distinct(M)[0] / d[:, None] * d, symmetric_part(P) / 2 / d[:, None] / d


def _rate(left: Array, P: Array) -> float:
    return min(-float(eigh(side, P, eigvals_only=True, check_finite=False)[-1]) / 2 for side in left)


def _definite(X: Array, size: Array) -> bool:
    return _least(X, size) > 0


def _least(X: Array, size: Array) -> float:
    """Return a lower bound of the least eigenvalue of X, computed with entries of magnitude `size`.

    Forming a product of order n errs by at most n eps |·||·| per entry, and the
    symmetric eigenvalue solver by a modest multiple of n eps ‖X‖ (Anderson et
    al., LAPACK Users' Guide, section 4.7): 16 n eps covers both with room.
    """
    n = len(X)
    bound = 16 * n * EPS * float(np.linalg.norm(size + size.T) + np.linalg.norm(X))
    return float(np.linalg.eigvalsh(X)[0]) - bound
