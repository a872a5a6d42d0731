"""Normal equations H x = r of a step, factorized: as one matrix, or by what is 0 in it."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import lapack

from pwatrack.arrays import Array, IntArray

_RIDGES = (1e-15, 1e-13, 1e-11, 1e-9)  # of the diagonal of H, the first that will do; for m ≥ 2 it is singular along
# P = 0, Y = Ω Bᵀ, Ω skew, and near the end to working precision


class Normal:
    """H x = r for a positive semidefinite H, of which the lower triangle is read.

    Raises LinAlgError if H is far from that, or not finite.
    """

    def __init__(self, H: Array) -> None:
        """Factorize H, in C order."""
        _factorize(H, self._factorized)

    def _factorized(self, A: Array) -> bool:
        self._factor, fails = lapack.dpotrf(A.T, lower=0, clean=0, overwrite_a=1)
        return not fails

    def solve(self, right: Array) -> Array:
        """Return x."""
        return np.asarray(lapack.dpotrs(self._factor, right, lower=0)[0])


class ChainNormal:
    """The same where unknowns are in blocks of which each has entries with the next alone, and the first with the last.

    Those behind them, few and at least one, have entries with all. Blocks are eliminated one after the other: each then
    adds to the next, to the last, and to those behind. That is as much work as blocks are many, and not as their cube.

    Example:
        >>> H = np.diag([4.0, 4, 4, 4, 4]) + np.eye(5, k=1) + np.eye(5, k=-1)
        >>> H[0, 3] = H[3, 0] = 1
        >>> ChainNormal(H, [slice(k, k + 1) for k in range(4)]).solve(H.sum(axis=0)).round(12).tolist()
        [1.0, 1.0, 1.0, 1.0, 1.0]
    """

    def __init__(self, H: Array, places: Sequence[slice]) -> None:
        """Factorize H, of which the lower triangle is read; raises as `Normal`."""
        last, self._rest = len(places) - 1, slice(places[-1].stop, len(H))
        after = ([*places[k + 1 : k + 2], *places[last:][: k < last - 1], self._rest] for k in range(last + 1))
        self._blocks = [(place, np.r_[*others]) for place, others in zip(places, after, strict=True)]
        _factorize(H, self._factorized)

    def _factorized(self, A: Array) -> bool:
        """Say whether all blocks are definite; keep their factors, and what is below them."""
        self._steps = list[tuple[slice, IntArray, Array, Array]]()
        for place, others in self._blocks:
            factor, fails = lapack.dpotrf(A[place, place].T, lower=0, clean=0)
            if fails:
                return False
            below = np.asarray(lapack.dtrtrs(factor, A[others, place].T, lower=0, trans=1)[0]).T
            self._steps.append((place, others, factor, below))
            A[np.ix_(others, others)] -= below @ below.T
        self._end, fails = lapack.dpotrf(A[self._rest, self._rest].T, lower=0, clean=0)
        return not fails

    def solve(self, right: Array) -> Array:
        """Return x."""
        x = np.array(right)
        for place, others, factor, below in self._steps:
            x[place] = lapack.dtrtrs(factor, x[place], lower=0, trans=1)[0]
            x[others] -= below @ x[place]
        x[self._rest] = lapack.dpotrs(self._end, x[self._rest], lower=0)[0]
        for place, others, factor, below in reversed(self._steps):
            x[place] = lapack.dtrtrs(factor, x[place] - below.T @ x[others], lower=0, trans=0)[0]
        return x


def _factorize(H: Array, factorized: Callable[[Array], bool]) -> None:
    """Factorize a copy of H with the first ridge that does, and 1 where its diagonal is 0.

    Raises LinAlgError where none does, or H is not finite.
    """
    diagonal = H.diagonal()
    if not np.isfinite(diagonal).all() or not diagonal.max() > 0:
        raise np.linalg.LinAlgError("H is not finite, or 0")
    for ridge in _RIDGES:
        A = H.copy()
        np.fill_diagonal(A, np.where(diagonal > 0, diagonal * (1 + ridge), 1.0))
        if factorized(A):
            return
    raise np.linalg.LinAlgError("H is not positive semidefinite to working precision")
