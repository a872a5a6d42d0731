"""What a process of the pool does: one task after the other, until there are no more or its parent is gone."""

import ctypes
import gc
import multiprocessing
import os
import resource
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)
_MEGABYTE = 2**20  # bytes


class OutOfMemory(Exception):
    """A task wanted more memory than it may have."""


def serve(tasks: Connection, errors: Connection, memory: float | None, preload: Sequence[str]) -> None:
    """Work off tasks: (function, arguments, named arguments) come, and (answer, whether it is one) go, at first a None.

    All that the process says on stderr goes to `errors`. A task may take so many megabytes beyond the program itself.
    The modules of `preload` are there before the first task, also if the fork server was begun for another pool.
    """
    _follow_parent()
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
    with suppress(OSError):
        tasks.send_bytes(ForkingPickler.dumps(None))  # from now on time counts
    while True:
        try:
            content = tasks.recv_bytes()
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
            return OutOfMemory(said), False
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
