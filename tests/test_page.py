"""The page of a batch in a browser: scripts run, the table is sorted and filtered, nothing is loaded, no error said."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.page import write_page
from tests.test_reports import OUTCOMES

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")

# Does what a reader does, notes what she then sees, and what was loaded.
SCRIPT = """<script>
const seen = () => [...document.querySelectorAll("tbody tr")].filter(row => row.offsetHeight > 0)
  .map(row => row.cells[0].textContent);
const click = name => [...document.querySelectorAll("th button")].find(each => each.textContent === name).click();
const enter = (field, value) => { field.value = value; field.dispatchEvent(new Event("input", {bubbles: true})); };
const kinds = document.getElementById("kind"), words = document.getElementById("text"), found = {};
const note = name => { found[name] = {rows: seen(), count: document.getElementById("count").value}; };
note("at first");
click("spec"); note("by name");
click("spec"); note("by name, down");
click("time (s)"); note("by time");
click("time (s)"); note("by time, down");
click("‖K‖"); note("by gain");
enter(kinds, "fail"); note("failed");
enter(words, "KILLED"); note("failed with a word");
enter(kinds, ""); enter(words, "no such word"); note("nothing");
enter(words, ""); note("all again");
document.querySelector("form").requestSubmit();
found.kinds = [...kinds.options].map(option => option.value);
found.loaded = performance.getEntriesByType("resource").map(entry => entry.name);
found.verdict = Math.min(...[...document.querySelectorAll("td.verdict")].map(cell => cell.clientWidth));
found.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
console.log("the end");
const noted = document.createElement("pre");
noted.id = "found";
noted.textContent = JSON.stringify(found);
document.body.append(noted);
</script>
"""


class Noted(HTMLParser):
    """Collects what the script noted."""

    def __init__(self) -> None:
        super().__init__()
        self.text, self.inside = "", False

    def handle_starttag(self, _: str, attributes: list[tuple[str, str | None]]) -> None:
        self.inside = ("id", "found") in attributes

    def handle_endtag(self, _: str) -> None:
        self.inside = False

    def handle_data(self, data: str) -> None:
        self.text += data if self.inside else ""


def browse(page: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    assert BROWSER is not None
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--hide-scrollbars"]
    command += [f"--user-data-dir={page.parent / 'profile'}", *options, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page of outcomes with long names and texts, one of them with pictures."""
    from PIL import Image

    folder = tmp_path / "runs" / "pictured"
    folder.mkdir(parents=True)
    for name in ("outputs.png", "tracking_error.png"):
        Image.new("RGB", (1125, 780), "white").save(folder / name)
    more = [
        SpecOutcome(spec=Path("specs/pictured.yaml"), folder=folder, exit=0, figures={"norm_K": 10.0}, seconds=9.5),
        SpecOutcome(
            spec=Path("specs/hand_written.yaml"), folder=folder, exit=0, figures={"norm_K": 9.0}, seconds=10.25
        ),
    ]
    write_page([*OUTCOMES, *more], tmp_path / "page.html")
    return tmp_path / "page.html"


def test_a_reader_sorts_and_filters_the_table_and_nothing_is_loaded(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace("</body>", f"{SCRIPT}</body>"), encoding="utf-8")
    done = browse(page, "--dump-dom", "--window-size=1000,700")
    noted = Noted()
    noted.feed(done.stdout)
    found: dict[str, Any] = json.loads(noted.text)
    rows = {name: [Path(spec).stem for spec in each["rows"]] for name, each in found.items() if isinstance(each, dict)}
    first = ["a,b: \\udcff\\x1b[31m|<b>%\n", "killed", "slow", "good", "same", "skipped", "pictured", "hand_written"]
    assert rows["at first"] == first
    named = sorted(found["at first"]["rows"], key=lambda spec: spec.lower())
    assert sorted(found["by name"]["rows"]) == sorted(named)
    assert found["by name, down"]["rows"] == found["by name"]["rows"][::-1]
    assert rows["by name"].index("hand_written") < rows["by name"].index("pictured")
    assert rows["by time"][-3:] == ["good", "pictured", "hand_written"]  # 1.25, 9.5, 10.25
    assert rows["by time, down"][:3] == ["hand_written", "pictured", "good"]
    assert rows["by gain"][:3] == ["good", "hand_written", "pictured"]  # 2.5, 9, 10, and then those that have none
    assert set(rows["failed"]) == {first[0], "killed", "slow"}
    assert rows["failed with a word"] == ["killed"]
    assert rows["nothing"] == []
    assert sorted(rows["all again"]) == sorted(first)
    counts = [found[name]["count"] for name in ("at first", "failed", "failed with a word", "nothing")]
    assert counts == ["8 of 8", "3 of 8", "1 of 8", "0 of 8"]
    assert found["kinds"] == ["", "cached", "fail", "pass", "skipped"]
    assert [name for name in found["loaded"] if not name.startswith("data:")] == []
    said = re.findall(r"CONSOLE.*?\"(.*?)\"", done.stderr)
    assert said == ["the end"], done.stderr


@pytest.mark.parametrize("width", [500, 1220, 1280, 1400])
def test_the_page_is_no_wider_than_its_window(page: Path, width: int) -> None:
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace("</body>", f"{SCRIPT}</body>"), encoding="utf-8")
    noted = Noted()
    noted.feed(browse(page, "--dump-dom", f"--window-size={width},900").stdout)
    found = json.loads(noted.text)
    assert found["wide"] <= 0
    assert found["verdict"] >= 288
