"""Scalar piecewise linear elements φ(s), s = row · x + constant, and the cells they make of the state space."""

import itertools
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.ball_matrix import BallMatrix
from pwatrack.model.cells import Partition
from pwatrack.model.contact import Contact
from pwatrack.model.linear_form import LinearForm, PiecewiseElement
from pwatrack.real import Real

Number = Real | Fraction | float

MOST_LISTED = 20_000  # cells of which tables are written to files: 80 MB with ten states
_MOST_CELLS = 100_000  # that nonlinearities may make together: a gigabyte with ten states


@dataclass(frozen=True, kw_only=True)
class PiecewiseLinear:
    """A continuous scalar function φ, linear between breakpoints.

    Example:
        >>> clip = saturation(lower=-1.0, upper=2.0, slope=3.0)
        >>> [clip(s) for s in (-5.0, 0.5, 9.0)]
        [-3.0, 1.5, 6.0]
    """

    breakpoints: tuple[Real, ...]  # increasing, k of them
    slopes: tuple[Real, ...]  # k + 1 of them, from left to right
    value: Real  # φ at the first breakpoint
    segments: tuple[str, ...]  # a name for each of the k + 1 segments

    def __call__(self, s: float) -> float:
        """Return φ(s)."""
        k = bisect_left([float(mark) for mark in self.breakpoints], s)
        return float(self.slopes[k]) * s + float(self.intercepts[k])

    @property
    def ends(self) -> list[int]:
        """The first segments with the least and with the largest slope."""
        values = [slope.centre for slope in self.slopes]
        return sorted({values.index(min(values)), values.index(max(values))})

    @cached_property
    def intercepts(self) -> tuple[Real, ...]:
        """The c_k with φ(s) = slopes[k] s + c_k on segment k."""
        found = [self.value - self.slopes[0] * self.breakpoints[0]]
        for k, s in enumerate(self.breakpoints):
            found.append(found[-1] + (self.slopes[k] - self.slopes[k + 1]) * s)
        return tuple(found)


def dead_zone(*, lower: Number, upper: Number, lower_slope: Number = 1, upper_slope: Number = 1) -> PiecewiseLinear:
    """Return φ = 0 between lower and upper, and a line from there on either side: gaps, backlash springs, stops."""
    return _function([lower, upper], [lower_slope, 0, upper_slope], 0, ("below", "inside", "above"))


def saturation(*, lower: Number, upper: Number, slope: Number = 1) -> PiecewiseLinear:
    """Return φ(s) = slope · clip(s, lower, upper)."""
    value = Real.of(slope) * lower
    return _function([lower, upper], [0, slope, 0], value, ("low", "linear", "high"))


def spring(*, start: Number = 0, slope: Number = 1) -> PiecewiseLinear:
    """Return φ(s) = slope · max(0, s − start): a one-sided spring, a ReLU, an ideal diode."""
    return _function([start], [0, slope], 0, ("off", "on"))


def absolute(*, slope: Number = 1) -> PiecewiseLinear:
    """Return φ(s) = slope · |s|."""
    return _function([0], [-Real.of(slope), slope], 0, ("negative", "positive"))


def piecewise_linear(
    *, breakpoints: Sequence[Number], slopes: Sequence[Number], value: Number | None = None
) -> PiecewiseLinear:
    """Return φ with free breakpoints and slopes; without `value` at the first breakpoint, φ(0) = 0.

    Raises ValueError if the breakpoints do not increase or there is not one slope more than breakpoints.
    """
    names = tuple(f"segment {k + 1}" for k in range(len(slopes)))
    function = _function(breakpoints, slopes, 0 if value is None else value, names)
    if value is not None:
        return function
    at_zero = function.intercepts[bisect_left(function.breakpoints, Real.of(0))]
    return _function(breakpoints, slopes, -at_zero, names)


def _function(
    breakpoints: Sequence[Number], slopes: Sequence[Number], value: Number, segments: tuple[str, ...]
) -> PiecewiseLinear:
    marks = tuple(Real.of(s) for s in breakpoints)
    for left, right in itertools.pairwise(marks):
        if not left < right:
            raise ValueError(f"{float(left):g} and {float(right):g} are not in increasing order")
    if not marks:
        raise ValueError("at least one breakpoint is expected")
    if len(slopes) != len(marks) + 1:
        raise ValueError(f"{len(slopes)} slopes for {len(marks)} breakpoints, expected one more than breakpoints")
    return PiecewiseLinear(
        breakpoints=marks, slopes=tuple(Real.of(v) for v in slopes), value=Real.of(value), segments=segments
    )


@dataclass(frozen=True, kw_only=True)
class Nonlinearity(PiecewiseElement):
    """Adds direction · φ(row · x + constant) to ẋ.

    All numbers are `Real`, fractions, or doubles, which count as the decimals that they print as.
    """

    function: PiecewiseLinear  # φ
    row: Any  # of the linear form, (n,)
    constant: Number  # of the linear form

    @cached_property
    def of(self) -> LinearForm:
        """s, exactly."""
        return LinearForm(tuple(map(Real.of, self.row)), Real.of(self.constant))

    @property
    def planes(self) -> list[LinearForm]:
        """Forms that are 0 at its breakpoints."""
        return [self.of - s for s in self.function.breakpoints]

    @property
    def cells(self) -> list[tuple[str, IntArray, LinearForm]]:
        """Of each segment its name, the signs of the planes, and what φ(row · x + constant) is there."""
        count, (slopes, intercepts) = len(self.planes), (self.function.slopes, self.function.intercepts)
        forms = [self.of * slope + rest for slope, rest in zip(slopes, intercepts, strict=True)]
        signs = 2 * np.tri(count + 1, count, -1, dtype=np.int64) - 1
        return list(zip(self.function.segments, signs, forms, strict=True))

    def located(self, sides: IntArray) -> IntArray:
        """Return its segment for each row of sides of its planes, (l, planes); of many, no table is compared."""
        return np.asarray((sides > 0).sum(axis=1))


@dataclass(frozen=True, kw_only=True)
class ScalarForm:
    """The field A x + b + Σ direction φ(row · x + constant)."""

    A: BallMatrix  # (n, n)
    b: BallMatrix  # (n, 1)
    elements: tuple[Nonlinearity, ...]

    @cached_property
    def product(self) -> bool:
        """Whether each combination of segments is a cell: the rows are independent. All numbers are to be exact."""
        parts = [(e, e.function) for e in self.elements]
        lists = [(*e.row, *e.direction, e.constant, *f.breakpoints, *f.slopes, f.value) for e, f in parts]
        numbers = [Real.of(v) for part in lists for v in part]
        if not self.elements or any(X.radius is not None for X in (self.A, self.b)) or any(v.radius for v in numbers):
            return False
        return bool(BallMatrix.of([element.row for element in self.elements]).centre.rank() == len(self.elements))

    @cached_property
    def corners(self) -> tuple[int, ...]:
        """The cells at the corners of the box of slopes, where `product` holds: each A_i is a mean of theirs."""
        counts = [len(element.function.slopes) for element in self.elements]
        cells = itertools.product(*(element.function.ends for element in self.elements))
        return tuple(int(np.ravel_multi_index(cell, counts)) for cell in cells)


def drives_away(A: Array, slopes: Sequence[float], row: Array, d: Array) -> list[int]:
    """Return the states through which an element drives what it looks at away from where it acts.

    With s = row · x + constant and row · d = 0, φ(s) of these slopes enters s̈ through row A d, the sum over the states
    that it drives; A (n, n) is without the elements. Where one of these terms has the sign of φ's slope, the element
    drives s away through that state. Nothing is said of one whose slopes have both signs, or that acts on ṡ at once.
    """
    signs = {float(np.sign(slope)) for slope in slopes if slope}
    if len(signs) != 1 or row @ d != 0:
        return []
    terms = (row @ A) * d
    size = np.abs(row) @ np.abs(A) * np.abs(d)  # a term below rounding says nothing
    return [int(j) for j in np.flatnonzero(terms * signs.pop() > 1e-12 * size)]


def generate_cells(
    A: BallMatrix, b: BallMatrix, elements: Sequence[Nonlinearity | Contact]
) -> tuple[Partition, list[BallMatrix], list[BallMatrix]]:
    """Return the cells, A_i (n, n) and b_i (n, 1) of ẋ = A x + b + Σ direction φ(row · x + constant), or of contacts.

    One cell for each combination of segments that has an interior: the regions that the hyperplanes of all
    breakpoints cut ℝⁿ into, joined where contacts do not tell them apart. The field is continuous by construction,
    exactly. Raises InvalidSpec for too many cells.
    """
    if not elements:
        return Partition.create(H=np.zeros((0, len(b.floats))), h=[], signs=[[]], names=["everywhere"]), [A], [b]
    planes = [plane for element in elements for plane in element.planes]
    rows, offsets = [list(plane.coefficients) for plane in planes], [plane.offset for plane in planes]
    regions = Partition.regions(H=np.array(rows, dtype=object), h=offsets, most=_MOST_CELLS)
    sides = regions.sides(H=rows, h=offsets)
    last = np.cumsum([len(element.planes) for element in elements])[:-1]
    parts = zip(elements, np.split(sides, last, axis=1), strict=True)
    combinations = np.array([element.located(part) for element, part in parts]).T
    different, order = np.unique(combinations, axis=0, return_index=True)
    chosen = [tuple(combination) for combination in different.tolist()]
    named = [[f"{element.name} {segment}" for segment in element.segments] for element in elements]
    names = tuple(", ".join(own[k] for own, k in zip(named, c, strict=True)) for c in chosen)
    steps = [[element.on(k) for k in range(len(element.segments))] for element in elements]
    alike = [tuple(element.alike[k] for element, k in zip(elements, c, strict=True)) for c in chosen]
    if any(isinstance(element, Contact) for element in elements):
        tables = [element.signs for element in elements]
        signs = np.array([np.concatenate([table[k] for table, k in zip(tables, c, strict=True)]) for c in chosen])
        partition = Partition.create(H=np.array(rows, dtype=object), h=offsets, signs=signs, names=names)
    else:
        partition = regions.ordered(order, names)
    return (
        partition,
        _sums(A, [[across for across, _ in step] for step in steps], alike),  # equal slopes share one matrix
        _sums(b, [[along for _, along in step] for step in steps], chosen),
    )


def _sums(
    start: BallMatrix, steps: Sequence[Sequence[BallMatrix]], chosen: Sequence[tuple[int, ...]]
) -> list[BallMatrix]:
    """Return start + steps[0][c_0] + steps[1][c_1] + … for each of the chosen c, in which equal ones are one object."""
    sums: dict[tuple[int, ...], BallMatrix] = {(): start}
    for position, step in enumerate(steps):
        sums = {c: sums[c[:-1]] + step[c[-1]] for c in dict.fromkeys(c[: position + 1] for c in chosen)}
    return [sums[c] for c in chosen]
