"""What is done to a problem before a solver sees it: cells that say nothing of their own leave it.

The inequalities are affine in A_i: what holds at A_1 and A_2 holds between them. So only the corners of the convex hull
of the cells are solved for. Proofs are about every cell.
"""

import numpy as np
import scipy
from scipy.linalg import qr

from pwatrack.arrays import Array, IntArray

_ROUNDING = 1e-9  # of the largest entry of a column of numbers: what is nearer than that is called equal
_HULLS = range(2, 5)  # dimensions in which all corners are found, in little time


def distinct(A: Array) -> tuple[Array, IntArray]:
    """Return the different matrices of a stack (l, n, n) and the place of each original among them.

    Equal matrices give equal inequalities: with k2 = k3 two cells of the paper's example are one.

    Example:
        >>> matrices, place = distinct(np.array([[[1.0]], [[2.0]], [[1.0]]]))
        >>> matrices.ravel().tolist(), place.tolist()
        ([1.0, 2.0], [0, 1, 0])
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
    place = distinct(A)[1]
    kept = np.sort(np.unique(place, return_index=True)[1])
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
