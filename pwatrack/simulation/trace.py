"""What a simulation leaves: samples, modes and events."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.simulation.flow import Mode


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

    Attributes:
        guard: Counts the rows of `part.guards` from 0.
        span: How long the doubt lasts, in s; 0 for a touch within one step, where it is not worked out.
    """

    t: float
    part: str
    guard: int
    span: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Breaks:
    """Where a trajectory goes on anew: at its start, at each crossing of a guard and at each jump.

    Attributes:
        t: When, in s, in order, (E,).
        z: From where, (E, N).
        modes: In which cell of each part, (E, P).
        until: Up to when in s all of them are known: the first sample of the next block, or the last one of the run.
    """

    t: Array
    z: Array
    modes: IntArray
    until: float


@dataclass(frozen=True, kw_only=True)
class Trace:
    """A sampled trajectory of a flow of order N with P switched parts.

    Attributes:
        t: Sample times in s, (K,).
        z: States, (K, N).
        modes: Cell of each part at each sample, (K, P).
        events: All mode changes, in order of time.
        unresolved: Where rounding leaves open whether or when there was one, in the order in which it was noticed.
        breaks: What happens between the samples; None where it is not kept.
    """

    t: Array
    z: Array
    modes: IntArray
    events: tuple[Event, ...]
    unresolved: tuple[Unresolved, ...] = ()
    breaks: Breaks | None = None

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
