"""Cells, continuity (eq. (1)) and the normal form (11)."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pwatrack.errors import OutsideTheory
from pwatrack.model.cells import Partition
from pwatrack.model.normal_form import normal_form
from pwatrack.model.pwa import PWASystem
from tests.plants import random_plant, springs

seeds = st.integers(0, 10_000)


def quadrants(signs: list[list[int]]) -> Partition:
    return Partition.create(
        H=[[1.0, 0.0], [0.0, 1.0]], h=[0.0, 0.0], signs=signs, names=[f"q{k}" for k in range(len(signs))]
    )


def test_four_cells_around_a_point_meet_in_four_facets() -> None:
    partition = quadrants([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    partition.check()
    assert {(f.i, f.j) for f in partition.facets} == {(0, 1), (1, 2), (2, 3), (0, 3)}


def test_a_missing_quadrant_is_a_hole_with_a_witness() -> None:
    with pytest.raises(OutsideTheory, match=r"no cell contains x = \(.*-.*, .*-.*\)"):
        quadrants([[1, 1], [-1, 1], [1, -1]]).check()


def test_overlapping_cells_are_named_with_a_witness() -> None:
    with pytest.raises(OutsideTheory, match="'q0' and 'q2' overlap, for example at x = "):
        quadrants([[1, 1], [-1, 0], [0, 1], [1, -1]]).check()


def test_a_cell_that_contradicts_itself_is_left_out_with_a_remark() -> None:
    partition = Partition.create(
        H=[[1.0], [1.0]], h=[0.0, -1.0], signs=[[-1, 1], [1, 0], [-1, 0]], names=["nowhere", "right", "left"]
    )
    plant = PWASystem.create(partition=partition, A=-np.ones((3, 1, 1)), b=np.zeros((3, 1)), B=[[1.0]], C=[[1.0]])
    assert plant.cell_names == ("right", "left")
    assert plant.remarks == ("cell 'nowhere' has no interior and is left out",)


def test_multiples_of_one_hyperplane_are_one() -> None:
    partition = Partition.create(H=[[2.0, 4.0], [-1.0, -2.0]], h=[6.0, -3.0], signs=[[1, 0], [0, 1]], names=["a", "b"])
    assert partition.H.shape == (1, 2)
    assert partition.signs.tolist() == [[1], [-1]]
    partition.check()


def test_parallel_hyperplanes_make_a_strip_between_two_cells() -> None:
    partition = Partition.create(
        H=[[1.0, 1.0], [1.0, 1.0]], h=[1e-6, -1e-6], signs=[[-1, 0], [1, -1], [0, 1]], names=["a", "strip", "b"]
    )
    partition.check()
    assert [(f.i, f.j) for f in partition.facets] == [(0, 1), (1, 2)]


def assert_exactly_continuous(plant: PWASystem) -> None:
    """At n affinely independent rational points of each facet both cells give the same ẋ, in fractions."""
    F = [
        np.array([[Fraction(t) for t in (*a, *b)] for a, b in zip(A.texts, b.texts, strict=True)])
        for A, b in zip(plant.exact.A, plant.exact.b, strict=True)
    ]
    for facet in plant.partition.facets:
        H = [Fraction(repr(float(v))) for v in plant.partition.H[facet.k]]
        h = Fraction(repr(float(plant.partition.h[facet.k])))
        pivot = next(k for k, v in enumerate(H) if v)
        for j in range(len(H)):
            x = [Fraction(int(k == j) * 3 + k, 7) for k in range(len(H))]
            x[pivot] = (-h - sum(a * v for k, (a, v) in enumerate(zip(H, x, strict=True)) if k != pivot)) / H[pivot]
            at = np.array([*x, Fraction(1)])
            assert (F[facet.i] @ at == F[facet.j] @ at).all()


@given(seeds, st.integers(2, 6), st.integers(0, 3))
@settings(max_examples=30)
def test_springs_are_continuous_across_every_facet(seed: int, n: int, k: int) -> None:
    random = np.random.default_rng(seed)
    A, b, B, C = (random.normal(size=shape) for shape in ((n, n), n, (n, 1), (1, n)))
    g, h, c = (random.normal(size=shape) for shape in ((k, n), (k, n), k))
    assume(k <= n)  # else not in general position
    plant = springs(A, b, B, C, g, h, c)
    assert_exactly_continuous(plant)
    x = random.normal(size=n)
    u = random.normal(size=1)
    np.testing.assert_allclose(plant.field(x, u), A @ x + b + np.maximum(0, h @ x + c) @ g + B @ u, atol=1e-12)


@given(seeds, st.floats(1e-6, 1.0))
@settings(max_examples=30)
def test_a_jump_is_refused_with_its_size(seed: int, size: float) -> None:
    random = np.random.default_rng(seed)
    A = random.normal(size=(3, 3))
    g, H = random.normal(size=3), random.normal(size=3)
    broken = A + np.outer(g, H)
    row, column = 1, int(np.argmin(np.abs(H)))
    broken[row, column] += size
    with pytest.raises(OutsideTheory, match="A jumps by "):
        PWASystem.create(
            partition=Partition.create(H=[H], h=[0.0], signs=[[-1], [1]], names=["a", "b"]),
            A=[A, broken],
            b=np.zeros((2, 3)),
            B=np.ones((3, 1)),
            C=np.ones((1, 3)),
        )


def test_a_tolerance_accepts_rounded_data() -> None:
    cells = Partition.create(H=[[1.0, 0.0]], h=[0.0], signs=[[-1], [1]], names=["a", "b"])
    A = [[[0, 1], [0, -1]], [[0, 1], [-2, -1.00001]]]
    with pytest.raises(OutsideTheory, match="a larger tolerance accepts a larger jump"):
        PWASystem.create(partition=cells, A=A, b=np.zeros((2, 2)), B=[[0], [1]], C=[[1, 0]])
    PWASystem.create(partition=cells, A=A, b=np.zeros((2, 2)), B=[[0], [1]], C=[[1, 0]], tolerance=1e-4)


@given(seeds, st.integers(2, 4), st.integers(3, 5))
@settings(max_examples=20)
def test_data_that_jump_by_rounding_are_repaired_exactly_around_every_edge(seed: int, n: int, k: int) -> None:
    """Planes through one edge: the jumps across them have to add up to 0 on the way around it."""
    random = np.random.default_rng(seed)
    angles = np.sort(random.uniform(0, np.pi, size=k))
    H = np.zeros((k, n))
    H[:, 0], H[:, 1] = np.cos(angles), np.sin(angles)
    middles = np.concatenate([angles, angles + np.pi])
    middles = (middles + np.append(middles[1:], middles[0] + 2 * np.pi)) / 2 + np.pi / 2
    signs = np.sign(np.column_stack([np.cos(middles), np.sin(middles)]) @ H[:, :2].T).astype(int)
    A, g = random.normal(size=(n, n)), random.normal(size=(k, n))
    partition = Partition.create(H=H, h=np.zeros(k), signs=signs, names=[f"c{j}" for j in range(2 * k)])
    given_A = A + np.einsum("ck,ki,kj->cij", signs > 0, g, H)
    plant = PWASystem.create(
        partition=partition, A=given_A, b=np.zeros((2 * k, n)), B=np.ones((n, 1)), C=np.ones((1, n))
    )
    assert_exactly_continuous(plant)
    assert plant.repair is not None
    assert plant.repair.relative < 1e-13
    np.testing.assert_allclose(plant.A, given_A, atol=1e-12 * np.abs(given_A).max())
    assert (np.abs(plant.A - given_A).max(axis=0) <= plant.repair.A + 4e-16 * np.abs(given_A).max()).all()


def test_what_is_continuous_in_decimals_is_left_as_it_is() -> None:
    """0.1 + 0.2 is 0.3 here, though no doubles are."""
    cells = Partition.create(H=[[1.0]], h=["-0.1"], signs=[[-1], [1]], names=["a", "b"])
    plant = PWASystem.create(partition=cells, A=[[["-0.1"]], [["-0.3"]]], b=[["0"], ["0.02"]], B=[[1]], C=[[1]])
    assert plant.repair is None
    assert plant.exact.A[1].texts == [["-0.3"]]


def test_a_jump_is_measured_by_the_terms_of_its_own_equation() -> None:
    cells = Partition.create(H=[[1.0]], h=[0.0], signs=[[-1], [1]], names=["low", "high"])

    def plant(jump: float) -> PWASystem:
        return PWASystem.create(partition=cells, A=[[[-1]], [[-1]]], b=[[1e6], [1e6 + jump]], B=[[1]], C=[[1]])

    repair = plant(4e-10).repair
    assert repair is not None
    assert 2e-10 < repair.disturbance(np.ones(1), np.ones(1))[0] < 5e-10
    with pytest.raises(OutsideTheory, match=r"b jumps by 0\.0009 .*4\.5e-10 of that equation's terms"):
        plant(9e-4)


def test_a_jump_of_the_offset_alone_is_refused() -> None:
    cells = Partition.create(H=[[1.0]], h=[0.0], signs=[[-1], [1]], names=["a", "b"])
    with pytest.raises(OutsideTheory, match=r"b jumps by 0\.5"):
        PWASystem.create(partition=cells, A=[[[-1.0]], [[-1.0]]], b=[[0.0], [0.5]], B=[[1.0]], C=[[1.0]])


@given(seeds, st.integers(1, 4), st.integers(0, 3), st.integers(0, 2))
@settings(max_examples=40)
def test_any_linear_change_of_state_is_undone_by_the_normal_form(seed: int, r: int, extra: int, k: int) -> None:
    plant = random_plant(seed, n=r + extra, k=k, r=r)
    form = normal_form(plant)
    assert form.r == r
    n = r + extra
    (T, *_), (offset, *_) = form.T, form.offset
    B = T @ plant.B[:, 0]
    np.testing.assert_allclose(B, [0.0] * (r - 1) + [form.D[0, 0, 0]] + [0.0] * extra, atol=1e-9 * np.abs(B).max())
    random = np.random.default_rng(seed)
    for x in random.normal(size=(5, n)):
        cell = plant.partition.locate(x)
        xi_eta = T @ x + offset
        xi, eta = xi_eta[:r], xi_eta[r:]
        rate = T @ (plant.A[cell] @ x + plant.b[cell])
        expected = np.concatenate(
            [
                xi[1:],
                form.alpha[cell] @ xi + form.beta[cell] @ eta + form.gamma[cell],
                form.chi[cell] @ xi + form.Psi[cell] @ eta + form.sigma[cell],
            ]
        )
        np.testing.assert_allclose(rate, expected, atol=1e-8 * max(1.0, np.abs(rate).max()))
        assert xi[0] == pytest.approx(float(plant.C[0] @ x), rel=1e-12)


def test_eta_keeps_original_states_where_the_input_does_not_act() -> None:
    plant = springs(
        A=np.array([[0.0, 1, 0], [0, 0, 1], [1, 1, -2]]),
        b=np.zeros(3),
        B=np.array([[1.0], [2.0], [0.0]]),
        C=np.array([[1.0, 0, 0]]),
        g=np.zeros((0, 3)),
        h=np.zeros((0, 3)),
        c=np.zeros(0),
    )
    assert normal_form(plant).eta_names == ("x3", "x2 - 2*x1")


def test_an_output_path_that_depends_on_the_cell_is_refused_with_row_and_cells() -> None:
    plant = springs(
        A=np.eye(3, k=1),
        b=np.zeros(3),
        B=np.eye(3)[:, 2:],
        C=np.eye(3)[:1],
        g=np.eye(3)[:1],
        h=np.eye(3)[:1],
        c=np.zeros(1),
    )
    with pytest.raises(OutsideTheory, match=r"row C A\^1 differs between cells '-' and '\+'.*entry 'x1' is 0 and 1"):
        normal_form(plant)


@pytest.mark.parametrize("force", [1.0, 0.0])
def test_an_input_that_never_reaches_the_output_has_no_relative_degree(force: float) -> None:
    plant = springs(
        A=np.diag([-1.0, -2.0]),
        b=np.zeros(2),
        B=np.array([[0.0], [force]]),
        C=np.array([[1.0, 0]]),
        g=np.zeros((0, 2)),
        h=np.zeros((0, 2)),
        c=np.zeros(0),
    )
    with pytest.raises(OutsideTheory, match="no relative degree"):
        normal_form(plant)


@pytest.mark.parametrize("other", [0.3333333, 1 / 3 + 1e-11, 1 / 3 + 1e-7, 1 / 3 - 1e-8])
def test_a_border_written_with_different_numbers_hides_no_jump(other: float) -> None:
    cells = Partition.create(H=[[1, 0], [1, 0]], h=[-1 / 3, -other], signs=[[-1, 0], [0, 1]], names=["low", "high"])
    with pytest.raises(OutsideTheory, match=r"overlap|do not cover|b jumps by 5"):
        PWASystem.create(partition=cells, A=[[[0, 1], [-1, -1]]] * 2, b=[[0, 0], [0, -5]], B=[[0], [1]], C=[[1, 0]])


@pytest.mark.parametrize("width", [1e-5, 1e-7, 1e-8])
def test_a_thin_cell_stays(width: float) -> None:
    cells = Partition.create(
        H=[[1, 0], [1, 0]], h=[-1, -1 - width], signs=[[-1, -1], [1, -1], [1, 1]], names=["low", "thin", "high"]
    )
    slope = 1 / width
    plant = PWASystem.create(
        partition=cells,
        A=[[[0, 1], [0, -1]], [[0, 1], [-slope, -1]], [[0, 1], [0, -1]]],
        b=[[0, 0], [0, slope], [0, -1.0]],
        B=[[0], [1]],
        C=[[1, 0]],
        tolerance=1e-6,
    )
    assert plant.cell_names == ("low", "thin", "high")
    assert len(plant.partition.facets) == 2


@given(seeds, st.integers(2, 4))
@settings(max_examples=25)
def test_scaling_states_by_a_million_loses_no_cell(seed: int, k: int) -> None:
    random = np.random.default_rng(seed)
    n = 4
    g, h, c = random.normal(size=(k, n)), random.normal(size=(k, n)), random.normal(size=k)
    d = 10.0 ** random.uniform(-6, 6, size=n)
    A, B, C = random.normal(size=(n, n)), random.normal(size=(n, 1)), random.normal(size=(1, n))
    plant = springs(A, np.zeros(n), B, C, g, h, c)
    other = springs(A / d[:, None] * d, np.zeros(n), B / d[:, None], C * d, g / d, h * d, c)
    assert len(other.cell_names) == len(plant.cell_names) == 2**k
    assert len(other.partition.facets) == len(plant.partition.facets)


@given(seeds, st.integers(1, 4))
@settings(max_examples=25)
def test_the_relative_degree_does_not_depend_on_the_scale_of_the_states(seed: int, r: int) -> None:
    plant = random_plant(seed, n=4, k=2, r=r)
    d = 10.0 ** np.random.default_rng(seed).uniform(-6, 6, size=4)
    other = PWASystem.create(
        partition=Partition.create(
            H=plant.partition.H * d, h=plant.partition.h, signs=plant.partition.signs, names=plant.cell_names
        ),
        A=plant.A / d[:, None] * d,
        b=plant.b / d,
        B=plant.B / d[:, None],
        C=plant.C * d,
    )
    assert normal_form(other).r == r


def test_the_form_11_of_decimals_is_that_of_a_plant_next_to_them_and_how_near_is_said() -> None:
    """C B = 0.3 · 0.3333333333333333 − 0.1 is 0 but for rounding: the input is moved, by as much as that says."""
    plant = PWASystem.create(
        partition=Partition.create(H=np.zeros((0, 2)), h=[], signs=np.zeros((1, 0)), names=["all"]),
        A=[[["-1", "0.3"], ["0.2", "-2"]]],
        b=[["0", "0"]],
        B=[["0.3"], ["1"]],
        C=[["0.3333333333333333", "-0.1"]],
    )
    form = normal_form(plant)
    assert form.r == 2
    assert (form.plant.exact.C @ form.plant.exact.B).texts == [["0"]]
    assert form.plant.repair is not None
    moved = np.abs((form.plant.exact.B - plant.exact.B).floats)
    assert 0 < moved.max() <= form.plant.repair.B.max() * (1 + 1e-12)
    assert 1e-18 < form.plant.repair.relative < 1e-15
