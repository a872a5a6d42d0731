"""Hyperplanes that cells write: which of them are one, and all regions that they cut ℝⁿ into, one by one and exactly.

A region is a whole number whose bit k tells whether it is on the positive side of hyperplane k.

Along independent normals every combination of the strips between parallel hyperplanes is a region. Every other
hyperplane is added to those before it: the regions that it cuts in two are the regions of a smaller problem, that of
the others on this hyperplane; of the rest one point tells the side. So no linear program is needed, and the work
follows the number of regions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate, pairwise, product
from math import lcm, log2, prod
from operator import xor

import numpy as np

from pwatrack.arrays import IntArray
from pwatrack.model.polyhedron import (
    Point,
    Row,
    borders,
    lifted,
    moved,
    opposite,
    oriented,
    pivot,
    primitive,
    restricted,
    shortened,
    value,
)
from pwatrack.rational import Rational, fraction_of, on_entries, pivots, rational

_ROUNDING = Fraction(1, 10**12)  # of its own numbers, up to which a border is taken for another one


@dataclass(frozen=True, kw_only=True)
class SharedHyperplanes:
    """Which hyperplanes are kept, and the sides of these that the cells claim."""

    kept: tuple[int, ...]  # numbers of the hyperplanes that stand for all, in ascending order
    signs: IntArray  # (l, k), for those that are kept
    repairs: tuple[tuple[int, int, Fraction], ...] = ()  # (k, other, by how much of its numbers k differs), not 0


def merge(rows: Sequence[Row], signs: IntArray) -> SharedHyperplanes:
    """Merge hyperplanes that are the same set, and those that two cells write with numbers rounded differently.

    The latter are those whose numbers (after a common factor) differ by at most 1e-12 of themselves, where no cell is
    between them: none claims opposite sides of the two, and none loses its interior.
    """
    exact = _same(rows, signs)
    rows = [rows[k] for k in exact.kept]
    banned: set[int] = set()
    while True:
        rounded = _nearly_same(rows, exact.signs, banned)
        moved = [k for repair in rounded.repairs for k in repair[:2]]
        claimants = np.flatnonzero(exact.signs[:, moved].any(axis=1))
        lost = [
            i
            for i in claimants
            if _has_interior(rows, exact.signs[i])
            and not _has_interior([rows[k] for k in rounded.kept], rounded.signs[i])
        ]
        if not lost:
            break
        banned |= {int(k) for i in lost for k in np.flatnonzero(exact.signs[i])}
    return replace(
        rounded,
        kept=tuple(exact.kept[k] for k in rounded.kept),
        repairs=tuple((exact.kept[k], exact.kept[other], size) for k, other, size in rounded.repairs),
    )


def _same(rows: Sequence[Row], signs: IntArray) -> SharedHyperplanes:
    """Merge equal sets. Of one whose both sides a cell claims, which has no interior, that cell has a second copy."""
    kept: list[int] = []
    columns: list[IntArray] = []
    homes: dict[Row, list[tuple[int, int]]] = {}
    for k, row in enumerate(rows):
        plane, side = oriented(row)
        claimed = signs[:, k]
        for position, other in homes.setdefault(plane, []):
            facing = side * other * claimed
            free = columns[position] * facing >= 0
            columns[position] = np.where(free & (facing != 0), facing, columns[position])
            claimed = np.where(free, 0, claimed)
        if claimed.any() or not homes[plane]:
            homes[plane].append((len(kept), side))
            columns.append(claimed)
            kept.append(k)
    return SharedHyperplanes(kept=tuple(kept), signs=np.array(columns, dtype=np.int64).reshape(len(kept), len(signs)).T)


def _nearly_same(rows: Sequence[Row], signs: IntArray, banned: set[int]) -> SharedHyperplanes:
    """Merge distinct hyperplanes by rounding, the closest ones first."""
    logs = np.array([[log2(abs(a)) if a else -np.inf for a in row] for row in rows])
    close = list[tuple[Fraction, int, int]]()
    for k in range(len(rows) - 1):
        with np.errstate(invalid="ignore"):  # of entries that are 0 in both
            ratio = logs[k + 1 :] - logs[k]
            spread = np.nanmax(ratio, axis=1) - np.nanmin(ratio, axis=1)
        near = np.flatnonzero(spread < 1e-6) + k + 1  # far coarser than these logarithms and the true limit
        for other in near.tolist():
            size = difference(rows[k], rows[other])
            if size is not None:
                close.append((size, k, other))
    table = signs.copy()
    home = list(range(len(rows)))
    repairs: dict[int, tuple[int, Fraction]] = {}
    for _, one, other in sorted(close):
        k, to = max(home[one], home[other]), min(home[one], home[other])
        group = [j for j in range(len(rows)) if home[j] == k]
        away = {j: difference(rows[j], rows[to]) for j in group}
        if k == to or banned & {*group, to} or any(size is None for size in away.values()):
            continue
        claimed = oriented(rows[k])[1] * oriented(rows[to])[1] * table[:, k]
        if not claimed.any() or not table[:, to].any() or (table[:, to] * claimed < 0).any():
            continue
        table[:, to] = np.where(claimed != 0, claimed, table[:, to])
        for j, size in away.items():
            assert size is not None
            home[j], repairs[j] = to, (to, size)
    kept = [k for k in range(len(rows)) if home[k] == k]
    return SharedHyperplanes(
        kept=tuple(kept),
        signs=table[:, kept],
        repairs=tuple((k, to, size) for k, (to, size) in sorted(repairs.items())),
    )


def difference(one: Row, other: Row) -> Fraction | None:
    """Return by how much of themselves the numbers of hyperplanes with the same zeros differ; None if by too much."""
    ratios = [Fraction(a, b) for a, b in zip(one, other, strict=True) if b]
    if min(ratios) < 0 < max(ratios):
        return None
    sizes = [abs(ratio) for ratio in ratios]
    spread = max(sizes) / min(sizes) - 1
    return spread if spread <= _ROUNDING else None


def _has_interior(rows: Sequence[Row], signs: IntArray) -> bool:
    return borders(claims(rows, signs), len(rows[0]) - 1) is not None


def claims(rows: Sequence[Row], signs: IntArray) -> list[Row]:
    """Return the inequalities of a vector of signs."""
    return [rows[k] if signs[k] > 0 else opposite(rows[k]) for k in np.flatnonzero(signs).tolist()]


class TooMany(Exception):
    """There are more regions than were asked for."""


@dataclass(frozen=True, kw_only=True)
class Arrangement:
    """The regions of a set of hyperplanes."""

    points: dict[int, Point]  # by region a point inside it, as `polyhedron.Point` in coordinates of its own
    columns: list[int]  # the r states that move in them; the others are 0
    back: Rational  # takes these coordinates to those states, (r, r)

    def point(self, region: int, n: int) -> tuple[Fraction, ...]:
        """Return a point (n,) inside a region."""
        *Y, W = self.points[region]
        x = [Fraction(0)] * n
        moving = self.back * rational([[Fraction(y, W)] for y in Y], (len(Y), 1))
        for column, v in zip(self.columns, moving.entries(), strict=True):
            x[column] = fraction_of(v)
        return tuple(x)


def arrangement(planes: Sequence[Row], most: int) -> Arrangement:
    """Return the regions of distinct hyperplanes in ℝⁿ; raises `TooMany` if there are more than `most`.

    Example: three lines of general position in the plane leave one of eight combinations out.

        >>> sorted(arrangement([(1, 0, 0), (0, 1, 0), (1, 1, -1)], 10).points)
        [0, 1, 2, 3, 5, 6, 7]
    """
    n = len(planes[0]) - 1 if planes else 0
    normals = rational([row[:-1] for row in planes], (len(planes), n))
    forms = on_entries(normals, pivots(normals.transpose()), range(n))
    columns = pivots(forms)
    r = len(columns)
    back = on_entries(forms, range(r), columns).inv()
    turned = (on_entries(normals, range(len(planes)), columns) * back).tolist()
    own = [primitive([*map(fraction_of, line), row[-1]]) for line, row in zip(turned, planes, strict=True)]
    return Arrangement(points=_regions(own, r, most), columns=columns, back=back)


def _regions(planes: Sequence[Row], r: int, most: int) -> dict[int, Point]:
    """Return the regions in ℝʳ with a point of each, where every coordinate has a hyperplane across it."""
    across: list[list[int]] = [[] for _ in range(r)]
    others: list[int] = []
    for k, row in enumerate(planes):
        moving = [j for j in range(r) if row[j]]
        (across[moving[0]] if len(moving) == 1 else others).append(k)
    if prod(len(ks) + 1 for ks in across) > most:
        raise TooMany
    intervals = list[list[tuple[int, Fraction]]]()  # between parallel hyperplanes, with a short number in each
    for j, ks in enumerate(across):
        marks = sorted((Fraction(-planes[k][-1], planes[k][j]), k) for k in ks)
        region, samples = sum(1 << k for _, k in marks if planes[k][j] < 0), [marks[0][0] - 1]
        for (low, _), (high, _) in pairwise(marks):
            gap = high - low
            bits = max(0, gap.denominator.bit_length() - gap.numerator.bit_length() + 1)
            samples.append(Fraction((low.numerator << bits) // low.denominator + 1, 1 << bits))
        regions = accumulate((1 << k for _, k in marks), xor, initial=region)
        intervals.append(list(zip(regions, [*samples, marks[-1][0] + 1], strict=True)))
    W = lcm(*(sample.denominator for each in intervals for _, sample in each))
    scaled = [[(region, int(sample * W)) for region, sample in each] for each in intervals]
    found = {sum(region for region, _ in box): (*(X for _, X in box), W) for box in product(*scaled)}
    done = [k for ks in across for k in ks]
    for k in others:
        _cut(found, planes, done, k, most)
        done.append(k)
    return found


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
