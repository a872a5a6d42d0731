"""All regions that some hyperplanes cut ℝⁿ into, one by one and exactly.

A region is a whole number whose bit k tells whether it is on the positive side of hyperplane k.

Along independent normals every combination of the strips between parallel hyperplanes is a region. Every other
hyperplane is added to those before it: the regions that it cuts in two are the regions of a smaller problem, that of
the others on this hyperplane; of the rest one point tells the side. So no linear program is needed, and the work
follows the number of regions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise, product
from math import lcm, prod

from pwatrack.model.polyhedron import (
    Point,
    Row,
    lifted,
    moved,
    oriented,
    pivot,
    primitive,
    restricted,
    shortened,
    value,
)
from pwatrack.rational import fraction_of, rational


class TooMany(Exception):
    """There are more regions than were asked for."""


@dataclass(frozen=True, kw_only=True)
class Arrangement:
    """The regions of a set of hyperplanes."""

    regions: tuple[int, ...]  # one whole number each
    points: tuple[Point, ...]  # a point inside each, (l, r), as `polyhedron.Point` in coordinates of its own
    columns: tuple[int, ...]  # the r states that move in them; the others are 0
    back: tuple[tuple[Fraction, ...], ...]  # takes these coordinates to those states, (r, r)

    def point(self, position: int, n: int) -> tuple[Fraction, ...]:
        """Return a point (n,) inside a region."""
        *Y, W = self.points[position]
        x = [Fraction(0)] * n
        for column, row in zip(self.columns, self.back, strict=True):
            x[column] = sum((a * v for a, v in zip(row, Y, strict=True)), Fraction(0)) / W
        return tuple(x)


def arrangement(planes: Sequence[Row], most: int) -> Arrangement:
    """Return the regions of distinct hyperplanes in ℝⁿ; raises `TooMany` if there are more than `most`.

    Example: three lines of general position in the plane leave one of eight combinations out.

        >>> sorted(arrangement([(1, 0, 0), (0, 1, 0), (1, 1, -1)], 10).regions)
        [0, 1, 2, 3, 5, 6, 7]
    """
    columns, forms = _independent_normals(planes)
    r = len(columns)
    inverse = rational([[Fraction(form[j]) for j in columns] for form in forms], (r, r)).inv()
    back = tuple(tuple(fraction_of(v) for v in row) for row in inverse.tolist())
    sides = list(zip(*back, strict=True))
    own = [
        primitive([*(sum(row[j] * b for j, b in zip(columns, side, strict=True)) for side in sides), row[-1]])
        for row in planes
    ]
    found = _regions(own, r, most)
    return Arrangement(regions=tuple(found), points=tuple(found.values()), columns=tuple(columns), back=back)


def _regions(planes: Sequence[Row], r: int, most: int) -> dict[int, Point]:
    """Return the regions in ℝʳ with a point of each, where every coordinate has a hyperplane across it."""
    across: list[list[int]] = [[] for _ in range(r)]
    others: list[int] = []
    for k, row in enumerate(planes):
        moving = [j for j in range(r) if row[j]]
        (across[moving[0]] if len(moving) == 1 else others).append(k)
    if prod(len(ks) + 1 for ks in across) > most:
        raise TooMany
    found = _boxes(planes, across)
    done = [k for ks in across for k in ks]
    for k in others:
        _cut(found, planes, done, k, most)
        done.append(k)
    return found


def _boxes(planes: Sequence[Row], across: Sequence[Sequence[int]]) -> dict[int, Point]:
    """Return all combinations of the intervals between parallel hyperplanes, with a point of each."""
    intervals = []
    for j, ks in enumerate(across):
        marks = sorted((Fraction(-planes[k][-1], planes[k][j]), k) for k in ks)
        region = sum(1 << k for _, k in marks if planes[k][j] < 0)
        inner = [_between(low, high) for (low, _), (high, _) in pairwise(marks)]
        samples = [marks[0][0] - 1, *inner, marks[-1][0] + 1]
        found = [(region, samples[0])]
        for (_, k), sample in zip(marks, samples[1:], strict=True):
            region ^= 1 << k
            found.append((region, sample))
        intervals.append(found)
    W = lcm(*(sample.denominator for found in intervals for _, sample in found))
    scaled = [[(region, int(sample * W)) for region, sample in found] for found in intervals]
    return {sum(region for region, _ in box): (*(X for _, X in box), W) for box in product(*scaled)}


def _between(low: Fraction, high: Fraction) -> Fraction:
    """Return a short dyadic number strictly between two others."""
    gap = high - low
    bits = max(0, gap.denominator.bit_length() - gap.numerator.bit_length() + 1)
    return Fraction((low.numerator << bits) // low.denominator + 1, 1 << bits)


def _cut(found: dict[int, Point], planes: Sequence[Row], done: Sequence[int], k: int, most: int) -> None:
    """Cut the regions of the hyperplanes `done` by another one."""
    plane, side = oriented(planes[k])
    before = [planes[d] for d in done]
    constant, bits, rows = 0, list[list[int]](), dict[Row, int]()  # bits[j]: of `done`, on either side of row j
    for d, row in zip(done, restricted(before, plane), strict=True):
        if any(row[:-1]):
            on, sign = oriented(row)
            j = rows.setdefault(on, len(rows))
            if j == len(bits):
                bits.append([0, 0])
            bits[j][sign > 0] |= 1 << d
        elif row[-1] > 0:
            constant |= 1 << d
    step = [0] * len(plane[:-1])
    step[pivot(plane)] = side
    cut = {}
    for small, point in _regions(list(rows), len(plane) - 2, most).items():
        region = constant + sum(pair[small >> j & 1] for j, pair in enumerate(bits))
        cut[region] = lifted(point, plane)
    if len(found) + len(cut) > most:
        raise TooMany
    for region, point in list(found.items()):
        if value(planes[k], point) > 0:
            found[region | 1 << k] = found.pop(region)
    for region, point in cut.items():
        for bit, way in ((0, [-v for v in step]), (1 << k, step)):
            found[region | bit] = shortened(moved(point, way, before), [*before, planes[k]])


def _independent_normals(planes: Sequence[Row]) -> tuple[list[int], list[Row]]:
    """Return the first independent normals, and as many columns in which they are independent."""
    columns, forms, reduced = list[int](), list[Row](), list[Row]()
    for plane in planes:
        row = plane[:-1]
        for j, other in zip(columns, reduced, strict=True):
            if row[j]:
                row = primitive([other[j] * a - row[j] * b for a, b in zip(row, other, strict=True)])
        if any(row):
            columns.append(pivot(row))
            reduced.append(row)
            forms.append(plane[:-1])
    return columns, forms
