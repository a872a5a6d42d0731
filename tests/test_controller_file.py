"""controller.json holds all of a controller, runs as the simulation does, and is refused where it was changed."""

import csv
import json
import random
import re
from collections.abc import Callable
from dataclasses import replace
from math import factorial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

import pwatrack
from pwatrack import Controller, Result, design, load_spec, simulate
from pwatrack.commands.verify import verify
from pwatrack.control.program import turned
from pwatrack.errors import CheckFailed, InvalidSpec
from pwatrack.export.schema import FORMAT, json_schema
from pwatrack.export.stored import differing, digest, parsed
from pwatrack.model.conditions import Sampling
from pwatrack.report.files import write_design, write_result
from tests.conftest import SPECS
from tests.test_cli import call, refused
from tests.test_outcome import cart

DOCS = SPECS.parent / "docs"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The example on a machine, for 2,000 samples of its controller, written."""
    path = tmp_path_factory.mktemp("spec") / "machine.yaml"
    text = (SPECS / "two_mass_machine.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace("duration: 60\n  sample_time: 0.01", "duration: 4\n  sample_time: 0.002"))
    result = simulate(load_spec(path))
    return write_result(result, path.parent / "run", plots="none"), result


def content(run: tuple[Path, Result]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run[0] / "controller.json").read_text(encoding="utf-8"))
    return found


def test_a_noisy_run_is_replayed_from_its_trace(tmp_path: Path) -> None:
    noise = "noise: {std: {y: 1e-3}, sample_time: 0.01, seed: 1}"
    path = cart(tmp_path, "controller: {sample_time: 0.02, delay: 1}", "quantum: {y: 1e-4}", noise, duration=2)
    run = tmp_path / "run"
    assert call("simulate", path, "--out", run, "--plots", "none").exit_code in (0, 6)
    with (run / "trace.csv").open(encoding="utf-8", newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert max(abs(row["y_measured"] - row["y"]) for row in rows) > 1e-3
    controller = Controller.load(run / "controller.json")
    assert len(rows) > 100
    assert [controller.step(np.array([row["y_measured"]]))[0] for row in rows] == [row["u"] for row in rows]


NOT_TO_BE_WRITTEN = {
    "name": ("name", "machine\n#error"),
    "a state": ("plant.states.0", "z1; */ x"),
    "an input": ("plant.inputs.0", "u\r"),
    "an output": ("plant.outputs.0", "y\n"),
    "a cell": ("plant.cells.1", "gap\u2028*/"),
    "a unit": ("plant.units.y", "m\x1b[31m"),
    "a claim": ("claims.0", "all is proved\nall of it"),
    "a remark": ("open", ["\x00"]),
    "an entry of the reference": ("program.outside.reference.0", "y\ud800"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("place", "text"), NOT_TO_BE_WRITTEN.values(), ids=NOT_TO_BE_WRITTEN)
def test_names_that_would_write_lines_of_their_own_are_refused(
    run: tuple[Path, Result], tmp_path: Path, place: str, text: Any
) -> None:
    forged = content(run)
    *steps, last = [int(step) if step.isdigit() else step for step in place.split(".")]
    part: Any = forged
    for step in steps:
        part = part[step]
    part[last] = text
    forged["sha256"] = digest(forged)
    path = tmp_path / "controller.json"
    path.write_text(json.dumps(forged), encoding="utf-8")
    with pytest.raises(InvalidSpec, match=re.escape(place)) as error:
        Controller.load(path)
    (problem,) = error.value.problems
    assert problem.message.isprintable()


def test_the_schema_in_the_docs_is_that_of_the_file() -> None:
    assert json.loads((DOCS / "controller.schema.json").read_text(encoding="utf-8")) == json_schema()


@pytest.mark.slow
def test_a_stored_controller_does_what_the_simulation_did_in_every_bit(run: tuple[Path, Result]) -> None:
    folder, result = run
    assert_the_same_bits(Controller.load(folder / "controller.json"), result, 0.002)


OF_OTHER_KINDS = {
    "carriage_on_slack_rope": 5e-4,  # the observer has more cells than the desired trajectory
    "flexible_arm": 1e-3,  # a desired trajectory that is played back
    "payload_without_sensor": 1e-3,  # loads that are estimated
    "payload_in_wind": 3e-4,  # one of them a sinusoid, with a unit
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_OTHER_KINDS)
def test_so_does_one_of_another_kind(name: str, tmp_path: Path) -> None:
    spec, h = load_spec(SPECS / "gallery" / f"{name}.yaml"), OF_OTHER_KINDS[name]
    conditions = replace(spec.scenario.conditions, sampling=Sampling(sample_time=h))
    scenario = replace(spec.scenario, conditions=conditions, duration=300 * h, sample_time=h)
    result = simulate(replace(spec, scenario=scenario), design(spec))
    folder = write_result(result, tmp_path / "run", plots="none")
    controller = Controller.load(folder / "controller.json")
    assert_the_same_bits(controller, result, h)
    (of_x_hat, of_x_d), names = controller.cells, controller.file.plant.cells
    assert of_x_hat in names
    assert of_x_d in (("1",) if name == "carriage_on_slack_rope" else names)


def assert_the_same_bits(controller: Controller, result: Result, h: float) -> None:
    at, clock = result.loop.at, result.loop.flow.clock
    assert clock is not None
    assert controller.sample_time == h
    for z in result.response.trace.z:
        u = controller.step(z[at.y])
        assert u.tobytes() == z[at.u].tobytes()
        assert controller.state("x_hat").tobytes() == z[at.x_hat].tobytes()
        if clock.program.sampling.corrects:  # what (15) makes of the reference in continuous time is in z
            away = np.abs(controller.state("eta_hat") - z[at.eta_hat]).max(initial=0.0)
            assert away <= 1e-3 * np.abs(z[at.eta_hat]).max(initial=1e-300)
        else:
            assert controller.state("eta_hat").tobytes() == z[at.eta_hat].tobytes()
        assert controller.status == 0


def test_it_starts_anew_and_takes_a_reference_from_outside(run: tuple[Path, Result]) -> None:
    controller = Controller.load(run[0] / "controller.json")
    first = [controller.step([0.1]).tolist() for _ in range(3)]
    controller.reset()
    assert [controller.step([0.1]).tolist() for _ in range(3)] == first
    with pytest.raises(ValueError, match="in some steps and not in others"):
        controller.step([0.1], [0.0, 0.0, 0.0])
    assert controller.file.program is not None
    names = controller.file.program.outside.reference
    assert names == ["y", "dy/dt", "d2y/dt2"]
    controller.reset()
    inside = np.array([controller.step([0.1]) for _ in range(50)])
    controller.reset()
    w, t = 2 * np.pi, 0.002 * np.arange(50)
    y_d = 0.15 * np.column_stack([np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t)])
    found = np.array([controller.step([0.1], row) for row in y_d]) - inside
    assert np.abs(found).max() < 1.01 * 0.15 * w**3 * 0.001  # half a sample of what is not given
    with pytest.raises(ValueError, match="1 output and 3 entries"):
        controller.step([0.1], [0.0])
    with pytest.raises(InvalidSpec, match="'z' is no part of the state: it has y, u, x_hat"):
        controller.state("z")


def test_a_measurement_that_is_no_number_holds_the_input(run: tuple[Path, Result]) -> None:
    controller = Controller.load(run[0] / "controller.json")
    u, x_hat = controller.step([0.1]), controller.state("x_hat")
    assert controller.step([np.nan]).tolist() == u.tolist()
    assert controller.status == -1
    assert controller.state("x_hat").tolist() == x_hat.tolist()


def changed(value: Any, generator: random.Random) -> Any:
    """One entry of a tree, changed, removed or of another type."""
    if isinstance(value, dict) and value:
        key = generator.choice(sorted(value))
        if generator.random() < 0.1:
            return {name: entry for name, entry in value.items() if name != key}
        return {**value, key: changed(value[key], generator)}
    if isinstance(value, list) and value:
        k = generator.randrange(len(value))
        if generator.random() < 0.1:
            return [*value[:k], *value[k + 1 :]]
        return [*value[:k], changed(value[k], generator), *value[k + 1 :]]
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return generator.choice(["x", 1.0, [], {"a": 1}])
    if isinstance(value, int):
        return value + 1
    return float(np.nextafter(value, np.inf)) if isinstance(value, float) else "x"


def test_a_file_that_was_changed_in_200_ways_is_refused(run: tuple[Path, Result]) -> None:
    """The least change of a double too; with a digest that was made to fit, what does not fit the schema or itself."""
    good, generator, refused = content(run), random.Random(1), 0
    assert parsed(good, Path("f")).format == FORMAT
    for _ in range(200):
        bad = changed(good, generator)
        assert bad != good
        with pytest.raises(InvalidSpec, match=r"digest|format|Input|valid|missing|Field|match|not permitted"):
            parsed(bad, Path("f"))
        try:
            parsed({**bad, "sha256": digest(bad)}, Path("f"))
        except InvalidSpec:
            refused += 1
    assert refused > 40  # the rest are files of other controllers


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("start", {"x_hat": [0.0], "eta_hat": []}, "start has not 4 and 2 entries"),
        ("L", [[0.0]], "L has fewer rows than there are states"),
        ("K", [[0.0]], r"K has not the shape \(1, 4\)"),
    ],
)
def test_parts_that_do_not_fit_each_other_are_refused(
    run: tuple[Path, Result], place: str, value: Any, said: str
) -> None:
    forged = {**content(run), place: value}
    with pytest.raises(InvalidSpec, match=f"f: {said}"):
        parsed({**forged, "sha256": digest(forged)}, Path("f"))


def test_an_old_version_is_refused_with_both_named(run: tuple[Path, Result], tmp_path: Path) -> None:
    old = tmp_path / "controller.json"
    old.write_text(json.dumps({**content(run), "format": "pwatrack controller 1"}))
    with pytest.raises(InvalidSpec, match="'pwatrack controller 1', this program reads 'pwatrack controller 8'"):
        Controller.load(old)
    for text in ("", "[]", "{}", "null", '{"format": 1}', "[" * 100_000, '{"format": "pwatrack controller 4"}'):
        old.write_text(text)
        with pytest.raises(InvalidSpec):
            Controller.load(old)
    with pytest.raises(InvalidSpec, match="cannot read"):
        Controller.load(tmp_path / "none.json")


def test_a_number_that_is_not_finite_is_refused(run: tuple[Path, Result], tmp_path: Path) -> None:
    text = (run[0] / "controller.json").read_text(encoding="utf-8")
    file = tmp_path / "controller.json"
    file.write_text(text.replace('"sample_time": 0.002', '"sample_time": Infinity'))
    with pytest.raises(InvalidSpec, match=r"program\.sample_time"):
        Controller.load(file)


def test_a_controller_that_is_not_sampled_has_no_steps(tmp_path: Path) -> None:
    spec = load_spec(SPECS / "two_mass_paper_gains.yaml")
    folder = write_design(spec, design(spec), tmp_path / "run")
    with pytest.raises(InvalidSpec, match="no sample time"):
        Controller.load(folder / "controller.json")


@pytest.mark.slow
def test_a_stored_controller_is_simulated_and_is_no_other(tmp_path: Path) -> None:
    path = cart(tmp_path, "controller: {sample_time: 0.01}", duration=2)
    assert call("simulate", path, "--out", tmp_path / "one").exit_code == 0
    stored = tmp_path / "one" / "controller.json"
    again = call("simulate", path, "--out", tmp_path / "two", "--controller", stored)
    assert again.exit_code == 0, again.output
    assert (tmp_path / "two" / "trace.csv").read_bytes() == (tmp_path / "one" / "trace.csv").read_bytes()
    slower = cart(tmp_path, "controller: {sample_time: 0.02}", duration=2)
    error = refused(call("simulate", slower, "--out", tmp_path / "two", "--controller", stored), 2)
    assert "not one for this spec: program.sample_time is 0.01, not 0.02" in error
    unsampled = cart(tmp_path, duration=2)
    call("simulate", unsampled, "--out", tmp_path / "three", "--controller", stored)
    traces = [(tmp_path / name / "trace.csv").read_bytes() for name in ("one", "three")]
    assert traces[0] == traces[1]  # at the sample time of the file
    other = cart(tmp_path, reference="0.07*cos(t)", duration=2)
    error = refused(call("simulate", other, "--out", tmp_path / "two", "--controller", stored), 2)
    assert "the stored controller is not one for this spec: trajectory.reference" in error


def test_gains_stand_on_the_controller() -> None:
    controller = pwatrack.design(load_spec(SPECS / "two_mass_paper_gains.yaml"))
    assert controller.K is controller.design.K
    assert controller.L is controller.design.L


ODD_UNITS = """
name: A stage in Gm and nm/s
system:
  states: [z, v]
  inputs: [F]
  outputs: [y]
  A: [[0, 1e-18], [0, -4]]
  B: [[0], [5e8]]
  C: [[1e9, 0]]
  nonlinearities: [{name: bumper, kind: spring, of: z, start: 1e-10, slope: 6e10, into: {v: -5e8}}]
reference: {output: {sine: {amplitude: 0.15, frequency: 1}}}
simulation: {duration: 5, sample_time: 0.01, initial: {plant: [2e-11, 0]}, controller: {sample_time: 0.01}}
"""
CHANGES: dict[str, Callable[[Any], None]] = {
    "the sign of a small gain": lambda program: program["K"][0].__setitem__(1, -program["K"][0][1]),
    "a constant of the observer": lambda program: program["observer"][1][0].__setitem__(-1, 1e-11),
    "what a measurement corrects": lambda program: program["M"][0].__setitem__(0, 1.001 * program["M"][0][0]),
    "a lower limit": lambda program: program["low"].__setitem__(0, -1.0),
    "where the reference begins": lambda program: program["inside"]["w0"].__setitem__(0, 7.0),
    "what is proved": lambda program: program.__setitem__("proved", "errors are 0 after one sample"),
}


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [True, False])
def test_a_program_is_compared_whole_in_whatever_units_it_is(tmp_path: Path, sampled: bool) -> None:
    """Without a sample time in the spec it is that of an export."""
    path, run = tmp_path / "odd.yaml", tmp_path / "run"
    text = ODD_UNITS if sampled else ODD_UNITS.replace(", controller: {sample_time: 0.01}", "")
    path.write_text(text, encoding="utf-8")
    if sampled:
        assert call("design", path, "--out", run).exit_code == 0
    else:
        assert call("export", "c", path, "--sample-time", "0.01", "--out", run).exit_code == 0
    verify(run / "certificate.json", path)
    file = run / "controller.json"
    told = file.read_text(encoding="utf-8")
    for change in CHANGES.values():
        forged = json.loads(told)
        change(forged["program"])
        file.write_text(json.dumps(forged | {"sha256": digest(forged)}), encoding="utf-8")
        with pytest.raises(CheckFailed, match=r"program in controller\.json is not what was proved"):
            verify(run / "certificate.json", path)


def test_ends_of_an_interval_are_compared_together() -> None:
    """One of them may be rounding of the other, as other processors make it; another kind of number may not."""
    told, made = {"from": -1.5e-12, "to": 4.0, "unit": "m"}, {"from": -1.6e-12, "to": 4.0, "unit": "m"}
    assert not list(differing(told, made, "y"))
    assert list(differing(told | {"from": -1e-6}, made, "y"))
    assert list(differing(told | {"unit": "mm"}, made, "y"))
    assert list(differing(told | {"bits": -1.5e-12}, made | {"bits": -1.6e-12}, "y"))


def test_a_polynomial_is_turned_without_rounding_for_as_long_as_a_program_runs() -> None:
    """Its chain beside a sinusoid, 2²⁰ samples at once: powers of two, so every entry is exact."""
    chain, turning, t = np.diag([1.0, 1.0, 1.0], 1), np.array([[0.0, -0.5], [0.5, 0.0]]), 2.0**15
    found = turned(block_diag(chain, turning) * t)
    exact = [[t ** (k - j) / factorial(k - j) if k >= j else 0.0 for k in range(4)] for j in range(4)]
    np.testing.assert_allclose(found[:4, :4], exact, rtol=1e-15, atol=0)
    c, s = np.cos(t / 2), np.sin(t / 2)
    np.testing.assert_allclose(found[4:, 4:], [[c, -s], [s, c]], atol=1e-11)
    assert not found[:4, 4:].any()
    assert not found[4:, :4].any()
