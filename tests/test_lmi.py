"""The kernel inequality, the two solvers, and what counts as a proof."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import picos
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are
from scipy.optimize import linprog

from benchmarks.corpus import feasible, infeasible
from benchmarks.measured import dual_off, off, violation
from pwatrack.arrays import Array, symmetric_part
from pwatrack.control import candidates, convergence, synthesis
from pwatrack.control.task import Task
from pwatrack.errors import Infeasible, Undecided
from pwatrack.lmi import picos_model, primal_dual
from pwatrack.lmi.blocks import Scaling, step_lengths
from pwatrack.lmi.exact import prove
from pwatrack.lmi.inequality import Inequality, Solver, lyapunov, quadratic_cost, state_feedback, weighted
from pwatrack.lmi.infeasibility import refute
from pwatrack.lmi.linear_map import DenseMap, LinearMap
from pwatrack.lmi.multipliers import refutes
from pwatrack.lmi.picos_model import ClarabelSolver
from pwatrack.lmi.presolve import Coordinates, corners, distinct
from pwatrack.lmi.program import (
    SemidefiniteProgram,
    Solution,
    largest_margin,
    least_condition,
    least_cost,
    least_sizes,
    least_violation,
    of_P,
    smaller_gain,
    smallest_gain,
)
from pwatrack.lmi.solve import asking, solve
from pwatrack.rational import decimals

seeds = st.integers(0, 10_000)
CELLS = ("a", "b", "c", "d")


def random_stack(seed: int, n: int = 4, cells: int = 3) -> Array:
    return np.random.default_rng(seed).normal(size=(cells, n, n))


@given(seeds)
def test_the_sandwich_form_of_8_is_8(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, B = random.normal(size=(3, 4, 4)), random.normal(size=(4, 2))
    P, Y = symmetric_part(random.normal(size=(4, 4))), random.normal(size=(2, 4))
    for left, A_i in zip(state_feedback(A, B, 0.3).evaluate(P, Y), A, strict=True):
        np.testing.assert_allclose(left, A_i @ P + P @ A_i.T + B @ Y + Y.T @ B.T + 0.6 * P, atol=1e-12)


@given(seeds)
def test_the_sandwich_form_of_the_cost_is_its_block_matrix(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, B = random.normal(size=(2, 3, 3)), random.normal(size=(3, 2))
    P, R = symmetric_part(random.normal(size=(3, 3))), np.diag([0.5, 2.0])
    Q_root = random.normal(size=(3, 3))
    for left, A_i in zip(quadratic_cost(A, B, Q_root, R).evaluate(P, np.zeros((0, 3))), A, strict=True):
        corner = symmetric_part(A_i @ P) - B @ np.diag([2.0, 0.5]) @ B.T
        expected = np.block([[corner, P @ Q_root.T], [Q_root @ P, -np.eye(3)]])
        np.testing.assert_allclose(left, expected, atol=1e-12)


@given(seeds)
@settings(max_examples=20)
def test_with_the_gain_of_the_cost_no_other_gain_has_a_smaller_left_side(seed: int) -> None:
    """In X = P⁻¹: sym(X (A + BK)) + Q + KᵀRK is least, as a matrix, for K = −R⁻¹BᵀX."""
    random = np.random.default_rng(seed)
    A, B = random.normal(size=(3, 3)), random.normal(size=(3, 2))
    root = random.normal(size=(3, 3))
    X, R, K = root @ root.T + np.eye(3), np.diag([0.5, 2.0]), random.normal(size=(2, 3))
    best = -np.linalg.solve(R, B.T @ X)
    sides = [symmetric_part(X @ (A + B @ gain)) + gain.T @ R @ gain for gain in (K, best)]
    assert np.linalg.eigvalsh(sides[0] - sides[1])[0] > -1e-9


@given(seeds, st.integers(1, 5))
@settings(max_examples=15)
def test_clarabel_and_cvxopt_find_the_same_optimum(seed: int, n: int) -> None:
    """Minimise tr(C X) over X ⪰ 0 with tr X = 1 (an equality) and X_11 ≥ 0.1 (an inequality)."""
    C = symmetric_part(np.random.default_rng(seed).normal(size=(n, n)))

    def optimum(**choice: object) -> float:
        X = picos.SymmetricVariable("X", n)
        problem = picos.Problem()
        problem.add_list_of_constraints([X >> 0, picos.trace(X) == 1, X[0, 0] >= 0.1])
        problem.set_objective("min", picos.trace(C * X))
        problem.solve(**choice)
        return float(problem.value)

    assert optimum(ad_hoc_solver=ClarabelSolver) == pytest.approx(optimum(solver="cvxopt"), abs=1e-6)


def test_the_clarabel_plugin_maximises_too() -> None:
    t = picos.RealVariable("t")
    problem = picos.Problem()
    problem.add_constraint((t & 1) // (1 & t) << 3 * np.eye(2))
    problem.set_objective("max", t)
    problem.solve(ad_hoc_solver=ClarabelSolver)
    assert float(t.value) == pytest.approx(2.0, abs=1e-6)
    assert float(problem.value) == pytest.approx(2.0, abs=1e-6)


BUILDERS: dict[str, Callable[[Array, Array], SemidefiniteProgram]] = {
    "largest_margin": lambda A, B: largest_margin(state_feedback(A, B)),
    "largest_margin, bounded": lambda A, B: largest_margin(state_feedback(A, B), 5.0),
    "least_violation": lambda A, B: least_violation([state_feedback(A, B)]),
    "least_condition": lambda A, _: least_condition(lyapunov(A), np.diag(np.arange(1.0, A.shape[1] + 1))),
    "least_sizes, above": lambda A, _: least_sizes(weighted(A, np.eye(A.shape[1])), *2 * [np.eye(A.shape[1])]),
    "least_sizes": lambda A, _: least_sizes(weighted(A, np.eye(A.shape[1])), np.diag(np.arange(1.0, A.shape[1] + 1))),
    "least_cost": lambda A, B: least_cost(quadratic_cost(A, B, np.eye(len(B)), np.eye(B.shape[1])), np.eye(len(B))),
    "smallest_gain": lambda A, B: smallest_gain(state_feedback(A, B), np.eye(len(B)), np.eye(B.shape[1])),
    "smaller_gain": lambda A, B: smaller_gain(
        state_feedback(A, B), np.eye(len(B)), np.eye(B.shape[1]), (np.eye(len(B)), np.zeros(B.T.shape))
    ),
}


def ours(program: SemidefiniteProgram, *, gap: float = 1e-7, against: float | None = None) -> Solution:
    found = primal_dual.solve(program, gap=gap, against=against)
    assert found is not None
    return found


def cvxopt(program: SemidefiniteProgram) -> Solution | None:
    return picos_model.solve(program, "cvxopt")


CLOSE = {"largest_margin": 3e-3, "smallest_gain": 1e-3}  # no P and Y reach the infimum: they grow without end


@pytest.mark.slow
@pytest.mark.parametrize("build", BUILDERS)
@given(seed=seeds, n=st.integers(2, 7), m=st.integers(1, 4), cells=st.integers(1, 6))
@settings(max_examples=8)
def test_the_primal_dual_method_and_clarabel_find_the_same_optimum(
    build: str, seed: int, n: int, m: int, cells: int
) -> None:
    A, B = feasible(seed, n, m, cells, 1e-2)
    if build in {"least_condition", "least_sizes", "least_sizes, above", "smaller_gain", "least_violation"}:
        A = np.random.default_rng(seed).normal(size=A.shape) / (4 * n) - np.eye(n)
    program = BUILDERS[build](A, B if build != "least_violation" else B[:, :0])
    first, second = ours(program), picos_model.solve(program)
    assert not first.impossible
    assert second is not None
    assert violation(first) < 1e-7
    assert off(first) < 1e-7
    size, close = max(1.0, abs(first.objective)), CLOSE.get(build, 1e-5)
    assert first.multipliers is not None
    price = sum(float(np.trace(Z, axis1=1, axis2=2).sum()) for Z in first.multipliers)  # of leaving the feasible set
    allowed = price * (max(violation(first), 0.0) + max(violation(second), 0.0))
    assert abs(first.objective - second.objective) <= close * size + allowed
    if build not in CLOSE:
        assert abs(first.gap) <= (1e-6 if build != "least_cost" else 1e-4) * size
        assert dual_off(first) <= 1e-5 * size
        assert build == "least_cost" or abs(second.gap) <= 1e-3 * size


@pytest.mark.parametrize("kind", [LinearMap, DenseMap])
@given(
    seed=seeds,
    n=st.integers(1, 5),
    m=st.integers(0, 2),
    cells=st.integers(1, 3),
    k=st.integers(1, 4),
    weighed=st.booleans(),
)
@settings(max_examples=30)
def test_both_forms_of_the_linear_map_are_the_left_hand_sides(
    kind: type[LinearMap], seed: int, n: int, m: int, cells: int, k: int, weighed: bool
) -> None:
    """For coefficients of any kind, the adjoint is one, and what solves the equations of a step does."""
    random = np.random.default_rng(seed)
    shapes = [(cells, k, n), (cells, n, k), (cells, k, m), (cells, n, k)]
    L, R, M, N = (random.normal(size=shape) for shape in shapes)
    C, T = (symmetric_part(random.normal(size=(cells, k, k))) for _ in range(2))
    A, B = random.normal(size=(2, n, n)), random.normal(size=(n, m))
    inequalities = (
        Inequality(L=L, R=R, M=M, N=N, constant=C, T=T),
        replace(state_feedback(A, B), T=symmetric_part(A)),
        of_P(state_feedback(A, B), -1.0, random.normal(size=(k, n))),
    )
    V = random.normal(size=(k, n)) if weighed else None
    linear = kind(SemidefiniteProgram(constraints=inequalities, price=0.0 if weighed else 1.0, weight=V))
    v = random.normal(size=linear.size)
    z = np.concatenate(
        [symmetric_part(random.normal(size=X.shape)).ravel() for X in linear.blocks.stacks(linear.constant)]
    )
    sides, (P, Y, t) = linear.apply(v), linear.parts(v)
    for side, c in zip(linear.blocks.parts(sides), inequalities, strict=False):
        expected = c.evaluate(P, Y) - c.constant + (0 if c.T is None else t * c.T)
        np.testing.assert_allclose(side, expected, atol=1e-10)
    assert linear.adjoint(z) @ v == pytest.approx(float(sides @ z), abs=1e-9)
    roots = [random.normal(size=X.shape) for X in linear.blocks.stacks(linear.constant) for _ in range(2)]
    definite = [root @ root.transpose(0, 2, 1) + np.eye(root.shape[1]) for root in roots]
    scalings = [Scaling.of(S, Z) for S, Z in zip(definite[::2], definite[1::2], strict=True)]
    step = linear.step(scalings)
    images = step.apply(v)
    for image, X, scaling in zip(images, linear.blocks.stacks(sides), scalings, strict=True):
        np.testing.assert_allclose(image, scaling.E @ X @ scaling.E.transpose(0, 2, 1), atol=1e-9)
    for image, other in zip(images, step.apply(step.solve(step.adjoint(images))), strict=True):
        np.testing.assert_allclose(other, image, atol=1e-4)


@given(seeds, st.integers(1, 12), st.sampled_from([1, 2, 3, 40]))
@settings(max_examples=30)
def test_a_scaling_makes_both_matrices_one_and_a_step_ends_before_the_boundary(seed: int, N: int, cells: int) -> None:
    random = np.random.default_rng(seed)
    roots = random.normal(size=(2, cells, N, N))
    S, Z = roots @ roots.transpose(0, 1, 3, 2) + 0.1 * np.eye(N)
    scaling = Scaling.of(S, Z)
    D = scaling.d[:, :, None] * np.eye(N)
    np.testing.assert_allclose(scaling.into(S), D, atol=1e-8 * D.max())
    np.testing.assert_allclose(scaling.back(D), Z, atol=1e-8 * np.abs(Z).max())
    changes = symmetric_part(random.normal(size=(2, *S.shape)))
    for change, length in zip(changes, step_lengths([changes[0]], [changes[1]], [scaling]), strict=True):
        assert np.linalg.eigvalsh(D + length * (1 - 1e-9) * change).min() > -1e-9
        assert length > 1 or np.linalg.eigvalsh(D + 1.03 * length * change).min() < 0


@given(seed=seeds, n=st.integers(1, 5), cells=st.integers(1, 4))
@settings(max_examples=15)
def test_what_contradicts_itself_has_no_solution_in_any_solver(seed: int, n: int, cells: int) -> None:
    """M P + P Mᵀ + I ⪯ 0 with an M that has an eigenvalue 1; what says so are multipliers with A*(Z) = 0."""
    M = np.random.default_rng(seed).normal(size=(cells, n, n)) - 3 * np.eye(n)
    M[0] += (1 - np.linalg.eigvals(M[0]).real.max()) * np.eye(n)
    program = least_sizes(weighted(M, np.eye(n)), np.eye(n), above=np.zeros((n, n)))
    found = primal_dual.solve(program)
    assume(found is not None)  # it may give up, seldom: then another one is asked
    assert found is not None
    assert found.impossible
    assert found.multipliers is not None
    (Z, above), inequality = found.multipliers, program.constraints[0]
    assert min(np.linalg.eigvalsh(X)[:, 0].min() / np.linalg.norm(X) for X in (Z, above)) > -1e-9
    assert float((Z * inequality.constant).sum()) == pytest.approx(1.0)
    assert np.abs(inequality.adjoint(Z)[0] - above[0]).max() < 1e-6
    for other in (solve(program), picos_model.solve(program), cvxopt(program)):
        assert other is None or violation(other) > 0


@given(seed=seeds, n=st.integers(2, 12), m=st.integers(0, 2), cells=st.integers(2, 5))
@settings(max_examples=15)
def test_central_multipliers_are_inside_and_refute(seed: int, n: int, m: int, cells: int) -> None:
    """Z_i ≻ 0, Σ tr Z_i = 1, Σ Z_i M_i = 0 for Y, and Σ tr Z_i F_i(P, Y) is at least the bound · tr P for P ⪰ 0."""
    random = np.random.default_rng(seed)
    inequality = state_feedback(random.normal(size=(cells, n, n)) + 3 * np.eye(n), np.zeros((n, m)))
    found = ours(least_violation([inequality]), gap=0.3)
    assert found.multipliers is not None
    (Z, _), bound = found.multipliers, found.bound
    assert 0 < bound <= found.objective <= 1.5 * bound
    assert np.trace(Z, axis1=1, axis2=2).sum() == pytest.approx(1.0, abs=1e-7)
    values = np.linalg.eigvalsh(Z)
    assert values.min() > 1e-4 / (n * cells)
    for root in random.normal(size=(5, n, n)):
        P = root @ root.T
        total = float(np.vdot(Z, inequality.evaluate(P, np.zeros((m, n)))))
        assert total >= bound * np.trace(P) * (1 - 1e-6)


@given(seed=seeds, n=st.integers(2, 6), m=st.integers(1, 3), cells=st.integers(1, 5))
@settings(max_examples=15)
def test_the_norm_falls_from_one_bound_of_it_to_the_next(seed: int, n: int, m: int, cells: int) -> None:
    A, B = feasible(seed, n, m, cells, 1e-2)
    inequality, random = state_feedback(A, B), np.random.default_rng(seed)
    root, E = random.normal(size=(n, n)) + 3 * np.eye(n), np.diag(random.uniform(0.5, 2.0, size=m))

    def norm(found: Solution) -> float:
        EK = E @ found.Y @ np.linalg.inv(found.P)
        return float(np.linalg.norm(EK @ root, 2))

    last = solve(largest_margin(inequality))
    assert last is not None
    program = smaller_gain(inequality, root, E, (last.P, last.Y))
    here, theirs = ours(program), picos_model.solve(program)
    assert theirs is not None
    for found in (here, theirs):
        assert norm(found) ** 2 <= (found.t + 1e-6) * norm(last) ** 2
    assert here.t == pytest.approx(theirs.t, rel=1e-4, abs=1e-4)
    assert np.linalg.eigvalsh(inequality.evaluate(here.P, here.Y)).max() < 1e-9
    following = solve(smaller_gain(inequality, root, E, (theirs.P, theirs.Y)))
    assert following is not None
    assert norm(following) <= norm(theirs) * (1 + 1e-3) + 1e-3 * norm(last)
    assert norm(theirs) <= norm(last) * (1 + 1e-3)


@pytest.mark.parametrize(("n", "m", "cells"), [(3, 1, 2), (4, 1, 3), (5, 1, 2), (8, 2, 8), (12, 3, 16)])
@pytest.mark.parametrize("seed", [1, 2])
def test_each_further_program_of_a_sequence_takes_at_most_eight_iterations(
    monkeypatch: pytest.MonkeyPatch, seed: int, n: int, m: int, cells: int
) -> None:
    """Margins at one rate after the other, and closer bounds of the norm, as a design solves them."""
    counts = list[int]()

    def counted(program: SemidefiniteProgram, *args: Any, **options: Any) -> Solution | None:
        found = solve(program, *args, **options)
        if options.get("after") is not None:
            assert found is not None
            assert found.iterations is not None
            counts.append(found.iterations)
        return found

    monkeypatch.setattr(convergence, "solve", counted)
    monkeypatch.setattr(candidates, "solve", counted)
    A, B = feasible(seed, n, m, cells, 1e-2)
    search = synthesis.Search(Task(A=A, B=B, cells=[str(i) for i in range(cells)]))
    found = search.regulator(0.0)
    assert found is not None
    assert search.smallest(0.9 * found[1].rate) is not None
    assert len(counts) >= 2
    assert max(counts) <= 8


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "damped"), [(0, 0.8316365022), (1, 0.7099422066)])
def test_a_marginal_plant_is_called_undecided_after_at_most_52_programs(
    monkeypatch: pytest.MonkeyPatch, seed: int, damped: float
) -> None:
    """The least damping with which there is a gain, and a millionth more."""
    counts, method = list[int](), primal_dual.solve

    def counted(program: SemidefiniteProgram, **options: Any) -> Solution | None:
        found = method(program, **options)
        counts.append(0 if found is None or found.iterations is None else found.iterations)
        return found

    monkeypatch.setattr(primal_dual, "solve", counted)
    A, B = infeasible(seed, 4, 1, 3, 1e-2)
    task = Task(A=A - damped * (1 + 1e-6) * np.eye(4), B=B, cells=["a", "b", "c"])
    with pytest.raises(Undecided):
        synthesis.gain(task)
    assert len(counts) <= 52
    assert max(counts) <= 60


@given(seed=seeds, n=st.integers(2, 8), m=st.integers(1, 3), cells=st.integers(2, 6))
@settings(max_examples=15)
@example(seed=265, n=2, m=1, cells=2)  # what follows gets lost after three steps
def test_an_answer_is_the_same_wherever_it_is_looked_for(seed: int, n: int, m: int, cells: int) -> None:
    """From an infeasible start, or from the answer to another program."""
    A, B = feasible(seed, n, m, cells, 1e-2)
    inequality, H, E = state_feedback(A, B), np.eye(n), np.eye(B.shape[1])
    answer = solve(smallest_gain(inequality, H, E), gap=1e-3)
    assert answer is not None
    first = answer.P, answer.Y
    found = solve(smaller_gain(inequality, H, E, first), gap=1e-3)
    assert found is not None
    program = smaller_gain(inequality, H, E, (found.P, found.Y), first)
    following, alone = solve(program, gap=1e-3, after=found), solve(program, gap=1e-3)
    assert following is not None
    assert alone is not None
    assert following.t == pytest.approx(alone.t, rel=2e-3, abs=1e-9)
    assert following.t <= found.t * (1 + 2e-3) + 1e-9


def test_what_is_no_start_for_a_program_does_no_harm() -> None:
    small, large = (largest_margin(lyapunov(-np.eye(n)[None])) for n in (2, 3))
    other, alone = solve(small), solve(large)
    assert other is not None
    assert alone is not None
    found = solve(large, after=other)
    assert found is not None
    assert found.t == alone.t
    at_the_edge = replace(alone, P=np.eye(3), t=1.0)
    found = solve(large, after=at_the_edge)
    assert found is not None
    assert found.t == pytest.approx(alone.t, abs=1e-6)


@given(seed=seeds, n=st.integers(2, 8), cells=st.integers(1, 5))
@settings(max_examples=15)
def test_it_ends_as_soon_as_the_objective_is_certain_to_be_on_one_side(seed: int, n: int, cells: int) -> None:
    M = np.random.default_rng(seed).normal(size=(cells, n, n)) / 2
    program = least_violation([lyapunov(M)])
    least = ours(program)
    assert least.iterations is not None
    for value in (least.objective - 0.3, least.objective + 0.3):
        early = ours(program, gap=0.9, against=value)
        assert early.iterations is not None
        assert early.iterations < least.iterations
        assert early.objective < value or early.bound > value
        assert (least.objective < value) == (early.objective < value)


@pytest.mark.parametrize("build", BUILDERS)
@given(
    n=st.integers(1, 3),
    m=st.integers(0, 2),
    cells=st.integers(1, 2),
    still=st.booleans(),
    idle=st.booleans(),
    seed=seeds,
)
@settings(max_examples=5)
def test_every_solver_takes_every_program_however_little_is_in_it(
    build: str, n: int, m: int, cells: int, still: bool, idle: bool, seed: int
) -> None:
    """Without inputs, with B = 0, one state, one cell, A = 0: the same objective from all, of the right shape.

    Where inputs reach all states the least violation is without bound, and P may be so where A = 0; without inputs
    there is no gain to be small: then some find nothing.
    """
    random = np.random.default_rng(seed)
    A = np.zeros((cells, n, n)) if still else random.normal(size=(cells, n, n)) / (4 * n) - 2 * np.eye(n)
    B = np.zeros((n, m)) if idle else random.normal(size=(n, m))
    program = BUILDERS[build](A, B)
    answers = [picos_model.solve(program), cvxopt(program), solve(program)]
    certain = not still and (build != "least_violation" or idle) and (m > 0 or "gain" not in build)
    for found in answers:
        if found is not None:
            assert found.P.shape == (n, n)
            assert found.Y.shape == (program.m, n)
        assert found is not None or not certain
    if certain:
        objectives = [found.objective for found in answers if found is not None]
        np.testing.assert_allclose(objectives, objectives[0], rtol=1e-5, atol=1e-5)


@given(seed=seeds, n=st.integers(2, 4), m=st.integers(0, 1), cells=st.integers(1, 3))
@settings(max_examples=8)
def test_the_least_violation_has_the_trace_that_is_asked_in_both_solvers(seed: int, n: int, m: int, cells: int) -> None:
    random = np.random.default_rng(seed)
    inequality = state_feedback(random.normal(size=(cells, n, n)) + np.eye(n), random.normal(size=(n, m)))
    program = least_violation([inequality])
    answers = [picos_model.solve(program), solve(program)]
    if not m:  # CVXOPT gives up where Y is large
        answers.append(cvxopt(program))
    for found in answers:
        assert found is not None
        assert np.trace(found.P) == pytest.approx(1.0, abs=1e-6)
    values = [float(np.linalg.eigvalsh(inequality.evaluate(f.P, f.Y)).max()) for f in answers if f is not None]
    np.testing.assert_allclose(values, values[0], rtol=1e-2, atol=1e-3)


def test_a_program_that_does_not_fit_together_is_refused() -> None:
    two, three = lyapunov(-np.eye(2)[None]), lyapunov(-np.eye(3)[None])
    with pytest.raises(ValueError, match="the same P and Y"):
        SemidefiniteProgram(constraints=(two, three), price=0.0)
    with pytest.raises(ValueError, match="the same P and Y"):
        SemidefiniteProgram(constraints=(), price=0.0)
    with pytest.raises(ValueError, match="one objective"):
        SemidefiniteProgram(constraints=(two,), price=0.0, cost=np.eye(2), weight=np.eye(2))
    with pytest.raises(ValueError, match="stands in no constraint"):
        SemidefiniteProgram(constraints=(two,), price=1.0)
    with pytest.raises(ValueError, match="V has 3 columns, P has 2"):
        SemidefiniteProgram(constraints=(two,), price=0.0, weight=np.eye(3))
    with pytest.raises(ValueError, match="W is 3 × 3, P is 2 × 2"):
        SemidefiniteProgram(constraints=(two,), price=0.0, cost=np.eye(3))


def test_a_nan_in_the_data_is_not_called_solved() -> None:
    assert solve(largest_margin(lyapunov(np.array([[[np.nan]]])))) is None
    with asking("cvxopt"):
        assert solve(largest_margin(lyapunov(np.array([[[np.inf]]])))) is None


@given(seed=seeds, n=st.integers(1, 5), m=st.integers(1, 2))
@settings(max_examples=15)
def test_with_one_cell_the_least_cost_gain_is_the_lqr_gain(seed: int, n: int, m: int) -> None:
    random = np.random.default_rng(seed)
    A, B = random.normal(size=(n, n)) - 0.5 * np.eye(n), random.normal(size=(n, m))
    assume(np.linalg.norm(solve_continuous_are(A, B, np.eye(n), np.eye(m)), 2) <= 20)  # else nearly unreachable
    candidate = picos_model.solve(least_cost(quadratic_cost(A[None], B, np.eye(n), np.eye(m)), np.eye(n)))
    assert candidate is not None
    K = -np.linalg.solve(candidate.P, B).T
    K_lqr = -B.T @ solve_continuous_are(A, B, np.eye(n), np.eye(m))
    np.testing.assert_allclose(K, K_lqr, rtol=0, atol=1e-5 * np.abs(K_lqr).max())


@given(seeds)
@settings(max_examples=20)
def test_the_observer_inequality_is_the_transposed_controller_inequality(seed: int) -> None:
    """(9) in 𝒫_o, 𝒳 is (8) for (A_iᵀ, Cᵀ) with P = 𝒫_o, Y = 𝒳ᵀ."""
    random = np.random.default_rng(seed)
    A, C = random.normal(size=(2, 3, 3)), random.normal(size=(1, 3))
    P, X = symmetric_part(random.normal(size=(3, 3))), random.normal(size=(3, 1))
    ours = state_feedback(np.swapaxes(A, 1, 2), C.T).evaluate(P, X.T)
    for left, A_i in zip(ours, A, strict=True):
        np.testing.assert_allclose(left, P @ A_i + A_i.T @ P + X @ C + C.T @ X.T, atol=1e-12)


@given(seeds, st.integers(1, 6), st.floats(0.01, 1.0))
@settings(max_examples=30)
def test_a_certificate_bounds_the_energy_along_any_switching(seed: int, n: int, slack: float) -> None:
    """d/dt xᵀP⁻¹x ≤ −2 rate xᵀP⁻¹x in every cell, checked at random states."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(n, n)) + 2 * np.eye(n)
    assume(np.linalg.cond(root) < 1e3)
    S = random.normal(size=(3, n, n))
    S -= np.swapaxes(S, 1, 2)
    M = root @ (S - slack * np.eye(n)) @ np.linalg.inv(root)
    P = root @ root.T
    certificate = prove(M, P)
    assert certificate is not None
    assert certificate.rate == pytest.approx(slack, rel=2e-3)
    for x in random.normal(size=(10, n)):
        v = np.linalg.solve(certificate.P, x)
        for M_i in M:
            assert 2 * v @ M_i @ x <= -2 * certificate.rate * (v @ x) * (1 - 1e-9)


@given(seeds, st.integers(2, 5), st.floats(-16, -1), st.booleans())
@settings(max_examples=200)
def test_a_matrix_that_is_not_stable_is_never_certified(seed: int, n: int, exponent: float, marginal: bool) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(n, n))
    real = np.diag([0.0 if marginal else 10.0**exponent] + [-1.0] * (n - 1))
    M = root @ real @ np.linalg.inv(root)
    P = root @ np.diag(random.uniform(0.1, 1, size=n)) @ root.T
    certificate = prove(M[None], P)
    assert certificate is None or np.linalg.eigvals(M).real.max() < 0


@pytest.mark.parametrize("P", [np.zeros((2, 2)), -np.eye(2), np.full((2, 2), np.nan), np.diag([1.0, 0.0])])
def test_a_wrong_P_is_no_proof(P: Array) -> None:
    assert prove(-np.eye(2)[None], P) is None


@pytest.mark.parametrize("solver", get_args(Solver))
@pytest.mark.parametrize(
    "A",
    [
        np.array([[[0.0, 1.0], [-1.0, 0.0]]]),  # pure oscillator: best margin exactly 0
        np.array([[[0.0]]]),  # pure integrator
        np.array([[[-1.0, 0.0], [0.0, 0.0]], [[-1.0, 0.0], [0.0, -1.0]]]),  # zero mode in one cell
    ],
)
def test_a_marginal_case_is_not_feasible(A: Array, solver: Solver) -> None:
    with asking(solver), pytest.raises((Undecided, Infeasible)):
        convergence.prove_convergence(A, claim="(7)", cells=CELLS[: len(A)])


@pytest.mark.parametrize("n", [3, 12])
def test_the_primal_dual_method_finds_the_least_cost(n: int) -> None:
    """One cell: Riccati. More: PICOS, where it can."""
    random = np.random.default_rng(n)
    A, B = random.normal(size=(3, n, n)) / 5 - np.eye(n), random.normal(size=(n, 2))
    V = random.normal(size=(n, n))
    program = least_cost(quadratic_cost(A, B, np.eye(n), np.eye(2)), V)
    found, other = ours(program), picos_model.solve(program)
    assert other is not None
    assert program.constraints[0].margin(found.P, found.Y) > 0
    assert found.objective == pytest.approx(other.objective, rel=1e-5)
    X = solve_continuous_are(A[0], B, np.eye(n), np.eye(2))
    alone = ours(least_cost(quadratic_cost(A[:1], B, np.eye(n), np.eye(2)), V))
    assert np.linalg.norm(alone.P @ X - np.eye(n)) < 1e-4


def test_a_lying_solver_convinces_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    def liar(program: SemidefiniteProgram, *_: object, **__: object) -> Solution:
        lies = tuple(np.broadcast_to(np.eye(c.constant.shape[1]), c.constant.shape) for c in program.constraints)
        return Solution(program=program, P=np.eye(2), Y=np.zeros((1, 2)), t=0.0, multipliers=lies)

    monkeypatch.setattr(picos_model, "solve", liar)
    monkeypatch.setattr(primal_dual, "solve", liar)
    stable_apart = np.array([[[-1.0, 10.0], [0.0, -1.0]], [[-1.0, 0.0], [10.0, -1.0]]])
    with pytest.raises(Undecided):
        convergence.prove_convergence(stable_apart, claim="(7)", cells=("a", "b"))
    with pytest.raises(Undecided, match=r"the best margin found is -[0-9]"):
        synthesis.gain(Task(A=stable_apart, B=np.zeros((2, 1)), cells="ab"))


def test_two_cells_that_are_stable_apart_can_be_proved_to_have_no_common_P() -> None:
    A = np.array([[[-1.0, 10.0], [0.0, -1.0]], [[-1.0, 0.0], [10.0, -1.0]]])
    with pytest.raises(Infeasible, match=r"\(7\) is infeasible: cells 'a' and 'b' conflict, no common P"):
        convergence.prove_convergence(A, claim="(7)", cells=("a", "b"))


def test_a_refutation_holds_only_for_what_it_speaks_of() -> None:
    nothing = decimals(np.zeros((1, 0)))
    one, two = decimals(np.eye(1)), decimals(2 * np.eye(1))
    assert refutes([one], nothing, {0: one})
    assert refutes([0 * one], nothing, {0: one})  # a pure integrator: margin exactly 0
    assert not refutes([-one], nothing, {0: one})
    assert not refutes([one], nothing, {0: -one})
    assert not refutes([one], one, {0: one})  # with an input it can be stabilised
    assert refutes([one, -two], nothing, {0: two, 1: one})
    assert not refutes([one, -two], nothing, {0: 0 * one, 1: 0 * one})
    assert not refutes([one, -two], nothing, {0: one, 1: -one})


@given(seeds)
@settings(max_examples=20)
def test_either_a_proof_or_a_refutation_exists(seed: int) -> None:
    """Random matrices are not marginal."""
    A = random_stack(seed, n=3, cells=2) - 1.5 * np.eye(3)
    candidate = solve(largest_margin(lyapunov(A)))
    assert candidate is not None
    assert (prove(A, candidate.P) is not None) != (refute(A, np.zeros((3, 0))) is not None)


@given(seeds, st.lists(st.integers(-20, 20), min_size=3, max_size=3))
def test_scaling_by_powers_of_two_loses_no_bit(seed: int, exponents: list[int]) -> None:
    A = random_stack(seed, n=3, cells=2)
    d = 2.0 ** np.array(exponents)
    stretched = A * d[:, None] / d
    at = Coordinates.balanced(stretched, np.ones((3, 1)))
    back = at.T @ (at.system(stretched) * at.speed) @ at.inverse
    assert (back == stretched).all()


@pytest.mark.parametrize(("length", "time", "force"), [(2**10, 1, 1), (2**-10, 2**-6, 2**8), (1e3, 60.0, 1e-3)])
def test_a_design_exists_in_any_units(length: float, time: float, force: float) -> None:
    """Positions in mm, hours for seconds …: the example stays feasible, with the same controller."""
    A = np.array([[[0, 1.0], [-k, -0.3]] for k in (1.0, 1.4)])
    B = np.array([[0.0], [1.0]])
    d, s = np.array([length, length / time]), time
    K, _ = synthesis.gain(Task(A=A, B=B, cells=CELLS[:2]))
    other, _ = synthesis.gain(Task(A=s * A * d[:, None] / d, B=s * B * d[:, None] / force, cells=CELLS[:2]))
    np.testing.assert_allclose(other * d / force, K, rtol=1e-5)  # the margin is known to its gap, K less well


def test_an_unreachable_unstable_mode_is_named() -> None:
    A = np.diag([1.5, -1.0])[None]
    with pytest.raises(Infeasible, match=r"no gain moves the eigenvalue 1\.5 in cell 'only'"):
        synthesis.gain(Task(A=A, B=np.array([[0.0], [1.0]]), cells=["only"]))


def in_hull(X: Array, points: Array) -> bool:
    """Say by a linear program whether X is a convex combination of points."""
    equations = np.vstack([points.reshape(len(points), -1).T, np.ones(len(points))])
    return bool(linprog(np.zeros(len(points)), A_eq=equations, b_eq=np.append(X.ravel(), 1.0)).status == 0)


@given(seeds, st.integers(1, 4), st.integers(1, 5), st.integers(2, 24))
def test_every_cell_lies_in_the_hull_of_those_that_are_solved_for(seed: int, n: int, k: int, count: int) -> None:
    random = np.random.default_rng(seed)
    slopes, directions = random.integers(0, 4, size=(count, k)) / 4, random.normal(size=(k, n, n))
    A = random.normal(size=(n, n)) + np.einsum("ck,kij->cij", slopes, directions)
    kept = corners(A)
    assert len(kept) <= len(distinct(A)[0])
    assert all(in_hull(X, A[kept]) for X in A)


@given(seeds, st.integers(1, 5), st.integers(2, 4))
def test_of_a_box_of_slopes_only_the_corners_are_solved_for(seed: int, k: int, slopes: int) -> None:
    random, n = np.random.default_rng(seed), k + 2
    rows, directions = random.normal(size=(k, n)), np.eye(n)[random.permutation(n)[:k]]
    steps = np.sort(random.uniform(1, 2, size=(k, slopes)).round(3) + np.arange(slopes))
    grid = np.array(np.meshgrid(*steps, indexing="ij")).reshape(k, -1).T
    order = random.permutation(len(grid))
    A = random.normal(size=(n, n)) + np.einsum("ck,ki,kj->cij", grid, directions, rows)
    ends = ((grid == steps[:, 0]) | (grid == steps[:, -1])).all(axis=1)
    assert sorted(order[corners(A[order])].tolist()) == np.flatnonzero(ends).tolist()


def test_equal_cells_are_solved_once() -> None:
    A = random_stack(0)
    matrices, place = distinct(A[[0, 1, 0, 2, 1]])
    assert len(matrices) == 3
    assert (matrices[place] == A[[0, 1, 0, 2, 1]]).all()
