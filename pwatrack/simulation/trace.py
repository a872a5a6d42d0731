"""What a simulation leaves: samples, modes and events."""

from dataclasses import dataclass

from pwatrack.arrays import Array, IntArray
from pwatrack.simulation.flow import Mode


@dataclass(frozen=True)
class Event:
    """The mode changed at time t (s)."""

    t: float
    before: Mode
    after: Mode


@dataclass(frozen=True, kw_only=True)
class Unresolved:
    """At time t (s) a guard came within rounding of 0 and left again: nobody can say whether it was crossed and back.

    `guard` counts the rows of `part.guards` from 0.
    """

    t: float
    part: str
    guard: int


@dataclass(frozen=True, kw_only=True)
class Trace:
    """A sampled trajectory of a flow of order N with P switched parts.

    Attributes:
        t: Sample times in s, (K,).
        z: States, (K, N).
        modes: Cell of each part at each sample, (K, P).
        events: All mode changes, in order of time.
        unresolved: Where rounding leaves open whether there was one, in order of time.
    """

    t: Array
    z: Array
    modes: IntArray
    events: tuple[Event, ...]
    unresolved: tuple[Unresolved, ...] = ()

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


def last_tenth(t: Array) -> slice:
    """Return which samples are the last tenth of the time: what a final error is taken over."""
    return slice(len(t) - -(-len(t) // 10), None)
