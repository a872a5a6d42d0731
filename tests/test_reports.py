import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

import pytest
from junitparser import JUnitXml
from pydantic import ValidationError
from sarif_pydantic import Sarif
from typer.testing import CliRunner

from pwatrack.batch.command import WRITERS
from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.page import write_page
from pwatrack.batch.reports import add_summary, annotations
from pwatrack.cli import app
from pwatrack.errors import Place
from pwatrack.report.terminal import JobFault

ODD = os.fsdecode(b"specs/a,b: \xff\x1b[31m|<b>%\n.yaml")
OUTCOMES = [
    SpecOutcome(
        spec=Path("specs/good.yaml"),
        folder=Path("runs/good"),
        exit=0,
        figures={"norm_K": 2.5, "final_error": 1e-12},
        unit="<m>",
        required=(("overshoot 3 % ≤ 5 %", True), ("settling_time 3 s ≤ 2 s: <late>", False)),
        notes=("a | remark",),
        seconds=1.25,
    ),
    SpecOutcome(
        spec=Path(ODD),
        folder=Path("runs/odd"),
        exit=2,
        messages="error: \x1b[2J no\nsecond",
        faults=(
            JobFault(message="line one\nline two ::error::", hint="mend it", place=Place(ODD, 3, 7)),
            JobFault(message="no place"),
        ),
    ),
    SpecOutcome(spec=Path("killed.yaml"), folder=Path("runs/killed"), exit=-9, reason="killed by signal 9"),
    SpecOutcome(spec=Path("slow.yaml"), folder=Path("runs/slow"), exit=None, reason="given up after 2 s"),
    SpecOutcome(spec=Path("same.yaml"), folder=Path("runs/same"), exit=0, how="cached"),
    SpecOutcome(spec=Path("skipped.yaml"), folder=Path("runs/skipped"), exit=None, reason="skipped", how="skipped"),
]


class Page(HTMLParser):
    """Collects tags, texts and what is loaded from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.loaded: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        named = dict(attributes)
        self.loaded += [str(named[name]) for name in ("src", "srcset", "action") if name in named]
        self.loaded += [str(named["href"])] if tag == "link" else []
        if tag not in ("meta", "input", "img", "wbr"):
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag == "td":
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "td" in self.open:
            self.rows[-1][-1] += data


@pytest.fixture(params=WRITERS)
def report(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"report{request.param}"
    WRITERS[request.param](OUTCOMES, path)
    return path


def test_every_report_is_text_without_control_characters_and_names_every_spec(report: Path) -> None:
    content = report.read_text(encoding="utf-8")
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f]", content)
    names = {"good", "killed", "slow"} | (set() if report.suffix == ".sarif" else {"same", "skipped"})
    assert all(name in content for name in names - ({"good"} if report.suffix == ".sarif" else set()))


@pytest.mark.parametrize("ending", WRITERS)
def test_a_report_of_nothing_is_one_too(ending: str, tmp_path: Path) -> None:
    WRITERS[ending]([], tmp_path / f"report{ending}")
    assert (tmp_path / f"report{ending}").exists()


def test_lines_hold_one_object_for_each_spec(tmp_path: Path) -> None:
    WRITERS[".jsonl"](OUTCOMES, tmp_path / "report.jsonl")
    objects = [json.loads(line) for line in (tmp_path / "report.jsonl").read_text().splitlines()]
    assert [o["spec"] for o in objects] == [str(o.spec) for o in OUTCOMES]
    assert [o["result"] for o in objects] == ["passed", "failed", "failed", "failed", "passed", "skipped"]
    assert [o["cached"] for o in objects] == [False] * 4 + [True, False]
    assert objects[1]["faults"][0]["place"]["line"] == 3


def test_sarif_says_where_every_fault_is(tmp_path: Path) -> None:
    WRITERS[".sarif"](OUTCOMES, tmp_path / "report.sarif")
    content: dict[str, Any] = json.loads((tmp_path / "report.sarif").read_text())
    (run,) = content["runs"]
    assert content["version"] == "2.1.0"
    rules = [rule["id"] for rule in run["tool"]["driver"]["rules"]]
    assert len(set(rules)) == len(rules)
    assert {result["ruleId"] for result in run["results"]} == set(rules)
    places = [result["locations"][0]["physicalLocation"] for result in run["results"]]
    assert places[0]["region"] == {"startLine": 3, "startColumn": 7}
    assert [unquote_to_bytes(place["artifactLocation"]["uri"]) for place in places] == [
        *[os.fsencode(ODD)] * 2,
        b"killed.yaml",
        b"slow.yaml",
    ]
    assert all(re.fullmatch(r"[\w%./~-]+", place["artifactLocation"]["uri"]) for place in places)
    assert all(result["message"]["text"] and result["level"] == "error" for result in run["results"])


def test_sarif_is_as_the_standard_says(tmp_path: Path) -> None:
    WRITERS[".sarif"](OUTCOMES, tmp_path / "report.sarif")
    content: dict[str, Any] = json.loads((tmp_path / "report.sarif").read_text())
    assert Sarif.model_validate(content).version == "2.1.0"
    content["runs"][0]["results"][0]["level"] = "bad"
    with pytest.raises(ValidationError, match="'none', 'note', 'warning' or 'error'"):
        Sarif.model_validate(content)


def test_junit_counts_what_failed_and_what_was_skipped(tmp_path: Path) -> None:
    WRITERS[".xml"](OUTCOMES, tmp_path / "report.xml")
    (suite,) = JUnitXml.fromfile(str(tmp_path / "report.xml"))
    assert (suite.tests, suite.failures, suite.errors, suite.skipped) == (6, 2, 1, 1)


def test_the_page_loads_nothing_and_shows_text_as_text(tmp_path: Path) -> None:
    WRITERS[".html"](OUTCOMES, tmp_path / "report.html")
    page = Page()
    page.feed((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.open == []
    assert page.loaded == []
    rows = [row for row in page.rows if row]
    good, odd = (next(row for row in rows if name in row[0]) for name in ("good.yaml", "<b>%"))
    assert len(rows) == len(OUTCOMES)
    assert "missed: settling_time 3 s ≤ 2 s: <late>" in good[2]
    assert good[3:] == ["1 of 2", "2.5", "", "1e-12 <m>", "1.2", ""]
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    heads = re.findall(r'<button type="button">(.*?)</button>', text)
    assert heads == ["spec", "result", "verdict", "required", "‖K‖", "‖L‖ (1/s)", "final error", "time (s)"]
    assert rows.index(odd) < rows.index(good), "what failed is read first"
    assert "\\x1b[2J no\nsecond" in odd[2]


def test_the_page_shows_pictures_of_runs_small(tmp_path: Path) -> None:
    from PIL import Image

    folder = tmp_path / "runs" / "a 100%"
    folder.mkdir(parents=True)
    Image.new("RGB", (1200, 800), "white").save(folder / "outputs.png")
    (folder / "tracking_error.png").write_text("no picture")
    made = SpecOutcome(spec=Path("a.yaml"), folder=folder, exit=0, figures={"norm_K": 1.0})
    broken = SpecOutcome(spec=Path("b.yaml"), folder=folder, exit=2)  # an earlier run is in its folder
    WRITERS[".html"]([made, broken], tmp_path / "reports" / "report.html")
    text = (tmp_path / "reports" / "report.html").read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    assert len(page.loaded) == 1
    assert page.loaded[0].startswith("data:image/png;base64,")
    assert 'href="../runs/a%20100%25/outputs.png"' in text
    assert len(text) < 20_000
    (folder / "report.html").touch()
    WRITERS[".html"]([made, broken], tmp_path / "reports" / "report.html")
    links = re.findall(r'href="([^"]*)"', (tmp_path / "reports" / "report.html").read_text(encoding="utf-8"))
    assert links == ["../runs/a%20100%25/report.html"] * 2  # its name, and its picture


def test_annotations_are_one_line_each_and_no_text_is_taken_for_another_command() -> None:
    lines = list(annotations(OUTCOMES))
    assert len(lines) == 4
    assert all(
        re.fullmatch(r"::error file=[^,:\n]+(,line=3,col=7)?,title=[\w ]+::[^\r\n\x1b]+", line) for line in lines
    )
    assert "line one%0Aline two ::error::%0Ahint: mend it" in lines[0]


def test_the_summary_of_a_job_is_added_to(tmp_path: Path) -> None:
    add_summary(OUTCOMES, {})
    path = tmp_path / "summary.md"
    path.write_text("before\n")
    add_summary(OUTCOMES, {"GITHUB_STEP_SUMMARY": str(path)})
    before, *lines = path.read_text(encoding="utf-8").splitlines()
    assert before == "before"
    assert lines[0] == "### pwatrack: 2 passed (1 cached), 3 failed, 1 skipped"
    rows = [line for line in lines if line.startswith("|")]
    assert len(rows) == len(OUTCOMES) + 2
    assert all(len(re.findall(r"(?<!\\)\|", row)) == 5 for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize("asked_for", [False, True])
def test_on_a_runner_or_where_it_is_asked_for_the_command_line_says_all_of_it(
    specs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked_for: bool
) -> None:
    text = (specs / "refused" / "many_errors.yaml").read_text(encoding="utf-8").replace("expect:", "#")
    (tmp_path / "wrong.yaml").write_text(text, encoding="utf-8")
    monkeypatch.delenv("GITHUB_ACTIONS", raising=False)
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "summary.md"))
    asked = ["--format", "github"] if asked_for else []
    if not asked_for:
        monkeypatch.setenv("GITHUB_ACTIONS", "true")
    arguments = [*asked, "batch", str(tmp_path / "wrong.yaml"), "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, [*arguments, *(f"--report={tmp_path}/report{ending}" for ending in WRITERS)])
    assert run.exit_code == 2
    assert re.search(
        r"^::error file=.*wrong\.yaml,line=\d+,col=\d+,title=invalid spec P200::", run.stdout, re.MULTILINE
    )
    assert "1 failed" in (tmp_path / "summary.md").read_text()
    assert all((tmp_path / f"report{ending}").stat().st_size for ending in WRITERS)


def test_the_page_has_what_failed_first(tmp_path: Path) -> None:
    write_page(OUTCOMES, tmp_path / "page.html")
    kinds = re.findall(r'<tr data-kind="(\w+)"', (tmp_path / "page.html").read_text(encoding="utf-8"))
    assert kinds == ["fail"] * 3 + ["pass", "cached", "skipped"]
