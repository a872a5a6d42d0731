"""The outcomes of a batch as JSON Lines and as SARIF."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.report.run_folder import written_at_once
from pwatrack.version import __version__

_SARIF = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"


def write_lines(outcomes: Sequence[SpecOutcome], path: Path) -> None:
    """Write one JSON object for each spec, on a line of its own.

    Raises:
        InvalidSpec: If the file cannot be written.
    """
    with written_at_once(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(_content(outcome)) + "\n" for outcome in outcomes)


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


def write_sarif(outcomes: Sequence[SpecOutcome], path: Path) -> None:
    """Write what is wrong in failing specs as SARIF 2.1.0, for editors and code scanning.

    Raises:
        InvalidSpec: If the file cannot be written.
    """
    failed = [outcome for outcome in outcomes if outcome.failed]
    results = [result for outcome in failed for result in _results(outcome)]
    rules = [{"id": rule} for rule in sorted({result["ruleId"] for result in results})]
    driver = {"name": "pwatrack", "version": __version__, "rules": rules}
    run = {"tool": {"driver": driver}, "columnKind": "unicodeCodePoints", "results": results}
    with written_at_once(path) as temporary:
        temporary.write_text(json.dumps({"$schema": _SARIF, "version": "2.1.0", "runs": [run]}, indent=1), "utf-8")


def _rule(outcome: SpecOutcome) -> str:
    return outcome.verdict.replace(" ", "-") if not outcome.reason else "lost"


def _results(outcome: SpecOutcome) -> list[dict[str, Any]]:
    """Return the results of one spec: one for each fault, or one that says how it ended."""
    if not outcome.faults:
        return [_result(outcome, _rule(outcome), outcome.ending, None)]
    return [
        _result(
            outcome,
            fault.code or _rule(outcome),
            fault.message + (f"\n{fault.hint}" if fault.hint else ""),
            {"startLine": fault.place.line, "startColumn": fault.place.column} if fault.place else None,
        )
        for fault in outcome.faults
    ]


def _result(outcome: SpecOutcome, rule: str, text: str, region: dict[str, int] | None) -> dict[str, Any]:
    place: dict[str, Any] = {"artifactLocation": {"uri": quote(bytes(outcome.spec))}}
    if region:
        place["region"] = region
    message = {"text": text}
    return {"ruleId": rule, "level": "error", "message": message, "locations": [{"physicalLocation": place}]}
