"""Limits of the inputs: what the feedforward takes of them is known before a run; from which starts none is reached."""

import json
import re
from io import StringIO
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_continuous_are, solve_continuous_lyapunov

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.claims.limits import NoSaturation, StartGuarantee, promises
from pwatrack.commands.verify import verify
from pwatrack.control.controller import ProvedController
from pwatrack.control.goal import AtLeast, Fastest
from pwatrack.control.headroom import Headroom, InputConstraint, Peak, Starts
from pwatrack.control.synthesis import gain
from pwatrack.control.task import Task
from pwatrack.errors import CheckFailed
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.exact import Certificate
from pwatrack.model.conditions import Conditions
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.model.sizes import Sizes
from pwatrack.report.files import write_design
from pwatrack.report.screen import Findings
from pwatrack.report.summary import print_all
from pwatrack.simulation.closed_loop import closed_loop
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.workflow.headroom import room_within_limits
from pwatrack.workflow.sizing import spec_sizes
from pwatrack.workflow.tracking import desired_trajectory
from tests.conftest import SPECS
from tests.plants import random_plant
from tests.promises import track
from tests.scenarios import in_scenario
from tests.test_cli import call, refused
from tests.units import Units, apart, in_units

STAGE = """
name: Stage
parameters: {m: 2, d: 3}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  units: {z: m, v: m/s, u: N, y: m}
  A: [[0, 1], [0, -d/m]]
  B: [[0], [1/m]]
  C: [[1, 0]]
  nonlinearities:
    - {name: stop, kind: spring, of: z, start: 0.2, slope: 50, into: {v: -1/m}}
reference: {output: REFERENCE}
simulation:
  duration: DURATION
  sample_time: 0.001
  MORE
  actuator: {limits: {u: LIMITS}}
"""

FILTER = """
name: A state behind the output
system:
  states: [y1, h]
  inputs: [u]
  outputs: [y]
  A: [[-1, 1], [1, -4]]
  B: [[1], [0]]
  C: [[1, 0]]
  nonlinearities: [{name: valve, kind: spring, of: h, start: 0.1, slope: 3, into: {h: -1, y1: 1}}]
reference: {output: REFERENCE}
simulation: {duration: 8, sample_time: 0.01, MORE, actuator: {limits: {u: LIMITS}}}
"""


def written(folder: Path, text: str, **entries: str) -> Path:
    path = folder / "spec.yaml"
    for name, entry in {"DURATION": "4", "MORE": "portraits: []", **entries}.items():
        text = text.replace(name, entry)
    path.write_text(text, encoding="utf-8")
    return path


def limited(spec: Spec) -> tuple[Headroom, Peak]:
    found = room_within_limits(spec, desired_trajectory(spec, False), spec_sizes(spec))
    assert found is not None
    assert found.peak is not None
    return found, found.peak


@settings(max_examples=10)
@given(st.floats(0.05, 0.5), st.floats(0.5, 4.0), st.floats(-0.2, 0.2))
def test_the_feedforward_takes_what_it_takes_by_hand(
    tmp_path_factory: pytest.TempPathFactory, a: float, w: float, c: float
) -> None:
    """u_ff = m y'' + d y' + 50 max(0, y - 0.2), looked at everywhere."""
    wave = f"{c!r} + {a!r}*sin({w!r}*t)"
    path = written(tmp_path_factory.mktemp("wave"), STAGE, REFERENCE=wave, LIMITS="[-1e4, 1e4]")
    found, peak = limited(load_spec(path))
    t = np.linspace(0, 2 * np.pi / w, 200_001)
    y = c + a * np.sin(w * t)
    u = -2 * a * w**2 * np.sin(w * t) + 3 * a * w * np.cos(w * t) + 50 * np.maximum(0, y - 0.2)
    size, step = np.abs(u).max(), np.abs(np.diff(u)).max()  # the least may be at a corner, on the facet
    assert [peak.low[0], peak.high[0]] == pytest.approx([u.min(), u.max()], abs=1e-6 * size + step)
    at = np.interp(peak.times[0] % (2 * np.pi / w), t, u)
    assert at == pytest.approx([u.min(), u.max()], abs=1e-5 * size + step)
    assert found.left == pytest.approx([1e4 - size], rel=1e-6)


def test_a_corner_of_the_feedforward_is_its_peak(tmp_path: Path) -> None:
    """A rounded step has a triangle as its acceleration: 2 m y'' is largest at its corners, between samples."""
    step = "{step: {size: 0.1, centre: 0.5123, smooth: 0.6}}"
    _, peak = limited(load_spec(written(tmp_path, STAGE.replace("d: 3", "d: 0"), REFERENCE=step, LIMITS="[-9, 9]")))
    most = 2 * 0.1 / 0.2**2  # three averages over 0.2 s
    assert [peak.low[0], peak.high[0]] == pytest.approx([-most, most], rel=1e-9)
    assert peak.times[0] == pytest.approx([0.5123 + 0.1, 0.5123 - 0.1], abs=1e-9)


def test_a_headroom_that_is_rounding_is_none(tmp_path: Path) -> None:
    """What was left of 100 A beside a feedforward of 0 but for rounding was 2.3e-13 A, or 6e-18 times the sizes."""
    limits = np.array([[0.0, 100.0]])
    for low in (2.273e-13, 0.0, -2.273e-13):
        peak = Peak(low=np.array([low]), high=np.array([low]), times=np.zeros((1, 2)))
        assert peak.left(limits).tolist() == [0.0]
        assert peak.beyond(limits) == []
    spec = load_spec(written(tmp_path, STAGE, REFERENCE="{constant: 0}", LIMITS="[0, 100]"))
    made = design(spec)
    said = [text for _, text in made.claim(NoSaturation).rows(spec.words, made)]
    assert len(said) == 1
    assert said[0].endswith("which takes the whole limit: nothing is left for what is off")


def test_a_state_behind_the_output_is_integrated_and_its_start_dies_out(tmp_path: Path) -> None:
    """h' = y - 4 h - 3 max(0, h - 0.1), u_ff = y' + y - h - 3 max(0, h - 0.1)."""
    wave, start = "0.3*sin(2*t)", "initial: {generator: [1.5]}"
    found, peak = limited(load_spec(written(tmp_path, FILTER, REFERENCE=wave, LIMITS="[-9, 9]", MORE=start)))

    def u_ff(duration: float, h0: float, late: float) -> list[float]:
        run = solve_ivp(
            lambda t, h: 0.3 * np.sin(2 * t) - 4 * h - 3 * np.maximum(0, h - 0.1),
            (0, duration),
            [h0],
            rtol=1e-10,
            atol=1e-12,
            max_step=0.01,
            t_eval=np.linspace(late, duration, 100_001),
        )
        t, h = run.t, run.y[0]
        u = 0.6 * np.cos(2 * t) + 0.3 * np.sin(2 * t) - h - 3 * np.maximum(0, h - 0.1)
        return [float(u.min()), float(u.max())]

    assert [peak.low[0], peak.high[0]] == pytest.approx(u_ff(8, 1.5, 0), abs=1e-6)
    lasting = found.lasting
    assert lasting is not None
    assert [lasting.low[0], lasting.high[0]] == pytest.approx(u_ff(20, 0, 15), abs=1e-6)
    assert peak.low[0] < 3 * lasting.low[0]


def test_a_reference_that_takes_too_much_is_refused_at_its_line(tmp_path: Path) -> None:
    path = written(tmp_path, STAGE, REFERENCE="0.1*sin(5*t)", LIMITS="[-5, 6]")
    for command in ("simulate", "design"):
        error = refused(call(command, path, "--out", tmp_path / "out"), 3)
        assert f"{path}:19:" in error
        assert "the reference takes u = -5.22 N at t = 0.372" in error
        assert "below its lower limit, -5 N" in error
        assert "upper" not in error
    index = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert (index["verdict"], index["exit"]) == ("outside the theory", 3)
    assert "t = 0.372" in index["reasons"][0]["message"]


def test_both_sides_are_told_and_each_once(tmp_path: Path) -> None:
    path = written(tmp_path, STAGE, REFERENCE="0.1*sin(5*t)", LIMITS="[-1, 1]")
    error = refused(call("design", path, "--out", tmp_path / "out"), 3)
    assert error.count("the reference takes u = ") == 2


def test_what_only_the_start_of_the_generator_takes_is_said_and_not_refused(tmp_path: Path) -> None:
    start = "initial: {generator: [1.5]}"
    path = written(tmp_path, FILTER, REFERENCE="0.3*sin(2*t)", LIMITS="[-1, 1]", MORE=start)
    controller = design(load_spec(path))
    assert controller.claims_of(NoSaturation)
    assert controller.claim(NoSaturation).room.left is None
    said = " ".join(call("design", path, "--verbose", "--out", tmp_path / "out").stdout.split())
    assert "more than that, from where the generator starts; once that start is forgotten -0.674" in said
    index = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert index["limits"]["inputs"]["u"]["left"] is None
    assert index["limits"]["inputs"]["u"]["lasting"]["range"] == pytest.approx([-0.6, 0.6], abs=0.1)


def test_the_run_shows_the_feedforward_that_was_said(tmp_path: Path) -> None:
    for name in ("two_mass_backlash", "gallery/three_tanks_weirs", "gallery/two_driven_carts"):
        spec = load_spec(SPECS / f"{name}.yaml")
        wide = np.array([[-1e9, 1e9]] * len(spec.problem.plant.inputs))
        _, peak = limited(in_scenario(spec, conditions=Conditions(limits=wide)))
        seen = simulate(spec).response.u_ff
        step = np.abs(np.diff(seen, axis=0)).max(axis=0) + 1e-6 * np.abs(seen).max(axis=0)
        assert (seen.min(axis=0) >= peak.low - 1e-6 * np.abs(peak.low)).all()
        assert (seen.max(axis=0) <= peak.high + 1e-6 * np.abs(peak.high)).all()
        assert (seen.max(axis=0) >= peak.high - step).all()


def test_a_limit_on_one_side_leaves_what_it_leaves(tmp_path: Path) -> None:
    path = written(tmp_path, STAGE, REFERENCE="0.1*sin(5*t)", LIMITS="[-.inf, 6]")
    found, peak = limited(load_spec(path))
    assert found.left == pytest.approx(6 - peak.high, rel=1e-5)
    said = " ".join(call("design", path, "--verbose", "--out", tmp_path / "out").stdout.split())
    assert "u from -inf to 6 N: its feedforward takes" in said


MASS = """
name: Mass
system:
  states: [v]
  inputs: [u]
  outputs: [y]
  sizes: {v: 0.5}
  A: [[0.3]]
  B: [[2]]
  C: [[1]]
design: {tracking: state, controller: {K: [[-1.5]]}, observer: {L: [[-4]]}}
reference: {setpoint: {y: 0.2}}
simulation: {duration: 5, sample_time: 0.01, INITIAL, actuator: {limits: {u: [-0.6, 0.8]}}}
"""


def test_one_state_is_promised_what_it_does_by_hand(tmp_path: Path) -> None:
    """u_ff = -0.03, so 0.57 is left; |K e| is 0.75 at the start of a size, and e decays."""
    initial = "initial: {plant: [0.55], observer: [0.55]}"
    found = design(load_spec(written(tmp_path, MASS, INITIAL=initial))).claim(NoSaturation)
    left = found.room.left
    assert left == pytest.approx(0.57, rel=1e-5)
    assert left is not None
    scales = {p.starts.kind: p.scale(left) for p in found.promises}
    assert scales["exact"] == pytest.approx(0.57 / 0.75, rel=1e-4)
    assert scales["run"] == pytest.approx(0.57 / (1.5 * 0.35), rel=1e-4)
    assert scales["sizes"] == pytest.approx(0.57 / 1.5, rel=1e-3)  # both are largest at the start


def moved(controller: ProvedController, promise: StartGuarantee, seed: int) -> float:
    """The largest |u - u_ff| / what is promised of it, of e and Δ from corners of the starts under switching."""
    plant, K, L = controller.plant, controller.design.K, controller.design.L
    random, n, worst, mode = np.random.default_rng(seed), len(plant.B), 0.0, 0
    M = [
        np.block([[A + plant.B @ K, plant.B @ K], [np.zeros((n, n)), A_hat + L @ plant.C]])
        for A in plant.A
        for A_hat in plant.A
    ]
    fastest = max(float(np.abs(np.linalg.eigvals(X)).max()) for X in M)
    steps = [expm(X * 0.05 / fastest) for X in M]
    assert promise.held is not None
    size = np.array(promise.held.sizes)
    for _ in range(12):
        corner = promise.starts.G @ random.choice([-1.0, 1.0], size=promise.starts.G.shape[1])
        z = np.concatenate([corner, np.zeros(2 * n - len(corner))])
        hold = int(random.integers(1, 30))
        for k in range(400):
            worst = max(worst, float((np.abs(K @ (z[:n] + z[n:]))[list(promise.inputs)] / size).max()))
            mode = mode if k % hold else int(random.integers(len(steps)))
            z = steps[mode] @ z
    return worst


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_no_start_within_the_promise_moves_an_input_further(seed: int) -> None:
    """Random plants of up to 4 cells, from corners of the box, for any switching; and it is not much too careful."""
    random = np.random.default_rng(seed)
    r = 1 + seed % 3
    loop = track(random_plant(seed, n=int(random.integers(r, 5)), k=2, r=r, strength=0.05), "sin(t)")
    controller = loop.controller
    sizes = controller.sizes
    starts = Starts.within(sizes)
    found = promises(controller, sizes.input, starts)
    assert [p.starts.kind for p in found] == ["exact", "sizes"]
    for promise in found:
        assert moved(controller, promise, seed) <= 1
        assert promise.held is not None
        K = controller.design.K
        least = np.abs(
            K @ np.hstack([promise.starts.G] if promise.starts.delta is None else np.split(promise.starts.G, 2))
        ).sum()
        assert promise.held.sizes[0] <= 2 * least  # Σ |K_k| s_k is reached at the start


def test_a_run_from_the_boundary_of_the_promise_keeps_its_limits(specs: Path) -> None:
    """The loop itself, with limits that cut off: nothing is cut off."""
    spec = load_spec(specs / "two_mass_machine.yaml")
    controller = design(in_scenario(spec, conditions=Conditions(limits=np.array([[-8.0, 8.0]]))))
    limited = controller.claim(NoSaturation)
    assert limited.room.left is not None
    exact = limited.promises[0]
    scale = exact.scale(limited.room.left)
    loop = closed_loop(controller, Conditions(limits=limited.room.limits))
    eta = np.array([0.2, 0.0])
    x_d = controller.trajectory.state(np.concatenate([eta, controller.trajectory.exosystem.w0, [1.0]]))
    seen = []
    for signs in product((-1.0, 1.0), repeat=4):
        x = x_d + scale * exact.starts.G @ np.array(signs)
        trace = simulate_flow(
            loop.flow, loop.start(plant=x, observer=x, generator=eta), duration=20.0, sample_time=0.005
        )
        assert not any(e.before[3] % 3 != 1 or e.after[3] % 3 != 1 for e in trace.events)
        response = loop.response(trace)
        seen.append(np.abs(response.u - response.u_ff).max())
    assert 0.7 * limited.room.left[0] < max(seen) <= limited.room.left[0]


def test_what_is_promised_is_audited_and_a_smaller_number_is_found_out(tmp_path: Path) -> None:
    out, path = tmp_path / "out", written(tmp_path, MASS, INITIAL="initial: {plant: [0.3]}")
    said = " ".join(call("simulate", path, "--verbose", "--out", out).stdout.split())
    assert "in the loop as designed no limit is ever reached from each |x_k − x_dk| up to 0.7599 times its size" in said
    assert "the bounds of signals with limits from 3 boxes of starts are proved" in verify(out, path)
    text = (out / "certificate.json").read_text(encoding="utf-8")
    content = json.loads(text)
    entry = content["limits"][0]
    for change, fault in (
        ({"starts": [["0.51"]]}, "a start is not in the ellipsoid"),
        ({"signals": [["input", 0, "0.74"]]}, "input 0 is not bounded by 0.74"),
        ({"weights": ["1.1"]}, "the weights of the starts are not positive, or more than 1 together"),
        ({"signals": []}, "it bounds nothing"),
        ({"Q": entry["Q"] | {"integers": [[-1]]}}, "a start is not in the ellipsoid"),
    ):
        changed = content | {"limits": [entry | change]}
        assert any(fault in wrong for wrong in audit(json.dumps(changed))[1]), fault
    index = (out / "run.json").read_text(encoding="utf-8")
    told = json.loads(index)
    told["limits"]["starts"][0]["scale"] = 0.8
    (out / "run.json").write_text(json.dumps(told), encoding="utf-8")
    with pytest.raises(CheckFailed, match=r"limits in run.json is not what was proved"):
        verify(out, path)


def test_starts_of_an_ensemble_and_a_measured_observer_are_those_of_its_members(tmp_path: Path) -> None:
    boxes = "initial: {plant: [0.3, 0], observer: measured}, ensemble: {initial: {plant: {z: [0.1, 0.5], v: [-1, 3]}}}"
    more = boxes.replace(", ensemble", "\n  ensemble")
    path = written(tmp_path, STAGE, REFERENCE="0.1*sin(5*t)", LIMITS="[-100, 100]", MORE=more)
    spec = load_spec(path)
    found, _ = limited(spec)
    run, members, right = found.starts[2:]
    assert (run.kind, members.kind, right.kind) == ("run", "ensemble", "members")
    assert right.delta is None
    assert np.array_equal(right.e, members.e)
    assert run.e[:, 0] == pytest.approx([0.3, -0.5])
    assert run.delta is None  # what is measured is what it starts with
    assert members.delta is not None
    for corner in product((-1, 1), repeat=2):
        x = np.array([0.3, 1.0]) + np.array([0.2, 2.0]) * corner
        assert members.e @ np.array([1, *corner]) == pytest.approx(x - [0, 0.5])
        assert members.delta @ np.array([1, *corner]) == pytest.approx([0, -x[1]])


def tank(a: float, b: float, s: float, most: float) -> tuple[Task, InputConstraint]:
    sizes = Sizes(state=np.array([s]), input=np.array([1.0]), output=np.ones(1), speed=1.0)
    task = Task(A=np.array([[[a]]]), B=np.array([[b]]), cells=["all"], sizes=sizes)
    return task, InputConstraint(starts=[np.array([[s]])], left=np.array([most]))


@pytest.mark.slow
@settings(max_examples=8)
@given(st.integers(-30, 30).map(lambda k: k / 10), st.floats(0.2, 5), st.floats(0.1, 10), st.floats(0.05, 5))
def test_one_state_has_the_gain_that_its_limits_leave(a: float, b: float, s: float, most: float) -> None:
    """|K| s <= u: the cost falls as |K| grows to that of the regulator, and the rate grows with |K|."""
    task, within = tank(a, b, s, most)
    room, regulator = most / s, (a + np.sqrt(a**2 + (b / s) ** 2)) / b
    assume(b * room - a >= 0.02 * (1 + abs(a)))  # else hardly stable, or nothing keeps the limits
    cheapest = gain(task, AtLeast(), within)[0]
    assert -cheapest[0, 0] == pytest.approx(min(room, regulator), rel=0.03)
    assert -cheapest[0, 0] * s <= most
    K, proof = gain(task, Fastest(), within)
    assert -K[0, 0] * s <= most
    assert proof.rate == pytest.approx(b * room - a, rel=5e-3, abs=5e-3 * b * room)
    if b * room / 2 > a + 0.1:
        _, proof = gain(task, Fastest(bound=most / 2), within)
        assert proof.rate == pytest.approx(b * room / 2 - a, rel=5e-3, abs=5e-3 * b * room)


@settings(max_examples=10)
@given(st.integers(1, 30).map(lambda k: k / 10), st.floats(0.2, 5), st.floats(0.1, 10), st.floats(0.05, 0.98))
def test_where_nothing_keeps_the_limits_the_gain_is_the_regulator(a: float, b: float, s: float, share: float) -> None:
    task, within = tank(a, b, s, share * a * s / b)
    cheapest = gain(task, AtLeast(), within)[0]
    assert cheapest == pytest.approx(-(a + np.sqrt(a**2 + (b / s) ** 2)) / b, rel=2e-3)


def largest(M: Array, K: Array, s: Array) -> float:
    """The largest |K e(t)| of e' = M e from all corners of |e_k| <= s_k: one cell, so it is known."""
    step, X, found = expm(M * 0.02 / float(np.abs(np.linalg.eigvals(M)).max())), np.eye(len(M)), 0.0
    for _ in range(2000):
        found = max(found, float(np.abs(K @ X @ np.diag(s)).sum()))
        X = step @ X
    return found


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_gains_within_limits_keep_them_and_no_regulator_of_heavier_inputs_is_much_cheaper(seed: int) -> None:
    """Of one cell: regulators with dearer and dearer inputs, until the limits are kept, are what one would try."""
    random = np.random.default_rng(seed)
    n, s = int(random.integers(2, 5)), random.uniform(0.5, 2.0, size=4)
    A, B, s = random.normal(size=(n, n)) - np.eye(n), random.normal(size=(n, 1)), s[:n]
    Q, most = np.diag(1 / s**2), float(random.uniform(0.3, 0.8))
    sizes = Sizes(state=s, input=np.ones(1), output=np.ones(1), speed=1.0)
    task = Task(A=A[None], B=B, cells=["all"], sizes=sizes)

    def cost(K: Array) -> float:
        X = solve_continuous_lyapunov((A + B @ K).T, -Q - K.T @ K)
        return max(float(v @ X @ v) for v in (s * np.array(c) for c in product((-1.0, 1.0), repeat=n)))

    tried = []
    for weight in np.geomspace(1, 1e4, 20):
        K = -B.T @ solve_continuous_are(A, B, Q, weight * np.eye(1)) / weight
        if largest(A + B @ K, K, s) <= most:
            tried.append((cost(K), -float(np.linalg.eigvals(A + B @ K).real.max())))
    within = InputConstraint(starts=[np.diag(s)], left=np.array([most]))
    K, proof = gain(task, AtLeast(), within)
    assert isinstance(proof, Certificate)
    if within.share(task, K, proof) < 1:
        assert not tried or np.linalg.eigvals(A).real.max() > 0  # nothing was found
        return
    assert largest(A + B @ K, K, s) <= most
    assert cost(K) <= 1.5 * min(value for value, _ in tried)
    fast, faster = gain(task, Fastest(), within)
    assert largest(A + B @ fast, fast, s) <= most
    assert faster.rate >= proof.rate * (1 - 1e-3)


def test_a_gain_that_keeps_its_limits_anyway_is_the_regulator(tmp_path: Path) -> None:
    texts = (STAGE.replace("\n  actuator: {limits: {u: LIMITS}}", ""), STAGE)
    sized = [t.replace("  units:", "  sizes: {z: 0.1, v: 0.2, u: 5}\n  units:") for t in texts]
    free, limited = (
        design(load_spec(written(tmp_path, t, REFERENCE="0.1*sin(t)", LIMITS="[-50, 50]"))).design.K for t in sized
    )
    assert np.array_equal(free, limited)


def summary(spec: Spec, controller: ProvedController) -> str:
    """All that is said of a design, in one line."""
    printed = StringIO()
    print_all(Console(width=200, file=printed), Findings(spec=spec, controller=controller))
    return " ".join(printed.getvalue().split())


@pytest.mark.slow
@pytest.mark.parametrize("asked", ["", "rate: 0.5, ", "rate: largest, ", "rate: largest, gain: 0.5, "])
def test_a_spec_with_limits_is_designed_within_them(tmp_path: Path, asked: str) -> None:
    sizes = "  sizes: {z: 0.5, v: 1}\n  units:"
    text = STAGE.replace("  units:", sizes).replace("slope: 50", "slope: 2")
    text = text.replace("reference:", f"design: {{controller: {{{asked}within: limits}}}}\nreference:")
    path = written(tmp_path, text, REFERENCE="0.1*sin(t)", LIMITS="[-4, 4]")
    spec = load_spec(path)
    controller = design(spec)
    found = controller.claim(NoSaturation)
    assert found.room.left is not None
    assert found.promises[0].scale(found.room.left) >= 1
    assert (np.abs(controller.design.K) @ [0.5, 1]).max() <= found.room.left[0]
    said = summary(spec, controller)
    assert " within the limits" in said.partition("(9)")[0]
    if asked == "rate: 0.5, ":
        assert controller.design.controller.rate >= 0.5


@pytest.mark.slow
def test_limits_leave_the_gain_as_it_is_but_where_it_is_to_keep_them(tmp_path: Path) -> None:
    """A K that keeps limits of 4 N from errors of 0.5 m is a small one; what a goal settles cannot be within limits."""
    sizes = STAGE.replace("  units:", "  sizes: {z: 0.5, v: 1, u: 5}\n  units:").replace("slope: 50", "slope: 2")
    kept = sizes.replace("reference:", "design: {controller: {within: limits}}\nreference:")
    free = sizes.replace("\n  actuator: {limits: {u: LIMITS}}", "")
    gains = [
        design(load_spec(written(tmp_path, t, REFERENCE="0.1*sin(t)", LIMITS="[-4, 4]"))).design.K
        for t in (sizes, kept, free)
    ]
    assert np.array_equal(gains[0], gains[2])
    assert np.abs(gains[1][0, 0]) < 0.7 * np.abs(gains[0][0, 0])
    path = written(tmp_path, kept.replace("\n  actuator: {limits: {u: LIMITS}}", ""), REFERENCE="0.1*sin(t)")
    assert "'within: limits' is asked of K, and no input has a limit" in refused(call("design", path), 2)
    for asked in ("gain: smallest, rate: 1", "K: [[-1, -1]]"):
        path = written(tmp_path, kept.replace("within:", f"{asked}, within:"), REFERENCE="0.1*sin(t)", LIMITS="[-4, 4]")
        assert "'within' beside it has no meaning" in refused(call("check", path), 2)


def test_where_no_gain_keeps_the_limits_it_is_said_from_where_they_are_kept(tmp_path: Path) -> None:
    """z'' = z + u cannot be held from 2 with |u| <= 1."""
    text = STAGE.replace("[0, -d/m]]", "[1, 0]]").replace("  units:", "  sizes: {z: 2, v: 2}\n  units:")
    path = written(tmp_path, text, REFERENCE="0.1*sin(t)", LIMITS="[-2, 2]")
    said = " ".join(call("design", path, "--verbose", "--out", tmp_path / "out").stdout.split())
    assert "designed within the limits" not in said
    share = re.search(r"from each \|x_k − x_dk\| up to (\S+) times its size and x̂ = x", said)
    assert share
    assert 0 < float(share[1]) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_mass_machine", "gallery/stage_with_bumpers"])
def test_limits_in_other_units_give_the_same_controller(name: str, tmp_path: Path) -> None:
    path, other = SPECS / f"{name}.yaml", tmp_path / "other.yaml"
    units = Units.random(path, 3)
    plain = Units(dict.fromkeys(units.of, "1"), "1")
    found = []
    for chosen in (plain, units):
        other.write_text(in_units(path, chosen), encoding="utf-8")
        found.append(design(load_spec(other)))
    assert found[0].claims_of(NoSaturation)
    assert found[0].claim(NoSaturation).promises
    assert found[1].design.K.shape == found[0].design.K.shape
    # A cost is flat at its least: where a solver is off that by 1e-8 of it, the gain may be off by 1e-4 and more.
    assert apart(found[0].design, found[1].design, found[0].sizes, units) < 1e-3
    scales = [
        {p.starts.kind: p.scale(left) for p in c.claim(NoSaturation).promises}
        for c in found
        if (left := c.claim(NoSaturation).room.left) is not None
    ]
    assert "exact" in scales[1]  # those with loads need units that are fractions
    # Each is that of an ellipsoid that is near the smallest, to 2e-3 or 1e-3 of it, about a gain that is as near.
    assert {kind: scales[0][kind] for kind in scales[1]} == pytest.approx(scales[1], rel=5e-3)


@pytest.mark.slow
def test_starts_of_an_ensemble_are_what_a_gain_is_designed_for(tmp_path: Path) -> None:
    """They are larger than the sizes, so that the gain is smaller; a certificate with other starts is found out."""
    starts = "initial: {plant: [0, 0]}\n  ensemble: {initial: {plant: {z: [-1, 1], v: [-1, 1]}}}"
    text = STAGE.replace("  units:", "  sizes: {z: 0.5, v: 1}\n  units:").replace("slope: 50", "slope: 2")
    text = text.replace("reference:", "design: {controller: {within: limits}}\nreference:")
    gains = []
    for more in (starts, "portraits: []"):
        path = written(tmp_path, text, REFERENCE="0.1*sin(t)", LIMITS="[-4, 4]", MORE=more)
        controller = design(load_spec(path))
        gains.append(controller.design.K)
        found = controller.claim(NoSaturation)
        assert found.room.left is not None
        kinds = {p.starts.kind: p.scale(found.room.left) for p in controller.claim(NoSaturation).promises}
        assert kinds["members" if more == starts else "exact"] >= 1
        assert ("ensemble" in kinds) == (more == starts)
        if more == starts:
            write_design(load_spec(path), controller, tmp_path / "out")
            said = summary(load_spec(path), controller)
    assert np.abs(gains[0][0, 0]) < np.abs(gains[1][0, 0])
    path = written(tmp_path, text, REFERENCE="0.1*sin(t)", LIMITS="[-4, 4]", MORE=starts)
    assert "designed within the limits" in said
    assert "no limit is ever reached from the starts of its ensemble with x̂ = x" in said
    assert any("it belongs to" in line for line in verify(tmp_path / "out", path))
    certificate = tmp_path / "out" / "certificate.json"
    content = json.loads(certificate.read_text(encoding="utf-8"))
    content["limits"][0]["starts"][0][0] = "0.4"
    certificate.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CheckFailed, match="the starts from which limits are kept are not those of"):
        verify(tmp_path / "out", path)


def test_with_loads_at_the_input_no_corner_of_the_promise_reaches_a_limit(tmp_path: Path) -> None:
    """Errors of x, of x̂ and the load, all at once, in the loop with its limits."""
    sizes = "  sizes: {z: 0.1, v: 0.3, load_u: 0.5}\n  units:"
    text = STAGE.replace("  units:", sizes).replace("slope: 50", "slope: 2")
    text = text.replace("reference:", "design: {estimate: input, observer: {rate: 3}}\nreference:")
    path = written(tmp_path, text, REFERENCE="0.1*sin(t)", LIMITS="[-4, 4]")
    spec = load_spec(path)
    controller = design(spec)
    found = controller.claim(NoSaturation)
    assert found.room.left is not None
    promise = next(p for p in controller.claim(NoSaturation).promises if p.starts.kind == "sizes")
    assert promise.loads == (0.5,)
    scale = promise.scale(found.room.left)
    assert scale > 0.02
    random = np.random.default_rng(1)
    most = 0.0
    for _ in range(12):
        z = scale * promise.starts.G @ random.choice([-1.0, 1.0], size=promise.starts.G.shape[1])
        push = exosystem([Signal.of(ExponentialPolynomial.constant(c)) for c in (0.0, -z[4] / 2)])
        loop = closed_loop(controller, Conditions(limits=found.room.limits, disturbance=push))
        x = np.array([0.0, 0.1]) + z[:2]
        start = loop.start(plant=x, observer=x + z[2:4], generator=np.zeros(0))
        trace = simulate_flow(loop.flow, start, duration=8.0, sample_time=0.002)
        limit = [part.name for part in loop.flow.parts].index("actuator u")
        assert not any(e.before[limit] != e.after[limit] for e in trace.events)
        response = loop.response(trace)
        nominal = response.u_ff + response.estimates
        most = max(most, float(np.abs(response.u - nominal).max()))
    assert 0.3 * found.room.left[0] < most <= found.room.left[0]
    out = tmp_path / "out"
    said = " ".join(call("design", path, "--verbose", "--out", out).stdout.split())
    assert "from each |x_k − x_dk| and |x̂_k − x_k| and each load up to" in said
    content = json.loads((out / "certificate.json").read_text(encoding="utf-8"))
    assert audit(json.dumps(content))[1] == []
    content["limits"][1]["signals"][0][0] = "input"
    assert "limits are said of 'drive' here" in audit(json.dumps(content))[1][0]


def test_loads_that_are_not_constants_at_inputs_get_no_promise_but_for_the_right_estimates(tmp_path: Path) -> None:
    text = STAGE.replace("reference:", "design: {estimate: {hum: {into: {v: 1/m}, frequency: 3}}}\nreference:")
    controller = design(load_spec(written(tmp_path, text, REFERENCE="0.1*sin(t)", LIMITS="[-50, 50]")))
    assert [p.starts.kind for p in controller.claim(NoSaturation).promises] == ["exact", "run"]
    hums = "disturbance: {v: {sine: {amplitude: 0.1, frequency: 3, phase: 0}}}"  # which is 0 as the run begins
    path = written(tmp_path, text, REFERENCE="0.1*sin(t)", LIMITS="[-50, 50]", MORE=hums)
    assert [p.starts.kind for p in design(load_spec(path)).claim(NoSaturation).promises] == ["exact"]


FAST = """
name: A fast start of the generator
system:
  states: [x, p, q]
  inputs: [u]
  outputs: [y]
  sizes: {x: 0.01, p: 0.01, q: 0.01, u: 1}
  A: [[-1, 10, 0], [0, 0, 3000], [0, -3000, -600]]
  B: [[1], [0], [0]]
  C: [[1, 0, 0]]
reference: {output: "0.1*sin(t)"}
simulation:
  duration: 20
  sample_time: 0.01
  initial: {generator: [0, 1], plant: [0, 0, 1], observer: [0, 0, 1]}
  actuator: {limits: {u: LIMITS}}
"""


def fast(t: Array) -> Array:
    """u_ff = y' + y - 10 p, (p, q) from (0, 1) on."""
    F = np.array([[0, 3000.0], [-3000, -600]])
    step, eta, p = expm(F * (t[1] - t[0])), np.array([0.0, 1.0]), np.empty(len(t))
    for k in range(len(t)):
        p[k], eta = eta[0], step @ eta
    return np.asarray(0.1 * np.cos(t) + 0.1 * np.sin(t) - 10 * p)


def test_a_peak_that_a_fast_generator_makes_between_the_samples_of_a_slow_reference_is_found(tmp_path: Path) -> None:
    u = fast(np.linspace(0, 0.03, 300_001))
    _, peak = limited(load_spec(written(tmp_path, FAST, LIMITS="[-20, 20]")))
    size = np.abs(u).max()
    assert u.max() <= peak.high[0] <= u.max() + 1e-6 * size
    assert peak.low[0] <= u.min() <= peak.low[0] + 1e-6 * size
    assert peak.times[0] == pytest.approx([u.argmin() * 1e-7, u.argmax() * 1e-7], abs=1e-6)


def test_no_start_is_promised_to_reach_no_limit_that_the_feedforward_reaches_between_samples(tmp_path: Path) -> None:
    path = written(tmp_path, FAST, LIMITS="[-2, 2]")
    said = " ".join(call("simulate", path, "--verbose", "--out", tmp_path / "out").stdout.split())
    assert "its feedforward takes -8.526 to 6.391" in said
    assert "limit is" not in said
    assert simulate(load_spec(path)).figures.largest_input["u"] == pytest.approx(2, rel=2e-7)


@pytest.mark.parametrize(("later", "said"), [(15, "no limit is reached in this run"), (5, "no limit is ever reached")])
def test_what_the_reference_does_after_the_run_is_not_spoken_of(tmp_path: Path, later: float, said: str) -> None:
    steps = f"{{step: [{{size: 0.1, at: 1, smooth: 1}}, {{size: 0.2, at: {later}, smooth: 1}}]}}"
    path = written(tmp_path, STAGE, REFERENCE=steps, DURATION="10", LIMITS="[-20, 20]")
    text = " ".join(call("design", path, "--verbose", "--out", tmp_path / "out").stdout.split())
    assert f"in the loop as designed {said} from" in text


def test_nothing_is_said_for_ever_while_the_start_of_the_generator_still_matters(tmp_path: Path) -> None:
    start = "initial: {generator: [0.5]}"
    for duration, ever in (("8", True), ("0.5", False)):
        text = FILTER.replace("duration: 8", f"duration: {duration}")
        path = written(tmp_path, text, REFERENCE="0.3*sin(2*t)", LIMITS="[-90, 90]", MORE=start)
        assert limited(load_spec(path))[0].ever == ever


def test_what_is_required_of_an_input_is_held_against_it_between_samples(tmp_path: Path) -> None:
    text = FAST.replace("  actuator: {limits: {u: LIMITS}}\n", "")
    path = written(tmp_path, text + "require: {largest_input: 8}\n")
    result = call("simulate", path, "--out", tmp_path / "out")
    assert result.exit_code == 6
    assert "largest_input of u: 8.526, at most 8 required" in " ".join(result.stdout.split())


TANKS = """
name: two tanks and a float, on which the pump hangs
system:
  states: [h1, h2, h3]
  inputs: [q]
  outputs: [y]
  A: [[-0.5, 0, 0.1], [0.2, -0.24, 0], [0, 1, -1]]
  B: [[1], [0], [0]]
  C: [[0, 1, 0]]
  nonlinearities:
    - {name: side, kind: spring, of: h1, into: {h1: -1, h2: 0.4}, start: 0.6, slope: 1}
reference: {output: {constant: HEIGHT}}
simulation: {duration: 8, sample_time: 0.1, initial: {generator: [START]}, actuator: {limits: {q: [-9, 9]}}}
"""


@pytest.mark.parametrize(("start", "ever"), [("0.8", True), ("0.7", False)])
def test_where_u_ff_jumps_between_cells_it_goes_on_for_ever_from_a_rest_inside_of_one(
    tmp_path: Path, start: str, ever: bool
) -> None:
    rest = "initial: {generator: steady}" if ever else f"initial: {{generator: [{start}]}}"
    text = TANKS.replace("HEIGHT", "0.8").replace("initial: {generator: [START]}", rest)
    found, _ = limited(load_spec(written(tmp_path, text)))
    assert found.ever == ever


@pytest.mark.parametrize(
    ("u", "low", "high", "ever"),
    [
        ("1 + 2*sin(0.5*t)", -1.0, 3.0, True),  # of which the run sees less than half a period
        ("3", 3.0, 3.0, True),
        ("sin(0.5*t) + sin(0.3*sqrt(2)*t)", -1.0, 2.0, False),  # it never repeats
    ],
)
def test_inputs_that_are_given_go_on_as_they_are_written(
    tmp_path: Path, u: str, low: float, high: float, ever: bool
) -> None:
    asked = f'design: {{tracking: state}}\nreference: {{input: ["{u}"], start: [0, 0]}}'
    text = STAGE.replace("reference: {output: REFERENCE}", asked).replace("[0, -d/m]", "[-4, -d/m]")
    path = written(tmp_path, text, DURATION="3", LIMITS="[-20, 20]")
    found, peak = limited(load_spec(path))
    assert found.ever == ever
    assert peak.low[0] == pytest.approx(low, abs=1.01 if not ever else 1e-5)
    assert peak.high[0] == pytest.approx(high, abs=1.01 if not ever else 1e-5)
