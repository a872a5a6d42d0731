"""The norm that a proof speaks of, and how large a matrix is from one such norm to another, proved exactly."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.linalg import eigh

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.exact import Proof, unsure
from pwatrack.rational import Rational, floats, identity, is_positive_definite, rational


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
        n, squares = len(sizes), [1 / Fraction(size) ** 2 for size in sizes.tolist()]
        return cls(rational([[squares[j] if j == k else Fraction(0) for k in range(n)] for j in range(n)], (n, n)))

    @classmethod
    def of(cls, proof: Proof) -> "Norm":
        """Return the norm in which a proof says that errors shrink: Q = P⁻¹ for (8), Q = P for (9) and (17).

        From M P + P Mᵀ ⪯ −2αP follows QM + MᵀQ ⪯ −2αQ for Q = P⁻¹; (9) and (17) are stated for M = Aᵀ.
        """
        P = proof.P
        return cls(P if proof.role.transposed else P.inv())

    def __call__(self, vector: Array) -> float:
        """Return ‖vector‖, rounded up.

        Example:
            >>> 5.0 <= Norm.euclidean(2)(np.array([3.0, 4.0])) < 5.0 + 1e-14
            True
        """
        column = rational([[Fraction(float(v))] for v in vector], (len(vector), 1))
        return root_above((column.transpose() * self.Q * column)[0, 0])


def largest_gain(X: Rational, of: Norm, to: Norm) -> float:
    """Return c with ‖X d‖_to ≤ c ‖d‖_of for every d, a little above the least: c² Q_of − Xᵀ Q_to X ≻ 0 is proved.

    Args:
        X: An exact matrix, (k, n).
        of: The norm of d (n,).
        to: The norm of X d (k,).

    Example:
        >>> from pwatrack.rational import decimals
        >>> 4.0 < largest_gain(decimals(np.diag([3.0, 4.0])), Norm.euclidean(2), Norm.euclidean(2)) < 4.0 + 1e-8
        True
    """
    size = X.transpose() * to.Q * X
    if not any(size.entries()):
        return 0.0
    c, grow = _estimate(size, of.Q), 1e-9
    while not is_positive_definite(_square(c * (1 + grow)) * of.Q - size):
        grow *= 10  # the estimate was off by its rounding
    return c * (1 + grow)


def square_above(U: BallMatrix, weights: Sequence[Fraction], unit: Sequence[Fraction]) -> Rational:
    """Return U diag(weights) Uᵀ, or an exact matrix above it for every U in the ball.

    Args:
        U: (n, k).
        weights: k numbers, none negative.
        unit: n sizes, for the diagonal that is added; see `unsure`.
    """
    k = len(weights)
    diagonal = rational([[w if j == i else Fraction(0) for i in range(k)] for j, w in enumerate(weights)], (k, k))
    square = U @ BallMatrix(diagonal) @ U.transpose()
    return square.centre + unsure(square.radius, identity(len(unit)), unit)  # twice what is needed


def _estimate(size: Rational, Q: Rational) -> float:
    """Return about the root of the largest eigenvalue of Q⁻¹ size, not far below it."""
    n, S, W = Q.nrows(), floats(size), floats(Q)
    d = np.sqrt(np.diag(W))
    try:
        largest = float(eigh(S / d[:, None] / d, W / d[:, None] / d, eigvals_only=True)[-1])
    except np.linalg.LinAlgError:  # too ill-conditioned for floats: the trace is above it, at most n times
        largest = 0.0
    trace = float(np.trace(floats(Q.inv() * size)))
    return float(np.sqrt(largest if trace / (2 * n) <= largest <= trace else trace))


def _square(value: float) -> Any:
    """Return the exact square."""
    return rational([[Fraction(value) ** 2]], (1, 1))[0, 0]


def root_above(value: Any) -> float:
    """Return a float just above the root of a rational number.

    Example: numbers whose squares are no floats.

        >>> [root_above(rational([[Fraction(10) ** k]], (1, 1))[0, 0]) for k in (-600, 0, 600)]
        [1e-300, 1.0, 1e+300]
    """
    exact = Fraction(int(value.p), int(value.q))
    shift = (exact.denominator.bit_length() - exact.numerator.bit_length()) // 2  # keeps floats away from their limits
    root = float(np.ldexp(np.sqrt(float(exact * Fraction(4) ** shift)), -shift))
    while Fraction(root) ** 2 < exact:
        root = float(np.nextafter(root, np.inf))
    return root
