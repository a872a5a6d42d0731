"""From which starts errors go to 0 although limits of the inputs are reached: what is proved, stored and said of it.

In the loop of e, or of (e, Δ), u − u_ff is a row of it that limits cut off: see `lmi.saturated`. The observer is given
the input as it is limited, so Δ is untouched. From every start it is enough that e goes to 0 with Δ = 0 in this way,
with H = 0: by (9) Δ goes to 0 exponentially, and e is driven by it linearly.
"""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import above, places, zero
from pwatrack.claims.bounds import loops_of
from pwatrack.claims.exact_text import Held, decimal_texts, read_held
from pwatrack.claims.limits import (
    NoSaturation,
    StartGuarantee,
    drive_rows,
    loads_at,
    looked_at,
    nearby,
    taken_off,
)
from pwatrack.control.bounds import Loop, Loops
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.headroom import Headroom, Starts
from pwatrack.control.vertices import outermost
from pwatrack.control.words import Words, down, matrix_text
from pwatrack.lmi.inequality import CONTROLLER
from pwatrack.lmi.polynomial_region import region_around
from pwatrack.lmi.saturated import MOST_WORK, SaturatedLoop

_TRIES = 3  # of how the room of several inputs is shared with their loads
_NOT_FOUND = "no ellipsoid was found that proves it"


@dataclass(frozen=True, kw_only=True)
class RegionClaim(Claim):
    """Starts from which errors settle with limits active."""

    room: Headroom = field(repr=False)  # what the feedforward, and what else is known to act, leaves of the limits
    found: tuple[StartGuarantee, ...] = ()  # what is proved of some starts, each by a region
    missing: str = ""  # why it is of none; "" where it is of some

    KEY: ClassVar[str]  # of run.json
    LABEL: ClassVar[str]

    @abstractmethod
    def said(self, starts: str, one: StartGuarantee, words: Words) -> str:
        """Say what a guarantee is, of starts that are told in words."""

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        left, inputs = self.left, words.plant.inputs
        names = [*inputs, *(f"change of {name}" for name in inputs)]
        said = [] if left is None else [one.figures(left, names) for one in self.found]
        return {self.KEY: {"starts": said, "missing": self.missing}}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        left, found = self.left, () if self.left is None else self.found
        if left is None or not found:
            yield self.LABEL, f"not proved: {self.missing}"
            return
        for k, one in enumerate(found):
            starts = one.said(left, loads=controller.plant.loads is not None)
            if one.starts.kind == "every":
                starts = f"every start{_with_loads(self.room, words, controller, one)}"
            yield "" if k else self.LABEL, self.said(starts, one, words)

    @property
    def left(self) -> Array | None:
        """How far each input may be from its feedforward, (m,)."""
        return self.room.spare

    @property
    def goes(self) -> str:
        """What errors do from these starts, in words."""
        return "errors go to 0" if self.room.ever else "a measure of the errors falls throughout this run"

    def from_this_start(self, controller: ProvedController) -> bool:
        """Whether it is proved of the start of the run, with the loads that act in it."""
        loads, room, left = controller.plant.loads, self.room, self.left
        run = next((starts for starts in room.starts if starts.kind == "run"), None)
        bears = exact = loads is None or (run is not None and run.delta is None)
        if loads is not None and left is not None and run is not None and run.load is not None:
            at, acting = np.array(controller.plant.load_inputs), -run.load.sum(axis=1)
            each = ((float(acting[at == k].sum()), room.bearable[k]) for k in room.inputs)
            bears = len(at) > 0 and all(low <= load <= high for load, (low, high) in each)
        every = (one for one in self.found if one.starts.kind == "every")
        whole = any(exact or one.starts.delta is not None for one in every)
        return (bears and whole) or any(one.of_this_run(left) for one in self.found)


@dataclass(frozen=True, kw_only=True)
class LimitedRegion(RegionClaim):
    """Starts from which errors go to 0 with limits active.

    Each that is found is proved by a `Region` or a `PolynomialRegion`.
    """

    statement: ClassVar[str] = (
        "Under regions: likewise, D the rows by which u - u_ff is read off z = x - x_d or (x - x_d, x_hat - x, s_hat - "
        "s), B its way into z, M the matrices of z: Q > 0 and sym((M + B_S (H_S - D_S)) Q) < 0 for all M and all sets "
        "S of the inputs with limits; z^T Q^-1 z <= 1 at the starts, |H z| <= the sizes there. So z goes to 0 from "
        "starts scaled by c with u cut off anywhere beyond c times these sizes and loads; with H = 0 and no starts, "
        "from all. With V in place of Q: V falls along all M_e = M + B_S (H_S - D_S) as under proofs with a degree 2 "
        "d, V(starts v) <= the sum of weights_a v^2a <= 1, v^a the monomials of degree d, and (H z)^2d <= sizes^2d V."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"regions": []}
    KEY: ClassVar[str] = "limits_active"
    LABEL: ClassVar[str] = "limits active"

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["LimitedRegion"]:
        """Yield the starts for which it is proved, or why there are none, where inputs have limits."""
        if (room := asked.room) is not None:
            missing = _beyond(controller, room)
            if missing or told is None:
                found = () if missing else regions(controller, room)
            else:
                entries = {entry["of"]: entry for entry in told["regions"]}
                starts = [every(controller), *(nearby(one, entries) for one in room.starts)]
                known = [(one, read_held(entries[one.kind])) for one in starts if one.kind in entries]
                found = tuple(_of(controller, one, room, held) for one, held in known)
            yield cls(room=room, found=found, missing=missing or _NOT_FOUND * (not found))

    def data(self, controller: ProvedController) -> dict[str, Any]:
        cheaper = controller.design.cheaper
        return {"regions": [one.data for one in self.found]} | (
            {} if cheaper is None else {"K_of_least_cost": decimal_texts(cheaper)}
        )

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        smaller = _smaller(controller)
        return {self.KEY: super().figures(words, controller)[self.KEY] | {"K_smaller_by": smaller}}

    def said(self, starts: str, one: StartGuarantee, words: Words) -> str:
        starts += self.room.whatever_said(one.starts)
        return f"in the loop as designed {self.goes}{words.undisturbed} from {starts}, with inputs at their limits too"

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        yield from super().rows(words, controller)
        smaller, cheaper, left = _smaller(controller), controller.design.cheaper, self.left
        if left is None or not self.found:
            return
        if smaller is not None and cheaper is not None:
            much = f"{smaller:.2g} times smaller"
            yield "", f"for that K is {much} in sizes than that of least cost, {matrix_text(cheaper)}"
        elif (
            getattr(words.goals[CONTROLLER], "within", None) == "region" and min(p.scale(left) for p in self.found) < 1
        ):
            yield "", "K is that of least cost: none was found for which that is proved of more of these starts"

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        """Yield whether errors go to 0 from the start of the run with inputs at their limits, where that is proved."""
        never = any(claim.from_this_start for claim in controller.claims_of(NoSaturation))
        alone = words.conditions.beside(controller.plant.loads).undisturbed
        if alone and self.from_this_start(controller) and not never:
            yield "ideal loop", f"{self.goes} from this start with inputs at their limits too{words.as_designed}"


def _with_loads(room: Headroom, words: Words, controller: ProvedController, one: StartGuarantee) -> str:
    """Say with which loads a guarantee of every start is."""
    if controller.plant.loads is None:
        return ""
    if one.starts.delta is None:
        return " with x̂ = x, while no load acts"
    named = []
    for k in sorted({*controller.plant.load_inputs} & {*one.inputs}):
        name, (low, high) = words.plant.inputs[k], np.abs(room.bearable[k]).tolist()
        ends = f"{'−' * bool(low)}{down(low)} to {down(high)} {words.units.get(name, '')}".rstrip()
        named.append(f"{name} from {ends}")
    return f" and all constant loads at {' and at '.join(named)}" if named else ""


def _smaller(controller: ProvedController) -> float | None:
    """Return how many times as large as K the gain of least cost is, in sizes; None where K is that."""
    sizes, cheaper = controller.sizes, controller.design.cheaper
    return None if cheaper is None else sizes.norm(cheaper) / sizes.norm(controller.K)


def nothing_left(room: Headroom) -> str:
    """Return why the feedforward is not known to leave anything; "" where it is."""
    if room.peak is None:
        return "x_d takes too long to follow, so what its feedforward takes is not known"
    return "the feedforward takes more than the limits, from where the generator starts" * (room.spare is None)


def _beyond(controller: ProvedController, room: Headroom) -> str:
    """Return why nothing is tried; "" where it is."""
    if not_left := nothing_left(room):
        return not_left
    if controller.running is not controller.plant:
        return "cells are merged, and what is merged acts too"
    if controller.trajectory.preview is not None:
        return "x_d is played back, and what that leaves acts too"
    return ""


def regions(controller: ProvedController, room: Headroom) -> tuple[StartGuarantee, ...]:
    """Prove from which starts errors go to 0 with limits active: from every one, or from multiples of those given."""
    loops, inputs = loops_of(controller, unmoved=True), room.inputs
    loop = _saturated(loops, "controller", inputs)
    held = loop.everywhere() if loop.work <= MOST_WORK else None
    if held is not None:
        return (_of(controller, every(controller), room, held),)
    found = list[StartGuarantee]()
    for one in room.starts:
        name: Loop = "controller" if one.delta is None else "joint"
        if name not in loops.M or not looked_at(controller, one):
            continue
        loop = _saturated(loops, name, inputs)
        balls = any(X.radius is not None for X in loop.M)  # a polynomial is asked of all different cells then
        enough = 0.0 if balls and len(controller.plant.hull) < len(places(controller.plant.exact.A)) else np.inf
        if loop.work <= MOST_WORK and (tried := _largest(controller, loop, one, room, enough)):
            found.append(tried)
    return tuple(found)


def _largest(
    controller: ProvedController, loop: SaturatedLoop, starts: Starts, room: Headroom, enough: float
) -> StartGuarantee | None:
    """Return the region of the largest multiple of starts; what loads at an input take of its room is in proportion.

    Where an ellipsoid holds enough times the starts no polynomial is looked for.
    """
    left, inputs = room.spare, list(room.inputs)
    assert left is not None
    loads, share, best = np.array(loads_at(controller, starts, inputs)), 0.0, None
    for _ in range(_TRIES if loads.any() else 1):
        held = region_around(loop, starts.G, np.maximum(left[inputs] - share * loads, 0.0), enough=enough)
        if held is None:
            break
        found = _of(controller, starts, room, held)
        share = found.scale(left)
        best = found if best is None or share > best.scale(left) else best
    return best


def _of(controller: ProvedController, starts: Starts, room: Headroom, held: Held) -> StartGuarantee:
    loop: Loop = "joint" if starts.delta is not None and starts.kind != "every" else "controller"
    loads = loads_at(controller, starts, room.inputs)
    return StartGuarantee(starts=starts, loop=loop, inputs=room.inputs, held=held, loads=loads)


def every(controller: ProvedController) -> Starts:
    """Return all starts, of Δ too where estimates of loads do not move x_d."""
    n, N = len(controller.plant.B), len(controller.L)
    return Starts(kind="every", e=np.zeros((n, 0)), delta=np.zeros((N, 0)) if taken_off(controller) else None)


def _saturated(loops: Loops, loop: Loop, inputs: tuple[int, ...]) -> SaturatedLoop:
    """Return a loop with the inputs that have limits."""
    B, M = loops.B.part(range(loops.n), inputs), outermost(loops.M[loop])  # of which an auditor counts the same
    if loop == "joint":
        B = above(B, zero(loops.N, len(inputs)))
    return SaturatedLoop(M=M, B=B, D=drive_rows(loops, loop, inputs), inners=loops.inners[loop])
