"""How a batch goes on: a live board at a terminal, a line for each spec as it ends elsewhere."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.run import Watcher

_STYLES = {"pass": "green", "cached": "cyan", "skipped": "yellow"}


class Board(Watcher):
    """Says on a console which specs have ended, and how: use it through `board`."""

    def __init__(self, screen: Console, progress: Progress | None) -> None:
        self._screen, self._progress = screen, progress
        self._total = self._done = self._failed = 0
        self._bar = progress.add_task("specs", total=None, failed="") if progress else None

    def begins(self, total: int) -> None:
        """Learn how many specs there are."""
        self._total = total
        if self._progress and self._bar is not None:
            self._progress.update(self._bar, total=total)

    def ended(self, outcome: SpecOutcome) -> None:
        """Say how one of them ended: at a terminal, cached and skipped ones only move the bar."""
        self._done += 1
        self._failed += outcome.failed
        if self._progress is None or outcome.how == "run":
            width = len(str(self._total))
            verdict = "" if outcome.passed and not outcome.exit else f": {outcome.verdict}"
            text = f"[{self._done:{width}}/{self._total}] {outcome.result} {outcome.spec}{verdict}"
            said = text if outcome.how != "run" else f"{text} ({outcome.seconds:.1f} s)"
            self._screen.print(said, style=_STYLES.get(outcome.result, "red"), soft_wrap=True)
        if self._progress and self._bar is not None:
            failed = f"{self._failed} failed" if self._failed else ""
            self._progress.update(self._bar, completed=self._done, failed=failed)


@contextmanager
def board(screen: Console) -> Iterator[Board]:
    """Return a board for a console, with a bar at a terminal until the block ends."""
    if not screen.is_terminal:
        yield Board(screen, None)
        return
    columns = (TextColumn("specs"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[failed]}", style="red"))
    with Progress(*columns, TimeElapsedColumn(), console=screen, transient=True) as progress:
        yield Board(screen, progress)
