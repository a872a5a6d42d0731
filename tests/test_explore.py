"""The page on which one moves a parameter says and draws, at each place, what a design there comes to."""

import json
import re
import shutil
import subprocess
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docs.ext.explore import explored
from pwatrack import Infeasible, design, load_spec, simulate

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
PAGE = Path(__file__).parents[1] / "docs" / "try" / "index.md"
FAST, GAP = (0.1, 0.55), (0.1, 0.3)
MOVE = """<script>
addEventListener("load", () => {
  const found = [], sliders = [...document.querySelectorAll("input")];
  for (const one of [0, 1]) for (const other of [0, 1]) {
    [sliders[0].value, sliders[1].value] = [one, other];
    sliders[1].dispatchEvent(new Event("input"));
    found.push([document.querySelector(".verdict b").textContent, document.querySelectorAll(".pictures > svg").length]);
  }
  document.body.innerHTML = `<pre id="found">${JSON.stringify(found)}</pre>`;
});
</script>"""


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The spec of the page itself, a shorter run."""
    (text,) = re.findall(r"```\{explore\}[^\n]*\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    path = tmp_path_factory.mktemp("explore") / "move.yaml"
    path.write_text(text.replace("duration: 40", "duration: 5"), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def html(spec: Path) -> str:
    return explored(spec, ["fast=0.1:0.55:2", "gap=0.1:0.3:2"]).split("html\n", 1)[1].rpartition("```")[0]


def test_each_place_holds_its_own_design_and_run(spec: Path, html: str) -> None:
    (content,) = re.findall(r'id="explored">(.*?)</script>', html)
    known: dict[str, Any] = json.loads(content)
    assert known["axes"] == {"fast": [*FAST], "gap": [*GAP]}
    assert len(known["places"]) == 4
    for place, (fast, gap) in zip(known["places"], product(FAST, GAP), strict=True):
        loaded = load_spec(spec, {"fast": fast, "gap": gap})
        assert [s for s, value in place["phi"] if abs(value) < 1e-12] == [-gap, gap]
        if place["verdict"] == "infeasible":
            with pytest.raises(Infeasible):
                design(loaded)
            continue
        run = simulate(loaded)
        at = np.searchsorted(run.t, np.array(place["t"]) - 1e-9)
        assert np.allclose(place["y"], run.y[at, 0], atol=1e-3 * np.abs(run.y).max())
        shares = {cell["name"]: cell["share"] for cell in place["cells"]}
        assert shares == pytest.approx(run.figures.time_share["plant"])


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_in_a_browser_each_move_of_a_slider_shows_its_verdict_and_pictures(html: str, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(f"<!doctype html><meta charset='utf-8'>{html}{MOVE}", encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", f"--user-data-dir={tmp_path}/profile"]
    options += ["--disable-background-networking", "--no-first-run", "--virtual-time-budget=3000"]
    run = subprocess.run(
        [str(BROWSER), *options, page.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    (found,) = re.findall(r'<pre id="found">(.*?)</pre>', run.stdout)
    assert json.loads(found) == [["proved", 4], ["proved", 4], ["proved impossible", 1], ["proved impossible", 1]]
