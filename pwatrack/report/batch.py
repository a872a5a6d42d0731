"""The outcomes of a batch as a table and as JUnit XML."""

from collections.abc import Sequence
from pathlib import Path

from junitparser import Failure, JUnitXml, TestCase, TestSuite
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pwatrack.batch.run import Outcome
from pwatrack.report.run_folder import run_folder

_COLUMNS = {"norm_K": "‖K‖", "norm_L": "‖L‖", "final_tracking_error": "final error"}


def print_batch(outcomes: Sequence[Outcome]) -> None:
    """Print the table on stdout, and what failing specs said on stderr."""
    table = Table()
    for name in ("spec", "result", "verdict", *_COLUMNS.values(), "s"):
        numeric = name in (*_COLUMNS.values(), "s")
        table.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for outcome in outcomes:
        figures = [f"{outcome.figures[key]:.3g}" if key in outcome.figures else "" for key in _COLUMNS]
        result = "pass" if outcome.passed else "FAIL"
        table.add_row(escape(str(outcome.spec)), result, outcome.verdict, *figures, f"{outcome.seconds:.1f}")
    console, errors = Console(highlight=False), Console(stderr=True, highlight=False)
    if not console.is_terminal:
        console.width = 140  # a CI log: names stay whole
    console.print(table)
    failed = [outcome for outcome in outcomes if not outcome.passed]
    console.print(f"{len(outcomes) - len(failed)} passed, {len(failed)} failed")
    for outcome in failed:
        ending = f"{outcome.verdict}, exit {outcome.exit}, expected {outcome.expected}"
        errors.print(escape(f"{outcome.spec}: {ending}\n{outcome.messages}"), soft_wrap=True)


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
            failure.text = outcome.messages
            case.result = [failure]
        case.system_out = outcome.verdict
        suite.add_testcase(case)
    report = JUnitXml()
    report.add_testsuite(suite)
    with run_folder(path.parent) as folder:
        report.write(str(folder.place(path.name)), pretty=True)
