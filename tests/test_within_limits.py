"""Limits of the inputs: what the feedforward takes of them is known before anything is simulated."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.control.limits import Limited, Peak
from pwatrack.limiting import room_within_limits
from pwatrack.model.conditions import Conditions
from pwatrack.tracking import desired_trajectory
from tests.conftest import SPECS
from tests.scenarios import in_scenario
from tests.test_cli import call, refused

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


def limited(spec: Spec) -> tuple[Limited, Peak]:
    found = room_within_limits(spec, *desired_trajectory(spec, False))
    assert found is not None
    assert found.peak is not None
    return found, found.peak


@settings(max_examples=10, deadline=None)
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
    step = "{step: {size: 0.1, at: 0.5123, smooth: 0.6}}"
    _, peak = limited(load_spec(written(tmp_path, STAGE.replace("d: 3", "d: 0"), REFERENCE=step, LIMITS="[-9, 9]")))
    most = 2 * 0.1 / 0.2**2  # three averages over 0.2 s
    assert [peak.low[0], peak.high[0]] == pytest.approx([-most, most], rel=1e-9)
    assert peak.times[0] == pytest.approx([0.5123 + 0.1, 0.5123 - 0.1], abs=1e-9)


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
    assert controller.limited is not None
    assert controller.limited.left is None
    said = " ".join(call("design", path, "--out", tmp_path / "out").stdout.split())
    assert "more than that, from where the generator starts; once that start is forgotten -0.674" in said
    index = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert index["limits"]["inputs"]["u"]["left"] is None
    assert index["limits"]["inputs"]["u"]["lasting"]["range"] == pytest.approx([-0.6, 0.6], abs=0.1)


def test_the_run_shows_the_feedforward_that_was_said(tmp_path: Path) -> None:
    for name in ("two_mass_backlash", "gallery/three_tanks_weirs", "gallery/stage_with_bumpers"):
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
    said = " ".join(call("design", path, "--out", tmp_path / "out").stdout.split())
    assert "u from -inf to 6 N: its feedforward takes" in said
