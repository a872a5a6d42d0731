"""What limits of the inputs leave for the controller: the feedforward's peak, and errors with which a run may begin.

With P ⪰ z zᵀ for all these errors z, the inequality of the decay and [ū_j², Y_j; Y_jᵀ, P] ⪰ 0, the gain K = Y P⁻¹ has
|K_j e| ≤ ū_j √(eᵀ P⁻¹ e) ≤ ū_j at all times (Boyd et al., Linear Matrix Inequalities in System and Control Theory,
1994, section 7.2.3).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pwatrack.arrays import Array, outward
from pwatrack.ball_matrix import BallMatrix, different
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.demand import Demand
from pwatrack.control.task import Task
from pwatrack.lmi.ellipsoid import Inner, held
from pwatrack.lmi.exact import Certificate
from pwatrack.lmi.polynomial_region import region_around, scale_of
from pwatrack.lmi.saturated import MOST_WORK, SaturatedLoop
from pwatrack.model.sizes import Sizes

_LITTLE = 1e-3  # of a size: what any error may be at least
OFF = 1e-6  # of the feedforward: its peak is known to that, see `simulation.desired`
_ROUNDING = 1e-12  # of the larger end: what is less is 0 where it is said
_KNOWN = 1e-6  # of an end: more than what it is enclosed to
_NO_ROOM = 1e-9  # of a limit: a feedforward that comes so near to one is there, but for rounding


@dataclass(frozen=True, kw_only=True)
class Peak:
    """How small and how large the feedforward gets."""

    low: Array  # of each input, (m,)
    high: Array  # likewise
    times: Array  # when it gets there, in s, (m, 2)

    def span(self, k: int, unit: str) -> str:
        """Say between what an input is; an end that is rounding beside the other is 0."""
        low, high = float(self.low[k]), float(self.high[k])
        rounding = _ROUNDING * max(abs(low), abs(high))
        low, high = (v if abs(v) > rounding else 0.0 for v in (low, high))
        return f"{outward(low, -1, _KNOWN)} to {outward(high, 1, _KNOWN)} {unit}".rstrip()

    def left(self, limits: Array) -> Array:
        """Return how far each input may be from its feedforward, (m,): the smaller side of its limits (m, 2).

        Example:
            >>> peak = Peak(low=np.array([-1.0]), high=np.array([3.0]), times=np.zeros((1, 2)))
            >>> peak.left(np.array([[-5.0, 5.0]])).round(4).tolist(), peak.left(np.array([[-np.inf, 2.0]])).tolist()
            ([2.0], [0.0])
        """
        off = self._off(limits)
        room = np.minimum(limits[:, 1] - self.high, self.low - limits[:, 0])
        return np.asarray(np.maximum(room - off, 0.0))

    def beyond(self, limits: Array) -> list[tuple[int, int]]:
        """Return where the feedforward is beyond a limit, by more than it is known to: (input, 0 for its lower one)."""
        off = self._off(limits)
        over = np.column_stack([limits[:, 0] - self.low > off, self.high - limits[:, 1] > off])
        return [(int(k), int(side)) for k, side in np.argwhere(over)]

    def _off(self, limits: Array) -> Array:
        """Return what tells no feedforward from a limit, (m,)."""
        largest = np.abs(np.where(np.isfinite(limits), limits, 0.0)).max(axis=1)
        return np.asarray(np.maximum(OFF * np.maximum(np.abs(self.low), np.abs(self.high)), _NO_ROOM * largest))

    def with_also(self, other: "Peak") -> "Peak":
        """Return the peak of two stretches of time."""
        lower, higher = other.low < self.low, other.high > self.high
        return Peak(
            low=np.where(lower, other.low, self.low),
            high=np.where(higher, other.high, self.high),
            times=np.where(np.column_stack([lower, higher]), other.times, self.times),
        )


@dataclass(frozen=True, kw_only=True)
class Starts:
    """Errors with which a run may begin: (e, Δ) = (x − x_d, x̂ − x) = G ζ with |ζ_k| ≤ 1."""

    # "exact": each entry of e within its size, Δ = 0. "sizes": each entry of e and of Δ. "run": that of the run.
    # "ensemble": those of its members. "members": the same with Δ = 0. "every": all there are.
    kind: Literal["exact", "sizes", "run", "ensemble", "members", "every"]
    e: Array  # rows of G for e, (n, k)
    delta: Array | None = None  # rows of G for Δ, (n, k), or None for Δ = 0
    # rows of G for the errors of the estimates of loads, which are 0 at first: so for the loads but for their sign, (p,
    # k). None where Δ = 0: then no load acts.
    load: Array | None = None
    # rows of G for all errors of a sampled loop whose inputs are late, as the first one acts, (order, k), with what the
    # run makes of the others till then; None where they act at once
    z: Array | None = None

    @property
    def G(self) -> Array:
        """The starts as their loop has them, (n, k), (2 n, k) or (2 n + p, k)."""
        return np.vstack([rows for rows in (self.e, self.delta, self.load) if rows is not None])

    def with_more(self, off: Array, loads: int) -> "Starts":
        """Return them with x̂ − x by so much more, (n, q), of any sign, of a plant with so many states of loads.

        Only those of a run or an ensemble begin with an x̂ that is made of what is measured; others are as they were.
        """
        off = off[:, off.any(axis=0)]
        if self.kind not in ("run", "ensemble") or not off.size:
            return self
        e, wider = self.e, ((0, 0), (0, off.shape[1]))
        delta = np.hstack([np.zeros_like(e) if self.delta is None else self.delta, off])
        load = np.zeros((loads, e.shape[1])) if self.load is None else self.load
        return replace(self, e=np.pad(e, wider), delta=delta, load=np.pad(load, wider) if loads else None)

    @classmethod
    def within(cls, sizes: Sizes) -> tuple["Starts", "Starts"]:
        """Return the starts within sizes, with the right x̂, and with another one and loads."""
        n, p = len(sizes.state), len(sizes.load)
        box = np.diag(np.concatenate([sizes.state, sizes.state, sizes.load]))
        both = cls(kind="sizes", e=box[:n], delta=box[n : 2 * n], load=box[2 * n :] if p else None)
        return cls(kind="exact", e=np.diag(sizes.state)), both


@dataclass(frozen=True, kw_only=True)
class InputConstraint:
    """Errors e = G ζ, |ζ_k| ≤ 1, from which K e is not to reach limits, or these are to do no harm."""

    starts: Sequence[Array]  # boxes G (n, k); where no limit may be reached one, of rank n
    left: Array  # ū (m,); infinite where an input has no limit
    over: float = 1.0  # of what is left, what K may ask of an input from there: at 1 no limit is reached

    def share(self, task: Task, K: Array, proof: Certificate) -> float:
        """Return how many times as large these errors may be for a gain K (m, n), by an exact proof; 0 for none.

        Example: |e| ≤ 2 at the start and u = −e / 2 is at most 1, of 3 that there are.

            >>> task = Task(A=np.zeros((1, 1, 1)), B=np.eye(1), cells=["all"])
            >>> K = np.array([[-0.5]])
            >>> within = InputConstraint(starts=[np.array([[2.0]])], left=np.array([3.0]))
            >>> 2.999 < within.share(task, K, task.reached(K, np.eye(1), 0.0)) <= 3
            True
        """
        if not K.any():
            return np.inf
        limited = np.flatnonzero(np.isfinite(self.left)).tolist()
        left, rows = self.left[limited], BallMatrix.of(K[limited], (len(limited), K.shape[1]))
        closed, inner = different(task.exactly_closed(K)), Inner.proved(proof.P, proof.rate)
        B = task.balls[1].part(range(len(task.B)), limited)
        loop = SaturatedLoop(M=closed, B=B, D=rows, inners=[inner])
        if self.over > 1 and (loop.work > MOST_WORK or loop.everywhere() is not None):
            return np.inf
        if self.over > 1:
            regions = [region_around(loop, G, left, enough=1.0) for G in self.starts]
            return min(0.0 if one is None else scale_of(one, left) for one in regions)
        kept = [held(closed, G, rows, left, inner) for G in self.starts]
        return min(0.0 if one is None else scale_of(one, left) for one in kept)


@dataclass(frozen=True, kw_only=True)
class SignalRoom:
    """Limits of outputs and states, and what the reference takes of them: what it leaves is room for errors."""

    names: tuple[str, ...]  # what has limits
    forms: tuple[Form, ...]  # what of x each is
    room: "Headroom"  # the limits, and what x_d takes of them
    acting: Mapping[Channel, float]  # how large each disturbance and noise of the file is


@dataclass(frozen=True, kw_only=True)
class Headroom:
    """Limits of the inputs, and what the feedforward takes of them: what it leaves is room for errors."""

    limits: Array  # lower and upper limit of each input, (m, 2); infinite where there is none
    # what the feedforward takes whatever the generator starts with, where that is known: in its steady state for the
    # reference as it begins, and from there on
    lasting: Peak | None
    peak: Peak | None  # the same from the start of the generator in this run too; None where it could not be followed
    ever: bool = False  # whether it is within that after the run too; else no more than the run is spoken of
    starts: tuple[Starts, ...] = ()  # errors with which a run may begin
    set_points: Demand | None = None  # what any set-points take too, where the program makes a reference of these

    @property
    def inputs(self) -> tuple[int, ...]:
        """Which inputs have a limit."""
        return tuple(int(k) for k in np.flatnonzero(np.isfinite(self.limits).any(axis=1)))

    @property
    def left(self) -> Array | None:
        """How far each input may be from its feedforward at any time, (m,); None where nothing is left or known."""
        left = self.spare
        return None if left is None or not (left > 0).all() else left

    @property
    def spare(self) -> Array | None:
        """The same with 0 where the feedforward takes a whole limit; None where it takes more, or that is not known."""
        peak = self._taken
        return None if peak is None or peak.beyond(self.limits) else peak.left(self.limits)

    def beside(self, more: Mapping[int, float], *, ever: bool) -> "Headroom":
        """Return it where something else takes so much more of inputs in this run, whatever its sign, or ever."""
        if self.peak is None:
            return self
        added = np.array([more.get(k, 0.0) for k in range(len(self.limits))])
        peak = replace(self.peak, low=self.peak.low - added, high=self.peak.high + added)
        return replace(self, peak=peak, lasting=None, ever=self.ever and ever, set_points=None)

    @property
    def whatever(self) -> bool:
        """Whether what is left is left whatever the set-points are."""
        demand = self.set_points
        return demand is not None and not demand.missing and not demand.beyond(self.limits)

    def whatever_said(self, starts: Starts) -> str:
        """Say so of starts that are about no run: x_d of a run may begin otherwise than that of set-points."""
        about = self.whatever and starts.kind in ("exact", "sizes", "every")
        return ", whatever the set-points" * about

    @property
    def _taken(self) -> Peak | None:
        """What the reference takes, and set-points where these are known to leave something."""
        if self.peak is None or self.set_points is None or not self.whatever:
            return self.peak
        return self.peak.with_also(replace(self.peak, low=self.set_points.low, high=self.set_points.high))

    @property
    def bearable(self) -> Array:
        """Between what constant loads at each input may be, (m, 2), so that the feedforward less them is in limits."""
        peak = self._taken
        assert peak is not None
        ends = np.column_stack([peak.high - self.limits[:, 1], peak.low - self.limits[:, 0]])
        return np.clip(ends, [-np.inf, 0.0], [0.0, np.inf])

    def within(self, sizes: Array) -> InputConstraint | None:
        """Return what a gain is to keep: from the starts of an ensemble where there is one, else within sizes (n,).

        Of an ensemble each error is at least a little, so that the starts have all directions.
        """
        left = self.left
        if left is None:
            return None
        members = [one.e for one in self.starts if one.kind == "members"]
        e = np.hstack([*members[:1], _LITTLE * np.diag(sizes)]) if members else np.diag(sizes)
        return InputConstraint(starts=[e[:, e.any(axis=0)]], left=left)

    def around(self, sizes: Array) -> InputConstraint | None:
        """Return from where limits are to do no harm if x̂ = x: starts of an ensemble or else a run, and within sizes.

        What is left on the smaller side is taken; sizes are (n,).
        """
        left, kinds = self.spare, [one.kind for one in self.starts]
        chosen = "members" if "members" in kinds else "run"
        boxes = [one.e[:, one.e.any(axis=0)] for one in self.starts if one.kind == chosen and one.e.any()]
        return None if left is None else InputConstraint(starts=[*boxes, np.diag(sizes)], left=left, over=np.inf)
