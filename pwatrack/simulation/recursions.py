"""Sequences x_{k+1} = M_k x_k + c_k, all at once."""

from math import ceil, sqrt

import numpy as np

from pwatrack.arrays import Array


def powers(M: Array, x: Array, count: int) -> Array:
    """Return x, M x, M² x, …, (count, n): as many again with each power that is squared.

    Example:
        >>> powers(np.array([[2.0]]), np.ones(1), 5).ravel().tolist()
        [1.0, 2.0, 4.0, 8.0, 16.0]
    """
    found = x[None]
    while len(found) < count:
        found = np.concatenate([found, found[: count - len(found)] @ M.T])
        M = M @ M
    return found


def recursion(M: Array, c: Array, x: Array) -> Array:
    """Return x_0 = x, …, x_K, (K + 1, n), of M (K, n, n) and c (K, n).

    It is made of √K stretches, of which all go on step by step at the same time, as maps of what they begin with.

    Example:
        >>> recursion(np.full((3, 1, 1), 2.0), np.ones((3, 1)), np.zeros(1)).ravel().tolist()
        [0.0, 1.0, 3.0, 7.0]
    """
    K, n = c.shape
    length = ceil(sqrt(K + 1))
    whole = np.zeros((length * length, n, n + 1))
    whole[:K, :, :n], whole[:K, :, n] = M, c
    steps = whole.reshape(length, length, n, n + 1)
    maps = np.empty((length + 1, length, n, n + 1))  # after some steps, of each stretch
    maps[0] = np.eye(n, n + 1)
    for k in range(length):
        maps[k + 1] = steps[:, k, :, :n] @ maps[k]
        maps[k + 1, :, :, n] += steps[:, k, :, n]
    begins = np.empty((length, n))
    for stretch, end in enumerate(maps[-1]):
        begins[stretch] = x
        x = end[:, :n] @ x + end[:, n]
    found = np.einsum("ksij,sj->ski", maps[:-1, :, :, :n], begins) + maps[:-1, :, :, n].transpose(1, 0, 2)
    return np.asarray(found.reshape(-1, n)[: K + 1])
