"""A batch as the command line does it: board, table, reports, exit code; reports also of one that is interrupted."""

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

from pwatrack.batch.board import board, print_batch, print_left_out
from pwatrack.batch.cluster import Cluster
from pwatrack.batch.find import left_out
from pwatrack.batch.outcomes import SpecOutcome, exit_code
from pwatrack.batch.page import write_page
from pwatrack.batch.pool import PRELOAD, Pool
from pwatrack.batch.reports import add_summary, annotations, write_junit, write_lines, write_sarif
from pwatrack.batch.run import Options, run_batch
from pwatrack.batch.sweep import Method, draw_sweep, places, sweep, told_of, write_sweep
from pwatrack.batch.work import Work, simulate
from pwatrack.errors import InvalidSpec
from pwatrack.report.terminal import STYLE, console
from pwatrack.spec.axis import axis

Writer = Callable[[Sequence[SpecOutcome], Path], None]
_LIMIT = 600.0  # s: for a point of a sweep
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
    print_left_out(left_out(paths, options.pattern))
    ended: Sequence[SpecOutcome] = []
    try:
        workers: AbstractContextManager[Cluster | None] = nullcontext()
        if scheduler:
            workers = Cluster(scheduler, timeout=options.timeout, memory=options.memory)
        with workers as cluster, board(console(stderr=True)) as watcher:
            ended = watcher.outcomes
            options = replace(options, jobs=cluster.jobs) if cluster else options
            outcomes = run_batch(paths, out, options, work=work, executor=cluster, watcher=watcher)
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


def swept(
    spec: Path,
    ranges: Sequence[str],
    out: Path,
    *,
    parameters: Sequence[str],
    method: Method,
    count: int,
    seed: int,
    simulated: bool,
    refine: float | None,
    jobs: int,
    scheduler: str | None,
) -> None:
    """Sweep a spec as the command line does, over given ranges or those of the file."""
    from pwatrack.spec.load import assignments, read_sweep

    fixed = assignments(parameters)
    axes = [axis(text) for text in ranges] or read_sweep(spec, fixed)[1]
    if not axes:
        raise InvalidSpec(f"{spec}: nothing varies", hint="--sweep k=0.1:0.9:17, or 'sweep' in the file")
    at = places(axes, method, count, seed)
    name, _ = read_sweep(spec, {**fixed, **{key: repr(value) for key, value in at[0].items()}})
    with (
        console(stderr=True).status("Starting") as status,
        Cluster(scheduler, timeout=_LIMIT) if scheduler else Pool(jobs, timeout=_LIMIT, preload=PRELOAD) as executor,
    ):
        points, edges = sweep(
            spec,
            axes,
            executor,
            at=at,
            fixed=fixed,
            simulated=simulated,
            refine=refine if method == "grid" else None,
            progress=lambda done, total: status.update(f"{done:,} of {total:,}"),
        )
    screen = console()
    files = write_sweep(out, axes, points, edges)
    if draw_sweep(out / "sweep.png", f"{name}: {len(points):,} designs", axes, points, edges):
        files.append(out / "sweep.png")
    for verdict in dict.fromkeys(point.verdict for point in points):
        screen.print(f"{sum(point.verdict == verdict for point in points):,} {verdict}")
    for sentence in told_of(points, edges):
        screen.print(sentence, soft_wrap=True)
    if edges and len(axes) > 1:
        screen.print(f"a kind of proof ends at {len(edges):,} places: boundary.csv has both sides of each")
    screen.print(f"{out}: {', '.join(file.name for file in files)}", soft_wrap=True)
