"""From which starts the errors of a sampled loop settle although limits of inputs are reached: proved, stored, said.

The program cuts its input off, holds it and predicts with it, so the observer's errors are untouched, but for what a
gain against windup makes of them: see `lmi.clocked_region`. What acts in the run is in it: what that leaves in an input
beside the feedforward, in the loop without limits, is taken off what the feedforward leaves of them.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, ClassVar, Literal

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.exact_text import Held, read_held
from pwatrack.claims.limits import StartGuarantee, loads_at, looked_at, nearby, taken_off
from pwatrack.claims.region import RegionClaim, every, nothing_left
from pwatrack.claims.sampled import SampledLoop, errors_of, on_estimates
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.bounds import Form
from pwatrack.control.controller import Asked, ProvedController, Row, Told
from pwatrack.control.headroom import Headroom, Starts
from pwatrack.control.sampled_disturbances import beside_loads, cut_off, drives
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.words import Words
from pwatrack.lmi.clocked import ClockedProof
from pwatrack.lmi.clocked_region import SaturatedTicks
from pwatrack.lmi.ellipsoid import Inner
from pwatrack.lmi.exact import short
from pwatrack.lmi.saturated import SaturatedLoop
from pwatrack.rational import floats

_NOT_FOUND = "no forms were found that prove it"
_FINER = 2  # times as many segments as the loop without limits takes
_BETTER = 1.05  # times as much of the starts with samples of no length: from which on what falls slower is looked at
_SLOWED = (1.0, 0.3)  # times what an input wants to change by: what it changes by at least where it may not
_FASTER = (1.5, 5.0)  # times as fast as the loop without limits: how fast V may change with a gain against windup
_MUCH = (1.0, 0.5)  # of it that is tried: it is sought as if samples were short
_SHARES = ((0.25, 0.1), (0.5, 1.0))  # of its rate: what V falls with at a limit; the others where none of these will do


@dataclass(frozen=True, kw_only=True)
class SampledRegion(RegionClaim):
    """Starts from which the errors of the sampled loop settle with limits active."""

    # what is left, likewise, of what inputs may change by in a sample, (m,); None where these have no such limits
    changes: Array | None = field(repr=False)
    idle: bool  # whether nothing acts
    late: bool = False  # whether inputs are: then starts with x̂ = x are as the first input of the program acts

    statement: ClassVar[str] = (
        "Under sampled_regions: z as under sampled, before a tick, with nu = 0 and rho = 0 at the starts, D the rows "
        "of J for nu, without delay less U (s_hat - s) after the tick, J_S with H_S in place of D_S for all sets S of "
        "the inputs with limits, where x_hat and s_hat of the tick are moved by E times what H z is more than D z, and "
        "nu by U times that of s_hat too: P as under sampled with rate 0 and J_S^T P_0 J_S < P_N for all S, z^T P_N z "
        "<= 1 at the starts, and |H z| <= the sizes where it is so. So z, less what all that acts makes of it without "
        "limits along the same switching, goes to 0 from starts scaled by c, with u cut off anywhere beyond c times "
        "these sizes and loads and what that makes of u; with H = 0 and no starts, from all. A row of a change is one "
        "more in place of the D of its input, nu + H z: with u changing by c times its size at least and what that "
        "makes of the change."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"sampled_regions": []}
    KEY: ClassVar[str] = "sampled_limits_active"
    LABEL: ClassVar[str] = "limits, sampled"

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["SampledRegion"]:
        """Yield the starts for which it is proved, or why there are none, where the loop is sampled and has limits."""
        yield from (search.claim(told) for search in _Search.of(controller, asked))

    def data(self, controller: ProvedController) -> dict[str, Any]:
        return {"sampled_regions": [one.data for one in self.found if one.held is not None]}

    def said(self, starts: str, one: StartGuarantee, words: Words) -> str:
        whole = one.starts.kind == "every" or one.of_this_run(self.left)
        starts += ", as the first input acts" * (self.late and not whole)
        return f"in the sampled loop {self.goes} from {starts}, {self._with}{words.as_designed}"

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        """Yield whether errors settle from the start of the run with inputs at their limits, where that is proved."""
        if self.from_this_start(controller) and not words.conditions.another_plant:
            yield "as sampled", f"from this start {self.goes}, {self._with}"

    @property
    def left(self) -> Array | None:
        """How far each input may be from its feedforward, then what is left of its changes where these have limits."""
        spare = self.room.spare
        return spare if spare is None or self.changes is None else np.concatenate([spare, self.changes])

    @property
    def _with(self) -> str:
        return f"with inputs{' and their rates' * (self.changes is not None)} at their limits too"

    @property
    def goes(self) -> str:
        """The same; where something acts, `room` is that of this run only."""
        return super().goes + " to what all that acts leaves" * (not self.idle)


@dataclass(frozen=True, kw_only=True)
class _Search:
    """Looks for regions of one loop."""

    controller: ProvedController
    gains: SampledGains
    proof: ClockedProof  # of the loop without limits
    bare: SampledRegion  # nothing is found yet; its room is without what acts takes
    off: Array  # columns by which x̂(0) of the run may be off, (n, q), as it is made of what is measured
    begun: Array | None  # where the run is as its first input acts, where that is late and known, (order, k)

    @classmethod
    def of(cls, controller: ProvedController, asked: Asked, *, alone: bool = False) -> Iterator["_Search"]:
        """Yield the search where the sampled loop is proved and inputs have limits; and why nothing is tried, if so.

        With `alone` as if nothing acted: then no bound of what does is needed.
        """
        room = asked.room
        for loop in controller.claims_of(SampledLoop):
            if loop.proof is None or room is None:
                continue
            X, inputs = asked.measured, tuple(range(controller.plant.B.shape[1]))
            X, begun = np.zeros(controller.plant.C.T.shape) if X is None else X, None
            taken, idle = np.full(len(inputs), 0.0 if alone else np.inf), alone
            missing, changes = _beyond(controller, room), asked.changes
            for bounds in controller.claims_of(SampledBounds) if not (missing or alone) else ():
                taken, changed = bounds.taken(inputs, drives(bounds.errors, inputs))
                idle, X, changes = bounds.idle, X * bounds.noise, None if changes is None else changes - changed
                begun = bounds.begun
            if not missing and not np.isfinite(taken).all():
                missing = "no bound is proved of what acts"
            elif not missing:
                room = room.beside(dict(enumerate(taken.tolist())), ever=idle)
                missing = "what acts takes all that is left of the limits" * (room.spare is None)
            if not missing and changes is not None and not (changes > 0).all():
                missing = "what acts, or how x_d begins, takes all that an input may change by"
            bare = SampledRegion(room=room, changes=changes, idle=idle, late=loop.gains.delay > 0, missing=missing)
            yield cls(controller=controller, gains=loop.gains, proof=loop.proof, bare=bare, off=X, begun=begun)

    def claim(self, told: Told = None, kinds: Collection[str] = ()) -> SampledRegion:
        """Return the claim with what is proved of all starts, or of some kinds; as a certificate tells it."""
        if self.bare.missing:
            return self.bare
        found = tuple(self.regions(kinds) if told is None else self.read(told["sampled_regions"]))
        return replace(self.bare, found=found, missing=_NOT_FOUND * (not found))

    def read(self, entries: Sequence[Any]) -> Iterator[StartGuarantee]:
        told = {entry["of"]: entry for entry in entries}
        known = (nearby(replace(one, z=self.errors.before(one)), told) for one in self.starts)
        for one in (every(self.controller), *known):
            if one.kind in told:
                yield self.guarantee(one, read_held(told[one.kind]))
            elif one.z is not None and self.on_reference(one.z) and "every" not in told:
                yield self.guarantee(one, None)

    @property
    def room(self) -> Headroom:
        return self.bare.room

    @cached_property
    def errors(self) -> SampledErrors:
        return errors_of(self.controller, self.gains)

    @property
    def own(self) -> list[int]:
        """Where e and the newest (Δ, σ) are in z."""
        n, m, N, *_ = self.errors.widths
        return [*range(n), *range(n + m, n + m + N)]

    def as_newest(self, before: Array) -> Array:
        """Return the rows of starts that are e and the newest (Δ, σ), or another where that one is 0, (n + N, k)."""
        (n, m, N, *_), found, d = self.errors.widths, before[self.own], self.errors.predicted
        idle = ~found.any(axis=0)
        found[n:, idle] = before[n + m : n + m + d * N, idle].reshape(d, N, -1).sum(axis=0)
        return found

    @cached_property
    def starts(self) -> list[Starts]:
        """Those that are looked at: of a run or an ensemble with what noise and steps of sensors add to x̂(0).

        Where inputs are late what errors are as the first one acts is known of x̂ = x, predicted so, and of the run.
        """
        if self.gains.delay:
            run = [] if self.begun is None else [one for one in self.room.starts if one.kind == "run"]
            late = [replace(one, z=self.begun) for one in run]
            return [*(one for one in self.room.starts if one.kind == "exact"), *late]
        loads = len(self.controller.L) - len(self.controller.plant.B)
        return [one.with_more(self.off, loads) for one in self.room.starts]

    @cached_property
    def ticks(self) -> SaturatedTicks:
        system, (n, m, *_) = self.errors.clocked, self.errors.widths
        put_out = drives(self.errors, [k % m for k in self.limited])
        return SaturatedTicks(
            system=system,
            near=floats(self.proof.P[0].P),
            knots=_FINER * (len(self.proof.P) // system.parts - 1),
            places=tuple(n + k % m for k in self.limited),
            T=cut_off(self.errors).part(range(self.errors.order), [k % m for k in self.limited]),
            D=BallMatrix.of(put_out) @ system.J[0],
            before=BallMatrix.of(put_out * (np.array(self.limited) >= m)[:, None]),
            rate=self.proof.rate,
        )

    @property
    def limited(self) -> tuple[int, ...]:
        """Which inputs have limits, and which have limits of changes, counted on from those."""
        m = len(self.room.limits)
        changes = self.bare.changes
        finite = () if changes is None else np.flatnonzero(np.isfinite(changes)).tolist()
        return (*self.room.inputs, *(m + k for k in finite))

    @cached_property
    def continuous(self) -> SaturatedLoop:
        """The loop of (e, Δ, σ) as if its ticks went on all the time: for short samples nearly what it does."""
        errors, gains, inputs, (n, m, N, *_) = self.errors, self.gains, self.room.inputs, self.errors.widths
        corrects = gains.M @ errors.plant.observed.C.floats / gains.sample_time
        own = self.own
        W = beside_loads(errors, tuple(range(m)))[:, n:]
        D, B = np.hstack([gains.K, gains.K @ np.eye(n, N) + W[:, m : m + N]]), errors.plant.B
        seen = [A if errors.plant.loads is None else errors.plant.loads.observed(A) for A in errors.seen]
        pairs = [
            np.block([[A.floats + B @ D[:, :n], B @ D[:, n:]], [np.zeros((N, n)), A_j.floats + corrects]])
            for A, A_j in product(errors.cells, seen)
        ]
        Q = np.asarray(np.linalg.inv(floats(self.proof.P[0].P))[np.ix_(own, own)], dtype=np.float64)
        return SaturatedLoop(
            M=[BallMatrix.of(X) for X in pairs],
            B=BallMatrix.of(np.vstack([B, gains.into / gains.sample_time])[:, list(inputs)]),
            D=BallMatrix.of(D[list(inputs)]),
            inners=[Inner(Q=Q, most=2 * self.proof.rate)],
        )

    def regions(self, kinds: Collection[str] = ()) -> Iterator[StartGuarantee]:
        """Yield what is proved: of every start, or of multiples of those that are given, or of some kinds of them."""
        free = taken_off(self.controller) and not self.ticks.before.floats.any()
        held = self.ticks.everywhere() if free else None
        if held is not None:
            yield self.guarantee(every(self.controller), held)
            return
        for one in (one for one in self.starts if not kinds or one.kind in kinds):
            if self.on_reference(self.errors.before(one)):
                yield self.guarantee(one, None)
            elif looked_at(self.controller, one) and (best := self._largest(one)):
                yield best

    def on_reference(self, before: Array) -> bool:
        """Whether starts are without errors, and what acts takes less than there is: then no limit is reached."""
        left = self.bare.left
        return not before.any() and left is not None and bool((left[list(self.limited)] > 0).all())

    def against_windup(self, starts: Starts) -> Iterator[tuple[SampledGains, float]]:
        """Yield gains with one against windup, K and M as they are, and how much of the starts is proved with it."""
        left, (_, m, N, *_), gains, inputs = self.bare.left, self.errors.widths, self.gains, list(self.room.inputs)
        assert left is not None
        G, room = self.as_newest(self.errors.before(starts)), np.maximum(left[inputs], 0.0)
        for faster in _FASTER:
            E = self.continuous.against_windup(G, room, N, _SHARES[0][-1] * self.proof.rate, faster)
            if E is None:
                continue
            for much in _MUCH:
                whole = np.zeros((N, m))
                whole[:, inputs] = E * (much * gains.sample_time)
                made = replace(gains, E=short(whole))
                found = replace(self, gains=made)._largest(starts)
                yield made, 0.0 if found is None else found.scale(left)

    def _largest(self, starts: Starts) -> StartGuarantee | None:
        """Return the region of the largest multiple that is proved, of a few H."""
        left, (n, m, N, *_), ticks, best, had = self.bare.left, self.errors.widths, self.ticks, None, 0.0
        assert left is not None
        before, own, inputs = self.errors.before(starts), self.own, len(self.room.inputs)
        room, ticked = np.maximum(left[list(self.limited)], 0.0), self.errors.ticks[0].floats[own]
        if self.gains.delay:  # an input is made of the oldest prediction
            oldest = n + m + (self.errors.predicted - 1) * N
            ticked = np.eye(self.errors.order)[[*range(n), *range(oldest, oldest + N)]]
        change = (ticks.D.floats - ticks.before.floats)[inputs:]
        for shares in _SHARES:
            rates = [share * self.proof.rate for share in shares]
            for Q, H, weights in self.continuous.sought(self.as_newest(before), room[:inputs], rates):
                sizes = np.sqrt(np.einsum("ij,jk,ik->i", H, Q, H))
                likely = float((room[:inputs] / np.where(sizes > 0, sizes, 1e-300)).min())
                nearly = best is not None and 1 / _BETTER <= best.scale(left) < 1  # a little more is all of them
                if had <= likely < _BETTER * had and not nearly:
                    continue
                for much in _SLOWED if len(change) else _SLOWED[:1]:
                    held = ticks.around(before, room, np.vstack([H @ ticked, much * change]), weights)
                    tried = None if held is None else self.guarantee(starts, held)
                    if tried is not None and (best is None or tried.scale(left) > best.scale(left)):
                        best, had = tried, likely
            if best is not None:
                break
        return best

    def guarantee(self, starts: Starts, held: Held | None) -> StartGuarantee:
        """Return what a region says of starts, as z before the first tick."""
        inputs, m = self.room.inputs, len(self.room.limits)
        forms: tuple[Form, ...] = ()
        if self.limited != inputs:
            kind: Literal["drive", "input"] = "input" if starts.load is None else "drive"
            forms = (*((kind, k) for k in range(m)), *(("change", k) for k in range(m)))
        return StartGuarantee(
            starts=replace(starts, z=self.errors.before(starts)),
            loop="joint",
            inputs=self.limited,
            held=held,
            loads=loads_at(self.controller, starts, inputs) + (0.0,) * (len(self.limited) - len(inputs)),
            forms=forms,
        )


def if_alone(controller: ProvedController, asked: Asked, kinds: Collection[str]) -> Iterator[SampledRegion]:
    """Yield for which starts of some kinds it would be proved if nothing acted: as a rule for more than with that."""
    yield from (search.claim(kinds=kinds) for search in _Search.of(controller, asked, alone=True))


def against_windup(controller: ProvedController, asked: Asked, kind: str) -> Iterator[tuple[SampledGains, float]]:
    """Yield gains with one against windup, and what multiple of the starts of a kind is proved with them."""
    for search in _Search.of(controller, asked):
        for starts in search.starts if not search.bare.missing else ():
            if starts.kind == kind:
                yield from search.against_windup(starts)


def _beyond(controller: ProvedController, room: Headroom) -> str:
    """Return why nothing is tried; "" where it is."""
    moved = on_estimates(controller) is not None
    return nothing_left(room) or "x_d or u_ff depend on estimates that are no constants at inputs" * moved
