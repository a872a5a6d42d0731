"""Processes that work off tasks: what kills or hangs one of them, or takes its memory, fails the task that it is at.

A ProcessPoolExecutor loses every task with one killed process. Here each process has a thread that hands it tasks, and
replaces it when it has ended, from a fork server that has imported everything before: that takes milliseconds.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from math import inf
from multiprocessing import connection
from multiprocessing.reduction import ForkingPickler
from queue import Empty, SimpleQueue
from typing import Any

from pwatrack.batch.worker import OutOfMemory, serve
from pwatrack.errors import CheckFailed
from pwatrack.interruption import uninterrupted

DRAWING = ("pwatrack.cli", "pwatrack.report.plots.pictures")  # what it takes to draw; the first is their main program's
PRELOAD = (*DRAWING, "pwatrack.batch.work", "pwatrack.commands.run", "pwatrack.simulation.kernel")  # every spec

_GRACE = 0.4  # seconds that a process has to clean up when it is told to end
_LONGEST_WAIT = 3600.0  # seconds: a selector takes no number of any size
_START = 60.0  # seconds that a new process has to import what its owner's main program imports
_SAID = 65_536  # bytes that are kept of what a process says before it dies
_CONTEXT = multiprocessing.get_context("forkserver")
_REAPING = threading.Lock()  # a start looks how all children have ended: what one thread reads, another would miss


class Lost(CheckFailed):
    """A task whose process did not live to end it.

    Attributes:
        reason: Why, in words.
        killer: The signal that ended the process, if it was one that nobody here sent; 0 otherwise.
        said: The last that it said on stderr.
        seconds: How long it was at the task.
    """

    def __init__(self, reason: str, *, killer: int = 0, said: str = "", seconds: float = 0.0) -> None:
        super().__init__(reason)
        self.reason, self.killer, self.said, self.seconds = reason, killer, said, seconds


class _Worker:
    """A process that one thread of its owner hands tasks to."""

    def __init__(self, memory: float | None, preload: Sequence[str]) -> None:
        self._tasks, theirs = _CONTEXT.Pipe()
        self._errors, said = _CONTEXT.Pipe(duplex=False)
        self._process = _CONTEXT.Process(target=serve, args=(theirs, said, memory, preload), daemon=True)
        with _REAPING:
            self._process.start()
        theirs.close()
        said.close()
        os.set_blocking(self._errors.fileno(), False)
        self._ready = False
        self._said = bytearray()

    @property
    def alive(self) -> bool:
        """Whether the process has not ended."""
        return not connection.wait([self._process.sentinel], 0)

    def done(self, content: bytes, timeout: float, stop: connection.Connection) -> tuple[Any, bool]:
        """Return what a task returned or raised, or `Lost`, and which of the two.

        Out of time, or when there is something to read from `stop`, the process is told to end, and then killed.
        """
        begun = time.monotonic()
        deadline, reason = begun + timeout + (0.0 if self._ready else _START), ""
        self._said.clear()
        with suppress(OSError):  # it died meanwhile: seen from its sentinel
            self._tasks.send_bytes(content)
        while True:
            watched: list[Any] = [self._errors, self._process.sentinel, *([] if reason else [self._tasks, stop])]
            found = connection.wait(watched, min(max(0.0, deadline - time.monotonic()), _LONGEST_WAIT))
            self._hear()
            with suppress(EOFError, OSError):  # it is dying: seen from its sentinel
                while not reason and self._tasks.poll():  # its last answer may come just before its end
                    message = ForkingPickler.loads(self._tasks.recv_bytes())
                    if message is not None:
                        answer, fine = message
                        if isinstance(answer, OutOfMemory):
                            self.end(grace=0.0)  # who knows what it still holds
                            answer = Lost(str(answer), seconds=time.monotonic() - begun)
                        return answer, fine
                    self._ready, begun = True, time.monotonic()  # from now on time counts
                    deadline = begun + timeout
            if self._process.sentinel in found:
                return self._lost(reason, begun), False
            if stop in found or deadline <= time.monotonic():
                if reason:
                    self._process.kill()
                    deadline = inf
                else:
                    self._process.terminate()  # it removes what it has half-written
                    reason = "interrupted" if stop in found else f"given up after {timeout:g} s"
                    deadline = time.monotonic() + _GRACE

    def end(self, grace: float = _GRACE) -> int:
        """End the process, which has nothing to do, and return its exit code."""
        self._tasks.close()
        if not connection.wait([self._process.sentinel], grace):
            self._process.kill()
            connection.wait([self._process.sentinel])
        with _REAPING:
            self._process.join()
        self._hear()
        self._errors.close()
        return self._process.exitcode or 0

    def _lost(self, reason: str, begun: float) -> Lost:
        code = self.end()
        killer = -code if code < 0 and not reason else 0
        reason = reason or (f"killed by signal {killer}" if killer else f"ended by itself with {code}")
        said = self._said.decode("utf-8", "replace").strip()
        return Lost(reason, killer=killer, said=said, seconds=time.monotonic() - begun)

    def _hear(self) -> None:
        """Take what the process says on stderr, or it would wait for ever to be heard."""
        with suppress(OSError):
            while said := os.read(self._errors.fileno(), _SAID):
                self._said += said
                del self._said[:-_SAID]


class Pool(Executor):
    """An executor that loses one task at most with each process.

    Args:
        jobs: How many processes.
        timeout: Seconds that a task may take, once it has begun; None for any time.
        memory: Megabytes that a task may take beyond the program itself; None for any size. Kept by Linux only.
        preload: Modules that are imported once, before the first process.

    A future's `result()` raises `Lost` where the process died, ran out of time or out of memory, and what the task
    raised otherwise.

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
        self._jobs, self._timeout = jobs, inf if timeout is None else timeout
        self._memory, self._preload = memory, tuple(preload)
        _CONTEXT.set_forkserver_preload(["pwatrack.batch.fork_server", *preload])
        self._lock = threading.Lock()
        self._waiting: SimpleQueue[tuple[Future[Any], bytes] | None] = SimpleQueue()  # None: there are no more
        self._threads: list[threading.Thread] = []
        self._open = 0  # tasks that wait or are being done: for so many there are threads, up to the number of jobs
        self._closed = self._started = False
        self._stop, self._running = _CONTEXT.Pipe(duplex=False)  # the one can be read once the other is closed

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future of a call, which some process will make."""
        future, content = Future[Any](), bytes(ForkingPickler.dumps((fn, args, kwargs)))
        with uninterrupted(), self._lock:
            if self._closed:
                raise RuntimeError("the pool is closed")
            self._waiting.put((future, content))
            self._open += 1
            if len(self._threads) < min(self._jobs, self._open):
                self._threads.append(threading.Thread(target=self._work_off, daemon=True))
                self._threads[-1].start()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more tasks, end those that are there or cancel those that have not begun, and end the processes."""
        with uninterrupted(), self._lock:
            self._closed = True
            with suppress(Empty):
                while cancel_futures:
                    if (task := self._waiting.get_nowait()) and task[0].cancel():
                        task[0].set_running_or_notify_cancel()
            for _ in self._threads:
                self._waiting.put(None)
        for thread in self._threads if wait else ():
            thread.join()

    def kill_workers(self) -> None:
        """Cancel what has not begun, and end all processes: what they are at is lost.

        Where none is there yet nobody waits for the first, which ends as it begins.
        """
        self._running.close()
        self.shutdown(wait=self._started, cancel_futures=True)

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.shutdown()
        else:
            self.kill_workers()

    def _work_off(self) -> None:
        """Hand tasks to one process, and to those that take its place."""
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # what is started here is not for Ctrl-C to end
        worker: _Worker | None = None
        while task := self._waiting.get():
            future, content = task
            if not future.set_running_or_notify_cancel():
                continue
            try:
                if worker is not None and not worker.alive:
                    worker.end()
                    worker = None
                worker = worker or _Worker(self._memory, self._preload)
                self._started = True
                answer, fine = worker.done(content, self._timeout, self._stop)
            except Exception as error:  # whoever waits for the future has to learn of it
                answer, fine = error, False
            with self._lock:
                self._open -= 1
            future.set_result(answer) if fine else future.set_exception(answer)
        if worker is not None:
            worker.end()
