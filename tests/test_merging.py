"""Cells that are merged: the plant is the merged one and a bounded deviation, exactly, and the least one."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from pwatrack import load_spec
from pwatrack.ball_matrix import BallMatrix
from pwatrack.model.cells import Partition
from pwatrack.model.nonlinearity import (
    Nonlinearity,
    PiecewiseLinear,
    ScalarForm,
    dead_zone,
    generate_cells,
    piecewise_linear,
)
from pwatrack.model.pwa import PWASystem
from pwatrack.model.simplification import merged, merges, scalar_form
from pwatrack.real import Real
from tests.plants import random_plant


def alone(function: PiecewiseLinear) -> ScalarForm:
    nothing = BallMatrix.of([[0]])
    element = Nonlinearity(name="it", function=function, row=[1], constant=0, direction=[1])
    return ScalarForm(A=nothing, b=nothing, elements=(element,))


@pytest.mark.parametrize("seed", range(20))
def test_a_merge_deviates_by_its_largest_and_no_other_corner_and_offset_by_less(seed: int) -> None:
    random = np.random.default_rng(seed)
    k = 2 + seed % 4
    marks = np.sort(np.round(random.normal(size=k) * 3, 2))
    function = piecewise_linear(breakpoints=marks.tolist(), slopes=np.round(random.normal(size=k + 1), 2).tolist())
    s = np.concatenate([np.linspace(-30, 30, 2001), marks])
    phi = np.array([function(v) for v in s])
    found = merges(alone(function), 0)
    assert len(found) == k * (k - 1) // 2
    assert [m.largest for m in found] == sorted(m.largest for m in found)
    for merge in found:
        corners = [float(mark) for mark in merge.function.breakpoints]
        grid = np.concatenate([s, corners])
        seen = max(abs(function(v) - merge.function(v)) for v in grid)
        assert seen == pytest.approx(float(merge.largest), rel=1e-12)
    whole = next(merge for merge in found if (merge.first, merge.last) == (0, k - 1))
    left, right = float(function.slopes[0]), float(function.slopes[-1])
    pick = np.maximum if left < right else np.minimum
    for a, b in random.normal(size=(2000, 2)) * 4:
        assert np.abs(pick(left * s + a, right * s + b) - phi).max() >= float(whole.largest) - 1e-9


def test_a_dead_zone_inside_stops_is_merged_and_the_stops_stay() -> None:
    function = piecewise_linear(breakpoints=[-3, -1, 1, 4], slopes=[5, 2, 0, 2, 6])
    inner = next(merge for merge in merges(alone(function), 0) if (merge.first, merge.last) == (1, 2))
    assert [float(v) for v in inner.function.breakpoints] == [-3, 4]
    assert [float(v) for v in inner.function.slopes] == [5, 2, 6]
    assert inner.largest == 2


def test_slopes_that_may_differ_by_rounding_are_not_taken_for_one() -> None:
    root = Real.of(2).applied("sqrt")
    same = dead_zone(lower=-1, upper=1, lower_slope=root, upper_slope=root)
    other = dead_zone(lower=-1, upper=1, lower_slope=root, upper_slope=Real.of(2).applied("sqrt"))
    (merge,) = merges(alone(same), 0)
    assert merge.largest > root.centre  # above what any number in the ball makes it
    assert merges(alone(other), 0) == []


def field(plant: PWASystem, x: tuple[Fraction, ...]) -> list[Fraction]:
    """f(x), exactly."""
    sides = [
        sum((a * v for a, v in zip(H, x, strict=True)), h)
        for H, h in zip(plant.partition.exact_H, plant.partition.exact_h, strict=True)
    ]
    i = next(
        i for i, signs in enumerate(plant.partition.signs) if all(s * v >= 0 for s, v in zip(signs, sides, strict=True))
    )
    fractions = BallMatrix.of([[v] for v in x])
    made = plant.exact.A[i] @ fractions + plant.exact.b[i]
    return [Fraction(int(v.p), int(v.q)) for v in made.centre.entries()]


@pytest.mark.parametrize("seed", range(8))
def test_the_field_is_the_merged_one_and_the_deviations(seed: int) -> None:
    random = np.random.default_rng(seed)
    n = 3
    elements = []
    for k in range(3):
        marks = np.sort(np.round(random.normal(size=2 + k % 2), 2)).tolist()
        slopes = np.round(random.normal(size=3 + k % 2), 2).tolist()
        row, direction = np.round(random.normal(size=(2, n)), 2).tolist()
        function = piecewise_linear(breakpoints=marks, slopes=slopes)
        elements.append(Nonlinearity(name=f"e{k}", function=function, row=row, constant=0.3, direction=direction))
    A, b = np.round(random.normal(size=(n, n)), 2), [[0.1], [0.2], [0.3]]
    form = ScalarForm(A=BallMatrix.of(A), b=BallMatrix.of(b), elements=tuple(elements))
    blank = PWASystem.create(
        partition=Partition.create(H=np.zeros((0, n)), h=[], signs=[[]], names=["all"]),
        A=[np.zeros((n, n))],
        b=[np.zeros(n)],
        B=np.ones((n, 1)),
        C=np.eye(n)[:1],
    )
    plant = merged(blank, form, {})
    chosen = {k: merges(form, k)[-1] for k in (0, 2)}
    less = merged(plant, form, chosen)
    assert len(less.A) < len(plant.A)
    read = scalar_form(replace(plant, written=None))
    assert read is not None
    assert len(read.elements) == 3
    again = merged(plant, read, {})
    for x in ([Fraction(repr(v)) for v in row] for row in np.round(4 * random.normal(size=(60, n)), 3).tolist()):
        point = tuple(x)
        assert field(again, point) == field(plant, point)
        rest = field(plant, point)
        for k, merge in chosen.items():
            s = float(sum(Fraction(repr(r)) * v for r, v in zip(elements[k].row, point, strict=True))) + 0.3
            w = elements[k].function(s) - merge.function(s)
            assert abs(w) <= float(merge.largest) * (1 + 1e-12)
            rest = [
                v - Fraction(repr(float(d))) * Fraction(w) for v, d in zip(rest, elements[k].direction, strict=True)
            ]
        assert np.allclose([float(v) for v in rest], [float(v) for v in field(less, point)], atol=1e-12)


def least_of_both(cells: Partition) -> PWASystem:
    """Return x' = y in the first of four cells and x in the second, 0 in the others."""
    return PWASystem.create(
        partition=cells,
        A=[[[0, 1], [0, 0]], [[1, 0], [0, 0]], [[0, 0], [0, 0]], [[0, 0], [0, 0]]],
        b=[[0, 0]] * 4,
        B=[[0], [1]],
        C=[[1, 0]],
    )


def test_cells_that_are_no_sum_of_elements_are_left_alone() -> None:
    corner = Partition.create(
        H=[[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]],
        h=[0.0, 0.0, 0.0],
        signs=[[1, 1, 1], [1, 1, -1], [-1, 0, 0], [1, -1, 0]],
        names=["a", "b", "c", "d"],
    )  # min(x, y) in the first quadrant, 0 elsewhere: each border is bent along one half only
    plant = least_of_both(corner)
    assert scalar_form(plant) is None


def test_a_border_that_ends_inside_a_cell_is_no_element() -> None:
    """min(x, y) in the first quadrant, 0 elsewhere: x = 0 bends wherever it is a border, and not below y = 0."""
    corner = Partition.create(
        H=[[1, 0], [0, 1], [1, -1], [2, -1]],
        h=[0, 0, 0, 0],
        signs=[[0, 1, 1, 0], [1, 0, -1, 0], [0, -1, 0, 1], [-1, 0, 0, -1]],
        names=["a", "b", "below", "left"],
    )
    plant = least_of_both(corner)
    assert len(plant.partition.facets) == 4
    assert scalar_form(plant) is None


@pytest.mark.parametrize("seed", range(6))
def test_cells_that_name_only_their_borders_are_read_too(seed: int) -> None:
    """A dead zone along each of two rows; of parallel borders a cell outside needs only one."""
    random = np.random.default_rng(seed)
    rows = np.round(random.normal(size=(2, 3)), 2)
    elements = tuple(
        Nonlinearity(
            name=f"e{k}",
            function=dead_zone(lower=-1, upper=2, lower_slope=0.5, upper_slope=3),
            row=rows[k].tolist(),
            constant=0,
            direction=np.round(random.normal(size=3), 2).tolist(),
        )
        for k in range(2)
    )
    A, b, sides = random.integers(-3, 4, size=(3, 3)), [[0], [1], [0]], ((-1, 0), (1, -1), (0, 1))
    _, fields, offsets = generate_cells(BallMatrix.of(A), BallMatrix.of(b), elements)
    plant = PWASystem.create(
        partition=Partition.create(
            H=np.repeat(rows, 2, axis=0),
            h=[1, -2, 1, -2],
            signs=[i + j for i in sides for j in sides],
            names="abcdefghi",
        ),
        A=fields,
        b=offsets,
        B=np.ones((3, 1)),
        C=np.eye(3)[:1],
    )
    read = scalar_form(plant)
    assert read is not None
    assert len(read.elements) == 2
    again = merged(plant, read, {})
    for x in random.integers(-40, 40, size=(40, 3)):
        point = tuple(Fraction(int(v), 7) for v in x)
        assert field(again, point) == field(plant, point)


def test_what_cells_say_is_what_was_written(specs: Path) -> None:
    plant = load_spec(specs / "gallery" / "train_slack_couplings.yaml").problem.plant
    read = scalar_form(replace(plant, written=None))
    assert read is not None
    assert sorted(e.row.index(1) for e in read.elements) == [1, 3, 5]
    assert [len(merges(read, k)) for k in range(3)] == [1, 1, 1]
    written = scalar_form(plant)
    assert written is not None
    less = [merged(plant, form, {k: merges(form, k)[0] for k in range(3)}) for form in (read, written)]
    assert [len(plant.A) for plant in less] == [1, 1]
    assert np.allclose(less[0].A, less[1].A, rtol=1e-15)


def test_random_plants_are_sums_of_elements() -> None:
    plant = random_plant(3, n=5, k=3, r=2)
    read = scalar_form(replace(plant, written=None))
    assert read is not None
    again = merged(plant, read, {})
    assert len(again.A) == len(plant.A)
