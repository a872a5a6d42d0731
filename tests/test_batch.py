import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from junitparser import JUnitXml
from typer.testing import CliRunner

import pwatrack.batch.run as batch
from pwatrack.batch.run import Outcome, called, find_specs, run_batch
from pwatrack.cli import app
from pwatrack.errors import InvalidSpec
from pwatrack.report.batch import write_junit
from pwatrack.report.run_folder import read_index
from pwatrack.spec.load import expected_exit, load_spec

Stand = Callable[..., Path]

PROGRAMS = {
    "killed": "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
    "slow": "import time; time.sleep(30)",
    "noisy": "import sys; sys.stderr.buffer.write(b'\\x1b[31mred\\x00 \\xff <&>]]>'); sys.exit(1)",
}


@pytest.fixture
def stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stand:
    """Return a function that makes a folder of specs, each run by a stand-in that its name chooses.

    `exit3 …` ends with 3; the names in PROGRAMS run those.
    """
    call = batch.called

    def stand_in(command: Sequence[str], timeout: float) -> tuple[int | None, str]:
        (path,) = (part for part in command if part.lower().endswith((".yaml", ".yml")))
        kind = Path(path).stem.split(" ")[0].lower()
        program = PROGRAMS.get(kind) or f"import sys; sys.exit({kind.removeprefix('exit')})"
        return call([sys.executable, "-S", "-c", program], timeout)

    def make(**names: str) -> Path:
        folder = tmp_path / "specs"
        folder.mkdir(exist_ok=True)
        for name, content in names.items():
            (folder / f"{name.replace('_', ' ')}.yaml").write_text(content, encoding="utf-8")
        return folder

    monkeypatch.setattr(batch, "called", stand_in)
    return make


def expecting(code: int) -> str:
    return f"name: x\nexpect: {{exit: {code}}}\n"


def ends(outcomes: list[Outcome]) -> list[tuple[str, int | None, bool, int]]:
    return [(o.spec.stem, o.exit, o.passed, o.code) for o in outcomes]


@pytest.fixture(scope="module")
def mixed(specs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good spec, one in error, two that are refused as they expect and one unexpectedly."""
    folder = tmp_path_factory.mktemp("mixed")
    (folder / "below").mkdir()
    good = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8").replace("duration: 60", "duration: 2")
    jump = (specs / "refused" / "printed_A1.yaml").read_text(encoding="utf-8")
    (folder / "good.yaml").write_text(good, encoding="utf-8")
    (folder / "below" / "good.yml").write_text(good, encoding="utf-8")
    (folder / "invalid.yaml").write_text(good.replace("sample_time", "sample_tim"), encoding="utf-8")
    (folder / "jump.yaml").write_text(jump, encoding="utf-8")
    (folder / "jump_unexpected.yaml").write_text(jump.replace("expect:", "#"), encoding="utf-8")
    (folder / "broken_as_expected.yaml").write_text("expect: {exit: 2}\nname: x\n", encoding="utf-8")
    (folder / "notes.txt").write_text("no spec")
    return folder


MIXED = [
    ("good", 0, True, 0),
    ("broken_as_expected", 2, True, 0),
    ("good", 0, True, 0),
    ("invalid", 2, False, 2),
    ("jump", 3, True, 0),
    ("jump_unexpected", 3, False, 3),
]


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_spec_ends_the_same_however_many_run_at_a_time(mixed: Path, tmp_path: Path, jobs: int) -> None:
    outcomes = run_batch(mixed, tmp_path / "out", jobs=jobs)
    assert ends(outcomes) == MIXED
    assert [bool(o.figures) for o in outcomes] == [True, False, True, False, False, False]
    assert "sample_tim" in outcomes[3].messages
    assert ":" in outcomes[5].messages
    made = {path.parent.relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("run.json")}
    assert made == {Path("good"), Path("below/good"), Path("jump"), Path("jump_unexpected")}
    assert read_index(tmp_path / "out" / "jump") is not None


def test_the_command_line_prints_every_spec_and_ends_with_the_largest_code(mixed: Path, tmp_path: Path) -> None:
    report = tmp_path / "reports" / "junit.xml"
    arguments = ["batch", str(mixed), "--out", str(tmp_path / "out"), "--jobs", "2", "--junit", str(report)]
    run = CliRunner().invoke(app, arguments)
    assert run.exit_code == 3, run.output
    assert "4 passed, 2 failed" in run.stdout
    assert "sample_tim" in run.stderr
    assert "Traceback" not in run.output
    assert [path.name for path in report.parent.iterdir()] == ["junit.xml"]
    (suite,) = JUnitXml.fromfile(str(report))
    assert (suite.tests, suite.failures, suite.errors, suite.skipped) == (6, 2, 0, 0)
    failed = {Path(case.name).stem: case.result[0] for case in suite if case.result}
    assert set(failed) == {"invalid", "jump_unexpected"}
    assert "exit 2, expected 0" in failed["invalid"].message
    assert "sample_tim" in failed["invalid"].text
    assert all(case.time >= 0 for case in suite)


def test_a_spec_whose_process_is_killed_stops_no_other(stand: Stand, tmp_path: Path) -> None:
    outcomes = run_batch(stand(exit0_a="", killed="", exit0=""), tmp_path / "out")
    assert [o.spec.stem for o in outcomes] == ["exit0 a", "exit0", "killed"]
    killed = outcomes[2]
    assert (killed.exit, killed.passed, killed.code, killed.verdict) == (-9, False, 1, "killed by signal 9")
    assert [o.passed for o in outcomes[:2]] == [True, True]


def test_a_spec_that_runs_out_of_time_stops_no_other(stand: Stand, tmp_path: Path) -> None:
    outcomes = run_batch(stand(slow="", exit0="", exit3=expecting(3)), tmp_path / "out", timeout=1.5)
    slow = next(o for o in outcomes if o.spec.stem == "slow")
    assert (slow.exit, slow.passed, slow.code, slow.verdict) == (None, False, 6, "out of time")
    assert "1.5 s" in slow.messages
    assert {o.spec.stem for o in outcomes if o.passed} == {"exit0", "exit3"}


@pytest.mark.parametrize(
    ("names", "code"),
    [
        ({"exit0": ""}, 0),
        ({"exit0": expecting(0), "exit4": expecting(4)}, 0),
        ({"exit2": "", "exit4": "", "exit3": ""}, 4),
        ({"exit5": "", "exit4": expecting(4)}, 5),
        ({"exit0": expecting(4)}, 6),
        ({"exit3": expecting(4)}, 3),
        ({"exit1": expecting(1)}, 1),
        ({"exit2": expecting(1)}, 2),
        ({"killed": "", "exit0": ""}, 1),
        ({"killed": expecting(1)}, 1),
        ({"exit2": "a: ["}, 2),
        ({"exit2": "broken: &a\nexpect: {exit: 4}"}, 2),
    ],
)
def test_a_batch_ends_with_the_largest_code_of_those_that_failed(
    stand: Stand, tmp_path: Path, names: dict[str, str], code: int
) -> None:
    run = CliRunner().invoke(app, ["batch", str(stand(**names)), "--out", str(tmp_path / "out")])
    assert run.exit_code == code, run.output
    assert f"{len(names)} passed, 0 failed" in run.stdout or code


def test_the_outcomes_come_in_order_of_the_paths_with_several_jobs(stand: Stand, tmp_path: Path) -> None:
    names = {f"exit{code}_{k}": expecting(code) for k in range(3) for code in (0, 3, 4)}
    folder = stand(**names)
    one, many = (run_batch(folder, tmp_path / "out", jobs=jobs) for jobs in (1, 4))
    assert ends(one) == ends(many)
    assert [o.spec for o in one] == sorted(o.spec for o in one)
    assert all(o.passed for o in one)


@pytest.mark.parametrize("name", ["missing", "empty", "file"])
def test_a_folder_without_specs_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").touch()
    (tmp_path / "empty" / "folder.yaml").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(InvalidSpec, match=r"no \.yaml file|is no folder"):
        find_specs(tmp_path / name)


def test_two_specs_that_differ_in_the_ending_only_have_a_run_folder_each(
    stand: Stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = stand(exit0="")
    (folder / "exit0.yml").touch()
    seen: list[str] = []

    def note(command: Sequence[str], timeout: float) -> tuple[int | None, str]:
        seen.append(command[list(command).index("--out") + 1])
        return 0, ""

    monkeypatch.setattr(batch, "called", note)
    run_batch(folder, tmp_path / "out")
    assert len(set(seen)) == 2


def test_a_spec_whose_name_looks_like_an_option_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-k.yaml").write_text("name: x\n")
    (outcome,) = run_batch(Path(), tmp_path / "out")
    assert outcome.exit == 2
    assert "system is missing" in outcome.messages


def test_an_earlier_result_is_not_reported_for_a_run_that_failed(stand: Stand, tmp_path: Path) -> None:
    earlier = tmp_path / "out" / "exit4"
    earlier.mkdir(parents=True)
    (earlier / "run.json").write_text('{"figures": {"norm_K": 1.0}}')
    (outcome,) = run_batch(stand(exit4=""), tmp_path / "out")
    assert outcome.figures == {}


def test_the_junit_report_parses_whatever_a_failing_run_said(stand: Stand, tmp_path: Path) -> None:
    write_junit(run_batch(stand(noisy="", exit0=""), tmp_path / "out"), tmp_path / "junit.xml")
    (suite,) = JUnitXml.fromfile(str(tmp_path / "junit.xml"))
    assert (suite.tests, suite.failures) == (2, 1)
    (failure,) = next(case.result for case in suite if case.result)
    assert "red" in failure.text
    assert "<&>]]>" in failure.text


def test_a_report_that_cannot_be_written_ends_with_2_after_the_table(stand: Stand, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    arguments = ["batch", str(stand(exit0="")), "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, [*arguments, "--junit", str(tmp_path / "file" / "junit.xml")])
    assert run.exit_code == 2
    assert "1 passed, 0 failed" in run.stdout
    assert "cannot write" in run.stderr
    assert "Traceback" not in run.output


def test_a_name_with_brackets_is_printed_as_it_is(stand: Stand, tmp_path: Path) -> None:
    folder = stand(exit3="")
    (folder / "exit3.yaml").rename(folder / "exit3 [red][b].yaml")
    run = CliRunner().invoke(app, ["batch", str(folder), "--out", str(tmp_path / "out")])
    assert run.exit_code == 3
    assert "[red][b]" in run.stdout.replace("\n", "")
    assert "exit3 [red][b].yaml: outside the theory, exit 3, expected 0" in run.stderr


def test_a_run_that_is_told_to_stop_leaves_nothing_behind(specs: Path, tmp_path: Path) -> None:
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    long = text.replace("duration: 60", "duration: 3000").replace("sample_time: 0.01", "sample_time: 0.001")
    (tmp_path / "long.yaml").write_text(long, encoding="utf-8")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "pwatrack", "simulate", str(tmp_path / "long.yaml"), "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and not list(out.glob(".*/trace.csv")):
            time.sleep(0.02)
        process.terminate()
    assert process.returncode == 143
    assert not list(out.glob("*"))


def test_a_run_that_is_given_up_may_clean_up(tmp_path: Path) -> None:
    program = f"""
import pathlib, signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: (pathlib.Path({str(tmp_path / "cleaned")!r}).touch(), sys.exit()))
time.sleep(60)
"""
    code, message = called([sys.executable, "-S", "-c", program], 2.0)
    assert (code, message) == (None, "given up after 2 s")
    assert (tmp_path / "cleaned").exists()


@pytest.mark.parametrize("said", ["expect: {exit: 2}", "expect:\n  exit: 2"])
def test_what_is_not_even_yaml_may_be_expected(said: str, tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text(f"name: [\n{said}\n", encoding="utf-8")
    assert expected_exit(tmp_path / "broken.yaml") == 2
    assert expected_exit(tmp_path / "absent.yaml") == 0


def test_a_crash_is_never_as_it_should_be(tmp_path: Path, specs: Path) -> None:
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    (tmp_path / "crash.yaml").write_text(text + "expect: {exit: 1}\n", encoding="utf-8")
    with pytest.raises(InvalidSpec, match=r"expect\.exit: 1 is a crash"):
        load_spec(tmp_path / "crash.yaml")
    (tmp_path / "crash.yaml").write_text("name: [\nexpect: {exit: 1}\n", encoding="utf-8")
    assert expected_exit(tmp_path / "crash.yaml") == 0


@pytest.mark.parametrize(("timeout", "code"), [("inf", 0), ("1e300", 0), ("nan", 2)])
def test_any_time_is_a_time_limit(stand: Stand, tmp_path: Path, timeout: str, code: int) -> None:
    arguments = ["batch", str(stand(exit0="")), "--out", str(tmp_path / "out"), "--timeout", timeout]
    run = CliRunner().invoke(app, arguments)
    assert run.exit_code == code, run.output
    assert "bug" not in run.output


ODD = {
    "text": '{"exit": 0, "figures": {"norm_K": "large", "norm_L": null, "final_error": true}}',
    "list": '{"exit": 0, "figures": [1, 2], "remarks": "no list", "simulation": [], "verdict": 3}',
    "words": '{"exit": 0, "remarks": [1, {}], "simulation": {"outcome": "off", "said": 4}}',
    "deep": "[" * 100_000,
    "other": "3",
    "digits": '{"exit": 0, "figures": {"norm_K": ' + "9" * 5000 + "}}",
    "large": '{"exit": 0, "figures": {"norm_K": ' + "9" * 400 + "}}",
    "old": '{"figures": {"norm_K": 1.0}}',
}


@pytest.mark.parametrize("index", ODD.values(), ids=ODD)
def test_an_index_of_another_kind_gives_no_figures(stand: Stand, tmp_path: Path, index: str) -> None:
    (tmp_path / "out" / "exit0").mkdir(parents=True)
    (tmp_path / "out" / "exit0" / "run.json").write_text(index)
    run = CliRunner().invoke(app, ["batch", str(stand(exit0="")), "--out", str(tmp_path / "out")])
    assert run.exit_code == 0, run.output
    (outcome,) = run_batch(tmp_path / "specs", tmp_path / "out")
    assert (outcome.figures, outcome.notes) == ({}, ())


def test_remarks_and_outcomes_are_noted(stand: Stand, tmp_path: Path) -> None:
    (tmp_path / "out" / "exit0").mkdir(parents=True)
    index = '{"exit": 0, "simulation": {"outcome": "off", "said": "off: by 3"}, "remarks": ["a cell is left out"]}'
    (tmp_path / "out" / "exit0" / "run.json").write_text(index)
    run = CliRunner().invoke(app, ["batch", str(stand(exit0="")), "--out", str(tmp_path / "out")])
    assert "exit0.yaml: off: by 3\n" in run.stdout
    assert "exit0.yaml: a cell is left out\n" in run.stdout


def test_what_is_named_like_a_spec_and_is_none_is_said_to_be_left_out(stand: Stand, tmp_path: Path) -> None:
    folder = stand(exit0="")
    (folder / "EXIT4.YAML").touch()
    (folder / "gone.yaml").symlink_to(folder / "nowhere")
    os.mkfifo(folder / "pipe.yml")
    (folder / "link.yaml").symlink_to(folder / "pipe.yml")
    (folder / "folder.yaml").mkdir()
    assert [path.name for path in find_specs(folder)] == ["EXIT4.YAML", "exit0.yaml"]
    run = CliRunner().invoke(app, ["batch", str(folder), "--out", str(tmp_path / "out")])
    assert [line.split("specs/")[1] for line in run.stderr.splitlines() if "left out" in line] == [
        "gone.yaml: left out: no file of this name is where the link leads",
        "link.yaml: left out: no file",
        "pipe.yml: left out: no file",
    ]


def test_specs_whose_names_are_dots_stay_in_folders_of_their_own(
    stand: Stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, seen = stand(), list[Path]()
    for name in ("..yaml", "...yaml", "....yml"):
        (folder / name).touch()

    def note(command: Sequence[str], timeout: float) -> tuple[int | None, str]:
        seen.append(Path(command[list(command).index("--out") + 1]))
        return 0, ""

    monkeypatch.setattr(batch, "called", note)
    run_batch(folder, tmp_path / "out")
    assert {path.resolve().relative_to(tmp_path / "out") for path in seen} == {
        Path("..yaml"),
        Path("...yaml"),
        Path("....yml"),
    }
