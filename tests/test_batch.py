import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from junitparser import JUnitXml
from typer.testing import CliRunner

from pwatrack.batch.command import batch
from pwatrack.batch.find import find_specs
from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.reports import write_junit
from pwatrack.batch.run import Options, run_batch
from pwatrack.batch.work import Ended
from pwatrack.cli import app
from pwatrack.errors import InvalidSpec
from pwatrack.report.run_folder import read_index
from pwatrack.spec.load import expected_exit, load_spec
from tests.stand_ins import work

Stand = Callable[..., Path]


@pytest.fixture
def stand(tmp_path: Path) -> Stand:
    """Return a function that makes a folder of specs, whose names say to `work` how they end."""

    def make(**names: str) -> Path:
        folder = tmp_path / "specs"
        folder.mkdir(exist_ok=True)
        for name, content in names.items():
            (folder / f"{name.replace('_', ' ')}.yaml").write_text(content, encoding="utf-8")
        return folder

    return make


def expecting(code: int) -> str:
    return f"name: x\nexpect: {{exit: {code}}}\n"


def ends(outcomes: list[SpecOutcome]) -> list[tuple[str, int | None, bool, int]]:
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
    outcomes = run_batch(mixed, tmp_path / "out", Options(jobs=jobs, plots="none"))
    assert ends(outcomes) == MIXED
    assert [bool(o.figures) for o in outcomes] == [True, False, True, False, False, False]
    assert "sample_tim" in outcomes[3].messages
    assert ":" in outcomes[5].messages
    made = {path.parent.relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("run.json")}
    assert made == {Path("good"), Path("below/good"), Path("jump"), Path("jump_unexpected")}
    assert read_index(tmp_path / "out" / "jump") is not None


def test_the_command_line_prints_every_spec_and_ends_with_the_largest_code(mixed: Path, tmp_path: Path) -> None:
    report = tmp_path / "reports" / "junit.xml"
    arguments = ["batch", str(mixed), "--out", str(tmp_path / "out"), "--jobs", "2", "--plots", "none"]
    arguments += ["--junit", str(report)]
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


LOST = {
    "killed": (-9, 1, "killed by signal 9"),
    "segfault": (-11, 1, "killed by signal 11"),
    "slow": (None, 6, "given up after 2 s"),
    "stubborn": (None, 6, "given up after 2 s"),
    "hungry": (None, 6, "out of memory: it may take 500 MB"),
    "leaves": (None, 6, "ended by itself with 7"),
}


def test_what_kills_hangs_or_fills_a_worker_fails_one_spec_of_forty(stand: Stand, tmp_path: Path) -> None:
    folder = stand(**{f"exit0_{k}": "" for k in range(34)}, **dict.fromkeys(LOST, ""))
    outcomes = run_batch(folder, tmp_path / "out", Options(jobs=2, timeout=2, memory=500), work=work)
    failed = {o.spec.stem: o for o in outcomes if not o.passed}
    assert {name: (o.exit, o.code, o.verdict) for name, o in failed.items()} == LOST
    assert len(outcomes) == 40
    assert "about to crash" in failed["segfault"].messages
    assert [o.spec for o in outcomes] == sorted(o.spec for o in outcomes)


def test_a_spec_that_is_given_up_may_clean_up(stand: Stand, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (outcome,) = run_batch(stand(tidy=""), tmp_path / "out", Options(timeout=1), work=work)
    assert outcome.reason == "given up after 1 s"
    assert (tmp_path / "out" / "tidy").is_file()


def test_none_is_begun_after_one_has_failed_if_so_asked(stand: Stand, tmp_path: Path) -> None:
    folder = stand(exit0="", exit3="", exit4="", exit5="")
    outcomes = run_batch(folder, tmp_path / "out", Options(fail_fast=True), work=work)
    assert [o.result for o in outcomes] == ["pass", "FAIL", "skipped", "skipped"]
    assert [o.code for o in outcomes] == [0, 3, 0, 0]


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
    stand: Stand, tmp_path: Path, names: dict[str, str], code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert batch([stand(**names)], tmp_path / "out", Options(), work=work) == code
    assert f"{len(names)} passed, 0 failed" in capsys.readouterr().out or code


def test_the_outcomes_come_in_order_of_the_paths_with_several_jobs(stand: Stand, tmp_path: Path) -> None:
    names = {f"exit{code}_{k}": expecting(code) for k in range(3) for code in (0, 3, 4)}
    folder = stand(**names)
    one, many = (run_batch(folder, tmp_path / "out", Options(jobs=jobs), work=work) for jobs in (1, 4))
    assert ends(one) == ends(many)
    assert [o.spec for o in one] == sorted(o.spec for o in one)
    assert all(o.passed for o in one)


@pytest.mark.parametrize("name", ["missing", "empty"])
def test_a_folder_without_specs_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").touch()
    (tmp_path / "empty" / "folder.yaml").mkdir()
    with pytest.raises(InvalidSpec, match=r"no \.yaml file|is no folder and no file"):
        find_specs([tmp_path / name])


def test_each_spec_has_a_run_folder_of_its_own(tmp_path: Path) -> None:
    names = ["a/x.yaml", "a/x.yml", "b/x.yaml", "b/x.yml", "b/..yaml", "b/...yaml", "b/....yml", "b/below/x.yaml"]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "b" / "again.yaml").symlink_to(tmp_path / "b" / "x.yaml")
    found = find_specs([tmp_path / "a", tmp_path / "b", tmp_path / "b" / "x.yaml", tmp_path])
    assert len(found) == len(set(found.values())) == len(names)
    assert not any(place == Path() or ".." in place.parts for place in found.values())


def test_a_pattern_says_which_specs_are_meant(stand: Stand) -> None:
    folder = stand(exit0="", exit3="", other="")
    (folder / "below").mkdir()
    (folder / "below" / "exit4.txt").touch()
    assert [p.name for p in find_specs([folder], "exit*")] == ["exit4.txt", "exit0.yaml", "exit3.yaml"]
    assert [p.name for p in find_specs([folder], "below/*")] == ["exit4.txt"]


def test_a_spec_whose_name_looks_like_an_option_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-k.yaml").write_text("name: x\n")
    (outcome,) = run_batch(Path(), tmp_path / "out")
    assert outcome.exit == 2
    assert "system is missing" in outcome.messages


def test_an_earlier_result_is_not_reported_for_a_run_that_failed(mixed: Path, tmp_path: Path) -> None:
    for name in ("good", "invalid"):
        (tmp_path / f"{name}.yaml").write_text((mixed / f"{name}.yaml").read_text())
    (first,) = run_batch(tmp_path / "good.yaml", tmp_path / "out", Options(plots="none"))
    (tmp_path / "invalid.yaml").rename(tmp_path / "good.yaml")
    (second,) = run_batch(tmp_path / "good.yaml", tmp_path / "out")
    assert first.figures
    assert (second.exit, second.figures) == (2, {})


def test_parameters_are_set_in_every_spec(mixed: Path, tmp_path: Path) -> None:
    (outcome,) = run_batch(mixed / "good.yaml", tmp_path, Options(parameters=("k2=0.35",), plots="none"))
    index = read_index(outcome.folder)
    assert index is not None
    assert index["parameters"]["k2"] == 0.35
    assert not list(outcome.folder.glob("*.png"))


@pytest.mark.slow
@pytest.mark.parametrize(("code", "drawn"), [(0, False), (6, True)])
def test_pictures_only_of_what_fails(mixed: Path, tmp_path: Path, code: int, drawn: bool) -> None:
    text = (mixed / "good.yaml").read_text() + ("" if code == 0 else "require: {final_error: 1e-12}\n")
    (tmp_path / "good.yaml").write_text(text)
    (outcome,) = run_batch(tmp_path / "good.yaml", tmp_path / "out", Options(plots="failed"))
    assert (outcome.exit, bool(list(outcome.folder.glob("*.png")))) == (code, drawn)


def test_the_junit_report_parses_whatever_a_failing_run_said(stand: Stand, tmp_path: Path) -> None:
    folder = stand(noisy="", exit0="", slow="")
    (folder / os.fsdecode(b"exit0 \x1b\xff \xef\xbf\xbe.yaml")).touch()
    write_junit(run_batch(folder, tmp_path / "out", Options(timeout=1), work=work), tmp_path / "junit.xml")
    (suite,) = JUnitXml.fromfile(str(tmp_path / "junit.xml"))
    assert (suite.tests, suite.failures, suite.errors) == (4, 1, 1)  # one crashed
    noisy = next(case.result[0] for case in suite if "noisy" in case.name)
    assert "red" in noisy.text
    assert "<&>]]>" in noisy.text


def test_a_report_that_cannot_be_written_ends_with_2_after_the_table(mixed: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    arguments = ["batch", str(mixed / "jump.yaml"), "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, [*arguments, "--junit", str(tmp_path / "file" / "junit.xml")])
    assert run.exit_code == 2
    assert "1 passed, 0 failed" in run.stdout
    assert "cannot write" in run.stderr
    assert "Traceback" not in run.output


def test_a_report_of_an_unknown_kind_is_refused_before_anything_runs(mixed: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke(app, ["batch", str(mixed), "--out", str(tmp_path / "out"), "--report", "report.doc"])
    assert run.exit_code == 2
    assert "report.doc" in run.stderr
    assert not (tmp_path / "out").exists()


def test_a_name_with_brackets_and_control_characters_is_printed_as_text(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = stand(exit3="")
    (folder / "exit3.yaml").rename(folder / "exit3 [red][b]\x1b[2J.yaml")
    assert batch([folder], tmp_path / "out", Options(), work=work) == 3
    said = capsys.readouterr()
    assert "[red][b]" in said.out.replace("\n", "")
    assert "exit3 [red][b]\\x1b[2J.yaml: outside the theory, exit 3, expected 0" in said.err
    assert "\x1b" not in said.out + said.err


@pytest.mark.slow
def test_a_run_that_is_told_to_stop_leaves_nothing_behind(specs: Path, tmp_path: Path) -> None:
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    long = text.replace("duration: 60", "duration: 150").replace("sample_time: 0.01", "sample_time: 0.001")
    (tmp_path / "long.yaml").write_text(long, encoding="utf-8")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "pwatrack", "simulate", str(tmp_path / "long.yaml"), "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and not list(out.glob(".*/trace.csv")):
            time.sleep(0.02)
        process.terminate()
    assert process.returncode == 143
    assert not list(out.glob("*"))


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
def test_any_time_is_a_time_limit(mixed: Path, tmp_path: Path, timeout: str, code: int) -> None:
    arguments = ["batch", str(mixed / "jump.yaml"), "--out", str(tmp_path / "out"), "--timeout", timeout]
    run = CliRunner().invoke(app, arguments)
    assert run.exit_code == code, run.output
    assert "bug" not in run.output


ODD: dict[str, dict[str, object]] = {
    "text": {"exit": 0, "figures": {"norm_K": "large", "norm_L": None, "final_error": True}},
    "list": {"exit": 0, "figures": [1, 2], "remarks": "no list", "simulation": [], "verdict": 3},
    "words": {"exit": 0, "remarks": [1, {}], "simulation": {"outcome": "off", "said": 4}},
    "large": {"exit": 0, "figures": {"norm_K": 10**400}},
}


@pytest.mark.parametrize("index", ODD.values(), ids=ODD)
def test_an_index_of_another_kind_gives_no_figures(index: dict[str, object]) -> None:
    outcome = SpecOutcome.of(Path("a.yaml"), Path("a"), Ended(exit=0, index=index), seconds=1.0)
    assert (outcome.figures, outcome.notes) == ({}, ())


def test_remarks_and_outcomes_are_noted() -> None:
    index = {"exit": 0, "simulation": {"outcome": "off", "said": "off: by 3"}, "remarks": ["a cell is left out"]}
    outcome = SpecOutcome.of(Path("a.yaml"), Path("a"), Ended(exit=0, index=index), seconds=1.0)
    assert outcome.notes == ("off: by 3", "a cell is left out")


def test_what_is_named_like_a_spec_and_is_none_is_said_to_be_left_out(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = stand(exit0="")
    (folder / "EXIT4.YAML").touch()
    (folder / "gone.yaml").symlink_to(folder / "nowhere")
    os.mkfifo(folder / "pipe.yml")
    (folder / "link.yaml").symlink_to(folder / "pipe.yml")
    (folder / "folder.yaml").mkdir()
    assert [path.name for path in find_specs([folder])] == ["EXIT4.YAML", "exit0.yaml"]
    batch([folder], tmp_path / "out", Options(), work=work)
    said = capsys.readouterr().err.splitlines()
    assert [line.split("specs/")[1] for line in said if "left out" in line] == [
        "gone.yaml: left out: no file of this name is where the link leads",
        "link.yaml: left out: no file",
        "pipe.yml: left out: no file",
    ]
    assert [line for line in said if line.startswith("[")] == [
        line for line in said if re.fullmatch(r"\[[12]/2\] (pass|FAIL) .*exit[04]\.yaml.* \(\d+\.\d s\)", line, re.I)
    ]
