"""Work that is done on other machines: what it reads goes along, and what it leaves comes back and is written here."""

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

from pwatrack.batch.record import inputs
from pwatrack.batch.work import Done, Ended, Job, Work, refused
from pwatrack.errors import InvalidSpec
from pwatrack.remote_files import Found, attempt, carried
from pwatrack.report.run_folder import Left, left_elsewhere, read_index
from pwatrack.spec.load import file_content, referenced_files
from pwatrack.spec.table import Folder, table_content


def packed(spec: Path, *, outside: bool = False) -> dict[str, Found]:
    """Return what a spec file and the files that it refers to hold, by their paths, or why they cannot be read."""
    folder, files = Folder(path=spec.parent, outside=outside), {str(spec): attempt(lambda: file_content(spec))}
    for path in referenced_files(spec):
        files[str(path)] = attempt(lambda path=path: table_content(path, folder))  # type: ignore[misc]
    return files


def with_files(files: Mapping[str, Found], function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call a function that reads these files, wherever it is called."""
    with carried(files):
        return function(*arguments, **named)


def done(work: Work, job: Job, depends: tuple[str, tuple[str, ...]] | None = None) -> Done:
    """Do a job here, where its folder is, or with what it depends on as `inputs` had it elsewhere."""
    start, (key, files) = time.perf_counter(), depends or inputs(job)
    ended = work(job)
    return Done(ended=ended, key=key, inputs=files, seconds=time.perf_counter() - start)


def send(executor: Executor, work: Work, job: Job) -> "Future[Done]":
    """Hand on a job to whoever can do it without the files of this machine: see `received`."""
    depends, files = inputs(job), packed(job.spec, outside=job.outside)
    return executor.submit(with_files, files, _left, work, job, depends, Left(index=read_index(job.out)))


def _left(work: Work, job: Job, depends: tuple[str, tuple[str, ...]], left: Left) -> Done:
    with left_elsewhere(left):
        return replace(done(work, job, depends), left=left)


def received(job: Job, done: Done) -> Done:
    """Write what a job left on another machine into its folder, at once, as if it had been done here."""
    if done.left is None or done.left.files is None:
        return done
    try:
        done.left.write(job.out)
    except InvalidSpec as error:
        code, lines, faults = refused(error)
        said = "\n".join(filter(None, [done.ended.messages, *lines]))
        return replace(done, ended=Ended(exit=code, expected=done.ended.expected, messages=said, faults=faults))
    index = read_index(job.out) or {} if done.ended.index else {}
    return replace(done, ended=replace(done.ended, index=index))
