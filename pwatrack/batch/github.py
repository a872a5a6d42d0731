"""What GitHub's runners show: annotations beside the lines of specs, and the summary of a job."""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pwatrack.batch.outcomes import SpecOutcome, counted
from pwatrack.report.annotation import annotation
from pwatrack.report.terminal import visible

_MOST_ANNOTATIONS = 10  # of a step: GitHub shows no more


def annotations(outcomes: Sequence[SpecOutcome]) -> Iterator[str]:
    """Yield a workflow command for each thing that is wrong in a failing spec.

    Example:
        >>> failed = SpecOutcome(spec=Path("a.yaml"), folder=Path("a"), exit=3)
        >>> list(annotations([failed]))
        ['::error file=a.yaml,title=outside the theory::outside the theory, exit 3, expected 0']
    """
    for outcome in outcomes:
        if not outcome.failed:
            continue
        file, title = visible(str(outcome.spec)), visible(outcome.verdict)
        for fault in outcome.faults[:_MOST_ANNOTATIONS]:
            line, column = (fault.place.line, fault.place.column) if fault.place else (None, None)
            text = visible(fault.message + (f"\nhint: {fault.hint}" if fault.hint else ""))
            coded = f"{title} {fault.code}".rstrip()
            yield annotation(text, title=coded, file=file, line=line, column=column)
        if not outcome.faults:
            yield annotation(visible("; ".join([outcome.ending, *outcome.missed])), title=title, file=file)


def add_summary(outcomes: Sequence[SpecOutcome], environment: Mapping[str, str] = os.environ) -> None:
    """Add a table to the summary of the job, where there is one.

    Raises:
        OSError: If it cannot be written.
    """
    if not (path := environment.get("GITHUB_STEP_SUMMARY")):
        return
    rows = [f"### pwatrack: {counted(outcomes)}", "", "| spec | result | verdict | s |", "|---|---|---|---:|"]
    for outcome in outcomes:
        texts = (str(outcome.spec), outcome.result, "; ".join([outcome.verdict, *outcome.missed]))
        rows.append(f"| {' | '.join(map(_cell, texts))} | {outcome.seconds:.1f} |")
    with Path(path).open("a", encoding="utf-8", errors="replace") as file:
        file.write("\n".join(rows) + "\n\n")


def _cell(text: str) -> str:
    """Return a text as it may stand in a table of Markdown."""
    plain = visible(text).replace("&", "&amp;").replace("<", "&lt;").replace("\n", " ")
    return "".join(f"\\{c}" if c in "\\|`*_[]" else c for c in plain)
