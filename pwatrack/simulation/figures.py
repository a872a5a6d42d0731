"""What is measured of a run: sizes of errors and inputs, and how each output goes to where its reference comes to rest.

Sizes are enclosed between samples and so hold at all times; times and overshoot are read off the samples. Times are
wanted when the whole run is known, so the blocks are gone through twice.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.bounds import Form, state_rows
from pwatrack.simulation.closed_loop import ClosedLoop, Response
from pwatrack.simulation.enclosure import Enclosing, Segments
from pwatrack.simulation.flow import Mode
from pwatrack.simulation.trace import last_tenth

_STILL = 1e-9  # of the size of a signal: by less it does not move
_BAND = 0.02  # of what an output has to go, or of the amplitude of its reference
_RISES = 0.1, 0.9  # of the way
_RANGES = "inputs", "limited"  # of what it is told how low and how high it gets
ERRORS = "final_error", "largest_error"  # in the norm of all that is tracked


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Measures of a run: sizes of errors and inputs at all times, to 1e-7 from above, the others at its samples.

    The last move of an output y begins at the last time t_s (s) before which its reference y_d was at rest, at 0 if
    it never was before it came to rest for good; y_d is at rest where it changes by less than 1e-9 of the signals.
    It comes to rest for good if it does so before the last tenth of the run, at y_∞, and y has to go h = y_∞ − y(t_s).
    """

    final_error: float  # largest norm of the tracking error in the last tenth of the time
    largest_error: float  # largest norm of the tracking error
    final_errors: Mapping[str, float]  # the same by name and unit: y − y_d of what follows a reference, else x − x_d
    largest_errors: Mapping[str, float]
    final_observer_error: float  # ‖x − x̂‖ at the end
    largest_input: Mapping[str, float]  # largest size of each input, by name
    mode_changes: int  # how many
    joint_modes: int  # how many there were
    # how long after t_s each output is within its band of y_∞ for good, in s; infinite where it never is, or left it
    # again in the last tenth of the run, as where it comes and goes. The band is
    # 2 % of the largest |y − y_∞| from t_s on, unless one is given. For an output whose reference does not come to
    # rest: when |y − y_d| is within its band for good, that being 2 % of half the range of y_d.
    settling_time: Mapping[str, float]
    # how long each output takes from 10 % of h to 90 % of it, in s; infinite where it does not get there. Only where
    # the reference comes to rest, and h is not 0.
    rise_time: Mapping[str, float]
    overshoot: Mapping[str, float]  # how far each output goes beyond y_∞ and y_d, as a share of |h|. Likewise.
    # how low and how high each input, and what has limits, gets, by name
    lowest: Mapping[str, float] = field(default_factory=dict)
    highest: Mapping[str, float] = field(default_factory=dict)
    # the share of the time that each part of the loop is in each of the cells that it comes to: of the plant, of the
    # observer, … by name. From event to event, so exact where no mode change is in doubt.
    time_share: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    sampled: tuple[str, ...] = ()  # which sizes are at the samples only, by these names: to enclose them took too long

    def seen(self, *names: str) -> str:
        """Say that any of these sizes is at the samples only, where that is so."""
        return " at the samples" if {*names} & {*self.sampled} else ""

    @staticmethod
    def of(response: Response, loop: ClosedLoop | None = None, **measured: Any) -> "Figures":
        """Return the figures of a run that is all in memory; see `Measuring`."""
        measuring = Measuring(len(response.t), **measured, loop=loop)
        measuring.see(response)
        return measuring.figures([response])


@dataclass
class Move:
    """The last move of an output, as far as the run was seen; and when it was where, once all of it was."""

    given: float | None  # the band, where one is given
    start: float = 0.0  # t_s
    origin: float = 0.0  # y(t_s)
    high: float = -np.inf  # largest and smallest y since t_s
    low: float = np.inf
    highest: float = -np.inf  # likewise of the reference
    lowest: float = np.inf
    still_from: float = 0.0  # the reference has not changed since
    rests: bool = False  # for good
    settled: float = 0.0  # since when the output is within its band; infinite where it is not
    marks: tuple[float, float] = (np.inf, np.inf)  # when 10 % and 90 % of the way were reached
    left: float = -np.inf  # when the output left its band last
    _inside: bool = False  # whether it was in it before
    _before: tuple[float, float, float, bool] | None = None  # last time, output and reference, and whether that changed
    _range: tuple[float, float] = (np.inf, -np.inf)  # of the reference
    _size: float = 0.0  # of output and reference

    def see(self, t: Array, y: Array, y_d: Array) -> None:
        """Take the next samples into account."""
        t_0, y_0, y_d0, changed = self._before or (float(t[0]), float(y[0]), float(y_d[0]), False)
        if self._before is None:
            self.start, self.origin = t_0, y_0
        size = np.maximum.accumulate(np.maximum(self._size, np.maximum(np.abs(y), np.abs(y_d))))
        changes = np.abs(np.diff(y_d, prepend=y_d0)) > _STILL * size
        begins = np.flatnonzero(changes & ~np.append(changed, changes[:-1]))
        if len(begins):
            k = int(begins[-1])
            self.start, self.origin = (float(t[k - 1]), float(y[k - 1])) if k else (t_0, y_0)
            self.high = self.low = self.origin
            self.highest, self.lowest = -np.inf, np.inf
        if changes.any():
            self.still_from = float(t[changes][-1])
        last = int(begins[-1]) if len(begins) else 0
        self.high, self.low = max(self.high, float(y[last:].max())), min(self.low, float(y[last:].min()))
        self.highest = max(self.highest, float(y_d[last:].max()))
        self.lowest = min(self.lowest, float(y_d[last:].min()))
        self._range = min(self._range[0], float(y_d.min())), max(self._range[1], float(y_d.max()))
        self._before, self._size = (float(t[-1]), float(y[-1]), float(y_d[-1]), bool(changes[-1])), float(size[-1])

    def end(self, last_tenth: float) -> None:
        """Take note that this was all, and when the last tenth of it began."""
        self.rests = self.still_from <= last_tenth
        if not self.rests:
            self.start = 0.0
        self.settled = self.start

    def settling(self, last_tenth: float) -> float:
        """Return how long after its start the output is within its band for good; infinite if it left it late."""
        return self.settled - self.start if self.left <= last_tenth else np.inf

    @property
    def target(self) -> float:
        """The last value of the reference."""
        return self._before[2] if self._before else 0.0

    @property
    def distance(self) -> float:
        """How far the output has to go, h; 0 where that is rounding or the reference does not come to rest."""
        h = self.target - self.origin
        return h if self.rests and abs(h) > _STILL * self._size else 0.0

    @property
    def overshoot(self) -> float:
        """How far the output goes beyond the rest, or the reference, as a share of |h|; 0 where that is rounding."""
        beyond = self.high - self.highest if self.distance > 0 else self.lowest - self.low
        return beyond / abs(self.distance) if beyond > _STILL * self._size else 0.0

    @property
    def band(self) -> float:
        """How far from the rest, or from a reference that moves on, counts as settled."""
        if self.given is not None:
            return self.given
        low, high = self._range
        away = max(self.high - self.target, self.target - self.low) if self.rests else (high - low) / 2
        return max(_BAND * away, _STILL * self._size)

    def follow(self, t: Array, y: Array, y_d: Array) -> None:
        """Find times among the next samples, once all of them were seen."""
        counts = t >= self.start
        away = counts & (np.abs(y - (self.target if self.rests else y_d)) > self.band)
        outside = np.flatnonzero(away)
        if len(outside):
            self.settled = float(np.append(t, np.inf)[outside[-1] + 1])
        elif self.settled == np.inf:
            self.settled = float(t[0])
        inside = counts & ~away
        leaves = np.flatnonzero(away & np.append(self._inside, inside[:-1]))
        self.left, self._inside = float(t[leaves[-1]]) if len(leaves) else self.left, bool(inside[-1])
        if self.distance:
            way = (y - self.origin) / self.distance
            found = (float(np.append(t[counts & (way >= share)], np.inf)[0]) for share in _RISES)
            low, high = (min(pair) for pair in zip(self.marks, found, strict=True))
            self.marks = low, high


_Sizes = Mapping[str, Array]  # by the names of what they are in the figures


@dataclass
class Measuring:
    """Measures a run of so many samples block by block.

    An output counts as settled within the band of its name, in its unit, where that is given. States are named where
    they follow x_d; of inputs and of what has limits it is told how low and how high they get. Without the loop that
    runs no more is known of sizes than the samples show.
    """

    samples: int
    outputs: Sequence[str]
    inputs: Sequence[str]
    bands: Mapping[str, float]
    states: Sequence[str] = ()
    limited: Mapping[str, Form] = field(default_factory=dict)
    loop: ClosedLoop | None = None
    _number: int = 0
    _sizes: _Sizes = field(default_factory=dict)  # at the samples
    _observer: float = 0.0
    _changes: int = 0
    _last_tenth: float = 0.0  # when it began
    _visited: set[Mode] = field(default_factory=set)
    _within: dict[str, Enclosing] = field(default_factory=dict)  # at all times
    _range: Array = field(default_factory=lambda: np.zeros((2, 0)))  # at the samples, of inputs and what has limits
    _until: float | None = None  # how long each part was in which cell is known up to there, in s
    _stays: dict[tuple[int, int], float] = field(default_factory=dict)  # part, cell: s

    def __post_init__(self) -> None:
        self._moves = [Move(self.bands.get(name)) for name in self.outputs]
        if self.loop is not None:
            error = self.loop.tracking_error / self.loop.controller.error_sizes[:, None]
            for name in ERRORS:
                self._within[name] = Enclosing(lambda _: error, norm=True)
            each = self.loop.signal_errors
            for name in ("final_errors", "largest_errors") if len(each) > 1 else ():
                self._within[name] = Enclosing(lambda _: each)
            self._within["inputs"] = Enclosing(self.loop.inputs)
            if self.limited:
                x = np.eye(self.loop.at.order)[self.loop.at.x]
                rows = state_rows(self.loop.plant, self.limited.values()) @ x
                self._within["limited"] = Enclosing(lambda _: rows)
        self._range = np.full((2, len(self.inputs) + len(self.limited)), [[np.inf], [-np.inf]])

    def see(self, block: Response) -> None:
        """Take the next samples into account."""
        size, tail = block.error_norm, last_tenth(self.samples).start - self._number
        if 0 <= tail < len(size):
            self._last_tenth = float(block.t[tail])
        each = np.abs(block.tracked - block.tracked_d)
        each = np.hstack([each, np.abs(block.x - block.x_d)]) if self.states else each
        late = slice(max(0, tail), None)
        seen = {
            "final_error": size[late].max(initial=0.0, keepdims=True),
            "largest_error": size.max(keepdims=True),
            "final_errors": each[late].max(axis=0, initial=0.0),
            "largest_errors": each.max(axis=0),
        }
        self._sizes = {name: np.maximum(self._sizes.get(name, 0.0), most) for name, most in seen.items()}
        of = {"output": block.tracked, "measured": block.y, "state": block.x}
        ranged = np.column_stack([block.u, *(of[kind][:, k] for kind, k in self.limited.values())])
        self._range[0] = np.minimum(self._range[0], ranged.min(axis=0))
        self._range[1] = np.maximum(self._range[1], ranged.max(axis=0))
        self._observer = float(block.observer_error[-1])
        self._changes += len(block.trace.events)
        self._visited |= block.trace.visited()
        events, t = block.trace.events, block.trace.t
        first = float(t[0]) if self._until is None else self._until  # up to there, all of it was in known cells
        self._until = max(float(t[-1]), events[-1].t if events else first)
        lengths = np.diff([first, *(event.t for event in events), self._until])
        modes = [events[0].before if events else block.trace.first_mode, *(event.after for event in events)]
        for k, cells in enumerate(np.array(modes).T):
            for cell, seconds in enumerate(np.bincount(cells, lengths).tolist()):
                if seconds:
                    self._stays[k, cell] = self._stays.get((k, cell), 0.0) + seconds
        for k, move in enumerate(self._moves):
            move.see(block.t, block.tracked[:, k], block.tracked_d[:, k])
        self._number += len(size)
        if self.loop is not None:
            segments = Segments.of(self.loop.flow, block.trace)
            for name, within in self._within.items():
                if not name.startswith("final"):
                    within.see(segments)
                elif tail < len(size):
                    within.see(segments.since(self._last_tenth))

    def _shares(self) -> dict[str, dict[str, float]]:
        """Return the share of the time in each cell by part; cells of one name count as one."""
        found: dict[str, dict[str, float]] = {}
        whole = sum(seconds for (k, _), seconds in self._stays.items() if k == 0)
        parts = () if self.loop is None else self.loop.flow.parts
        for (k, cell), seconds in sorted(self._stays.items()) if parts else ():
            part = parts[k]
            shares = found.setdefault(part.name, {})
            shares[part.cells[cell]] = shares.get(part.cells[cell], 0.0) + seconds / whole
        return found

    def figures(self, blocks: Iterable[Response]) -> Figures:
        """Return the figures of all that was seen, given the same blocks once more."""
        moves = dict(zip(self.outputs, self._moves, strict=True))
        for move in moves.values():
            move.end(self._last_tenth)
        for block in blocks:
            for k, move in enumerate(self._moves):
                move.follow(block.t, block.tracked[:, k], block.tracked_d[:, k])
        known, between = self._enclosed(), self._between()
        sizes = {name: np.maximum(size, known.get(name, 0.0)).tolist() for name, size in self._sizes.items()}
        signals, ranged = (*self.outputs, *self.states), (*self.inputs, *self.limited)
        low, high = self._range if between is None else between
        ranges = {
            name: dict(zip(ranged, ends.tolist(), strict=True)) for name, ends in (("lowest", low), ("highest", high))
        }
        return Figures(
            final_error=sizes["final_error"][0],
            largest_error=sizes["largest_error"][0],
            final_errors=dict(zip(signals, sizes["final_errors"], strict=True)),
            largest_errors=dict(zip(signals, sizes["largest_errors"], strict=True)),
            final_observer_error=self._observer,
            largest_input=dict(zip(self.inputs, np.maximum(-low, high).tolist(), strict=False)),
            mode_changes=self._changes,
            joint_modes=len(self._visited),
            settling_time={name: move.settling(self._last_tenth) for name, move in moves.items()},
            rise_time={
                name: move.marks[1] - move.marks[0] if move.marks[1] < np.inf else np.inf
                for name, move in moves.items()
                if move.distance
            },
            overshoot={name: move.overshoot for name, move in moves.items() if move.distance},
            **ranges,
            time_share=self._shares(),
            sampled=(
                *(name for name in sizes if name not in known),
                *(("largest_input", *(ranges if self.limited else ())) if between is None else ()),
            ),
        )

    def _between(self) -> Array | None:
        """Return how low and high inputs and what has limits get at all times, (2, q); None if that is not known."""
        found = [self._within[name].range() for name in _RANGES if name in self._within]
        if not found or not np.isfinite([end for one in found for end in (*one.low, *one.high)]).all():
            return None
        low, high = np.concatenate([one.low for one in found]), np.concatenate([one.high for one in found])
        m = len(self.inputs)
        if self.loop is not None and (limits := self.loop.conditions.limits) is not None:  # cut off, so never beyond
            low[:m], high[:m] = np.maximum(low[:m], limits[:, 0]), np.minimum(high[:m], limits[:, 1])
        return np.array([np.minimum(low, self._range[0]), np.maximum(high, self._range[1])])

    def _enclosed(self) -> _Sizes:
        """Return which sizes are no larger between samples than what; those of which that is not known are left out."""
        ranges = {name: within.range() for name, within in self._within.items() if name not in _RANGES}
        for name in ERRORS if ranges else ():
            ranges.setdefault(f"{name}s", ranges[name])  # of a single entry
        sizes = {name: np.maximum(found.high, -found.low) for name, found in ranges.items()}
        return {name: size for name, size in sizes.items() if np.isfinite(size).all()}
