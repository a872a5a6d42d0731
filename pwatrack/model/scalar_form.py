"""A field as A x + b and a sum of scalar piecewise linear elements: as it was written, or read off cells."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

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
    return None if _bends_inside(plant.partition, bends, points) else _collected(plant, bends, points)


def with_elements(plant: PWASystem, form: ScalarForm) -> PWASystem:
    """Return a plant with another field, and everything else as it is; elements that are lines join A and b."""
    A, b, kept = form.A, form.b, list[Nonlinearity]()
    for element in form.elements:
        slopes = element.function.slopes
        if any(slope != slopes[0] for slope in slopes):
            kept.append(element)
            continue
        across, along = element.on(0)
        A, b = A + across, b + along
    partition, matrices, offsets = generate_cells(A, b, kept)
    exact = replace(plant.exact, A=tuple(matrices), b=tuple(offsets))
    written = ScalarForm(A=A, b=b, elements=tuple(kept))
    return replace(plant, partition=partition, exact=exact, repair=None, written=written, watched=None)


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


def _collected(plant: PWASystem, bends: dict[int, Row], points: Sequence[Row]) -> ScalarForm:
    """Return the sum of all bends, those of one direction along parallel hyperplanes as one element."""
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


def _element(plant: PWASystem, bends: dict[int, Row], members: Sequence[int], points: Sequence[Row]) -> Nonlinearity:
    """Return direction φ(row · x), the row that of the first hyperplane."""
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
    count = len(hinges)
    return Nonlinearity(
        name=_between(plant, points, row, first, hinges[-1][0]),
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


def _between(plant: PWASystem, points: Sequence[Row], row: Row, low: Fraction, high: Fraction) -> str:
    """Return the names of the cells that lie between two values of a form, of many the first; else the form."""
    values = (_value(row, Fraction(0), x) for x in points)
    names = [name for name, value in zip(plant.cell_names, values, strict=True) if low < value < high]
    return listed(names, 1) if names else linear_form_text(np.array([float(v) for v in row]), plant.states)


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
