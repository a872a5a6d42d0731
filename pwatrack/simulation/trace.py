"""What a simulation leaves: samples, modes and events, in memory or on disk."""

import os
import pickle
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.errors import InvalidSpec
from pwatrack.simulation.flow import Mode

_LARGE = Path("/var/tmp")  # noqa: S108  on a disk; /tmp is in memory on many machines


@dataclass(frozen=True, slots=True)
class Event:
    """The mode changed at time t (s)."""

    t: float
    before: Mode
    after: Mode


@dataclass(frozen=True, kw_only=True, slots=True)
class Unresolved:
    """From time t (s) on a guard was within rounding of 0: nobody can say on which side of it the trajectory was.

    That is so where it touches the guard and leaves again, where it moves along it, where it starts there or crosses it
    with hardly any slope, and at corners. A mode change there may be missing, or early or late by as much as the doubt
    lasts. A guard that is exactly 0, as at a start on it, is no such case, nor is one crossed with so clear a slope
    that the time is known to 2⁻²² of the finest step, 2⁻³⁰ of a sample time, or 1e-12 of the time itself.
    """

    t: float
    part: str
    guard: int  # counts the rows of `part.guards` from 0
    span: float = 0.0  # how long the doubt lasts, in s; 0 for a touch within one step, where it is not worked out


@dataclass(frozen=True, kw_only=True, slots=True)
class Breaks:
    """Where a trajectory goes on anew: at its start, at each crossing of a guard and at each jump."""

    t: Array  # when, in s, in order, (E,)
    z: Array  # from where, (E, N)
    modes: IntArray  # in which cell of each part, (E, P)
    until: float  # when, in s, the next block begins, or the run ends: all of them are known up to there


@dataclass(frozen=True, kw_only=True)
class Trace:
    """A sampled trajectory of a flow of order N with P switched parts."""

    t: Array  # sample times in s, (K,)
    z: Array  # states, (K, N)
    modes: IntArray  # cell of each part at each sample, (K, P)
    events: tuple[Event, ...]  # all mode changes, in order of time
    unresolved: tuple[Unresolved, ...] = ()  # where rounding leaves open whether or when there was one, as noticed
    breaks: Breaks | None = None  # what happens between the samples; None where it is not kept

    @staticmethod
    def coarse(blocks: Sequence["Trace"]) -> "Trace":
        """Return blocks of samples as one trace whose events are the changes of mode from sample to sample."""
        t, z, modes = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("t", "z", "modes"))
        changed = np.flatnonzero((modes[1:] != modes[:-1]).any(axis=1)) + 1
        events = (Event(float(t[k]), tuple(modes[k - 1].tolist()), tuple(modes[k].tolist())) for k in changed)
        unresolved = tuple(touch for block in blocks for touch in block.unresolved)
        return Trace(t=t, z=z, modes=modes, events=tuple(events), unresolved=unresolved)

    def every(self, step: int, number: int) -> "Trace":
        """Return every so many-th sample where the first of the trace has this number; there are no events in it."""
        rows = slice((-number) % step, None, step)
        return replace(
            self, t=self.t[rows], z=self.z[rows].copy(), modes=self.modes[rows].copy(), events=(), breaks=None
        )

    def stays(self) -> list[tuple[Mode, float, float]]:
        """Return (mode, from, to) for each stretch of time without a mode change."""
        edges = [float(self.t[0]), *(event.t for event in self.events), float(self.t[-1])]
        modes = [self.first_mode, *(event.after for event in self.events)]
        return list(zip(modes, edges[:-1], edges[1:], strict=True))

    @property
    def first_mode(self) -> Mode:
        """The mode at the first sample."""
        return tuple(int(cell) for cell in self.modes[0])

    def visited(self) -> set[Mode]:
        """Return the joint modes that occur."""
        return {self.first_mode} | {event.after for event in self.events}


def tenths(samples: int) -> list[int]:
    """Return the first sample of each tenth of a run and the number of samples; the last tenth has the most.

    Example:
        >>> tenths(25)
        [0, 2, 5, 7, 10, 12, 15, 17, 20, 22, 25]
    """
    return [samples - -(-samples * (10 - k) // 10) for k in range(11)]


def last_tenth(samples: int) -> slice:
    """Return which samples are the last tenth of the time: what a final error is taken over."""
    return slice(tenths(samples)[9], None)


class TraceOnDisk:
    """The blocks of a long run, kept from when they are walked: what reads them later simulates nothing.

    They are in a file that has no name, so that none is left behind: it goes with this object, or with its process.
    It is in TMPDIR where that is set.
    """

    def __init__(self, traces: Iterable[Trace] = ()) -> None:
        own = not os.environ.get("TMPDIR") and os.access(_LARGE, os.W_OK)
        self._folder = str(_LARGE) if own else tempfile.gettempdir()
        self._starts: list[int] = []
        try:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115
        except OSError as error:
            raise self._full(error) from None
        weakref.finalize(self, _close, self._file)
        for trace in traces:
            self.add(trace)

    def add(self, trace: Trace) -> None:
        """Keep one more trace; raises InvalidSpec if there is no room for it."""
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
        return TraceOnDisk, (list(self),)

    def _full(self, error: OSError) -> InvalidSpec:
        message = f"cannot keep the samples of the run in {self._folder}: {error.strerror or error}"
        hint = "set TMPDIR to a folder with room, or take a longer sample time: it moves no event"
        return InvalidSpec(message, hint=hint)


def _close(file: IO[bytes]) -> None:
    with suppress(OSError):  # what a full disk did not take
        file.close()
