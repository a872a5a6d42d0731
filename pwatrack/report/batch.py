"""The outcomes of a batch as a table and as JUnit XML."""

import re
from collections.abc import Sequence
from pathlib import Path

from junitparser import Failure, JUnitXml, TestCase, TestSuite
from rich.table import Table

from pwatrack.batch.run import Outcome, left_out
from pwatrack.report.run_folder import written_at_once
from pwatrack.report.terminal import console

_COLUMNS = {"norm_K": "‖K‖", "norm_L": "‖L‖", "final_tracking_error": "final error"}

_CONTROL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # not allowed in XML


def print_batch(outcomes: Sequence[Outcome]) -> None:
    """Print the table on stdout, and what failing specs said on stderr."""
    table = Table()
    for name in ("spec", "result", "verdict", *_COLUMNS.values(), "s"):
        numeric = name in (*_COLUMNS.values(), "s")
        table.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for outcome in outcomes:
        figures = [f"{outcome.figures[key]:.3g}" if key in outcome.figures else "" for key in _COLUMNS]
        result = "pass" if outcome.passed else "FAIL"
        table.add_row(str(outcome.spec), result, outcome.verdict, *figures, f"{outcome.seconds:.1f}")
    screen, errors = console(), console(stderr=True)
    if not screen.is_terminal:
        screen.width = 140  # a CI log: names stay whole
    screen.print(table)
    for outcome in outcomes:
        for note in outcome.notes:
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


def write_junit(outcomes: Sequence[Outcome], path: Path) -> None:
    """Write a JUnit XML report for a CI server.

    Raises:
        InvalidSpec: If the file cannot be written.
    """
    suite = TestSuite("pwatrack")
    for outcome in outcomes:
        case = TestCase(str(outcome.spec), classname="pwatrack.batch", time=outcome.seconds)
        if not outcome.passed:
            failure = Failure(f"{outcome.verdict}: exit {outcome.exit}, expected {outcome.expected}")
            failure.text = _CONTROL.sub("\ufffd", outcome.messages)
            case.result = [failure]
        case.system_out = outcome.verdict
        suite.add_testcase(case)
    report = JUnitXml()
    report.add_testsuite(suite)
    with written_at_once(path) as temporary:
        report.write(str(temporary), pretty=True)
