"""The first screen: ten lines of 80 columns that say what matters, and what an engineer would be warned of."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from pwatrack import design, load_spec, simulate
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.report.screen import COLUMNS, LINES, Findings, first_rows, fitted, joined
from pwatrack.simulation.margins import loop_margins, worst
from pwatrack.workflow.bands import declared
from pwatrack.workflow.cautions import assessed, plant_questions
from tests.scenarios import TWO
from tests.test_cli import call

STAGE = """
name: Stage
parameters: {{m: 2, d: 0.5, k: 100, sign: -1}}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  units: {{z: m, v: m/s, u: N, y: m}}
  A: [[0, 1], [0, -d/m]]
  B: [[0], [1/m]]
  C: [[1, 0]]
  nonlinearities:
    - name: bed
      kind: piecewise_linear
      of: z
      breakpoints: [-0.1, 0.1]
      slopes: [2*k, k, 2*k]
      value: -0.1*k
      into: {{v: sign/m}}
reference: {{output: {output}}}
simulation:
  duration: 4
  sample_time: 0.01
{more}
"""


def stage(tmp_path: Path, *, output: str = "0.05*sin(2*t)", more: str = "") -> Path:
    path = tmp_path / "stage.yaml"
    path.write_text(STAGE.format(output=output, more=more), encoding="utf-8")
    return path


def small(lines: list[str]) -> bool:
    return len(lines) <= LINES and all(len(line) <= COLUMNS for line in lines)


MUCH = """  actuator: {limits: {u: [-90, 90]}}
  noise: {std: {y: 0.02}, sample_time: 0.01, seed: 1}
  disturbance: {v: {sine: {amplitude: 0.2, frequency: 3}}}
  quantum: {y: 0.001}
  controller: {sample_time: 0.01}
require: {final_error: 1, largest_input: {u: 900}}
"""


@pytest.mark.slow
@pytest.mark.parametrize("command", ["check", "design", "simulate"])
@pytest.mark.parametrize("more", ["", MUCH], ids=["nothing else", "a machine"])
def test_ten_lines_of_eighty_columns(tmp_path: Path, command: str, more: str) -> None:
    options = () if command == "check" else ("--out", tmp_path / "out")
    run = call(command, stage(tmp_path, more=more), *options)
    assert run.exit_code == 0, run.output
    assert small(run.stdout.splitlines())


def test_rows_that_have_no_room_give_way_in_the_order_of_their_weight() -> None:
    rows = joined([*((label, "x " * 99) for label in ("margins", "K, L", "ideal loop", "simulated", "files"))])
    for most in range(1, 8):
        lines = fitted(rows, most)
        assert len(lines) <= most
        assert small(lines)
    assert [line.split()[0] for line in fitted(rows, 2)] == ["simulated", "files"]
    labels = [line[:12].strip() for line in fitted(rows, 5)]
    assert labels == [
        "simulated",
        "",
        "ideal loop",
        "margins",
        "files",
    ]  # that the run went well, or not, has two lines


def test_a_row_that_has_others_without_room_says_so() -> None:
    rows = [("open loop", f"cell {k}: τ {k + 1} s") for k in range(5)]
    assert fitted(rows, 2) == ["open loop   cell 0: τ 1 s", "open loop   cell 1: τ 2 s; …"]
    assert not any("…" in line for line in fitted(rows, 5))


def test_limits_and_a_disturbance_are_not_proved_by_what_is_proved_of_each_alone(tmp_path: Path) -> None:
    """Errors settle with limits where nothing disturbs, and end below a bound where no input is at a limit."""
    limits, disturbed = "  actuator: {limits: {u: [-90, 90]}}\n", "  disturbance: {v: {constant: 0.2}}\n"
    for more, whole in ((limits, True), (disturbed, True), (limits + disturbed, False)):
        spec = load_spec(stage(tmp_path, output="0.01*sin(2*t)", more=more))
        rows = list(first_rows(Findings(spec=spec, controller=design(spec))))
        said = " ".join(text for label, text in rows if label == "ideal loop")
        assert ("NOT proved" not in dict(rows)) == whole
        assert ("no limit reached" in said or "at their limits too" in said) == (more == limits)
        assert ("in the end" in said) == (disturbed in more)
        assert ("while no input is at a limit" in said) == (not whole)


def test_what_is_declared_times_its_bound_is_what_is_said_in_the_end(tmp_path: Path) -> None:
    """Three standard deviations of the sensor, and the amplitude of the disturbance."""
    spec = load_spec(
        stage(tmp_path, more=MUCH.replace("  quantum: {y: 0.001}\n  controller: {sample_time: 0.01}\n", ""))
    )
    made = design(spec)
    acting = declared(spec, made)
    assert acting == {("noise", 0): pytest.approx(0.06), ("disturbance", 1): pytest.approx(0.2, rel=1e-3)}
    sizes = {bounds.channel: bounds.sizes["output", 0] for bounds in made.bounds}
    total = sum(sizes[channel] * size for channel, size in acting.items())
    assert assessed(spec, made).ends["output", 0] == pytest.approx(total)


def test_where_the_sampled_loop_is_bounded_that_is_what_is_said_in_the_end(tmp_path: Path) -> None:
    spec = load_spec(stage(tmp_path, more=MUCH))
    made = design(spec)
    assert declared(spec, made)["noise", 0] == pytest.approx(0.0605)  # and half a step
    said = assessed(spec, made)
    assert said.ends == made.claim(SampledBounds).ends_below(made)
    assert said.condition == "under noise as drawn, quantisation, disturbance"  # not with other parameters, or limits


def test_a_bound_under_noise_beyond_what_is_required_or_half_the_reference_is_warned_of(tmp_path: Path) -> None:
    noise = "  noise: {std: {y: %s}, sample_time: 0.01, seed: 1}\n"
    said = {}
    for std in ("1e-9", "0.02"):
        spec = load_spec(stage(tmp_path, more=noise % std))
        said[std] = [w for w in assessed(spec, design(spec)).warnings if "half the reference" in w]
    assert [len(found) for found in said.values()] == [0, 1]
    spec = load_spec(stage(tmp_path, more=noise % "1e-9" + "require: {final_error: 1e-12}\n"))
    assert any(" is proved, 1e-12 m is required; most by noise: " in w for w in assessed(spec, design(spec)).warnings)


FAST = "  controller: {sample_time: 0.002}\n"
CAUSES = {
    "noise": (5e-4, FAST + "  noise: {std: {y: SIZE}, sample_time: 0.002, seed: 1}\n"),
    "steps of sensors": (0.01, FAST + "  quantum: {y: SIZE}\n"),
    "steps of inputs": (3.0, FAST + "  quantum: {y: 1e-9, u: SIZE}\n"),
    "disturbances": (5.0, FAST + "  disturbance: {v: SIZE*sin(3*t)}\n"),
    "jitter": (2e-4, "  controller: {sample_time: {nominal: 0.01, jitter: SIZE}}\n"),
    "sampling": (0.02, "  controller: {sample_time: SIZE}\n"),
}


@pytest.mark.slow
@pytest.mark.parametrize("cause", CAUSES)
def test_what_most_of_a_bound_is_said_to_be_by_is_what_lessens_it(cause: str, tmp_path: Path) -> None:
    (size, more), ends = CAUSES[cause], list[float]()
    for share in (1.0, 0.1):
        text = more.replace("SIZE", f"{size * share:g}") + "require: {final_error: 1e-12}\n"
        spec = load_spec(stage(tmp_path, more=text))
        found = assessed(spec, design(spec))
        said = " ".join(w for w in found.warnings if "no better than" in w)
        assert share < 1 or f"; most by {cause}: " in said, said
        ends.append(found.ends.get(("output", 0), 0.0))
    assert ends[1] < 0.6 * ends[0]


def test_an_element_of_the_wrong_sign_is_warned_of_by_its_figures(tmp_path: Path) -> None:
    right, wrong = (load_spec(stage(tmp_path), {"sign": sign}).problem.plant for sign in ("-1", "1"))
    assert plant_questions(right) == []
    gives, away = plant_questions(wrong)
    assert gives.startswith("'bed' pushes z on, 100 1/s² per unit")  # 2 k / m
    s = max(np.linalg.eigvals(A).real.max() for A in wrong.A)
    assert f"in 3 of 3 cells, time constant {1 / s:.3g} s" in away


def test_a_mode_without_damping_is_warned_of(tmp_path: Path) -> None:
    plant = load_spec(stage(tmp_path), {"d": "0"}).problem.plant
    (said,) = plant_questions(plant)
    assert said.startswith(f"a mode at {np.sqrt(2 * 100 / 2):.3g} rad/s has damping 0")


def test_an_input_that_rests_at_its_limit_is_warned_of(tmp_path: Path) -> None:
    limits = "  actuator: {{limits: {{u: [-90, {}]}}}}\n"
    for limit, expected in (("5.001", True), ("50", False)):  # k z = 5 N
        spec = load_spec(stage(tmp_path, output="{constant: 0.05}", more=limits.format(limit)))
        said = [w for w in assessed(spec, design(spec)).warnings if "of its range left" in w]
        assert bool(said) == expected
        up = "feedforward of u up to 5 N, upper limit 5.001: 0.0 % of its range left"
        assert not expected or said[0].startswith(up)


def test_gains_too_fast_for_their_sampling_are_warned_of_unless_the_sampled_loop_is_proved(tmp_path: Path) -> None:
    slow = "  controller: {sample_time: 0.02, method: emulated}\n"
    spec = load_spec(stage(tmp_path, more=slow))
    said = assessed(spec, design(spec)).warnings
    assert len([w for w in said if "every 0.02 s is slow" in w]) == 1  # one cause, one cure
    unstable = load_spec(stage(tmp_path, more=slow.replace("0.02", "0.1")))
    (why,) = (w for w in assessed(unstable, design(unstable)).warnings if "sampled every" in w or "is slow" in w)
    assert why.startswith("sampled every 0.1 s, the loop is unstable in cell")
    proved = load_spec(stage(tmp_path, more="  controller: {sample_time: 0.001}\n"))
    assert not any("sampl" in w for w in assessed(proved, design(proved)).warnings)


def test_warnings_are_in_run_json_and_all_that_is_proved_in_summary_txt(tmp_path: Path) -> None:
    path, out = stage(tmp_path), tmp_path / "out"
    run = call("design", path, "--set", "sign=1", "--out", out)
    assert run.exit_code == 0, run.output
    assert "\nquestion    'bed' pushes z on" in run.stdout
    assert run.stdout.splitlines()[0] == f"Stage: NOT READY: 1 warning; {IDEAL}"
    index = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert len(index["questions"]) >= 2
    said = (out / "summary.txt").read_text(encoding="utf-8")
    assert all(label in said for label in ("(8) controller", "(9) observer", "bounds", "margins", "question"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_mass_machine", "gallery/gear_with_backlash", "gallery/payload_in_wind"])
def test_specs_of_the_repository_have_small_first_screens(specs: Path, tmp_path: Path, name: str) -> None:
    run = call("simulate", specs / f"{name}.yaml", "--plots", "none", "--out", tmp_path / "out")
    assert small(run.stdout.splitlines())
    assert any(line.startswith(("ideal loop  proved", "as sampled  proved")) for line in run.stdout.splitlines())


def test_loads_that_are_smaller_than_they_count_are_a_way_to_more_phase_margin(specs: Path, tmp_path: Path) -> None:
    text = (specs / "gallery" / "payload_in_wind.yaml").read_text(encoding="utf-8")
    (tmp_path / "plant.yaml").write_text(text.replace("sizes: {wind: 2, fan: 1}", ""), encoding="utf-8")
    phases = []
    for sizes in ({}, {"wind": 4.29277, "fan": 3.08356}):  # a tenth of what they count else
        spec = load_spec(tmp_path / "plant.yaml")
        spec = replace(spec, problem=replace(spec.problem, sizes=sizes))
        found = assessed(spec, design(spec))
        (said,) = (warning for warning in found.warnings if "phase margin" in warning)
        phases.append(np.degrees(min(each.phase for each in found.margins)))
        if not sizes:
            assert said.endswith("lower 'sizes' of loads: with 0.1 times these it would have 5.8°")
    assert phases[0] < 1
    assert phases[1] == pytest.approx(5.8, abs=0.1)


def test_a_run_is_as_required_where_that_is_met_by_all_that_is_tracked(tmp_path: Path) -> None:
    more = "disturbance: {w: {constant: 0.6}}"
    wishes = {"{y1: 0.05}": "does NOT track", "{y1: 0.05, y2: 0.5}": "is as required", "5": "is as required"}
    for wish, said in wishes.items():
        text = TWO.replace("DESIGN", "{}").replace("MORE", more) + f"require: {{final_error: {wish}}}\n"
        (tmp_path / "two.yaml").write_text(text, encoding="utf-8")
        run = call("simulate", tmp_path / "two.yaml", "--plots", "none", "--out", tmp_path / "out")
        assert f": {said}, largest error" in " ".join(run.stdout.split())


IDEAL = "without sampling, limits, noise"


def title(run: Result) -> str:
    return run.stdout.splitlines()[0]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("", "Stage: tracks; without sampling, limits, noise"),
        ("require: {final_error: 1e-30}\n", "Stage: NOT READY: 1 of 1 requirements missed"),
        ("  actuator: {limits: {u: [-90, 90]}}\n", "Stage: tracks; without sampling, noise"),
        (MUCH.replace("0.02", "1e-6").replace("0.2,", "1e-6,"), "Stage: tracks; proved as it runs"),
    ],
)
def test_the_title_says_the_worst_first(tmp_path: Path, more: str, said: str) -> None:
    path = stage(tmp_path, more=more)
    path.write_text(path.read_text().replace("d: 0.5", "d: 40"))  # or the phase margin is small, which would come first
    assert title(call("simulate", path, "--out", tmp_path / "out")) == said


def test_an_error_that_is_as_required_is_no_failure_though_it_is_off(tmp_path: Path) -> None:
    other = "  plant: {parameters: {k: 80}}\n"
    for wish, said in (
        ("", f"NOT READY: error above 1 %; {IDEAL}"),
        ("require: {final_error: 1}\n", f"as required; {IDEAL}; partly proved"),
    ):
        path = stage(tmp_path, more=other + wish)
        path.write_text(path.read_text().replace("d: 0.5", "d: 40"))
        assert title(call("simulate", path, "--out", tmp_path / "out")) == f"Stage: {said}"


def test_a_row_without_room_loses_whole_parts_and_no_figure() -> None:
    parts = [f"part {k} says {k}.5 m and more than that" for k in range(9)]
    (first, *others) = fitted([("input", "; ".join(parts))], 3)
    said = " ".join(line[12:] for line in [first, *others])
    kept = said.removesuffix("; …").split("; ")
    assert kept == parts[: len(kept)]
    assert 0 < len(kept) < len(parts)
    assert small([first, *others])


def test_how_long_an_input_was_at_its_limit_is_what_its_samples_say(tmp_path: Path) -> None:
    limits = "  initial: {plant: [0.5, 0]}\n  actuator: {limits: {u: [-9, 7]}}\n"
    result = simulate(load_spec(stage(tmp_path, more=limits)))
    u = result.response.u[:, 0]
    at = np.mean((u <= -9 + 1e-12) | (u >= 7 - 1e-12))
    assert 0.1 < at < 0.9
    assert result.at_limits["u"] == pytest.approx(at, abs=0.01)
    assert (result.figures.lowest["u"], result.figures.highest["u"]) == pytest.approx((-9, 7))
    free = simulate(load_spec(stage(tmp_path)))
    assert free.at_limits == {}
    assert free.figures.lowest["u"] == pytest.approx(free.response.u.min(), rel=1e-3)


def test_a_limit_of_what_still_waits_is_said_of_what_is_computed(tmp_path: Path) -> None:
    more = """\
  initial: {plant: [0.5, 0], observer: [0.5, 0]}
  actuator: {limits: {u: [-9, 7]}}
  controller: {sample_time: 0.02, delay: %d}
"""
    for delay in (0, 2):
        said = call("simulate", stage(tmp_path, more=more % delay), "--out", tmp_path / f"out{delay}").stdout
        told = " ".join(said.split())
        assert "% of the time" in told
        assert ("% of the time as computed" in told) == (delay > 0)


@pytest.mark.parametrize("program", ["", "  controller: {sample_time: 0.02}\n"])
def test_an_input_begins_with_the_first_value_that_it_has(tmp_path: Path, program: str) -> None:
    """And not at 0, where a program is before it starts."""
    path = stage(tmp_path, output="{constant: 0.2, step: [{size: 0.01, at: 0, smooth: 0.5}]}", more=program)
    result = simulate(load_spec(path))
    assert result.figures.lowest["u"] == pytest.approx(result.response.u.min(), rel=1e-2)
    assert result.response.u.min() > 1


def test_a_small_phase_margin_is_told_with_the_change_that_gives_most(tmp_path: Path) -> None:
    spec = load_spec(stage(tmp_path))
    made = design(spec)
    (said,) = [warning for warning in assessed(spec, made).warnings if warning.startswith("phase margin")]
    found = re.search(r"([KL]) × (\S+) would have (\S+)°: (lower|raise) 'sizes' of (in|out)puts", said)
    assert found is not None
    phases = {}
    for letter in "KL":
        for factor in (0.5, 2.0):
            changed = replace(made.design, **{letter: factor * getattr(made.design, letter)})
            phases[letter, factor] = np.degrees(min(one.phase for one in loop_margins(replace(made, design=changed))))
    best = max(phases, key=phases.__getitem__)
    assert (found[1], float(found[2])) == best
    assert float(found[3]) == pytest.approx(phases[best], rel=0.05)


BOUND = "error to 0 for other m = {}, k = 64; to a bound only"


def test_a_plant_of_the_box_is_not_called_unproved(specs: Path, tmp_path: Path) -> None:
    path = specs / "gallery" / "robust_positioning.yaml"
    for value, named in (("2.1", False), ("2.3", True)):  # m is at most 2.2 in the box
        text = path.read_text(encoding="utf-8").replace("m: 2.1", f"m: {value}")
        (tmp_path / "box.yaml").write_text(text, encoding="utf-8")
        spec = load_spec(tmp_path / "box.yaml")
        found = first_rows(Findings(spec=spec, controller=design(spec)))
        rows = [text for label, text in found if label == "NOT proved"]
        assert rows == [f"for other m = {value}, k = 64" if named else BOUND.format(value)]


def test_a_small_gain_margin_is_told(tmp_path: Path) -> None:
    """A pad that is much stiffer than what counts: a cell alone is unstable with its gain a third larger."""
    path = stage(tmp_path, output="0.01 + 0.02*sin(4*t)")
    pad = "[{name: pad, kind: spring, of: z, start: 0.02, slope: 333, into: {v: -1}}]\nreference"
    text = re.sub(r"(?s)\[\[0, 1\], \[0, -d/m\]\]", "[[0, 1], [0, -7.5]]", path.read_text(encoding="utf-8"))
    text = re.sub(r"(?s)nonlinearities:.*?\nreference", f"nonlinearities: {pad}", text).replace("[1/m]", "[0.00833]")
    path.write_text(text, encoding="utf-8")
    spec = load_spec(path)
    made = design(spec)
    (said,) = (text for text in assessed(spec, made).warnings if text.startswith("gain margin"))
    of = worst(loop_margins(made))
    assert of is not None
    assert (of.phase > np.pi / 6, of.least_gain < 1.4) == (True, True)
    assert said.startswith(f"gain margin × {of.least_gain:.3g} of each cell by itself: more is unstable; halving or")
    for letter, factor in (("K", 0.5), ("K", 2.0), ("L", 0.5), ("L", 2.0)):
        changed = replace(made.design, **{letter: factor * getattr(made.design, letter)})
        other = worst(loop_margins(replace(made, design=changed)))
        assert other is None or other.least_gain < 1.2 * of.least_gain


def test_a_gain_margin_says_which_side_and_no_unstable_loop_is_advised(tmp_path: Path) -> None:
    """x' = x + u is unstable with u = K x where K is above −1: −1.25 may be a fifth smaller, and not half."""
    path = tmp_path / "unstable.yaml"
    system = "{states: [x], inputs: [u], outputs: [y], sizes: {x: 1, u: 1, y: 1}, A: [[1]], B: [[1]], C: [[1]]}"
    for L in (-200, -8):
        gains = f"design: {{tracking: output, controller: {{K: [[-1.25]]}}, observer: {{L: [[{L}]]}}}}"
        rest = "reference: {output: {constant: 1}}\nsimulation: {duration: 5, sample_time: 0.01}"
        path.write_text(f"name: unstable\nsystem: {system}\n{gains}\n{rest}\n", encoding="utf-8")
        spec = load_spec(path)
        said = " ".join(assessed(spec, design(spec)).warnings)
        assert "K × 0.5" not in said
        assert "more is unstable" not in said
    assert "less is unstable" in said or "phase margin" in said


MANY = """
name: A lag
parameters: {a: 1}
system:
  states: [x]
  inputs: [u]
  outputs: [y]
  A: [[-a]]
  B: [[1]]
  C: [[1]]
design: {controller: {K: [[-0.5]]}}
reference: {output: {sine: {amplitude: 0.3, frequency: 1}}}
simulation:
  {duration: 8, sample_time: 0.05, initial: {plant: steady, observer: steady}, ensemble: {parameters: {a: [0.5, 2]}}}
"""


@pytest.mark.parametrize(
    ("wish", "over", "off"),
    [
        ("", "parameters", True),
        ("require: {final_error: 0.5}", "parameters", True),  # of the run itself
        ("require: {ensemble: {members: all, final_error: 0.5}}", "parameters", False),
        ("", "initial", False),
    ],
)
def test_members_that_are_off_are_said_first_unless_what_is_left_of_them_is_required(
    tmp_path: Path, wish: str, over: str, off: bool
) -> None:
    path = tmp_path / "lag.yaml"
    path.write_text(MANY + wish, encoding="utf-8")
    run = call("simulate", path, "--ensemble", 6, "--over", over, "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    assert ("NOT READY: " in run.stdout and "of 6 members off" in run.stdout) is off
