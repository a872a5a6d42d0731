"""Scalar elements, the cells they make, and the three ways to write one plant."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack import load_spec
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, stack
from pwatrack.model.nonlinearity import (
    Nonlinearity,
    PiecewiseLinear,
    absolute,
    dead_zone,
    generate_cells,
    piecewise_linear,
    saturation,
    spring,
)
from pwatrack.model.pwa import PWASystem

ELEMENTS = {
    "dead zone": (dead_zone(lower=-1, upper=2), lambda s: max(0.0, s - 2) + min(0.0, s + 1)),
    "saturation": (saturation(lower=-1, upper=2, slope=3), lambda s: 3 * min(max(s, -1.0), 2.0)),
    "spring": (spring(start=0.5, slope=4), lambda s: 4 * max(0.0, s - 0.5)),
    "absolute": (absolute(slope=2), lambda s: 2 * abs(s)),
    "free": (piecewise_linear(breakpoints=[1.0, 2.0], slopes=[1.0, -1.0, 0.5]), None),
}


@pytest.mark.parametrize("name", ELEMENTS)
@given(s=st.floats(-5, 5))
def test_an_element_is_the_function_it_is_called(name: str, s: float) -> None:
    function, formula = ELEMENTS[name]
    if formula is None:
        formula = lambda s: s if s < 1 else 2 - s if s < 2 else 0.5 * (s - 2)  # noqa: E731
    assert function(s) == pytest.approx(formula(s), abs=1e-12)


@pytest.mark.parametrize("name", ELEMENTS)
def test_an_element_is_continuous_at_its_breakpoints(name: str) -> None:
    function, _ = ELEMENTS[name]
    for s in map(float, function.breakpoints):
        assert function(s - 1e-9) == pytest.approx(function(s + 1e-9), abs=1e-7)


def plant_of(seed: int, elements: list[PiecewiseLinear]) -> tuple[PWASystem, list[Nonlinearity], Array, Array]:
    random = np.random.default_rng(seed)
    n = 4
    A, b = random.normal(size=(n, n)), random.normal(size=n)
    nonlinearities = [
        Nonlinearity(
            name=f"e{k}",
            function=function,
            row=random.normal(size=n),
            constant=float(random.normal()),
            direction=random.normal(size=n),
        )
        for k, function in enumerate(elements)
    ]
    partition, stack_A, stack_b = generate_cells(BallMatrix.of(A), BallMatrix.of(b[:, None]), nonlinearities)
    plant = PWASystem.create(
        partition=partition, A=stack_A, b=stack_b, B=random.normal(size=(n, 1)), C=random.normal(size=(1, n))
    )
    return plant, nonlinearities, A, b


@given(st.integers(0, 1000), st.lists(st.sampled_from(sorted(ELEMENTS)), min_size=0, max_size=3))
@settings(max_examples=25)
def test_the_generated_cells_are_the_sum_of_the_elements(seed: int, names: list[str]) -> None:
    plant, nonlinearities, A, b = plant_of(seed, [ELEMENTS[name][0] for name in names])
    random = np.random.default_rng(seed + 1)
    for x in 3 * random.normal(size=(20, 4)):
        expected = A @ x + b
        for n in nonlinearities:
            expected = expected + n.direction * n.function(float(n.row @ x) + float(n.constant))
        np.testing.assert_allclose(plant.field(x, np.zeros(1)), expected, atol=1e-9)


def test_three_dead_zones_make_27_cells_with_readable_names() -> None:
    plant, *_ = plant_of(0, [dead_zone(lower=-1, upper=1)] * 3)
    assert len(plant.cell_names) == 27
    assert "e0 below, e1 inside, e2 above" in plant.cell_names
    assert len(plant.partition.facets) == 54
    assert len({id(A_i) for A_i in plant.exact.A}) == 8, "cells of equal slopes share their matrix"


def test_elements_of_the_same_form_make_no_impossible_cells() -> None:
    row, direction = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    both = [
        Nonlinearity(name=name, function=spring(start=start), row=row, constant=0.0, direction=direction)
        for name, start in (("first", 0.0), ("second", 1.0))
    ]
    partition, A, _ = generate_cells(BallMatrix.of(np.zeros((2, 2))), BallMatrix.of(np.zeros((2, 1))), both)
    assert partition.names == ("first off, second off", "first on, second off", "first on, second on")
    assert stack(A)[:, 1, 0].tolist() == [0.0, 1.0, 2.0]


SYSTEM = """
name: one plant
parameters: {k: 3, gap: 0.1}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  B: [[0], [1]]
  C: [[1, 0]]
%s
reference: {output: 0.2}
simulation: {duration: 1, sample_time: 0.1}
"""
WAYS = {
    "where": """
  cells:
    - {name: free, where: ["z <= gap"], A: [[0, 1], [-1, -1]]}
    - {name: touching, where: ["z >= gap"], A: [[0, 1], [-1 - k, -1]], b: [0, k*gap]}
""",
    "signs": """
  hyperplanes: [{H: [-2, 0], h: 2*gap}]
  cells:
    - {name: free, signs: ["+"], A: [[0, 1], [-1, -1]]}
    - {name: touching, signs: ["-"], A: [[0, 1], [-1 - k, -1]], b: [0, k*gap]}
""",
    "nonlinearities": """
  A: [[0, 1], [-1, -1]]
  nonlinearities:
    - {name: stop, kind: spring, of: z, into: {v: -k}, start: gap}
""",
}


def test_the_three_ways_of_writing_a_plant_give_the_same_system(tmp_path: Path) -> None:
    plants = []
    for name, way in WAYS.items():
        (tmp_path / f"{name}.yaml").write_text(SYSTEM % way)
        plants.append(load_spec(tmp_path / f"{name}.yaml").problem.plant)
    first = plants[0]
    for other in plants[1:]:
        np.testing.assert_allclose(other.A, first.A, atol=1e-15)
        np.testing.assert_allclose(other.b, first.b, atol=1e-15)
        for x in np.random.default_rng(0).normal(size=(50, 2)) * 0.2:
            assert other.partition.locate(x) == first.partition.locate(x)
    assert plants[2].cell_names == ("stop off", "stop on")
