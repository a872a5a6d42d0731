"""Processes that work off tasks: what kills or hangs one of them, or takes its memory, fails the task that it is at.

A ProcessPoolExecutor loses every task with one killed process. Here a process that ends is replaced, from a fork server
that has imported everything before: that takes milliseconds.
"""

import ctypes
import gc
import multiprocessing
import os
import resource
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

from pwatrack.errors import CheckFailed
from pwatrack.interruption import uninterrupted

DRAWING = ("pwatrack.cli", "pwatrack.report.plots.pictures")  # what it takes to draw; the first is their main program's
PRELOAD = (*DRAWING, "pwatrack.batch.work", "pwatrack.commands.run", "pwatrack.simulation.kernel")  # every spec

_GRACE = 0.4  # seconds that a process has to clean up when it is told to end
_LONGEST_WAIT = 3600.0  # seconds: a selector takes no number of any size
_START = 60.0  # seconds that a new process has to import what its owner's main program imports
_SAID = 65_536  # bytes that are kept of what a process says before it dies
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)
_MEGABYTE = 2**20  # bytes
_PATHS = "PYTHONSAFEPATH", "PYTHONPATH"  # of the environment: where a Python looks for modules
_STARTING = threading.Lock()  # held while a fork server is started in another environment


class Lost(CheckFailed):
    """A task whose process did not live to end it, and the last that it said on stderr.

    Its killer is the signal that ended the process, if it was one that nobody here sent; 0 otherwise.
    """

    def __init__(self, reason: str, *, killer: int = 0, said: str = "", seconds: float = 0.0) -> None:
        super().__init__(reason)
        self.reason, self.killer, self.said, self.seconds = reason, killer, said, seconds


@dataclass(kw_only=True)
class _Task:
    future: Future[Any]
    content: bytes


@dataclass(kw_only=True)
class _Worker:
    """A process, its task, and whether it has taken it; it is left alone until `deadline`, then ended."""

    process: ForkServerProcess
    tasks: Connection
    errors: Connection
    ready: bool = False
    task: _Task | None = None
    taken: bool = False
    begun: float = 0.0
    deadline: float | None = None
    reason: str = ""
    said: bytearray = field(default_factory=bytearray)


@contextmanager
def _this_package() -> Iterator[dict[str, str | None]]:
    """Let a Python that is started find this package, and no other that the working directory may have.

    Yielded is what its environment was.

    A fork server looks for what it imports beforehand in its own path, and not in that of its owner.
    """
    with _STARTING:
        before = {name: os.environ.get(name) for name in _PATHS}
        path = [str(Path(__file__).parents[2]), *filter(None, [before["PYTHONPATH"]])]
        os.environ.update({"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(path)})
        try:
            yield before
        finally:
            _restore(before)


def _restore(environment: Mapping[str, str | None]) -> None:
    for name, value in environment.items():
        os.environ.pop(name, None)
        if value is not None:
            os.environ[name] = value


class Pool(Executor):
    """An executor that loses one task at most with each process.

    A task may take `timeout` seconds once it has begun, None for any time, and `memory` megabytes beyond the program
    itself, None for any size, which Linux alone keeps. The modules of `preload` are imported once, before the first
    process. A future's `result()` raises `Lost` where the process died, ran out of time or out of memory, and what the
    task raised otherwise.

    Example:
        >>> with Pool(1) as pool:
        ...     pool.submit(max, 3, 5).result()
        5
    """

    def __init__(
        self,
        jobs: int = 1,
        *,
        timeout: float | None = None,
        memory: float | None = None,
        preload: Sequence[str] = (),
    ) -> None:
        self._jobs, self._timeout, self._memory = jobs, timeout, memory
        self._context = multiprocessing.get_context("forkserver")
        self._preload = tuple(preload)
        self._context.set_forkserver_preload(["pwatrack.batch.fork_server", *preload])
        self._lock = threading.Lock()
        self._waiting: deque[_Task] = deque()
        self._workers: list[_Worker] = []
        self._closing = self._killing = False
        self._woken, self._wake = self._context.Pipe(duplex=False)
        self._dispatcher: threading.Thread | None = None

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future of a call, which some process will make."""
        task = _Task(future=Future(), content=bytes(ForkingPickler.dumps((fn, args, kwargs))))
        with uninterrupted(), self._lock:
            if self._closing:
                raise RuntimeError("the pool is closed")
            self._waiting.append(task)
            if self._dispatcher is None:
                self._dispatcher = threading.Thread(target=self._dispatch, daemon=True)
                self._dispatcher.start()
            self._wake.send_bytes(b"!")
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more tasks, end those that are there or cancel those that have not begun, and end the processes."""
        with uninterrupted(), self._lock:
            self._closing = True
            if cancel_futures:
                for task in self._waiting:
                    task.future.cancel()
            self._wake.send_bytes(b"!")
        if wait and self._dispatcher is not None:
            self._dispatcher.join()

    def kill_workers(self) -> None:
        """Cancel what has not begun, and end all processes: what they are at is lost."""
        with self._lock:
            self._killing = True
        self.shutdown(wait=bool(self._workers), cancel_futures=True)  # the first, if it comes yet, ends as it begins

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.shutdown()
        else:
            self.kill_workers()

    def _dispatch(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # what is started here is not for Ctrl-C to end
        try:
            while self._assigned():
                self._look()
        except BaseException as error:  # whoever waits for a future has to learn of it
            for task in [*self._waiting, *(w.task for w in self._workers if w.task)]:
                if not task.future.done():
                    task.future.set_exception(error)
            raise
        finally:
            with self._lock:
                self._closing = True
            for worker in self._workers:
                worker.tasks.close()  # it ends, having nothing to do
            for worker in self._workers:
                worker.process.join(_GRACE)
                if worker.process.exitcode is None:
                    worker.process.kill()
                self._bury(worker)

    def _assigned(self) -> bool:
        """Give tasks to processes that have none; return whether there is anything left to wait for."""
        while True:
            free = next((w for w in self._workers if not w.task and not w.reason), None)
            if free is None and len(self._workers) >= self._jobs:
                break
            with self._lock:
                task = self._waiting.popleft() if self._waiting else None
            if task is None:
                break
            if not task.future.running() and not task.future.set_running_or_notify_cancel():
                continue
            if free is None:
                free = self._start()
                self._workers.append(free)
            free.task, free.taken = task, False
            self._begin(free)
            with suppress(OSError):  # it died meanwhile: seen from its sentinel
                free.tasks.send_bytes(task.content)
        with self._lock:
            return not self._closing or bool(self._waiting) or any(w.task or w.reason for w in self._workers)

    def _begin(self, worker: _Worker) -> None:
        """Let the time of a task begin, if its process is there to do it."""
        worker.begun = time.monotonic()
        start = 0.0 if worker.ready else _START
        worker.deadline = None if self._timeout is None else worker.begun + start + self._timeout

    def _start(self) -> _Worker:
        with _this_package() as own:
            forkserver.ensure_running()
        ours, theirs = self._context.Pipe()
        errors, said = self._context.Pipe(duplex=False)
        args = theirs, said, self._memory, self._preload, own
        process = self._context.Process(target=serve, args=args, daemon=True)
        process.start()
        theirs.close()
        said.close()
        os.set_blocking(errors.fileno(), False)
        return _Worker(process=process, tasks=ours, errors=errors)

    def _look(self) -> None:
        """Wait until something happens, and see to it."""
        if self._killing:
            for worker in self._workers:
                if worker.task and not worker.reason:
                    self._tell(worker, "interrupted")
        deadlines = [w.deadline for w in self._workers if w.deadline is not None]
        watched = [c for w in self._workers for c in (w.tasks, w.errors, w.process.sentinel)]
        limit = min(max(0.0, min(deadlines) - time.monotonic()), _LONGEST_WAIT) if deadlines else None
        ready = wait([self._woken, *watched], limit)
        while self._woken.poll():
            self._woken.recv_bytes()
        for worker in list(self._workers):
            _hear(worker)
            if worker.tasks in ready:
                self._answered(worker)
            if worker.process.sentinel in ready:
                self._ended(worker)
            elif worker.deadline is not None and worker.deadline <= time.monotonic():
                self._tell(worker, worker.reason or f"given up after {self._timeout:g} s")

    def _tell(self, worker: _Worker, reason: str) -> None:
        """Tell a process to end; kill it if it was told before."""
        if worker.reason:
            worker.process.kill()
            worker.deadline = None
        else:
            worker.process.terminate()  # it removes what it has half-written
            worker.reason, worker.deadline = reason, time.monotonic() + _GRACE

    def _answered(self, worker: _Worker) -> bool:
        """Take what a process sends: that it is there, has taken its task, or its answer; say whether there was any."""
        try:
            message = ForkingPickler.loads(worker.tasks.recv_bytes())
        except (EOFError, OSError):  # it is dying: seen from its sentinel
            return False
        if message is None:
            worker.taken, worker.ready = worker.ready, True
        if worker.reason or worker.task is None:  # too late
            return True
        if message is None:
            self._begin(worker)
            return True
        answer, fine = message
        task, worker.task = worker.task, None
        worker.deadline = None
        worker.said.clear()
        if fine:
            task.future.set_result(answer)
        elif isinstance(answer, MemoryError):
            worker.reason = str(answer)  # it is replaced: who knows what it still holds
            worker.process.kill()
            task.future.set_exception(Lost(str(answer), seconds=time.monotonic() - worker.begun))
        else:
            task.future.set_exception(answer)
        return True

    def _ended(self, worker: _Worker) -> None:
        if not worker.reason:
            with suppress(OSError):
                while worker.task and worker.tasks.poll() and self._answered(worker):
                    pass  # its last answer came just before
        self._bury(worker)
        with self._lock:
            self._workers.remove(worker)
        if worker.task and worker.ready and not worker.taken and not worker.reason:  # it died of something else
            with self._lock:
                self._waiting.appendleft(worker.task)
        elif worker.task:
            code = worker.process.exitcode or 0
            killer = -code if code < 0 and not worker.reason else 0
            reason = worker.reason or (f"killed by signal {killer}" if killer else f"ended by itself with {code}")
            said = worker.said.decode("utf-8", "replace").strip()
            seconds = time.monotonic() - worker.begun
            worker.task.future.set_exception(Lost(reason, killer=killer, said=said, seconds=seconds))

    def _bury(self, worker: _Worker) -> None:
        worker.process.join()
        _hear(worker)
        for connection in (worker.tasks, worker.errors):
            connection.close()


def _hear(worker: _Worker) -> None:
    """Take what a process says on stderr, or it would wait for ever to be heard."""
    with suppress(BlockingIOError, OSError):
        while said := os.read(worker.errors.fileno(), _SAID):
            worker.said += said
            del worker.said[:-_SAID]


def serve(
    tasks: Connection,
    errors: Connection,
    memory: float | None,
    preload: Sequence[str],
    environment: Mapping[str, str | None],
) -> None:
    """Work off tasks: (function, arguments, named arguments) come, and (answer, whether it is one) go.

    A None goes at first, and as a task is taken.

    All that the process says on stderr goes to `errors`. A task may take so many megabytes beyond the program itself.
    The modules of `preload` are there before the first task, also if the fork server was begun for another pool; what
    it was begun in is not what its processes have: `environment` is put back.
    """
    _follow_parent()
    _restore(environment)
    gc.freeze()  # what the fork server imported: its pages stay shared
    gc.set_threshold(100_000, 20)  # much of what a task makes stays until it ends
    gc.enable()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that nothing half-written is left
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 0)
    os.dup2(nowhere, 1)
    os.dup2(errors.fileno(), 2)
    for name in preload:
        with suppress(ImportError):  # a task that needs it says so
            import_module(name)
    here = ForkingPickler.dumps(None)
    with suppress(OSError):
        tasks.send_bytes(here)  # from now on time counts
    while True:
        try:
            content = tasks.recv_bytes()
            tasks.send_bytes(here)
        except (EOFError, OSError):
            return
        answer = _done(content, memory)
        sys.stderr.flush()
        try:
            message = ForkingPickler.dumps(answer)
        except Exception as error:
            message = ForkingPickler.dumps((RuntimeError(f"{answer[0]!r}: {error}"), False))
        with suppress(OSError):  # nobody waits for it any more
            tasks.send_bytes(message)


def _done(content: bytes, memory: float | None) -> tuple[Any, bool]:
    """Return what a task returned or raised, and which of the two."""
    with _limited(memory):
        try:
            function, positional, named = ForkingPickler.loads(content)
            return function(*positional, **named), True
        except MemoryError:
            said = "out of memory" if memory is None else f"out of memory: it may take {memory:g} MB"
            return MemoryError(said), False
        except Exception as error:
            return error, False


@contextmanager
def _limited(memory: float | None) -> Iterator[None]:
    """Keep the process from taking more memory than it has now and some megabytes."""
    known = Path("/proc/self/statm")
    if memory is None or not known.exists():
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    has = int(known.read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (has + int(memory * _MEGABYTE), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _follow_parent() -> None:
    """End with the parent, however it ends, at once if Python runs, and soon while compiled code does."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def follow() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGKILL)

    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    threading.Thread(target=follow, daemon=True).start()
