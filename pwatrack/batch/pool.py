"""Processes that work off tasks: what kills or hangs one of them, or takes its memory, fails the task that it is at.

A ProcessPoolExecutor loses every task with one killed process. Here a thread sees to each process, and one that ends is
replaced, from a fork server that has imported everything before: that takes milliseconds.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from math import inf
from multiprocessing import forkserver, resource_tracker
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
_ALONE = threading.Lock()  # held while processes begin, and how one ended is read: that is no matter for two threads


class Lost(CheckFailed):
    """A task whose process did not live to end it, and the last that it said on stderr.

    Its killer is the signal that ended the process, if it was one that nobody here sent; 0 otherwise.
    """

    def __init__(self, reason: str, *, killer: int = 0, said: str = "", seconds: float = 0.0) -> None:
        super().__init__(reason)
        self.reason, self.killer, self.said, self.seconds = reason, killer, said, seconds


@dataclass(kw_only=True)
class _Worker:
    """A process, which takes tasks and answers, and what it has said on stderr."""

    process: ForkServerProcess
    tasks: Connection
    errors: Connection
    said: bytearray = field(default_factory=bytearray)

    def message(self, limit: float | None, *ends: Connection) -> bytes:
        """Return what the process sends within so many seconds, else a TimeoutError.

        An EOFError says that it has ended, or that one of `ends` has.
        """
        until = inf if limit is None else time.monotonic() + limit
        watched: list[Any] = [self.tasks, self.errors, self.process.sentinel, *ends]
        while (left := until - time.monotonic()) > 0:
            ready = wait(watched, min(left, _LONGEST_WAIT))
            self._hear()
            if self.tasks in ready:
                try:
                    return self.tasks.recv_bytes()
                except (EOFError, OSError):  # it is dying: seen from its sentinel
                    watched.remove(self.tasks)
            if not {self.process.sentinel, *ends}.isdisjoint(ready):
                raise EOFError
        raise TimeoutError

    def end(self) -> int:
        """Tell the process to end, kill it if it does not, and return its exit code."""
        if not wait([self.process.sentinel], 0):
            self.process.terminate()  # it removes what it has half-written
        with suppress(EOFError, TimeoutError):
            while True:
                self.message(_GRACE)
        with _ALONE:
            if self.process.exitcode is None:
                self.process.kill()
            self.process.join()
        self._hear()
        for connection in (self.tasks, self.errors):
            connection.close()
        return self.process.exitcode or 0

    def _hear(self) -> None:
        """Take what the process says on stderr, or it would wait for ever to be heard."""
        with suppress(OSError):
            while said := os.read(self.errors.fileno(), _SAID):
                self.said += said
                del self.said[:-_SAID]


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
        self._timeout, self._memory, self._preload = timeout, memory, tuple(preload)
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["pwatrack.batch.fork_server", *preload])
        self._threads = ThreadPoolExecutor(jobs, initializer=_leave_to_owner)
        self._lock = threading.Lock()
        self._idle: list[_Worker] = []
        self._closed = False  # whether what becomes idle ends
        self._killed, self._kill = self._context.Pipe(duplex=False)  # closed where nothing is to go on

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future of a call, which some process will make."""
        content = bytes(ForkingPickler.dumps((fn, args, kwargs)))
        with uninterrupted():
            return self._threads.submit(self._call, content)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more tasks, end those that are there or cancel those that have not begun, and end the processes."""
        with uninterrupted():
            self._threads.shutdown(wait=False, cancel_futures=cancel_futures)
        self._threads.shutdown(wait=wait)
        with self._lock:
            idle, self._idle, self._closed = self._idle, [], True
        for worker in idle:
            worker.process.terminate()
        for worker in idle:
            worker.end()

    def kill_workers(self) -> None:
        """Cancel what has not begun, and end all processes: what they are at is lost."""
        self._kill.close()
        self.shutdown(cancel_futures=True)

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.shutdown()
        else:
            self.kill_workers()

    def _call(self, content: bytes) -> Any:
        """Let a process make a call: return its answer, or raise what that raised, or `Lost`."""
        with self._lock:
            idle = self._idle.pop() if self._idle else None
        worker, taken, reason = idle or self._start(), False, ""
        begun = time.monotonic()
        try:
            with suppress(OSError):  # it died meanwhile
                worker.tasks.send_bytes(content)
            worker.message(None if self._timeout is None else self._timeout + _START * (idle is None), self._killed)
            begun, taken = time.monotonic(), True
            message = worker.message(self._timeout, self._killed)
        except TimeoutError:
            reason = f"given up after {self._timeout:g} s"
        except EOFError:
            reason = "interrupted" * self._kill.closed
        else:
            worker.said.clear()
            with self._lock:
                kept = not self._closed
                self._idle += [worker] * kept
            if not kept:
                worker.end()
            answer, fine = ForkingPickler.loads(message)
            if fine:
                return answer
            if isinstance(answer, MemoryError):
                raise Lost(str(answer), seconds=time.monotonic() - begun)
            raise answer
        code = worker.end()
        if idle and not taken and not reason:  # it died of something else
            return self._call(content)
        killer = -code if code < 0 and not reason else 0
        reason = reason or (f"killed by signal {killer}" if killer else f"ended by itself with {code}")
        said = worker.said.decode("utf-8", "replace").strip()
        raise Lost(reason, killer=killer, said=said, seconds=time.monotonic() - begun)

    def _start(self) -> _Worker:
        """Begin a process of this package, and of no other that the working directory may have.

        A fork server looks for what it imports beforehand in its own path, and not in that of its owner.
        """
        ours, theirs = self._context.Pipe()
        errors, said = self._context.Pipe(duplex=False)
        with _ALONE:
            own = {name: os.environ.get(name) for name in _PATHS}
            path = [str(Path(__file__).parents[2]), *filter(None, [own["PYTHONPATH"]])]
            os.environ.update({"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(path)})
            resource_tracker.ensure_running()  # which unblocks SIGINT
            _leave_to_owner()
            try:
                forkserver.ensure_running()
            finally:
                _restore(own)
            args = theirs, said, self._memory, self._preload, own
            process = self._context.Process(target=serve, args=args, daemon=True)
            process.start()
        theirs.close()
        said.close()
        os.set_blocking(errors.fileno(), False)
        return _Worker(process=process, tasks=ours, errors=errors)


def _leave_to_owner() -> None:
    """Keep Ctrl-C from what this thread starts; and that a process is gone is no end of this one."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGPIPE})


def serve(
    tasks: Connection,
    errors: Connection,
    memory: float | None,
    preload: Sequence[str],
    environment: Mapping[str, str | None],
) -> None:
    """Work off tasks: (function, arguments, named arguments) come, and (answer, whether it is one) go.

    As a task is taken, that is said. All that the process says on stderr goes to `errors`. A task may take so many
    megabytes beyond the program itself. The modules of `preload` are there before the first task, also if the fork
    server was begun for another pool; what it was begun in is not what its processes have: `environment` is put back.
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
    while True:
        try:
            content = tasks.recv_bytes()
            tasks.send_bytes(b"taken")  # from now on time counts
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
        if isinstance(answer[0], MemoryError):  # it is replaced: who knows what it still holds
            return


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
