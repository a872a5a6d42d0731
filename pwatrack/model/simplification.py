"""A field as A x + b and a sum of scalar elements, as it was written or read off cells; and cells that are merged.

Of an element some breakpoints become one or none, and it deviates by a bounded amount. Let φ have the slopes l before
and r after some of its breakpoints in a row. Outside them φ̃ has the same slopes, between them it has at most one
corner: with l < r it is the largest max(l s + a, r s + b) ≤ φ there, shifted up by half of the largest difference D;
with l > r likewise from above; with l = r a line. A function max(l s + a', r s + b') that is nowhere more than w̄ from
φ is, shifted down by w̄, below φ, so it is at most that largest one, which is D below φ somewhere: no other corner and
offset has less than w̄ = D / 2.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain

import numpy as np

from pwatrack.ball_matrix import BallMatrix
from pwatrack.errors import listed
from pwatrack.model.cells import Partition
from pwatrack.model.nonlinearity import Nonlinearity, PiecewiseLinear, ScalarForm, generate_cells
from pwatrack.model.pwa import PWASystem, linear_form_text
from pwatrack.rational import fraction_of
from pwatrack.real import Real

Row = tuple[Fraction, ...]


def scalar_form(plant: PWASystem) -> ScalarForm | None:
    """Return the field as A x + b + Σ direction φ(row · x + constant), or None where cells are not of this form.

    It is the sum of its bends where it bends by the same vector all along each hyperplane: where all facets on one say
    so and none of them goes on through the interior of a cell, which is decided exactly. For then the sum is affine in
    each cell and bends as the field does from each to the next, and they are the same in the first one. Bends on
    parallel hyperplanes along the same direction are one element. Cells with irrational numbers are left as they are.
    """
    if plant.written is not None:
        return plant.written
    bends = _bends(plant) if plant.exact.exact and len(plant.exact.A) > 1 else None
    if bends is None:
        return None
    points = [x for signs in plant.partition.signs if (x := plant.partition.interior_point(signs)) is not None]
    assert len(points) == len(plant.cell_names), "every cell of a plant has an interior"
    if _bends_inside(plant.partition, bends, points):
        return None
    groups: dict[tuple[Row, Row], list[int]] = {}
    for k, gamma in bends.items():
        groups.setdefault((_direction(plant.partition.exact_H[k]), _direction(gamma)), []).append(k)
    elements = [_element(plant, bends, members, points) for members in groups.values()]
    A, b = plant.exact.A[0], plant.exact.b[0]
    for element in elements:
        s = _value(element.row, Fraction(0), points[0])
        across, along = element.on(sum(mark.centre < s for mark in element.function.breakpoints))
        A, b = A - across, b - along
    return ScalarForm(A=A, b=b, elements=tuple(elements))


def _bends(plant: PWASystem) -> dict[int, Row] | None:
    """Return for each hyperplane H x + h = 0 the γ with f = … + γ max(0, H x + h), or None if it differs along one."""
    partition, found = plant.partition, dict[int, Row]()
    for facet in partition.facets:
        i, j = (facet.i, facet.j) if partition.signs[facet.i, facet.k] < 0 else (facet.j, facet.i)
        H = partition.exact_H[facet.k]
        pivot = next(p for p, v in enumerate(H) if v)
        jump = plant.exact.A[j].centre - plant.exact.A[i].centre
        gamma = tuple(fraction_of(jump[row, pivot]) / H[pivot] for row in range(len(H)))
        if found.setdefault(facet.k, gamma) != gamma:
            return None
    return {k: gamma for k, gamma in found.items() if any(gamma)}


def _element(plant: PWASystem, bends: dict[int, Row], members: Sequence[int], points: Sequence[Row]) -> Nonlinearity:
    """Return direction φ(row · x), the row that of the first hyperplane; named by the cells that it bends around."""
    partition = plant.partition
    row, direction = partition.exact_H[members[0]], _direction(bends[members[0]])
    row = row if max(row) > 0 else tuple(-v for v in row)
    at, along = (next(p for p, v in enumerate(X) if v) for X in (row, direction))
    hinges = []  # where, by how much the slope changes there, and what it is on the left
    for k in members:
        scale, size = partition.exact_H[k][at] / row[at], bends[k][along] / direction[along]
        hinges.append((-partition.exact_h[k] / scale, size * abs(scale), size * min(scale, Fraction(0))))
    hinges.sort()
    slopes = [sum((left for *_, left in hinges), Fraction(0))]
    for _, change, _ in hinges:
        slopes.append(slopes[-1] + change)
    first = hinges[0][0]
    value = sum((left * (first - where) for where, _, left in hinges), Fraction(0))
    count, values = len(hinges), (_value(row, Fraction(0), x) for x in points)
    inside = [cell for cell, s in zip(plant.cell_names, values, strict=True) if first < s < hinges[-1][0]]
    name = listed(inside, 1) if inside else linear_form_text(np.array([float(v) for v in row]), plant.states)
    return Nonlinearity(
        name=name,
        function=PiecewiseLinear(
            breakpoints=tuple(Real.of(where) for where, *_ in hinges),
            slopes=tuple(map(Real.of, slopes)),
            value=Real.of(value),
            segments=(
                "below",
                *(["between"] if count == 2 else [f"segment {k + 1}" for k in range(1, count)]),
                "above",
            ),
        ),
        row=row,
        constant=Fraction(0),
        direction=direction,
    )


def _bends_inside(partition: Partition, planes: Collection[int], points: Sequence[Row]) -> bool:
    """Decide whether one of some hyperplanes passes through the interior of a cell; `points` has one inside each."""
    for signs, x in zip(partition.signs, points, strict=True):
        for k in planes:
            if signs[k]:
                continue
            side, beyond = _value(partition.exact_H[k], partition.exact_h[k], x), signs.copy()
            beyond[k] = -1 if side > 0 else 1
            if not side or partition.interior_point(beyond) is not None:
                return True
    return False


def _value(H: Iterable[Fraction], h: Fraction, x: Iterable[Fraction]) -> Fraction:
    return sum((a * v for a, v in zip(H, x, strict=True)), Fraction(h))


def _direction(v: Row) -> Row:
    """Return a vector with its first entry that is not 0 made 1."""
    first = next(entry for entry in v if entry)
    return tuple(entry / first for entry in v)


@dataclass(frozen=True, kw_only=True)
class Simplification:
    """φ = φ̃ + w with |w| ≤ largest everywhere."""

    element: int  # of those of a plant, counted from 0
    nonlinearity: Nonlinearity  # that one, with φ
    first: int  # the first breakpoint of φ, and
    last: int  # the last one, of those that become one or none
    function: PiecewiseLinear  # φ̃; where it is a line it has one breakpoint with the same slope on either side
    largest: Fraction  # w̄, exact; an upper bound of it where φ has irrational numbers

    @property
    def column(self) -> BallMatrix:
        """By which w enters ẋ, (n, 1)."""
        return BallMatrix.of([[v] for v in self.nonlinearity.direction])


def merges(form: ScalarForm, element: int) -> list[Simplification]:
    """Return all ways to merge cells of one element, those with the least deviation first."""
    count = len(form.elements[element].function.breakpoints)
    found = (_ways(form, element, width) for width in range(1, count))
    return sorted(chain.from_iterable(found), key=lambda merge: (merge.largest, merge.last - merge.first, merge.first))


def widest(form: ScalarForm) -> dict[int, Simplification]:
    """Return each element merged whole, or as much of it as can be, where it can be."""
    chosen = dict[int, Simplification]()
    for k, element in enumerate(form.elements):
        widths = (_ways(form, k, width) for width in reversed(range(1, len(element.function.breakpoints))))
        ways = next(filter(None, widths), [])
        if ways:
            chosen[k] = min(ways, key=lambda merge: merge.largest)
    return chosen


def _ways(form: ScalarForm, element: int, width: int) -> list[Simplification]:
    """Return all ways to merge so many cells of an element, and the next one."""
    nonlinearity, found = form.elements[element], list[Simplification]()
    function = nonlinearity.function
    for first in range(len(function.breakpoints) - width):
        other = _merged(function, first, first + width)
        if other is not None:
            marks = (*function.breakpoints, *other.breakpoints)  # outside all of these, both have the same slopes
            gaps = [_at(function, mark) - _at(other, mark) for mark in marks]
            found.append(
                Simplification(
                    element=element,
                    nonlinearity=nonlinearity,
                    first=first,
                    last=first + width,
                    function=other,
                    largest=max(abs(gap.centre) + gap.radius for gap in gaps),
                )
            )
    return found


def merged(plant: PWASystem, form: ScalarForm, chosen: Mapping[int, Simplification]) -> PWASystem:
    """Return the plant f̃ in which some elements of its form are merged, each in one way; `chosen` has their numbers."""
    A, b, kept = form.A, form.b, list[Nonlinearity]()
    for k, element in enumerate(form.elements):
        one = replace(element, function=chosen[k].function) if k in chosen else element
        slopes = one.function.slopes
        if any(slope != slopes[0] for slope in slopes):
            kept.append(one)
        else:  # a line: it joins A and b
            across, along = one.on(0)
            A, b = A + across, b + along
    partition, matrices, offsets = generate_cells(A, b, kept)
    exact = replace(plant.exact, A=tuple(matrices), b=tuple(offsets))
    written = ScalarForm(A=A, b=b, elements=tuple(kept))
    return replace(plant, partition=partition, exact=exact, repair=None, written=written, watched=None)


def _merged(function: PiecewiseLinear, first: int, last: int) -> PiecewiseLinear | None:
    """Return φ̃, or None where it is not known whether the slopes on both sides are the same."""
    left, right = function.slopes[first], function.slopes[last + 1]
    if left.centre == right.centre and left is not right and not (left.exact and right.exact):
        return None
    marks = function.breakpoints[first : last + 1]
    sign = 1 if left.centre <= right.centre else -1
    points, lines = [mark.centre for mark in marks], [sign * left.centre, sign * right.centre]
    heights = [sign * _at(function, mark).centre for mark in marks]
    offsets = [min(v - slope * s for v, s in zip(heights, points, strict=True)) for slope in lines]
    corner = points[0] if lines[0] == lines[1] else (offsets[0] - offsets[1]) / (lines[1] - lines[0])
    points, heights = [*points, corner], [*heights, sign * _at(function, Real.of(corner)).centre]
    D = max(
        v - max(slope * s + c for slope, c in zip(lines, offsets, strict=True))
        for v, s in zip(heights, points, strict=True)
    )
    offset = sign * (offsets[0] + D / 2)  # φ̃ = left s + offset before the corner
    before, after = function.breakpoints[:first], function.breakpoints[last + 1 :]
    inner = () if lines[0] == lines[1] and (before or after) else (Real.of(corner),)
    breakpoints = (*before, *inner, *after)
    slopes = (*function.slopes[: first + 1], *function.slopes[last + 1 + (not inner) :])
    value = Real.of(offset) + left * breakpoints[0]
    if before:  # there φ̃ − φ is constant
        value = function.value + Real.of(offset) - function.intercepts[first]
    names = function.segments
    joined = names[first] if names[first] == names[last + 1] else f"{names[first]} or {names[last + 1]}"
    middle = (names[first], names[last + 1]) if inner else (joined,)
    segments = (*names[:first], *middle, *names[last + 2 :])
    return PiecewiseLinear(breakpoints=breakpoints, slopes=slopes, value=value, segments=segments)


def _at(function: PiecewiseLinear, s: Real) -> Real:
    """Return φ(s)."""
    k = sum(mark.centre < s.centre for mark in function.breakpoints)
    return function.slopes[k] * s + function.intercepts[k]
