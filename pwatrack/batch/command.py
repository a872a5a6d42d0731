"""A batch as the command line does it: how it goes on, table, reports, exit code; also of one that is interrupted."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from pwatrack.batch.cluster import Cluster
from pwatrack.batch.find import find_specs, left_out
from pwatrack.batch.outcomes import FIGURES, SpecOutcome, counted, exit_code
from pwatrack.batch.page import write_page
from pwatrack.batch.reports import add_summary, annotations, write_junit, write_lines, write_sarif
from pwatrack.batch.run import Options, run_batch
from pwatrack.batch.work import Work, simulate
from pwatrack.errors import InvalidSpec
from pwatrack.report.terminal import STYLE, console

Writer = Callable[[Sequence[SpecOutcome], Path], None]
_STYLES = {"pass": "green", "cached": "cyan", "skipped": "yellow"}
WRITERS: dict[str, Writer] = {".xml": write_junit, ".jsonl": write_lines, ".sarif": write_sarif, ".html": write_page}


def batch(
    paths: Sequence[Path],
    out: Path,
    options: Options,
    *,
    reports: Sequence[Path] = (),
    junit: Path | None = None,
    scheduler: str | None = None,
    work: Work = simulate,
) -> int:
    """Run a batch, show how it goes on, print its table, write its reports, and return its exit code."""
    for path in reports:
        if path.suffix.lower() not in WRITERS:
            raise InvalidSpec(f"--report {path}: its ending says its kind, one of {', '.join(WRITERS)}")
    writers = [(WRITERS[path.suffix.lower()], path) for path in reports] + ([(write_junit, junit)] if junit else [])
    for path, reason in left_out(paths, options.pattern):
        console(stderr=True).print(f"{path}: left out: {reason}", soft_wrap=True)
    total, ended = len(find_specs(paths, options.pattern)), list[SpecOutcome]()
    try:
        workers: AbstractContextManager[Cluster | None] = nullcontext()
        if scheduler:
            workers = Cluster(scheduler, timeout=options.timeout, memory=options.memory)
        with workers as cluster, board(console(stderr=True), total, ended) as told:
            options = replace(options, jobs=cluster.jobs) if cluster else options
            outcomes = run_batch(paths, out, options, work=work, executor=cluster, told=told)
    except (KeyboardInterrupt, SystemExit):
        _report(sorted(ended, key=lambda outcome: outcome.spec), writers)
        raise
    _report(outcomes, writers)
    return exit_code(outcomes)


def _report(outcomes: Sequence[SpecOutcome], writers: Sequence[tuple[Writer, Path]]) -> None:
    """Print the table and write all reports; what cannot be written is said after the others are."""
    print_batch(outcomes)
    refused: list[InvalidSpec] = []
    if STYLE.get() == "github" or os.environ.get("GITHUB_ACTIONS") == "true":
        for command in annotations(outcomes):
            console().print(command, soft_wrap=True)
    try:
        add_summary(outcomes)
    except OSError as error:
        refused.append(InvalidSpec(f"cannot write the summary of the job: {error.strerror or error}"))
    for writer, path in writers:
        try:
            writer(outcomes, path)
        except InvalidSpec as refusal:
            refused.append(refusal)
    if refused:
        raise InvalidSpec(*(problem for refusal in refused for problem in refusal.problems))


@contextmanager
def board(screen: Console, total: int, ended: list[SpecOutcome]) -> Iterator[Callable[[SpecOutcome], None]]:
    """Return what adds outcomes to a list and says them, at a terminal with a bar, which alone tells of cached ones."""
    columns = (TextColumn("specs"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[failed]}", style="red"))
    off = not screen.is_terminal
    with Progress(*columns, TimeElapsedColumn(), console=screen, transient=True, disable=off) as progress:
        bar = progress.add_task("specs", total=total, failed="")

        def told(outcome: SpecOutcome) -> None:
            ended.append(outcome)
            if off or outcome.how == "run":
                verdict = "" if outcome.passed and not outcome.exit else f": {outcome.verdict}"
                text = f"[{len(ended):{len(str(total))}}/{total}] {outcome.result} {outcome.spec}{verdict}"
                said = text if outcome.how != "run" else f"{text} ({outcome.seconds:.1f} s)"
                screen.print(said, style=_STYLES.get(outcome.result, "red"), soft_wrap=True)
            failures = sum(each.failed for each in ended)
            progress.update(bar, completed=len(ended), failed=f"{failures} failed" if failures else "")

        yield told


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
