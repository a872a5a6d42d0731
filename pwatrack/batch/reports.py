"""The outcomes of a batch for other programs: JUnit XML, JSON Lines, SARIF, and what GitHub's runners show."""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

from junitparser import Error, Failure, JUnitXml, Skipped, TestCase, TestSuite

from pwatrack.batch.outcomes import SpecOutcome, counted
from pwatrack.report.run_folder import written_at_once
from pwatrack.report.terminal import JobFault, annotated, visible
from pwatrack.version import __version__

_CONTROL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # not allowed in XML
_SARIF = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"
_MOST_ANNOTATIONS = 10  # of a step: GitHub shows no more


def write_junit(outcomes: Sequence[SpecOutcome], path: Path) -> None:
    """Write a JUnit XML report for a CI server."""
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


def write_lines(outcomes: Sequence[SpecOutcome], path: Path) -> None:
    """Write one JSON object for each spec, on a line of its own."""
    with written_at_once(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(_content(outcome)) + "\n" for outcome in outcomes)


def write_sarif(outcomes: Sequence[SpecOutcome], path: Path) -> None:
    """Write what is wrong in failing specs as SARIF 2.1.0, for editors and code scanning."""
    results = [result for outcome in outcomes if outcome.failed for result in _results(outcome)]
    rules = [{"id": rule} for rule in sorted({result["ruleId"] for result in results})]
    driver = {"name": "pwatrack", "version": __version__, "rules": rules}
    run = {"tool": {"driver": driver}, "columnKind": "unicodeCodePoints", "results": results}
    with written_at_once(path) as temporary:
        temporary.write_text(json.dumps({"$schema": _SARIF, "version": "2.1.0", "runs": [run]}, indent=1), "utf-8")


def annotations(outcomes: Sequence[SpecOutcome]) -> Iterator[str]:
    """Yield a workflow command for each thing that is wrong in a failing spec, to stand beside its line on GitHub."""
    for outcome in outcomes:
        if not outcome.failed:
            continue
        file, title = visible(str(outcome.spec)), visible(outcome.verdict)
        for fault in outcome.faults[:_MOST_ANNOTATIONS]:
            yield annotated(fault, title=title, file=file, said=visible)
        if not outcome.faults:
            whole = JobFault(message="; ".join([outcome.ending, *outcome.missed]))
            yield annotated(whole, title=title, file=file, said=visible)


def add_summary(outcomes: Sequence[SpecOutcome], environment: Mapping[str, str] = os.environ) -> None:
    """Add a table to the summary of a job on GitHub, where there is one."""
    if not (path := environment.get("GITHUB_STEP_SUMMARY")):
        return
    rows = [f"### pwatrack: {counted(outcomes)}", "", "| spec | result | verdict | s |", "|---|---|---|---:|"]
    for outcome in outcomes:
        texts = (str(outcome.spec), outcome.result, "; ".join([outcome.verdict, *outcome.missed]))
        rows.append(f"| {' | '.join(map(_cell, texts))} | {outcome.seconds:.1f} |")
    with Path(path).open("a", encoding="utf-8", errors="replace") as file:
        file.write("\n".join(rows) + "\n\n")


def _printable(text: str) -> str:
    """Return a text as it may stand in XML."""
    return _CONTROL.sub("\ufffd", text)


def _content(outcome: SpecOutcome) -> dict[str, Any]:
    return {
        "spec": str(outcome.spec),
        "folder": str(outcome.folder),
        "result": outcome.how if outcome.how == "skipped" else "passed" if outcome.passed else "failed",
        "cached": outcome.how == "cached",
        "verdict": outcome.verdict,
        "exit": outcome.exit,
        "expected": outcome.expected,
        "seconds": outcome.seconds,
        "figures": dict(outcome.figures),
        "requirements": [{"said": text, "met": met} for text, met in outcome.required],
        "notes": list(outcome.notes),
        "messages": outcome.messages,
        "faults": [asdict(fault) for fault in outcome.faults],
    }


def _results(outcome: SpecOutcome) -> Iterator[dict[str, Any]]:
    """Yield the results of one spec: one for each fault, or one that says how it ended."""
    rule = "lost" if outcome.reason else outcome.verdict.replace(" ", "-")
    for fault in outcome.faults or [JobFault(message=outcome.ending)]:
        place: dict[str, Any] = {"artifactLocation": {"uri": quote(bytes(outcome.spec))}}
        if fault.place:
            place["region"] = {"startLine": fault.place.line, "startColumn": fault.place.column}
        message = {"text": fault.message + (f"\n{fault.hint}" if fault.hint else "")}
        locations = [{"physicalLocation": place}]
        yield {"ruleId": fault.code or rule, "level": "error", "message": message, "locations": locations}


def _cell(text: str) -> str:
    """Return a text as it may stand in a table of Markdown."""
    plain = visible(text).replace("&", "&amp;").replace("<", "&lt;").replace("\n", " ")
    return "".join(f"\\{c}" if c in "\\|`*_[]" else c for c in plain)
