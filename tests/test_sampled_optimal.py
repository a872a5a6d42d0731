"""Gains of least cost in samples: against costs that are summed over a simulation, and covariances stepped to rest."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_lyapunov

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.claims.sampled import SampledLoop
from pwatrack.control.goal import AtLeast, Given, LeastCost
from pwatrack.control.sampled_gains import sampled_gains
from pwatrack.control.sampled_optimal import candidates, kalman, regulator
from pwatrack.control.task import Task
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER
from pwatrack.model.conditions import Sampling
from pwatrack.report.certificate import design_certificate
from pwatrack.workflow.pipeline import asked_of
from tests.scenarios import TWO

A, B = np.array([[0.3, 1.0], [-2.0, -0.4]]), np.array([[0.2], [1.0]])
Q, R = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[0.5]])
FINE = 2000


def task(X: Array, Y: Array) -> Task:
    return Task(A=X[None], B=Y, cells=["all"])


def cost(K: Array, h: float) -> float:
    """∫(xᵀ Q x + uᵀ R u) dt from both unit vectors, by the trapezoidal rule within each sample."""
    whole = np.block([[A, B], [np.zeros((1, 3))]])
    times = np.linspace(0, h, FINE + 1)
    within = np.array([expm(whole * t)[:2] @ np.vstack([np.eye(2), K]) for t in times])
    lost = np.trapezoid([X.T @ Q @ X + K.T @ R @ K for X in within], times, axis=0)
    return float(np.trace(solve_discrete_lyapunov(within[-1].T, lost)))


@pytest.mark.parametrize("h", [0.05, 0.8])
def test_no_other_gain_costs_less_than_the_regulator(h: float) -> None:
    K = regulator(task(A, B), LeastCost(Q=Q, R=R), h)
    assert K is not None
    least = cost(K, h)
    for k in range(2):
        for change in (-0.02, 0.02):
            assert cost(K + change * np.eye(2)[k : k + 1], h) > least


@pytest.mark.parametrize("h", [0.05, 0.8])
def test_the_filter_is_that_of_a_covariance_stepped_to_rest(h: float) -> None:
    C = B.T
    M = kalman(task(A.T, C.T), LeastCost(Q=Q, R=R), h)
    assert M is not None
    times = np.linspace(0, h, FINE + 1)
    over = expm(A * h)
    noise = np.trapezoid([expm(A * t) @ Q @ expm(A.T * t) for t in times], times, axis=0)
    P = np.eye(2)
    for _ in range(1000):
        gain = P @ C.T / (C @ P @ C.T + R / h)
        P = over @ (P - gain @ C @ P) @ over.T + noise
    assert pytest.approx(-gain, rel=1e-5) == M


def test_a_rate_that_is_asked_for_is_reached_in_the_mean() -> None:
    K = regulator(task(A, B), AtLeast(rate=3.0), 0.1)
    assert K is not None
    whole = expm(np.block([[A, B], [np.zeros((1, 3))]]) * 0.1)
    assert np.abs(np.linalg.eigvals(whole[:2, :2] + whole[:2, 2:] @ K)).max() < np.exp(-3.0 * 0.1)


def test_what_is_rounding_of_plants_that_do_not_touch_is_no_gain_and_no_other_gain(tmp_path: Path) -> None:
    """What processors round apart is entries that are 0: a certificate is read where these are others."""
    cost = "{cost: {Q: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], R: [[1, 0], [0, 1]]}}"
    text = TWO.replace("DESIGN", f"{{controller: {cost}, observer: {cost}}}")
    (tmp_path / "two.yaml").write_text(text.replace("MORE", "controller: {sample_time: 0.05}"), encoding="utf-8")
    spec = load_spec(tmp_path / "two.yaml")
    controller = design(spec)
    claim, own = controller.claim(SampledLoop), asked_of(spec, None, controller)
    assert (claim.gains.K[0, 2:] == 0).all()
    assert (claim.gains.K[1, :2] == 0).all()
    assert (claim.gains.M[:2, 1] == 0).all()
    off = replace(claim, gains=replace(claim.gains, K=claim.gains.K + 1e-15))
    content = design_certificate(spec, replace(controller, claims=(off,)))
    (told,) = SampledLoop.prove(controller, own, content)
    assert (told.gains.K == off.gains.K).all()


def test_gains_that_were_tried_are_not_tried_again(specs: Path) -> None:
    controller = design(load_spec(specs / "gallery" / "two_rooms.yaml"))
    made = sampled_gains(controller.plant, controller.K, controller.L, Sampling(sample_time=70))
    goals = {CONTROLLER: AtLeast(rate=1.0), OBSERVER: AtLeast(rate=1.0)}  # too fast for any gain for all cells
    found = [(one.K.tobytes(), one.M.tobytes()) for one in candidates(controller.plant, controller.sizes, goals, made)]
    assert len(found) == len(set(found)) >= 1


def test_what_is_given_stays_and_what_has_a_cost_as_its_goal_comes_first(specs: Path) -> None:
    controller = design(load_spec(specs / "two_mass_paper_gains.yaml"))
    plant, sizes = controller.plant, controller.sizes
    made = sampled_gains(plant, controller.K, controller.L, Sampling(sample_time=0.1))
    free, costly = AtLeast(), LeastCost(Q=np.eye(4), R=np.eye(1))
    given = Given(gain=controller.K), Given(gain=controller.L)
    assert list(candidates(plant, sizes, {CONTROLLER: given[0], OBSERVER: given[1]}, made)) == [made]
    first, *others = candidates(plant, sizes, {CONTROLLER: given[0], OBSERVER: free}, made)
    assert first == made
    assert all((other.K == made.K).all() for other in others)
    assert len({other.M.tobytes() for other in [first, *others]}) == 3  # made of L, of least cost in the mean, for all
    first, *others = candidates(plant, sizes, {CONTROLLER: costly, OBSERVER: free}, made)
    K = regulator(Task.of(plant, CONTROLLER, sizes=sizes), costly, 0.1)
    assert pytest.approx(K) == first.K
    assert (first.M == made.M).all()
    assert [(one.K == first.K).all() for one in others] == [True, False, False]
    assert (others[1].K == others[2].K).all()
    assert [(one.M == made.M).all() for one in others] == [False, True, False]
