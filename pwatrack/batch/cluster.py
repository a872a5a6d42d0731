"""Work that is done on other machines: what it reads goes along, and what it leaves comes back and is written here.

The workers of a dask scheduler are an executor: each does its tasks in processes of a pool, as it is done locally. So
a task that crashes, hangs or grows fails by itself there too, and the worker lives on. A task whose worker is lost is
done again by another one.
"""

import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import lru_cache
from importlib import import_module
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any
from weakref import WeakSet

from pwatrack.batch.pool import PRELOAD, Lost, Pool
from pwatrack.batch.work import Ended, Job, Work, inputs, refused
from pwatrack.errors import InvalidSpec
from pwatrack.interruption import uninterrupted
from pwatrack.remote_files import Found, attempt, carried
from pwatrack.report.run_folder import Left, left_elsewhere, read_index
from pwatrack.spec.load import file_content, referenced_files
from pwatrack.spec.table import Folder, table_content
from pwatrack.version import versions

_PATIENCE = 10.0  # seconds in which a scheduler and a worker are to be found
_LOOK = 1.0  # seconds between two looks whether anybody still waits for a task

Settings = tuple[float | None, float | None, tuple[str, ...]]  # timeout, memory and preload of a pool


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


def done(work: Work, job: Job, depends: tuple[str, tuple[str, ...]] | None = None) -> Ended:
    """Do a job here, where its folder is, or with what it depends on as `inputs` had it elsewhere."""
    start, (key, files) = time.perf_counter(), depends or inputs(job)
    return replace(work(job), key=key, inputs=files, seconds=time.perf_counter() - start)


def send(executor: Executor, work: Work, job: Job) -> "Future[Ended]":
    """Hand on a job to whoever can do it without the files of this machine: see `received`."""
    depends, files = inputs(job), packed(job.spec, outside=job.outside)
    return executor.submit(with_files, files, _left, work, job, depends, Left(index=read_index(job.out)))


def _left(work: Work, job: Job, depends: tuple[str, tuple[str, ...]], left: Left) -> Ended:
    with left_elsewhere(left):
        return replace(done(work, job, depends), left=left)


def received(job: Job, ended: Ended) -> Ended:
    """Write what a job left on another machine into its folder, at once, as if it had been done here."""
    if ended.left is None or ended.left.files is None:
        return ended
    try:
        ended.left.write(job.out)
    except InvalidSpec as error:
        code, lines, faults = refused(error)
        said = "\n".join(filter(None, [ended.messages, *lines]))
        return replace(ended, exit=code, messages=said, faults=faults, index={})
    return replace(ended, index=read_index(job.out) or {} if ended.index else {})


class Cluster(Executor):
    """An executor on the workers of a dask scheduler, limited as `Pool` is, in whose processes they do their tasks.

    Use it as a context: an exception inside cancels what is left. A future's `result()` raises `Lost` as that of a pool
    does, also where the scheduler went away, and `InvalidSpec` where a worker cannot do the task as it would be done
    here: it has no pwatrack, or other versions. Raises InvalidSpec if distributed is not installed, or there is no
    scheduler at the address, such as "tcp://10.0.0.1:8786", or no worker.
    """

    def __init__(
        self,
        address: str,
        *,
        timeout: float | None = None,
        memory: float | None = None,
        preload: Sequence[str] = PRELOAD,
    ) -> None:
        try:
            distributed: Any = import_module("distributed")
        except ImportError:
            hint = "pip install 'pwatrack[cluster]'"
            raise _unusable("--scheduler: the package distributed is not installed", hint) from None
        hint = "start one with 'dask scheduler', and workers with 'dask worker ADDRESS'"
        try:
            self._client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise _unusable(f"--scheduler {address}: no dask scheduler answers: {error}", hint) from None
        try:
            self._client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError:
            self._client.close()
            raise _unusable(f"--scheduler {address}: the scheduler has no workers", hint) from None
        self._executor = self._client.get_executor(pure=False)
        self._settings: Settings = timeout, memory, tuple(preload)
        self._futures = WeakSet[Future[Any]]()

    @property
    def jobs(self) -> int:
        """How many tasks the workers do at a time."""
        threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future of a call, which some worker will make."""
        future = Future[Any]()
        content = bytes(ForkingPickler.dumps((fn, args, kwargs)))
        self._futures.add(future)
        with uninterrupted():  # a future of dask that is half made says so as it is thrown away
            sent = self._executor.submit(work, content, self._settings, versions())

        def ended(_: object) -> None:
            if future.set_running_or_notify_cancel():
                _settle(future, sent)

        sent.add_done_callback(ended)
        future.add_done_callback(lambda future: future.cancelled() and sent.cancel())
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more tasks, wait for those that are there or cancel them, and leave the scheduler."""
        left = list(self._futures)
        if cancel_futures:
            for future in left:
                future.cancel()
        elif wait:
            futures.wait(left)
        self._client.close()

    def __exit__(self, kind: object, *_: object) -> None:
        self.shutdown(cancel_futures=kind is not None)


def _settle(future: Future[Any], sent: Future[Any]) -> None:
    from distributed import KilledWorker

    if sent.cancelled():
        future.set_exception(Lost("the scheduler has gone, or has dropped the task"))
        return
    error = sent.exception()
    if error is None:
        answer, fine = ForkingPickler.loads(sent.result())
        future.set_result(answer) if fine else future.set_exception(answer)
    elif isinstance(error, KilledWorker):
        future.set_exception(Lost(f"every worker that was at it has died: {error}"))
    else:
        future.set_exception(_unusable(f"--scheduler: a worker cannot do the work: {type(error).__name__}: {error}"))


def _unusable(message: str, hint: str = "") -> InvalidSpec:
    """Return the refusal of a scheduler or a worker: it is about no line of the spec."""
    return InvalidSpec(message, subject=None, hint=hint)


@lru_cache(maxsize=1)  # those that are limited otherwise than was last asked for end
def _idle(_: Settings) -> list[Pool]:
    """Return the processes on a worker that wait for a task and are limited like this."""
    return []


def work(content: bytes, settings: Settings, known: Mapping[str, str]) -> bytes:
    """Make a call in a process of a worker that has the versions of who asks: others may compute other bits."""
    if versions() != known:
        other = [(name, here, known.get(name)) for name, here in versions().items() if known.get(name) != here]
        said = ", ".join(f"{name} {here} instead of {there}" for name, here, there in other)
        return _answer(_unusable(f"--scheduler: a worker has {said}", "install the same versions there"), False)
    multiprocessing.current_process().daemon = False  # that of a nanny may have no children; ours end with it anyway
    idle, (timeout, memory, preload) = _idle(settings), settings
    try:
        function, positional, named = ForkingPickler.loads(content)
    except Exception as broken:
        return _answer(broken, False)
    try:
        pool = idle.pop()
    except IndexError:
        pool = Pool(1, timeout=timeout, memory=memory, preload=preload)
    future = pool.submit(function, *positional, **named)
    while not futures.wait([future], _LOOK).done:
        if _forgotten():
            pool.kill_workers()
    if future.cancelled() or _forgotten():
        return b""  # nobody asks for it
    idle.append(pool)
    error = future.exception()
    return _answer(error, False) if error else _answer(future.result(), True)


def _answer(answer: object, fine: bool) -> bytes:
    return bytes(ForkingPickler.dumps((answer, fine)))


def _forgotten() -> bool:
    """Whether nobody waits any more for what this thread of a worker is at."""
    from distributed import get_worker

    worker = get_worker()
    task = worker.state.tasks.get(worker.get_current_task())
    return task is None or task.state == "cancelled"
