import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pwatrack.cli import app
from pwatrack.errors import Place
from pwatrack.report.terminal import excerpt


def at(line: str, column: int, message: str, tmp_path: Path) -> list[str]:
    (tmp_path / "x.yaml").write_text(f"first\n{line}\nlast\n", encoding="utf-8")
    return excerpt(Place(str(tmp_path / "x.yaml"), 2, column), message)


@pytest.mark.parametrize(
    ("line", "column", "message", "marked"),
    [
        ("A: [[0, 1], [k9, 1]]", 4, "unknown name 'k9'", "k9"),
        ("A: [[0, 1], [k99, k9]]", 4, "unknown name 'k9'", "k9"),
        ("A: [[0, 1]]", 4, "no word of this line: 'gap'", "["),
        ("gap: 1, other: gap", 16, "unknown name 'gap'", "gap"),
        ("ẋ: 质量 + k9", 4, "unknown name 'k9'", "k9"),
        ("\ta: b9", 5, "unknown name 'b9'", "b9"),
    ],
)
def test_the_caret_is_under_what_is_meant(line: str, column: int, message: str, marked: str, tmp_path: Path) -> None:
    from rich.cells import cell_len

    shown, under = at(line, column, message, tmp_path)
    place = under.index("^")
    assert cell_len(shown[: shown.rindex(marked) if marked != "[" else shown.index("[")]) == place
    assert under[place:] == "^" + "~" * (len(marked) - 1)


def test_a_long_line_is_shown_around_the_place(tmp_path: Path) -> None:
    shown, under = at("x" * 3_000 + " k9 " + "y" * 3_000, 1, "unknown name 'k9'", tmp_path)
    assert len(shown) < 120
    assert shown[under.index("^") :].startswith("k9 ")


@pytest.mark.parametrize("place", [Place("absent.yaml", 1, 1), Place("/dev/zero", 1, 1), Place("/", 1, 1)])
def test_nothing_is_shown_of_what_is_not_there(place: Place) -> None:
    assert excerpt(place, "no") == []


def test_nothing_is_shown_of_a_line_that_has_gone(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_bytes(b"\xff\n")
    assert excerpt(Place(str(tmp_path / "x.yaml"), 1, 1), "no") == []
    (tmp_path / "x.yaml").write_text("one\n")
    assert excerpt(Place(str(tmp_path / "x.yaml"), 9, 1), "no") == []


@pytest.fixture
def wrong(specs: Path) -> str:
    return str(specs / "refused" / "many_errors.yaml")


def test_every_fault_of_a_file_has_its_line_and_a_caret(wrong: str) -> None:
    lines = CliRunner().invoke(app, ["check", wrong]).stderr.splitlines()
    faults = [k for k, line in enumerate(lines) if line.startswith("error: ")]
    assert len(faults) > 5
    for k in faults:
        number = re.match(r"error: .*?yaml:(\d+):", lines[k])
        assert number
        assert re.match(rf" +{number[1]} \| ", lines[k + 1])
        assert re.fullmatch(r" +\| +\^~*", lines[k + 2])


def test_errors_as_json_are_one_object(wrong: str) -> None:
    run = CliRunner().invoke(app, ["--format", "json", "check", wrong])
    assert run.exit_code == 2
    said = json.loads(run.stderr)
    assert (said["exit"], said["verdict"]) == (2, "invalid spec")
    assert all(problem["place"]["line"] > 0 for problem in said["problems"])
    assert CliRunner().invoke(app, ["check", wrong]).stderr.startswith("error: ")  # and no later ones in this process


def test_errors_for_github_are_commands(wrong: str) -> None:
    run = CliRunner().invoke(app, ["--format", "github", "check", wrong])
    assert run.exit_code == 2
    lines = run.stderr.splitlines()
    assert all(
        re.match(r"::error file=.*many_errors\.yaml,line=\d+,col=\d+,title=invalid spec P2\d\d::", line)
        for line in lines
    )


@pytest.mark.slow
@pytest.mark.parametrize("command", ["design", "simulate"])
def test_what_is_printed_can_be_chosen(command: str, specs: Path, tmp_path: Path) -> None:
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8").replace("duration: 60", "duration: 2")
    (tmp_path / "x.yaml").write_text(text, encoding="utf-8")
    arguments = [command, str(tmp_path / "x.yaml"), "--out", str(tmp_path / "out")]
    said = {}
    for option in ("-q", "-v", "--json"):
        run = CliRunner().invoke(app, [*arguments, option, *(["--plots", "none"] if command == "simulate" else [])])
        assert run.exit_code == 0, run.output
        said[option] = run.stdout
    assert said["-q"] == ""
    assert re.search(r"design \d+\.\d\d s", said["-v"])
    assert json.loads(said["--json"])["verdict"] == "proved"
    assert CliRunner().invoke(app, [*arguments, "-q", "-v"]).exit_code == 2
