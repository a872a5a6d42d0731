"""Matrices that have some others in their hull."""

from fractions import Fraction

from .balls import Ball, unlike
from .matrices import spend


def outermost(matrices: list[Ball]) -> list[Ball]:
    """Return different matrices without those between two others: the hull stays what it is."""
    found = [ball for _, ball in unlike(matrices)]
    if any(R for _, R in found):
        return found
    points = [[v for row in X for v in row] for X, _ in found]
    return [ball for ball, point in zip(found, points, strict=True) if not between(point, points)]


def between(point: list[Fraction], points: list[list[Fraction]]) -> bool:
    """Say whether a point lies between two others: in opposite directions from it."""
    seen = set[tuple[Fraction, ...]]()
    for other in points:
        spend(2 * len(point))
        change = [v - w for v, w in zip(other, point, strict=True)]
        size = next((abs(v) for v in change if v), None)
        if size is None:
            continue
        direction = tuple(v / size for v in change)
        if tuple(-v for v in direction) in seen:
            return True
        seen.add(direction)
    return False


def within(one: Ball, other: Ball) -> bool:
    """Say whether all of one ball is in the other of the same centre."""
    (X, R), (Y, S) = one, other
    pairs = zip((v for row in R for v in row), (v for row in S for v in row), strict=True) if R and S else ()
    return X == Y and (not R or bool(S)) and all(v <= w for v, w in pairs)
