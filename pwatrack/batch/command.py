"""A batch as the command line does it: board, table, reports, exit code; reports also of one that is interrupted."""

from collections.abc import Callable, Sequence
from pathlib import Path

from pwatrack.batch.board import board
from pwatrack.batch.find import left_out
from pwatrack.batch.junit import write_junit
from pwatrack.batch.outcomes import Outcome
from pwatrack.batch.run import Options, Work, run_batch
from pwatrack.batch.table import print_batch, print_left_out
from pwatrack.batch.work import simulate
from pwatrack.errors import InvalidSpec
from pwatrack.report.terminal import console

Writer = Callable[[Sequence[Outcome], Path], None]
WRITERS: dict[str, Writer] = {".xml": write_junit}


def report_writer(path: Path) -> Writer:
    """Return what writes a report to a path: its ending says of which kind.

    Raises:
        InvalidSpec: If there is none of this kind.
    """
    if path.suffix.lower() not in WRITERS:
        raise InvalidSpec(f"--report {path}: its ending says its kind, one of {', '.join(WRITERS)}")
    return WRITERS[path.suffix.lower()]


def batch(
    paths: Sequence[Path],
    out: Path,
    options: Options,
    *,
    reports: Sequence[Path] = (),
    junit: Path | None = None,
    work: Work = simulate,
) -> int:
    """Run a batch, show how it goes on, print its table, write its reports, and return its exit code.

    Raises:
        InvalidSpec: If there is no spec, or a report is of no known kind or cannot be written.
    """
    writers = [(report_writer(path), path) for path in reports] + ([(write_junit, junit)] if junit else [])
    print_left_out(left_out(paths, options.pattern))
    ended: list[Outcome] = []
    try:
        with board(console(stderr=True)) as watcher:
            outcomes = run_batch(paths, out, options, work=work, watcher=watcher, ended=ended)
    except (KeyboardInterrupt, SystemExit):
        _report(sorted(ended, key=lambda outcome: outcome.spec), writers)
        raise
    _report(outcomes, writers)
    return max(outcome.code for outcome in outcomes)


def _report(outcomes: Sequence[Outcome], writers: Sequence[tuple[Writer, Path]]) -> None:
    """Print the table and write all reports; what cannot be written is said after the others are."""
    print_batch(outcomes)
    refused: list[InvalidSpec] = []
    for writer, path in writers:
        try:
            writer(outcomes, path)
        except InvalidSpec as refusal:
            refused.append(refusal)
    if refused:
        raise InvalidSpec(*(problem for refusal in refused for problem in refusal.problems))
