"""What interrupts the program, Ctrl-C or a signal, put off to where it does no harm."""

import signal
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from types import FrameType
from typing import TypeVar

_T = TypeVar("_T")
_LONGEST_WAIT = 0.5  # s: a signal that comes just before a wait begins does not end it
_SIGNALLED = 128  # and the number of the signal: the exit code, as shells have it
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ended_by: list[int] = []  # signals that were to end the program


def listen() -> None:
    """Let SIGTERM end the program with what is open closed, and remember what was to end it: see `ended_by`."""
    signal.signal(signal.SIGTERM, _end)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def _end(number: int, frame: FrameType | None) -> None:
    _ended_by.append(number)
    if number == signal.SIGINT:
        signal.default_int_handler(number, frame)
    raise SystemExit(_SIGNALLED + number)


def ended_by() -> int | None:
    """Return the exit code of a program that a signal was to end, if one was.

    What runs when the signal comes, such as the compiler, may turn that into an error of its own.
    """
    return _SIGNALLED + _ended_by[0] if _ended_by else None


@contextmanager
def uninterrupted(told: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Put off what interrupts the program until the block ends; `told` is called at once, in the middle of the block.

    Signals come to the main thread only.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def note(number: int, _: object) -> None:
        came.append(number)
        told()

    handlers = {number: signal.getsignal(number) for number in _SIGNALS}
    ours = {number: handler for number, handler in handlers.items() if handler is not None}
    try:
        for number in ours:
            signal.signal(number, note)
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
        for missed in came:
            signal.raise_signal(missed)


def as_ended(futures: Collection[Future[_T]]) -> Iterator[Future[_T]]:
    """Yield each future when it has ended. The program can be interrupted while this waits.

    So it can in `concurrent.futures.wait`, `as_completed` and `result`, but there perhaps while they hold the lock of
    a future, for good: whoever works for it, and wants to end it, would then wait for ever.
    """
    ended: SimpleQueue[Future[_T] | None] = SimpleQueue()  # a signal may come in the middle of its methods
    with uninterrupted():
        for future in futures:
            future.add_done_callback(ended.put)
    left = len(futures)
    while left:
        one = None
        with uninterrupted(lambda: ended.put(None)), suppress(Empty):
            one = ended.get(timeout=_LONGEST_WAIT)
        if one is not None:
            left -= 1
            yield one


def in_order(futures: Sequence[Future[_T]]) -> Iterator[Future[_T]]:
    """Yield each future when it has ended, and those before it: see `as_ended`."""
    for future in futures:
        yield from as_ended([future])
