"""What is done to a problem before a solver sees it: removal of repeated cells."""

import numpy as np

from pwatrack.arrays import Array, IntArray


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
