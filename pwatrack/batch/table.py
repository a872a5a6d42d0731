"""The outcomes of a batch as a table."""

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from pwatrack.batch.outcomes import FIGURES, SpecOutcome, counted
from pwatrack.report.terminal import console


def print_batch(outcomes: Sequence[SpecOutcome]) -> None:
    """Print the table on stdout, and what failing specs said on stderr."""
    table = Table()
    some = ["required"] if any(outcome.required for outcome in outcomes) else []
    for name in ("spec", "result", "verdict", *some, *FIGURES.values(), "s"):
        numeric = name in (*some, *FIGURES.values(), "s")
        table.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for outcome in outcomes:
        figures = [f"{outcome.figures[key]:.3g}" if key in outcome.figures else "" for key in FIGURES]
        total = len(outcome.required)
        met = [f"{total - len(outcome.missed)} of {total}" if total else "" for _ in some]
        table.add_row(str(outcome.spec), outcome.result, outcome.verdict, *met, *figures, f"{outcome.seconds:.1f}")
    screen, errors = console(), console(stderr=True)
    if not screen.is_terminal:
        screen.width = 140  # a CI log: names stay whole
    screen.print(table)
    for outcome in outcomes:
        for note in (*(f"requirement missed: {text}" for text in outcome.missed), *outcome.notes):
            screen.print(f"{outcome.spec}: {note}", soft_wrap=True)
    screen.print(counted(outcomes))
    for outcome in outcomes:
        if outcome.failed:
            errors.print(f"{outcome.spec}: {outcome.ending}\n{outcome.messages}", soft_wrap=True)


def print_left_out(left_out: Sequence[tuple[Path, str]]) -> None:
    """Say on stderr which specs are not run, and why."""
    for path, reason in left_out:
        console(stderr=True).print(f"{path}: left out: {reason}", soft_wrap=True)
