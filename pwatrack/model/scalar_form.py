"""A field as A x + b and a sum of scalar piecewise linear elements: as it was written, or read off cells."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from pwatrack.ball_matrix import BallMatrix
from pwatrack.errors import InvalidSpec, listed
from pwatrack.model.cells import Partition
from pwatrack.model.nonlinearity import Nonlinearity, PiecewiseLinear, ScalarForm, generate_cells
from pwatrack.model.pwa import PWASystem, linear_form_text
from pwatrack.rational import Rational, fraction_of
from pwatrack.real import Real

Row = tuple[Fraction, ...]


def scalar_form(plant: PWASystem) -> ScalarForm | None:
    """Return the field as A x + b + Σ direction φ(row · x + constant), or None where cells are not of this form.

    Cells are where the field bends by the same vector all along each hyperplane: then it is the sum of these bends, of
    which those on parallel hyperplanes along the same direction are one element. That the sum is the field is
    decided exactly, region by region; cells with irrational numbers are left as they are.

    Example: a gap between two springs, in three cells.

        >>> from pwatrack import load_spec
        >>> form = scalar_form(load_spec("specs/two_mass_backlash.yaml").problem.plant)
        >>> [(e.name, [float(s) for s in e.function.breakpoints]) for e in form.elements]
        [('gap', [-0.1, 0.05])]
    """
    if plant.written is not None:
        return plant.written
    if not plant.exact.exact or len(plant.exact.A) == 1:
        return None
    bends = _bends(plant)
    if bends is None:
        return None
    form = _collected(plant, bends)
    return form if _is_field(form, plant) else None


def with_elements(plant: PWASystem, form: ScalarForm) -> PWASystem:
    """Return a plant with another field, and everything else as it is; elements that are lines join A and b."""
    A, b, kept = form.A, form.b, list[Nonlinearity]()
    for element in form.elements:
        slopes = element.function.slopes
        if any(slope != slopes[0] for slope in slopes):
            kept.append(element)
            continue
        across, along = _line(element, slopes[0], element.function.intercepts[0])
        A, b = A + across, b + along
    partition, matrices, offsets = generate_cells(A, b, kept)
    exact = plant.exact
    found = PWASystem.create(
        partition=partition,
        A=matrices,
        b=offsets,
        B=exact.B,
        C=exact.C,
        tracked=exact.tracked,
        states=plant.states,
        inputs=plant.inputs,
        outputs=plant.outputs,
        tracked_names=plant.tracked_names,
        continuous=True,
    )
    written = ScalarForm(A=A, b=b, elements=tuple(kept))
    return replace(found, loads=plant.loads, written=written, remarks=plant.remarks)


def _line(element: Nonlinearity, slope: Real, intercept: Real) -> tuple[BallMatrix, BallMatrix]:
    """Return what a line φ adds to A and b."""
    column, row = BallMatrix.of([[v] for v in element.direction]), BallMatrix.of([element.row])
    offset = slope * Real.of(element.constant) + intercept
    return column @ BallMatrix.of([[slope]]) @ row, column @ BallMatrix.of([[offset]])


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


def _collected(plant: PWASystem, bends: dict[int, Row]) -> ScalarForm:
    """Return the sum of all bends, those of one direction along parallel hyperplanes as one element."""
    groups: dict[tuple[Row, Row], list[int]] = {}
    for k, gamma in bends.items():
        groups.setdefault((_direction(plant.partition.exact_H[k]), _direction(gamma)), []).append(k)
    elements = [_element(plant, bends, members) for members in groups.values()]
    x = _point(plant.partition, plant.partition.signs[0])
    A, b = plant.exact.A[0], plant.exact.b[0]
    for element in elements:
        function = element.function
        s = sum((Fraction(h) * v for h, v in zip(element.row, x, strict=True)), Fraction(0))
        k = sum(mark.centre < s for mark in function.breakpoints)
        across, along = _line(element, function.slopes[k], function.intercepts[k])
        A, b = A - across, b - along
    return ScalarForm(A=A, b=b, elements=tuple(elements))


def _element(plant: PWASystem, bends: dict[int, Row], members: Sequence[int]) -> Nonlinearity:
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
        name=_between(plant, row, first, hinges[-1][0]),
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


def _between(plant: PWASystem, row: Row, low: Fraction, high: Fraction) -> str:
    """Return the names of the cells that lie between two values of a form, of many the first; else the form."""
    names = [
        name
        for name, signs in zip(plant.cell_names, plant.partition.signs, strict=True)
        if low < _value(row, Fraction(0), _point(plant.partition, signs)) < high
    ]
    return listed(names, 1) if names else linear_form_text(np.array([float(v) for v in row]), plant.states)


def _is_field(form: ScalarForm, plant: PWASystem) -> bool:
    """Decide whether a sum of elements is the field of a plant: in every region that all hyperplanes cut out."""
    try:
        partition, A, b = generate_cells(form.A, form.b, form.elements)
    except InvalidSpec:
        return False
    cells, exact = plant.partition, plant.exact
    for signs, A_i, b_i in zip(partition.signs, A, b, strict=True):
        x = _point(partition, signs)
        sides = [_sign(_value(H, h, x)) for H, h in zip(cells.exact_H, cells.exact_h, strict=True)]
        here = [j for j, claim in enumerate(cells.signs) if all(s * t >= 0 for s, t in zip(claim, sides, strict=True))]
        if not any(_same(A_i.centre, exact.A[j].centre) and _same(b_i.centre, exact.b[j].centre) for j in here):
            return False
    return True


def _same(X: Rational, Y: Rational) -> bool:
    return bool(X == Y)


def _sign(value: Fraction) -> int:
    return (value > 0) - (value < 0)


def _value(H: Iterable[Fraction], h: Fraction, x: Iterable[Fraction]) -> Fraction:
    return sum((a * v for a, v in zip(H, x, strict=True)), Fraction(h))


def _direction(v: Row) -> Row:
    """Return a vector with its first entry that is not 0 made 1."""
    first = next(entry for entry in v if entry)
    return tuple(entry / first for entry in v)


def _point(partition: Partition, signs: object) -> tuple[Fraction, ...]:
    x = partition.interior_point(signs)  # type: ignore[arg-type]
    assert x is not None
    return x
