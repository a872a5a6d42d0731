"""The outcomes of a batch as JUnit XML, for CI servers."""

import re
from collections.abc import Sequence
from pathlib import Path

from junitparser import Error, Failure, JUnitXml, Skipped, TestCase, TestSuite

from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.report.run_folder import written_at_once

_CONTROL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # not allowed in XML


def _printable(text: str) -> str:
    """Return a text as it may stand in XML."""
    return _CONTROL.sub("\ufffd", text)


def write_junit(outcomes: Sequence[SpecOutcome], path: Path) -> None:
    """Write a JUnit XML report for a CI server.

    Raises:
        InvalidSpec: If the file cannot be written.
    """
    suite = TestSuite("pwatrack")
    for outcome in outcomes:
        case = TestCase(_printable(str(outcome.spec)), classname="pwatrack.batch", time=outcome.seconds)
        if outcome.how == "skipped":
            case.result = [Skipped("one failed before")]
        elif outcome.failed:
            kind = Error if outcome.crashed else Failure
            failure = kind(_printable("; missed: ".join([outcome.ending, *outcome.missed])))
            failure.text = _printable(outcome.messages)
            case.result = [failure]
        lines = (f"{'met' if met else 'missed'}: {text}" for text, met in outcome.required)
        case.system_out = _printable("\n".join([outcome.verdict, *lines]))
        suite.add_testcase(case)
    report = JUnitXml()
    report.add_testsuite(suite)
    with written_at_once(path) as temporary:
        report.write(str(temporary), pretty=True)
