"""Coordinates in which an inequality is solved: a solver is most exact where all matrices, and P, have size 1."""

import warnings
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov

from pwatrack.arrays import Array, balancing

_MOST = 250.0  # of an exponent of a scale: products of a few of them are finite, and so are their inverses
_DEFINITE = 1e-14  # of the largest eigenvalue of P, above which the least one can be told from 0


@dataclass(frozen=True, kw_only=True)
class Coordinates:
    """x = T z, u = E v and t = τ / speed, for the inequality A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ + W ⪯ 0.

    Attributes:
        T, inverse: T (n, n) and T⁻¹.
        e: Diagonal of E, (m,).
        speed: In 1/s.

    Example: what is asked of the one is asked of the other.

        >>> A, B = np.array([[[0.0, 1e6], [-1.0, 0.0]]]), np.array([[0.0], [1e3]])
        >>> at = Coordinates.balanced(A, B)
        >>> float(np.abs(at.system(A)).max()), float(np.abs(at.input(B)).max())
        (1.0, 0.9765625)
        >>> K = np.array([[3.0, 4.0]])
        >>> bool(np.allclose(at.system(A + B @ at.gain(K)), at.system(A) + at.input(B) @ K))
        True
    """

    T: Array
    inverse: Array
    e: Array
    speed: float

    @classmethod
    def balanced(cls, A: Array, B: Array | None = None) -> "Coordinates":
        """Return those that balance A (l, n, n) and give A and the columns of B (n, m) size 1.

        All scales are powers of two, so T is diagonal and nothing is rounded.
        """
        n = A.shape[1]
        B = np.zeros((n, 0)) if B is None else B
        d = np.clip(balancing(A), 2.0**-_MOST, 2.0**_MOST)
        speed = _power_of_two(np.linalg.norm(A / d[:, None] * d, 2, axis=(1, 2)).max(initial=0.0))
        columns = np.linalg.norm(B / d[:, None] / speed, axis=0)
        e = np.array([1 / _power_of_two(c) for c in columns])
        return cls(T=np.diag(d), inverse=np.diag(1 / d), e=e, speed=speed)

    @classmethod
    def sized(cls, A: Array, states: Array, inputs: Array | None = None, *, tempo: float = 1.0) -> "Coordinates":
        """Return those in which states and inputs are counted in sizes, and A (l, n, n) has size 1.

        There a problem has the same numbers in all units, so that a solver answers the same.

        Args:
            A: (l, n, n).
            states, inputs: Sizes (n,) and (m,); no inputs by default.
            tempo: The speed in 1/s where A is 0.

        Example:
            >>> at = Coordinates.sized(np.array([[[0.0, 1.0], [-1.0, 0.0]]]), np.array([0.1, 2.0]), np.array([5.0]))
            >>> at.speed, at.gain(np.ones((1, 2))).tolist()
            (20.0, [[50.0, 2.5]])
        """
        speed = float(np.linalg.norm(A / states[:, None] * states, 2, axis=(1, 2)).max(initial=0.0))
        speed = speed if 0 < speed < np.inf else tempo
        e = np.zeros(0) if inputs is None else np.asarray(inputs)
        return cls(T=np.diag(states), inverse=np.diag(1 / states), e=e, speed=speed)

    def system(self, A: Array) -> Array:
        """Return A (l, n, n), or the shift of a rate (n, n), in these coordinates."""
        return np.asarray(self.inverse @ A @ self.T / self.speed)

    def input(self, B: Array) -> Array:
        """Return B (n, m) in these coordinates."""
        return np.asarray(self.inverse @ B * self.e / self.speed)

    def driven(self, W: Array) -> Array:
        """Return W (n, n), and with time as it is P, in these coordinates."""
        return np.asarray(self.inverse @ W @ self.inverse.T)

    def weights(self, Q: Array) -> Array:
        """Return the weights of zᵀ(·)z that xᵀQx has."""
        return np.asarray(self.T.T @ Q @ self.T)

    def rows(self, X: Array) -> Array:
        """Return rows (k, n) that read x as ones that read z."""
        return np.asarray(X @ self.T)

    def states(self, V: Array) -> Array:
        """Return states x, the rows of V (k, n), as states z."""
        return np.asarray(V @ self.inverse.T)

    def gain(self, K: Array) -> Array:
        """Return the gain u = K x (m, n) of one in these coordinates."""
        return np.asarray(self.e[:, None] * K @ self.inverse)

    def matrix(self, P: Array) -> Array:
        """Return the P (n, n) of (8) of one in these coordinates."""
        return np.asarray(self.T @ P @ self.T.T)

    def centred(self, P: Array) -> "Coordinates":
        """Return coordinates in which P ≻ 0, a matrix in these ones, is a multiple of I; these where it is not ≻ 0.

        Example:
            >>> at = Coordinates.balanced(-np.eye(2)[None])
            >>> at.centred(np.diag([4.0, 1.0])).driven(np.diag([4.0, 1.0])).tolist()
            [[4.0, 0.0], [0.0, 4.0]]
        """
        try:
            values, vectors = np.linalg.eigh((P + P.T) / 2)
        except np.linalg.LinAlgError:  # an entry is not finite
            return self
        return self._along(vectors, values / values[-1])

    def of_mean(self, M: Array, W: Array | None = None) -> "Coordinates":
        """Return those in which the P of the mean of the cells, M̄ P + P M̄ᵀ = −W, is a multiple of I.

        Args:
            M: (l, n, n), in these coordinates.
            W: (n, n), in these coordinates; I by default.
        """
        mean = M.mean(axis=0)
        if not np.isfinite(mean).all() or np.linalg.eigvals(mean).real.max(initial=-1.0) >= 0:
            return self
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # nearly singular: coordinates that are not exact are still coordinates
            return self.centred(solve_continuous_lyapunov(mean, -np.eye(len(mean)) if W is None else -W))

    def of_regulator(self, A: Array, B: Array, Q: Array | None = None, R: Array | None = None) -> "Coordinates":
        """Return those in which the least cost of the mean of the cells is |z|²: there the P of (8) is near I.

        Args:
            A: (l, n, n), in these coordinates.
            B: (n, m), the same.
            Q, R: Weights (n, n) and (m, m) of ∫(zᵀQz + vᵀRv) dt; I by default.
        """
        Q, R = (np.eye(k) if X is None else X for X, k in ((Q, len(B)), (R, B.shape[1])))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                values, vectors = np.linalg.eigh(solve_continuous_are(A.mean(axis=0), B, Q, R))
        except (np.linalg.LinAlgError, ValueError):
            return self
        return self._along(vectors[:, ::-1], 1 / values[::-1]) if values[0] > 0 else self

    def _along(self, axes: Array, squares: Array) -> "Coordinates":
        """Stretch axes, orthonormal columns (n, n), by the roots of their squares, of which the last is the largest."""
        if not squares[0] > _DEFINITE * squares[-1]:
            return self
        root = np.sqrt(squares)
        return replace(self, T=self.T @ (axes * root), inverse=(axes / root).T @ self.inverse)


def _power_of_two(value: float) -> float:
    return float(2.0 ** np.clip(np.round(np.log2(value)), -_MOST, _MOST)) if value > 0 else 1.0
