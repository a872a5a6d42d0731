"""The page of a run: all in one file, text as text, claims as the certificate has them, times as the events say."""

import csv
import json
import math
import re
from collections import defaultdict
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import pytest

from pwatrack import Result, load_spec, simulate
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.registry import CLAIMS
from pwatrack.report.files import write_result
from pwatrack.report.page import page as page_of
from pwatrack.report.plots.canvas import png, svg
from pwatrack.report.plots.pictures import pictures
from pwatrack.report.screen import Findings
from tests.test_page import BROWSER, Noted, browse

ATTACK = "<script>alert(1)</script>\"'&"
SPEC = f"""
name: {json.dumps(ATTACK)}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  units: {{z: "</pre><script>m", v: m/s, u: N, y: m}}
  B: [[0], [1]]
  C: [[1, 0]]
  cells:
    - {{name: "</svg><img src=x onerror=alert(2)>", where: ["z <= 0.05"], A: [[0, 1], [-1, -1]]}}
    - {{name: touching, where: ["z >= 0.05"], A: [[0, 1], [-2, -1]], b: [0, 0.05]}}
reference: {{output: 0.1*sin(t)}}
simulation: {{duration: 10, sample_time: 0.1, initial: {{plant: [0.2, 0]}}}}
# </pre><script>alert(3)</script>
"""
VOID = {"meta", "img", "input", "br", "wbr", "hr", "link"}


class Page(HTMLParser):
    """Collects what a page has: elements with their attributes, and the text in each kind of element."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = defaultdict(list)
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attributes)))
        self.texts[tag].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attributes)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        for tag in set(self.open):
            self.texts[tag][-1] += data

    def attributes(self, name: str) -> list[str]:
        return [attributes[name] or "" for _, attributes in self.found if name in attributes]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    path = tmp_path_factory.mktemp("spec") / "odd.yaml"
    path.write_text(SPEC, encoding="utf-8")
    return simulate(load_spec(path))


@pytest.fixture(scope="module")
def run(result: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with pictures."""
    return write_result(result, tmp_path_factory.mktemp("run"), summary="all & <more>\n")


@pytest.fixture(scope="module")
def page(run: Path) -> Page:
    return Page((run / "report.html").read_text(encoding="utf-8"))


def test_the_page_is_whole_and_refers_to_nothing_outside(run: Path, page: Page) -> None:
    assert page.open == []
    ids = page.attributes("id")
    assert len(ids) == len(set(ids))
    for name in ("src", "href", "data", "action", "poster", "srcset", "xlink:href"):
        assert all(value.startswith("data:") for value in page.attributes(name)), name
    style = page.texts["style"][0]
    assert "@import" not in style
    assert "url(" not in style
    assert "report.html" in json.loads((run / "run.json").read_text())["files"]


def test_text_of_a_spec_is_text(page: Page) -> None:
    tags = [tag for tag, _ in page.found]
    assert tags.count("script") == 1
    assert not [name for _, attributes in page.found for name in attributes if name.startswith("on")]
    assert page.texts["h1"] == [ATTACK]
    assert page.texts["title"] == [f"pwatrack: {ATTACK}"]
    assert "</svg><img src=x onerror=alert(2)>" in page.texts["th"]
    assert SPEC in page.texts["pre"]
    assert "all & <more>\n" in page.texts["pre"]


def test_every_picture_of_the_run_is_in_it_whole_and_sharp(result: Result, run: Path, page: Page) -> None:
    shown = [unquote(src.removeprefix("data:image/svg+xml,")) for src in page.attributes("src")]
    names = page.attributes("alt")[: len(shown)]
    assert {f"{name.replace(' ', '_')}.png" for name in names} == {file.name for file in run.glob("*.png")}
    for name, text in zip(names, shown, strict=True):
        root = ElementTree.fromstring(text.encode())
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        assert sum(len(path.get("d", "")) for path in root.iter("{http://www.w3.org/2000/svg}path")) > 10_000
        assert not list(root.iter("{http://www.w3.org/2000/svg}image"))
        figure = pictures(result)[name.replace(" ", "_")]()
        png(figure)  # panels are placed
        assert " ".join(svg(figure).split()) == text
    assert len(shown) >= 6


def test_each_claim_unfolds_to_its_statement_and_the_numbers_of_the_certificate(
    result: Result, run: Path, page: Page
) -> None:
    certificate = json.loads((run / "certificate.json").read_text())
    shown = page.texts["details"]
    told: dict[str, Any] = {}
    for text in page.texts["pre"]:
        if text.startswith("{"):
            told |= json.loads(text)
    made = [claim for claim in CLAIMS if result.controller.claims_of(claim) and claim.nothing]
    assert len(made) >= 2
    for claim in made:
        for key in claim.nothing:
            assert told[key] == certificate[key]
            assert any(claim.statement in text and f"certificate.json, {key}" in text for text in shown)


def test_what_the_certificate_does_not_prove_has_no_statement(result: Result, run: Path) -> None:
    content = json.loads((run / "certificate.json").read_text())
    for bounds in (content["bounds"], list[Any]()):
        found = Findings(spec=result.spec, controller=result.controller, result=result)
        page = Page(page_of(found, {}, certificate=json.dumps(content | {"bounds": bounds})))
        assert any(SignalBounds.statement in text for text in page.texts["details"]) == bool(bounds)


def test_bars_are_as_long_as_the_events_say(result: Result, run: Path, page: Page) -> None:
    """By the table of events alone, from the first cell of each part in the trace on."""
    seconds: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    with (run / "events.csv").open(newline="") as file:
        events = list(csv.DictReader(file))
    for part in result.loop.flow.parts:
        own = [row for row in events if row["part"] == part.name]
        cell, since = own[0]["from_cell"] if own else part.cells[result.response.trace.modes[0, 0]], 0.0
        for row in own:
            seconds[part.name][cell] += float(row["t"]) - since
            cell, since = row["to_cell"], float(row["t"])
        seconds[part.name][cell] += 10.0 - since
    assert len(events) > 10
    told = json.loads((run / "run.json").read_text())["simulation"]["time_share"]
    assert {part: set(cells) for part, cells in told.items()} == {part: set(cells) for part, cells in seconds.items()}
    for name, cells in seconds.items():
        for cell, size in cells.items():
            assert told[name][cell] == pytest.approx(size / 10.0, rel=1e-9)
    drawn = [sum(float(wide) for wide in re.findall(r"h(\d+\.\d)v", path)) for path in page.attributes("d")]
    expected = [
        told[part.name][cell] for part in result.loop.flow.parts for cell in part.cells if cell in told[part.name]
    ]
    assert len(drawn) == len(expected)
    assert all(math.isclose(wide / 1000, share, abs_tol=2e-3) for wide, share in zip(drawn, expected, strict=True))


def test_a_run_without_pictures_has_no_page(result: Result, tmp_path: Path) -> None:
    assert not (write_result(result, tmp_path, plots="none") / "report.html").exists()
    write_result(result, tmp_path)
    assert (tmp_path / "report.html").is_file()
    write_result(result, tmp_path, plots="none")
    assert not (tmp_path / "report.html").exists()
    assert not list(tmp_path.glob("*~"))


# Does what a reader does, notes what she then sees, and what was loaded.
SCRIPT = """<script>
addEventListener("load", () => {
  const shown = document.querySelector("dialog"), found = {}, pictures = [...document.querySelectorAll("figure img")];
  found.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  found.folded = [...document.querySelectorAll(".claim")].map(each => each.open);
  document.querySelector(".claim > summary").click();
  found.unfolded = document.querySelector(".claim").open;
  found.drawn = pictures.map(each => each.naturalWidth > 500 && each.clientWidth > 200);
  document.querySelectorAll("figure button")[1].click();
  const large = shown.querySelector("img");
  found.opened = [shown.open, large.alt, large.src === pictures[1].src];
  const width = large.getBoundingClientRect().width;
  large.dispatchEvent(new WheelEvent("wheel", {deltaY: -1, bubbles: true, cancelable: true}));
  found.zoomed = large.getBoundingClientRect().width / width;
  shown.querySelector("[data-by]").click();
  found.more = large.getBoundingClientRect().width / width;
  [...shown.querySelectorAll("button")].at(-1).click();
  found.closed = shown.open;
  dispatchEvent(new Event("beforeprint"));
  found.printed = [...document.querySelectorAll(".claim")].every(each => each.open);
  found.loaded = performance.getEntriesByType("resource").map(entry => entry.name);
  const noted = document.createElement("pre");
  noted.id = "found";
  noted.textContent = JSON.stringify(found);
  document.body.append(noted);
  console.log("the end");
});
</script>
"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [500, 1280])
def test_a_reader_unfolds_zooms_and_prints_and_nothing_is_loaded(run: Path, tmp_path: Path, width: int) -> None:
    text = (run / "report.html").read_text(encoding="utf-8")
    (tmp_path / "page.html").write_text(text.replace("</body>", f"{SCRIPT}</body>"), encoding="utf-8")
    done = browse(tmp_path / "page.html", "--dump-dom", f"--window-size={width},900")
    noted = Noted()
    noted.feed(done.stdout)
    found = json.loads(noted.text)
    assert found["wide"] <= 0
    assert not any(found["folded"])
    assert found["unfolded"]
    assert found["drawn"]
    assert all(found["drawn"])
    assert found["opened"] == [True, "tracking error", True]
    assert found["zoomed"] == pytest.approx(1.2, rel=0.01)
    assert found["more"] == pytest.approx(1.8, rel=0.01)
    assert not found["closed"]
    assert found["printed"]
    assert [name for name in found["loaded"] if not name.startswith("data:")] == []
    assert re.findall(r"CONSOLE.*?\"(.*?)\"", done.stderr) == ["the end"], done.stderr


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [320, 420])
def test_the_page_fits_a_phone(run: Path, tmp_path: Path, width: int) -> None:
    """In a frame, as no window of a browser is so narrow."""
    frame = f'<iframe src="{(run / "report.html").as_uri()}" style="width:{width}px;height:900px"></iframe>'
    measure = """<script>addEventListener("load", () => {
      const seen = document.querySelector("iframe").contentDocument.documentElement;
      const noted = document.createElement("pre");
      noted.id = "found";
      noted.textContent = JSON.stringify([seen.clientWidth, seen.scrollWidth]);
      document.body.append(noted);
    });</script>"""
    (tmp_path / "frame.html").write_text(frame + measure, encoding="utf-8")
    noted = Noted()
    noted.feed(browse(tmp_path / "frame.html", "--dump-dom", "--allow-file-access-from-files").stdout)
    inside, needed = json.loads(noted.text)
    assert 0 <= width - inside < 20
    assert needed <= inside
