"""Where a polynomial first becomes negative on [0, 1]: isolation in Bernstein form.

On one step a guard is a Taylor polynomial in τ ∈ [0, 1] up to rounding. Its
Bernstein coefficients enclose its values, and those of its derivative tell
where it is monotone, so a crossing is either isolated or excluded, never
overlooked (Farouki, The Bernstein polynomial basis: a centennial
retrospective, CAGD 29, 2012).
"""

from dataclasses import dataclass
from functools import cache
from math import comb

import numpy as np

from pwatrack.arrays import Array

_FINEST = 2.0**-26  # a piece so short that a polynomial without monotony on it stays within rounding of 0


@dataclass(frozen=True)
class Crossing:
    """The polynomial turns negative at `tau`; `grazing` if it only comes within rounding of 0 there."""

    tau: float
    grazing: bool = False


@cache
def bernstein_matrix(degree: int) -> Array:
    """Return the matrix that maps power coefficients on [0, 1] to Bernstein coefficients.

    Example:
        >>> bernstein_matrix(2) @ np.array([0.0, 0.0, 1.0])  # τ²
        array([0., 0., 1.])
    """
    return np.array(
        [[comb(j, i) / comb(degree, i) if i <= j else 0.0 for i in range(degree + 1)] for j in range(degree + 1)]
    )


def first_crossing(power: Array, tolerance: float) -> Crossing | None:
    """Return where the polynomial Σ power_j τʲ first becomes negative on [0, 1).

    Leading coefficients within the tolerance count as 0: the trajectory starts
    on the guard, and the first coefficient beyond decides which side it goes to.

    Args:
        power: Power coefficients, (J + 1,).
        tolerance: Values of smaller size are indistinguishable from 0.

    Returns:
        The first crossing; a grazing one if the polynomial comes within the
        tolerance of 0 and no sign can be given; None if there is neither.

    Example:
        >>> first_crossing(np.array([0.25, -1.0]), 1e-15)
        Crossing(tau=0.25, grazing=False)
        >>> first_crossing(np.array([0.26, -1.0, 1.0]), 1e-15) is None
        True
    """
    significant = np.abs(power) > tolerance
    if not significant.any():
        return None
    start = int(np.argmax(significant))
    rest = power[start:]
    if rest[0] >= np.abs(rest[1:]).sum() + tolerance:
        return None
    touched: Crossing | None = None
    pieces = [(0.0, 1.0, bernstein_matrix(len(rest) - 1) @ rest)]
    while pieces:
        low, high, b = pieces.pop()
        if b.min() > tolerance:
            continue
        slope = np.diff(b)
        if (slope >= 0).all():
            if b[0] < 0:
                return Crossing(low)
            continue
        if (slope <= 0).all():
            if b[-1] < 0:
                return Crossing(_root(rest, low, high))
            continue
        if high - low < _FINEST:
            if b.max() < -tolerance:
                return Crossing(low)
            touched = touched or Crossing(low, grazing=True)
            continue
        left, right = _halves(b)
        middle = (low + high) / 2
        pieces += [(middle, high, right), (low, middle, left)]
    return touched


def _root(power: Array, low: float, high: float) -> float:
    """Return the root of a polynomial that falls through 0 on [low, high], to 2⁻⁵³."""
    down = power[::-1].tolist()
    while high - low > 2.0**-53 * max(1.0, 4 * high):
        middle = (low + high) / 2
        value = 0.0
        for coefficient in down:
            value = value * middle + coefficient
        if value < 0:
            high = middle
        else:
            low = middle
    return low


def _halves(b: Array) -> tuple[Array, Array]:
    """Return the Bernstein coefficients on both halves, by de Casteljau's algorithm."""
    left, right = [b[0]], [b[-1]]
    while len(b) > 1:
        b = (b[:-1] + b[1:]) / 2
        left.append(b[0])
        right.append(b[-1])
    return np.array(left), np.array(right[::-1])
