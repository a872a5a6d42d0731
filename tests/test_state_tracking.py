"""Theorem 2 with every way to give the trajectory, any number of inputs and outputs."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import LinearConstraint, minimize

from pwatrack import OutsideTheory, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.control.realisable import input_trajectory, set_point, state_trajectory
from pwatrack.errors import CheckFailed, ExitCode, InvalidSpec
from pwatrack.model.cells import Partition
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.simulation.bounded import bounded_response
from pwatrack.simulation.desired import realised
from pwatrack.spec.expression import formula
from tests.test_cli import call

PLANT = """
name: two carts
system:
  states: [z1, v1, z2, v2]
  inputs: [u1, u2]
  outputs: [y1, y2]
  A: [[0, 1, 0, 0], [-1, -0.5, 0, 0], [0, 0, 0, 1], [0, 0, -1, -0.5]]
  B: [[0, 0], [1, 0], [0, 0], [0, 2]]
  C: [[1, 0, 0, 0], [0, 0, 1, 0]]
  nonlinearities:
    - {name: buffer, kind: spring, of: z1 - z2, into: {v1: -1, v2: 1}, start: 0.1, slope: 3}
design: {tracking: state}
reference: %s
simulation: {duration: 60, sample_time: 0.05, initial: {plant: [0.3, 0, -0.2, 0]}}
"""


def write(folder: Path, reference: str) -> Path:
    path = folder / "plant.yaml"
    path.write_text(PLANT % reference)
    return path


def test_a_closed_form_is_tracked_and_its_feedforward_solves_equation_3(tmp_path: Path) -> None:
    path = write(tmp_path, '{state: ["0.3*sin(t)", "0.3*cos(t)", "0.2*cos(2*t)", "-0.4*sin(2*t)"]}')
    result = simulate(load_spec(path))
    t, plant, response = result.response.t, result.spec.problem.plant, result.response
    np.testing.assert_allclose(response.x_d[:, 0], 0.3 * np.sin(t), atol=1e-11)
    rate = np.column_stack([0.3 * np.cos(t), -0.3 * np.sin(t), -0.4 * np.sin(2 * t), -0.8 * np.cos(2 * t)])
    for k in range(0, len(t), 50):
        np.testing.assert_allclose(plant.field(response.x_d[k], response.u_ff[k]), rate[k], atol=1e-10)
    assert len(response.trace.events) > 20
    assert result.final_error < 1e-9


def test_a_trajectory_that_no_input_can_make_is_refused_with_time_state_and_size(tmp_path: Path) -> None:
    path = write(tmp_path, '{state: ["0.3*sin(t)", "0.3*cos(t) + 0.05", "0", "0"]}')
    with pytest.raises(OutsideTheory, match=r"not realisable: at t = .* s .* state 'z1' in \(3\); 0.05 is left over"):
        simulate(load_spec(path))


def test_the_response_to_a_given_input_is_tracked_from_a_given_start(tmp_path: Path) -> None:
    path = write(tmp_path, '{input: ["0.4*sin(t)", "0.3"], start: [0.1, 0, 0, 0.2]}')
    result = simulate(load_spec(path))
    assert result.response.x_d[0].tolist() == [0.1, 0.0, 0.0, 0.2]
    np.testing.assert_allclose(result.response.u_ff[:, 0], 0.4 * np.sin(result.response.t), atol=1e-11)
    assert result.final_error < 1e-9


def test_the_periodic_response_to_a_given_input_starts_where_it_ends(tmp_path: Path) -> None:
    path = write(tmp_path, '{input: ["0.4*sin(t)", "0.3*cos(2*t)"], start: periodic}')
    result = simulate(load_spec(path))
    x_d, per_period = result.response.x_d, 2 * np.pi / 0.05
    k = round(5 * per_period)
    shift = (5 * per_period - k) * 0.05
    assert abs(shift) < 0.03
    steady = result.steady_state
    assert steady is not None
    assert np.abs(steady.z[-1] - steady.z[0]).max() < 1e-11
    np.testing.assert_allclose(x_d[0], steady.z[0, :4], atol=0)
    assert result.final_error < 1e-9


def test_the_steady_state_under_a_constant_input_is_an_equilibrium(tmp_path: Path) -> None:
    result = simulate(load_spec(write(tmp_path, '{input: ["0.5", "-0.3"], start: periodic}')))
    response = result.response
    np.testing.assert_allclose(result.spec.problem.plant.field(response.x_d[0], response.u_ff[0]), 0.0, atol=1e-10)
    np.testing.assert_allclose(response.x_d[-1], response.x_d[0], atol=1e-9)


@pytest.mark.parametrize("first", ["sin(t) + sin(sqrt(2)*t)", "exp(-t)"])
def test_a_periodic_start_without_a_period_is_refused(tmp_path: Path, first: str) -> None:
    with pytest.raises(InvalidSpec, match="start: periodic, but the inputs together have no period"):
        simulate(load_spec(write(tmp_path, f'{{input: ["{first}", "0"], start: periodic}}')))


def test_a_period_too_long_to_follow_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, '{input: ["sin(t) + sin(t/983)", "sin(t/991) + sin(t/997)"], start: periodic}')
    with pytest.raises(
        InvalidSpec, match=r"period of 6.1e\+09 s, 6.1e\+09 rad of the fastest; up to 1e\+06 are followed"
    ):
        simulate(load_spec(path))


@pytest.mark.parametrize("wanted", [(0.5, 0.0), (-0.3, 0.4)])
def test_a_set_point_is_an_equilibrium_in_its_own_cell(tmp_path: Path, wanted: tuple[float, float]) -> None:
    result = simulate(load_spec(write(tmp_path, f"{{setpoint: {{y1: {wanted[0]}, y2: {wanted[1]}}}}}")))
    response, plant = result.response, result.spec.problem.plant
    np.testing.assert_allclose(plant.field(response.x_d[0], response.u_ff[0]), 0.0, atol=1e-12)
    np.testing.assert_allclose(response.y[-1], wanted, atol=1e-9)
    touching = plant.cell_names[plant.partition.locate(response.x_d[0])] == "buffer on"
    assert touching == (wanted[0] - wanted[1] > 0.1)


def test_a_set_point_that_the_plant_cannot_rest_at_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "{setpoint: {y1: 0.1, y2: 0}}")
    path.write_text(path.read_text().replace("C: [[1, 0, 0, 0], ", "C: [[0, 1, 0, 0], "))
    with pytest.raises(OutsideTheory, match="no equilibrium has the wanted outputs: none at all in cell 'buffer off'"):
        simulate(load_spec(path))


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("{output: 0.1}", "state tracking needs a reference that is state or input or setpoint, found output"),
        ('{state: ["0", "0", "0"]}', "reference.state: 3 entries, expected 4"),
        ('{input: ["0", "0"]}', "reference.start is missing"),
        ("{setpoint: {y1: 1}}", "setpoint must give what is tracked, y1, y2, and gives y1"),
        ('{state: ["t", "1", "0", "0"]}', "x_d is not bounded"),
    ],
)
def test_a_reference_that_does_not_fit_is_refused(tmp_path: Path, reference: str, message: str) -> None:
    with pytest.raises((InvalidSpec, OutsideTheory), match=message):
        simulate(load_spec(write(tmp_path, reference)))


SMALL = """
name: small
system:
  states: [p, v]
  inputs: [u]
  outputs: [y]
  A: %s
  B: [[0], [1]]
  C: [[1, 0]]
design: {tracking: state}
reference: %s
simulation: {duration: 5, sample_time: 0.1}
"""


def test_a_periodic_start_at_resonance_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(SMALL % ("[[0, 1], [-1, 0]]", '{input: ["sin(t)"], start: periodic}'))
    with pytest.raises(OutsideTheory, match="no periodic solution"):
        simulate(load_spec(path))


@pytest.mark.parametrize(("reference", "growth"), [("sin(t)", 1.0), ("0.2 + cos(2*t)", 0.6)])
def test_a_periodic_solution_that_rounding_leaves_within_the_run_ends_with_6(
    tmp_path: Path, reference: str, growth: float
) -> None:
    """What differs from it grows as e^(growth t): about 32 / growth s after the start it is seen, and not before."""
    text = SMALL % (f"[[0, 1], [{growth} * (1 + {growth}), -1]]", f'{{input: ["{reference}"], start: periodic}}')
    path = tmp_path / "plant.yaml"
    for duration, code in ((20, ExitCode.DONE), (80, ExitCode.CHECK_FAILED)):
        path.write_text(text.replace("duration: 5", f"duration: {duration}"))
        result = simulate(load_spec(path))
        assert result.outcome.code == code
        assert result.steady_state is not None
        largest = np.abs(result.steady_state.z[:, :2]).max()
        assert (np.abs(result.response.x_d).max() > 2 * largest) == (code != ExitCode.DONE)
        assert not result.controller.trajectory.bounded
    assert "x_d leaves its periodic solution by rounding: what differs from it is multiplied by" in result.outcome.text
    said = " ".join(call("simulate", path, "--out", tmp_path / "out").stdout.split())
    assert "NOT proved that x_d is bounded and what was asked for: it is not" in said


def test_a_periodic_solution_is_proved_bounded_where_the_plant_converges(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    for stiffness, bounded in ((-1, True), (2, False)):
        path.write_text(SMALL % (f"[[0, 1], [{stiffness}, -1]]", '{input: ["sin(t)"], start: periodic}'))
        assert design(load_spec(path)).trajectory.bounded == bounded


def test_a_given_start_needs_no_periodic_solution(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(SMALL % ("[[0, 1], [0, -1]]", '{input: ["sin(t)"], start: [0, 0]}'))
    assert simulate(load_spec(path)).steady_state is None


def plant_of(A: list[list[float]], b: list[float], B: list[list[float]], C: list[list[float]]) -> PWASystem:
    n = len(A)
    everywhere = Partition.create(H=np.zeros((0, n)), h=[], signs=np.zeros((1, 0)), names=["everywhere"])
    return PWASystem.create(partition=everywhere, A=[A], b=[b], B=B, C=C)


def test_realisability_is_judged_per_state_equation() -> None:
    plant = plant_of([[0, 1, 0], [0, -1, 0], [0, 0, -1e7]], [0, 0, 0], [[0, 0], [1, 0], [0, 1e7]], [[1, 0, 0]])
    x_d = exosystem([Signal.of(formula(text, {})) for text in ("sin(t)", "1.001*cos(t)", "sin(t)")])
    with pytest.raises(OutsideTheory, match="state 'x1'"):
        realised(plant, state_trajectory(plant, x_d), horizon=10.0)


def signals(*texts: str) -> list[Signal]:
    return [Signal.of(formula(text, {"pi": np.pi})) for text in texts]


LEAKING = PWASystem.create(  # dp/dt = v − max(0, p − 1): only below 1 does p follow from v alone
    partition=Partition.create(H=[[1, 0]], h=[-1], signs=[[-1], [1]], names=["below", "above"]),
    A=[[[0, 1], [-1, -1]], [[-1, 1], [-1, -1]]],
    b=[[0, 0], [1, 0]],
    B=[[0], [1]],
    C=[[1, 0]],
    states=["p", "v"],
)


@pytest.mark.parametrize(("k", "horizon"), [(1000, 20.0), (1, 20_000.0), (7, 3.0)])
def test_equation_3_is_not_decided_on_a_grid_of_times(k: int, horizon: float) -> None:
    # dp/dt = v wherever t k is a whole number, and nowhere else
    x_d = exosystem(signals(f"0.5*sin({2 * k}*pi*t)", f"{k}*pi"))
    with pytest.raises(
        OutsideTheory, match=r"in cell 'below' no input satisfies the equation of state 'p' in \(3\)"
    ) as e:
        realised(LEAKING, state_trajectory(LEAKING, x_d), horizon=horizon, subject=("reference", "state"))
    assert e.value.problems[0].subject == ("reference", "state", 0)


@given(
    st.floats(1e-3, 1e4),
    st.floats(1e-9, 1e9),
    st.floats(0.1, 1e4),
    st.floats(1e-9, 1e-2),
    st.sampled_from("pv"),
    st.booleans(),
)
@settings(max_examples=40)
def test_equation_3_holds_exactly_where_each_state_follows_from_the_others(
    omega: float, size: float, horizon: float, wrong: float, where: str, spoiled: bool
) -> None:
    plant = plant_of([[0, 1 / size], [-3 * size, -1]], [0, 0], [[0], [size]], [[1, 0]])  # v in other units
    a, b = 1 + wrong * (spoiled and where == "p"), size * omega * (1 + wrong * (spoiled and where == "v"))
    trajectory = state_trajectory(plant, exosystem(signals(f"{a!r}*sin({omega!r}*t)", f"{b!r}*cos({omega!r}*t)")))
    if spoiled:
        with pytest.raises(OutsideTheory, match="state 'x1'"):
            realised(plant, trajectory, horizon=horizon)
    else:
        assert realised(plant, trajectory, horizon=horizon).until is None


def test_frequencies_that_differ_by_rounding_are_one() -> None:
    w = 0.1 + 0.2
    plant = plant_of([[0, 0, 0], [0, 0, w], [0, -w, 0]], [0, 0, 0], [[1], [1], [0]], [[1, 0, 0]])
    for size in ("1", "1e6"):  # u_ff is 0 but for rounding, which is large beside the 0 of the first equation
        trajectory = state_trajectory(plant, exosystem(signals("0", f"{size}*sin(0.3*t)", f"{size}*cos({w!r}*t)")))
        assert realised(plant, trajectory, horizon=100.0).until is None


@pytest.mark.parametrize(("amplitude", "refused"), [(0.9, False), (1.0, False), (1 + 1e-9, True), (1.5, True)])
def test_equation_3_is_asked_for_in_the_cells_that_are_visited(amplitude: float, refused: bool) -> None:
    p = formula(f"{amplitude!r}*sin(t)", {})
    trajectory = state_trajectory(LEAKING, exosystem([Signal.of(p), Signal.of(p.derivative())]))
    if not refused:
        assert realised(LEAKING, trajectory, horizon=30.0).until is None
        return
    with pytest.raises(OutsideTheory, match="in cell 'above'") as refusal:
        realised(LEAKING, trajectory, horizon=30.0)
    time = float(refusal.value.problems[0].message.split("t = ")[1].split(" s ")[0])
    first = np.arcsin(1 / amplitude)
    assert first - 1e-4 <= time <= np.pi - first + 1e-4


def test_equation_3_without_a_period_is_decided_up_to_the_end_of_the_run() -> None:
    p = formula("0.6*sin(t) + 0.39999*sin(sqrt2*t)", {"sqrt2": 2**0.5})  # comes close to 1 at last, never above
    trajectory = state_trajectory(LEAKING, exosystem([Signal.of(p), Signal.of(p.derivative())]))
    assert realised(LEAKING, trajectory, horizon=100.0).until == 100.0
    quiet = state_trajectory(LEAKING, exosystem(signals("0.5*exp(-t)", "-0.5*exp(-t)")))
    assert realised(LEAKING, quiet, horizon=10.0).until == 10.0


@pytest.mark.parametrize("wrong", [0.0, 1e-6])
def test_equation_3_is_asked_for_on_every_piece(wrong: float) -> None:
    t, one = ExponentialPolynomial.time(), ExponentialPolynomial.constant(1.0)
    p = Signal((0.0, 2.0), (t * 0.1, one * 0.2 + 0.1 * t - 0.01 * t * t), end=4.0)
    v = Signal((0.0, 2.0), (one * 0.1, one * 0.1 - (0.02 + wrong) * t), end=4.0)
    trajectory = state_trajectory(LEAKING, exosystem([p, v]))
    if not wrong:
        assert realised(LEAKING, trajectory, horizon=4.0).until == 4.0
        return
    with pytest.raises(OutsideTheory, match=r"at t = [23]\.\d* s in cell 'below' .* state 'p'"):
        realised(LEAKING, trajectory, horizon=4.0)


@pytest.mark.parametrize("f", [1e-12, 1e-8, 1e-6, 1.0, 1e6, 1e8, 1e12])
def test_a_set_point_does_not_depend_on_units(f: float) -> None:
    d = np.array([f, 1.0, 1 / f])
    A = np.array([[0.0, 1, 0], [0, 0, 1], [-1, -2, -3]])
    plant = plant_of((A / d[:, None] * d).tolist(), [0, 0, 0], [[0], [0], [1 / d[2]]], [[d[0], 0, 0]])
    trajectory = set_point(plant, np.array([0.5]))
    np.testing.assert_allclose(trajectory.x_d[0, :, 0] * d, [0.5, 0, 0], atol=1e-9)


def test_with_more_inputs_than_outputs_a_set_point_in_the_right_cell_is_found() -> None:
    h, g = np.array([1.0, -1.0]), np.array([5.0, -5.0])
    plant = PWASystem.create(
        partition=Partition.create(H=[h], h=[0.0], signs=[[-1], [1]], names=["neg", "pos"]),
        A=[-np.eye(2), -np.eye(2) + np.outer(g, h)],
        b=[[4, -4]] * 2,
        B=np.eye(2),
        C=[[1, 1]],
    )
    trajectory = set_point(plant, np.array([1.0]))
    x, u = trajectory.x_d[0, :, 0], trajectory.u_ff[0, :, 0]
    np.testing.assert_allclose(plant.field(x, u), 0.0, atol=1e-9)
    assert x.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("B", "C", "y"),
    [
        ([[0.0], [0.0]], [[1.0, 0.0]], [0.0]),
        ([[0.0], [0.0]], [[1.0, 0.0]], [1.0]),
        ([[0.0], [1.0]], [[0.0, 0.0]], [0.0]),
        ([[0.0], [1.0]], [[0.0, 0.0]], [2.0]),
        ([[0.0], [1.0]], [[0.0, 0.0], [1.0, 0.0]], [1.0, 1.0]),
        ([[0.0], [1.0]], [[1.0, 0.0], [-3.0, 0.0]], [0.1, -0.3]),
        ([[0.0], [1.0]], [[1.0, 0.0], [-3.0, 0.0]], [0.1, -0.30001]),
        ([[0.0], [2.18]], [[0.0, 0.0], [-0.0023, 0.0]], [-0.7, 0.72]),
        ([[0.0, 0.0], [1.0, 1e-9]], [[1.0, 0.0]], [0.5]),
    ],
)
@pytest.mark.parametrize("k", [0.0, 2.0])
def test_a_set_point_is_found_exactly_where_a_least_squares_solution_solves_the_equations(
    B: list[list[float]], C: list[list[float]], y: list[float], k: float
) -> None:
    plant = plant_of([[0, 1], [-k, -1]], [0, 0], B, C)
    equations = np.block([[plant.A[0], plant.B], [plant.C, np.zeros((len(C), len(B[0])))]])
    right = np.concatenate([np.zeros(2), y])
    left = equations @ np.linalg.lstsq(equations, right, rcond=None)[0] - right
    if np.abs(left).max() < 1e-9:
        found = set_point(plant, np.array(y))
        np.testing.assert_allclose(plant.field(found.x_d[0, :, 0], found.u_ff[0, :, 0]), 0.0, atol=1e-9)
        np.testing.assert_allclose(plant.C @ found.x_d[0, :, 0], y, atol=1e-9)
    else:
        with pytest.raises(
            OutsideTheory, match="no equilibrium has the wanted outputs: none at all in cell 'everywhere'"
        ):
            set_point(plant, np.array(y))


@given(st.integers(0, 10_000), st.booleans())
@settings(max_examples=40)
def test_of_many_equilibria_a_set_point_takes_the_least_within_limits(seed: int, limited: bool) -> None:
    """Of three states and two inputs with one output one direction or more is open; the oracle looks in each cell."""
    random = np.random.default_rng(seed)
    first, kink, h = random.normal(size=(3, 3)), random.normal(size=3), random.normal(size=3)
    edge, y, B = 0.3 * random.normal(), random.normal(size=1), random.normal(size=(3, 2))
    plant = PWASystem.create(
        partition=Partition.create(H=[h], h=[-edge], signs=[[-1], [1]], names=["below", "above"]),
        A=[first, first + np.outer(kink, h)],
        b=[np.zeros(3), -edge * kink],
        B=B,
        C=[[1.0, 0, 0]],
        tolerance=1e-9,
    )
    sizes, ends = random.uniform(0.3, 3, size=5), np.array([[-1.5, 1.0], [-1.0, 2.0]])
    inner = ends + 0.1 * np.ptp(ends, axis=1)[:, None] * [1, -1]
    best = np.inf

    def cost(z: Array) -> float:
        return float(((z / sizes) ** 2).sum())

    for i, side in enumerate((-1, 1)):
        E, r = np.block([[plant.A[i], B], [plant.C, np.zeros((1, 2))]]), np.append(-plant.b[i], y)
        sides: list[LinearConstraint] = [LinearConstraint(E, r, r)]
        sides.append(LinearConstraint(side * np.append(h, [0, 0]), side * edge, np.inf))
        if limited:
            sides.append(LinearConstraint(np.eye(5)[3:], *inner.T))
        found = minimize(cost, np.zeros(5), constraints=sides, method="SLSQP", options={"ftol": 1e-13, "maxiter": 500})
        best = min(best, np.sqrt(found.fun)) if found.success else best
    assume(best < np.inf)
    point = set_point(plant, y, sizes=sizes, limits=ends if limited else None)
    z = np.concatenate([point.x_d[0, :, 0], point.u_ff[0, :, 0]])
    np.testing.assert_allclose(plant.field(z[:3], z[3:]), 0.0, atol=1e-9)
    assert z[0] == pytest.approx(y[0], abs=1e-9)
    assert np.linalg.norm(z / sizes) == pytest.approx(best, rel=1e-4)
    if limited:
        assert (z[3:] >= inner[:, 0] - 1e-9).all()
        assert (z[3:] <= inner[:, 1] + 1e-9).all()


def test_check_refuses_a_set_point_that_no_input_within_limits_holds(tmp_path: Path) -> None:
    path = write(tmp_path, "{setpoint: {y1: 0.5, y2: 0}}")
    limits = "actuator: {limits: {u1: [-0.2, 0.2]}}, "
    path.write_text(path.read_text().replace("simulation: {", "simulation: {" + limits))
    for command in ("check", "design"):
        done = call(command, path, *(("--out", tmp_path / "out") if command == "design" else ()))
        assert done.exit_code == ExitCode.OUTSIDE_THEORY
        assert "the reference takes u1 = 1.7 at t = 0 s, above its upper limit, 0.2" in " ".join(done.stderr.split())
        assert "choose another set-point, or take a stronger drive" in " ".join(done.stderr.split())


@given(st.lists(st.integers(-12, 12), min_size=4, max_size=4), st.floats(-3, 3), st.integers(0, 1))
@settings(max_examples=40)
def test_a_set_point_is_the_same_in_all_units(exponents: list[int], y: float, redundant: int) -> None:
    # dp/dt = v, dv/dt = −p − v − 4 max(0, p − 1) + u (+ u2): at rest u (+ u2) = p + 4 max(0, p − 1)
    d, e = 10.0 ** np.array(exponents[:2]), 10.0 ** np.array(exponents[2 : 3 + redundant])
    A = np.array([[[0, 1], [-1, -1]], [[0, 1], [-5, -1]]])
    plant = PWASystem.create(
        partition=Partition.create(H=[[1.0 * d[0], 0]], h=[-1], signs=[[-1], [1]], names=["free", "touching"]),
        A=A / d[:, None] * d,
        b=[[0, 0], [0, 4 / d[1]]],
        B=np.array([[0, 0], [1, 1]])[:, : 1 + redundant] / d[:, None] * e,
        C=[[d[0], 0]],
    )
    found = set_point(plant, np.array([y]))
    x, u = found.x_d[0, :, 0] * d, found.u_ff[0, :, 0] * e
    np.testing.assert_allclose(x, [y, 0], atol=1e-12)
    assert u.sum() == pytest.approx(y + 4 * max(0.0, y - 1), abs=1e-9)


def test_a_set_point_on_the_border_of_every_cell_that_has_one_is_found() -> None:
    # at rest q = |p| + 1, and s = p + q is asked for: 1 + p + |p| is 1 for every p ≤ 0, more for p > 0, never less
    plant = PWASystem.create(
        partition=Partition.create(H=[[1, 0]], h=[0], signs=[[-1], [1]], names=["left", "right"]),
        A=[[[0, 0], [1, 1]], [[0, 0], [-1, 1]]],
        b=[[0, -1], [0, -1]],
        B=[[0], [0]],
        C=[[1, 1]],
        states=["p", "q"],
    )
    for s, p in ((1.0, None), (1.0 + 2e-9, 1e-9), (3.0, 1.0)):
        x = set_point(plant, np.array([s])).x_d[0, :, 0]
        np.testing.assert_allclose([x[1] - abs(x[0]), x.sum()], [1.0, s], atol=1e-12)
        assert x[0] <= 1e-12 if p is None else x[0] == pytest.approx(p, abs=1e-12)
    with pytest.raises(OutsideTheory, match="none at all in cell 'left'; those of cell 'right' lie outside it"):
        set_point(plant, np.array([0.9]))


def test_a_set_point_in_the_corner_of_a_cell_is_found() -> None:
    # dp/dt = q + min(0, q − p + c) + min(0, q + 0.7 (p − c)), c = 0.3: the first cell rests at its corner only
    c, d = 0.3, 0.21
    plant = PWASystem.create(
        partition=Partition.create(
            H=[[-1, 1], [0.7, 1]], h=[c, -d], signs=[[1, 1], [-1, 1], [1, -1], [-1, -1]], names=list("abcd")
        ),
        A=[[[0, 1], [0, 0]], [[-1, 2], [0, 0]], [[0.7, 2], [0, 0]], [[-0.3, 3], [0, 0]]],
        b=[[0, 0], [c, 0], [-d, 0], [0.09, 0]],
        B=[[0], [0]],
        C=[[0, 0]],
    )
    np.testing.assert_allclose(set_point(plant, np.array([0.0])).x_d[0, :, 0], [c, 0.0], atol=1e-12)


def response(plant: PWASystem, text: str, start: list[float], horizon: float, end: float | None = None) -> bool:
    """Return whether x_d is proved bounded."""
    u_ff = exosystem([Signal((0.0,), (formula(text, {"sqrt2": 2**0.5}),), end)])
    return bounded_response(plant, input_trajectory(plant, u_ff, np.array(start)), horizon=horizon).bounded


PENDULUM = [[0.0, 1.0], [4.0, -0.5]]  # falls with e^(1.77 t)
CART = [[0.0, 1.0], [0.0, -1.0]]


@pytest.mark.parametrize(
    ("A", "text", "start", "horizon", "end"),
    [
        (PENDULUM, "0.2*sin(t)", [0.0, 0.0], 20.0, None),
        (PENDULUM, "0.2*sin(t)", [0.0, 0.0], 20.0, 20.0),
        (PENDULUM, "0", [1e-3, 0.0], 8.0, None),
        (PENDULUM, "sin(t)", [0.0, 0.0], 2000.0, None),
        (CART, "1", [0.0, 0.0], 30.0, None),
        ([[0.0, 1.0], [-1.0, 0.0]], "sin(t)", [0.0, 0.0], 40.0, None),
    ],
)
def test_a_response_that_grows_without_bound_is_refused(
    A: list[list[float]], text: str, start: list[float], horizon: float, end: float | None
) -> None:
    plant = plant_of(A, [0, 0], [[0], [1]], [[1, 0]])
    with pytest.raises(
        CheckFailed, match=r"x_d grows without bound, as far as can be seen: \|x[12]\| reaches .* before"
    ):
        response(plant, text, start, horizon, end)


@pytest.mark.parametrize(
    ("A", "text", "start", "horizon", "end"),
    [
        (CART, "sin(t)", [0.0, 0.0], 3.0, None),  # on its way to its first turn
        (CART, "exp(-t)", [0.0, 0.0], 5.0, None),  # to its place of rest
        (CART, "1", [0.0, 0.0], 3.0, 3.0),  # a move, and no more
        ([[0.0, 1.0], [-1.0, 0.0]], "sin(sqrt2*t)", [1.0, 0.0], 40.0, None),
    ],
)
def test_a_response_of_which_nothing_is_proved_or_seen_is_said_not_to_be_proved_bounded(
    A: list[list[float]], text: str, start: list[float], horizon: float, end: float | None
) -> None:
    assert not response(plant_of(A, [0, 0], [[0], [1]], [[1, 0]]), text, start, horizon, end)


@pytest.mark.parametrize("horizon", [0.1, 0.8, 30.0])
def test_the_response_of_a_convergent_plant_is_bounded_though_it_changes_cells_for_ever(horizon: float) -> None:
    plant = PWASystem.create(
        partition=Partition.create(H=[[1]], h=[0], signs=[[-1], [1]], names=["left", "right"]),
        A=[[[-1]], [[-2]]],
        b=[[0], [0]],
        B=[[1]],
        C=[[1]],
    )
    assert response(plant, "100*sin(t)", [9], horizon)


def test_a_response_that_is_still_on_its_way_out_of_a_stable_cell_is_not_proved_bounded() -> None:
    # p'' = −p − 0.2 p' + 30 max(0, p − 1) + u: a swing towards the slope, still in the well after 0.5 s
    plant = PWASystem.create(
        partition=Partition.create(H=[[1, 0]], h=[-1], signs=[[-1], [1]], names=["well", "slope"]),
        A=[[[0, 1], [-1, -0.2]], [[0, 1], [29, -0.2]]],
        b=[[0, 0], [0, -30]],
        B=[[0], [1]],
        C=[[1, 0]],
    )
    assert response(plant, "0.1*sin(3*t)", [0, 0.3], 0.5)
    with pytest.raises(CheckFailed, match="x_d grows without bound"):
        response(plant, "0.1*sin(3*t)", [0, 1.5], 0.5)


@pytest.mark.parametrize(
    ("amplitude", "start", "bounded"), [(0.5, 0.0, True), (0.5, -0.7, True), (0.999, 0.0, True), (1.01, -1.0, False)]
)
def test_a_response_that_ends_in_a_stable_cell_is_proved_bounded_if_it_stays_there(
    amplitude: float, start: float, bounded: bool
) -> None:
    # dx/dt = −x + 3 max(0, x − 1) + u: what passes 1.5 runs away; under u = a √2 sin t the response is a sin(t − π/4)
    plant = PWASystem.create(
        partition=Partition.create(H=[[1]], h=[-1], signs=[[-1], [1]], names=["well", "slope"]),
        A=[[[-1]], [[2]]],
        b=[[0], [-3]],
        B=[[1]],
        C=[[1]],
    )
    assert response(plant, f"{amplitude}*sqrt2*sin(t)", [start], 30.0) == bounded


def test_the_file_says_where_a_response_that_grows_starts(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(SMALL % (PENDULUM, "{input: [0.2*sin(t)], start: [0, 0]}"))
    with pytest.raises(CheckFailed, match=r"plant.yaml:11:\d+: x_d grows without bound"):
        design(load_spec(path))
