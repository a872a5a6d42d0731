"""Gains of least cost for all cells: what they make of each part of the loop is proved; those of a mean do not do."""

from collections.abc import Iterator, Sequence
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.control.goal import AtLeast, Goal
from pwatrack.control.sampled_optimal import kalman, regulator
from pwatrack.control.task import Task
from pwatrack.lmi.clocked import Clocked, clocked_proof
from pwatrack.lmi.clocked_gains import correction, feedback, largest_form

PERIOD = 0.125
FREE = AtLeast()


def falls(F: Sequence[Array], J: Array) -> bool:
    system = Clocked(F=[BallMatrix.of(X) for X in F], J=[BallMatrix.of(J)], period=Fraction(PERIOD))
    return any(clocked_proof(system, knots=knots) is not None for knots in (8, 32))


def observed(A: Array, C: Array, M: Array) -> bool:
    return falls(list(A), np.eye(len(M)) + M @ C)


def held(A: Array, B: Array, K: Array) -> bool:
    n, m = B.shape
    tick = np.block([[np.eye(n), np.zeros((n, m))], [K, np.zeros((m, m))]])
    return falls([np.block([[A_i, B], [np.zeros((m, n + m))]]) for A_i in A], tick)


def of_one(A: Array, B: Array) -> Task:
    return Task(A=A, B=B, cells=[f"{k}" for k in range(len(A))])


def gains(
    A: Array, B: Array, C: Array, goal: Goal = FREE, *, for_all: bool, h: float = PERIOD
) -> tuple[Array | None, Array | None]:
    """M and K of all weights 1 in sizes."""
    M = kalman(of_one(A.transpose(0, 2, 1), C.T), goal, h, for_all=for_all)
    return M, regulator(of_one(A, B), goal, h, for_all=for_all)


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.integers(2, 4), st.integers(1, 2), st.integers(2, 3))
def test_gains_that_are_found_do_for_all_cells(seed: int, n: int, q: int, cells: int) -> None:
    random = np.random.default_rng(seed)
    A = random.normal(size=(n, n)) + 0.5 * random.normal(size=(cells, n, 1)) * random.normal(size=n)
    C, B = random.normal(size=(q, n)), random.normal(size=(n, q))
    M, K = gains(A, B, C, for_all=True)
    assert M is None or observed(A, C, M)
    assert K is None or held(A, B, K)


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.integers(2, 4), st.integers(1, 2))
def test_of_one_cell_they_are_nearly_those_of_least_cost(seed: int, n: int, q: int) -> None:
    random = np.random.default_rng(seed)
    A, C, B = random.normal(size=(1, n, n)), random.normal(size=(q, n)), random.normal(size=(n, q))
    each = (gains(A, B, C, for_all=for_all, h=0.01) for for_all in (True, False))
    for found, best in zip(*each, strict=True):
        assert found is not None
        assert best is not None
        assert np.abs(found - best).max() < 0.05 * np.abs(best).max()


def switched(A: Array, h: float, seed: int) -> Iterator[tuple[Array, float]]:
    """e^(A_j t) of one cell after another within a sample, with the time that each lasts."""
    random = np.random.default_rng(seed)
    for part in np.diff(np.concatenate([[0.0], np.sort(random.uniform(size=3)), [1.0]])) * h:
        yield A[random.integers(len(A))], float(part)


def over(A: Array, Q: Array, t: float) -> tuple[Array, Array]:
    """e^(A t), and the integral of e^(A s) Q e^(Aᵀ s) up to t."""
    n = len(A)
    both = expm(np.block([[-A, Q], [np.zeros((n, n)), A.T]]) * t)
    return both[n:, n:].T, both[n:, n:].T @ both[:n, n:]


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_the_covariance_of_the_observer_stays_below_that_of_the_form(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, C = np.array([[[0.0, 1.0], [a, -0.2]] for a in random.uniform(-20, 20, 3)]), np.array([[1.0, 0.0]])
    form = largest_form(A, np.eye(2), None, PERIOD * C.T @ C, np.eye(2), PERIOD)
    assert form is not None
    above = np.linalg.inv(form)
    M = -above @ C.T @ np.linalg.inv(C @ above @ C.T + np.eye(1) / PERIOD)
    assert correction(A, C, np.eye(2), np.eye(1), period=PERIOD, near=np.eye(2)) == pytest.approx(M)
    P = np.zeros((2, 2))
    for tick in range(60):
        left = np.eye(2) + M @ C
        P = left @ P @ left.T + M @ M.T / PERIOD
        for X, part in switched(A, PERIOD, seed + tick):
            turned, noise = over(X, np.eye(2), part)
            P = turned @ P @ turned.T + noise
        assert np.linalg.eigvalsh(above - P)[0] > -1e-9 * np.abs(above).max()


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_the_cost_of_the_regulator_stays_below_that_of_the_form(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, B = np.array([[[0.0, 1.0], [a, -0.2]] for a in random.uniform(-10, 10, 3)]), np.array([[0.0], [1.0]])
    F = np.array([np.block([[X, B], [np.zeros((1, 3))]]) for X in A])
    form = largest_form(F.transpose(0, 2, 1), np.eye(3), np.eye(3, 2), np.zeros((3, 3)), np.eye(3), PERIOD)
    assert form is not None
    K = form[2:, :2] @ np.linalg.inv(form[:2, :2])
    assert feedback(A, B, np.eye(2), np.eye(1), period=PERIOD, near=np.eye(3)) == pytest.approx(K)
    e = start = random.normal(size=2)
    spent = 0.0
    for tick in range(400):
        z = np.concatenate([e, K @ e])
        for X, part in switched(F, PERIOD, seed + tick):
            turned, weight = over(X.T, np.eye(3), part)
            spent += z @ weight @ z
            z = turned.T @ z
        e = z[:2]
    assert spent <= start @ np.linalg.solve(form[:2, :2], start) * (1 + 1e-9)


def test_they_do_for_cells_that_differ_too_much_for_gains_of_the_mean() -> None:
    A = np.array([[[0.0, 1.0], [a, -0.1]] for a in (-30.0, 30.0)])
    B, C = np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    M, K = gains(A, B, C, for_all=True)
    assert M is not None
    assert K is not None
    assert observed(A, C, M)
    assert held(A, B, K)
    M, K = gains(A, B, C, for_all=False)
    assert M is not None
    assert K is not None
    assert not observed(A, C, M)
    assert not held(A, B, K)


def test_there_are_none_where_what_is_not_seen_grows_in_one_cell() -> None:
    A = np.array([np.diag([0.1, -1.0]), np.diag([-2.0, -1.0])])
    assert all(X is not None for X in gains(A, np.array([[0.0], [1.0]]), np.array([[0.0, 1.0]]), for_all=False))
    assert gains(A, np.array([[0.0], [1.0]]), np.array([[0.0, 1.0]]), for_all=True) == (None, None)


def test_a_rate_that_is_asked_for_is_reached_in_every_cell() -> None:
    A = np.array([[[-0.5 * k, 1.0], [-1.0, 0.5]] for k in range(3)])
    B, rate = np.array([[0.0], [1.0]]), 2.0
    M, K = gains(A, B, B.T, AtLeast(rate=rate), for_all=True)
    assert M is not None
    assert K is not None
    assert observed(A + rate * np.eye(2), B.T, M)
    growing = [np.block([[A_i + rate * np.eye(2), B], [np.zeros((1, 2)), rate * np.eye(1)]]) for A_i in A]
    assert falls(growing, np.block([[np.eye(2), np.zeros((2, 1))], [K, np.zeros((1, 1))]]))
