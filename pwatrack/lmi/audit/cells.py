"""Which regions the cells fill, decided by linear programs in fractions."""

from collections.abc import Iterator
from fractions import Fraction
from itertools import combinations
from typing import Any

from .matrices import AuditFault, less, spend
from .reading import number


class Cells:
    """Cell i is where s (H x + h) >= 0 for each hyperplane (H, h) and its sign s in this cell, if s is not 0."""

    def __init__(self, content: Any) -> None:
        self.planes = [[number(v) for v in (*row, h)] for row, h in zip(content["H"], content["h"], strict=True)]
        self.parallel = [normalised(plane) for plane in self.planes]
        self.signs = content["signs"]
        spend(sum(map(len, self.signs)) / 10)
        if any(s not in (-1, 0, 1) for row in self.signs for s in row):
            raise AuditFault("a sign is none")

    def faults(self, jumps: Any) -> list[str]:
        """Return where cells overlap, where none is, and where the field jumps: `jumps(i, j, plane)` says it may."""
        faults = []
        for i, j, opposite in self.neighbours():
            both = [s or t for s, t in zip(self.signs[i], self.signs[j], strict=True)]
            if not opposite and self.interior(both):
                faults.append(f"cells {i + 1} and {j + 1} overlap")
            if len(opposite) == 1 and jumps(i, j, self.planes[opposite[0]]) and self.interior(both, on=opposite[0]):
                faults.append(f"the field jumps between cells {i + 1} and {j + 1}")
        if not faults and self.hole([0] * len(self.planes), list(range(len(self.signs)))):
            faults.append("the cells do not cover the state space")
        return faults

    def neighbours(self) -> Iterator[tuple[int, int, list[int]]]:
        """Yield pairs of cells on opposite sides of one hyperplane at most: the others do not touch in a facet."""
        if not all(map(all, self.signs)):  # some hyperplanes do not bound some cells
            for i, j in combinations(range(len(self.signs)), 2):
                spend(1 + len(self.planes) / 10)
                pairs = zip(self.signs[i], self.signs[j], strict=True)
                opposite = [k for k, (s, t) in enumerate(pairs) if s * t < 0]
                if len(opposite) <= 1:
                    yield i, j, opposite
            return
        places: dict[tuple[int, ...], int] = {}
        for j, row in enumerate(map(tuple, self.signs)):
            spend(len(row) * (1 + len(row) / 50))
            if row in places:
                yield places[row], j, []
            for k in range(len(row)):
                beside = places.get((*row[:k], -row[k], *row[k + 1 :]))
                if beside is not None:
                    yield beside, j, [k]
            places[row] = j

    def hole(self, region: list[int], cells: list[int]) -> bool:
        """Say whether some point strictly inside a region is in none of these cells."""
        if not self.interior(region):
            return False
        for position, i in enumerate(cells):
            spend(1 + len(region) / 20)
            if any(s * t < 0 for s, t in zip(region, self.signs[i], strict=True)):
                continue
            inside = list(region)
            for k, s in enumerate(self.signs[i]):
                if s and not region[k]:
                    outside = list(inside)
                    outside[k] = -s
                    if self.hole(outside, cells[position + 1 :]):
                        return True
                    inside[k] = s
            return False
        return True

    def interior(self, signs: list[int], on: int | None = None) -> bool:
        """Decide whether s (H x + h) > 0 has a solution for all signs s but 0, on a hyperplane if one is given."""
        if on is None:
            return self.between(signs)
        rows = [[s * v for v in self.planes[k]] for k, s in enumerate(signs) if s and k != on]
        plane = self.planes[on]
        pivot = next(p for p, v in enumerate(plane) if v)
        return strictly_feasible([less(row, row[pivot] / plane[pivot], plane) for row in rows])

    def between(self, signs: list[int]) -> bool:
        """Decide the same off all hyperplanes: of those that are parallel only the nearest on either side count."""
        above: dict[Any, Fraction] = {}
        below: dict[Any, Fraction] = {}
        for s, (direction, offset, turned) in zip(signs, self.parallel, strict=True):
            spend(1 + len(direction) / 2)
            if s * turned > 0:
                above[direction] = min(offset, above.get(direction, offset))
            elif s:
                below[direction] = max(offset, below.get(direction, offset))
        if any(offset <= below[direction] for direction, offset in above.items() if direction in below):
            return False
        rows = [[*direction, offset] for direction, offset in above.items()]
        rows += [[-v for v in (*direction, offset)] for direction, offset in below.items()]
        return strictly_feasible(rows)


def normalised(plane: list[Fraction]) -> tuple[tuple[Fraction, ...], Fraction, int]:
    """Return H and h over the first entry of H that is not 0, and the sign of that."""
    pivot = next((v for v in plane[:-1] if v), None)
    if pivot is None:
        raise AuditFault("a hyperplane has a zero normal")
    return tuple(v / pivot for v in plane[:-1]), plane[-1] / pivot, 1 if pivot > 0 else -1


def strictly_feasible(rows: list[list[Fraction]]) -> bool:
    """Decide whether a x + c > 0 for all rows (a, c) has a solution.

    The least w >= 0 with a x + c >= 1 - w is below 1 then; it is found by the simplex method with Bland's rule.
    """
    width = 2 * (len(rows[0]) - 1) + 1 if rows else 0  # x as a difference of two positive vectors, and w
    table = [
        [*row[:-1], *(-v for v in row[:-1]), Fraction(1), row[-1] - 1] for row in rows
    ]  # each basic variable of these
    basis, free = [-1 - k for k in range(len(rows))], list(range(width))
    if all(row[-1] >= 0 for row in table):
        return True
    goal: list[Fraction] = [Fraction(0)] * width + [Fraction(0)]
    goal[width - 1] = Fraction(1)
    leaving, entering = min(range(len(table)), key=lambda k: table[k][-1]), width - 1
    while True:
        row = table[leaving]
        factor = -1 / row[entering]
        spend(len(table) + len(row))
        row[entering] = Fraction(-1)
        table[leaving] = row = [factor * v for v in row]
        basis[leaving], free[entering] = free[entering], basis[leaving]
        for other in (*(t for k, t in enumerate(table) if k != leaving), goal):
            scale, other[entering] = other[entering], Fraction(0)
            if scale:
                other[:] = less(other, -scale, row)
        if goal[-1] < 1:
            return True
        falling = [k for k in range(width) if goal[k] < 0]
        if not falling:
            return False
        entering = min(falling, key=lambda k: free[k])
        limits = [(t[-1] / -t[entering], basis[k], k) for k, t in enumerate(table) if t[entering] < 0]
        leaving = min(limits)[2]
