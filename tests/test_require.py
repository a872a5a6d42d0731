"""Figures of a run that can be required, and what is said where they are missed."""

import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from junitparser import JUnitXml

from pwatrack import Result, ensemble, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.work import Ended
from pwatrack.claims.decay import gain_figures
from pwatrack.errors import InvalidSpec
from pwatrack.report.figures import figure_content, measures
from pwatrack.report.plots.spread import fan
from pwatrack.report.required import required
from pwatrack.simulation.closed_loop import Response
from pwatrack.simulation.figures import Figures, Measuring
from pwatrack.simulation.margins import margin_figures
from pwatrack.simulation.trace import Trace
from pwatrack.spec.requirement import QUANTITIES
from tests.test_cli import call, index_of, refused
from tests.test_drawing import points
from tests.test_outcome import cart

T = np.linspace(0.0, 10.0, 1001)
BESIDE = {"gain_margin", "phase_margin", "delay_margin", "time_share"}  # in run.json by themselves
SIZES = {"final_error", "largest_error", "final_errors", "largest_errors", "largest_input"}


def response(y: Array, y_d: Array, t: Array = T) -> Response:
    """A run of which only output and reference matter."""
    zero, modes = np.zeros((len(t), 1)), np.zeros((len(t), 1), dtype=int)
    y, y_d = y[:, None], y_d[:, None]
    signals = dict.fromkeys(("x", "x_hat", "x_d", "eta", "eta_hat", "u", "u_ff", "estimates", "loads"), zero)
    trace = Trace(t=t, z=zero, modes=modes, events=())
    return Response(
        trace=trace,
        y=y,
        y_d=y_d,
        measured=y,
        tracked=y,
        tracked_d=y_d,
        tracking_error=y - y_d,
        state_sizes=np.ones(1),
        error_sizes=np.ones(1),
        **signals,
    )


def figures(y: Array, y_d: Array, band: float | None = None) -> Figures:
    bands = {} if band is None else {"y": band}
    return Figures.of(response(y, y_d), outputs=["y"], inputs=["u"], bands=bands)


def oscillator(damping: float, t: Array) -> Array:
    """The step response of ω = 1, from 0 to 1, with its textbook overshoot e^(−πζ/√(1−ζ²))."""
    w = np.sqrt(1 - damping**2)
    past = np.maximum(t, 0.0)
    return np.asarray(1 - np.exp(-damping * past) * (np.cos(w * past) + damping / w * np.sin(w * past)))


@given(st.floats(0.3, 0.9), st.floats(-5.0, 5.0), st.floats(-3.0, 3.0).filter(lambda h: abs(h) > 1e-3))
def test_a_step_response_has_the_overshoot_of_the_textbook(damping: float, start: float, size: float) -> None:
    found = figures(start + size * oscillator(damping, 2 * T), np.full_like(T, start + size))
    expected = np.exp(-np.pi * damping / np.sqrt(1 - damping**2))
    assert found.overshoot["y"] == pytest.approx(expected, abs=1e-3)


@given(st.floats(0.5, 5.0), st.floats(0.01, 0.2))
def test_an_exponential_rises_and_settles_when_the_logarithm_says(rate: float, band: float) -> None:
    found = figures(1 - np.exp(-rate * T), np.ones_like(T), band)
    assert found.rise_time["y"] == pytest.approx(np.log(9) / rate, abs=0.0101)
    assert found.settling_time["y"] == pytest.approx(-np.log(band) / rate, abs=0.0101)
    assert found.overshoot["y"] == 0
    plain = figures(1 - np.exp(-rate * T), np.ones_like(T))
    assert plain.settling_time["y"] == pytest.approx(np.log(50) / rate, abs=0.0101)


@pytest.mark.parametrize("at", [0.0, 3.0, 4.005])
def test_times_count_from_the_beginning_of_the_last_move(at: float) -> None:
    ramp = np.clip((T - at) / 0.5, 0.0, 1.0)
    earlier = np.where(T < 1, 5.0, 7.0) if at else 0.0  # a move of its own
    found = figures(earlier + np.heaviside(T - at - 1, 1.0), earlier + ramp)
    assert found.settling_time["y"] == pytest.approx(1.0, abs=0.0201)
    assert found.rise_time["y"] == 0
    assert found.overshoot["y"] == 0


def test_what_the_reference_itself_goes_beyond_its_end_is_no_overshoot() -> None:
    polyline = np.interp(T, [0, 2, 5, 20], [0, 1.5, 1, 1])
    assert figures(polyline, polyline).overshoot["y"] == 0
    assert figures(polyline + 0.1 * np.exp(-((T - 2) ** 2)), polyline).overshoot["y"] == pytest.approx(0.1, abs=1e-3)


def test_a_wave_settles_when_its_error_is_small_for_good_and_has_no_overshoot() -> None:
    wave = 3 * np.sin(2 * T)
    found = figures(wave + np.where(T < 4, 0.1, 0.05), wave)
    assert found.settling_time["y"] == pytest.approx(4.0)  # 2 % of 3 is 0.06
    assert (found.rise_time, found.overshoot) == ({}, {})
    never = figures(wave + 0.1, wave)
    assert never.settling_time["y"] == np.inf
    assert figure_content({"settling_time": never.settling_time}) == {"settling_time": {"y": None}}


def test_what_never_gets_there_has_no_time_and_what_starts_there_has_no_way() -> None:
    short = figures(np.minimum(T / 20, 0.8), np.ones_like(T))
    assert (short.rise_time["y"], short.settling_time["y"]) == (np.inf, np.inf)
    pushed = figures(np.exp(-T) * np.sin(5 * T), np.zeros_like(T))
    assert (pushed.rise_time, pushed.overshoot) == ({}, {})
    assert 0 < pushed.settling_time["y"] < 5
    assert figures(np.ones_like(T), np.ones_like(T)).settling_time["y"] == 0


def test_what_goes_beyond_by_rounding_does_not_overshoot() -> None:
    rounded = 1 - np.exp(-9 * T) + 1e-15 * np.sin(300 * T)
    assert rounded.max() > 1
    assert figures(rounded, np.ones_like(T)).overshoot["y"] == 0


@given(
    st.integers(0, 2**31),
    st.lists(st.integers(1, 999), max_size=4),
    st.sampled_from(["wave", "step", "moves", "rest"]),
)
def test_the_figures_do_not_depend_on_the_blocks(seed: int, cuts: list[int], kind: str) -> None:
    random = np.random.default_rng(seed)
    y_d = {
        "wave": np.sin(T),
        "step": (T > 2) * 1.0,
        "moves": np.repeat(random.normal(size=11), 91),
        "rest": np.zeros_like(T),
    }[kind]
    y = y_d + np.exp(-T) * random.normal(size=len(T))
    edges = sorted({0, *cuts, len(T)})
    blocks = [response(y[a:b], y_d[a:b], T[a:b]) for a, b in pairwise(edges)]
    measuring = Measuring(len(T), outputs=["y"], inputs=["u"], bands={})
    for block in blocks:
        measuring.see(block)
    assert measuring.figures(blocks) == figures(y, y_d)


# one spec, and each figure that it has


STEP = "{step: {size: 0.05, centre: 2, smooth: 0.5}}"
BACK = "{step: {size: -0.05, centre: 2, smooth: 0.5}}"


def stage(folder: Path, wishes: str, *conditions: str, reference: str = STEP) -> Path:
    path = cart(folder, *conditions, reference="REFERENCE", duration=12)
    text = path.read_text(encoding="utf-8").replace('"REFERENCE"', reference)
    path.write_text(f"{text}require: {wishes}\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def wave(tmp_path_factory: pytest.TempPathFactory, specs: Path) -> Result:
    path = tmp_path_factory.mktemp("wave") / "plant.yaml"
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace("duration: 60", "duration: 4"), encoding="utf-8")
    return simulate(load_spec(path))


@pytest.fixture(scope="module")
def step(tmp_path_factory: pytest.TempPathFactory) -> Result:
    return simulate(load_spec(stage(tmp_path_factory.mktemp("step"), "{norm_K: 100}")))


def test_every_figure_of_run_json_can_be_required_and_no_other(wave: Result, step: Result) -> None:
    found = {**gain_figures(wave.controller), **measures(wave)}
    assert list(found) == [name for name in QUANTITIES if name not in BESIDE]
    for result in (wave, step):
        for name, value in measures(result).items():
            assert isinstance(value, dict) == (QUANTITIES[name].per is not None)


def value_of(result: Result, name: str) -> float:
    beside = margin_figures(result.controller) | {"time_share": result.figures.time_share["plant"]}
    value: Any = {**gain_figures(result.controller), **measures(result), **beside}[name]
    return float(next(iter(value.values())) if isinstance(value, dict) else value)


@pytest.mark.parametrize("name", QUANTITIES)
def test_each_figure_is_missed_and_met_once(wave: Result, step: Result, tmp_path: Path, name: str) -> None:
    result = step if QUANTITIES[name].per == "outputs" else wave
    came = value_of(result, name)
    share = 1.01 if QUANTITIES[name].best == "at most" else 0.99
    text = result.spec.path.read_text(encoding="utf-8").partition("require:")[0]
    limits = [(came * share, True)] + [(came / share, False)] * (came > 0)  # nothing is below 0
    assert len(limits) == 2 or name == "steady_state_residual"
    for limit, met in limits:
        path = tmp_path / "spec.yaml"
        asked = (
            f"{{{next(iter(result.figures.time_share['plant']))}: {limit!r}}}" if name == "time_share" else repr(limit)
        )
        path.write_text(f"{text}require: {{{name}: {asked}}}\n", encoding="utf-8")
        (checked,) = required(load_spec(path), result.controller, result)
        assert (checked.met, checked.found) == (met, came), checked.text


@pytest.mark.slow
def test_a_run_and_a_batch_end_with_6_where_any_figure_is_missed_and_with_0_where_it_is_met(
    wave: Result, step: Result, tmp_path: Path
) -> None:
    ends, met = dict[str, int](), dict[str, str]()
    (tmp_path / "specs").mkdir()

    def written(name: str, text: str, code: int) -> int:
        (tmp_path / "specs" / f"{name}.yaml").write_text(text, encoding="utf-8")
        return code

    for name, quantity in QUANTITIES.items():
        if name == "time_share":
            continue  # it is of cells by name: below
        result = step if quantity.per == "outputs" else wave
        came, share = value_of(result, name), 1.01 if quantity.best == "at most" else 0.99
        text = result.spec.path.read_text(encoding="utf-8").partition("require:")[0]
        met[text] = f"{met.get(text, '')}  {name}: {came * share!r}\n"
        if came > 0:
            ends[f"{name}_missed"] = written(f"{name}_missed", f"{text}require: {{{name}: {came / share!r}}}\n", 6)
    for k, (text, wishes) in enumerate(met.items()):
        ends[f"met_{k}"] = written(f"met_{k}", f"{text}require:\n{wishes}", 0)
    for code in (0, 6):  # one of either kind by itself; a batch of all
        name = next(name for name in ends if ends[name] == code)
        run = call("simulate", tmp_path / "specs" / f"{name}.yaml", "--plots", "none", "--out", tmp_path / "out" / name)
        assert run.exit_code == code, run.output
    report = tmp_path / "junit.xml"
    run = call("batch", tmp_path / "specs", "--out", tmp_path / "runs", "--plots", "none", "--junit", report)
    assert run.exit_code == 6, run.output
    (suite,) = JUnitXml.fromfile(str(report))
    failed = {str(case.name).removesuffix(".yaml").rpartition("/")[2]: bool(case.result) for case in suite}
    assert failed == {name: code == 6 for name, code in ends.items()}


WISHES = {
    "met": ("{final_error: 1e-3, settling_time: 3, largest_input: {u: 50}, overshoot: 50%, rate: 0.1}", 0),
    "missed": ("{final_error: 1e-3, settling_time: {y: 0.1}, largest_input: 1e-3, overshoot: 0%, rate: 100}", 6),
}


@pytest.mark.parametrize("kind", WISHES)
def test_a_run_ends_with_6_and_all_its_files_where_something_is_missed(tmp_path: Path, kind: str) -> None:
    wishes, code = WISHES[kind]
    path = stage(tmp_path, wishes)
    run = call("simulate", path, "--out", tmp_path / "out")
    assert run.exit_code == code, run.output
    index = index_of(tmp_path / "out")
    assert (index["verdict"], index["exit"]) == ("proved", code)
    assert "trace.csv" in index["files"]
    met = [(entry["figure"], entry["met"]) for entry in index["requirements"]]
    names = ["final_error", "settling_time", "largest_input", "overshoot", "rate"]
    assert met == [(name, name == "final_error" or kind == "met") for name in names]
    first = next(line for line in run.stdout.splitlines()[1:] if line.strip())
    if kind == "met":
        assert run.stderr == ""
        assert "required" in run.stdout
        assert "5 of 5 met" in run.stdout
        assert first.startswith("simulated")
    else:
        assert first.startswith("missed")
        line = path.read_text(encoding="utf-8").count("\n")
        lines = run.stderr.splitlines()
        assert all(said.startswith(f"error: {path}:{line}:") for said in lines)
        assert [said.split(": ")[2:4] for said in lines] == [
            ["requirement missed", name]
            for name in ("settling_time of y", "largest_input of u", "overshoot of y", "rate")
        ]
        assert ", at most 0.1 s required" in lines[0]
        assert ", at most 0.001 N required" in lines[1]
        assert ", at most 0 % required" in lines[2]
        assert ", at least 100 1/s required" in lines[3]


def test_a_design_is_held_to_what_is_asked_of_it_alone(tmp_path: Path) -> None:
    path = stage(tmp_path, "{rate: 100, norm_K: 100, final_error: 0}")
    run = call("design", path, "--out", tmp_path / "out")
    assert run.exit_code == 6, run.output
    assert run.stderr.count("requirement missed") == 1
    assert [entry["met"] for entry in index_of(tmp_path / "out")["requirements"]] == [False, True]


def test_a_batch_says_what_is_missed_in_table_and_junit(tmp_path: Path) -> None:
    for kind, (wishes, _) in WISHES.items():
        (tmp_path / "specs" / kind).mkdir(parents=True)
        stage(tmp_path / "specs" / kind, wishes)
    report = tmp_path / "junit.xml"
    run = call("batch", tmp_path / "specs", "--out", tmp_path / "out", "--junit", report)
    assert run.exit_code == 6, run.output
    assert "1 passed, 1 failed" in run.stdout
    assert "5 of 5" in run.stdout
    assert "1 of 5" in run.stdout
    assert "cart.yaml: requirement missed: overshoot of y: " in run.stdout
    (suite,) = JUnitXml.fromfile(str(report))
    met, missed = sorted(suite, key=lambda case: str(case.name))
    assert not met.result
    assert "met: final_error: " in met.system_out
    (failure,) = missed.result
    assert "exit 6, expected 0; missed: settling_time of y: " in failure.message
    assert "; missed: overshoot of y: " in failure.message
    assert "met: final_error: " in missed.system_out


@pytest.mark.slow
def test_members_of_an_ensemble_are_held_to_their_share(tmp_path: Path) -> None:
    boxes = "ensemble: {initial: {plant: {z: [-0.05, 0.09]}}}"
    many = ensemble(simulate(load_spec(stage(tmp_path, "{norm_K: 9}", boxes))), 20)
    limit = round(float(np.median([figures.largest_input["u"] for figures in many.figures])), 3)
    wishes = f"{{ensemble: {{members: SHARE, largest_input: {limit}, final_error: 1e-3}}}}"
    kept = sum(figures.largest_input["u"] <= limit for figures in many.figures)
    assert 0 < kept < 20
    spec = load_spec(stage(tmp_path, wishes.replace("SHARE", "all"), boxes))
    figure = fan(many, required(spec, many.nominal.controller, many=many))
    strip = figure.axes[2]  # below the errors, whose limit is a line there
    worst = max(figures.largest_input["u"] for figures in many.figures)
    assert strip.get_xlabel() == f"largest_input of u (N): worst {worst:.4g}, at most {limit:.4g} required"
    assert len(figure.axes) == 3
    assert {float(points(line)[0, 0]) for line in strip.lines} >= {limit, worst}
    for share, met in ((f"{kept}/20", True), (f"{5 * kept + 1}%", False), ("all", False)):
        path = stage(tmp_path, wishes.replace("SHARE", share), boxes)
        run = call("simulate", path, "--ensemble", 20, "--out", tmp_path / "out")
        assert run.exit_code == (0 if met else 6), run.output
        first, second = index_of(tmp_path / "out")["requirements"]
        assert (first["figure"], first["met"], second["met"]) == ("largest_input", met, True)
        assert f"at most {limit:g} N in {kept} of 20 members, in " in first["said"]
        assert first["found"] == max(figures.largest_input["u"] for figures in many.figures)
    run = call("simulate", path, "--out", tmp_path / "out")  # without an ensemble nothing is asked
    assert run.exit_code == 0
    assert "requirements" not in index_of(tmp_path / "out")


def test_a_member_has_the_figures_of_its_own_run(tmp_path: Path) -> None:
    path = stage(tmp_path, "{norm_K: 100}", "ensemble: {initial: {plant: {z: [0, 0.09]}}}")
    many = ensemble(simulate(load_spec(path)), 3)
    for z, found in zip(many.variation.values["z"].tolist(), many.figures, strict=True):
        text = path.read_text(encoding="utf-8").replace("plant: [0.05, 0]", f"plant: [{z!r}, 0]")
        (tmp_path / "one.yaml").write_text(text, encoding="utf-8")
        assert figure_content(vars(simulate(load_spec(tmp_path / "one.yaml")).figures)) == figure_content(vars(found))


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ("{settling_tim: 3}", "require.settling_tim: no figure has this name; did you mean 'settling_time'?"),
        ("{speed: 3}", "require.speed: no figure has this name; there are norm_K, "),
        ("{final_error: 10%}", "require.final_error: '10%': percent of what?"),
        ("{final_error: {v: 1}}", "require.final_error: 'v' is none of the signals that have an error (y)"),
        ("{mode_changes: {y: 1}}", "require.mode_changes: one number is expected"),
        ("{largest_input: {uu: 1}}", "require.largest_input: 'uu' is none of the inputs (u); did you mean 'u'?"),
        ("{largest_input: {}}", "require.largest_input: nothing is given"),
        ("{final_error: -1}", "require.final_error: -1 is negative"),
        ("{final_error: [1]}", "require.final_error: a number or an expression is expected"),
        ("{final_error: limits}", "require.final_error: unknown name 'limits'; did you mean 'limit'?"),
        ("{final_error: 1 s}", "require.final_error: 's' is no unit of what is in 'm'"),
        ("{gain_margin: 6 dB}", "require.gain_margin: 'dB': what this is about has no unit: give a number alone"),
        ("{limits: {z: [0, 2 kg]}}", "require.limits.z: 'kg' is no unit of what is in 'm'"),
        ("{time_share: 5%}", "require.time_share: a share for some of the cells by name is expected"),
        (
            "{time_share: {stop: 5%}}",
            "require.time_share: 'stop' is no cell of the plant, nor what one of its elements",
        ),
        ("3", "require: a mapping such as {final_error: 1e-3} is expected"),
        ("{ensemble: 3}", "require.ensemble: what each member is to achieve is expected"),
        ("{ensemble: {members: 90%}}", "require.ensemble: what each member is to achieve is expected"),
        ("{ensemble: {members: 0, final_error: 1}}", "require.ensemble.members: '0' is no share of the members"),
        ("{ensemble: {members: 110%, final_error: 1}}", "require.ensemble.members: '110%' is no share"),
        ("{ensemble: {norm_K: 1}}", "require.ensemble.norm_K: a member of an ensemble has no such figure of its own"),
    ],
)
def test_what_cannot_be_required_is_refused_with_its_place(tmp_path: Path, wishes: str, said: str) -> None:
    path = stage(tmp_path, wishes)
    error = refused(call("simulate", path, "--out", tmp_path / "out"), 2)
    line = path.read_text(encoding="utf-8").count("\n")
    assert f"{path}:{line}:" in error
    assert said in error


@pytest.mark.parametrize("name", ["overshoot", "rise_time", "generator_rate", "largest_multiplier"])
def test_a_figure_that_a_run_has_not_is_refused_where_it_is_required(tmp_path: Path, name: str) -> None:
    path = stage(tmp_path, f"{{{name}: 1}}", reference='"0.05*sin(t)"')
    error = refused(call("simulate", path, "--out", tmp_path / "out"), 2)
    assert f"require.{name}: there is no {name}" in error
    assert "hint: leave it out" in error
    assert not (tmp_path / "out" / "run.json").exists()


SEVERAL = """name: two integrators
system:
  states: [a, v, b]
  inputs: [f, g]
  outputs: [ya, yb]
  units: {a: mm, v: mm/s, b: V, ya: mm, yb: V}
  A: [[0, 1, 0], [0, 0, 0], [0, 0, 0]]
  B: [[0, 0], [1, 0], [0, 1]]
  C: [[1, 0, 0], [0, 0, 1]]
TRACKING
simulation: {duration: 3, sample_time: 0.01, initial: {plant: [0.5, 0, -2]}}
require: WISHES
"""
OUTPUTS = 'reference: {output: {ya: "sin(t)", yb: "cos(2*t)"}}'
STATES = "design: {tracking: state}\nreference: {setpoint: {ya: 1, yb: 2}}"


@pytest.mark.parametrize(("tracking", "names"), [(OUTPUTS, ["ya", "yb"]), (STATES, ["ya", "yb", "a", "v", "b"])])
def test_the_final_error_of_each_signal_is_required_in_its_own_unit(
    tmp_path: Path, tracking: str, names: list[str]
) -> None:
    """Held against the samples of the trace, and against what is required a little above and below."""
    path = tmp_path / "spec.yaml"

    def written(wishes: str) -> Path:
        path.write_text(SEVERAL.replace("TRACKING", tracking).replace("WISHES", wishes), encoding="utf-8")
        return path

    result = simulate(load_spec(written("{final_error: 1}")))
    r, late = result.response, result.response.t >= 2.7 - 1e-9
    off = {name: r.tracked[:, k] - r.tracked_d[:, k] for k, name in enumerate(["ya", "yb"])}
    off |= {name: r.x[:, k] - r.x_d[:, k] for k, name in enumerate(["a", "v", "b"])}
    wanted = {name: float(np.abs(off[name][late]).max()) for name in names}
    for name, found in result.figures.final_errors.items():  # between samples it may be a little more
        assert wanted[name] <= found <= 1.001 * wanted[name]
    assert result.figures.largest_errors == pytest.approx({name: np.abs(off[name]).max() for name in names}, rel=1e-2)
    for name, unit in zip(names, ["mm", "V", "mm", "mm/s", "V"], strict=False):
        limits = {"final_error": wanted[name], "largest_error": result.figures.largest_errors[name]}
        for figure, came in limits.items():
            for share, met in ((1.01, True), (0.99, False)):
                spec = load_spec(written(f"{{{figure}: {{{name}: {came * share!r}}}}}"))
                (checked,) = required(spec, result.controller, result)
                assert checked.met == met
                assert checked.text.startswith(f"{figure} of {name}: ")
                assert checked.text.endswith(f" {unit} required")
    run = call("simulate", written(f"{{final_error: {{yb: {wanted['yb'] / 2!r}}}}}"), "--out", tmp_path / "out")
    assert run.exit_code == 6, run.output
    assert f"{path}:" in run.stderr
    assert "requirement missed: final_error of yb: " in run.stderr
    index = index_of(tmp_path / "out")
    assert index["figures"]["final_errors"] == pytest.approx(wanted, rel=1e-3)
    assert index["requirements"][0]["signal"] == "yb"


def test_members_of_an_ensemble_are_held_to_the_final_error_of_one_signal(tmp_path: Path) -> None:
    boxes = "ensemble: {initial: {plant: {z: [-0.05, 0.09]}}}"
    wishes = "{ensemble: {final_error: {y: 1e-3}}}"
    run = call("simulate", stage(tmp_path, wishes, boxes), "--ensemble", 3, "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    assert index_of(tmp_path / "out")["requirements"][0]["signal"] == "y"


def test_all_requirements_in_error_are_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(InvalidSpec) as refusal:
        load_spec(stage(tmp_path, "{a: 1, final_error: x, overshoot: {z: 1}}"))
    assert len(refusal.value.problems) == 3


def test_the_band_of_an_output_can_be_given(tmp_path: Path) -> None:
    wide, narrow = (
        simulate(load_spec(stage(tmp_path, "{norm_K: 100}", f"settled: {{y: {band}}}"))).figures.settling_time["y"]
        for band in (0.01, 1e-6)
    )
    assert wide < narrow
    assert "'z' is no output" in refused(call("check", stage(tmp_path, "{norm_K: 1}", "settled: {z: 1}")), 2)


def test_run_json_stays_readable_where_a_time_never_comes(tmp_path: Path) -> None:
    path = stage(tmp_path, "{settling_time: 5}", "disturbance: {v: {constant: 1}}", reference=BACK)
    run = call("simulate", path, "--out", tmp_path / "out")
    assert run.exit_code == 6, run.output
    index = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert index["figures"]["settling_time"] == {"y": None}
    assert index["requirements"][0]["said"] == "settling_time of y: never, at most 5 s required"


def test_what_took_too_long_to_enclose_is_said_of_the_samples_and_keeps_no_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wishes = "{largest_input: 50, final_error: 1, settling_time: 12, ensemble: {members: 1/3, largest_error: 9}}"
    path = stage(tmp_path, wishes, "ensemble: {initial: {plant: {z: [-0.05, 0.09]}}}")
    text = path.read_text(encoding="utf-8").replace("sample_time: 0.02", "sample_time: 0.5")
    path.write_text(text, encoding="utf-8")
    enclosed = simulate(load_spec(path)).figures
    assert call("simulate", path, "--ensemble", 3, "--out", tmp_path / "out").exit_code == 0
    assert index_of(tmp_path / "out")["simulation"]["sampled"] == []
    monkeypatch.setattr("pwatrack.simulation.enclosure.MOST_NUMBERS", 1)
    result = simulate(load_spec(path))
    u, error = np.abs(result.response.u).max(), result.response.error_norm
    assert result.figures.sampled == tuple(name for name in QUANTITIES if name in SIZES)
    assert result.figures.largest_input["u"] == u < 0.999 * enclosed.largest_input["u"]
    assert result.figures.final_error == error[-3:].max()
    assert " at the samples in the last tenth of the time" in result.outcome.text
    short = " ".join(call("simulate", path, "--out", tmp_path / "short").output.split())
    assert re.search(r"largest error \S+ m at the samples", short)
    assert re.search(r"u from \S+ to \S+ N at the samples \(", short)
    run = call("simulate", path, "--ensemble", 3, "--verbose", "--out", tmp_path / "out")
    assert run.exit_code == 6, run.output
    said = " ".join(run.output.split())
    assert f"largest input |u| = {u:.4g} N at the samples" in said
    assert f"missed largest_input of u: {u:.4g} N at the samples, not known between them, at most 50 N required" in said
    assert "missed largest_error: at most 9 m in 0 of 3 members, in 1 required; worst " in said
    assert "largest u (N), at the samples" in said
    assert "met: settling_time of y: " in said
    index = index_of(tmp_path / "out")
    assert index["simulation"]["sampled"] == list(result.figures.sampled)
    assert index["ensemble"]["sampled"] == sorted(result.figures.sampled)
    assert [each["met"] for each in index["requirements"]] == [False, False, True, False]


def test_limits_in_other_units_are_the_same_limits(tmp_path: Path) -> None:
    plain = load_spec(
        stage(tmp_path, "{final_error: 1e-3, settling_time: 0.25, limits: {z: [-0.002, .inf], v: [-2, 3]}}")
    )
    other = load_spec(
        stage(tmp_path, "{final_error: 1 mm, settling_time: 250 ms, limits: {z: [-2 mm, .inf], v: [-200 cm/s, 3]}}")
    )
    for one, same in zip(plain.requirements, other.requirements, strict=True):
        assert (one.figure, one.signal) == (same.figure, same.signal)
        assert same.limit == pytest.approx(one.limit, rel=1e-15)


def test_a_share_of_the_time_is_that_of_the_events(tmp_path: Path, specs: Path) -> None:
    """Against the trace: how many samples are in a cell, to one for each change; and what an element is adds up."""
    text = (specs / "gallery" / "kinked_tanks.yaml").read_text(encoding="utf-8").partition("require:")[0]
    path = tmp_path / "spec.yaml"
    path.write_text(f"{text}require: {{time_share: {{side on: 1, 'side on, overflow off': 1}}}}\n", encoding="utf-8")
    result = simulate(load_spec(path))
    side, cell = (checked.found for checked in required(result.spec, result.controller, result))
    names = result.spec.problem.plant.cell_names
    modes = result.response.trace.modes[:, [part.name for part in result.loop.flow.parts].index("plant")]
    known = 1.5 * (1 + len(result.response.trace.events)) / len(modes)
    assert cell == pytest.approx(np.mean(modes == names.index("side on, overflow off")), abs=known)
    on = [k for k, name in enumerate(names) if name.startswith("side on")]
    assert side == pytest.approx(np.isin(modes, on).mean(), abs=known)
    assert side >= cell


def test_a_cell_that_a_run_never_comes_to_has_no_share(tmp_path: Path) -> None:
    path = stage(tmp_path, "{time_share: {FAR: 0}}", reference='"0.001*sin(t)"')
    result = simulate(load_spec(stage(tmp_path, "{norm_K: 100}", reference='"0.001*sin(t)"')))
    (never, *_) = set(result.spec.problem.plant.cell_names) - set(result.figures.time_share["plant"])
    path.write_text(path.read_text(encoding="utf-8").replace("{norm_K: 100}", f"{{time_share: {{{never}: 0}}}}"))
    (checked,) = required(load_spec(path), result.controller, result)
    assert (checked.met, checked.found) == (True, 0)


def test_an_error_that_is_known_less_well_than_is_required_says_how_well(tmp_path: Path) -> None:
    """A pole of 100 kHz for two hours: what rounding may do is above a microvolt."""
    system = {"states": ["v"], "inputs": ["i"], "outputs": ["y"], "A": [[-1e5]], "B": [[1e3]], "C": [[1]]}
    spec = {"name": "RC", "system": {**system, "units": {"v": "V", "y": "V"}}}
    spec |= {"reference": {"output": 3.5}, "simulation": {"duration": 7200, "sample_time": 2}}
    for limit, known in ((1e-9, True), (1.0, False)):
        result = simulate(load_spec(spec | {"require": {"final_error": limit}}))
        (checked,) = required(result.spec, result.controller, result)
        assert checked.met
        assert ("V, known to " in checked.text) == known


PERCENT = """
name: A valve in percent
system:
  states: [z]
  inputs: [u]
  outputs: [y]
  units: {z: "%", u: "%", y: "%"}
  A: [[-1]]
  B: [[1]]
  C: [[1]]
reference: {output: {constant: 20, sine: {amplitude: 5, frequency: 1}}}
simulation: {duration: 3, sample_time: 0.01, initial: {plant: steady, observer: steady}}
require: {largest_error: 3%, final_error: 0.5 %, limits: {z: [-5 %, 30%]}, largest_input: 50}
"""


def test_what_is_in_percent_is_no_share(tmp_path: Path) -> None:
    path = tmp_path / "valve.yaml"
    path.write_text(PERCENT, encoding="utf-8")
    run = call("simulate", path, "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    found = {each["figure"]: each for each in index_of(tmp_path / "out")["requirements"]}
    assert found["largest_error"]["at most"] == 3
    assert found["final_error"]["at most"] == 0.5
    assert found["lowest"]["at least"] == -5
    assert found["highest"]["said"].startswith("highest of z: 25 %, at most 30 % required")
    assert found["largest_input"]["said"].endswith("at most 50 % required")
    path.write_text(PERCENT.replace('"%"', "m"), encoding="utf-8")
    assert refused(call("check", path), 2).count("percent of what?") == 3


def test_a_batch_says_what_it_does_not_look_at_and_which_kind_of_proof_it_is(tmp_path: Path) -> None:
    """Members are run by simulate --ensemble alone; practical tracking is not called proved."""
    (tmp_path / "specs").mkdir()
    wish = "{ensemble: {members: all, final_error: 1e-30}}"
    stage(tmp_path / "specs", wish, "ensemble: {initial: {plant: {z: [-0.05, 0.09]}}}")
    run = call("batch", tmp_path / "specs", "--out", tmp_path / "out", "--plots", "none")
    assert run.exit_code == 0, run.output
    assert "required: 1 more of an ensemble, not looked at" in " ".join(run.stdout.split())
    ended = Ended(exit=0, expected=0, messages="", faults=(), index={"verdict": "practical"})
    assert SpecOutcome.of(tmp_path, tmp_path, ended, seconds=1.0).verdict == "practical"
