"""Section V of the paper, with its misprints mended, number by number."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pwatrack import Result, Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.control.convergence import prove_convergence
from pwatrack.control.generator import TrajectoryGenerator, trajectory_generator
from pwatrack.control.goal import DEFAULT, Given
from pwatrack.errors import Infeasible, OutsideTheory
from pwatrack.lmi.inequality import Solver
from pwatrack.model.normal_form import normal_form
from tests.scenarios import in_scenario

STATES = [  # t, y − y_d, ‖x − x̂‖, η̂_1: as printed, so half a unit of the last digit is allowed
    (0, "2.500e-01", "2.500e-01", "0.2"),
    (1, "-2.761e-01", "1.871e-01", "0.09960531"),
    (5, "7.552e-02", "4.291e-02", "0.05364562"),
    (10, "3.795e-05", "1.969e-02", "-0.01116546"),
    (20, "3.090e-04", "2.782e-03", "-0.01823472"),
    (30, "-1.321e-05", "4.630e-04", "-0.00830725"),
    (40, "-2.486e-06", "7.672e-05", "-0.00729241"),
    (60, "-1.059e-06", "1.970e-06", "-0.00779703"),
]
WINDOWS = [(0, 5, "0.3246"), (5, 10, "0.0755"), (10, 20, "2.61e-3"), (20, 30, "5.4e-4"), (30, 40, "5.3e-5")]


def generator_of(controller: ProvedController) -> TrajectoryGenerator:
    assert controller.generator is not None
    return controller.generator


def half_unit(printed: str) -> float:
    mantissa, _, exponent = printed.partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(0.5 * 10.0 ** (int(exponent or 0) - decimals) * (1 + 1e-9))


@pytest.mark.parametrize(("t", "tracking", "observer", "eta"), STATES)
def test_the_table_of_states_is_reproduced(paper: Result, t: int, tracking: str, observer: str, eta: str) -> None:
    response, k = paper.response, 100 * t
    assert response.t[k] == pytest.approx(t)
    assert abs(response.tracking_error[k, 0] - float(tracking)) <= half_unit(tracking)
    assert abs(response.observer_error[k] - float(observer)) <= half_unit(observer)
    assert abs(response.eta_hat[k, 0] - float(eta)) <= half_unit(eta)


@pytest.mark.parametrize(("start", "end", "largest"), WINDOWS)
def test_the_table_of_windows_is_reproduced(paper: Result, start: int, end: int, largest: str) -> None:
    error = np.abs(paper.response.tracking_error[100 * start : 100 * end + 1]).max()
    assert abs(error - float(largest)) <= half_unit(largest)


def test_the_joint_mode_changes_694_times_between_19_modes(paper: Result) -> None:
    assert len(paper.response.trace.events) == 694
    assert len(paper.response.trace.visited()) == 19


def equations_of_section_v(t: float, state: Array) -> Array:
    """The closed loop written down from (20)–(23) with their misprints mended, as an oracle."""
    m1 = m2 = k1 = 1.0
    d1, d2, k2, k3, c1, c2, Ad, omega = 0.2, 0.1, 0.4, 0.4, 0.1, 0.05, 0.15, 2 * np.pi
    K = np.array([-1.6088, -1.1260, 0.2282, -0.1182])
    L = np.array([-1.1056, -1.5348, -0.1027, 0.1653])
    x, x_hat, eta = state[:4], state[4:8], state[8:]  # eta is η̄ of (21)
    z_d, v_d, a_d = Ad * np.sin(omega * t), Ad * omega * np.cos(omega * t), -Ad * omega**2 * np.sin(omega * t)

    def spring(gap: float) -> float:
        return k2 * (gap - c2) if gap >= c2 else k3 * (gap + c1) if gap <= -c1 else 0.0

    def plant(x: Array, u: float) -> Array:
        contact = spring(x[2] - x[0]) + d2 * (x[3] - x[1])
        return np.array([x[1], (contact + u) / m1, x[3], (-contact - k1 * x[2] - d1 * x[3]) / m2])

    eta_rate = np.array([eta[1] - v_d, (-spring(eta[0]) - k1 * (eta[0] + z_d) - (d1 + d2) * eta[1] + d2 * v_d) / m2])
    u_ff = m1 * a_d - d2 * (eta[1] - v_d) - spring(eta[0])
    x_d = np.array([z_d, v_d, eta[0] + z_d, eta[1]])
    u = float(K @ (x_hat - x_d) + u_ff)
    return np.concatenate([plant(x, u), plant(x_hat, u) + L * (x_hat[0] - x[0]), eta_rate])


@pytest.mark.slow
def test_every_sample_agrees_with_a_tight_integrator(paper: Result) -> None:
    response = paper.response
    start = np.array([0.25, 0, 0, 0, 0, 0, 0, 0, 0.2, 0])
    found = solve_ivp(
        equations_of_section_v, (0, 60), start, method="DOP853", rtol=1e-12, atol=1e-14, t_eval=response.t
    )
    truth, steps = found.y.T, found.nfev / 12
    eta_bar = response.eta_hat - np.column_stack([response.y_d[:, 0], np.zeros(len(response.t))])
    ours = np.hstack([response.x, response.x_hat, eta_bar])
    own = steps * (1e-12 * np.abs(truth).max() + 1e-14)  # what its steps may be off together
    assert np.abs(ours - truth).max() < own < 1e-7


def test_the_feedforward_is_equation_23(paper: Result) -> None:
    response = paper.response
    Ad, omega, t = 0.15, 2 * np.pi, response.t
    gap, rate = response.eta_hat[:, 0] - response.y_d[:, 0], response.eta_hat[:, 1]
    u_c = -Ad * omega**2 * np.sin(omega * t) - 0.1 * (rate - Ad * omega * np.cos(omega * t))
    expected = u_c - np.where(gap <= -0.1, 0.4 * (gap + 0.1), np.where(gap >= 0.05, 0.4 * (gap - 0.05), 0.0))
    np.testing.assert_allclose(response.u_ff[:, 0], expected, atol=1e-11)


def test_the_shift_of_equation_21_is_found(paper: Result) -> None:
    shift = generator_of(paper.controller).shift
    assert shift is not None
    np.testing.assert_allclose(shift, [[1, 0], [0, 0]], atol=1e-12)


def test_the_generator_matrices_are_those_of_22(paper: Result) -> None:
    generator = generator_of(paper.controller)
    for cell, k in enumerate((0.4, 0.0, 0.4)):
        A_eta = np.array([[0.0, 1.0], [-(k + 1), -0.3]])
        np.testing.assert_allclose(generator.A_eta[cell], A_eta, atol=1e-15)
    b_eta = np.array([[0.0, 0.4 * 0.05], [0.0, 0.0], [0.0, -0.4 * 0.1]])
    np.testing.assert_allclose(generator.b_eta, b_eta, atol=1e-15)
    assert generator.shift is not None
    B_bar = generator.A_eta @ generator.shift + generator.B_eta[:, :, :2]
    np.testing.assert_allclose(B_bar[:, 1], [[-1, 0.1]] * 3, atol=1e-12)


def test_the_certified_rates_are_the_best_ones(paper: Result) -> None:
    gains = paper.controller.design
    assert gains.controller.rate == pytest.approx(0.083, abs=5e-4)
    assert gains.observer.rate == pytest.approx(0.084, abs=5e-4)
    assert generator_of(paper.controller).rate == pytest.approx(0.058, abs=5e-4)


@pytest.mark.parametrize("digits", [2, 3, 4])
def test_fewer_printed_digits_of_the_gains_keep_a_rate_of_six_hundredths(paper_spec: Spec, digits: int) -> None:
    def printed(X: Array) -> Array:
        return np.array([[float(f"{v:.{digits - 1}e}") for v in row] for row in X])

    controller, observer = paper_spec.objectives.controller, paper_spec.objectives.observer
    assert isinstance(controller, Given)
    assert isinstance(observer, Given)
    given = replace(
        paper_spec.objectives,
        controller=Given(gain=printed(controller.gain)),
        observer=Given(gain=printed(observer.gain)),
    )
    proofs = design(replace(paper_spec, objectives=given)).proofs
    for part in ("controller", "observer"):
        assert max(proof.rate for proof in proofs if proof.role.name == part) >= 0.06


def test_the_steady_state_of_the_generator_has_period_one(paper: Result) -> None:
    trace = paper.steady_state
    assert trace is not None
    assert trace.t[-1] == pytest.approx(1.0)
    assert np.abs(trace.z[-1] - trace.z[0]).max() <= 1e-11
    assert (trace.z[:, 0].min(), trace.z[:, 0].max()) == pytest.approx((-0.007812, -0.002770), abs=1e-6)


def test_the_gains_as_printed_are_destabilising(specs: Path) -> None:
    with pytest.raises(Infeasible) as refusal:
        design(load_spec(specs / "refused/printed_gains.yaml"))
    text = str(refusal.value)
    assert "(8)" in text
    for figure in ("+1.752 in cell 'upper spring'", "+1.884 in cell 'gap'", "+1.752 in cell 'lower spring'"):
        assert figure in text
    assert refusal.value.code == 4


def test_the_observer_gain_as_printed_is_destabilising(paper_spec: Spec) -> None:
    observer = paper_spec.objectives.observer
    assert isinstance(observer, Given)
    wrong = replace(paper_spec.objectives, observer=Given(gain=-observer.gain))
    with pytest.raises(Infeasible) as refusal:
        design(replace(paper_spec, objectives=wrong))
    text = str(refusal.value)
    assert "(9)" in text
    for figure in ("+1.746 in cell 'upper spring'", "+1.879 in cell 'gap'", "+1.746 in cell 'lower spring'"):
        assert figure in text


def test_A_1_as_printed_is_refused_with_cells_facet_jump_and_line(specs: Path) -> None:
    path = specs / "refused/printed_A1.yaml"
    with pytest.raises(OutsideTheory) as refusal:
        load_spec(path)
    (problem,) = refusal.value.problems
    assert "cells 'upper spring' and 'gap' disagree on z2 - z1 = 0.05" in problem.message
    assert "A jumps by 0.4" in problem.message
    lines = path.read_text().splitlines()
    assert problem.place is not None
    assert "[0, 1, 0, 0]" in lines[problem.place.line - 1]
    assert "as printed" in lines[problem.place.line]
    assert refusal.value.code == 3


def test_seven_is_not_feasible_because_the_gap_has_a_zero_eigenvalue(paper_spec: Spec) -> None:
    plant = paper_spec.problem.plant
    with pytest.raises(Infeasible, match="'gap' not stable"):
        prove_convergence(np.swapaxes(plant.A, 1, 2), claim="(7)", cells=plant.cell_names)


def test_seventeen_has_a_common_P_up_to_069_and_a_polynomial_up_to_1113(specs: Path) -> None:
    path = specs / "two_mass_backlash.yaml"

    def degrees(k: str) -> set[int]:
        proofs = design(load_spec(path, {"k2": k, "k3": k})).guarantees.generator
        return {proof.degree for proof in proofs}

    assert [degrees(k) for k in ("0.68", "0.70", "1.112")] == [{2}, {8}, {10}]
    with pytest.raises(Infeasible, match=r"\(17\).*infeasible.* no polynomial of degree 4, 6, 8 or 10 was found"):
        trajectory_generator(normal_form(load_spec(path, {"k2": "1.12", "k3": "1.12"}).problem.plant))


def test_the_designed_gains_are_small_and_track(specs: Path) -> None:
    spec = in_scenario(load_spec(specs / "two_mass_backlash.yaml"), duration=150.0)
    assert spec.objectives.controller == spec.objectives.observer == DEFAULT
    controller = design(spec)
    assert max(controller.sizes.norms(controller.design.K, controller.design.L)) < 10
    response = simulate(spec, controller).response
    error = np.abs(response.tracking_error)
    assert error[5900:6001].max() < 1e-4
    assert error[14900:].max() < 1e-7


@pytest.mark.parametrize("solver", ["clarabel", "cvxopt"])
def test_other_solvers_agree_with_the_structured_one(paper_spec: Spec, solver: Solver) -> None:
    other = design(replace(paper_spec, objectives=replace(paper_spec.objectives, solver=solver)))
    ours = design(paper_spec)
    assert other.design.controller.rate == pytest.approx(ours.design.controller.rate, rel=2e-3)
    assert generator_of(other).rate == pytest.approx(generator_of(ours).rate, rel=2e-3)
