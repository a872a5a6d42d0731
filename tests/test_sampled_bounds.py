"""What is left of the errors of a sampled loop: against closed forms, worst cases that are built, and the loop."""

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_disturbances import row
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.clocked import Clocked
from pwatrack.lmi.clocked_tubes import Drive, tube
from pwatrack.lmi.tube_program import TubeProgram
from pwatrack.report.certificate import design_certificate
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
    assert {kind for kind, _ in claim.tubes} == {"disturbance", "noise", "input", "moved"}
    for channel, one in claim.tubes.items():
        c = row(claim.errors, ("output", 0)).floats
        found = worst_found(claim, channel, c, seed)
        assert 0.05 * one.sizes[0] < found <= one.sizes[0]


def test_what_acts_is_what_the_walk_shows_in_between(sampled: tuple[Spec, ProvedController]) -> None:
    """u_ff from fine samples, less its mean over each hold; x_d less what it was at the last substep."""
    spec, controller = sampled
    claim, trajectory = the_bounds(controller), controller.trajectory
    h, r, fine = claim.errors.gains.sample_time, claim.errors.gains.substeps, 40
    flow = desired_flow(controller.plant, trajectory)
    z0 = np.concatenate([[0.2, 0.0], trajectory.exosystem.w0, [1.0]])
    step = h / (r * fine)
    trace = simulate_flow(flow, z0, duration=spec.scenario.duration, sample_time=step)
    cell = trace.modes[:, 0]
    u = np.einsum("kmj,kj->km", trajectory.u_ff[cell], trace.z)[:, 0]
    x_d = np.einsum("knj,kj->kn", trajectory.x_d[cell], trace.z) @ claim.errors.R.floats.T
    count = len(u) // (r * fine) * (r * fine)
    holds = u[:count].reshape(-1, r * fine)
    off = float(np.abs(holds - holds.mean(axis=1, keepdims=True)).max())
    starts = x_d[:count, 0].reshape(-1, fine)
    moved = float(np.abs(starts - starts[:, :1]).max())
    assert 0.97 * off < claim.acts["input", 0] - 0.005 < 1.1 * off
    assert 0.95 * moved < claim.acts["moved", 0] < 1.05 * moved
    assert claim.acts["disturbance", 0 + 1] == pytest.approx(0.007, rel=1e-3)
    noise = np.abs(np.random.default_rng(1).normal(size=(601, 1)) * 1e-4).max()
    assert claim.acts["noise", 0] == pytest.approx(noise + 5e-6, rel=1e-3)


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
    assert "the sampled loop: what 4 disturbances, noises and inputs leave is proved" in said
    (told,) = SampledBounds.read(content, controller, asking(spec, controller, claim.errors.gains))
    assert told.data(controller) == claim.data(controller)
    assert told.figures(spec.words, controller) == claim.figures(spec.words, controller)


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
