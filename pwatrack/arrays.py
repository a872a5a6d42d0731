"""Read-only float64 arrays: every matrix in this package is one."""

from decimal import ROUND_CEILING, Context
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
EPS = float(np.finfo(np.float64).eps)  # relative distance from 1 to the next double; a rounding is half of it
TINY = float(np.finfo(np.float64).tiny)  # the least double that keeps all digits
CLOSE = 1e-9  # of what is usual of some numbers: what two processors may make of one formula
OVER_SUMS = 1 + 1e-12  # more than the rounding of a sum of products
OVER_POWERS = 1 + 1e-9  # more than the rounding of a few operations and exponentials


def readonly(values: Any) -> Array:
    """Return a read-only float64 copy of numbers, all of which have to be finite: else a ValueError."""
    array = np.array(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ValueError("array has an entry that is not finite")
    array.flags.writeable = False
    return array


def alike(one: Array, other: Array, *, together: bool = False) -> bool:
    """Say whether arrays (…, r, c) are what two processors make of one formula, in whatever units rows and columns are.

    Entries differ by `CLOSE` of their size, or of what their row and column have at most; `together` of the largest.

    Example:
        >>> table = np.array([[1.0, 1e-13], [1e9, 1.0]])
        >>> alike(table * (1 + 1e-12), table), alike(table + [[0, 1e-14], [0, 0]], table)
        (True, False)
    """
    if one.shape != other.shape or not other.size:
        return one.shape == other.shape
    size = np.abs(np.atleast_2d(other))
    most = size.reshape(-1, *size.shape[-2:]).max(axis=0)
    rows = most.max(axis=1, keepdims=True)
    columns = (most / np.where(rows, rows, 1.0)).max(axis=0, keepdims=True)
    within = CLOSE * (size.max() if together else np.maximum(size, rows * columns))
    return bool((np.abs(np.atleast_2d(one) - np.atleast_2d(other)) <= within).all())


def symmetric_part(X: Array) -> Array:
    """Return sym(X) = X + Xᵀ, for one matrix or a stack."""
    result: Array = X + np.swapaxes(X, -1, -2)
    return result


def root_of(Q: Array) -> Array:
    """Return X with Xᵀ X = Q ⪰ 0, (n, n).

    Example:
        >>> X = root_of(np.array([[2.0, 1.0], [1.0, 2.0]]))
        >>> (X.T @ X).round(12).tolist()
        [[2.0, 1.0], [1.0, 2.0]]
    """
    values, vectors = np.linalg.eigh((Q + Q.T) / 2)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)


def balancing(A: Array) -> Array:
    """Return powers of two d (n,) such that the stack of D⁻¹ A_i D, D = diag(d), is balanced.

    Example:
        >>> balancing(np.array([[[0.0, 1024.0], [1.0, 0.0]]])).tolist()
        [32.0, 1.0]
    """
    size = np.abs(A).sum(axis=0)
    with np.errstate(invalid="ignore"):  # SciPy also casts the scales to whole numbers, for a permutation
        _, (scale, _) = matrix_balance(size, permute=False, separate=True)
    return np.asarray(scale, dtype=np.float64)


def number_text(value: float, form: str = ".5g") -> str:
    """Return a number as text, 0 without a sign of minus: whoever reads it need not ask where it is from."""
    text = format(float(value), form)
    return text if any(c in "123456789in" for c in text.partition("e")[0]) else format(0.0, form)


def amount(count: int, what: str) -> str:
    """Return how many of something there are, which has a plural with an s.

    Example:
        >>> amount(1, "input"), amount(2187, "cell")
        ('1 input', '2,187 cells')
    """
    return f"{count:,} {what}{'s' * (count != 1)}"


def up(value: float) -> str:
    """Return a number in three digits, not smaller."""
    return number_text(rounded_up(value, 3), ".3g")


def outward(value: float, side: int, known: float = 0.0, *, digits: int = 4) -> str:
    """Return the end of an interval in so many digits: not inside of it, but for what of itself it is known to.

    Example:
        >>> outward(1.118034, 1), outward(-1.118034, -1), outward(1 + 1e-9, 1, known=1e-6)
        ('1.119', '-1.119', '1')
    """
    nearest = number_text(value, f".{digits}g")
    if side * (value - float(nearest)) <= known * abs(value):
        return nearest
    return number_text(side * rounded_up(side * value, digits), f".{digits}g")


def rounded_up(value: float, digits: int) -> float:
    """Return a number of so many digits, not smaller: two processors enclose the same."""
    return float(Context(prec=digits, rounding=ROUND_CEILING).create_decimal(value))


def complex_text(value: complex) -> str:
    """Return a number as text, without an imaginary part of 0.

    Example:
        >>> complex_text(1.5 + 0j), complex_text(-0.15 - 1.174j), complex_text(-0j)
        ('1.5', '-0.15-1.174j', '0')
    """
    real = number_text(value.real, ".4g")
    return f"{real}{number_text(value.imag, '+.4g')}j" if value.imag else real
