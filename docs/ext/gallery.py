"""The gallery: every spec of this project, run when the site is built."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from docs.ext.cells import ROOT
from docs.ext.reference import said
from pwatrack import load_spec, simulate
from pwatrack.errors import PwatrackError
from pwatrack.report.codes import code_of
from pwatrack.spec.load import expected_exit

SPECS = ROOT / "specs"
RUNS = ROOT / "docs" / "_build" / "gallery"
PICTURES = ROOT / "docs" / "generated"


def run_all() -> None:
    """Design and simulate every spec, or those that have changed since."""
    command = [sys.executable, "-m", "pwatrack", "batch", "specs", "--jobs", "2", "--resume", "--out", str(RUNS)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode:
        raise RuntimeError(f"the gallery does not end as it should:\n{run.stdout}\n{run.stderr}")


def words(path: Path) -> str:
    """Return what the comment at the top of a spec says, as Markdown; lines of commands are left out.

    Example:
        >>> words(SPECS / "gallery" / "stage_with_bumpers.yaml")[:45]
        'A linear stage between two rubber bumpers: a '
    """
    head = re.match(r"(?:#.*\n)+", path.read_text(encoding="utf-8"))
    lines = [line[1:] for line in (head.group() if head else "").splitlines() if not line.startswith("# yaml-")]
    paragraphs = "\n".join(line for line in lines if not line.startswith("     ")).split("\n\n")
    return "\n\n".join(said(paragraph) for paragraph in paragraphs if paragraph.strip())


def plant(path: Path) -> str:
    """Return the entry of a spec that is designed: picture, what is hard about it, result."""
    folder = RUNS / path.relative_to(SPECS).with_suffix("")
    index = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    drawn = "tracking_error" if index.get("practical") else "outputs"
    picture = PICTURES / f"gallery-{path.stem}.png"
    shutil.copyfile(folder / f"{drawn}.png", picture)
    outcome = index["simulation"]["said"]
    entry = [
        f"### {said(index['name'])}",
        "",
        f":::{{figure}} /generated/{picture.name}",
        f":alt: {said(index['name'])}: {drawn.replace('_', ' ')}",
        ":loading: lazy\n:::",
        "",
        words(path),
        "",
        f"**{said(_verdict(index))}** {said(outcome[:1].upper() + outcome[1:])}.",
        "",
        f"[`{path.relative_to(ROOT)}`](/../{path.relative_to(ROOT)})",
        "",
    ]
    return "\n".join(entry)


def _verdict(index: Mapping[str, Any]) -> str:
    figures = index["figures"]
    kind = "Practical tracking, proved" if index.get("practical") else index["verdict"].capitalize()
    return f"{kind}, rate {figures['rate']:.3g} 1/s, ‖K‖ = {figures['norm_K']:.3g} in sizes."


def refusal(path: Path) -> str:
    """Return the entry of a spec that must be refused: what it is, and what is said."""
    lines: list[str] = []
    try:
        simulate(load_spec(path))
    except PwatrackError as error:
        lines = [f"error: {problem} [{code_of(problem.message, error.code)}]" for problem in error.problems]
    shown = "\n".join(lines).replace(str(ROOT) + "/", "")
    title = re.search(r"(?m)^name: (.*)$", path.read_text(encoding="utf-8"))
    entry = [
        f"### {said(title[1]) if title else path.stem}",
        "",
        words(path),
        "",
        f"Exit code {expected_exit(path)}:\n\n:::{{container}} output\n```text\n{shown}\n```\n:::",
        "",
        f"[`{path.relative_to(ROOT)}`](/../{path.relative_to(ROOT)})",
        "",
    ]
    return "\n".join(entry)


def working() -> list[Path]:
    """Return all specs that are designed: the paper's example first, then by name."""
    return [path for path in sorted(SPECS.rglob("*.yaml"), key=_order) if not expected_exit(path)]


def refused() -> list[Path]:
    """Return all specs that are refused."""
    return [path for path in sorted(SPECS.rglob("*.yaml"), key=_order) if expected_exit(path)]


def _order(path: Path) -> tuple[bool, str]:
    return path.parent != SPECS, path.stem


def gallery() -> str:
    """Return an entry for each spec that is designed."""
    run_all()
    return "\n".join(plant(path) for path in working())


def refusals() -> str:
    """Return an entry for each spec that is refused."""
    return "\n".join(refusal(path) for path in refused())


GENERATED: Mapping[str, Callable[[], str]] = {"gallery": gallery, "refusals": refusals}
