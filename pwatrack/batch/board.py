"""What a terminal shows of a batch: how it goes on, and in the end a table."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from pwatrack.batch.outcomes import FIGURES, SpecOutcome, counted
from pwatrack.batch.run import Watcher
from pwatrack.report.terminal import console

_STYLES = {"pass": "green", "cached": "cyan", "skipped": "yellow"}


class Board(Watcher):
    """Says on a console which specs have ended, and how: use it through `board`."""

    def __init__(self, screen: Console, progress: Progress | None) -> None:
        self.outcomes = list[SpecOutcome]()
        self._screen, self._progress, self._total, self._failures = screen, progress, 0, 0
        self._bar = progress.add_task("specs", total=None, failed="") if progress else None

    def begins(self, total: int) -> None:
        """Learn how many specs there are."""
        self._total = total
        if self._progress and self._bar is not None:
            self._progress.update(self._bar, total=total)

    def ended(self, outcome: SpecOutcome) -> None:
        """Say how one of them ended: at a terminal, cached and skipped ones only move the bar."""
        self.outcomes.append(outcome)
        self._failures += outcome.failed
        done, failures = len(self.outcomes), self._failures
        if self._progress is None or outcome.how == "run":
            width = len(str(self._total))
            verdict = "" if outcome.passed and not outcome.exit else f": {outcome.verdict}"
            text = f"[{done:{width}}/{self._total}] {outcome.result} {outcome.spec}{verdict}"
            said = text if outcome.how != "run" else f"{text} ({outcome.seconds:.1f} s)"
            self._screen.print(said, style=_STYLES.get(outcome.result, "red"), soft_wrap=True)
        if self._progress and self._bar is not None:
            self._progress.update(self._bar, completed=done, failed=f"{failures} failed" if failures else "")


@contextmanager
def board(screen: Console) -> Iterator[Board]:
    """Return a board for a console, with a bar at a terminal until the block ends."""
    if not screen.is_terminal:
        yield Board(screen, None)
        return
    columns = (TextColumn("specs"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[failed]}", style="red"))
    with Progress(*columns, TimeElapsedColumn(), console=screen, transient=True) as progress:
        yield Board(screen, progress)


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
