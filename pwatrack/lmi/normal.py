"""Normal equations H x = r of a step, factorized: as one matrix, or by what is 0 in it."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import lapack

from pwatrack.arrays import Array

_RIDGES = (1e-15, 1e-13, 1e-11, 1e-9)  # of the diagonal of H, the first that will do; for m ≥ 2 it is singular along
# P = 0, Y = Ω Bᵀ, Ω skew, and near the end to working precision


class Normal:
    """H x = r for a positive semidefinite H, of which the lower triangle is read.

    Raises LinAlgError if H is far from that, or not finite.
    """

    def __init__(self, H: Array, room: Array | None = None) -> None:
        """Factorize H, in C order, in a room of its size."""
        self._factor = np.empty_like(H) if room is None else room
        _factorize(H, self._factorized)

    def _factorized(self, H: Array, ridge: float) -> bool:
        """Say whether it is with so much added to its diagonal."""
        self._factor[:] = H
        _add_ridge(self._factor, ridge)
        _, fails = lapack.dpotrf(self._factor.T, lower=0, clean=0, overwrite_a=1)
        return not fails

    def solve(self, right: Array) -> Array:
        """Return x."""
        return np.asarray(lapack.dpotrs(self._factor.T, right, lower=0)[0])


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
        self._places, self._rest = places, slice(places[-1].stop, len(H))
        _factorize(H, self._factorized)

    def _factorized(self, H: Array, ridge: float) -> bool:
        """Say whether it is with so much added to its diagonal; keep what blocks are, and below them."""
        places, last, rest = self._places, len(self._places) - 1, self._rest
        own = [H[place, place].copy() for place in places]
        behind = [H[rest, place].copy() for place in places]
        end, ring = H[rest, rest].copy(), H[places[last], places[0]].copy()
        self._own, self._below = list[Array](), list[Array]()
        for X in (*own, end):
            _add_ridge(X, ridge)
        for k, place in enumerate(places):
            parts = [behind[k]] if k == last else [H[places[k + 1], place], behind[k]]
            if k < last - 1:  # the last block has entries with all that were eliminated
                parts.insert(1, ring)
            elif k == last - 1:
                parts[0] = parts[0] + (ring if last > 1 else 0.0)
            factor, fails = lapack.dpotrf(own[k].T, lower=0, clean=0)
            if fails:
                return False
            below = np.vstack(parts)
            below = np.asarray(lapack.dtrtrs(factor, below.T, lower=0, trans=1)[0]).T
            self._own.append(factor)
            self._below.append(below)
            spread = below @ below.T
            size, m = [len(part) for part in parts], len(spread) - len(end)
            end -= spread[m:, m:]
            if k == last:
                continue
            own[k + 1] -= spread[: size[0], : size[0]]
            behind[k + 1] -= spread[m:, : size[0]]
            if k < last - 1:
                own[last] -= spread[size[0] : m, size[0] : m]
                behind[last] -= spread[m:, size[0] : m]
                ring = -spread[size[0] : m, : size[0]]
        self._end, fails = lapack.dpotrf(end.T, lower=0, clean=0)
        return not fails

    def _after(self, k: int) -> list[slice]:
        """Return which unknowns what is below a block is of."""
        last = len(self._places) - 1
        following = [*self._places[k + 1 : k + 2], *([self._places[last]] if k < last - 1 else [])]
        return [*following, self._rest]

    def solve(self, right: Array) -> Array:
        """Return x."""
        x = np.array(right)
        for k, (place, factor, below) in enumerate(zip(self._places, self._own, self._below, strict=True)):
            x[place] = lapack.dtrtrs(factor, x[place], lower=0, trans=1)[0]
            taken, first = below @ x[place], 0
            for after in self._after(k):
                size = after.stop - after.start
                x[after] -= taken[first : first + size]
                first += size
        x[self._rest] = lapack.dpotrs(self._end, x[self._rest], lower=0)[0]
        for k in range(len(self._places) - 1, -1, -1):
            known = np.concatenate([x[after] for after in self._after(k)])
            x[self._places[k]] = lapack.dtrtrs(
                self._own[k], x[self._places[k]] - self._below[k].T @ known, lower=0, trans=0
            )[0]
        return x


def _factorize(H: Array, factorized: Callable[[Array, float], bool]) -> None:
    """Factorize H with the first ridge that does; raises LinAlgError where none does, or H is not finite."""
    diagonal = H.diagonal()
    if not np.isfinite(diagonal).all() or not diagonal.max() > 0:
        raise np.linalg.LinAlgError("H is not finite, or 0")
    if not any(factorized(H, ridge) for ridge in _RIDGES):
        raise np.linalg.LinAlgError("H is not positive semidefinite to working precision")


def _add_ridge(X: Array, ridge: float) -> None:
    """Add a share of its diagonal to a matrix, and 1 where that is 0."""
    diagonal = np.einsum("ii->i", X)
    diagonal[:] = np.where(diagonal > 0, diagonal * (1 + ridge), 1.0)
