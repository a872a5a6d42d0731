"""The one bisection."""

from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")


def bisected(
    best: tuple[float, Found],
    without: float,
    at: Callable[[float], tuple[float, Found] | None],
    *,
    near: float,
    most: int = 100,
    middle: Callable[[float, float], float] = lambda one, other: (one + other) / 2,
) -> tuple[float, Found, float]:
    """Return the last number at which something is found, what that is, and the next one at which nothing is.

    `best` is a number with what is found there, `without` one at which nothing is. `at` looks at a number; it may
    return one that is nearer to the end. It ends where they are apart by the share `near` of the first, after the most
    looks, or where the middle of two is one of them.

    Example: the root of 2.

        >>> value, _, above = bisected((1.0, None), 2.0, lambda x: (x, None) if x * x < 2 else None, near=1e-3)
        >>> value**2 < 2 < above**2, above - value <= 1e-3 * value
        (True, True)
    """
    (value, found), looked = best, 0
    while abs(without - value) > near * abs(value) and looked < most:
        trial, looked = middle(value, without), looked + 1
        if trial in (value, without):
            break
        seen = at(trial)
        if seen is None:
            without = trial
        else:
            value, found = seen
    return value, found, without
