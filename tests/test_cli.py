import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner
from typer.testing import Result as Run

from pwatrack import design, load_spec, simulate
from pwatrack.cli import app
from pwatrack.report.run_folder import read_index

PUSHED = ("--set", "d1=-0.5")  # the load is driven on: zero dynamics that are unstable in every cell


def call(*arguments: object, pictures: bool = False) -> Run:
    """Run a command; a simulation draws pictures only where a test looks at them, since they take most of its time."""
    asked = [str(a) for a in arguments]
    if asked[0] == "simulate" and not pictures and "--plots" not in asked:
        asked += ["--plots", "none"]
    return CliRunner().invoke(app, asked)


def refused(run: Run, code: int) -> str:
    assert run.exit_code == code, run.output
    assert run.stdout == ""
    assert run.stderr.startswith("error: ")
    assert "Traceback" not in run.output
    return str(run.stderr)


def shortened(source: Path, target: Path, *replacements: tuple[str, str]) -> Path:
    """Copy a spec with 2 s of simulation and further replacements."""
    text = source.read_text(encoding="utf-8")
    for old, new in (("duration: 60", "duration: 2"), *replacements):
        assert old in text
        text = text.replace(old, new)
    target.write_text(text, encoding="utf-8")
    return target


def index_of(folder: Path) -> dict[str, Any]:
    index = read_index(folder)
    assert index is not None
    return index


def contents(folder: Path) -> dict[str, bytes | None]:
    return {p.name: p.read_bytes() if p.is_file() else None for p in folder.iterdir()}


@pytest.fixture
def spec(specs: Path, tmp_path: Path) -> Path:
    return shortened(specs / "two_mass_paper_gains.yaml", tmp_path / "plant.yaml")


@pytest.fixture(scope="module")
def simulated(specs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Run]:
    """A spec, its run folder and how the run went."""
    folder = tmp_path_factory.mktemp("simulated")
    path = shortened(specs / "two_mass_paper_gains.yaml", folder / "plant.yaml")
    return path, folder / "out", call("simulate", path, "-v", "--out", folder / "out", pictures=True)


def test_check_says_what_the_plant_is(spec: Path) -> None:
    run = call("check", spec)
    assert run.exit_code == 0
    assert "relative degree" in run.stdout
    assert "gap: integrates" in run.stdout
    assert "A controller can be designed: exact tracking, Theorem 3" in " ".join(run.stdout.split())
    assert run.stderr == ""


def test_check_writes_no_file(spec: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(spec.parent)
    assert call("check", spec).exit_code == 0
    assert set(contents(spec.parent)) == {spec.name}


@pytest.mark.slow
def test_simulate_ends_with_0_and_names_its_files_on_stdout(simulated: tuple[Path, Path, Run]) -> None:
    _, out, run = simulated
    assert run.exit_code == 0, run.output
    assert "proved for all 3 cells" in run.stdout
    assert all(name in run.stdout for name in contents(out))


def test_the_folder_holds_what_the_index_names_and_no_stray_file(simulated: tuple[Path, Path, Run]) -> None:
    _, out, _ = simulated
    index = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert set(contents(out)) == {*index["files"], "run.json"}
    assert {"gains.json", "certificate.json", "generator.json", "trace.csv", "events.csv"} < set(index["files"])
    assert all((out / name).stat().st_size > 0 for name in index["files"])
    assert index["spec_sha256"] == load_spec(simulated[0]).sha256


def test_the_trace_read_back_has_every_bit_of_the_result_of_the_library(
    simulated: tuple[Path, Path, Run],
) -> None:
    path, out, _ = simulated
    response = simulate(load_spec(path)).response
    with (out / "trace.csv").open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    read = dict(zip(header, np.array(rows).T, strict=True))
    assert len(read) == len(header)
    expected = {"t": response.t, "y": response.y, "y_d": response.y_d, "u": response.u, "u_ff": response.u_ff}
    for k, state in enumerate(("z1", "v1", "z2", "v2")):
        expected |= {state: response.x[:, k], f"{state}_hat": response.x_hat[:, k]}
        expected |= {f"{state}_d": response.x_d[:, k]}
    for k in range(response.eta_hat.shape[1]):
        expected[f"eta_hat{k + 1}"] = response.eta_hat[:, k]
    for name, values in expected.items():
        assert read[name].astype(float).tobytes() == np.ascontiguousarray(values).tobytes(), name
    cells = [read[f"cell_{part}"].astype(int) for part in ("plant", "observer", "generator")]
    assert np.array_equal(np.transpose(cells), response.trace.modes)
    assert set(header) == {*expected, "cell_plant", "cell_observer", "cell_generator"}


def test_the_events_read_back_are_those_of_the_library(simulated: tuple[Path, Path, Run]) -> None:
    path, out, _ = simulated
    events = simulate(load_spec(path)).response.trace.events
    with (out / "events.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows
    assert {float(row["t"]) for row in rows} == {event.t for event in events}
    assert {row["from_cell"] for row in rows} <= {"upper spring", "gap", "lower spring"}


def test_the_gains_read_back_are_those_of_the_library(simulated: tuple[Path, Path, Run]) -> None:
    path, out, _ = simulated
    gains = json.loads((out / "gains.json").read_text(encoding="utf-8"))
    found = design(load_spec(path)).design
    assert (gains["K"], gains["L"]) == (found.K.tolist(), found.L.tolist())


def test_the_columns_of_the_trace_have_different_names(simulated: tuple[Path, Path, Run]) -> None:
    _, out, _ = simulated
    header = (out / "trace.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert len(set(header)) == len(header)
    assert {"t", "z1", "z1_hat", "z1_d", "eta_hat1", "y", "y_d", "u", "u_ff", "cell_plant"} < set(header)


@pytest.mark.parametrize(
    "name",
    ["z2_hat", "z2_d", "y_d", "u_ff", "eta_hat1", "cell_plant", "cell_observer", "cell_generator", "cell_actuator_u"],
)
def test_a_state_is_not_called_like_another_column_of_the_trace(spec: Path, name: str) -> None:
    spec.write_text(spec.read_text(encoding="utf-8").replace("z1", name), encoding="utf-8")
    message = refused(call("check", spec), 2)
    assert f"'{name}' is how the trace names " in message
    assert message.count("error: ") == 1


@pytest.mark.parametrize("command", ["check", "design", "simulate"])
def test_an_invalid_spec_ends_with_2_and_every_error_on_a_line_of_its_own(
    spec: Path, tmp_path: Path, command: str
) -> None:
    spec.write_text(spec.read_text(encoding="utf-8").replace("-k2/m1", "-q/m1").replace("sample_time: 0.01", ""))
    out = () if command == "check" else ("--out", tmp_path / "out")
    message = refused(call(command, spec, *out), 2)
    assert len(re.findall(rf"^error: {re.escape(str(spec))}:\d+:\d+: ", message, re.MULTILINE)) == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["check", "design", "simulate"])
def test_a_discontinuous_field_ends_with_3_and_its_place(specs: Path, tmp_path: Path, command: str) -> None:
    out = () if command == "check" else ("--out", tmp_path / "out")
    message = refused(call(command, specs / "refused" / "printed_A1.yaml", *out), 3)
    assert re.match(r"error: .*printed_A1\.yaml:\d+:\d+: ", message)
    assert "'gap'" in message
    if command != "check":
        index = index_of(tmp_path / "out")
        assert (index["verdict"], index["exit"], index["simulation"]) == ("outside the theory", 3, None)
        assert f"error: {index['reasons'][0]['place']}: {index['reasons'][0]['message']}" in message
        assert contents(tmp_path / "out").keys() == {"run.json"}


@pytest.mark.parametrize("name", ["printed_gains.yaml", "tank_without_outlet.yaml"])
@pytest.mark.parametrize("command", ["design", "simulate"])
def test_what_is_proved_infeasible_ends_with_4_and_its_place(
    specs: Path, tmp_path: Path, command: str, name: str
) -> None:
    message = refused(call(command, specs / "refused" / name, "--out", tmp_path / "out"), 4)
    assert re.match(rf"error: .*{name}:\d+:\d+: ", message)
    assert contents(tmp_path / "out").keys() == {"refusal.json", "run.json", "spec.txt"}
    assert (index_of(tmp_path / "out")["verdict"], index_of(tmp_path / "out")["exit"]) == ("infeasible", 4)
    assert call("verify", tmp_path / "out").exit_code == 0


def test_an_initial_state_of_the_generator_of_a_wrong_length_ends_with_2(specs: Path, tmp_path: Path) -> None:
    path = shortened(
        specs / "two_mass_paper_gains.yaml", tmp_path / "plant.yaml", ("generator: [0.2, 0]", "generator: [0.2]")
    )
    message = refused(call("simulate", path, "--out", tmp_path / "out"), 2)
    assert "simulation.initial.generator: 1 entries, expected 2" in message.replace("1 entry", "1 entries")


@pytest.mark.parametrize(
    "arguments",
    [
        ["check", "missing.yaml"],
        ["check", "."],
        ["check"],
        ["frobnicate"],
        ["simulate", "missing.yaml", "--nope"],
        ["batch", "missing"],
        ["batch", ".", "--jobs", "0"],
    ],
)
def test_a_wrong_command_line_ends_with_2_and_no_traceback(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = call(*arguments)
    assert run.exit_code == 2
    assert run.stderr
    assert run.stdout == ""
    assert "Traceback" not in run.output
    assert contents(tmp_path) == {}


@pytest.mark.parametrize("text", ["k2", "=1", "k2=", "kk=1", "k2=no", "k2=0.3=4", "k2=__import__('os')", "pi=3"])
def test_a_parameter_that_cannot_be_set_ends_with_2(spec: Path, text: str) -> None:
    assert text.partition("=")[0] in refused(call("check", spec, "--set", text), 2)


def test_an_unknown_solver_ends_with_2(spec: Path, tmp_path: Path) -> None:
    run = call("design", spec, "--solver", "mosek", "--out", tmp_path / "out")
    assert (run.exit_code, run.stdout) == (2, "")
    assert all(name in run.stderr for name in ("mosek", "structured", "clarabel", "cvxopt"))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_command_line_replaces_parameters_and_solver(spec: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run = call("design", spec, "--set", "k2=0.3", "--set", "k3 = k2", "--solver", "cvxopt", "--out", out)
    assert run.exit_code == 0, run.output
    index = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert (index["parameters"]["k2"], index["parameters"]["k3"], index["solver"]) == (0.3, 0.3, "cvxopt")


@pytest.mark.parametrize("solver", ["structured", "clarabel", "cvxopt"])
def test_the_solver_that_is_named_is_the_one_that_answers(specs: Path, tmp_path: Path, solver: str) -> None:
    run = call("design", specs / "two_mass_backlash.yaml", "--solver", solver, "--out", tmp_path)
    assert run.exit_code == 0, run.output
    index = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    assert index["figures"]["controller_rate"] > 0
    assert index["solver"] == solver
    assert index["answered"].keys() - {"nobody"} == {solver}
    assert index["answered"][solver] > 20, "those of the bounds, too"


def test_without_out_the_run_folder_is_named_for_the_spec(spec: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(spec.parent)
    assert call("design", spec).exit_code == 0
    assert (spec.parent / "runs" / "plant" / "gains.json").is_file()


@pytest.mark.slow
def test_a_folder_tells_the_last_run_alone_whatever_came_of_it(spec: Path, specs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for arguments, code, verdict in (
        (("simulate", spec), 0, "proved"),
        (("design", spec, *PUSHED), 4, "infeasible"),
        (("design", spec), 0, "proved"),
        (("simulate", specs / "refused" / "printed_A1.yaml"), 3, "outside the theory"),
    ):
        run = call(*arguments, "--out", out)
        assert (run.exit_code, index_of(out)["verdict"]) == (code, verdict), run.output
        assert set(contents(out)) == {*index_of(out)["files"], "run.json"}
        assert ("refusal.json" in contents(out)) == (code == 4)
        assert ("gains.json" in contents(out)) == (code == 0)


def test_an_invalid_spec_changes_no_earlier_result_and_says_so(spec: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call("design", spec, "--out", out).exit_code == 0
    before = contents(out)
    message = refused(call("simulate", spec, "--out", out, "--set", "q=1"), 2)
    assert "the earlier results" in message
    assert contents(out) == before


def test_a_refusal_whose_folder_cannot_be_written_is_still_that_refusal(spec: Path) -> None:
    message = refused(call("design", spec, "--out", spec, *PUSHED), 4)
    assert "cannot write results" in message


def test_what_only_an_earlier_run_had_is_dropped_and_other_files_stay(
    simulated: tuple[Path, Path, Run], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name, content in contents(simulated[1]).items():
        (out / name).write_bytes(content or b"")
    (out / "notes.txt").write_text("mine")
    assert (out / "trace.csv").exists()
    assert call("design", simulated[0], "--out", out).exit_code == 0
    made = {
        "gains.json",
        "certificate.json",
        "bounds.json",
        "generator.json",
        "controller.json",
        "run.json",
        "spec.txt",
        "summary.txt",
    }
    assert set(contents(out)) == {*made, "notes.txt"}


def test_an_index_that_is_no_index_of_ours_removes_nothing(spec: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "sub").mkdir(parents=True)
    (tmp_path / "precious.txt").write_text("mine")
    (out / "run.json").write_text('{"files": ["../precious.txt", "sub", "..", ".", "", 3, null]}')
    assert call("design", spec, "--out", out).exit_code == 0
    assert (tmp_path / "precious.txt").read_text() == "mine"
    assert (out / "sub").is_dir()


@pytest.mark.parametrize("content", ["{", "[" * 100_000, '{"files": 3}', "\udcff"])
def test_an_earlier_index_that_cannot_be_read_is_replaced(spec: Path, tmp_path: Path, content: str) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    assert call("design", spec, "--out", out).exit_code == 0
    assert "gains.json" in json.loads((out / "run.json").read_text(encoding="utf-8"))["files"]


@pytest.mark.parametrize("out", ["plant.yaml", "plant.yaml/below"])
def test_a_folder_that_cannot_be_written_ends_with_2(spec: Path, out: str) -> None:
    before = contents(spec.parent)
    assert "cannot write results" in refused(call("design", spec, "--out", spec.parent / out), 2)
    assert contents(spec.parent) == before


@pytest.mark.slow
@pytest.mark.parametrize(("error", "code"), [(OSError(28, "No space left on device"), 2), (ValueError("a fault"), 1)])
def test_a_fault_while_writing_leaves_no_temporary_file_and_the_earlier_results(
    spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, code: int
) -> None:
    def fail(*_: object) -> None:
        raise error

    out = tmp_path / "out"
    assert call("design", spec, "--out", out).exit_code == 0
    before = contents(out)
    monkeypatch.setattr("pwatrack.report.plots.pictures.pictures", fail)
    monkeypatch.setattr("pwatrack.cores.cores", lambda: 1)  # where no other process draws
    message = refused(call("simulate", spec, "--out", out, pictures=True), code)
    assert str(error.args[-1]) in message
    assert contents(out) == before


def test_a_folder_that_stands_in_the_way_of_a_file_changes_no_other_file(spec: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call("design", spec, "--out", out).exit_code == 0
    (out / "generator.json").unlink()
    (out / "generator.json").mkdir()
    before = contents(out)
    refused(call("design", spec, "--out", out, "--set", "k2=0.3"), 2)
    assert contents(out) == before


@pytest.mark.parametrize("name", ["[/gap]", "[red]gap", "[k1]"])
def test_a_name_with_brackets_is_printed_as_it_is(specs: Path, tmp_path: Path, name: str) -> None:
    path = shortened(specs / "two_mass_paper_gains.yaml", tmp_path / "plant.yaml", ("name: gap", f'name: "{name}"'))
    run = call("check", path, "-v")
    assert run.exit_code == 0, run.output
    assert f"{name}: integrates" in call("check", path).stdout
    assert f"{name}: " in run.stdout


def test_a_unit_in_brackets_is_printed_as_it_is(specs: Path, tmp_path: Path) -> None:
    units = (("u: N", 'u: "[N]"'), ("y: m}", 'y: "[/m]"}'))
    path = shortened(specs / "two_mass_paper_gains.yaml", tmp_path / "plant.yaml", *units)
    run = call("simulate", path, "-v", "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    assert "[N]" in run.stdout
    assert "[/m]" in run.stdout


@pytest.mark.slow
def test_names_that_matplotlib_would_read_as_formulas_are_drawn_as_they_are(specs: Path, tmp_path: Path) -> None:
    """And one with a sign that its font does not have."""
    names = (
        ("name: Two", r"name: $\nope$ 二 Two"),
        ("name: gap", r"name: $\nope$"),
        ("y: m}", r"y: $\nope$}"),
    )
    path = shortened(specs / "two_mass_paper_gains.yaml", tmp_path / "plant.yaml", *names)
    run = subprocess.run(
        [sys.executable, "-m", "pwatrack", "simulate", path, "--out", tmp_path / "out"],
        capture_output=True,
        check=False,
    )
    assert (run.returncode, run.stderr) == (0, b"")


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_a_terminal_that_cannot_print_greek_loses_no_result(spec: Path, tmp_path: Path, encoding: str) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "pwatrack", "design", spec, "-v", "--out", tmp_path / "out"],
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": encoding},
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert run.stderr == b""
    assert b"proved for all 3 cells" in run.stdout


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["check", "--help"], ["simulate", "--help"]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    run = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "pwatrack", *arguments],
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=True,
    )
    imported = {line.rsplit("|", 1)[1].strip().split(".")[0] for line in run.stderr.splitlines() if "|" in line}
    assert "pwatrack" in imported
    assert imported & {"matplotlib", "picos", "scipy", "clarabel", "cvxopt", "numpy"} == set()


@pytest.mark.parametrize("command", ["check", "design", "simulate", "batch"])
def test_the_help_of_a_command_shows_an_example(command: str) -> None:
    run = call(command, "--help")
    assert run.exit_code == 0
    assert f"Example: pwatrack {command}" in " ".join(run.stdout.split())


def test_a_bug_is_said_on_a_line_with_exit_code_1(spec: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr("pwatrack.spec.load.load_spec", fail)
    message = refused(call("check", spec), 1)
    assert "bug" in message
    assert "ZeroDivisionError: a fault" in message


def test_the_module_passes_its_exit_code_to_the_shell(specs: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "pwatrack", "check", specs / "refused" / "printed_A1.yaml"],
        capture_output=True,
        check=False,
    )
    assert (run.returncode, run.stdout) == (3, b"")
    assert b"Traceback" not in run.stderr


def test_check_speaks_json_for_machines(spec: Path) -> None:
    run = call("check", spec, "--json")
    assert run.exit_code == 0
    content = json.loads(run.stdout)
    assert content["cells"] == ["upper spring", "gap", "lower spring"]
    assert content["relative_degrees"] == [2]
    assert content["form_11"] is True
    assert len(content["facets"]) == 2
    assert content["zero_dynamics"]["gap"][0] == pytest.approx([-0.15, 0.98869], abs=1e-4)
    assert content["routes"]["Theorem 2"] == "needs (8) and (9), and an x_d that satisfies (3)"
    assert content["design_takes"] == "Theorem 3, else practical tracking"


def test_check_takes_a_plant_for_state_tracking(specs: Path) -> None:
    run = call("check", specs / "gallery" / "two_driven_carts.yaml", "--verbose")
    assert run.exit_code == 0
    told = " ".join(run.stdout.split())
    assert "Theorem 3 no: as the paper has it, it is about one input and one output, the plant has 2 and" in told
    assert "design takes Theorem 2" in told


@pytest.mark.parametrize("option", [("--over", "noise"), ("--seed", 2)])
def test_what_goes_with_an_ensemble_is_refused_without_one(
    option: tuple[str, object], spec: Path, tmp_path: Path
) -> None:
    run = call("simulate", spec, *option, "--out", tmp_path / "out")
    assert run.exit_code == 2
    assert "--ensemble" in run.stderr


THIN = """
name: Cart
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  B: [[0], [1]]
  C: [[1, 0]]
  cells:
    - {name: free, where: ["z <= 0.1"], A: [[0, 1], [-1, -1]]}
    - {name: nowhere, where: ["z >= 0.1", "z <= 0.1"], A: [[0, 1], [-1, -1]]}
    - {name: stop, where: ["z >= 0.1"], A: [[0, 1], [-2, -1]], b: [0, 0.1]}
reference: {output: "0.2*sin(t)"}
simulation: {duration: 1, sample_time: 0.01}
"""


def test_a_cell_that_is_left_out_is_remarked_by_every_command(tmp_path: Path) -> None:
    path = tmp_path / "thin.yaml"
    path.write_text(THIN, encoding="utf-8")
    remark = "remark cell 'nowhere' has no interior and is left out"
    out = tmp_path / "out"
    for arguments in (("check", path), ("design", path, "--out", out), ("simulate", path, "--out", out)):
        run = call(*arguments)
        assert run.exit_code == 0, run.output
        assert remark in " ".join(run.stdout.split())
        if arguments[0] != "check":
            assert index_of(out)["remarks"] == [remark.removeprefix("remark ")]


def shell(command: str, *arguments: object) -> "subprocess.CompletedProcess[str]":
    line = [sys.executable, "-m", "pwatrack", *map(str, arguments)]
    return subprocess.run(
        ["bash", "-c", command, "bash", *line], capture_output=True, text=True, encoding="utf-8", check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [("--version",), ("check", "specs/two_mass_backlash.yaml")])
def test_output_that_nobody_takes_is_no_bug(arguments: tuple[str, ...]) -> None:
    full = shell('"$@" > /dev/full', *arguments)
    assert (full.returncode, full.stderr) == (2, "error: cannot print: No space left on device\n")
    assert shell('"$@" > /dev/full 2> /dev/full', *arguments).returncode == 2
    closed = shell('"$@" >&-', *arguments)
    assert (closed.returncode, closed.stderr) == (0, "")
    pipe = shell('"$@" | true; exit ${PIPESTATUS[0]}', *arguments)
    assert (pipe.returncode, pipe.stderr) == (141, "")


def in_group(number: int) -> bool:
    try:
        os.killpg(number, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_an_interrupted_run_ends_with_130_and_changes_nothing(specs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shortened(specs / "two_mass_paper_gains.yaml", tmp_path / "plant.yaml", ("duration: 2", "duration: 800"))
    assert call("design", specs / "two_mass_paper_gains.yaml", "--out", out).exit_code == 0
    before = contents(out)
    command = [sys.executable, "-m", "pwatrack", "simulate", str(tmp_path / "plant.yaml"), "--out", str(out)]
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        while process.poll() is None and not list(out.glob(".*/trace.csv")):
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate()
    assert (process.returncode, said) == (130, "")
    assert contents(out) == before
    limit = time.monotonic() + 30
    while in_group(process.pid) and time.monotonic() < limit:
        time.sleep(0.02)
    assert not in_group(process.pid)  # those that drew are gone too


@pytest.mark.parametrize("name", ["..yaml", "...yaml"])
def test_a_spec_whose_name_is_dots_has_a_run_folder_of_its_own(
    spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    spec.rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert call("design", tmp_path / name).exit_code == 0
    assert set(contents(tmp_path)) == {name, "runs"}
    assert set(contents(tmp_path / "runs")) == {name}


def test_what_overflows_on_the_way_is_no_word_on_stderr() -> None:
    program = "import warnings, pwatrack.__main__ as m; m.app = lambda **_: warnings.warn('x', RuntimeWarning); m.run()"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert run.stderr == b""
