"""Matrices whose entries lie within radii: whatever is in a ball."""

from fractions import Fraction
from typing import Any

from .matrices import AuditFault, Matrix, added, identity, inverted, product, sizes, spend, total, transposed

Ball = tuple[Matrix, Matrix]  # centre and radius


def times(one: Ball, other: Ball) -> Ball:
    """Return all products of what is in two balls."""
    (X, R), (Y, S) = one, other
    radius: Matrix = product(sizes(X), S) if S else []
    radius = added_or(radius, product(R, added_or(sizes(Y), S)) if R else [])
    return product(X, Y), radius


def plus(one: Ball, other: Ball) -> Ball:
    """Return all sums of what is in two balls."""
    return added(one[0], other[0]), added_or(one[1], other[1])


def less(one: Ball, other: Ball) -> Ball:
    """Return all differences of what is in two balls."""
    return added(one[0], other[0], -1), added_or(one[1], other[1])


def added_or(X: Matrix, Y: Matrix) -> Matrix:
    """Return X + Y, where [] is 0."""
    return added(X, Y) if X and Y else X or Y


def inverse(ball: Ball) -> Ball:
    """Return all inverses: |(X + E)^-1 - X^-1| <= (I - Q)^-1 Q |X^-1| with Q = |X^-1| |E|, if (I - Q)^-1 >= 0."""
    X, R = ball
    back = inverted(X)
    if not R:
        return back, []
    size = sizes(back)
    Q = product(size, R)
    grown = inverted(added(identity(len(X), 1), Q, -1))
    if any(v < 0 for row in grown for v in row):
        raise AuditFault("a change of state in a ball may be singular")
    return back, product(grown, product(Q, size))


def negative(ball: Ball) -> Ball:
    """Return what is in a ball, with the other sign."""
    return [[-v for v in row] for row in ball[0]], ball[1]


def part(ball: Ball, k: int) -> Ball:
    """Return one row."""
    return [ball[0][k]], [ball[1][k]] if ball[1] else []


def column(ball: Ball, k: int) -> Ball:
    """Return one column."""
    return [[row[k]] for row in ball[0]], [[row[k]] for row in ball[1]]


def flipped(ball: Ball) -> Ball:
    """Return the transposes."""
    return transposed(ball[0]), transposed(ball[1])


def stacked(one: Ball, other: Ball) -> Ball:
    """Return one matrix on top of another."""
    (X, R), (Y, S) = one, other
    zero = [[[Fraction(0)] * len(row) for row in Z] for Z in (X, Y)]
    spend(sum(len(row) / 4 for row in (*X, *Y)))
    return X + Y, ((R or zero[0]) + (S or zero[1]) if R or S else [])


def sides(one: Ball, other: Ball) -> Ball:
    """Return one matrix beside another."""
    return flipped(stacked(flipped(one), flipped(other)))


def unlike(matrices: list[Ball]) -> list[tuple[int, Ball]]:
    """Return the matrices that are no repetition of an earlier one, with their cells."""
    first: dict[Any, tuple[int, Ball]] = {}
    for i, ball in enumerate(matrices):
        spend(sum(len(row) for X in ball for row in X))
        first.setdefault(tuple(tuple(map(tuple, X)) for X in ball), (i, ball))
    return list(first.values())


def enlarge(left: Matrix, half: Matrix, powers: list[Fraction]) -> None:
    """Add a diagonal above every symmetric E with |E| <= half + half^T.

    For any a > 0, 2 |v_j v_k| <= v_j^2 a_j / a_k + v_k^2 a_k / a_j.
    """
    for j, row in enumerate(added(half, transposed(half))):
        left[j][j] += total([v * powers[j] / power for v, power in zip(row, powers, strict=True)])
