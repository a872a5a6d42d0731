"""The outcomes of a batch as a table and as JUnit XML."""

import re
from collections.abc import Sequence
from pathlib import Path

from junitparser import Failure, JUnitXml, TestCase, TestSuite
from rich.table import Table

from pwatrack.batch.run import Outcome, left_out
from pwatrack.report.run_folder import written_at_once
from pwatrack.report.terminal import console

_COLUMNS = {"norm_K": "‖K‖", "norm_L": "‖L‖", "final_error": "final error"}

_CONTROL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # not allowed in XML


def print_batch(outcomes: Sequence[Outcome]) -> None:
    """Print the table on stdout, and what failing specs said on stderr."""
    table = Table()
    some = ["required"] if any(outcome.required for outcome in outcomes) else []
    for name in ("spec", "result", "verdict", *some, *_COLUMNS.values(), "s"):
        numeric = name in (*some, *_COLUMNS.values(), "s")
        table.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for outcome in outcomes:
        figures = [f"{outcome.figures[key]:.3g}" if key in outcome.figures else "" for key in _COLUMNS]
        result = "pass" if outcome.passed else "FAIL"
        total = len(outcome.required)
        met = [f"{total - len(outcome.missed)} of {total}" if total else "" for _ in some]
        table.add_row(str(outcome.spec), result, outcome.verdict, *met, *figures, f"{outcome.seconds:.1f}")
    screen, errors = console(), console(stderr=True)
    if not screen.is_terminal:
        screen.width = 140  # a CI log: names stay whole
    screen.print(table)
    for outcome in outcomes:
        for note in (*(f"requirement missed: {text}" for text in outcome.missed), *outcome.notes):
            screen.print(f"{outcome.spec}: {note}", soft_wrap=True)
    failed = [outcome for outcome in outcomes if not outcome.passed]
    screen.print(f"{len(outcomes) - len(failed)} passed, {len(failed)} failed")
    for outcome in failed:
        ending = f"{outcome.verdict}, exit {outcome.exit}, expected {outcome.expected}"
        errors.print(f"{outcome.spec}: {ending}\n{outcome.messages}", soft_wrap=True)


def print_left_out(folder: Path) -> None:
    """Say on stderr which specs are not run, and why."""
    for path, reason in left_out(folder):
        console(stderr=True).print(f"{path}: left out: {reason}", soft_wrap=True)


def _printable(text: str) -> str:
    """Return a text as it may stand in XML."""
    return _CONTROL.sub("\ufffd", text)


def write_junit(outcomes: Sequence[Outcome], path: Path) -> None:
    """Write a JUnit XML report for a CI server.

    Raises:
        InvalidSpec: If the file cannot be written.
    """
    suite = TestSuite("pwatrack")
    for outcome in outcomes:
        case = TestCase(str(outcome.spec), classname="pwatrack.batch", time=outcome.seconds)
        if not outcome.passed:
            ending = f"{outcome.verdict}: exit {outcome.exit}, expected {outcome.expected}"
            failure = Failure(_printable("; missed: ".join([ending, *outcome.missed])))
            failure.text = _printable(outcome.messages)
            case.result = [failure]
        lines = (f"{'met' if met else 'missed'}: {text}" for text, met in outcome.required)
        case.system_out = _printable("\n".join([outcome.verdict, *lines]))
        suite.add_testcase(case)
    report = JUnitXml()
    report.add_testsuite(suite)
    with written_at_once(path) as temporary:
        report.write(str(temporary), pretty=True)
