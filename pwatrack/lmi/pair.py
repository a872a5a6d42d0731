"""Two matrices that differ by one of rank one: a common P by Riccati equations, in place of a program.

Of cells that one scalar element makes, the corners are M ± f gᵀ. For every |δ| ≤ 1 and τ > 0

    δ (f gᵀ P + P g fᵀ) ⪯ τ f fᵀ + P g gᵀ P / τ,

and for some τ nothing is lost by it for both signs (Petersen, A stabilization algorithm for a class of uncertain linear
systems, Systems & Control Letters 8, 1987). So a common P is one that solves a Riccati equation, and there is one for a
rate α where |gᵀ (jω − α − M)⁻¹ f| < 1 for all ω. Nothing of it is believed before it is proved.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are imported where they are used
from scipy.linalg import schur

from pwatrack.arrays import Array

MANY_STATES = 32  # from so many on programs take longer than a second, and these equations are asked first
_RANK_ONE = 1e-9  # of the largest singular value of a difference, below which the others are rounding
_RATES = 30  # that are tried, each nearer to the largest
_ENCLOSED = 1e-4  # of a rate, up to which it is sought
_INSIDE = (1e-3, 1e-2, 0.1)  # of that rate, given up so that there is a P well inside
_LIGHT = (1e-9, 1e-7, 1e-5)  # of |f|²: how strict the inequality is to be
_ON_AXIS = 1e-13  # of the largest eigenvalue: the real part of one that may lie on the imaginary axis
_SOLVED = 1e-6  # of ‖X‖ ‖A‖: what an equation may be off by
_AROUND, _STEP = 8.0, 2.0  # decades of τ about its natural sizes, and how far apart it is looked at first
_APART = 30.0  # decades that these may be apart
_NEAR = 0.05  # decades, up to which the best τ is sought


@dataclass(frozen=True)
class Pair:
    """M − f gᵀ and M + f gᵀ; one matrix alone where f = g = 0.

    Example: the two of a dead zone that stiffens a spring.

        >>> pair = Pair.of(np.array([[[0.0, 1], [-1, -1]], [[0.0, 1], [-3, -1]]]))
        >>> pair.M.tolist(), np.abs(np.outer(pair.f, pair.g)).round(12).tolist()
        ([[0.0, 1.0], [-2.0, -1.0]], [[0.0, 0.0], [1.0, 0.0]])
    """

    M: Array  # (n, n), the mean
    f: Array  # (n,)
    g: Array  # (n,)

    @classmethod
    def of(cls, corners: Array, moved: Array | float = 0.0) -> "Pair | None":
        """Return that of the corners (l, n, n) of some cells, of which all are moved by (n, n); None for no such pair.

        Where a large gain moves them, rounding hides from their sums what they differ by.
        """
        if len(corners) > 2 or not np.isfinite(corners).all():
            return None
        first, last = corners[0], corners[-1]
        U, s, Vt = np.linalg.svd((first - last) / 2)
        if len(s) > 1 and s[1] > _RANK_ONE * s[0]:
            return None
        root = np.sqrt(s[0])
        return cls((first + last) / 2 + moved, U[:, 0] * root, Vt[0] * root)

    def certificates(self) -> Iterator[Array]:
        """Yield P (n, n) with M P + P Mᵀ + 2 α P ≺ 0 for both, the first ones for nearly the largest α."""
        rate, size = self._largest_rate(), float(self.f @ self.f)
        for given in _INSIDE if rate > 0 else ():
            for light in _LIGHT if size else (1.0,):
                P = self.common(rate * (1 - given), light * (size or 1.0))
                if P is not None:
                    yield P

    def well_conditioned(self, rate: float) -> Array | None:
        """Return that P for a rate, of those of several τ, which has the least condition number; None if none is found.

        Where M P + P Mᵀ + 2 α P + I is to be 0, P is large only where the pair itself is slow.
        """

        def condition(log: float) -> float:
            P = self.common(rate, 1.0, 10.0**log)
            return np.inf if P is None else float(np.log(np.linalg.cond(P)))

        about = -np.log10(float(self.f @ self.f) or 1.0)
        return self.common(rate, 1.0, 10.0 ** (_least(condition, about, about) if self.f.any() else 0.0))

    def regulator(self, B: Array, Q: Array, R: Array, starts: Array) -> Array | None:
        """Return the X (n, n) of the least guaranteed cost: of u = −R⁻¹ Bᵀ X x, whatever the switching.

        xᵀ X x is above ∫(xᵀQx + uᵀRu) dt, and its sum over the starts, rows (k, n), is least. For each τ that is a
        Riccati equation, and the least is a convex function of τ (Petersen and McFarlane, Optimal guaranteed cost
        control and filtering for uncertain linear systems, IEEE Transactions on Automatic Control 39, 1994).
        """
        act = B @ np.linalg.solve(R, B.T)

        def solved(log: float) -> Array | None:
            tau = 10.0**log
            found = riccati(self.M, act - tau * np.outer(self.f, self.f), Q + np.outer(self.g, self.g) / tau)
            return found if found is not None and np.linalg.eigvalsh(found)[0] > 0 else None

        def cost(log: float) -> float:
            X = solved(log)
            return np.inf if X is None else float(np.log(np.einsum("kj,ji,ki->", starts, X, starts)))

        of_g, of_Q, of_u, of_M = np.log10([np.linalg.norm(X) for X in (self.g[None], Q, act, self.M)])
        sizes = np.array([2 * of_g - of_Q, 2 * of_g + of_u - 2 * of_M])  # g gᵀ / τ is like Q, and like what u can do
        alone = not self.f.any() or not np.isfinite(sizes).all()
        return solved(0.0 if alone else _least(cost, max(sizes.min(), sizes.max() - _APART), sizes.max()))

    def _largest_rate(self) -> float:
        """Return about the largest rate that one P has for both."""
        low, high = 0.0, -float(np.linalg.eigvals(self.M).real.max())
        if not self.f.any():
            return high
        for _ in range(_RATES):
            if high - low <= _ENCLOSED * high:
                break
            middle = (low + high) / 2
            low, high = (middle, high) if self._reaches(middle) else (low, middle)
        return low

    def _reaches(self, rate: float) -> bool:
        """Say whether no frequency has |gᵀ (jω − rate − M)⁻¹ f| ≥ 1: H has no eigenvalue on the axis."""
        shifted = self.M + rate * np.eye(len(self.M))
        H = np.block([[shifted, np.outer(self.f, self.f)], [-np.outer(self.g, self.g), -shifted.T]])
        values = np.linalg.eigvals(H)
        apart = bool(np.abs(values.real).min() > _ON_AXIS * np.abs(values).max())
        return apart and int((values.real < 0).sum()) == len(self.M)

    def common(self, rate: float, strict: float, tau: float = 1.0) -> Array | None:
        """Return P ≻ 0 with M P + P Mᵀ + 2 rate P + τ f fᵀ + P g gᵀ P / τ + strict I = 0; None where none is seen."""
        eye = np.eye(len(self.M))
        constant = tau * np.outer(self.f, self.f) + strict * eye
        P = riccati((self.M + rate * eye).T, -np.outer(self.g, self.g) / tau, constant)
        return P if P is not None and np.linalg.eigvalsh(P)[0] > 0 else None


def riccati(A: Array, G: Array, Q: Array) -> Array | None:
    """Return X with AᵀX + X A − X G X + Q = 0 that makes A − G X stable, G and Q of any sign; None where none is seen.

    Example:
        >>> riccati(np.array([[1.0]]), np.array([[1.0]]), np.array([[3.0]])).round(12).tolist()
        [[3.0]]
    """
    n, sizes = len(A), (float(np.linalg.norm(Q)), float(np.linalg.norm(G)))
    scale = np.sqrt(sizes[0] / sizes[1]) if min(sizes) > 0 else 1.0  # X / scale has blocks G and Q of one size
    H = np.block([[A, -G * scale], [-Q / scale, -A.T]])
    try:
        _, U, stable = schur(H, sort="lhp")
        X = np.linalg.solve(U[:n, :n].T, U[n:, :n].T) if stable == n else np.full((n, n), np.nan)
    except (np.linalg.LinAlgError, ValueError):
        return None
    X = (X + X.T) / 2
    off = A.T @ X + X @ A - X @ G @ X * scale + Q / scale
    near = float(np.linalg.norm(off)) <= _SOLVED * max(float(np.linalg.norm(X)) * float(np.linalg.norm(A)), 1e-300)
    return X * scale if np.isfinite(X).all() and near else None


def _least(value: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function, which may be infinite, is least near two numbers: at or beside the best of a grid."""
    grid = np.arange(low - _AROUND, high + _AROUND + _STEP / 2, _STEP)
    values = [value(at) for at in grid.tolist()]
    best = int(np.argmin(values))
    if not np.isfinite(values[best]):
        return high
    middle = float(grid[best])
    found = scipy.optimize.minimize_scalar(
        lambda x: min(value(x), 1e3),
        bounds=(middle - _STEP, middle + _STEP),
        method="bounded",
        options={"xatol": _NEAR},
    )
    return float(found.x) if found.fun <= values[best] else middle
