"""Matrices whose entries lie within radii: whatever is in a ball."""

from fractions import Fraction
from math import ceil
from typing import Any, NamedTuple

from .matrices import (
    AuditFault,
    Matrix,
    added,
    definite,
    identity,
    inverted,
    product,
    spend,
    symmetric_part,
    times,
    total,
    transposed,
)

_DIGITS = 40  # binary ones of what is added for radii


def sizes(X: Matrix) -> Matrix:
    """Return the sizes of all entries."""
    return [[abs(v) for v in row] for row in X]


class Ball(NamedTuple):
    """Matrices whose entries lie within radii, [] for none, of those of a centre: whatever is in it."""

    centre: Matrix
    radius: Matrix = []  # noqa: RUF012

    def __matmul__(self, other: "Ball") -> "Ball":
        (X, R), (Y, S) = self, other
        radius = product(sizes(X), S) if S else []
        radius = added_or(radius, product(R, added_or(sizes(Y), S)) if R else [])
        return Ball(product(X, Y), radius)

    def __add__(self, other: "Ball") -> "Ball":  # type: ignore[override]
        return Ball(added(self.centre, other.centre), added_or(self.radius, other.radius))

    def __sub__(self, other: "Ball") -> "Ball":
        return Ball(added(self.centre, other.centre, -1), added_or(self.radius, other.radius))

    def __neg__(self) -> "Ball":
        return self.times(Fraction(-1))

    @property
    def T(self) -> "Ball":
        """The transposes."""
        return Ball(transposed(self.centre), transposed(self.radius))

    def times(self, factor: Fraction) -> "Ball":
        """Return a multiple."""
        return Ball(times(self.centre, factor), times(self.radius, abs(factor)))

    def rows(self, first: int, end: int) -> "Ball":
        """Return some rows."""
        return Ball(self.centre[first:end], self.radius[first:end])

    @property
    def most(self) -> Matrix:
        """The largest sizes of all entries."""
        return added_or(sizes(self.centre), self.radius)

    def row(self, k: int) -> "Ball":
        """Return one row, from the end where k is negative."""
        return Ball([self.centre[k]], [self.radius[k]] if self.radius else [])

    def column(self, k: int) -> "Ball":
        """Return one column."""
        return self.T.row(k).T

    def inverse(self) -> "Ball":
        """Return all inverses: |(X + E)^-1 - X^-1| <= (I - Q)^-1 Q |X^-1| with Q = |X^-1| |E|, if (I - Q)^-1 >= 0."""
        back = inverted(self.centre)
        if not self.radius:
            return Ball(back)
        size = sizes(back)
        Q = product(size, self.radius)
        grown = inverted(added(identity(len(back), 1), Q, -1))
        if any(v < 0 for row in grown for v in row):
            raise AuditFault("a change of state in a ball may be singular")
        return Ball(back, product(grown, product(Q, size)))


def added_or(X: Matrix, Y: Matrix) -> Matrix:
    """Return X + Y, where [] is 0."""
    return added(X, Y) if X and Y else X or Y


def zero(rows: int, columns: int) -> Ball:
    """Return 0."""
    return Ball([[Fraction(0)] * columns for _ in range(rows)])


def unit(order: int, k: int) -> Ball:
    """Return a column of the identity."""
    return Ball([[Fraction(j == k)] for j in range(order)])


def stacked(*balls: Ball) -> Ball:
    """Return matrices below each other."""
    X = [row for ball in balls for row in ball.centre]
    spend(sum(map(len, X)) / 4)
    radii = [ball.radius or times(ball.centre, 0) for ball in balls] if any(ball.radius for ball in balls) else []
    return Ball(X, [row for radius in radii for row in radius])


def sides(*balls: Ball) -> Ball:
    """Return matrices side by side."""
    return stacked(*(ball.T for ball in balls)).T


def unlike(matrices: list[Ball]) -> list[tuple[int, Ball]]:
    """Return the matrices that are no repetition of an earlier one, with their cells."""
    first: dict[Any, tuple[int, Ball]] = {}
    for i, ball in enumerate(matrices):
        first.setdefault(frozen(ball), (i, ball))
    return list(first.values())


def frozen(ball: Ball) -> Any:
    """Return a ball as a key."""
    spend(sum(len(row) for X in ball for row in X))
    return tuple(tuple(map(tuple, X)) for X in ball)


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


def falls(
    ball: Ball,
    P: Matrix,
    powers: list[Fraction],
    rest: Matrix | None = None,
    open_: Matrix | None = None,
    *,
    rate: Fraction | int = 0,
) -> bool:
    """Decide X P + P X^T + 2 rate P + rest + E < 0 for all X in a ball and symmetric E with |E| <= open_ + open_^T.

    The powers are about the roots of the diagonal of P.
    """
    X, R = ball
    half = product(X, P)
    half = added(half, P, rate) if rate else half
    left = symmetric_part(half)
    left = added(left, rest) if rest else left
    enlarge(left, product(R, sizes(P)) if R else [], powers)
    enlarge(left, open_ or [], powers)
    return definite(left, sign=-1)


def squared(g: Ball, factor: Fraction | int = 1) -> tuple[Matrix, Matrix]:
    """Return factor g g^T of a centre, and half of by how much it may be off; [] where g is exact."""
    square, open_ = g @ g.T
    return times(square, factor), times(open_, Fraction(factor) / 2)


def less_square(Q: Matrix, powers: list[Fraction], g: Ball, factor: Fraction | int = 1) -> Matrix:
    """Return Q - factor g g^T, or what is below it for all g in a ball."""
    square, open_ = squared(g, factor)
    left = added(square, Q, -1)
    enlarge(left, open_, powers)
    return times(left, -1)


def beyond(c: Ball, Q: Matrix, size: Fraction) -> bool:
    """Say whether |c z| may be above a size, or that is negative, for z^T Q^-1 z <= 1 and some row in a ball."""
    square, open_ = c @ Ball(Q) @ c.T
    return size < 0 or square[0][0] + (open_[0][0] if open_ else 0) > size**2


def enlarge(left: Matrix, half: Matrix, powers: list[Fraction]) -> None:
    """Add a diagonal above every symmetric E with |E| <= half + half^T.

    For any a > 0, 2 |v_j v_k| <= v_j^2 a_j / a_k + v_k^2 a_k / a_j. It is rounded up to a short number: the others of
    the matrix have denominators in common, and it would have another.
    """
    for j, row in enumerate(symmetric_part(half)):
        more = powers[j] * total([v / power if v else v for v, power in zip(row, powers, strict=True)])
        unit = Fraction(2) ** (more.numerator.bit_length() - more.denominator.bit_length() - _DIGITS)
        left[j][j] += ceil(more / unit) * unit
