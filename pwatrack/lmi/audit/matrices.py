"""Matrices of fractions, and of fractions that lie within radii."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from math import inf, lcm
from typing import Any, NamedTuple

Matrix = list[list[Fraction]]

_MOST, _SMALL = 7e5, 100_000  # steps, 5e-6 to 12e-6 s each, for so many bytes; as their fourth power for more
_BITS = 1_000.0  # of numerator and denominator: so long numbers take twice the time of short ones, then as the square
_work = {"most": inf, "done": 0.0}


class AuditFault(Exception):
    """Something in the file is wrong, or does not hold."""


@contextmanager
def counted(size: int) -> Iterator[None]:
    """Count what is done for a file of so many bytes."""
    _work.update(most=_MOST * max(1.0, size / _SMALL) ** 4, done=0.0)
    try:
        yield
    finally:
        _work.update(most=inf, done=0.0)


def spend(steps: float, bits: int = 0) -> None:
    """Count so many operations on numbers of so many bits; a small file that asks for many is refused."""
    _work["done"] += steps * (1 + (bits / _BITS) ** 2)
    if _work["done"] > _work["most"]:
        raise AuditFault(f"it takes more than {_work['most']:.2g} steps, the most for a file of its size")


def bits(numbers: Iterable[Fraction]) -> int:
    """Return of how many the longest numerator and denominator are."""
    return max((v.numerator.bit_length() + v.denominator.bit_length() for v in numbers), default=0)


def identity(n: int, factor: Any) -> Matrix:
    """Return factor I."""
    return [[Fraction(factor) * (j == k) for k in range(n)] for j in range(n)]


def product(X: Matrix, Y: Matrix) -> Matrix:
    """Return X Y."""
    columns = transposed(Y)
    if any(len(row) != len(Y) for row in X):
        raise AuditFault("matrices do not fit together")
    found = list[list[Fraction]]()
    for row in X:
        terms = [[a * b for a, b in zip(row, c, strict=True) if a and b] for c in columns]
        found.append([total(each) for each in terms])
    return found


def total(terms: list[Fraction]) -> Fraction:
    """Return the sum."""
    found = sum(terms, Fraction(0))
    spend(1 + len(terms), bits([found]))
    return found


def added(X: Matrix, Y: Matrix, factor: Fraction | int = 1) -> Matrix:
    """Return X + factor Y."""
    spend(sum(map(len, X)), bits(v for row in (*X, *Y) for v in row))
    return [[a + factor * b for a, b in zip(one, two, strict=True)] for one, two in zip(X, Y, strict=True)]


def transposed(X: Matrix) -> Matrix:
    """Return the transpose."""
    return [list(column) for column in zip(*X, strict=True)]


def sizes(X: Matrix) -> Matrix:
    """Return the sizes of all entries."""
    return [[abs(v) for v in row] for row in X]


def inverted(X: Matrix) -> Matrix:
    """Return the inverse, by Gauss and Jordan's elimination."""
    n = len(X)
    rows = [[*row, *unit] for row, unit in zip(X, identity(n, 1), strict=True)]
    for k in range(n):
        found = next((j for j in range(k, n) if rows[j][k]), None)
        if found is None:
            raise AuditFault("a change of state is singular")
        rows[k], rows[found] = rows[found], rows[k]
        rows[k] = [v / rows[k][k] for v in rows[k]]
        for j in range(n):
            if j != k and rows[j][k]:
                rows[j] = less(rows[j], rows[j][k], rows[k])
    return [row[n:] for row in rows]


def less(row: list[Fraction], factor: Fraction, other: list[Fraction]) -> list[Fraction]:
    """Return row - factor other."""
    found = [v - factor * p for v, p in zip(row, other, strict=True)] if factor else list(row)
    spend(len(row), bits(found) if factor else 0)
    return found


def rank(X: Matrix) -> int:
    """Return the rank, by Gauss' elimination."""
    rows, found = [list(row) for row in X], 0
    for k in range(len(rows[0])):
        pivot = next((j for j in range(found, len(rows)) if rows[j][k]), None)
        if pivot is None:
            continue
        rows[found], rows[pivot] = rows[pivot], rows[found]
        for row in rows[found + 1 :]:
            row[:] = less(row, row[k] / rows[found][k], rows[found])
        found += 1
    return found


def positive(X: Matrix) -> int:
    """Return how many eigenvalues of a symmetric matrix are positive, by congruences to a diagonal one (Sylvester)."""
    rows, found = [list(row) for row in X], 0
    while rows:
        k = next((j for j, row in enumerate(rows) if row[j]), None)
        if k is None:  # all of the diagonal is 0: another row and column added to one make it 2 X_jk
            pair = next(((j, i) for j, row in enumerate(rows) for i, v in enumerate(row) if v), None)
            if pair is None:
                return found
            k, i = pair
            rows[k] = [a + b for a, b in zip(rows[k], rows[i], strict=True)]
            for row in rows:
                row[k] += row[i]
        pivot = rows.pop(k)
        at = pivot.pop(k)
        found += at > 0
        for row in rows:
            row[:] = less(row, row.pop(k) / at, pivot)
    return found


def definite(X: Matrix, *, semi: bool = False, sign: int = 1) -> bool:
    """Decide whether sign X, symmetric, is positive (semi)definite, by Bareiss' elimination in integers."""
    scale = sign * lcm(*(v.denominator for row in X for v in row))
    rows, previous = [[int(v * scale) for v in row] for row in X], 1
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if pivot < 0 or (pivot == 0 and (not semi or any(pivot_row[k + 1 :]))):
            return False
        spend((len(rows) - k) ** 2 / 3, max(map(int.bit_length, pivot_row)))
        for row in rows[k + 1 :] if pivot else []:
            factor, pairs = row[k], zip(row[k + 1 :], pivot_row[k + 1 :], strict=True)
            row[k + 1 :] = [(v * pivot - factor * p) // previous for v, p in pairs]
        previous = pivot or previous
    return True


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
        return Ball([[-v for v in row] for row in self.centre], self.radius)

    @property
    def T(self) -> "Ball":
        """The transposes."""
        return Ball(transposed(self.centre), transposed(self.radius))

    def row(self, k: int) -> "Ball":
        """Return one row."""
        return Ball([self.centre[k]], [self.radius[k]] if self.radius else [])

    def column(self, k: int) -> "Ball":
        """Return one column."""
        return Ball([[row[k]] for row in self.centre], [[row[k]] for row in self.radius])

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


def stacked(one: Ball, other: Ball) -> Ball:
    """Return one matrix on top of another."""
    (X, R), (Y, S) = one, other
    zero = [[[Fraction(0)] * len(row) for row in Z] for Z in (X, Y)]
    spend(sum(len(row) / 4 for row in (*X, *Y)))
    return Ball(X + Y, (R or zero[0]) + (S or zero[1]) if R or S else [])


def sides(one: Ball, other: Ball) -> Ball:
    """Return one matrix beside another."""
    return stacked(one.T, other.T).T


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


def falls(ball: Ball, P: Matrix, powers: list[Fraction], rest: Matrix | None, open_: Matrix | None = None) -> bool:
    """Decide X P + P X^T + rest + E < 0 for all X in a ball and all symmetric E with |E| <= open_ + open_^T.

    The powers are about the roots of the diagonal of P.
    """
    X, R = ball
    half = product(X, P)
    left = added(half, transposed(half))
    left = added(left, rest) if rest else left
    enlarge(left, product(R, sizes(P)) if R else [], powers)
    enlarge(left, open_ or [], powers)
    return definite(left, sign=-1)


def enlarge(left: Matrix, half: Matrix, powers: list[Fraction]) -> None:
    """Add a diagonal above every symmetric E with |E| <= half + half^T.

    For any a > 0, 2 |v_j v_k| <= v_j^2 a_j / a_k + v_k^2 a_k / a_j.
    """
    for j, row in enumerate(added(half, transposed(half))):
        left[j][j] += total([v * powers[j] / power for v, power in zip(row, powers, strict=True)])
