"""What limits of the inputs leave for the controller: the feedforward's peak, and starts from which none is reached.

As long as no limit is reached, the loop is the one without limits. So if in that one |u − u_ff| is at most what is left
beside u_ff at all times, from a start, no limit is ever reached from there, and all that is proved holds with limits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, above
from pwatrack.control.bounds import Loop, Loops
from pwatrack.control.compensation import Compensation
from pwatrack.control.synthesis import Design
from pwatrack.control.within import Within
from pwatrack.lmi.exact_polynomial import AnyProof
from pwatrack.lmi.starts import Held, held
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes

_ROUNDING = 1e-12  # of the 1 that a load at an input is taken off it with
_LITTLE = 1e-3  # of a size: what any error may be at least
OFF = 1e-6  # of the feedforward: its peak is known to that, see `simulation.peak`
_NO_ROOM = 1e-9  # of a limit: a feedforward that comes so near to one is there, but for rounding


@dataclass(frozen=True, kw_only=True)
class Peak:
    """How small and how large the feedforward gets.

    Attributes:
        low, high: Of each input, (m,).
        times: When it gets there, in s, (m, 2).
    """

    low: Array
    high: Array
    times: Array

    def left(self, limits: Array) -> Array:
        """Return how far each input may be from its feedforward, (m,): what is left on the smaller side of its limits.

        Args:
            limits: (m, 2); infinite where there is none.

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
    """Errors with which a run may begin: (e, Δ) = (x − x_d, x̂ − x) = G ζ with |ζ_k| ≤ 1.

    Attributes:
        kind: "exact": each entry of e within its size, Δ = 0. "sizes": each entry of e and of Δ. "run": that of the
            run. "ensemble": those of its members. "members": the same with Δ = 0.
        e: Rows of G for e, (n, k).
        delta: Rows of G for Δ, (n, k), or None for Δ = 0.
        load: Rows of G for the errors of the estimates of loads, which are 0 at first: so for the loads but for their
            sign, (p, k). None where Δ = 0: then no load acts.
    """

    kind: Literal["exact", "sizes", "run", "ensemble", "members"]
    e: Array
    delta: Array | None = None
    load: Array | None = None

    @property
    def G(self) -> Array:
        """The starts as their loop has them, (n, k), (2 n, k) or (2 n + p, k)."""
        return np.vstack([rows for rows in (self.e, self.delta, self.load) if rows is not None])

    @classmethod
    def within(cls, sizes: Sizes) -> tuple["Starts", "Starts"]:
        """Return the starts within sizes, with the right x̂, and with another one and loads."""
        n, p = len(sizes.state), len(sizes.load)
        box = np.diag(np.concatenate([sizes.state, sizes.state, sizes.load]))
        both = cls(kind="sizes", e=box[:n], delta=box[n : 2 * n], load=box[2 * n :] if p else None)
        return cls(kind="exact", e=np.diag(sizes.state)), both


@dataclass(frozen=True, kw_only=True)
class Promise:
    """By how much inputs differ from their feedforward at any time, from some starts, in the loop as designed.

    Attributes:
        starts: Which.
        loop: Of which loop the ellipsoid is: of e alone, or of (e, Δ).
        inputs: Those that have limits.
        held: The ellipsoid; None where no input is moved.
        loads: How large the loads at each of these inputs are together; their estimates make the input differ by that.
    """

    starts: Starts
    loop: Loop
    inputs: tuple[int, ...]
    held: Held | None
    loads: tuple[float, ...]

    def scale(self, left: Array) -> float:
        """Return how many times as large the errors of the start may be, so that no limit is reached, rounded down.

        Args:
            left: How far each input may be from its feedforward, (m,).
        """
        sizes = self.held.sizes if self.held else (0.0,) * len(self.inputs)
        moved = (size + load for size, load in zip(sizes, self.loads, strict=True))
        ratios = (float(left[k]) / size for k, size in zip(self.inputs, moved, strict=True) if size)
        return min(ratios, default=np.inf) * (1 - 1e-12)


def promises(
    plant: PWASystem,
    design: Design,
    proofs: Sequence[AnyProof],
    left: Array,
    starts: Sequence[Starts],
    added: Compensation | None = None,
    known: Mapping[str, Held] | None = None,
) -> tuple[Promise, ...]:
    """Prove from which starts inputs stay near their feedforward; what cannot be proved is not there.

    With x̂ = x they are about e' = (A_i + B K) e, else about (e, Δ) for all pairs of cells, as in `bounds`. Where loads
    are estimated the first is about a time when none acts, and its estimate is 0. The second is looked at where all are
    constants s at inputs: then x_d does not depend on them, and with Δ of x̂ − x and σ = ŝ − s

        u − u_ff = K (e + Δ) − ŝ = (K (e + Δ) − σ) − s,    u_ff without estimates.

    Args:
        plant: The system (1).
        design: Its gains K and L.
        proofs: What `prove_design` returned for them.
        left: How far each input may be from its feedforward, (m,); infinite where it has no limit.
        starts: Which starts.
        added: What estimates of loads add to the desired trajectory.
        known: What was proved of starts before, by their kind: then nothing is searched.
    """
    K, L = design.exact
    p = L.shape[0] - plant.exact.B.shape[0]
    loops = Loops(plant, K, L, proofs, BallMatrix.of(np.zeros((len(plant.B), p)), (len(plant.B), p)), output=False)
    taken_off = added is not None and _taken_off(added, loops.at_inputs)
    inputs, found = tuple(int(k) for k in np.flatnonzero(np.isfinite(left))), list[Promise]()
    for one in starts:
        loop: Loop = "controller" if one.delta is None else "joint"
        if loop not in loops.M or (p and one.delta is not None and (one.load is None or not taken_off)):
            continue
        kind: Literal["drive", "input"] = "drive" if p and loop == "joint" else "input"
        rows = reduce(above, (loops.row(loop, (kind, k)) for k in inputs))
        acting = np.zeros(p) if one.load is None else np.abs(one.load).sum(axis=1)
        loads = tuple(
            float(acting[np.array(loops.at_inputs, dtype=int) == k].sum()) if acting.any() else 0.0 for k in inputs
        )
        promise = Promise(starts=one, loop=loop, inputs=inputs, held=None, loads=loads)
        if not one.G.any() or not any(rows.centre.entries()):
            found.append(promise)
            continue
        if known is not None:
            found += [replace(promise, held=known[one.kind])] if one.kind in known else []
            continue
        tries = (held(loops.M[loop], one.G, rows, left[list(inputs)], inner) for inner in loops.inners[loop])
        best = max((replace(promise, held=h) for h in tries if h), key=lambda p: p.scale(left), default=None)
        found += [best] if best else []
    return tuple(found)


def _taken_off(added: Compensation, at_inputs: Sequence[int]) -> bool:
    """Say whether estimates of loads do nothing but to be taken off the input that each load is added to."""
    if not at_inputs or any(added.X.centre.entries()) or added.X.radius is not None:
        return False
    off = added.u_ff + np.eye(added.u_ff.shape[1])[:, list(at_inputs)]
    return bool(np.abs(off).max() <= _ROUNDING and np.abs(added.rate).max(initial=0.0) <= _ROUNDING)


@dataclass(frozen=True, kw_only=True)
class Limited:
    """Limits of the inputs, and what the feedforward takes of them.

    Attributes:
        limits: Lower and upper limit of each input, (m, 2); infinite where there is none.
        lasting: What the feedforward takes whatever the generator starts with, where that is known: in its steady
            state for the reference as it begins, and from there on.
        peak: The same from the start of the generator in this run too; None where it could not be followed.
        ever: Whether it is within that after the run too; else no more than the run is spoken of.
        starts: Errors with which a run may begin.
        promises: What is proved of some of them.
    """

    limits: Array
    lasting: Peak | None
    peak: Peak | None
    ever: bool = False
    starts: tuple[Starts, ...] = ()
    promises: tuple[Promise, ...] = ()

    @property
    def left(self) -> Array | None:
        """How far each input may be from its feedforward at any time, (m,); None where nothing is left or known."""
        left = None if self.peak is None else self.peak.left(self.limits)
        return None if left is None or not (left > 0).all() else left

    def within(self, sizes: Array) -> Within | None:
        """Return what a gain is to keep: from the starts of an ensemble where there is one, else within sizes (n,).

        Of an ensemble each error is at least a little, so that the starts have all directions.
        """
        left = self.left
        if left is None:
            return None
        members = [one.e for one in self.starts if one.kind == "members"]
        e = np.hstack([*members[:1], _LITTLE * np.diag(sizes)]) if members else np.diag(sizes)
        return Within(starts=e[:, e.any(axis=0)], left=left)

    def promising(self, plant: PWASystem, design: Design, proofs: Sequence[AnyProof], added: Compensation) -> "Limited":
        """Return the same with what is proved of a design; see `promises`."""
        left = self.left
        if left is None:
            return self
        return replace(self, promises=promises(plant, design, proofs, left, self.starts, added))
