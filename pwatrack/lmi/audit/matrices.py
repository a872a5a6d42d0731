"""Matrices of fractions, and of fractions that lie within radii."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from math import inf, lcm
from operator import mul
from typing import Any

Matrix = list[list[Fraction]]

_MOST, _SMALL = 5e6, 100_000  # steps, 3e-6 to 12e-6 s each, for so many bytes; as their fourth power for more
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
    ratios = [v.as_integer_ratio() for v in numbers]
    return max([a.bit_length() + b.bit_length() for a, b in ratios], default=0)


def identity(n: int, factor: Any) -> Matrix:
    """Return factor I."""
    zero, one = Fraction(0), Fraction(factor)
    return [[one if j == k else zero for k in range(n)] for j in range(n)]


def product(X: Matrix, Y: Matrix) -> Matrix:
    """Return X Y: products of integers, of a row and a column each over what all of its numbers are over."""
    if any(len(row) != len(Y) for row in X):
        raise AuditFault("matrices do not fit together")
    columns, found = [whole(column) for column in transposed(Y)], list[list[Fraction]]()
    for row, below in map(whole, X):
        sums = [sum(map(mul, row, column)) for column, _ in columns]
        longest = max([value.bit_length() for value in sums], default=0) + below.bit_length()
        spend(len(columns) * (1 + len(row) - row.count(0)), longest)
        found.append([Fraction(value, below * other) for value, (_, other) in zip(sums, columns, strict=True)])
    return found


def whole(numbers: list[Fraction]) -> tuple[list[int], int]:
    """Return integers, and what all of them are over."""
    ratios = [v.as_integer_ratio() for v in numbers]
    below = lcm(*[b for _, b in ratios])
    return [a * (below // b) for a, b in ratios], below


def total(terms: list[Fraction]) -> Fraction:
    """Return the sum."""
    found = sum(terms[1:], terms[0]) if terms else Fraction(0)
    spend(1 + len(terms), bits([found]))
    return found


def added(X: Matrix, Y: Matrix, factor: Fraction | int = 1) -> Matrix:
    """Return X + factor Y."""
    Y = Y if factor == 1 else times(Y, factor)
    pairs = [zip(one, two, strict=True) for one, two in zip(X, Y, strict=True)]
    found = [[a + b if a and b else a or b for a, b in row] for row in pairs]
    spend(sum(map(len, X)), bits(v for row in found for v in row))
    return found


def symmetric_part(X: Matrix) -> Matrix:
    """Return X + X^T, of which each entry is added once."""
    n = range(len(X))
    low = added([row[: j + 1] for j, row in enumerate(X)], [[X[k][j] for k in range(j + 1)] for j in n])
    return [[low[max(j, k)][min(j, k)] for k in n] for j in n]


def times(X: Matrix, factor: Fraction | int) -> Matrix:
    """Return factor X."""
    return [[factor * v if v else v for v in row] for row in X]


def transposed(X: Matrix) -> Matrix:
    """Return the transpose."""
    return [list(column) for column in zip(*X, strict=True)]


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
    numbers, n, previous = whole([v if sign > 0 else -v for row in X for v in row])[0], len(X), 1
    rows = [numbers[j * n :][:n] for j in range(n)]
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
