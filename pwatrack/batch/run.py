"""Many specs, each designed and simulated by itself: one that crashes, hangs or grows stops no other."""

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from pwatrack.batch.cluster import done, received, send
from pwatrack.batch.find import find_specs
from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.pool import PRELOAD, Lost, Pool
from pwatrack.batch.work import Ended, Job, Work, recall, remember, simulate
from pwatrack.interruption import as_ended
from pwatrack.report.run_folder import Plots, sweep


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a batch is run."""

    pattern: str | None = None  # what specs below a folder are named like; None: all that end in .yaml or .yml
    parameters: tuple[str, ...] = ()  # replacements as NAME=VALUE, in every spec
    plots: Plots = "all"  # of which runs pictures are drawn
    outside: bool = False  # whether specs may refer to files outside of their folders
    jobs: int = 1  # how many run at a time
    timeout: float = 600.0  # seconds after which a spec is given up
    memory: float | None = None  # megabytes that a spec may take beyond the program itself; None for any
    fail_fast: bool = False  # whether none is begun after one has failed
    again: Literal["all", "failed", "changed"] = "all"  # those run before: all, that failed, that have changed


def run_batch(
    paths: Path | Sequence[Path],
    out: Path,
    options: Options | None = None,
    *,
    work: Work = simulate,
    preload: Sequence[str] = PRELOAD,
    executor: Executor | None = None,
    told: Callable[[SpecOutcome], object] = lambda _: None,
) -> list[SpecOutcome]:
    """Design and simulate every spec among files and below folders; return an outcome for each, in their order.

    Each spec gets a run folder in `out`, under its own path. `work` is a function of a module, which other processes
    call by its name, after they have imported `preload`; or an executor does it, on whatever machine: files go along
    and come back. `told` learns of every spec as it ends. Raises InvalidSpec if there is no spec.
    """
    options = options or Options()
    places = find_specs([paths] if isinstance(paths, Path) else paths, options.pattern)
    jobs = [
        Job(spec=spec, out=out / place, parameters=options.parameters, plots=options.plots, outside=options.outside)
        for spec, place in places.items()
    ]
    outcomes, rest = dict[Path, SpecOutcome](), list[Job]()

    def ended(outcome: SpecOutcome) -> None:
        outcomes[outcome.spec] = outcome
        told(outcome)

    for job in jobs:
        sweep(job.out)
        start = time.perf_counter()
        known = recall(job, out) if options.again != "all" else None
        seconds = time.perf_counter() - start
        outcome = SpecOutcome.of(job.spec, job.out, known, seconds=seconds, cached=True) if known else None
        if outcome is None or (outcome.failed and options.again == "failed"):
            rest.append(job)
        else:
            ended(outcome)
    if executor is not None:
        for outcome in _worked_off(rest, out, partial(send, executor, work), options):
            ended(outcome)
    elif rest:
        with Pool(options.jobs, timeout=options.timeout, memory=options.memory, preload=preload) as pool:
            for outcome in _worked_off(rest, out, partial(pool.submit, done, work), options):
                ended(outcome)
    return [outcomes[job.spec] for job in jobs]


def _worked_off(
    jobs: Sequence[Job], out: Path, submit: Callable[[Job], "Future[Ended]"], options: Options
) -> Iterator[SpecOutcome]:
    """Yield the outcomes of jobs as they end; no more are handed on than are soon begun: the rest may be skipped."""
    waiting, running = deque(jobs), dict[Future[Ended], Job]()
    at_once = options.jobs if options.fail_fast else 2 * options.jobs
    while waiting or running:
        while waiting and len(running) < at_once:
            job = waiting.popleft()
            running[submit(job)] = job
        future = next(as_ended(running))
        outcome = _outcome(running.pop(future), out, future)
        yield outcome
        if options.fail_fast and outcome.failed:
            for job in waiting:
                yield SpecOutcome(spec=job.spec, folder=job.out, exit=None, reason="skipped", how="skipped")
            waiting.clear()


def _outcome(job: Job, out: Path, future: "Future[Ended]") -> SpecOutcome:
    try:
        ended = received(job, future.result())
        remember(job, out, ended)
        return SpecOutcome.of(job.spec, job.out, ended, seconds=ended.seconds)
    except Lost as lost:
        from pwatrack.spec.load import expected_exit

        sweep(job.out)
        return SpecOutcome(
            spec=job.spec,
            folder=job.out,
            exit=-lost.killer if lost.killer else None,
            expected=expected_exit(job.spec),
            reason=lost.reason,
            messages=lost.said or lost.reason,
            seconds=lost.seconds,
        )
