"""Runs for the tests of run folders, in a module that imports fast."""

import json
from pathlib import Path

from pwatrack.report.run_folder import run_folder

NAMES = ("gains.json", "certificate.json", "trace.csv")
RUNS = {0: NAMES, 1: ("refusal.json",), 2: (*NAMES, "generator.json")}  # an earlier run and the next differ in files


def write(folder: str | Path, number: int) -> None:
    with run_folder(folder) as run:
        for name in RUNS[number % 3]:
            run.text(name, json.dumps({"number": number, "padding": "x" * 200_000 * (name == "trace.csv")}))
        run.commit({"verdict": "proved", "number": number})


def record(folder: str | Path, index: dict[str, object]) -> None:
    """Leave a run of one file."""
    with run_folder(folder) as run:
        run.text("gains.json", "{}")
        run.commit(index)
