"""The norm that a proof speaks of, and how large a matrix is from one such norm to another, proved exactly."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.linalg import eigh

from pwatrack.arrays import Array
from pwatrack.lmi.exact import Proof, positive_definite, to_float, to_fmpq, to_matrix, unpacked


@dataclass(frozen=True)
class Norm:
    """‖e‖ = √(eᵀ Q e) with an exact Q ≻ 0, FLINT's rational matrix of order n."""

    Q: Any

    @classmethod
    def euclidean(cls, n: int) -> "Norm":
        """Return the norm with Q = I: the length of a vector in the units given."""
        return cls(to_matrix([[Fraction(int(j == k)) for k in range(n)] for j in range(n)]))

    @classmethod
    def of(cls, proof: Proof) -> "Norm":
        """Return the norm in which a proof says that errors shrink: Q = P⁻¹ for (8), Q = P for (9) and (17).

        From M P + P Mᵀ ⪯ −2αP follows QM + MᵀQ ⪯ −2αQ for Q = P⁻¹; (9) and (17) are stated for M = Aᵀ.
        """
        P = to_matrix(unpacked(proof.integers, proof.exponents))
        return cls(P.inv() if proof.of == "controller" else P)

    def __call__(self, vector: Array) -> float:
        """Return ‖vector‖, rounded up.

        Example:
            >>> 5.0 <= Norm.euclidean(2)(np.array([3.0, 4.0])) < 5.0 + 1e-14
            True
        """
        column = to_matrix([[Fraction(float(v))] for v in vector])
        return _root_above((column.transpose() * self.Q * column)[0, 0])


def largest_gain(X: Sequence[Sequence[Fraction]], of: Norm, to: Norm) -> float:
    """Return c with ‖X d‖_to ≤ c ‖d‖_of for every d, a little above the least: c² Q_of − Xᵀ Q_to X ≻ 0 is proved.

    Args:
        X: An exact matrix, (k, n).
        of: The norm of d (n,).
        to: The norm of X d (k,).

    Example:
        >>> X = [[Fraction(3), Fraction(0)], [Fraction(0), Fraction(4)]]
        >>> 4.0 < largest_gain(X, Norm.euclidean(2), Norm.euclidean(2)) < 4.0 + 1e-8
        True
    """
    exact_X = to_matrix(X)
    size = exact_X.transpose() * to.Q * exact_X
    if not any(v != 0 for row in size.tolist() for v in row):
        return 0.0
    c, grow = _estimate(size, of.Q), 1e-9
    while not positive_definite(to_fmpq(Fraction(c * (1 + grow)) ** 2) * of.Q - size):
        grow *= 10  # the estimate was off by its rounding
    return c * (1 + grow)


def _estimate(size: Any, Q: Any) -> float:
    """Return about the root of the largest eigenvalue of Q⁻¹ size, not far below it."""
    n = Q.nrows()
    S, W = (np.array([[to_float(X[j, k]) for k in range(n)] for j in range(n)]) for X in (size, Q))
    d = np.sqrt(np.diag(W))
    try:
        largest = float(eigh(S / d[:, None] / d, W / d[:, None] / d, eigvals_only=True)[-1])
    except np.linalg.LinAlgError:  # too ill-conditioned for floats: the trace is above it, at most n times
        largest = 0.0
    trace = sum(to_float(v) for v in np.diag(np.array((Q.inv() * size).tolist(), dtype=object)))
    return float(np.sqrt(largest if trace / (2 * n) <= largest <= trace else trace))


def _root_above(value: Any) -> float:
    """Return a float just above the root of a rational number."""
    exact = Fraction(int(value.p), int(value.q))
    root = float(np.sqrt(float(exact)))
    while Fraction(root) ** 2 < exact:
        root = float(np.nextafter(root, np.inf))
    return root
