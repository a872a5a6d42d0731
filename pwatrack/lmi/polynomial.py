"""Polynomials that decay along every switching: sought where no quadratic form does.

Let e' = A(t) e with A(t) in the convex hull of matrices A_i, and let m hold the monomials of degree d of z = T e; their
lifts 𝒜_i are those of T A_i T⁻¹ (see `monomials`). If there are P ≻ 0 and N_i with

    sym(P 𝒜_i) + N_i + 2 d α P ≺ 0   and   mᵀ N_i m = 0 for all z,

then V = mᵀ P m has V > 0 and V' < −2 d α V for all e ≠ 0. *Proof.* V > 0 since P ≻ 0 and m = 0 for z = 0 only. At
A = Σ λ_i A_i the lift is Σ λ_i 𝒜_i, as it is linear in A; so V' = mᵀ sym(P 𝒜) m = Σ λ_i mᵀ (sym(P 𝒜_i) + N_i) m, which
is below −2 d α mᵀ P m. ∎ Hence V(t) ≤ V(0) e^(−2dαt). V^(1/2d) is homogeneous of degree 1 and positive, so it lies
between two multiples of |e|, and |e| falls as e^(−αt).

With a disturbance, e' = A(t) e + w, V' ≤ −2 d α V + |∇V| |w|. ∇V is homogeneous of degree 2d − 1, so |∇V| is at most
c V^((2d−1)/2d), and W = V^(1/2d) has W' ≤ −α W + c/(2d) |w|: errors stay bounded while w does, and go to 0 with it.
That is what Theorems 2 and 3 use of (8), (9) and (17), and all they use: the difference of two solutions of a
continuous piecewise affine system obeys such an e' = A(t) e + w.

For d = 1 there is no N but 0, and these are the inequalities of the paper. A term N_0 beside P would add nothing:
P + N_0 has the same V, and the difference in sym(P 𝒜_i) is half of d/dt mᵀ N_0 m = 0.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from pwatrack.arrays import Array, symmetric_part
from pwatrack.lmi.coordinates import Coordinates
from pwatrack.lmi.monomials import Monomials, symmetric_of, upper
from pwatrack.lmi.solve import semidefinite

DEGREES = (4, 6, 8, 10)  # that are tried
MOST_ROWS = 1200  # of a program: one takes half a second then, its time grows as their cube
TRIALS = 8  # rates that are tried
_ENCLOSED = 1e-2  # of a rate that is out of reach: where the best one is that near, the search ends
_DIGITS = 12  # binary, of the coordinates


@dataclass(frozen=True, kw_only=True)
class Polynomial:
    """P and N_i in floating point, for the monomials in weights of z = T e.

    Attributes:
        A: The matrices by which errors change, (l, n, n).
        degree: 2 d.
        T: (n, n), of short binary numbers.
        P: (N, N).
        N: One for each matrix, (l, N, N).
        rate: α in 1/s that they show, positive.
    """

    A: Array
    degree: int
    T: Array
    P: Array
    N: Array
    rate: float

    @property
    def monomials(self) -> Monomials:
        """Those of half the degree."""
        return Monomials.of(len(self.T), self.degree // 2)


def degrees(n: int, cells: int, most_rows: int = MOST_ROWS) -> tuple[int, ...]:
    """Return the degrees that are tried for so many different matrices of order n: those of programs small enough.

    Args:
        n, cells: Order and number of the matrices.
        most_rows: Of a program.

    Example:
        >>> degrees(2, 2), degrees(4, 3), degrees(12, 3)
        ((4, 6, 8, 10), (4, 6), ())
    """
    return tuple(degree for degree in DEGREES if n > 1 and _rows(n, degree, cells) <= most_rows)


def best_polynomial(A: Array, degree: int, near: Coordinates, *, trials: int = TRIALS) -> Polynomial | None:
    """Look for a polynomial of one degree with the largest rate.

    Args:
        A: The matrices by which errors change, (l, n, n), each different and each stable by itself.
        degree: 2 d.
        near: Coordinates in which the P of M_i P + P M_iᵀ ≺ 0 for M_i = A_iᵀ is near I.
        trials: So many rates are tried; the first of them is 0.

    Example: a pair that no quadratic form serves, the example's zero dynamics with k2 = 1.

        >>> A = np.array([[[0.0, 1.0], [-1.0, -0.3]], [[0.0, 1.0], [-2.0, -0.3]]])
        >>> near = Coordinates.balanced(A.swapaxes(1, 2))
        >>> best_polynomial(A, 2, near) is None, best_polynomial(A, 4, near).rate > 0
        (True, True)
    """
    T = short(near.T.T)
    with np.errstate(all="ignore"):
        G = T @ A @ np.linalg.inv(T)
    speed = float(np.linalg.norm(G, 2, axis=(1, 2)).max()) if np.isfinite(G).all() else 0.0
    if not 0 < speed < np.inf:
        return None
    sought = _Sought(G / speed, Monomials.of(A.shape[1], degree // 2))
    slow, fast, best = 0.0, -float(np.linalg.eigvals(A).real.max()) / speed, None
    for trial in range(trials):
        found = sought.at((slow + fast) / 2 if trial else 0.0)
        if found is None and best is None:
            return None
        if found is None:
            fast = (slow + fast) / 2
        else:
            best, slow = found, found[2]
        if fast - slow <= _ENCLOSED * fast:
            break
    assert best is not None
    P, N, rate = best
    return Polynomial(A=A, degree=degree, T=T, P=P, N=N * speed, rate=rate * speed)


def short(X: Array) -> Array:
    """Return a matrix with entries of few binary digits."""
    fraction, exponent = np.frexp(X)
    return np.asarray(np.ldexp(np.round(np.ldexp(fraction, _DIGITS)), exponent - _DIGITS))


def _rows(n: int, degree: int, cells: int) -> int:
    """Return how many rows the program has."""
    N = len(Monomials.of(n, degree // 2))
    return (cells + 2) * N * (N + 1) // 2


class _Sought:
    """The programs of one degree: the largest t with −sym(P 𝒜_i) − N_i − 2 d α P ⪰ t I, t I ⪯ P ⪯ I, for rates α."""

    def __init__(self, A: Array, monomials: Monomials) -> None:
        self.d, self.order = monomials.d, len(monomials)
        self.lifts = monomials.lift(A)
        self.nothing = monomials.nothing.toarray()
        self.size = self.order * (self.order + 1) // 2
        self.one = upper(np.eye(self.order)[None])[0]
        basis = symmetric_of(np.eye(self.size), self.order)
        self.maps = [upper(symmetric_part(basis @ lift)).T for lift in self.lifts]
        self.of_P = upper(symmetric_part(basis)).T  # of sym(P), 2 P

    def at(self, rate: float) -> tuple[Array, Array, float] | None:
        """Return P, N_i and the rate that they show, at least this one; None if none is found."""
        cells, free = len(self.lifts), self.nothing.shape[1]
        G = np.zeros((cells + 2, self.size, 1 + self.size + cells * free))
        G[:, :, 0] = self.one
        G[1, :, 0] = 0.0
        G[:, :, 1 : 1 + self.size] = [
            -np.eye(self.size),
            np.eye(self.size),
            *(of_P + self.d * rate * self.of_P for of_P in self.maps),
        ]
        for k in range(cells):
            G[2 + k, :, 1 + self.size + k * free : 1 + self.size + (k + 1) * free] = self.nothing
        h = np.zeros((cells + 2, self.size))
        h[1] = self.one
        cost = np.zeros(G.shape[2])
        cost[0] = -1.0
        x = semidefinite(cost, G, h, self.order)
        if x is None:
            return None
        P = symmetric_of(x[1 : 1 + self.size], self.order)
        y = x[1 + self.size :].reshape(cells, free)
        N = symmetric_of((self.nothing @ y.T).T, self.order)
        return self._shown(P, N, rate)

    def _shown(self, P: Array, N: Array, rate: float) -> tuple[Array, Array, float] | None:
        """Return them with the largest rate for which all slacks are definite, if it is above the one given."""
        left = symmetric_part(P @ self.lifts) + N
        if not np.isfinite(left).all():
            return None
        try:
            shown = min(-float(eigh(side, P, eigvals_only=True)[-1]) for side in left) / (2 * self.d)
        except np.linalg.LinAlgError:  # P is not positive definite to working precision
            return None
        return (P, N, shown) if shown > rate else None
