"""Coordinates to hundreds of bits, for problems whose directions doubles cannot tell apart.

Where modes are nearly out of reach T of `Coordinates` is ill-conditioned, and T⁻¹ A T keeps only the digits that its
condition leaves: whether a solver then finds anything is a matter of rounding, which differs from one processor to the
next. Here T is worked out with balls, of which only the middle is kept: what follows is the same everywhere, and in
these coordinates doubles do again. None of it is believed before it is proved.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint
import numpy as np

from pwatrack.arrays import Array
from pwatrack.rational import Rational, floats, rational, working_bits

_BITS = 512  # of all numbers: of a P of condition 1e40 most are left
_MOST_STATES = 20  # up to which it takes a second at most
_STEPS = 80  # Newton's method doubles the distance of eigenvalues from the imaginary axis, and then the digits
_SCALED = 1e-2  # near which a scaling is 1: from there on it converges quadratically
_DOUBLES_DO = 1e6  # condition of a P up to which these coordinates bring nothing


@dataclass(frozen=True)
class Precise:
    """x = T z.

    Attributes:
        T, inverse: T (n, n) and T⁻¹, to working precision.
        P: T Tᵀ, (n, n).
    """

    T: Rational
    inverse: Rational
    P: Rational

    @classmethod
    def of_stable(cls, M: Rational, W: Rational) -> "Precise | None":
        """Return coordinates in which the P of M P + P Mᵀ = −W is I, where doubles do not hold it; else None."""
        with working_bits(_BITS):
            P = _riccati(M.transpose(), 0 * W, W)
            root = None if P is None else _root(P)
            return None if P is None or root is None else cls._of(_middle(root), _middle(root.inv()))

    @classmethod
    def of_regulator(cls, A: Rational, B: Rational, Q: Rational, R: Rational) -> "tuple[Precise, Array] | None":
        """Return coordinates in which the least cost is |z|², where doubles do not hold them, and the gain; else None.

        Args:
            A, B: (n, n) and (n, m).
            Q, R: Weights of ∫(xᵀQx + uᵀRu) dt, (n, n) and (m, m).

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
        with working_bits(_BITS):
            act = R.inv() * B.transpose()
            X = _riccati(A, B * act, Q)
            root = None if X is None else _root(X)
            if X is None or root is None:
                return None
            at = cls._of(_middle(root.inv().transpose()), _middle(root.transpose()))
            return None if at is None else (at, _near(-act * _middle(X)))

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
        return _near(_exact(K) * self.inverse)

    def matrix(self, P: Array) -> Rational:
        """Return the P (n, n) of one in these coordinates."""
        return self.T * _exact(P) * self.T.transpose()


def square(sizes: Array) -> Rational:
    """Return diag(sizes²), (n, n)."""
    root = _exact(np.diag(sizes))
    return root * root


def _near(X: Rational) -> Array:
    """Return the nearest doubles; what is not a number where one is too large for them."""
    try:
        return floats(X)
    except OverflowError:
        return np.full((X.nrows(), X.ncols()), np.nan)


def _exact(X: Array) -> Rational:
    return rational([[Fraction(v) for v in row] for row in X.tolist()], (X.shape[0], X.shape[1]))


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
    """Return the lower triangle L with L Lᵀ = X, to working precision; None where X is not positive definite."""
    n = X.nrows()
    L = [[flint.arb(0)] * n for _ in range(n)]
    for k in range(n):
        for j in range(k, n):
            rest = (X[j, k] - sum((L[j][i] * L[k][i] for i in range(k)), flint.arb(0))).mid()
            if j == k and not rest > 0:
                return None
            L[j][k] = (rest.sqrt() if j == k else rest / L[k][k]).mid()
    return flint.arb_mat(L)


def _middle(X: Any) -> Rational:
    """Return the middle of balls."""
    parts = [v.mid().man_exp() for v in X.entries()]
    return flint.fmpq_mat(X.nrows(), X.ncols(), [flint.fmpq(man) * flint.fmpq(2) ** int(exp) for man, exp in parts])
