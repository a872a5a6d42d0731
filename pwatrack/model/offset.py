"""The b of a cell that would make the field continuous, where it is missing."""

import numpy as np

from pwatrack.arrays import Array, readonly


def continuous_offset(
    A_i: Array, A_j: Array, b_j: Array, H: Array, h: float, *, tolerance: float = 1e-9
) -> Array | None:
    """Return the b_i (n,) with A_i x + b_i = A_j x + b_j wherever H x + h = 0, or None if there is none.

    There is one exactly where A_i − A_j = g Hᵀ for some g; it is b_j + g h.

    Args:
        A_i, A_j: (n, n).
        b_j: (n,).
        H, h: The hyperplane, (n,) and a scalar.
        tolerance: Largest entry of A_i − A_j − g Hᵀ that is taken for rounding, relative to the largest of A_i and A_j.

    Example: a spring of stiffness 4 that is met at z = 0.1.

        >>> free, touching = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0, 1.0], [-4.0, 0.0]])
        >>> continuous_offset(touching, free, np.zeros(2), np.array([1.0, 0.0]), -0.1).tolist()
        [0.0, 0.4]
    """
    change = A_i - A_j
    pivot = int(np.argmax(np.abs(H)))
    g = change[:, pivot] / H[pivot]
    size = max(np.abs(A_i).max(), np.abs(A_j).max())
    if np.abs(change - np.outer(g, H)).max() > tolerance * size:
        return None
    return readonly(b_j + g * h + 0.0)
