"""How a proof measures errors: between which norms that lies, and how fast a disturbance makes it grow."""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.exact import Proof
from pwatrack.lmi.exact_polynomial import AnyProof, PolynomialProof
from pwatrack.lmi.norm import Norm
from pwatrack.rational import Rational, floats, is_positive_definite, rational

_ABOVE = Fraction(1) + Fraction(1, 10**9)  # more than the rounding of a power


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

            >>> from pwatrack.lmi.role import OBSERVER
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
        d, (low, high) = proof.degree // 2, _limits(proof)
        T = BallMatrix.of(proof.T).centre
        square = T.transpose() * T
        return cls(
            above=Norm(_times(square, high ** (1 / d), up=True)),
            below=Norm(_times(square, low ** (1 / d), up=False)),
            driven=Norm(_times(square, high / low ** ((d - 1) / d), up=True)),
        )


def _limits(proof: PolynomialProof) -> tuple[float, float]:
    """Return λ and Λ with λ |z|^2d ≤ mᵀ P m ≤ Λ |z|^2d, proved exactly."""
    monomials, P = proof.monomials, proof.P
    scale = 1 / monomials.weights
    values = np.linalg.eigvalsh(floats(P) * scale[:, None] * scale)
    length = [Fraction(square) for square in monomials.squares]
    low = _proved(values[0], 0.5, lambda value: is_positive_definite(P - _diagonal(length, value)))
    high = _proved(values[-1], 2.0, lambda value: is_positive_definite(_diagonal(length, value) - P))
    return low, high


def _proved(estimate: float, factor: float, holds: Callable[[float], bool]) -> float:
    """Return a number near an estimate for which something is proved, further and further away by a factor."""
    value = max(estimate, np.finfo(float).tiny) * (1 - 1e-6 if factor < 1 else 1 + 1e-6)
    while not holds(value):
        value *= factor
    return float(value)


def _diagonal(squares: list[Fraction], value: float) -> Rational:
    n = len(squares)
    rows = [[squares[j] * Fraction(value) if j == k else Fraction(0) for k in range(n)] for j in range(n)]
    return rational(rows, (n, n))


def _times(X: Rational, factor: float, *, up: bool) -> Any:
    """Return X times a number, rounded to the safe side."""
    exact = Fraction(factor) * _ABOVE if up else Fraction(factor) / _ABOVE
    return X * rational([[exact]], (1, 1))[0, 0]
