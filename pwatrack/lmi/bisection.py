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

    Args:
        best: A number, and what is found there.
        without: One at which nothing is.
        at: Looks at a number; it may return one that is nearer to the end than that.
        near: Share of the first that they may be apart in the end.
        most: Times that it looks.
        middle: Where it looks between two; where that is one of them, it ends.

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
