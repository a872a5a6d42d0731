"""The blocks of a long run, kept on disk from when they are walked: what reads them later simulates nothing."""

import os
import pickle
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from pwatrack.errors import InvalidSpec, Problem
from pwatrack.simulation.trace import Trace

_LARGE = Path("/var/tmp")  # noqa: S108  on a disk; /tmp is in memory on many machines


class TraceOnDisk:
    """Traces in a file that has no name, so that none is left behind: it goes with this object, or with its process.

    The file is in TMPDIR where that is set.

    Example:
        >>> import numpy as np
        >>> spool = TraceOnDisk()
        >>> for t in (0.0, 1.0):
        ...     spool.add(Trace(t=np.array([t]), z=np.ones((1, 2)), modes=np.zeros((1, 1), dtype=int), events=()))
        >>> [float(trace.t[0]) for trace in spool]
        [0.0, 1.0]
    """

    def __init__(self) -> None:
        own = not os.environ.get("TMPDIR") and os.access(_LARGE, os.W_OK)
        self._folder = str(_LARGE) if own else tempfile.gettempdir()
        self._starts: list[int] = []
        try:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115
        except OSError as error:
            raise self._full(error) from None
        weakref.finalize(self, _close, self._file)

    def add(self, trace: Trace) -> None:
        """Keep one more trace.

        Raises:
            InvalidSpec: If there is no room for it.
        """
        try:
            self._starts.append(self._file.seek(0, os.SEEK_END))
            pickle.dump(trace, self._file, protocol=pickle.HIGHEST_PROTOCOL)
            self._file.flush()
        except OSError as error:
            raise self._full(error) from None

    def __iter__(self) -> Iterator[Trace]:
        """Yield the traces in the order in which they came, to the same bit."""
        for start in self._starts:
            self._file.seek(start)
            yield pickle.load(self._file)  # noqa: S301  nobody else can write to it

    def __reduce__(self) -> tuple[Any, ...]:
        return _spooled, (list(self),)

    def _full(self, error: OSError) -> InvalidSpec:
        message = f"cannot keep the samples of the run in {self._folder}: {error.strerror or error}"
        hint = "set TMPDIR to a folder with room, or take a longer sample time: it moves no event"
        return InvalidSpec(Problem(message=message, hint=hint))


def _spooled(traces: list[Trace]) -> TraceOnDisk:
    spool = TraceOnDisk()
    for trace in traces:
        spool.add(trace)
    return spool


def _close(file: IO[bytes]) -> None:
    with suppress(OSError):  # what a full disk did not take
        file.close()
