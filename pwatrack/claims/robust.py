"""What is proved of the loop for every plant of a box: the plants at its corners, and all their means.

With w = f_p(x_d) − f(x_d) + (B_p − B) u_ff the errors obey (e, Δ)' = M (e, Δ) + (w, −w), M in the hull of the M_cij of
all corners c and cells i, j: see `docs/theory/beyond.md`, *Uncertain parameters*. One ellipsoid for each entry of w
that is not 0 bounds every signal, as in `bounds`; p may change with time, in any way. The desired trajectory is that
of the known plant, and does not depend on p.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import OVER_SUMS, Array, number_text, up
from pwatrack.ball_matrix import BallMatrix, above, beside, different, text
from pwatrack.claims.bounds import from_start, loops_of, with_acting
from pwatrack.claims.exact_text import bounds_content, corner_content, read_bounds
from pwatrack.control.bounds import MOST_WORK, Bounds, Channel, Form
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Seen, Told
from pwatrack.control.convergence import best_certificate
from pwatrack.control.vertices import Differences
from pwatrack.control.words import Words, down
from pwatrack.errors import OutsideTheory, ProblemPart, Remedy, Undecided, Way
from pwatrack.lmi.ellipsoid import Inner
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.real import Box

_CLAIM = "the proof for the uncertain parameters"


@dataclass(frozen=True, kw_only=True)
class Robust(Claim):
    """The proof for a box."""

    box: Box  # the parameters that are uncertain
    plant: PWASystem  # the plant of the design
    corners: tuple[Matrices, ...]  # the matrices at the corners
    count: int  # how many inequalities of order 2 n each ellipsoid satisfies
    # what 1 of an entry of w can make of each output or state that is tracked, and of each input, for every plant of
    # the box; one for each entry that is not 0
    bounds: tuple[Bounds, ...]

    statement: ClassVar[str] = (
        "Under uncertain: for every plant whose A, b and B are a mean of those of the corners, with the same weights "
        "in all cells, and may change with time: what 1 at most in an entry of w = f_p(x_d) - f(x_d) + (B_p - B) u_ff "
        "can make of each signal from x = x_hat = x_d on; entries without a bound are 0."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"uncertain": None}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["Robust"]:
        if not asked.box or (told is not None and told["uncertain"] is None):
            return
        plant = controller.plant
        corners = tuple(asked.corners(plant))
        if told is None:
            yield prove_box(controller, corners, asked.box)
        else:
            content = told["uncertain"]
            count = len(joint_matrices(plant.exact, corners, *controller.design.exact))
            bounds = tuple(map(read_bounds, content["bounds"]))
            yield cls(box=asked.box, plant=plant, corners=corners, count=count, bounds=bounds)

    def data(self, controller: ProvedController) -> dict[str, Any]:
        intervals = [[one.name, *(text(end.centre) for end in (one.low, one.high))] for one in self.box]
        bounds = [bounds_content(bounds) for bounds in self.bounds]
        corners = [corner_content(corner) for corner in self.corners]
        return {"uncertain": {"parameters": intervals, "corners": corners, "bounds": bounds}}

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        box = {interval.name: [float(interval.low), float(interval.high)] for interval in self.box}
        return {"uncertain": {"parameters": box, "inequalities": self.count, "rate": self.rate}}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        box, order = self.parameters, 2 * len(self.plant.B)
        yield (
            "uncertain",
            f"for every plant with {box}, also where they change with time: {self.count} inequalities of order {order} "
            f"proved; errors go to their bounds at least as fast as e^(−{down(self.rate)} t)",
        )
        said = "w = f_p(x_d) − f(x_d) + (B_p − B) u_ff, f_p and B_p of that plant: what its entries leave in the end "
        said += "adds up"
        if controller.beside:
            left = ((form, controller.leaves(form)) for form in self.bounds[0].sizes)
            texts = words.limits((form, size) for form, size in left if size is not None)
            said += f"{controller.beside}: {', '.join(texts)} for all of them"
        yield "", said
        for bounds in self.bounds:
            _, on, unit = words.cause(bounds.channel, uncertain=True)
            yield "", f"{', '.join(words.limits(bounds.sizes.items()))} per {unit or '1'} of {on}"

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        yield "ideal loop", f"to a bound for all plants with {self.parameters}: time constant {up(1 / self.rate)} s"

    def allows(self, controller: ProvedController, seen: Seen) -> dict[Form, Array]:
        if seen.w is None or seen.designed:
            return {}
        most = from_start(self.bounds, (), seen.start, seen.t, states=len(self.plant.B))
        acting: dict[Channel, Array] = {bounds.channel: seen.w[:, bounds.channel[1]] for bounds in self.bounds}
        return with_acting(most, self.bounds, acting)

    @property
    def parameters(self) -> str:
        return ", ".join(interval.text for interval in self.box)

    @property
    def rate(self) -> float:
        """Errors go to their bound at least as fast as e^(−rate t), in 1/s."""
        return min(part.ellipsoid.a for bounds in self.bounds for part in bounds.parts) / 2

    def reached(self, deviation: Array) -> dict[Form, float]:
        """Return the bound of each signal in the end, for entries of w of these sizes at most (n,)."""
        total = dict.fromkeys(self.bounds[0].sizes, 0.0)
        for bounds in self.bounds:
            for signal in total:
                total[signal] += bounds.sizes[signal] * float(deviation[bounds.channel[1]])
        return {signal: size * OVER_SUMS for signal, size in total.items()}

    @cached_property
    def differences(self) -> Differences:
        """By how much the plants at the corners differ from that of the design: in each equation, once each."""
        return Differences.of_corners(self.plant.exact, self.corners)


def check_without_loads(plant: PWASystem) -> None:
    """Refuse a plant whose loads are estimated."""
    if plant.loads is not None:
        message = "bounds for uncertain parameters are proved without estimates of unknown loads"
        raise OutsideTheory(message, subject=(ProblemPart.UNCERTAIN,), hint="leave out one or the other")


def prove_box(controller: ProvedController, corners: Sequence[Matrices], box: Box = ()) -> Robust:
    """Prove for every plant of a box that x − x_d ends within bounds, each signal in its own unit.

    The matrices at the corners of the box have the same cells. Raises OutsideTheory if loads are estimated too;
    Undecided if there are too many inequalities, or no common P is found.
    """
    plant = controller.plant
    check_without_loads(plant)
    M = joint_matrices(plant.exact, corners, *controller.design.exact)
    order = M[0].shape[0]
    if len(M) * order**4 > MOST_WORK:
        most = MOST_WORK // order**4
        message = (
            f"{_CLAIM} is undecided: {len(M)} inequalities of order {order}, at most {most} of that order are tried"
        )
        raise Undecided(message, subject=(ProblemPart.UNCERTAIN,), hint="let parameters that matter least be known")
    matrices = np.array([X.floats for X in M])
    worst = float(np.linalg.eigvals(matrices).real.max())
    found = best_certificate(matrices) if worst < 0 else None
    if found is None or found.rate <= 0:
        raise _undecided(len(M), order, worst)
    loops = loops_of(controller)
    loops.M["joint"], loops.inners["joint"] = M, [Inner.proved(found.P, found.rate)]
    bounds = []
    for k in varying_rows(plant.exact, corners):
        channel: Channel = ("disturbance", k)
        sizes, parts = loops.sizes("joint", channel, loops.tracked + loops.inputs)
        if not parts:
            raise _undecided(len(M), order, worst)
        bounds.append(Bounds(channel=channel, sizes=sizes, parts=parts))
    return Robust(box=box, plant=plant, corners=tuple(corners), count=len(M), bounds=tuple(bounds))


def varying_rows(exact: Matrices, corners: Sequence[Matrices]) -> list[int]:
    """Return the state equations in which the plants differ."""
    own = (*exact.A, *exact.b, exact.B)
    pairs = (zip((*corner.A, *corner.b, corner.B), own, strict=True) for corner in corners)
    off = [(X.centre - Y.centre).tolist() for each in pairs for X, Y in each]
    return [k for k in range(exact.B.shape[0]) if any(any(D[k]) for D in off)]


def joint_matrices(exact: Matrices, corners: Sequence[Matrices], K: BallMatrix, L: BallMatrix) -> list[BallMatrix]:
    """Return the different M_cij."""
    observers, found = [A_j + L @ exact.C for A_j in different(exact.A)], list[BallMatrix]()
    for corner in corners:
        BK, off = corner.B @ K, (exact.B - corner.B) @ K
        for A_c, A_i in zip(corner.A, exact.A, strict=True):
            upper, left = beside(A_c + BK, BK), A_i - A_c + off
            found += [above(upper, beside(left, A_j + off)) for A_j in observers]
    return different(found)


def _undecided(count: int, order: int, worst: float) -> Undecided:
    message = f"{_CLAIM} is undecided: no common P was found for {count} inequalities of order {order}"
    if worst >= 0:
        message += f"; at a corner an eigenvalue of the loop has real part {number_text(worst, '.3g')}"
    hint = "give smaller intervals, or ask for gains with a faster decay"
    return Undecided(message, subject=(ProblemPart.UNCERTAIN,), hint=hint, remedy=Remedy(Way.SMALLER_BOX))
