"""Exact propagation, events and steady states, against scipy and closed forms."""

import resource
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from pwatrack import Result, Spec, design, simulate
from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.control.generator import trajectory_generator
from pwatrack.control.synthesis import synthesize
from pwatrack.control.trajectory import output_trajectory
from pwatrack.errors import CheckFailed, InvalidSpec, PwatrackError
from pwatrack.model.normal_form import NormalForm, normal_form
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.model.sizes import Sizes
from pwatrack.report.figures import figure_content, measures
from pwatrack.report.files import write_result
from pwatrack.simulation.closed_loop import ClosedLoop, closed_loop
from pwatrack.simulation.desired import desired_flow
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import simulate_flow, trace_blocks
from pwatrack.simulation.steady_state import period_map_derivative, periodic_state
from pwatrack.simulation.trace import TraceOnDisk, Unresolved
from pwatrack.spec.expression import formula
from pwatrack.spec.spec import InitialStates
from tests.grazing import near_grazing
from tests.plants import random_plant, reset
from tests.precise import precise
from tests.scenarios import in_scenario

seeds = st.integers(0, 10_000)


def switched(F0: Array, guards: list[list[float]], signs: list[list[int]], F: list[Array]) -> Flow:
    part = SwitchedPart(
        name="part",
        cells=tuple(str(k) for k in range(len(signs))),
        guards=np.array(guards, dtype=float),
        signs=np.array(signs),
        F=np.array(F, dtype=float),
    )
    return Flow(F0=F0, parts=(part,))


def abs_oscillator(kick: float = 3.0) -> Flow:
    """ẍ = −x − kick · max(0, x), driven by nothing: half periods π and π/√(1 + kick)."""
    F0 = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 0]])
    stiff = np.zeros((3, 3))
    stiff[1, 0] = -kick
    return switched(F0, [[1.0, 0, 0]], [[-1], [1]], [np.zeros((3, 3)), stiff])


def test_a_linear_flow_is_the_matrix_exponential() -> None:
    random = np.random.default_rng(1)
    F = random.normal(size=(5, 5))
    z0 = random.normal(size=5)
    flow = switched(F, np.zeros((0, 5)).tolist() or [[0.0, 0, 0, 0, 1]], [[0]], [np.zeros((5, 5))])
    trace = simulate_flow(flow, z0, duration=3.0, sample_time=0.25)
    for t, z in zip(trace.t, trace.z, strict=True):
        np.testing.assert_allclose(z, expm(F * t) @ z0, rtol=1e-12, atol=1e-12)
    assert trace.events == ()


def test_crossings_of_an_oscillator_with_a_stiffer_side_are_where_they_must_be() -> None:
    trace = simulate_flow(abs_oscillator(), np.array([0.0, 1.0, 1.0]), duration=50.0, sample_time=0.1)
    halves = np.cumsum([np.pi / 2, np.pi] * 20)
    expected = halves[halves < 50.0]
    np.testing.assert_allclose([event.t for event in trace.events], expected, rtol=1e-13, atol=1e-13)


@given(st.floats(0.003, 0.7))
@settings(max_examples=20)
def test_the_sample_time_moves_no_event(sample_time: float) -> None:
    reference = simulate_flow(abs_oscillator(), np.array([0.3, 1.0, 1.0]), duration=10.0, sample_time=0.05)
    other = simulate_flow(abs_oscillator(), np.array([0.3, 1.0, 1.0]), duration=10.0, sample_time=sample_time)
    times = [event.t for event in reference.events if event.t < other.t[-1]]
    np.testing.assert_allclose([event.t for event in other.events], times, atol=1e-12)


def test_half_the_sample_time_changes_neither_events_nor_samples(paper: Result, paper_spec: Spec) -> None:
    finer = simulate(in_scenario(paper_spec, sample_time=0.005), paper.controller).response
    ours, theirs = paper.response.trace, finer.trace
    assert [e.after for e in ours.events] == [e.after for e in theirs.events]
    np.testing.assert_allclose([e.t for e in ours.events], [e.t for e in theirs.events], atol=1e-12)
    np.testing.assert_allclose(ours.z, theirs.z[::2], atol=1e-11)


@given(st.integers(1, 50), st.sampled_from([0.01, 0.07]))
@settings(max_examples=25)
def test_blocks_of_a_trace_are_the_trace(most: int, sample_time: float) -> None:
    kicks = [reset(t, slice(1, 2), np.array([v])) for t, v in ((0.7, -2.0), (1.333, 1.0), (1.4, 0.5))]
    arguments: dict[str, Any] = {"duration": 3.0, "sample_time": sample_time, "resets": kicks}
    whole = simulate_flow(abs_oscillator(), np.array([0.3, 1.0, 1.0]), **arguments)
    blocks = list(trace_blocks(abs_oscillator(), np.array([0.3, 1.0, 1.0]), **arguments, most=most))
    assert all(len(block.t) <= most for block in blocks)
    for name in ("t", "z", "modes"):
        assert np.array_equal(np.concatenate([getattr(block, name) for block in blocks]), getattr(whole, name))
    assert tuple(event for block in blocks for event in block.events) == whole.events
    assert tuple(stay for block in blocks for stay in block.unresolved) == whole.unresolved


def test_a_long_run_is_written_in_full_and_kept_in_part(
    paper: Result, paper_spec: Spec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pwatrack.workflow.pipeline.MOST_KEPT", 700)
    result = simulate(paper_spec, paper.controller)
    assert len(result.response.t) == 667  # every ninth of 6001
    np.testing.assert_array_equal(result.response.x, paper.response.x[::9])
    all_of_it, in_part = (figure_content(asdict(one.figures)) for one in (paper, result))
    for part, shares in all_of_it.pop("time_share").items():
        assert in_part["time_share"][part] == pytest.approx(shares, rel=1e-12)
    for name, figure in all_of_it.items():
        assert in_part[name] == pytest.approx(figure, rel=1e-12), name
    monkeypatch.delattr("pwatrack.workflow.pipeline.trace_blocks")  # writing does not simulate
    for one, other in ((paper, "whole"), (result, "part")):
        write_result(one, tmp_path / other, plots="none")
    assert (tmp_path / "whole/events.csv").read_bytes() == (tmp_path / "part/events.csv").read_bytes()
    whole, part = (np.loadtxt(tmp_path / name / "trace.csv", delimiter=",", skiprows=1) for name in ("whole", "part"))
    np.testing.assert_allclose(part, whole, rtol=1e-14, atol=1e-15)  # products of matrices of other shapes


def test_blocks_on_disk_come_back_to_the_bit_however_they_are_read() -> None:
    arguments: dict[str, Any] = {"duration": 3.0, "sample_time": 0.01, "most": 64}
    blocks, spool = list(trace_blocks(abs_oscillator(), np.array([0.3, 1.0, 1.0]), **arguments)), TraceOnDisk()
    for block in blocks:
        spool.add(block)
    for written, *read in zip(blocks, spool, spool, strict=True):  # two at a time
        for trace in read:
            assert all(np.array_equal(getattr(trace, name), getattr(written, name)) for name in ("t", "z", "modes"))
            assert (trace.events, trace.unresolved) == (written.events, written.unresolved)


def test_a_disk_that_is_full_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    trace = simulate_flow(abs_oscillator(), np.array([0.3, 1.0, 1.0]), duration=1.0, sample_time=0.001)
    spool, limits = TraceOnDisk(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(InvalidSpec, match=f"cannot keep the samples of the run in {tmp_path}: File too large"):
            spool.add(trace)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("depth", [10.0**k for k in range(-11, -1)])
def test_a_grazing_crossing_is_seen_however_shallow(depth: float) -> None:
    """x(t) = (t − t0)² − depth under ẍ = 2: below 0 for 2 √depth."""
    F0 = np.array([[0.0, 1, 0], [0, 0, 2], [0, 0, 0]])
    flow = switched(F0, [[1.0, 0, 0]], [[-1], [1]], [np.zeros((3, 3))] * 2)
    t0 = 0.7323
    trace = simulate_flow(flow, np.array([t0**2 - depth, -2 * t0, 1.0]), duration=2.0, sample_time=0.1)
    width = np.sqrt(depth)
    assert len(trace.events) == 2
    np.testing.assert_allclose([e.t for e in trace.events], [t0 - width, t0 + width], atol=1e-15 / width + 1e-13)
    above = simulate_flow(flow, np.array([t0**2 + depth, -2 * t0, 1.0]), duration=2.0, sample_time=0.1)
    assert above.events == ()


def test_two_crossings_within_one_sample_are_both_seen() -> None:
    trace = simulate_flow(abs_oscillator(), np.array([0.0, 1.0, 1.0]), duration=20.0, sample_time=10.0)
    assert len(trace.events) == 8
    assert len(trace.t) == 3


def test_a_start_on_the_facet_enters_the_side_the_motion_points_to() -> None:
    for speed, cell in ((1.0, 1), (-1.0, 0)):
        trace = simulate_flow(abs_oscillator(), np.array([0.0, speed, 1.0]), duration=0.1, sample_time=0.1)
        assert trace.first_mode == (cell,)
        assert trace.events == ()


def test_motion_along_a_facet_makes_no_events() -> None:
    """x stays 0 while v turns: both cells agree there."""
    F0 = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 0]])
    bend = np.zeros((4, 4))
    bend[0, 0] = -5.0
    flow = switched(F0, [[1.0, 0, 0, 0]], [[-1], [1]], [np.zeros((4, 4)), bend])
    trace = simulate_flow(flow, np.array([0.0, 1.0, 0.0, 1.0]), duration=20.0, sample_time=0.1)
    assert trace.events == ()
    np.testing.assert_allclose(trace.z[:, 0], 0.0, atol=0)


def test_a_path_through_a_corner_goes_straight_to_the_opposite_cell() -> None:
    F0 = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 0]])
    signs = [[-1, -1], [-1, 1], [1, -1], [1, 1]]
    flow = switched(F0, [[1.0, 0, 0], [0, 1, 0]], signs, [np.zeros((3, 3))] * 4)
    trace = simulate_flow(flow, np.array([-0.5, -0.5, 1.0]), duration=1.0, sample_time=0.3)
    assert [(e.before, e.after) for e in trace.events] == [((0,), (3,))]
    assert trace.events[0].t == pytest.approx(0.5, abs=1e-15)


def test_an_ill_posed_field_that_chatters_is_reported() -> None:
    """x' = −sign(x) is discontinuous: at 0 the trajectory cannot leave."""
    push = [np.array([[0.0, 1.0], [0, 0]]), np.array([[0.0, -1.0], [0, 0]])]
    flow = switched(np.zeros((2, 2)), [[1.0, 0.0]], [[-1], [1]], push)
    with pytest.raises(CheckFailed, match=r"the part crosses guard 1 at t = 0\.5 s, .* without progress"):
        simulate_flow(flow, np.array([0.5, 1.0]), duration=1.0, sample_time=0.1)


def loop_of(plant: PWASystem, y_d: str) -> ClosedLoop:
    generator = trajectory_generator(normal_form(plant))
    trajectory = output_trajectory(generator, exosystem([Signal.of(formula(y_d, {}))]))
    return closed_loop(
        ProvedController(
            plant=plant,
            running=plant,
            design=synthesize(plant),
            trajectory=trajectory,
            proofs=(),
            sizes=Sizes.of(plant),
        )
    )


def random_loop(seed: int) -> ClosedLoop:
    return loop_of(random_plant(seed), "0.1 + sin(2*t) + 0.3*sin(4*t + 1)")


def y_d_of_random_loop(t: float, order: int) -> float:
    """The reference of `random_loop` and its derivatives, in closed form."""
    wave = 2.0**order * np.sin(2 * t + order * np.pi / 2) + 0.3 * 4.0**order * np.sin(4 * t + 1 + order * np.pi / 2)
    return float(wave) + (0.1 if order == 0 else 0.0)


def right_hand_side(loop: ClosedLoop, form: NormalForm, t: float, state: Array) -> Array:
    """(1), (15), (16), (18), (19) written out with max and located cells, as an oracle for the flow."""
    controller, plant = loop.controller, loop.controller.plant
    n = plant.A.shape[1]
    x, x_hat, eta = state[:n], state[n : 2 * n], state[2 * n :]
    xi = np.array([y_d_of_random_loop(t, k) for k in range(form.r + 1)])
    x_d = form.T_inverse[0] @ (np.concatenate([xi[:-1], eta]) - form.offset[0])
    cell = plant.partition.locate(x_d)
    u_ff = (xi[-1] - form.alpha[cell] @ xi[:-1] - form.beta[cell] @ eta - form.gamma[cell]) / form.D[cell, 0, 0]
    u = controller.design.K @ (x_hat - x_d) + u_ff
    innovation = controller.design.L @ (plant.C @ (x_hat - x))
    eta_rate = form.chi[cell] @ xi[:-1] + form.Psi[cell] @ eta + form.sigma[cell]
    return np.concatenate([plant.field(x, u), plant.field(x_hat, u) + innovation, eta_rate])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
def test_random_closed_loops_agree_with_a_tight_integrator(seed: int) -> None:
    loop = random_loop(seed)
    form, random = normal_form(loop.controller.plant), np.random.default_rng(seed)
    x, x_hat, eta = random.normal(size=4), np.zeros(4), random.normal(size=2)
    trace = simulate_flow(loop.flow, loop.start(plant=x, observer=x_hat, generator=eta), duration=1.5, sample_time=0.05)
    truth = solve_ivp(
        lambda t, s: right_hand_side(loop, form, t, s),
        (0, 1.5),
        np.concatenate([x, x_hat, eta]),
        method="DOP853",
        rtol=1e-11,
        atol=1e-13,
        t_eval=trace.t,
    ).y.T
    assert len(trace.events) > 0
    np.testing.assert_allclose(trace.z[:, :10], truth, atol=1e-8 * max(1.0, np.abs(truth).max()))


@pytest.mark.slow
@given(seeds)
@settings(max_examples=6)
def test_any_two_solutions_under_one_reference_converge(seed: int) -> None:
    loop = random_loop(seed)
    random = np.random.default_rng(seed)
    design_ = loop.controller.design
    generator = loop.controller.generator
    assert generator is not None
    slowest = min(design_.controller.rate, design_.observer.rate, generator.rate)
    ends = []
    for _ in range(2):
        start = loop.start(plant=random.normal(size=4), observer=random.normal(size=4), generator=random.normal(size=2))
        ends.append(simulate_flow(loop.flow, start, duration=30 / slowest, sample_time=1 / slowest).z[-1])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-8)


def test_the_desired_trajectory_is_a_solution_of_the_closed_loop(paper: Result) -> None:
    """(x, x̂, η̂) = (x_d, x_d, η_d) of Theorem 3: started on it, the error stays at rounding."""
    loop = paper.loop
    start = loop.start(plant=np.zeros(4), observer=np.zeros(4), generator=np.array([0.2, 0.0]))
    x_d = loop.x_d[0] @ start
    start[loop.at.x], start[loop.at.x_hat] = x_d, x_d
    response = loop.response(simulate_flow(loop.flow, start, duration=20.0, sample_time=0.01))
    assert np.abs(response.x - response.x_d).max() < 1e-12
    assert np.abs(response.tracking_error).max() < 1e-13


def test_a_feedforward_that_is_wrong_is_seen(paper: Result) -> None:
    """What x_d, u_ff and the plant are decides how the error moves, not what (3) says of them."""
    controller = paper.controller
    wrong = replace(controller.trajectory, u_ff=(1 + 1e-6) * controller.trajectory.u_ff)
    for trajectory, least, most in ((controller.trajectory, 0.0, 1e-13), (wrong, 1e-9, 1e-4)):
        loop = closed_loop(replace(controller, trajectory=trajectory))
        start = loop.start(plant=np.zeros(4), observer=np.zeros(4), generator=np.array([0.2, 0.0]))
        start[loop.at.x] = start[loop.at.x_hat] = loop.x_d[0] @ start
        trace = simulate_flow(loop.flow, start, duration=20.0, sample_time=0.05)
        assert least <= np.abs(loop.response(trace).tracking_error).max() < most


def test_the_steady_state_does_not_depend_on_the_first_guess(paper: Result) -> None:
    flow = desired_flow(paper.controller.plant, paper.controller.trajectory)
    ends = []
    for guess in ([0.0, 0.0], [0.5, -3.0]):
        z0 = np.concatenate([guess, paper.controller.trajectory.exosystem.w0, [1.0]])
        ends.append(periodic_state(flow, z0, free=2, period=1.0).z[0])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)


@pytest.mark.parametrize("size", [1.0, 1e-12, 1e12])
def test_a_steady_state_is_found_whatever_the_unit_of_a_state(size: float) -> None:
    """ζ' = −ζ + size w of w'' = −(2π)² w: known in closed form, also where it is tiny beside w or w beside it."""
    omega = 2 * np.pi
    F0 = np.zeros((4, 4))
    F0[0, :2], F0[1, 2], F0[2, 1] = (-1.0, size), omega, -omega
    whole = SwitchedPart(
        name="plant",
        cells=("everywhere",),
        guards=np.zeros((0, 4)),
        signs=np.zeros((1, 0), dtype=np.int64),
        F=np.zeros((1, 4, 4)),
    )
    steady = periodic_state(Flow(F0=F0, parts=(whole,)), np.array([0.0, 0.0, 1.0, 1.0]), free=1, period=1.0)
    wanted = size * (np.sin(omega * steady.t) - omega * np.cos(omega * steady.t)) / (1 + omega**2)
    assert steady.z[:, 0] == pytest.approx(wanted, rel=1e-9, abs=1e-12 * size)


def test_the_steady_state_repeats_and_has_the_multipliers_of_its_period_map(paper: Result) -> None:
    """Both are held against plain simulations of one period: the state itself, and the period map by differences."""
    steady, flow = paper.steady_state, desired_flow(paper.controller.plant, paper.controller.trajectory)
    assert steady is not None
    assert steady.residual <= 1e-11
    period = simulate_flow(flow, steady.z[0], duration=1.0, sample_time=0.01)
    assert np.abs(period.z[-1] - steady.z[0]).max() <= 1e-11 * np.abs(steady.z).max()
    columns = []
    for direction in np.eye(steady.z.shape[1])[:2]:
        ends = [
            simulate_flow(flow, steady.z[0] + sign * 1e-5 * direction, duration=1.0, sample_time=0.01).z[-1, :2]
            for sign in (1.0, -1.0)
        ]
        columns.append(((ends[0] - ends[1]) / 2e-5).tolist())
    expected = np.linalg.eigvals(np.array(columns).T)
    np.testing.assert_allclose(np.sort(np.abs(steady.multipliers)), np.sort(np.abs(expected)), rtol=1e-6)
    assert np.abs(steady.multipliers[0]) < 1
    assert measures(paper)["largest_multiplier"] == np.abs(steady.multipliers).max()


def test_multipliers_of_a_linear_flow_are_known() -> None:
    """ẋ = −x and ẏ = −3 y, driven with period 1."""
    F0 = np.zeros((5, 5))
    F0[0, 0], F0[1, 1], F0[0, 2], F0[2, 3], F0[3, 2] = -1, -3, 1, 2 * np.pi, -2 * np.pi
    flow = switched(F0, [[1.0, 1, 0, 0, 0.1]], [[-1], [1]], [np.zeros((5, 5))] * 2)
    steady = periodic_state(flow, np.array([0.0, 0, 1, 0, 1]), free=2, period=1.0)
    np.testing.assert_allclose(steady.multipliers, np.exp([-1.0, -3.0]), rtol=1e-12)


def test_an_unresolved_touch_becomes_a_remark(paper: Result) -> None:
    assert not any("rounding" in remark for remark in paper.remarks)
    touches = tuple(Unresolved(t=t, part="observer", guard=1) for t in (0.25, 1.25))
    touches += (Unresolved(t=0.5, part="plant", guard=0, span=1e-9),)
    trace = replace(paper.response.trace, unresolved=touches)
    remarks = replace(paper, response=replace(paper.response, trace=trace)).remarks
    assert len(remarks) == len(paper.remarks) + 1
    first, *others = remarks[-1].split("; ")
    assert (
        first
        == "within rounding of a hyperplane for up to 1e-09 s or a step of the simulation, on which side cannot be told"
    )
    assert others[1:] == [
        "observer at hyperplane 2, t = 0.25 s and 1 more time",
        "plant at hyperplane 1, t = 0.5 s",
    ]


def test_the_derivative_of_the_period_map_is_that_of_simulations(paper: Result) -> None:
    flow, start = paper.loop.flow, paper_start(paper.loop)
    period = simulate_flow(flow, start, duration=1.0, sample_time=0.01)
    assert len(period.events) >= 5
    for column, direction in zip(period_map_derivative(flow, period).T[:10], np.eye(len(start)), strict=False):
        up, down = (
            simulate_flow(flow, start + shift * direction, duration=1.0, sample_time=0.01).z[-1]
            for shift in (1e-6, -1e-6)
        )
        np.testing.assert_allclose((up - down) / 2e-6, column, atol=1e-4)


@pytest.mark.parametrize("t", [0.7323, 1.9])
def test_a_reset_within_a_long_sample_is_carried_out_at_its_time(t: float) -> None:
    kick = [reset(t, slice(1, 2), np.array([-2.0]))]
    start = np.array([0.3, 1.0, 1.0])
    long, short = (
        simulate_flow(abs_oscillator(), start, duration=8.0, sample_time=step, resets=kick) for step in (2.0, 0.05)
    )
    assert len(short.events) >= 3
    np.testing.assert_allclose([e.t for e in long.events], [e.t for e in short.events], atol=1e-12)
    np.testing.assert_allclose(long.z, short.z[::40], atol=1e-12)


def test_relative_degree_equal_to_the_number_of_states_needs_no_generator() -> None:
    plant = random_plant(3, n=2, k=1, r=2)
    loop = loop_of(plant, "sin(t)")
    start = loop.start(plant=np.ones(2), observer=np.zeros(2), generator=np.zeros(0))
    slowest = min(loop.controller.design.controller.rate, loop.controller.design.observer.rate)
    response = loop.response(simulate_flow(loop.flow, start, duration=40 / slowest, sample_time=0.05))
    assert abs(response.tracking_error[-1, 0]) < 1e-8


def test_a_generator_start_of_the_wrong_length_is_refused_with_its_place(paper_spec: Spec) -> None:
    with pytest.raises(PwatrackError, match=r"simulation.initial.generator: 3 entries, expected 2") as refusal:
        simulate(in_scenario(paper_spec, initial=InitialStates(generator=np.zeros(3))), design(paper_spec))
    assert refusal.value.problems[0].place is not None


@pytest.mark.parametrize("t", [0.0, 0.1, 0.3, 0.55, 0.7])
def test_resets_of_one_instant_are_carried_out_together(t: float) -> None:
    """Two entries jump at once; between them the state would be on the other side of the guard."""
    flow = switched(np.zeros((3, 3)), [[1.0, -1.0, 0.0]], [[-1], [1]], [np.zeros((3, 3))] * 2)
    both = [
        reset(t, slice(0, 1), np.array([5.0])),
        reset(t, slice(1, 2), np.array([4.0])),
    ]
    trace = simulate_flow(flow, np.array([2.0, 1.0, 1.0]), duration=1.0, sample_time=0.1, resets=both)
    assert trace.events == ()
    assert trace.z[-1].tolist() == [5.0, 4.0, 1.0]
    if t == 0.0:
        assert trace.z[0].tolist() == [5.0, 4.0, 1.0]


def paper_start(loop: ClosedLoop) -> Array:
    return loop.start(plant=np.array([0.25, 0, 0, 0]), observer=np.zeros(4), generator=np.array([0.2, 0]))


def test_a_hundred_periods_of_the_example_agree_with_fifty_digits(paper: Result) -> None:
    flow, start = paper.loop.flow, paper_start(paper.loop)
    trace = simulate_flow(flow, start, duration=100.0, sample_time=0.01)
    z, times = precise(flow, start, trace)
    assert len(times) == len(trace.events) > 1000
    assert np.abs(trace.z - z).max() <= 1e-13 * np.abs(z).max()
    np.testing.assert_array_less(np.abs([e.t for e in trace.events] - times), 1e-12 * np.maximum(1.0, times))
    assert trace.unresolved == ()


@pytest.mark.parametrize(("omega", "sample_time"), [(1.0, 0.1), (1.0, 5.0), (100.0, 0.5)])
def test_states_are_those_of_exact_arithmetic_to_within_the_figure(omega: float, sample_time: float) -> None:
    """ε ‖F‖ T of the largest state, at every sample, for steps short and long."""
    oscillator = abs_oscillator()
    flow = Flow(F0=omega * oscillator.F0, parts=tuple(replace(p, F=omega * p.F) for p in oscillator.parts))
    start = np.array([0.3, 1.0, 1.0])
    trace = simulate_flow(flow, start, duration=20.0, sample_time=sample_time)
    z, times = precise(flow, start, trace)
    figure = np.finfo(np.float64).eps * (1 + np.linalg.norm(flow.size(), 2) * trace.t)
    assert (np.abs(trace.z - z).max(axis=1) <= 2 * figure * np.abs(z).max()).all()
    np.testing.assert_allclose([e.t for e in trace.events], times, atol=1e-13)


def test_forward_and_back_over_one_period_returns(paper: Result) -> None:
    flow, start = paper.loop.flow, paper_start(paper.loop)
    forth = simulate_flow(flow, start, duration=1.0, sample_time=0.01)
    parts = tuple(replace(part, F=-part.F) for part in flow.parts)
    back = simulate_flow(replace(flow, F0=-flow.F0, parts=parts), forth.z[-1], duration=1.0, sample_time=0.01)
    np.testing.assert_allclose(back.z[-1], start, atol=1e-10)
    np.testing.assert_allclose([1.0 - e.t for e in back.events[::-1]], [e.t for e in forth.events], atol=1e-10)


@pytest.mark.slow
def test_of_500_passes_within_a_hair_none_is_missed_or_invented() -> None:
    for seed in range(500):
        case = near_grazing(seed)
        trace = simulate_flow(case.flow, case.z0, duration=case.duration, sample_time=case.duration / 3)
        assert len(trace.events) == case.crossings, (seed, case.depth)
        assert trace.unresolved == (), (seed, case.depth)


@pytest.mark.parametrize("t0", [0.25, 0.7323, 0.5])  # inside a step, on no grid, at a sample
@pytest.mark.parametrize("depth", [0.0, 1e-16, -1e-16])
def test_a_touch_that_rounding_cannot_decide_is_reported(t0: float, depth: float) -> None:
    F0 = np.array([[0.0, 1, 0], [0, 0, 2], [0, 0, 0]])
    flow = switched(F0, [[0.0, 0, 1.0], [1.0, 0, 0]], [[0, -1], [0, 1]], [np.zeros((3, 3))] * 2)
    trace = simulate_flow(flow, np.array([t0**2 - depth, -2 * t0, 1.0]), duration=1.0, sample_time=0.5)
    assert trace.events == ()
    assert [(u.part, u.guard) for u in trace.unresolved] == [("part", 1)]
    assert trace.unresolved[0].t == pytest.approx(t0, abs=1e-6)


def test_a_start_on_a_facet_or_a_path_along_it_is_not_unresolved() -> None:
    """x = 0 until it is kicked at t = 0.55."""
    kick = [reset(0.55, slice(1, 2), np.array([1.0]))]
    trace = simulate_flow(abs_oscillator(), np.array([0.0, 0.0, 1.0]), duration=1.0, sample_time=0.1, resets=kick)
    assert [(e.t, e.before, e.after) for e in trace.events] == [(0.55, (0,), (1,))]
    assert trace.unresolved == ()


def test_a_thousand_crossings_in_one_sample_are_all_seen() -> None:
    trace = simulate_flow(abs_oscillator(), np.array([0.0, 1.0, 1.0]), duration=3000.0, sample_time=3000.0)
    halves = np.cumsum([np.pi / 2, np.pi] * 700)
    np.testing.assert_allclose([e.t for e in trace.events], halves[halves < 3000.0], rtol=1e-12)
    assert len(trace.events) > 1000
    assert len(trace.t) == 2


def test_a_pole_ten_million_times_faster_changes_nothing() -> None:
    """A quick lag behind the oscillator, with a guard of its own that it never meets."""
    F0 = np.zeros((4, 4))
    F0[:3, :3] = np.array([[0.0, 1, 0], [-1, 0, 0], [1e7, 0, -1e7]])
    stiff = np.zeros((4, 4))
    stiff[1, 0] = -3.0
    flow = switched(
        F0, [[1.0, 0, 0, 0], [0, 0, 1.0, -2.0]], [[-1, -1], [1, -1], [1, 1]], [np.zeros((4, 4)), stiff, stiff]
    )
    trace = simulate_flow(flow, np.array([0.0, 1, 0, 1]), duration=10.0, sample_time=0.1)
    slow = simulate_flow(abs_oscillator(), np.array([0.0, 1, 1]), duration=10.0, sample_time=0.1)
    np.testing.assert_allclose([e.t for e in trace.events], [e.t for e in slow.events], atol=1e-12)
    np.testing.assert_allclose(trace.z[:, :2], slow.z[:, :2], atol=1e-11)


def test_a_crossing_right_at_a_sample_is_one_event_and_not_unresolved() -> None:
    F0 = np.array([[0.0, -1.0], [0, 0]])
    flow = switched(F0, [[1.0, 0.0]], [[-1], [1]], [np.zeros((2, 2))] * 2)
    trace = simulate_flow(flow, np.array([0.5, 1.0]), duration=1.0, sample_time=0.25)
    assert [e.t for e in trace.events] == [pytest.approx(0.5, abs=1e-15)]
    assert trace.modes[:, 0].tolist()[3:] == [0, 0]
    assert trace.unresolved == ()
