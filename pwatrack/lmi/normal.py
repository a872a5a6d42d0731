"""The equations that are left for the unknowns in each step: a symmetric matrix, its factor."""

import numpy as np
from scipy.linalg import lapack

from pwatrack.arrays import Array

_RIDGES = (1e-15, 1e-13, 1e-11, 1e-9)  # of the diagonal of H, the first that will do; for m ≥ 2 it is singular along
# P = 0, Y = Ω Bᵀ, Ω skew, and near the end to working precision


class Normal:
    """H x = r for a positive semidefinite H, of which the lower triangle is read.

    Raises:
        numpy.linalg.LinAlgError: If H is far from that, or not finite.

    Example: what no equation speaks of is 0.

        >>> Normal(np.diag([4.0, 0.0])).solve(np.array([8.0, 0.0])).round(9).tolist()
        [2.0, 0.0]
    """

    def __init__(self, H: Array, room: Array | None = None) -> None:
        """Factorize H, in C order, in a room of its size."""
        self._factor = np.empty_like(H) if room is None else room
        diagonal = H.diagonal().copy()
        if not np.isfinite(diagonal).all() or not diagonal.max() > 0:
            raise np.linalg.LinAlgError("H is not finite, or 0")
        for ridge in _RIDGES:
            self._factor[:] = H
            np.einsum("ii->i", self._factor)[:] = np.where(diagonal > 0, diagonal * (1 + ridge), 1.0)
            _, fails = lapack.dpotrf(self._factor.T, lower=0, clean=0, overwrite_a=1)
            if not fails:
                return
        raise np.linalg.LinAlgError("H is not positive semidefinite to working precision")

    def solve(self, right: Array) -> Array:
        """Return x."""
        return np.asarray(lapack.dpotrs(self._factor.T, right, lower=0)[0])
