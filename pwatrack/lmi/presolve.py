"""What is done to a problem before a solver sees it: cells that say nothing of their own leave it, coordinates fit it.

The inequalities are affine in A_i: what holds at A_1 and A_2 holds between them. So only the corners of the convex hull
of the cells are solved for. A solver is most exact where all matrices, and P, have size 1. Where modes are nearly out
of reach T of `Coordinates` is ill-conditioned: for `Precise` it is worked out with balls, of which only the middle is
kept, and doubles do again, the same on every processor. Proofs are about every cell.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import flint
import numpy as np
import scipy
from scipy.linalg import qr, solve_continuous_are, solve_continuous_lyapunov

from pwatrack.arrays import Array, IntArray, balancing
from pwatrack.rational import Rational, doubles, floats, middle

_ROUNDING = 1e-9  # of the largest entry of a column of numbers: what is nearer than that is called equal
_HULLS = range(2, 5)  # dimensions in which all corners are found, in little time
_MOST = 250.0  # of an exponent of a scale: products of a few of them are finite, and so are their inverses
_DEFINITE = 1e-14  # of the largest eigenvalue of P, above which the least one can be told from 0
_BITS = 512  # of all numbers: of a P of condition 1e40 most are left
_MOST_STATES = 20  # up to which it takes a second at most
_STEPS = 80  # Newton's method doubles the distance of eigenvalues from the imaginary axis, and then the digits
_SCALED = 1e-2  # near which a scaling is 1: from there on it converges quadratically
_DOUBLES_DO = 1e6  # condition of a P up to which these coordinates bring nothing


def distinct(A: Array) -> tuple[Array, IntArray]:
    """Return the different matrices of a stack (l, n, n) and the place of each original among them.

    Equal matrices give equal inequalities: with k2 = k3 two cells of the paper's example are one.
    """
    seen: dict[bytes, int] = {}
    first = [seen.setdefault(row.tobytes(), len(seen)) for row in A + 0.0]  # −0 + 0 = 0
    positions = np.unique(first, return_index=True)[1]
    matrices, order = np.unique(A[positions], axis=0, return_inverse=True)  # few by now: to sort many takes long
    return matrices, order.ravel()[first]


def corners(A: Array) -> IntArray:
    """Return the places of cells (l, n, n), each different, whose convex hull holds all others, to rounding.

    Example: a dead zone whose sides have two slopes has a cell between them; a box has its corners.

        >>> corners(np.array([[[1.0]], [[3.0]], [[2.0]], [[1.0]]])).tolist()
        [0, 1]
        >>> box = np.array([np.diag([s, t]) for s in (1.0, 4.0, 2.0) for t in (1.0, 2.0, 3.0)])
        >>> corners(box).tolist()
        [0, 2, 3, 5]
    """
    kept = np.sort(np.unique(distinct(A)[1], return_index=True)[1])
    points = _coordinates(A[kept].reshape(len(kept), -1))
    for axis in range(points.shape[1]):  # who is between two others on a line along an axis is no corner
        chosen = _ends(points, axis)
        kept, points = kept[chosen], points[chosen]
    if points.shape[1] in _HULLS and len(points) > 2 ** points.shape[1]:
        try:
            kept = kept[np.sort(scipy.spatial.ConvexHull(points).vertices)]
        except scipy.spatial.QhullError:  # the points are too flat for it
            return kept
    return kept


def extreme(A: Array) -> Array:
    """Return the corners themselves, in an order that does not depend on that of the cells."""
    return distinct(A[corners(A)])[0]


def _coordinates(points: Array) -> Array:
    """Return some columns of the points (l, k), shifted and scaled, of which all others are affine functions."""
    centred = points - points[0]
    sizes = np.abs(centred).max(axis=0)
    centred = centred[:, sizes > 0] / sizes[sizes > 0]
    if not centred.size:
        return np.zeros((len(points), 0))
    R, order = qr(centred, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(R))
    return np.asarray(centred[:, np.sort(order[: int((diagonal > _ROUNDING * diagonal[0]).sum())])])


def _ends(points: Array, axis: int) -> IntArray:
    """Return the places of the first and the last point on each line along an axis."""
    whole = np.round(points / _ROUNDING).astype(np.int64)
    lines = np.unique(np.delete(whole, axis, axis=1), axis=0, return_inverse=True)[1].ravel()
    order = np.lexsort([points[:, axis], lines])
    starts = np.flatnonzero(np.diff(lines[order], prepend=-1))
    ends = np.append(starts[1:], len(order)) - 1
    return np.unique(order[np.concatenate([starts, ends])])


@dataclass(frozen=True, kw_only=True)
class Coordinates:
    """x = T z, u = E v and t = τ / speed, for the inequality A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ + W ⪯ 0."""

    T: Array  # (n, n)
    inverse: Array  # T⁻¹
    e: Array  # diagonal of E, (m,)
    speed: float  # in 1/s

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

        There a problem has the same numbers in all units, so that a solver answers the same. Where A is 0 the tempo
        (1/s) is its speed.
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
        """Return those in which the P of the mean of the cells, M̄ P + P M̄ᵀ = −W, is a multiple of I; W = I by default.

        M (l, n, n) and W are in these coordinates.
        """
        mean = M.mean(axis=0)
        if not np.isfinite(mean).all() or np.linalg.eigvals(mean).real.max(initial=-1.0) >= 0:
            return self
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # nearly singular: coordinates that are not exact are still coordinates
            return self.centred(solve_continuous_lyapunov(mean, -np.eye(len(mean)) if W is None else -W))

    def of_regulator(self, A: Array, B: Array, Q: Array | None = None, R: Array | None = None) -> "Coordinates":
        """Return those in which the least cost of the mean of the cells is |z|²: there the P of (8) is near I.

        A (l, n, n), B and the weights of ∫(zᵀQz + vᵀRv) dt, I by default, are in these coordinates.
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


@dataclass(frozen=True)
class Precise:
    """x = T z."""

    T: Rational  # (n, n), to working precision, as T⁻¹
    inverse: Rational
    P: Rational  # T Tᵀ, (n, n)

    @classmethod
    def of_stable(cls, M: Rational, W: Rational) -> "Precise | None":
        """Return coordinates in which the P of M P + P Mᵀ = −W is I, where doubles do not hold it; else None."""
        with flint.ctx.workprec(_BITS):
            root = _root(_riccati(M.transpose(), 0 * W, W))
            return None if root is None else cls._of(middle(root), middle(root.inv()))

    @classmethod
    def of_regulator(cls, A: Rational, B: Rational, Q: Rational, R: Rational) -> "tuple[Precise, Array] | None":
        """Return where the least ∫(xᵀQx + uᵀRu) dt is |z|², if doubles do not hold it, and the gain; else None.

        Example: an input that hardly tells two unstable modes apart.

            >>> from pwatrack.rational import decimals
            >>> A, B = decimals(np.diag([1.0, 1.00001])), decimals(np.ones((2, 1)))
            >>> found = Precise.of_regulator(A, B, decimals(np.eye(2)), decimals(np.eye(1)))
            >>> at, K = found
            >>> bool(np.abs(at.system([A + B * decimals(K)])).max() < 5)
            True
            >>> Precise.of_regulator(A, decimals(np.eye(2)), decimals(np.eye(2)), decimals(np.eye(2))) is None
            True
        """
        with flint.ctx.workprec(_BITS):
            act = R.inv() * B.transpose()
            X = _riccati(A, B * act, Q)
            root = _root(X)
            if root is None:
                return None
            at = cls._of(middle(root.inv().transpose()), middle(root.transpose()))
            return None if at is None else (at, _near(-act * middle(X)))

    @classmethod
    def _of(cls, T: Rational, inverse: Rational) -> "Precise | None":
        P = T * T.transpose()
        near = _near(P)
        return None if np.isfinite(near).all() and np.linalg.cond(near) < _DOUBLES_DO else cls(T, inverse, P)

    def system(self, M: Sequence[Rational]) -> Array:
        """Return matrices M_i in these coordinates, as doubles (l, n, n)."""
        return np.array([_near(self.inverse * M_i * self.T) for M_i in M])

    def input(self, B: Rational) -> Array:
        """Return B (n, m) in these coordinates."""
        return _near(self.inverse * B)

    def gain(self, K: Array) -> Array:
        """Return the gain u = K x (m, n) of one in these coordinates."""
        return _near(doubles(K) * self.inverse)

    def matrix(self, P: Array) -> Rational:
        """Return the P (n, n) of one in these coordinates."""
        return self.T * doubles(P) * self.T.transpose()


def square(sizes: Array) -> Rational:
    """Return diag(sizes²), (n, n)."""
    root = doubles(np.diag(sizes))
    return root * root


def _near(X: Rational) -> Array:
    """Return the nearest doubles; what is not a number where one is too large for them."""
    try:
        return floats(X)
    except OverflowError:
        return np.full((X.nrows(), X.ncols()), np.nan)


def _riccati(A: Rational, G: Rational, Q: Rational) -> Any:
    """Return X with AᵀX + X A − X G X + Q = 0 that makes A − G X stable, to working precision; None where none is seen.

    The columns of [I; X] span the stable subspace of H = [A, −G; −Q, −Aᵀ], which is that of its sign: Newton's method
    for Z² = I from H leads there (Roberts, Linear model reduction and solution of the algebraic Riccati equation by
    use of the sign function, Int. J. Control 32, 1980).
    """
    n = A.nrows()
    if n > _MOST_STATES:
        return None
    rows = [[*a, *(-g for g in row)] for a, row in zip(A.tolist(), G.tolist(), strict=True)]
    rows += [[*(-q for q in row), *(-a for a in b)] for row, b in zip(Q.tolist(), A.transpose().tolist(), strict=True)]
    Z, limit = flint.arb_mat(flint.fmpq_mat(rows)).mid(), flint.arb(2) ** (-_BITS // 2)
    try:
        for _ in range(_STEPS):
            inverse = Z.inv().mid()
            scale = (_size(inverse) / _size(Z)).sqrt().mid()
            scale = flint.arb(1) if abs(scale - 1) < _SCALED else scale
            before, Z = Z, ((Z * scale + inverse * (1 / scale)) * flint.arb(0.5)).mid()
            if _size(Z - before) < limit * _size(Z):
                break
        top = flint.arb_mat(n, n, [int(j == k) - Z[j, k] for j in range(n) for k in range(n)]).mid()
        below = flint.arb_mat(n, n, [-Z[n + j, k] for j in range(n) for k in range(n)]).mid()
        X = (below * top.inv()).mid()
    except ZeroDivisionError:  # an eigenvalue on the axis
        return None
    return ((X + X.transpose()) * flint.arb(0.5)).mid()


def _size(X: Any) -> Any:
    return sum((abs(v) for v in X.entries()), flint.arb(0)).mid()


def _root(X: Any) -> Any:
    """Return the lower triangle L with L Lᵀ = X, to working precision; None where X is None, or not ≻ 0."""
    n = 0 if X is None else X.nrows()
    L = [[flint.arb(0)] * n for _ in range(n)]
    for k in range(n):
        for j in range(k, n):
            rest = (X[j, k] - sum((L[j][i] * L[k][i] for i in range(k)), flint.arb(0))).mid()
            if j == k and not rest > 0:
                return None
            L[j][k] = (rest.sqrt() if j == k else rest / L[k][k]).mid()
    return flint.arb_mat(L) if n else None
