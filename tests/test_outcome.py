"""How a simulation ended: figures by figures, and never "proved" above a loop that fails."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pwatrack import load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.batch.run import run_batch
from pwatrack.report.terminal import told
from pwatrack.simulation.closed_loop import ClosedLoop, Response
from pwatrack.simulation.trace import Trace, tenths
from pwatrack.workflow.outcome import grows
from tests.test_cli import call, index_of

T = np.linspace(0.0, 1.0, 1001)

CART = """
name: Cart
parameters: {m: 1, k: 0, Ts: 0.01, limit: 1e6, push: 0}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  units: {z: m, v: m/s, u: N, y: m}
  A: [[0, 1], [k/m, 0]]
  B: [[0], [1/m]]
  C: [[1, 0]]
  nonlinearities:
    - {name: stop, kind: spring, of: z, start: 0.1, slope: 10, into: {v: -1/m}}
design:
  controller: {K: [[-4, -3]]}
  observer: {L: [[-10], [-30]]}
reference: {output: "REFERENCE"}
simulation:
  duration: 20
  sample_time: 0.02
  initial: {plant: [0.05, 0]}
"""

ROD = """
name: Rod
system: {states: [th, w], inputs: [u], outputs: [y], A: [[0, 1], [4, -1]], B: [[0], [1]], C: [[1, 0]]}
design: {tracking: state}
reference: {input: ["0.1*sin(t)"], start: [0, 0]}
simulation: {duration: 8, sample_time: 0.01}
"""


def cart(folder: Path, *conditions: str, reference: str = "0.08*sin(t)", duration: float = 20) -> Path:
    text = CART.replace("REFERENCE", reference).replace("duration: 20", f"duration: {duration}")
    path = folder / "cart.yaml"
    path.write_text(text + "".join(f"  {condition}\n" for condition in conditions), encoding="utf-8")
    return path


def rises(signal: Array, size: float) -> bool:
    parts = np.split(signal, tenths(len(signal))[1:-1])
    return grows(np.array([part.max() for part in parts]), np.array([part.min() for part in parts]), size)


@given(st.integers(10, 10_000))
def test_the_tenths_are_ten_in_order_and_differ_by_one_sample_at_most(samples: int) -> None:
    edges = tenths(samples)
    assert (edges[0], edges[10]) == (0, samples)
    lengths = np.diff(edges)
    assert lengths.min() >= 1
    assert lengths.max() - lengths.min() <= 1
    assert edges[9] == samples - -(-samples // 10)


@given(st.floats(1.0, 200.0), st.floats(0.0, 300.0), st.floats(0.0, 6.28), st.floats(1e-6, 1e6))
def test_what_grows_exponentially_is_seen_when_it_has_grown(
    rate: float, frequency: float, phase: float, size: float
) -> None:
    """x' = εx from its start, and an oscillation of some periods in a tenth of the time that swells likewise."""
    swing = np.cos(frequency * T + phase) if frequency > 100 else 1.0
    assert rises(size * np.exp(rate * T) * swing, size)


def is_largest_at_the_end(signal: Array, size: float) -> bool:
    """The largest size in the last tenth is above that of every tenth before it, and above the size."""
    *before, last = (np.abs(part).max() for part in np.split(signal, tenths(len(signal))[1:-1]))
    return bool(last > max(size, *before))


@given(st.floats(0.25, 1.0), st.floats(200.0, 300.0), st.floats(0.0, 6.28), st.booleans())
def test_what_grows_slowly_from_its_start_is_seen(rate: float, frequency: float, phase: float, swings: bool) -> None:
    """x' = εx grows by no more than e^ε; each tenth is above the one before it.

    There are so many samples that none misses a peak by much.
    """
    t = np.linspace(0.0, 1.0, 10_001)
    assert rises(np.exp(rate * t) * (np.cos(frequency * t + phase) if swings else 1.0), 1.0)


def test_to_be_largest_at_the_end_is_not_to_grow() -> None:
    """Loops that are held, whose error happens to be largest in the last tenth; and one that is not held."""
    beat = np.cos(100 * T) + np.cos((100 + np.pi) * T + np.pi)
    settling = 1 - np.exp(-3 * T)
    noise = np.random.default_rng(2).normal(size=len(T))
    for held in (beat, settling, noise, 1 + 0.05 * T):
        assert is_largest_at_the_end(held, 0.0)
        assert not rises(held, 0.0)
    assert is_largest_at_the_end(np.exp(0.25 * T), 1.0)
    assert rises(np.exp(0.25 * T), 1.0)


@given(st.floats(0.0, 300.0), st.floats(0.0, 6.28), st.floats(0.0, 200.0), st.floats(-1.0, 1.0), st.integers(0, 10))
def test_what_oscillates_decays_or_is_noise_does_not_grow(
    frequency: float, phase: float, rate: float, share: float, seed: int
) -> None:
    assume(frequency == 0 or frequency > 4 * np.pi)
    noise = np.random.default_rng(seed).normal(size=len(T))
    signal = np.sin(frequency * T + phase) + share * np.exp(-rate * T) + 0.1 * noise
    assert not rises(signal, 0.0)
    assert not rises(noise, 0.0)


@given(st.floats(0.4, 1000.0), st.floats(-10.0, 10.0), st.floats(-10.0, 10.0))
def test_what_settles_at_a_value_does_not_grow(rate: float, start: float, end: float) -> None:
    """Time constants up to 2.5 times the run; what is even less settled cannot be told from a drift."""
    assert not rises(end + (start - end) * np.exp(-rate * T), abs(start))


@given(st.floats(0.1, 10.0), st.floats(0.0, 300.0))
def test_what_stays_below_reference_and_start_does_not_grow(rate: float, frequency: float) -> None:
    """An error that follows a reference of growing amplitude at a distance."""
    signal = np.exp(rate * T) * np.cos(frequency * T)
    assert not rises(0.5 * signal, np.abs(signal).max())


def test_what_drifts_grows() -> None:
    assert rises(T, 0.5)
    assert rises(T**2, 0.5)
    assert not rises(T, 2.0)


def test_a_nominal_run_tracks_whatever_its_length(tmp_path: Path) -> None:
    """The proved bound goes to 0, so that no error of it grows, however short the run."""
    for duration in (0.2, 1.0, 20.0):
        result = simulate(load_spec(cart(tmp_path, duration=duration)))
        assert result.outcome.kind == ("tracks" if duration == 20 else "off")
        assert result.outcome.code == 0


def test_a_disturbed_run_is_bounded_by_its_proof_and_only_off(tmp_path: Path) -> None:
    result = simulate(load_spec(cart(tmp_path, "disturbance: {v: {constant: 3}}", reference="0*t", duration=0.5)))
    assert (result.outcome.kind, result.outcome.code) == ("off", 0)
    assert "y − y_d" in result.outcome.text


def test_what_is_left_is_measured_by_reference_and_start_and_not_by_an_earlier_error(tmp_path: Path) -> None:
    """After a heavy push 1 % of it is left, which is more than all of the reference."""
    push = "disturbance: {v: {trapezoid: {high: 3000, rise: 0.2, hold: 0.1, fall: 0.2, rest: 99, smooth: 0.1}}}"
    result = simulate(load_spec(cart(tmp_path, push, duration=5.5)))
    error = np.abs(result.response.tracking_error)
    assert 0.08 < error[-28:].max() < 0.01 * error.max()
    assert result.outcome.kind == "off"


def lines(stdout: str) -> list[str]:
    """Return the rows of the summary, each with what is folded below it."""
    rows: list[str] = []
    for line in stdout.splitlines():
        if line[:1].strip():
            rows.append(" ".join(line.split()))
        else:
            rows[-1] += " " + " ".join(line.split())
    return rows


RUNAWAY = {
    "other parameters": "plant: {parameters: {k: 12}}",  # it pushes harder than K and the stop pull
    "and sampled": "plant: {parameters: {k: 12}}\n  controller: {sample_time: 0.02}",  # no sample time would help
}


@pytest.mark.slow
@pytest.mark.parametrize("condition", RUNAWAY.values(), ids=RUNAWAY)
def test_a_loop_that_runs_away_ends_with_6_and_all_its_files(tmp_path: Path, condition: str) -> None:
    path = cart(tmp_path, condition, reference="0.08*cos(t)")
    run = call("simulate", path, "--out", tmp_path / "out", pictures=True)
    assert run.exit_code == 6, run.output
    assert f"error: {path}: the error grows: |y − y_d| up to" in run.stderr
    title, first, *_ = lines(run.stdout)
    assert title == f"Cart: NOT READY: grows; without {'' if 'sample_time' in condition else 'sampling, '}limits, noise"
    assert re.match(r"simulated the error grows: \|y − y_d\| up to", first)
    assert "NOT proved for other k = 12" in " ".join(run.stdout.split())
    _, first, second, third, *_ = lines((tmp_path / "out" / "summary.txt").read_text(encoding="utf-8"))
    assert first.startswith("simulated 20 s: the error grows: |y − y_d| up to")
    said = [second, third]
    assert any(one.startswith("proofs are about the loop without: ") for one in said)
    index = index_of(tmp_path / "out")
    assert (index["verdict"], index["exit"], index["simulation"]["outcome"]) == ("proved", 6, "grows")
    assert {"trace.csv", "certificate.json", "tracking_error.png"} < set(index["files"])


LATE = "disturbance: {v: {step: {size: 3, at: 19.5, smooth: 0.1}}}"


@pytest.mark.parametrize("other", ["", "  plant: {parameters: {k: 12}}\n"])
def test_a_disturbance_that_comes_late_does_not_make_a_loop_grow_and_hides_none_that_does(
    tmp_path: Path, other: str
) -> None:
    """In the loop as designed its error is bounded; a little of it is seen, and is by far the largest so far."""
    path = cart(tmp_path, "controller: {sample_time: 0.001}", LATE, reference="0*t")
    path.write_text(path.read_text().replace("plant: [0.05, 0]", "plant: [1e-3, 0]") + other, encoding="utf-8")
    result = simulate(load_spec(path))
    error = result.response.tracking_error[:, 0]
    assert rises(error, 1e-3)
    assert (result.outcome.kind, result.outcome.code) == (("grows", 6) if other else ("off", 0))


@pytest.mark.slow
def test_a_batch_fails_on_what_grows_and_says_what(tmp_path: Path) -> None:
    cart(tmp_path, RUNAWAY["other parameters"], duration=2)
    (outcome,) = run_batch(tmp_path, tmp_path / "batch")
    assert (outcome.exit, outcome.code, outcome.verdict) == (6, 6, "check failed")
    assert outcome.figures["norm_K"] == pytest.approx(0.809, rel=1e-3)  # in sizes
    assert any(note.startswith("the error grows") for note in outcome.notes)


def test_a_loop_whose_limits_are_too_tight_is_led_by_how_far_off_it_is(tmp_path: Path) -> None:
    limits, push = "actuator: {limits: {u: [-0.1, 0.1]}}", "disturbance: {v: {constant: 0.5}}"
    path = cart(tmp_path, limits, push, reference="0.08*sin(t)")
    run = call("simulate", path, "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    _, first, *_ = lines(run.stdout)
    how = "simulated 20 s, limits, disturbance: does NOT track, largest error"
    assert re.match(how + r" \S+ m in the last tenth; \S+ m at worst; ('tracks': ≤ 1 %|…)", first)
    assert "NOT proved for u limited to [-0.1, 0.1] N" in lines(run.stdout)
    said = lines((tmp_path / "out" / "summary.txt").read_text(encoding="utf-8"))
    assert "proofs are about the loop without: u limited to [-0.1, 0.1] N; disturbance on dv/dt" in said
    assert index_of(tmp_path / "out")["simulation"]["outcome"] == "off"


def test_a_good_run_says_so_in_a_line(tmp_path: Path) -> None:
    run = call("simulate", cart(tmp_path), "--out", tmp_path / "out")
    _, first, second, third, *_ = lines(run.stdout)
    said = r"simulated 20 s, ideal loop: tracks, largest error \S+ m( \(rounding\))? in the last tenth; \S+ m"
    assert re.match(said, first)
    assert re.match(r"question a mode at 3.16 rad/s has damping 0;", second)  # the file has none
    assert re.match(r"ideal loop proved: error to 0 from every start, time constant \S+ s; ", third)
    assert index_of(tmp_path / "out")["simulation"]["outcome"] == "tracks"


def test_a_loop_beyond_all_bounds_keeps_its_design(tmp_path: Path) -> None:
    path = cart(tmp_path, "plant: {parameters: {k: 600}}")
    run = call("simulate", path, "--out", tmp_path / "out")
    assert run.exit_code == 6, run.output
    index = index_of(tmp_path / "out")
    assert (index["verdict"], index["exit"], index["simulation"]["outcome"]) == ("proved", 6, "broken off")
    made = {"bounds.json", "gains.json", "certificate.json", "generator.json", "controller.json", "spec.txt"}
    assert run.stdout == ""  # what failed is said alone
    assert {*index["files"]} == made
    assert "1e+100" in index["simulation"]["said"]


@pytest.mark.parametrize("kept", [250_000, 60])
def test_a_run_above_its_own_bound_ends_with_6_also_where_the_sample_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    """One sample of the error is raised by hand: no proof of the loop allows it."""
    response = ClosedLoop.response

    def spoiled(self: ClosedLoop, trace: Trace) -> Response:
        read = response(self, trace)
        raised = read.tracking_error + 1e-3 * (np.abs(read.t - 15.02) < 1e-9)[:, None]
        return replace(read, tracking_error=raised)

    monkeypatch.setattr("pwatrack.workflow.pipeline.MOST_KEPT", kept)
    assert simulate(load_spec(cart(tmp_path))).outcome.kind == "tracks"
    monkeypatch.setattr(ClosedLoop, "response", spoiled)
    outcome = simulate(load_spec(cart(tmp_path))).outcome
    assert (outcome.kind, outcome.code) == ("above its bound", 6)
    assert "|y − y_d| is 0.001 at t = 15.02 s, where at most" in outcome.text


def test_an_observer_above_its_bound_is_seen_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Response, "observer_error", property(lambda self: 1e-6 * np.ones(len(self.t))))
    outcome = simulate(load_spec(cart(tmp_path))).outcome
    assert (outcome.kind, "‖x̂ − x‖ is 1e-06" in outcome.text) == ("above its bound", True)


def test_rounding_is_not_above_a_bound(specs: Path) -> None:
    """Started on its reference, a loop is proved to stay there exactly; large offsets leave large rounding."""
    for name in ("rectifier_load", "two_pumps_two_tanks"):
        assert simulate(load_spec(specs / "gallery" / f"{name}.yaml")).outcome.kind == "tracks"


@pytest.mark.slow
def test_a_desired_trajectory_that_grows_is_no_tracking(tmp_path: Path) -> None:
    """u_ff drives an unstable plant from a given start: x_d leaves, and the plant would follow it."""
    path = tmp_path / "rod.yaml"
    path.write_text(ROD, encoding="utf-8")
    for command in ("design", "simulate"):
        run = call(command, path, "--out", tmp_path / command, pictures=True)
        assert run.exit_code == 6, run.output
        assert re.match(rf"error: {path}:\d+:\d+: x_d grows without bound, as far as can be seen: \|", run.stderr)
    assert index_of(tmp_path / "design")["verdict"] == "check failed"
    _title, first, *_ = lines(run.stdout)
    assert first.startswith("simulated x_d grows without bound, as far as can be seen")
    assert "NOT proved that x_d is bounded and what was asked for: it is not" in lines(run.stdout)
    said = lines((tmp_path / "simulate" / "summary.txt").read_text(encoding="utf-8"))
    assert "proofs are about an x_d that is bounded and what was asked for; this one is not" in said
    index = index_of(tmp_path / "simulate")
    assert (index["verdict"], index["exit"], index["simulation"]["outcome"]) == ("proved", 6, "grows")
    assert {"trace.csv", "outputs.png"} < set(index["files"])
    assert run_batch(tmp_path, tmp_path / "batch")[0].exit == 6


def test_the_outcome_does_not_depend_on_the_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = cart(tmp_path, RUNAWAY["other parameters"])
    whole = simulate(load_spec(path)).outcome
    monkeypatch.setattr("pwatrack.workflow.pipeline.MOST_KEPT", 37)
    assert simulate(load_spec(path)).outcome == whole


def test_too_little_memory_is_no_bug_and_says_what_was_too_large() -> None:
    try:
        np.empty(10**17)
    except MemoryError as error:
        code, (said, hint) = told(error)
    assert code == 1
    assert re.fullmatch(r"error: out of memory: Unable to allocate .* \(test_outcome.py:\d+\) \[P100\]", said)
    assert "fewer states" in hint
