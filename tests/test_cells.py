"""Which cells exist, meet, overlap and cover: exactly, whatever the sizes of the numbers."""

import json
from collections.abc import Sequence
from fractions import Fraction
from itertools import combinations, pairwise
from math import comb
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from pwatrack.ball_matrix import BallMatrix
from pwatrack.cli import app
from pwatrack.errors import InvalidSpec, OutsideTheory
from pwatrack.model.cells import Partition
from pwatrack.model.nonlinearity import Nonlinearity, dead_zone, generate_cells, spring
from pwatrack.model.polyhedron import Row, borders, interior_point, opposite, primitive, value
from pwatrack.real import Real
from tests.scenarios import mass

entries = st.integers(-3, 3)
powers = st.integers(-150, 150).map(lambda k: Fraction(10) ** k)


def strictly_feasible(rows: Sequence[Sequence[Fraction | int]]) -> bool:
    """Decide a·x + c > 0 for all rows (a, c) by the elimination of Fourier and Motzkin: an oracle for few rows."""
    left = [[Fraction(v) for v in row] for row in rows]
    while left and len(left[0]) > 1:
        above = [[v / row[0] for v in row[1:]] for row in left if row[0] > 0]
        below = [[v / -row[0] for v in row[1:]] for row in left if row[0] < 0]
        left = [row[1:] for row in left if row[0] == 0]
        left += [[a + b for a, b in zip(one, other, strict=True)] for one in above for other in below]
    return all(row[0] > 0 for row in left)


def touching(one: Sequence[Row], other: Sequence[Row], plane: Row) -> bool:
    """Decide whether two polyhedra, one on each side of a hyperplane, share a set of dimension n − 1 on it."""
    j = next(j for j, v in enumerate(plane) if v)
    on = []
    for row in (*one, *other):
        if row not in (plane, opposite(plane)):
            left = [a - Fraction(row[j], plane[j]) * p for a, p in zip(row, plane, strict=True)]
            on.append(left[:j] + left[j + 1 :])
    return strictly_feasible(on)


def claimed(partition: Partition, i: int) -> list[Row]:
    return [
        row if sign > 0 else opposite(row)
        for row, sign in zip(partition.rows, partition.signs[i].tolist(), strict=True)
        if sign
    ]


def inside(partition: Partition, i: int, x: Sequence[float]) -> bool:
    point = primitive([*map(Fraction, x), Fraction(1)])
    return all(value(row, point) > 0 for row in claimed(partition, i))


rows_in = st.integers(1, 3).flatmap(
    lambda n: st.lists(st.tuples(*[entries] * n, entries).map(lambda row: primitive(row)), min_size=1, max_size=6)
)


@given(rows_in)
@settings(max_examples=150)
def test_interiors_and_borders_are_those_of_elimination(rows: list[Row]) -> None:
    n = len(rows[0]) - 1
    point, found = interior_point(rows, n), borders(rows, n)
    assert (point is not None) == (found is not None) == strictly_feasible(rows)
    if point is not None and found is not None:
        assert all(value(row, point) > 0 for row in rows)
        for row in found:
            assert strictly_feasible([*(other for other in found if other != row), opposite(row)])
        for row in rows:
            assert not strictly_feasible([*found, opposite(row)])


@given(st.lists(st.tuples(entries, entries, entries).filter(lambda row: any(row[:-1])), min_size=1, max_size=7))
@settings(max_examples=60)
def test_lines_in_the_plane_make_as_many_cells_and_facets_as_their_crossings_say(
    lines: list[tuple[int, ...]],
) -> None:
    distinct = {max(primitive(line), opposite(primitive(line))) for line in lines}
    crossings = [
        {
            (Fraction(b * f - c * e, a * e - b * d), Fraction(c * d - a * f, a * e - b * d))
            for d, e, f in distinct
            if a * e != b * d
        }
        for a, b, c in distinct
    ]
    through = [sum(point in points for points in crossings) for point in set().union(*crossings)]
    partition = Partition.regions(H=[line[:2] for line in lines], h=[line[2] for line in lines], most=100)
    assert len(partition.signs) == 1 + len(distinct) + sum(m - 1 for m in through)
    assert len(partition.facets) == sum(1 + len(points) for points in crossings)
    explicit = Partition.create(
        H=partition.exact_H,
        h=partition.exact_h,
        signs=partition.signs,
        names=[str(i) for i in range(len(partition.signs))],
    )
    explicit.check()
    assert explicit.facets == partition.facets


@pytest.mark.parametrize(("n", "k"), [(1, 7), (2, 12), (3, 8), (4, 6), (5, 5), (6, 4)])
def test_hyperplanes_in_general_position_make_the_cells_of_schlaefli(n: int, k: int) -> None:
    random = np.random.default_rng(n)
    partition = Partition.regions(H=random.normal(size=(k, n)), h=random.normal(size=k), most=1000)
    assert len(partition.signs) == sum(comb(k, j) for j in range(n + 1))
    assert len({tuple(row) for row in partition.signs.tolist()}) == len(partition.signs)
    assert len(partition.facets) == k * sum(comb(k - 1, j) for j in range(n))


def chain(marks: Sequence[Fraction], row: Sequence[Fraction], factors: Sequence[Fraction]) -> Partition:
    """Return the cells between parallel borders, each written by both cells with a factor of its own."""
    H, h = list[list[Fraction]](), list[Fraction]()
    signs = np.zeros((len(marks) + 1, 2 * len(marks)), dtype=int)
    for k, mark in enumerate(marks):
        for cell, side in ((k, -1), (k + 1, 1)):
            factor = factors[len(H)]
            H.append([factor * v for v in row])
            h.append(-factor * mark)
            signs[cell, len(H) - 1] = side if factor > 0 else -side
    return Partition.create(H=H, h=h, signs=signs, names=[f"c{i}" for i in range(len(marks) + 1)])


@given(st.data(), st.integers(1, 6), st.integers(1, 3))
@settings(max_examples=40)
def test_a_chain_of_cells_of_any_widths_keeps_every_cell(data: st.DataObject, k: int, n: int) -> None:
    marks = sorted(data.draw(st.sets(st.tuples(st.integers(-99, 99), powers).map(lambda v: v[0] * v[1]), min_size=k)))
    row = [data.draw(powers) for _ in range(n)]
    factors = [data.draw(st.sampled_from([-1, 1])) * data.draw(powers) for _ in range(2 * len(marks))]
    partition = chain(marks, row, factors)
    partition.check()
    assert not partition.empty_cells
    assert [(f.i, f.j) for f in partition.facets] == list(pairwise(range(len(marks) + 1)))
    assert len(partition.H) == len(marks)


@pytest.mark.parametrize("far", [5e3, 6e3, 2e4, 1e12, 1e60])
def test_a_border_next_to_0_beside_one_far_away_loses_no_cell(far: float) -> None:
    stop = dead_zone(lower=Fraction(-1, 2**54), upper=far, upper_slope=-300)
    elements = [Nonlinearity(name="valve", function=stop, row=[1, 0], constant=0, direction=[0, -1])]
    partition, A, _ = generate_cells(BallMatrix.of([[0, 1], [-1, -1]]), BallMatrix.of([[0], [0]]), elements)
    assert partition.names == ("valve below", "valve inside", "valve above")
    assert [matrix.floats[1, 0] for matrix in A] == [-2, -1, 299]


def test_a_thin_cell_beside_a_border_far_away_stays() -> None:
    partition = chain(
        [Fraction(0), Fraction(1, 10**9), Fraction(10**12)], [Fraction(1), Fraction(0)], [Fraction(1)] * 6
    )
    partition.check()
    assert not partition.empty_cells
    assert len(partition.facets) == 3


def split(data: st.DataObject, n: int, times: int) -> tuple[list[tuple[int, ...]], list[dict[int, int]]]:
    """Cut ℝⁿ by hyperplanes that each go through one cell only: facets need not match from cell to cell."""
    planes: list[tuple[int, ...]] = []
    cells: list[dict[int, int]] = [{}]
    for _ in range(times):
        plane = data.draw(st.tuples(*[entries] * (n + 1)).filter(lambda row: any(row[:-1])))
        cell = data.draw(st.sampled_from(cells))
        own = [[s * v for v in planes[k]] for k, s in cell.items()]
        if all(strictly_feasible([*own, [s * v for v in plane]]) for s in (-1, 1)):
            planes.append(plane)
            cells.remove(cell)
            cells += [cell | {len(planes) - 1: s} for s in (-1, 1)]
    return planes, cells


def partition_of(planes: Sequence[Sequence[Fraction | int]], cells: Sequence[dict[int, int]]) -> Partition:
    signs = np.array([[cell.get(k, 0) for k in range(len(planes))] for cell in cells])
    H = [plane[:-1] for plane in planes]
    return Partition.create(
        H=H, h=[plane[-1] for plane in planes], signs=signs, names=[f"c{i}" for i in range(len(cells))]
    )


@given(st.data(), st.integers(1, 3), st.integers(1, 6))
@settings(max_examples=60)
def test_cells_whose_facets_do_not_match_cover_and_meet_as_elimination_says(
    data: st.DataObject, n: int, times: int
) -> None:
    planes, cells = split(data, n, times)
    assume(planes)
    partition = partition_of(planes, cells)
    partition.check()
    assert not partition.empty_cells
    expected = {
        (i, j, k)
        for i, j in combinations(range(len(cells)), 2)
        for k in partition.between(i, j)
        if touching(claimed(partition, i), claimed(partition, j), partition.rows[k])
    }
    assert {(f.i, f.j, f.k) for f in partition.facets} == expected


def witness(message: str) -> list[float]:
    return [float(v) for v in message.split("x = (")[1].split(")")[0].split(",")]


@given(st.data(), st.integers(1, 3), st.integers(1, 5))
@settings(max_examples=50)
def test_a_cell_that_is_missing_or_too_large_is_found(data: st.DataObject, n: int, times: int) -> None:
    planes, cells = split(data, n, times)
    assume(planes)
    which = data.draw(st.integers(0, len(cells) - 1))
    rest = partition_of(planes, cells[:which] + cells[which + 1 :])
    with pytest.raises(OutsideTheory, match="do not cover") as hole:
        rest.check()
    x = witness(str(hole.value))
    assert not any(inside(rest, i, x) for i in range(len(rest.names)))
    own = {k: [s * v for v in planes[k]] for k, s in cells[which].items()}
    others = {k: [row for other, row in own.items() if other != k] for k in own}
    borders_of_it = [k for k, row in own.items() if strictly_feasible([*others[k], [-v for v in row]])]
    larger = dict(cells[which])
    larger.pop(data.draw(st.sampled_from(borders_of_it)))
    overlapping = partition_of(planes, [*cells[:which], larger, *cells[which + 1 :]])
    with pytest.raises(OutsideTheory, match=f"c{which}.*overlap"):
        overlapping.check()


def test_a_border_through_a_corner_alone_is_none() -> None:
    assert borders([(-1, 0, 0), (0, -1, 0), (-1, -1, 0)], 2) == ((-1, 0, 0), (0, -1, 0))


def test_every_pair_that_overlaps_is_named_and_no_other() -> None:
    signs = [[1, 1], [-1, 1], [-1, -1], [1, -1], [0, 1]]
    cells = Partition.create(H=[[1, 0], [0, 1]], h=[0, 0], signs=signs, names=["ur", "ul", "ll", "lr", "upper"])
    with pytest.raises(OutsideTheory) as refusal:
        cells.check()
    pairs = [problem.message.split(" overlap")[0] for problem in refusal.value.problems]
    assert pairs == ["cells 'ur' and 'upper'", "cells 'ul' and 'upper'"]


def test_two_partitions_on_top_of_each_other_overlap() -> None:
    both = Partition.create(H=[[1.0], [1.0]], h=[0, -1], signs=[[-1, 0], [1, 0], [0, -1], [0, 1]], names="abcd")
    with pytest.raises(OutsideTheory, match="'a' and 'c' overlap"):
        both.check()


@given(st.data(), st.integers(1, 3), st.integers(1, 5))
@settings(max_examples=40)
def test_units_factors_and_order_change_nothing(data: st.DataObject, n: int, times: int) -> None:
    planes, cells = split(data, n, times)
    assume(planes)
    partition = partition_of(planes, cells)
    units = [data.draw(powers) for _ in range(n)] + [Fraction(1)]
    factors = [data.draw(powers) for _ in planes]
    scaled = [[f * v * d for v, d in zip(plane, units, strict=True)] for f, plane in zip(factors, planes, strict=True)]
    order = data.draw(st.permutations(range(len(cells))))
    turned = data.draw(st.permutations(range(len(planes))))
    new = {k: position for position, k in enumerate(turned)}
    other = partition_of([scaled[k] for k in turned], [{new[k]: s for k, s in cells[i].items()} for i in order])
    other.check()
    assert not other.empty_cells
    assert {frozenset((f.i, f.j)) for f in partition.facets} == {
        frozenset((order[f.i], order[f.j])) for f in other.facets
    }


def test_a_cell_between_equal_borders_is_left_out() -> None:
    flat = Partition.create(H=[[1], [2]], h=[0, 0], signs=[[-1, 0], [1, -1], [0, 1]], names=["low", "flat", "high"])
    assert flat.empty_cells == (1,)
    left = flat.without(flat.empty_cells)
    left.check()
    assert left.names == ("low", "high")
    assert [(f.i, f.j, f.k) for f in left.facets] == [(0, 1, 0)]
    assert left.H.shape == (1, 1)


@given(powers, st.integers(1, 9), st.booleans())
@settings(max_examples=30)
def test_one_border_with_two_roundings_is_one_plane_and_remarked(size: Fraction, digit: int, turned: bool) -> None:
    third, rounded = Fraction(digit, 3) * size, Fraction(round(digit * 10**13 / 3), 10**13) * size
    assume(third != rounded)
    sign = -1 if turned else 1
    partition = Partition.create(
        H=[[1, size], [sign, sign * size]],
        h=[-third, -sign * rounded],
        signs=[[-1, 0], [0, sign]],
        names=["low", "high"],
    )
    partition.check()
    assert len(partition.facets) == 1
    assert partition.exact_h[0] == -third * partition.exact_H[0][0]
    assert 0 < partition.repair < 1e-12
    assert len(partition.remarks) == 1
    assert "the borders of cells 'low' and 'high' differ by" in partition.remarks[0]


def test_borders_that_differ_by_more_than_rounding_are_two() -> None:
    apart = Partition.create(
        H=[[1], [1]], h=[-1, Fraction(-1) - Fraction(2, 10**12)], signs=[[-1, 0], [0, 1]], names="ab"
    )
    with pytest.raises(OutsideTheory, match="do not cover"):
        apart.check()


def test_rounding_swallows_no_cell_that_has_a_name() -> None:
    near = Fraction(1, 10**14)
    strip = chain([Fraction(1), 1 + near], [Fraction(1)], [Fraction(1)] * 4)
    strip.check()
    assert strip.repair == 0
    assert not strip.empty_cells
    # a triangle in the strip, with its corner on x1 = 1 and its base on x1 = 1 + near
    triangle = Partition.create(
        H=[[1, 0], [1, 0], [1, 1], [1, -1]],
        h=[-1, -1 - near, -1, -1],
        signs=[[0, -1, 1, 1], [-1, 0, 0, 0]],
        names=["triangle", "left"],
    )
    assert triangle.repair == 0
    assert not triangle.empty_cells


def test_numbers_mean_the_decimals_they_print_as() -> None:
    for number in (0.1, "0.1", Fraction(1, 10), Real.of("0.1"), np.float64(0.1)):
        partition = Partition.create(H=[[1]], h=[number], signs=[[-1], [1]], names="ab")
        assert partition.exact_h == (Fraction(1, 10),)
        assert partition.h.tolist() == [0.1]
    sums = Partition.create(H=[[1], [1]], h=[Real.of(0.1) + 0.2, 0.3], signs=[[-1, 0], [0, 1]], names="ab")
    assert sums.exact_h == (Fraction(3, 10),)
    assert not sums.remarks


@pytest.mark.parametrize("size", [Fraction(1, 10**300), Fraction(1, 10**320), Fraction(10**310)])
def test_a_normal_of_any_size_is_a_plane(size: Fraction) -> None:
    partition = Partition.create(H=[[size, 0]], h=[-size / 2], signs=[[-1], [1]], names=["low", "high"])
    partition.check()
    assert partition.H.tolist() == [[1, 0]]
    assert partition.h.tolist() == [-0.5]
    assert partition.locate(np.array([0.7, 0.0])) == 1


def test_a_border_beyond_all_doubles_is_refused() -> None:
    with pytest.raises(InvalidSpec, match="beyond the range"):
        Partition.create(H=[[Fraction(1, 10**200)]], h=[10**200], signs=[[-1], [1]], names=["low", "high"])


def test_a_state_on_a_facet_is_in_the_first_of_its_cells() -> None:
    halves = Partition.create(H=[[3, 0.1]], h=[Fraction(-1, 4)], signs=[[1], [-1]], names=["high", "low"])
    assert halves.locate(np.array([0.0, 2.5])) == 0  # 3 · 0 + 0.1 · 2.5 = 1/4
    assert halves.locate(np.array([0.0, np.nextafter(2.5, 0)])) == 1
    assert halves.locate(np.array([0.0, np.nextafter(2.5, 3)])) == 0
    assert halves.locate(np.array([np.nan, 0.0])) in (0, 1)


def test_an_interior_point_is_found_for_any_vector_of_signs() -> None:
    partition = Partition.create(H=[[1, 0], [0, 1]], h=[-1, -2], signs=[[1, 1], [1, -1], [-1, 0]], names="abc")
    point = partition.interior_point(partition.signs[0])
    assert point is not None
    assert point[0] > 1
    assert point[1] > 2
    assert partition.interior_point(np.array([1, -1])) is not None


def test_more_cells_than_can_be_worked_with_are_refused_at_once() -> None:
    elements = [
        Nonlinearity(name=f"e{k}", function=spring(), row=np.eye(60)[k], constant=0, direction=np.eye(60)[0])
        for k in range(60)
    ]
    with pytest.raises(InvalidSpec, match="60 hyperplanes make more than 100,000 cells"):
        generate_cells(BallMatrix.of(-np.eye(60)), BallMatrix.of(np.zeros((60, 1))), elements)


def run(tmp_path: Path, elements: str, command: str, *options: str) -> Result:
    (tmp_path / "spec.yaml").write_text(mass(elements, head="name: cells\nparameters: {a: 0.3, b: 0.1}"))
    return CliRunner().invoke(app, [command, str(tmp_path / "spec.yaml"), *options])


def test_differences_that_vanish_on_paper_vanish_beside_large_offsets(tmp_path: Path) -> None:
    stop = "{name: valve, kind: stop, of: z, lower: a - 3*b, upper: 2e4, upper_slope: -300, into: {v: -1}}"
    checked = json.loads(run(tmp_path, stop, "check", "--json").stdout)
    assert checked["cells"] == ["valve below", "valve inside", "valve above"]
    assert checked["facets"][0]["hyperplane"] == "z = 0"


def test_a_border_that_no_decimal_hits_is_proved_and_verified_as_it_is(tmp_path: Path) -> None:
    spring = "{name: s, kind: spring, of: z/7 + v/3, start: 1/3, slope: 1/11, into: {v: -1}}"
    done = run(tmp_path, spring, "design", "--out", str(tmp_path / "out"))
    assert done.exit_code == 0, done.output
    certificate = json.loads((tmp_path / "out" / "certificate.json").read_text())
    (element,) = certificate["plant"]["elements"]
    assert element["row"] == ["1/7", "1/3"]
    assert element["function"]["breakpoints"] == ["1/3"]
    assert CliRunner().invoke(app, ["verify", str(tmp_path / "out")]).exit_code == 0


def test_check_shows_the_first_of_many_cells_and_json_has_all(tmp_path: Path) -> None:
    marks = list(range(24))
    slopes = [k % 3 for k in range(25)]
    wavy = f"{{name: w, kind: piecewise_linear, of: z, breakpoints: {marks}, slopes: {slopes}, into: {{v: -1}}}}"
    text = run(tmp_path, wavy, "check", "-v").stdout
    assert "25 cells; continuous across 24 facets" in " ".join(text.split())
    assert "… and 20 more cells (--json lists all)" in text
    assert "… and 19 more facets (--json lists all)" in text
    checked = json.loads(run(tmp_path, wavy, "check", "--json").stdout)
    assert len(checked["cells"]) == len(checked["zero_dynamics"]) == 25
    assert len(checked["facets"]) == 24
