"""A word while the compiler is at work: where nothing of it is kept yet, the simulation is compiled for up to 45 s."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pwatrack.interruption import ended_by

_SLOW = 2.0  # s: what takes less needs no word
_COMPILED = "numba:compile"  # what Numba calls it; what it finds on disk is not compiled
_told: list[Callable[[bool], object]] = []  # who is told, the innermost last


@contextmanager
def while_compiling(tell: Callable[[bool], object]) -> Iterator[None]:
    """Call `tell` once in the middle of what is compiled in the block, if that takes long: with whether it is kept."""
    _told.append(tell)
    try:
        yield
    finally:
        if tell in _told:
            _told.remove(tell)


def listen() -> None:
    """Let Numba say when it begins to compile, and when it has done so."""
    from numba.core import event

    waiting: list[threading.Timer] = []  # one for each function that is compiled just now, by those that call it

    class Compiler(event.Listener):
        def on_start(self, found: Any) -> None:
            kept = getattr(found.data["dispatcher"]._cache, "cache_path", None) is not None
            waiting.append(threading.Timer(_SLOW, _tell, (kept,)))
            waiting[-1].daemon = True  # it holds nothing up
            if len(waiting) == 1:
                waiting[0].start()

        def on_end(self, _: Any) -> None:
            waiting.pop().cancel()
            if (code := ended_by()) is not None:  # what that raised was lost in a callback of the compiler
                raise SystemExit(code)

    register: Any = event.register  # it has no types
    register(_COMPILED, Compiler())


def _tell(kept: bool) -> None:
    if _told:
        _told.pop()(kept)
