"""What is done to a problem before a solver sees it: exact scaling, removal of repeated cells."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array, IntArray, balancing

_MOST = 250.0  # of an exponent of a scale: products of a few of them are finite, and so are their inverses


@dataclass(frozen=True, kw_only=True)
class Scaling:
    """x = D x', u = E u', t = t' / speed, all powers of two, hence exact.

    Attributes:
        d: Diagonal of D, (n,).
        e: Diagonal of E, (m,).
        speed: In 1/s.
    """

    d: Array
    e: Array
    speed: float

    @classmethod
    def of(cls, A: Array, B: Array) -> "Scaling":
        """Return the scaling that balances A (l, n, n) and gives A and the columns of B (n, m) size 1."""
        d = np.clip(balancing(A), 2.0**-_MOST, 2.0**_MOST)
        speed = _power_of_two(np.linalg.norm(A / d[:, None] * d, 2, axis=(1, 2)).max(initial=0.0))
        columns = np.linalg.norm(B / d[:, None] / speed, axis=0)
        return cls(d=d, e=np.array([1 / _power_of_two(c) for c in columns]), speed=speed)

    def system(self, A: Array) -> Array:
        """Return A (l, n, n) in scaled coordinates."""
        result: Array = A / self.d[:, None] * self.d / self.speed
        return result

    def input(self, B: Array) -> Array:
        """Return B (n, m) in scaled coordinates."""
        result: Array = B / self.d[:, None] * self.e / self.speed
        return result

    def gain(self, K: Array) -> Array:
        """Return the gain (m, n) in the given coordinates of a gain in scaled ones."""
        result: Array = self.e[:, None] * K / self.d
        return result

    def matrix(self, P: Array) -> Array:
        """Return P (n, n) of (8) in the given coordinates."""
        result: Array = self.d[:, None] * P * self.d
        return result


def distinct(A: Array) -> tuple[Array, IntArray]:
    """Return the different matrices of a stack (l, n, n) and the place of each original among them.

    Equal matrices give equal inequalities: with k2 = k3 two cells of the paper's example are one.

    Example:
        >>> matrices, place = distinct(np.array([[[1.0]], [[2.0]], [[1.0]]]))
        >>> matrices.ravel().tolist(), place.tolist()
        ([1.0, 2.0], [0, 1, 0])
    """
    matrices, place = np.unique(A, axis=0, return_inverse=True)
    return matrices, place.ravel()


def centre(P: Array) -> tuple[Array, Array]:
    """Return V (n, n) and its inverse such that P ≻ 0 becomes a multiple of I in z with x = V z.

    A solver is most exact where its answer is near I, so a hard problem is solved once more
    in the coordinates of its first answer.

    Raises:
        numpy.linalg.LinAlgError: If P is not positive definite to working precision.

    Example:
        >>> V, inverse = centre(np.diag([4.0, 1.0]))
        >>> (V @ V.T).tolist(), (V @ inverse).tolist()
        ([[1.0, 0.0], [0.0, 0.25]], [[1.0, 0.0], [0.0, 1.0]])
    """
    values, vectors = np.linalg.eigh((P + P.T) / 2)
    if not values[0] > 1e-14 * values[-1]:
        raise np.linalg.LinAlgError("P is not positive definite")
    root = np.sqrt(values / values[-1])
    V: Array = vectors * root
    inverse: Array = (vectors / root).T
    return V, inverse


def _power_of_two(value: float) -> float:
    return float(2.0 ** np.clip(np.round(np.log2(value)), -_MOST, _MOST)) if value > 0 else 1.0
