"""Logarithms of sizes in which the numbers of a plant are as nearly 1 as can be: one convex problem."""

import numpy as np
from scipy.sparse import csr_matrix

from pwatrack.arrays import Array

_PULL = 1e-3  # of the square of a logarithm beside x²/2 − log x: enough for one solution, to rounding
_STEPS = 200  # of Newton's method at most
_SHORTEST = 1e-3  # of a step, which rounding may stop
_ENDED = 1e-26  # of the cost: what a last step may still take off it; the step itself is the root of that
_STEEPEST = 5.0  # of a logarithm, above which x²/2 goes on as a parabola: about all that pull can keep a number there
_LOOSE = 1e-6  # what is left of a unit vector outside the range of a matrix of whole numbers


def numbers(A: Array, B: Array, C: Array) -> tuple[Array, csr_matrix]:
    """Return the numbers of a plant that are not 0 and, for each, how its logarithm depends on those of the sizes.

    a_jk x_k / (x_j speed), b_jk u_k / (x_j speed) and c_jk x_k / y_j: columns for states, inputs, outputs, speed.
    """
    n, m = B.shape
    whole = np.block([[A, B], [C, np.zeros((len(C), m))]])
    place = np.concatenate([np.arange(n), n + m + np.arange(len(C))])  # of the signal that a row is about
    row, column = np.nonzero(whole)
    count, last = len(row), n + m + len(C)
    moving = np.flatnonzero(row < n)
    at = np.concatenate([np.arange(count), np.arange(count), moving])
    of = np.concatenate([column, place[row], np.full(len(moving), last)])
    sign = np.concatenate([np.ones(count), -np.ones(count + len(moving))])
    return whole[row, column], csr_matrix((sign, (at, of)), shape=(count, last + 1))


def settled(rows: csr_matrix) -> bool:
    """Say whether the last column is outside the span of the others."""
    gram = (rows.T @ rows).toarray()
    unit = np.eye(len(gram))[-1]
    return bool(np.abs(gram @ np.linalg.lstsq(gram, unit, rcond=None)[0] - unit).max() < _LOOSE)


def nearest_to_one(rows: csr_matrix, offset: Array, states: int) -> Array:
    """Return the θ (k,) of the least Σ e^{2r}/2 − r + ε r² with r = rows θ + offset, by Newton's method.

    Of many such θ it is one whose first entries, those of states, are small.

    Args:
        rows: What the logarithm of each number adds of each θ, (K, k).
        offset: That of each number as it is, (K,).
        states: How many of the θ are those of states.

    Example: ẋ = 3 u with a speed of 1: u is a third of x.

        >>> theta = nearest_to_one(csr_matrix([[-1.0, 1.0]]), np.log([3.0]), 1)
        >>> np.exp(theta).round(6).tolist()
        [1.0, 0.333333]
    """
    gram = (rows.T @ rows).toarray()
    values, vectors = np.linalg.eigh(gram)
    still = vectors[:, values < _LOOSE]  # directions that change no r
    theta = np.linalg.solve(gram + still @ still.T, -(rows.T @ offset))
    value, slope, bend = _cost(rows @ theta + offset)
    for _ in range(_STEPS):
        H = (rows.T @ rows.multiply(bend[:, None])).toarray()
        step = -np.linalg.solve(H + (1 + np.trace(H)) * still @ still.T, rows.T @ slope)
        towards, share = float(slope @ (rows @ step)), 1.0
        trial = _cost(rows @ (theta + step) + offset)
        while trial[0] > value + share * towards / 4 and share > _SHORTEST:
            share /= 2
            trial = _cost(rows @ (theta + share * step) + offset)
        theta, (value, slope, bend) = theta + share * step, trial
        if -towards < _ENDED * abs(value):
            break
    shift = np.linalg.lstsq(still[:states], theta[:states], rcond=None)[0]
    return np.asarray(theta - still @ shift)


def _cost(r: Array) -> tuple[float, Array, Array]:
    """Return Σ e^{2r}/2 − r + ε r², and of each term the first and the second derivative."""
    squares, beyond = np.exp(2 * np.minimum(r, _STEEPEST)), np.maximum(r - _STEEPEST, 0.0)
    value = float((squares * (0.5 + beyond + beyond**2) - r + _PULL * r**2).sum())
    return value, squares * (1 + 2 * beyond) - 1 + 2 * _PULL * r, 2 * squares + 2 * _PULL
