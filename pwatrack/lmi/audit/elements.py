"""A plant as it is written: a linear field and scalar elements. Its cells are counted, and never listed."""

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import product
from math import prod
from typing import Any

from .balls import Ball
from .matrices import AuditFault, bits, rank, spend
from .reading import matrix, number, place

_MOST_CORNERS = 2**16  # that are decided one by one
Segments = tuple[int, ...]  # one of each element: a cell


class Function:
    """A continuous function of one number, linear between breakpoints."""

    def __init__(self, content: Any) -> None:
        self.breakpoints, self.slopes = ([number(v) for v in content[name]] for name in ("breakpoints", "slopes"))
        if len(self.slopes) != len(self.breakpoints) + 1 or not self.breakpoints:
            raise AuditFault("a function does not fit together")
        if sorted(set(self.breakpoints)) != self.breakpoints:
            raise AuditFault("the breakpoints of a function do not increase")
        self.intercepts = [number(content["value"]) - self.slopes[0] * self.breakpoints[0]]
        for k, s in enumerate(self.breakpoints):
            self.intercepts.append(self.intercepts[-1] + (self.slopes[k] - self.slopes[k + 1]) * s)
            spend(2, bits(self.intercepts[-1:]))

    def at(self, s: Fraction) -> Fraction:
        """Return its value."""
        k = bisect_left(self.breakpoints, s)
        return self.slopes[k] * s + self.intercepts[k]

    def segment(self, low: Fraction | None, high: Fraction | None) -> int:
        """Return the segment of all s from low to high, None for without end; where slopes are equal, either."""
        below = 0
        spend(len(self.breakpoints))
        for k, mark in enumerate(self.breakpoints):
            if low is not None and mark <= low:
                below = k + 1
            elif (high is None or mark < high) and self.slopes[k] != self.slopes[k + 1]:
                raise AuditFault("a function has a corner inside a cell")
        return below

    def line(self, k: int, row: list[Fraction], constant: Fraction) -> list[Fraction]:
        """Return what f(row x + constant) is on a segment: its row and, in the end, its constant."""
        return [*(self.slopes[k] * v for v in row), self.slopes[k] * constant + self.intercepts[k]]


class Element:
    """direction f(row x + constant), a term of the field."""

    def __init__(self, content: Any, n: int) -> None:
        self.row, self.direction = ([number(v) for v in content[name]] for name in ("row", "direction"))
        self.constant, self.function = number(content["constant"]), Function(content["function"])
        if len(self.row) != n or len(self.direction) != n or not any(self.row):
            raise AuditFault("an element does not fit the plant")

    def firsts(self, slopes: Iterable[Fraction]) -> list[int]:
        """Return the first segments with some slopes."""
        return sorted({self.function.slopes.index(v) for v in slopes})


class Elements:
    """x' = A x + b + sum of direction f(row x + constant) + B u.

    The rows are independent: so the arguments of the functions take all values together, and each combination of
    segments is a cell with an interior. The functions are continuous, so the field is.
    """

    def __init__(self, content: Any) -> None:
        self.A, self.b = matrix(content["A"]), matrix(content["b"])
        self.each = [Element(one, len(self.A)) for one in content["elements"]]
        self.names = [one["segments"] for one in content["elements"]]
        self.count = prod(map(len, self.names))
        if not self.each or rank([element.row for element in self.each]) < len(self.each):
            raise AuditFault("the rows of the elements are not independent")
        if [len(names) for names in self.names] != [len(element.function.slopes) for element in self.each]:
            raise AuditFault("a segment of an element has no name")

    @property
    def corners(self) -> list[Segments]:
        """The cells at the corners of the box of slopes: A_i is affine in these, so each is a mean of theirs."""
        return self.combined([e.firsts([min(e.function.slopes), max(e.function.slopes)]) for e in self.each])

    @property
    def slopes(self) -> list[Segments]:
        """Cells with all combinations of slopes."""
        return self.combined([e.firsts(e.function.slopes) for e in self.each])

    def combined(self, each: list[list[int]]) -> list[Segments]:
        """Return the cells with all combinations of some segments of each element."""
        count = prod(map(len, each))
        if count > _MOST_CORNERS:
            raise AuditFault(f"the elements have more than {_MOST_CORNERS} corners, or combinations of slopes")
        spend(count * len(self.A) ** 2 / 4)
        return list(product(*each))

    def segments(self, i: int) -> Segments:
        """Return the segments of a cell, which are counted with the last element first."""
        left, found = place(i, self.count), list[int]()
        for names in reversed(self.names):
            left, k = divmod(left, len(names))
            found.append(k)
        return tuple(reversed(found))

    def name(self, i: int) -> str:
        """Return what a cell is called."""
        return ", ".join(names[k] for names, k in zip(self.names, self.segments(i), strict=True))

    def fields(self, cells: Sequence[Segments]) -> tuple[list[Ball], list[Ball]]:
        """Return A_i and b_i of some cells."""
        lines = [[e.function.line(k, e.row, e.constant) for k in range(len(e.function.slopes))] for e in self.each]
        terms = [[(j, v) for j, v in enumerate(element.direction) if v] for element in self.each]
        found, n = list[list[list[Fraction]]](), len(self.A)
        for cell in cells:
            field = [[*row, *constant] for row, constant in zip(self.A, self.b, strict=True)]
            for term, line, k in zip(terms, lines, cell, strict=True):
                spend(len(term) * n)
                for j, factor in term:
                    field[j] = [v + factor * w if w else v for v, w in zip(field[j], line[k], strict=True)]
            found.append(field)
        A, b = ([Ball([row[part] for row in field]) for field in found] for part in (slice(n), slice(n, None)))
        return A, b
