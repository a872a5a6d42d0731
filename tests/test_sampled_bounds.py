"""What is left of the errors of a sampled loop: against closed forms, worst cases that are built, and the loop."""

import copy
import json
import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_disturbances import driven, row
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.clocked import Clocked
from pwatrack.lmi.clocked_tubes import Drive, tube
from pwatrack.lmi.tube_program import TubeProgram
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation import acting
from pwatrack.simulation.desired import desired_flow
from pwatrack.simulation.propagate import simulate_flow
from tests.sampled import asking, worst_found

MACHINE = """
  controller: {sample_time: 0.1}
  noise: {std: {y: 1e-4}, sample_time: 0.1, seed: 1}
  quantum: {y: 1e-5, u: 0.01}
  disturbance: {v1: {constant: 0.002, sine: {amplitude: 0.005, frequency: 3}}}
"""


@pytest.fixture(scope="module")
def sampled(specs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    path = tmp_path_factory.mktemp("sampled") / "plant.yaml"
    path.write_text(text.replace("\nsimulation:\n", f"\nsimulation:{MACHINE}"), encoding="utf-8")
    spec = load_spec(path)
    return spec, design(spec)


FRICTION = """
name: A mass with friction
system:
  states: [x, v]
  inputs: [u]
  outputs: [y]
  B: [[0], [1]]
  C: [[1, 0]]
  cells:
    - {name: forwards, where: ["v >= 0.2"], A: [[0, 1], [0, -0.5]], b: [0, -0.2]}
    - {name: slow, where: ["v <= 0.2", "v >= -0.2"], A: [[0, 1], [0, -1.5]]}
    - {name: backwards, where: ["v <= -0.2"], A: [[0, 1], [0, -0.5]], b: [0, 0.2]}
reference:
  output: {sine: {amplitude: 0.3, frequency: 4}}
simulation:
  duration: 8
  sample_time: 0.01
  controller: {sample_time: 0.1}
"""

TANK = """  states: [x]
  inputs: [u]
  outputs: [y]
  B: [[2]]
  C: [[1]]
  cells:
    - {name: high, where: ["x >= 0.1"], A: [[-1]], b: [-0.1]}
    - {name: low, where: ["x <= 0.1"], A: [[-2]]}
reference"""


@pytest.fixture(scope="module")
def friction(tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    """A plant with cells of what its input drives: R B is not 0."""
    path = tmp_path_factory.mktemp("friction") / "plant.yaml"
    path.write_text(FRICTION, encoding="utf-8")
    spec = load_spec(path)
    return spec, design(spec)


def the_bounds(controller: ProvedController) -> SampledBounds:
    return controller.claim(SampledBounds)


@pytest.mark.parametrize("g", [0.9, 0.5, -0.7])
def test_noise_at_ticks_leaves_the_sum_of_what_each_tick_leaves(g: float) -> None:
    """z' = −z and z⁺ = g z + d: at most 1 / (1 − |g| e^(−h)), and a tube is an ellipse of one dimension: exact."""
    h, one, nothing = 0.1, BallMatrix.of([[1]]), BallMatrix.of([[0]])
    system = Clocked(F=[BallMatrix.of([[-1]])], J=[BallMatrix.of([[g]])], period=Fraction("0.1"))
    program = TubeProgram(system=system, near=np.eye(1), knots=4)
    worst = 1 / (1 - abs(g) * np.exp(-h))
    decays = np.geomspace(0.1, 1.9 * program.most, 25)
    drive = Drive(held=nothing, between=nothing, ticks=one)
    found = [tube(program, drive, one, np.ones(1), float(f"{decay:.3g}")) for decay in decays]
    least = min(each.sizes[0] for each in found if each is not None)
    assert worst <= least < 1.03 * worst


def test_what_drives_beside_a_state_is_what_that_state_drives() -> None:
    """z' = −(z + d) is at most 1."""
    one, nothing = BallMatrix.of([[1]]), BallMatrix.of([[0]])
    system = Clocked(F=[BallMatrix.of([[-1]])], J=[one], period=Fraction("0.1"))
    program = TubeProgram(system=system, near=np.eye(1), knots=1)
    found = tube(program, Drive(held=one, between=nothing), one, np.ones(1), 1.0)
    assert found is not None
    assert 1.0 <= found.sizes[0] < 1.01


@pytest.mark.parametrize("seed", range(4))
def test_no_switching_and_nothing_that_acts_is_above_a_tube(seed: int, sampled: tuple[Spec, ProvedController]) -> None:
    _, controller = sampled
    claim = the_bounds(controller)
    assert {kind for kind, _ in claim.tubes} == {"disturbance", "noise", "input", "ripple", "moved"}
    for channel, one in claim.tubes.items():
        c = row(claim.errors, ("output", 0)).floats
        found = worst_found(claim, channel, c, seed)
        assert 0.05 * one.sizes[0] < found <= one.sizes[0]


@pytest.mark.parametrize("which", ["sampled", "friction"])
def test_what_acts_is_what_the_walk_shows_in_between(which: str, request: pytest.FixtureRequest) -> None:
    """u_ff from fine samples, less its mean over each hold; x_d + B W less what it was at the last substep."""
    spec, controller = request.getfixturevalue(which)
    claim, trajectory, plant = the_bounds(controller), controller.trajectory, controller.plant
    h, r, fine = claim.errors.gains.sample_time, claim.errors.gains.substeps, 40
    z0 = np.concatenate([{"sampled": [0.2, 0.0], "friction": []}[which], trajectory.exosystem.w0, [1.0]])
    step = h / (r * fine)
    trace = simulate_flow(desired_flow(plant, trajectory), z0, duration=spec.scenario.duration, sample_time=step)
    cell, count = trace.modes[:, 0], (len(trace.t) - 1) // (r * fine)
    u = np.einsum("kmj,kj->km", trajectory.u_ff[cell], trace.z)[:, 0]
    x_d = np.einsum("knj,kj->kn", trajectory.x_d[cell], trace.z)
    holds = np.array([u[k * r * fine : (k + 1) * r * fine + 1] for k in range(count)])
    total = np.hstack([np.zeros((count, 1)), np.cumsum((holds[:, 1:] + holds[:, :-1]) / 2 * step, axis=1)])
    mean = total[:, -1:] / h
    W = mean * step * np.arange(r * fine + 1) - total
    moving = x_d[: count * r * fine] + W[:, :-1].reshape(-1, 1) * plant.B[:, 0]
    moving = np.vstack([moving, x_d[count * r * fine]]) @ claim.errors.R.floats.T
    moved = [np.abs(moving[k : k + fine + 1] - moving[k]).max() for k in range(0, count * r * fine, fine)]
    machine = 0.005 if which == "sampled" else 0.0
    acts = claim.acts.sizes
    assert 0.97 * np.abs(holds - mean).max() < claim.acts.off[0] - machine < 1.1 * np.abs(holds - mean).max()
    assert acts["input", 0] - machine < 0.25 * np.abs(holds - mean).max()
    assert acts["ripple", 0] == pytest.approx(np.abs(W).max(), rel=2e-3)
    assert acts["moved", 0] == pytest.approx(max(moved), rel=2e-3)
    assert which == "sampled" or abs(claim.errors.R.floats @ plant.B).max() == 1


@pytest.mark.parametrize("which", ["sampled", "friction"])
def test_what_acts_does_not_depend_on_how_the_walk_is_cut(
    which: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, controller = request.getfixturevalue(which)
    claim = the_bounds(controller)
    monkeypatch.setattr(acting, "BLOCK", 7)
    asked = asking(spec, controller, claim.errors.gains)
    assert asked.acting is not None
    found = asked.acting(controller, claim.errors)
    assert found is not None
    assert found.off == pytest.approx(claim.acts.off, rel=2e-3)
    assert found.sizes == pytest.approx(dict(claim.acts.sizes), rel=2e-3)


def test_noise_and_disturbances_act_as_large_as_they_are(sampled: tuple[Spec, ProvedController]) -> None:
    _, controller = sampled
    acts = the_bounds(controller).acts.sizes
    assert acts["disturbance", 1] == pytest.approx(0.007, rel=1e-3)
    noise = np.abs(np.random.default_rng(1).normal(size=(601, 1)) * 1e-4).max()
    assert acts["noise", 0] == pytest.approx(noise + 5e-6, rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_0_in_the_mean_acts_by_its_integral(seed: int, friction: tuple[Spec, ProvedController]) -> None:
    """z under ω that jumps and rises is what W and V = W − W(t_p) drive, B W and R B V added, at all times."""
    errors, random, fine = the_bounds(friction[1]).errors, np.random.default_rng(seed), 4
    system = errors.clocked
    F, J = np.array([X.floats for X in system.F]), system.J[0].floats
    assert system.between is not None
    R, dt = system.between.floats, float(system.period) / system.parts / fine
    of_omega, of_W, of_rho = (driven(errors, (kind, 0)).held.floats for kind in ("input", "ripple", "moved"))
    of_V, none = of_rho @ errors.R.floats @ errors.plant.B, 0 * of_W
    S = np.array([[0, 0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0]])  # of (W, V, ω, ω')
    z, less = np.zeros((2, errors.order))
    for _ in range(20):
        z, less, W, V = J @ z, J @ less, 0.0, 0.0
        jumps, slopes = random.normal(size=(2, system.parts * fine))
        jumps -= np.mean(jumps + slopes * dt / 2)
        for k, (omega, slope) in enumerate(zip(jumps, slopes, strict=True)):
            if k and k % fine == 0:
                z, less, V = R @ z, R @ less, 0.0
            A, acts = np.tensordot(random.dirichlet(np.full(len(F), 0.1)), F, 1), [W, V, omega, slope]
            drives = np.hstack([none, none, of_omega, none]), np.hstack([of_W, of_V, none, none])
            both = (np.block([[A, A @ E], [np.zeros((4, len(z))), S]]) for E in drives)
            turns = [expm(X * dt) for X in both]
            z, less, (W, V) = (turns[0] @ [*z, *acts])[:-4], (turns[1] @ [*less, *acts])[:-4], (expm(S * dt) @ acts)[:2]
            assert z == pytest.approx(less + of_W[:, 0] * W + of_V[:, 0] * V, abs=1e-12)
            assert np.abs(z).max() > 1e-4
        assert abs(W) < 1e-12


def test_what_the_input_drives_at_once_moves_with_the_ripple(tmp_path: Path) -> None:
    """Of a tank, B = 2, with all tubes empty: between ticks 2 W is left of the level, and ω of the input."""
    text = re.sub(r"(?s)  states.*reference", TANK, FRICTION)
    (tmp_path / "plant.yaml").write_text(text, encoding="utf-8")
    controller = design(load_spec(tmp_path / "plant.yaml"))
    claim = the_bounds(controller)
    empty = {channel: replace(one, sizes=(0.0,) * len(one.sizes)) for channel, one in claim.tubes.items()}
    ends = replace(claim, tubes=empty).ends_below(controller)
    assert ends["output", 0] == pytest.approx(2 * claim.acts.sizes["ripple", 0])
    assert ends["input", 0] == pytest.approx(claim.acts.off[0])
    assert ends["estimate", 0] == 0


@pytest.fixture(scope="module")
def content(sampled: tuple[Spec, ProvedController]) -> dict[str, Any]:
    return design_certificate(*sampled)


def test_tubes_are_in_the_certificate_and_read_again(
    sampled: tuple[Spec, ProvedController], content: dict[str, Any]
) -> None:
    spec, controller = sampled
    claim = the_bounds(controller)
    said, faults = audit(json.dumps(content))
    assert not faults
    assert "the sampled loop: what 5 disturbances, noises and inputs leave is proved" in said
    (told,) = SampledBounds.read(content, controller, asking(spec, controller, claim.errors.gains))
    assert told.data(controller) == claim.data(controller)
    assert told.figures(spec.words, controller) == claim.figures(spec.words, controller)


def exchange(tubes: Any, one: str, other: str) -> None:
    """Say of each of two tubes that it is of the channel of the other."""
    first, second = (next(tube for tube in tubes if tube["channel"][0] == kind) for kind in (one, other))
    first["channel"], second["channel"] = second["channel"], first["channel"]


FORGED: dict[str, Callable[[Any], Any]] = {
    "a smaller bound": lambda t: t[0]["signals"][0].__setitem__(2, "1e-9"),
    "another channel": lambda t: t[0].update(channel=["disturbance", 0]),
    "a channel that there is not": lambda t: t[0].update(channel=["disturbance", 9]),
    "one of another kind": lambda t: t[0].update(channel=["start", 0]),
    "one twice": lambda t: t.append(t[0]),
    "another a": lambda t: t[0].update(a="3"),
    "no a": lambda t: t[0].update(a="0"),
    "a negative bound": lambda t: t[0]["signals"][0].__setitem__(2, "-9"),
    "a signal that there is not": lambda t: t[0]["signals"][0].__setitem__(1, 9),
    "knots that are missing": lambda t: t[0]["Q"].pop(),
    "knots in another order": lambda t: t[0]["Q"].reverse(),
    "no Q": lambda t: t[0].update(Q=[]),
    "a smaller Q": lambda t: t[0]["Q"].__setitem__(0, t[1]["Q"][0]),
    "b of 1": lambda t: t[[one["channel"][0] for one in t].index("noise")].update(b="1"),
    "another b": lambda t: t[[one["channel"][0] for one in t].index("noise")].update(b="0.5"),
    "a mean for a ripple": lambda t: exchange(t, "input", "ripple"),
    "what moves for a ripple": lambda t: exchange(t, "moved", "ripple"),
    "no b": lambda t: t[[one["channel"][0] for one in t].index("noise")].update(b="0"),
}


@pytest.mark.parametrize("what", FORGED)
def test_a_forged_tube_is_refused(what: str, content: dict[str, Any]) -> None:
    forged = copy.deepcopy(content)
    FORGED[what](forged["sampled_bounds"])
    assert audit(json.dumps(forged))[1]


def test_a_run_above_its_bound_is_a_numerical_error(sampled: tuple[Spec, ProvedController]) -> None:
    spec, controller = sampled
    result = simulate(spec, controller)
    assert result.outcome.kind != "above its bound"
    claim = the_bounds(controller)
    assert result.final_error < claim.ends_below(controller)["output", 0]
    small = {channel: replace(one, sizes=tuple(v * 1e-3 for v in one.sizes)) for channel, one in claim.tubes.items()}
    claims = tuple(replace(one, tubes=small) if one is claim else one for one in controller.claims)
    broken = simulate(spec, replace(controller, claims=claims))
    assert broken.outcome.kind == "above its bound"
