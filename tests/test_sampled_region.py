"""Limits that a sampled loop reaches: from which starts errors settle all the same, between ticks too."""

import copy
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.claims.exact_text import decimal
from pwatrack.claims.region import LimitedRegion
from pwatrack.claims.registry import proved
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_region import SampledRegion
from pwatrack.commands.verify import verify
from pwatrack.control.candidates import Candidates
from pwatrack.control.controller import ProvedController
from pwatrack.control.headroom import InputConstraint
from pwatrack.control.program import program
from pwatrack.control.sampled_disturbances import drives
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.task import Task
from pwatrack.lmi import polynomial_region
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.clocked_region import ClockedRegion
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation.closed_loop import Response, closed_loop
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.workflow.pipeline import asked
from tests.test_cli import call

POLE = """
name: A pole that leans on a cushion
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  units: {z: rad, v: rad/s, u: N m, y: rad}
  sizes: {z: 0.3, v: 0.6, u: 2}
  A: [[0, 1], [4, -0.2]]
  B: [[0], [1]]
  C: [[1, 0]]
  nonlinearities: [{name: cushion, kind: spring, of: z, start: 0.2, slope: 3, into: {v: -1}}]
design: {tracking: state, MORE}
reference: {setpoint: {y: 0}}
simulation:
  duration: 12
  sample_time: 0.02
  controller: {sample_time: 0.02}
  actuator: {limits: {u: [-2, 2]}}
  initial: {plant: {z: 0.2}, observer: OBSERVER}
  ALSO
"""


def written(
    folder: Path, *, more: str = "", also: str = "", observer: str = "{z: 0.2}", rate: float = np.inf, delay: int = 0
) -> Path:
    path = folder / "pole.yaml"
    also += f"\n  rate_limit: {{u: {rate}}}" if np.isfinite(rate) else ""
    text = POLE.replace(", MORE", f", {more}" if more else "").replace("ALSO", also).replace("OBSERVER", observer)
    text = text.replace("{sample_time: 0.02}", f"{{sample_time: 0.02, delay: {delay}}}")
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module", autouse=True)
def ellipsoids() -> Iterator[None]:
    """Regions of the loop in continuous time by polynomials have tests of their own: here they only take time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(polynomial_region, "DEGREES", ())
        yield


@pytest.fixture(scope="module")
def pole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    spec = load_spec(written(tmp_path_factory.mktemp("pole")))
    return spec, design(spec)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    spec = load_spec(written(tmp_path_factory.mktemp("loaded"), more="estimate: input", also="disturbance: {v: 0.3}"))
    return spec, design(spec)


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    """Its input changes by 1 N m in a sample at most."""
    load = "disturbance: {v: 0.3}"
    path = written(tmp_path_factory.mktemp("slow"), more="estimate: input", also=load, rate=50)
    return load_spec(path), design(load_spec(path))


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    """What it puts out acts two samples later."""
    load = "disturbance: {v: 0.3}"
    path = written(tmp_path_factory.mktemp("late"), more="estimate: input", also=load, delay=2)
    return load_spec(path), design(load_spec(path))


def leaning(folder: Path, more: str = "") -> Path:
    """Its start is beyond what the region of the gain of least cost holds, where samples are long."""
    path = written(folder, more=more, observer="{z: 0.4, v: -1.6}")
    text = (
        path.read_text(encoding="utf-8").replace("plant: {z: 0.2}", "plant: {z: 0.4, v: -1.6}").replace("0.02", "0.1")
    )
    path.write_text(text, encoding="utf-8")
    return path


def scaled(controller: ProvedController) -> dict[str, float]:
    claim = controller.claim(SampledRegion)
    left = claim.left
    assert left is not None, claim.missing
    return {one.starts.kind: one.scale(left) for one in claim.found}


KEPT = "controller: {rate: largest, gain: 9}, estimate: input"  # a K that no other one stands in for


@pytest.fixture(scope="module")
def against(tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    """It has a gain against windup, which moves the estimate of its load too."""
    path = leaning(tmp_path_factory.mktemp("against"), KEPT)
    path.write_text(
        path.read_text(encoding="utf-8").replace("  initial", "  disturbance: {v: 0.3}\n  initial"), "utf-8"
    )
    return load_spec(path), design(load_spec(path))


def moved(gains: SampledGains, order: int, loads: int) -> Array:
    """What z = (x − x_d, ν, x̂ − x, ŝ − s, …) is moved by for 1 that is cut off.

    ν − (ŝ − s) is what is put out, or ν where inputs are late.
    """
    E, (m, n) = gains.into[:, 0], gains.K.shape
    found = np.zeros(order)
    found[n] = 1 + E[n:].sum() * (loads > 0 and not gains.delay)
    found[n + m : n + m + len(E)] = E
    return found


@pytest.mark.slow
@pytest.mark.parametrize("of", ["pole", "loaded", "slow", "late", "against"])
def test_no_start_on_the_edge_leaves_it_for_any_switching_with_limits_active(
    of: str, request: pytest.FixtureRequest
) -> None:
    _, controller = request.getfixturevalue(of)
    errors = controller.claim(SampledBounds).errors
    system, random, reached = errors.clocked, np.random.default_rng(4), 0
    slowed = 0
    F, (J,) = np.array([X.floats for X in system.vertices]), (X.floats for X in system.J)
    assert system.between is not None
    gains = errors.gains
    R, step = system.between.floats, gains.sample_time / system.parts
    more = moved(gains, errors.order, len(gains.M) - len(controller.plant.B))
    (before,) = drives(errors, (0,))
    D = before @ J
    for one in controller.claim(SampledRegion).found:
        held = one.held
        assert isinstance(held, ClockedRegion)
        P, (most, *change) = held.form, held.sizes
        change = change or [np.inf]
        edges = random.normal(size=(60, len(P))) @ np.linalg.inv(np.linalg.cholesky(P))
        towards = np.linalg.solve(P, D)
        edges[::2] += 4 * towards / np.sqrt(towards @ P @ towards)  # from there limits are reached soon
        for z in edges / np.sqrt(np.einsum("ki,ij,kj->k", edges, P, edges))[:, None]:
            at, value = z, 1.0
            for _ in range(40):
                slower = np.clip(D @ at, before @ at - change[0], before @ at + change[0])
                off = np.clip(slower, -most, most) - D @ at
                reached += off != 0
                slowed += slower != D @ at
                at = J @ at + more * off
                for part in range(system.parts):
                    for _ in range(2):
                        at = expm(F[random.integers(len(F))] * step / 2) @ at
                    at = at if part == system.parts - 1 else R @ at
                after = at @ P @ at
                assert after < value * (1 + 1e-9)
                value = after
    assert reached > 200
    assert slowed > 40 or of != "slow"
    assert len(gains.E) or of != "against"


def run_of_one_cell(path: Path, x: Array, x_hat: Array) -> tuple[SampledErrors, SampledGains, Response]:
    """What the errors of a loop obey without its cushion, with some gain against windup, and a run of its program."""
    text = "".join(line for line in path.read_text("utf-8").splitlines(True) if "nonlinearities" not in line)
    path.write_text(text, encoding="utf-8")
    spec = load_spec(path)
    controller = design(spec)
    errors, conditions = controller.claim(SampledBounds).errors, spec.scenario.conditions
    gains = replace(errors.gains, E=np.array([[0.01], [-0.02], [0.05]])[: len(errors.gains.M)])
    loop = closed_loop(controller, conditions, replace(program(controller, conditions), E=gains.E))
    start = loop.start(plant=x, observer=x_hat, generator=np.zeros(0))
    trace = simulate_flow(loop.flow, start, duration=2.0, sample_time=0.02, resets=loop.resets(2.0))
    return errors, gains, loop.response(trace)


@pytest.mark.parametrize("estimated", [False, True])
@pytest.mark.parametrize("delay", [1, 2])
def test_late_inputs_move_the_estimate_as_they_are_put_out(delay: int, estimated: bool, tmp_path: Path) -> None:
    """Of one cell, as the first input acts, with x̂ = x: from there z⁺ = J z + T (v − D z) is what the program does."""
    x = np.array([0.2, 0.3])
    path = written(tmp_path, more="estimate: input" if estimated else "", delay=delay)
    errors, gains, response = run_of_one_cell(path, x, x)
    (F,), (J,) = (X.floats for X in errors.clocked.vertices), (X.floats for X in errors.clocked.J)
    more, D = moved(gains, errors.order, len(gains.M) - 2), drives(errors, (0,))[0] @ J
    z, cut = np.zeros(errors.order), 0
    z[:2] = response.x[delay]
    for at, x_hat, u in zip(response.x[delay:], response.x_hat[delay:], response.u[delay:], strict=True):
        v = np.clip(D @ z, -2, 2)
        z, cut = J @ z + more * (v - D @ z), cut + (v != D @ z)
        assert [*z[:2], *z[3:5]] == pytest.approx([*at, *(x_hat - at)], abs=1e-9)
        assert u[0] == pytest.approx(v, abs=1e-9)
        z = expm(F * 0.02) @ z
    assert cut > 5


@pytest.mark.parametrize("estimated", [False, True])
def test_at_limits_the_errors_of_the_program_are_moved_by_its_gain_against_windup(
    estimated: bool, tmp_path: Path
) -> None:
    """Of one cell z obeys its matrices exactly: the program beside the plant, and z⁺ = J z + T (v − D z)."""
    load, x, x_hat = 0.3 * estimated, np.array([0.25, 0.3]), np.array([0.3, 0.2])
    path = written(tmp_path, more="estimate: input" if estimated else "", also="disturbance: {v: 0.3}" * estimated)
    errors, gains, response = run_of_one_cell(path, x, x_hat)
    (F,), (J,) = (X.floats for X in errors.clocked.vertices), (X.floats for X in errors.clocked.J)
    more, D = moved(gains, errors.order, len(gains.M) - 2), drives(errors, (0,))[0] @ J
    z, cut = np.zeros(errors.order), 0
    z[:2], z[3 : 3 + len(gains.M)] = x, [*(x_hat - x), -load][: len(gains.M)]
    for at, u in zip(response.x, response.u, strict=True):
        assert z[:2] == pytest.approx(at, abs=1e-9)
        v = np.clip(D @ z, -2 + load, 2 + load)  # u_ff is −load, where it is taken off
        assert u[0] == pytest.approx(v - load, abs=1e-9)
        cut += v != D @ z
        z = expm(F * 0.02) @ (J @ z + more * (v - D @ z))
    assert cut > 5


def test_a_gain_against_windup_is_made_where_inputs_are_late(tmp_path: Path) -> None:
    spec = load_spec(written(tmp_path, more="controller: {rate: largest, gain: 20}", delay=1))
    controller = design(spec)
    without = proved(replace(controller, claims=()), asked(spec, replace(controller, claims=())))
    assert len(controller.claim(SampledLoop).gains.E)
    assert scaled(controller)["exact"] > 1.2 * scaled(without)["exact"]
    content = design_certificate(spec, controller)
    assert not audit(json.dumps(content))[1]
    content["sampled"]["E"] = []
    assert audit(json.dumps(content))[1]


def test_a_gain_against_windup_is_made_where_K_is_to_stay(
    against: tuple[Spec, ProvedController], tmp_path: Path
) -> None:
    spec, controller = against
    loop, own = controller.claim(SampledLoop), asked(spec, replace(controller, claims=()))
    assert loop.cheaper is None
    without = proved(replace(controller, claims=()), own)
    assert np.array_equal(without.claim(SampledLoop).gains.K, loop.gains.K)
    assert not len(without.claim(SampledLoop).gains.E)
    assert scaled(controller)["run"] > 1.1 * scaled(without)["run"]
    assert any("against windup" in text for _, text in loop.rows(spec.words, controller))
    content = design_certificate(spec, controller)
    assert not audit(json.dumps(content))[1]
    told = proved(replace(controller, claims=()), own, told=content).claim(SampledLoop)
    assert [*told.rows(spec.words, controller)] == [*loop.rows(spec.words, controller)]
    E = content["sampled"]["E"]
    for forged in ([], times(E, 3), [*E[:2], ["0"]], E[:2]):
        content["sampled"]["E"] = forged
        assert audit(json.dumps(content))[1]


def runs(controller: ProvedController, x: Array, x_hat: Array, push: Conditions) -> Array:
    """Return |x| at the end of a run of the program itself beside the plant."""
    loop = closed_loop(controller, push)
    rest = np.zeros(len(controller.L) - len(x))
    response = loop.response(
        simulate_flow(
            loop.flow,
            loop.start(plant=x, observer=x_hat, generator=rest[:0]),
            duration=12.0,
            sample_time=0.02,
        )
    )
    assert (np.abs(response.u) <= 2 + 1e-12).all()
    return np.asarray([np.abs(response.x[-1] - response.x_d[-1]).max(), np.abs(response.u).max()])


def test_the_program_itself_settles_from_the_edge_and_not_from_far_beyond(pole: tuple[Spec, ProvedController]) -> None:
    _, controller = pole
    share, limits = (
        scaled(controller)["exact"],
        Conditions(limits=np.array([[-2.0, 2.0]]), sampling=Sampling(sample_time=0.02)),
    )
    size = np.array([0.3, 0.6])
    ends = [
        runs(controller, x, x, limits) for x in (share * size * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1]])).round(9)
    ]
    assert max(end[0] for end in ends) < 1e-3
    assert max(end[1] for end in ends) == 2.0  # the limit is reached
    assert runs(controller, 4 * share * size, 4 * share * size, limits)[0] > 0.5


def test_it_is_nearly_what_an_ellipsoid_of_the_loop_in_continuous_time_has(
    pole: tuple[Spec, ProvedController],
) -> None:
    _, controller = pole
    claim = controller.claim(LimitedRegion)
    left = claim.room.spare
    assert left is not None
    for one in claim.found:
        assert scaled(controller)[one.starts.kind] > 0.8 * one.scale(left)


def test_what_acts_is_taken_off_the_limits(tmp_path: Path, pole: tuple[Spec, ProvedController]) -> None:
    """Noise takes of the room what it makes of the input; much noise takes all of it."""
    shares = {0.0: scaled(pole[1])["exact"]}
    for noise in (1e-3, 4e-3):
        path = written(tmp_path, also=f"noise: {{std: {{y: {noise}}}, sample_time: 0.02, seed: 1}}")
        shares[noise] = scaled(design(load_spec(path)))["exact"]
    assert shares[0.0] > shares[1e-3] > shares[4e-3] > 0
    claim = design(load_spec(written(tmp_path, also="noise: {std: {y: 0.1}, sample_time: 0.02, seed: 1}"))).claim(
        SampledRegion
    )
    assert claim.missing == "what acts takes all that is left of the limits"
    assert not claim.found


def test_a_run_that_begins_on_its_reference_settles_with_no_region(tmp_path: Path) -> None:
    """What acts takes less than the limits, so none is reached; nothing of it is in the certificate."""
    noise, path = "noise: {std: {y: 1e-3}, sample_time: 0.02, seed: 1}", written(tmp_path, also="NOISE", observer="{}")
    path.write_text(path.read_text().replace("NOISE", noise).replace("plant: {z: 0.2}", "plant: {}"), encoding="utf-8")
    controller = design(load_spec(path))
    claim = controller.claim(SampledRegion)
    (one,) = (one for one in claim.found if one.starts.kind == "run")
    assert (one.held, claim.from_this_start(controller)) == (None, True)
    content = design_certificate(load_spec(path), controller)
    assert [entry["of"] for entry in content["sampled_regions"]] == [one.starts.kind for one in claim.found if one.held]
    assert call("design", path, "--out", tmp_path / "out").exit_code == 0
    assert call("verify", tmp_path / "out").exit_code == 0


@pytest.mark.parametrize("limit", [1.0, 1.0 - 5e-7])
def test_where_the_feedforward_takes_a_whole_limit_a_start_on_the_reference_is_in_no_region(
    limit: float, tmp_path: Path
) -> None:
    """It is unstable there: any error at all would leave it."""
    path = tmp_path / "pole.yaml"
    text = POLE.replace(", MORE", "").replace("  ALSO\n", "").replace("[-2, 2]", f"[{-4 * limit}, {4 * limit}]")
    text = text.replace(
        "nonlinearities: [{name: cushion, kind: spring, of: z, start: 0.2, slope: 3, into: {v: -1}}]", ""
    )
    text = text.replace("reference: {setpoint: {y: 0}}", "reference: {setpoint: {y: -1}}")
    path.write_text(text.replace("{z: 0.2}", "{z: -1}").replace("OBSERVER", "{z: -1}"), encoding="utf-8")
    controller = design(load_spec(path))
    claim = controller.claim(SampledRegion)
    assert not claim.found
    assert not claim.from_this_start(controller)


def test_of_a_run_it_is_said_with_what_noise_adds_to_the_first_estimate(tmp_path: Path) -> None:
    noise = "noise: {std: {y: 1e-3}, sample_time: 0.02, seed: 1}"
    given = design(load_spec(written(tmp_path, also=noise))).claim(SampledRegion)
    measured = design(load_spec(written(tmp_path, also=noise, observer="measured"))).claim(SampledRegion)
    (one,), (other,) = ([g for g in claim.found if g.starts.kind == "run"] for claim in (given, measured))
    assert one.starts.delta is None
    assert other.starts.delta is not None
    assert other.starts.delta.shape[1] == one.starts.e.shape[1] + 1
    assert 1e-3 < other.starts.delta[0, -1] < 5e-3


def test_loads_take_their_part(pole: tuple[Spec, ProvedController], loaded: tuple[Spec, ProvedController]) -> None:
    """One of 0.3 N m is taken off the limits of 2 N m; the run with it comes to them, and settles."""
    spec, controller = loaded
    assert set(scaled(controller)) == {"exact", "sizes", "run"}
    assert 1 <= scaled(controller)["run"] < scaled(pole[1])["run"]
    result = simulate(spec)
    assert np.abs(result.response.u).max() == 2.0
    assert np.abs(result.response.x[-1]).max() < 1e-3


@pytest.mark.slow
def test_where_inputs_are_late_it_is_said_of_errors_as_the_first_one_acts(tmp_path: Path) -> None:
    """Without an input the plant falls for two samples; from the edge as these end the program itself settles.

    So it does from the start of the run, which is within what is proved of it.
    """
    path, size = written(tmp_path, delay=2), np.array([0.3, 0.6])
    controller = design(load_spec(path))
    assert set(scaled(controller)) == {"exact", "run"}
    assert scaled(controller)["run"] > 1
    run = simulate(load_spec(path), controller)
    assert np.abs(run.response.u).max() == 2.0
    assert run.final_error < 1e-3
    late = Conditions(limits=np.array([[-2.0, 2.0]]), sampling=Sampling(sample_time=0.02, delay=2))
    corners = scaled(controller)["exact"] * size * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1], [4, 4]])
    before = [solve_ivp(falls, (0.04, 0), e, rtol=1e-12, atol=1e-14).y[:, -1] for e in corners]
    *ends, beyond = (runs(controller, x, x, late)[0] for x in before)
    assert max(ends) < 1e-3
    assert beyond > 0.5
    said = call("design", path, "--out", tmp_path / "out", "--verbose").stdout
    assert "and x̂ = x, as the first input acts, with inputs at their limits too" in " ".join(said.split())
    assert "errors go to 0 from the start of this run, with inputs at their limits too" in " ".join(said.split())
    assert verify(tmp_path / "out", path)


def falls(_: float, x: Array) -> Array:
    """The pole by itself, written again."""
    z, v = x
    return np.array([v, 4 * z - 0.2 * v - 3 * max(z - 0.2, 0.0)])


@pytest.mark.slow
def test_the_faster_an_input_may_change_the_more_is_proved_and_the_program_settles_from_there(
    tmp_path: Path, pole: tuple[Spec, ProvedController]
) -> None:
    size, shares = np.array([0.3, 0.6]), [0.0]
    for rate in (10, 50, 500):
        path = written(tmp_path, rate=rate)
        controller = design(load_spec(path))
        shares.append(scaled(controller)["exact"])
        limits = Conditions(limits=np.array([[-2.0, 2.0]]), rates=np.array([rate]), sampling=Sampling(sample_time=0.02))
        corners = shares[-1] * size * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1]])
        assert max(runs(controller, x, x, limits)[0] for x in corners.round(9)) < 1e-3
    said = call("design", path, "--out", tmp_path / "out", "--verbose").stdout
    assert "and x̂ = x, with inputs and their rates at their limits too" in " ".join(said.split())
    assert verify(tmp_path / "out", path)
    assert shares == sorted(shares)
    assert scaled(pole[1])["exact"] > 0.95 * shares[-1]
    assert runs(controller, 4 * size, 4 * size, limits)[0] > 0.5


@pytest.mark.slow
def test_what_acts_and_the_first_input_are_taken_off_what_it_may_change_by(tmp_path: Path) -> None:
    """By noise an input changes; and from 0 on it is to be at its feedforward."""
    noise = "noise: {std: {y: 1e-3}, sample_time: 0.02, seed: 1}"
    quiet, loud = (
        design(load_spec(written(tmp_path, also=also, rate=50))).claim(SampledRegion) for also in ("", noise)
    )
    assert quiet.changes is not None
    assert loud.changes is not None
    assert quiet.changes[0] == pytest.approx(1)
    assert 0.5 < loud.changes[0] < 0.95
    path = written(tmp_path, rate=50)
    path.write_text(path.read_text(encoding="utf-8").replace("{y: 0}", "{y: 0.1}"), encoding="utf-8")
    assert design(load_spec(path)).claim(SampledRegion).changes == pytest.approx([0.6])  # of u_ff = −0.4
    path.write_text(path.read_text(encoding="utf-8").replace("{u: 50}", "{u: 15}"), encoding="utf-8")
    refused = design(load_spec(path)).claim(SampledRegion)
    assert refused.missing == "what acts, or how x_d begins, takes all that an input may change by"
    assert not refused.found


@pytest.mark.slow
def test_of_another_plant_nothing_is_said_of_this_start(tmp_path: Path) -> None:
    """The pole falls faster than the one of the design: it runs away, and what is proved is of the other."""
    path = tmp_path / "pole.yaml"
    text = written(tmp_path, also="plant: {parameters: {g: 12}}").read_text(encoding="utf-8")
    text = text.replace("\nsystem:", "\nparameters: {g: 4}\nsystem:").replace("[4, -0.2]", "[g, -0.2]")
    path.write_text(text.replace("slope: 3", "slope: 0.1"), encoding="utf-8")
    run = call("simulate", path, "--out", tmp_path / "out")
    said = " ".join(run.stdout.split())
    assert run.exit_code == 6
    assert "u is at a limit" in said
    assert "from this start" not in said
    long = " ".join(call("design", path, "--out", tmp_path / "out", "--verbose").stdout.split())
    for row in long.split("in the sampled loop ")[1:]:
        assert (
            "plant as designed" in row.split(" limits")[0] or "with inputs at their limits too, with the plant" in row
        )
    assert "in this run nothing acts on the sampled loop: its errors go to 0, but for rounding, with the plant" in long
    assert "proved while no input is at a limit, with the plant as designed" in " ".join(
        call("design", path, "--out", tmp_path / "out").stdout.split()
    )


def test_a_plant_that_is_stable_by_itself_settles_from_every_start(tmp_path: Path) -> None:
    path = written(tmp_path)
    text = path.read_text(encoding="utf-8").replace("[4, -0.2]", "[-4, -1]")
    path.write_text(text, encoding="utf-8")
    said = call("design", path, "--out", tmp_path / "out", "--verbose").stdout
    assert "in the sampled loop errors go to 0 from every start" in " ".join(said.split())
    assert verify(tmp_path / "out", path)


@pytest.fixture(scope="module")
def certificate(loaded: tuple[Spec, ProvedController]) -> dict[str, Any]:
    return design_certificate(*loaded)


def test_it_is_audited(certificate: dict[str, Any], late: tuple[Spec, ProvedController]) -> None:
    for content, boxes in ((certificate, 3), (design_certificate(*late), 2)):
        said, faults = audit(json.dumps(content))
        assert not faults
        own = f"errors of the sampled loop, less what all that acts makes of them, go to 0 from {boxes} boxes of starts"
        assert any(text.startswith(own) for text in said)


def times(rows: list[list[str]], factor: float) -> list[list[str]]:
    return [[decimal(float(v) * factor) for v in row] for row in rows]


def test_a_row_of_a_change_is_audited(slow: tuple[Spec, ProvedController]) -> None:
    content = design_certificate(*slow)
    assert not audit(json.dumps(content))[1]
    forgeries: list[tuple[int, Any, str]] = [
        (1, lambda entry: entry["signals"][1].__setitem__(2, "0.001"), "change 0 is not bounded by 0.001"),
        (1, lambda entry: entry["signals"][1].__setitem__(0, "drive"), "a signal is there twice"),
        (0, lambda entry: entry["signals"][0].__setitem__(0, "change"), "a signal is there twice"),
        (1, lambda entry: entry["H"].reverse(), "sampled region 1: "),
        (1, lambda entry: entry["H"].__setitem__(1, ["0"] * len(entry["H"][1])), "a tick makes its form grow"),
    ]
    for place, change, fault in forgeries:
        forged = copy.deepcopy(content)
        forged["sampled_regions"] = forged["sampled_regions"][place:][:1]
        change(forged["sampled_regions"][0])
        assert any(fault in one for one in audit(json.dumps(forged))[1]), fault


def test_a_start_with_all_that_was_predicted_is_audited(late: tuple[Spec, ProvedController]) -> None:
    content = design_certificate(*late)
    (entry,) = (one for one in content["sampled_regions"] if one["of"] == "run")
    content["sampled_regions"] = [entry]
    assert any(any(float(v) for v in row) for row in entry["starts"][6:9])  # what was predicted a sample before
    assert not audit(json.dumps(content))[1]
    forgeries: list[tuple[Any, str]] = [
        (times(entry["starts"], 1e3), "a start is not in the region"),
        ([*entry["starts"][:-1], ["0.1"] * len(entry["weights"])], "what a substep moves"),
    ]
    for starts, fault in forgeries:
        entry["starts"] = starts
        assert any(fault in one for one in audit(json.dumps(content))[1]), fault


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (
            lambda entry: entry["signals"][0].__setitem__(2, "0.001"),
            "sampled region 1: drive 0 is not bounded by 0.001",
        ),
        (
            lambda entry: entry.update(starts=times(entry["starts"], 1.2)),
            "sampled region 1: a start is not in the region",
        ),
        (
            lambda entry: entry.update(H=times(entry["H"], 0.3)),
            "sampled region 1: a tick makes its form grow",
        ),
        (lambda entry: entry["P"].reverse(), None),
        (lambda entry: entry["starts"].__setitem__(2, ["0.1"] * len(entry["weights"])), None),
    ],
)
def test_what_is_forged_is_found_out(change: Any, fault: str | None, certificate: dict[str, Any]) -> None:
    forged = copy.deepcopy(certificate)
    (entry,) = (one for one in forged["sampled_regions"] if one["of"] == "sizes")
    forged["sampled_regions"] = [entry]
    change(entry)
    _, faults = audit(json.dumps(forged))
    assert faults
    assert fault is None or any(one.startswith(fault) for one in faults), faults


@pytest.mark.slow
def test_a_smaller_K_is_made_for_the_start_of_a_run_where_that_of_least_cost_does_not_do(tmp_path: Path) -> None:
    path = leaning(tmp_path)
    spec = load_spec(path)
    controller = design(spec)
    loop, own = controller.claim(SampledLoop), asked(spec, replace(controller, claims=()))
    assert loop.cheaper is not None
    assert own.sampled is not None
    assert np.array_equal(loop.cheaper, own.sampled.K)
    before = proved(replace(controller, claims=()), own)
    assert scaled(before)["run"] < 1 <= scaled(controller)["run"]
    norms = [float(np.linalg.norm(controller.sizes.gain(K), 2)) for K in (loop.gains.K, loop.cheaper)]
    assert norms[0] < norms[1]
    (said,) = (text for _, text in loop.rows(spec.words, controller) if "inputs at limits" in text)
    assert f"{norms[1] / norms[0]:.2g} times smaller" in said
    assert simulate(spec, controller).outcome.kind == "tracks"
    call("design", str(path), "--out", str(tmp_path / "out"))
    verify(tmp_path / "out" / "certificate.json", path)
    content = json.loads((tmp_path / "out" / "certificate.json").read_text())
    told = proved(replace(controller, claims=()), own, told=content)
    assert [*told.claim(SampledLoop).rows(spec.words, told)] == [*loop.rows(spec.words, controller)]


@pytest.mark.slow
@pytest.mark.parametrize("more", ["controller: {K: [[-11, -6]]}", "controller: {rate: largest, gain: 9}"])
def test_a_K_that_is_given_or_sought_otherwise_stays(more: str, tmp_path: Path) -> None:
    spec = load_spec(leaning(tmp_path, more))
    controller = design(spec)
    loop = controller.claim(SampledLoop)
    assert loop.cheaper is None
    other = replace(loop.gains, K=loop.gains.K * 0.9)
    content = design_certificate(spec, replace(controller, claims=(replace(loop, gains=other),)))
    bare = replace(controller, claims=())
    with pytest.raises(ValueError, match="not those of its certificate"):
        proved(bare, asked(spec, bare), told=content)


@pytest.mark.parametrize("h", [0.05, 0.5, 1.0])
def test_of_one_state_a_gain_for_held_inputs_brings_nearly_all_to_0_that_any_input_can(h: float) -> None:
    """z' = a z + v with |v| ≤ 1 can be brought to 0 from |z| < 1 / a, however long v is held."""
    task = Task(A=np.array([[[0.5]]]), B=np.eye(1), cells=["all"])
    within = InputConstraint(starts=[np.eye(1)], left=np.ones(1), over=8.0)
    found = Candidates(task).farthest_held(within, h)
    assert found is not None
    turn, push = np.exp(0.5 * h), np.expm1(0.5 * h) / 0.5
    z = np.array([0.99, 0.5, 0.1]) / 0.5
    for _ in range(int(400 / h)):
        z = turn * z + push * np.clip(found.K[0, 0] * z, -1, 1)
    assert np.abs(z).max() < 1e-9
