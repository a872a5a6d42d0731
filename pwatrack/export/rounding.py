"""What rounding adds to the errors of a sampled loop, enclosed: in whole numbers, or in single floats.

In a tick each row of a table is off by what its entries and its result are rounded by, times how large the numbers get
that it is of. What that is of predictions and corrections kicks (x̂, ŝ), of the law u; what generator and reference are
off by is seen by running them, along the whole run, and kicks u too. Where rounding takes another cell, x̂ is kicked to
a point of that one and back. Kicks of size δ in V^½, V a tube of `lmi.clocked_tubes`, leave
δ / (1 − (1 − b)^½ e^(−a h / 2)) of it, from 0 on: see `docs/theory/beyond.md`, *A loop that is sampled*, on rounding.
"""

from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from pwatrack.arrays import OVER_POWERS, Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.ranges import ProgramRanges
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds, shown
from pwatrack.claims.tube_search import TubeSearch
from pwatrack.control.bounds import Channel
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController
from pwatrack.control.sampled_disturbances import corrected
from pwatrack.control.words import Words
from pwatrack.errors import CheckFailed, OutsideTheory
from pwatrack.export.fixed_point import FixedPoint, unit_of
from pwatrack.export.single_floats import SingleFloats, along
from pwatrack.export.source import Source
from pwatrack.export.stored import runs
from pwatrack.lmi.clocked import ClockedProof
from pwatrack.lmi.clocked_tubes import Tube
from pwatrack.rational import squares_in

# Times what a number is at most with real numbers, what there is room for: the first of these that rounding stays in.
_ROOMS = (1.001, 1.1, 2.0)
_LESS = 1.001  # times that, what units have room for: for what rounding may add in units
_MOST = 4096  # sets of planes that are looked at
_CHANNEL: Channel = ("rounding", 0)
_OVER = 1 + 1e-6  # more than the rounding of products and of bases
_OTHER = "--float32 is written all the same, and says that it is not known"
NOT_KNOWN = "what rounding adds: "  # how refusals begin


@dataclass(frozen=True, kw_only=True)
class _Kicked(Tube):
    """A tube in units of what V^½ is at most: of 1 of these its sizes are, and what it spreads over."""

    level: float

    def spread(self, rows: Array) -> Array:
        return np.asarray(self.level * super().spread(rows))


@dataclass(frozen=True, kw_only=True)
class Rounding:
    """A program in numbers of some kind, in a run."""

    controller: ProvedController  # whose program it is
    numbers: FixedPoint | SingleFloats  # what runs
    ranges: ProgramRanges  # of its numbers, were they real
    given: Array  # the reference from outside at all ticks, (ticks, s); (ticks, 0) where it is made inside
    room: float  # times what numbers are at most with real numbers, to which they may grow
    proved: SampledController  # what its loop was proved with, which makes the reference inside
    started: tuple[ArrayLike, ArrayLike]  # what x̂ with ŝ, and η̂ start with

    @cached_property
    def bounds(self) -> SampledBounds:
        """What all that acts leaves, and rounding too; CheckFailed if a number leaves its bits, or no tube is known."""
        known, count = self.ranges.bounds, len(self.ranges.bounds.acts.near)
        off: dict[Channel, float] = {("input", k): size for k, size in enumerate(self.put_out.tolist())}
        wanted: list[Channel] = [*off, *(("noise", k) for k in range(len(known.errors.plant.C)))]
        acts = replace(known.acts, squares={one: np.ones(1) for one in wanted if one not in known.covered}, means={})
        search = TubeSearch.of(self.controller, known.forms, known.errors, self.proof)
        tubes = (*known.tubes, *search.tubes(acts))
        kicked = tuple(self._kicked(tube) for _, each in tubes for tube in each)
        if not (kicked and off.keys() <= replace(known, tubes=tubes).covered):
            raise CheckFailed(f"{NOT_KNOWN}no bound was found for what it leaves", hint=_OTHER)
        late, of = known.acts.late, self.controller.sizes
        each = self.predicted + self.corrected
        if late is not None and (each > late.clear * np.concatenate([of.state, of.load])).any():
            raise CheckFailed(f"{NOT_KNOWN}so much that it may begin in other cells, as inputs are late", hint=_OTHER)
        squares, beside = {**known.acts.squares, _CHANNEL: np.ones(count)}, dict(known.acts.beside)
        for k, size in enumerate(off.values()):
            squares["input", k] = (np.sqrt(squares.get(("input", k), np.zeros(count))) + size) ** 2
            beside["input", k] = beside.get(("input", k), 0.0) + np.full(count, size)
        acts = replace(known.acts, squares=squares, beside=beside)
        found = replace(known, acts=acts, tubes=(*tubes, ({_CHANNEL: 1.0}, kicked)))
        ranges = replace(self.ranges, bounds=found, steps=self.ranges.steps + self.put_out)
        for name, each in self._largest(ranges).items():
            if (each / self.numbers.units[name] > np.minimum(self.sizes[name], self.numbers.largest)).any():
                raise CheckFailed(f"{NOT_KNOWN}{name} may get too large", hint=_OTHER)
        return found

    @property
    def fits(self) -> bool:
        """Whether all numbers stay where there is room for them."""
        with suppress(CheckFailed):
            return bool(self.bounds.tubes)
        return False

    def sentence(self, words: Words) -> str:
        """Return what is proved of the loop with this program, in the run."""
        both = (each.ends_below(self.controller) for each in (self.bounds, self.ranges.bounds))
        ends, real = (", ".join(words.limits(shown(each))) for each in both)
        of, own = f"{words.as_designed}{words.off_limits}", " and its own reference" * bool(self.given.shape[1])
        begins = "" if self.ranges.bounds.errors.starts is not None else ", from x = x̂ = x_d as the first input acts on"
        whole = isinstance(self.numbers, FixedPoint)
        kind, fits = (
            ("whole numbers of 32 bits", "no number leaves its range, and ") if whole else ("single floats", "")
        )
        return (
            f"In {kind}, in the run of its spec{begins}{of}: {fits}{ends} in the end, for any switching, between ticks "
            f"too, beside what is left of the start ({real} with real numbers{own})."
        )

    @property
    def proof(self) -> ClockedProof:
        """Of the loop that is sampled."""
        found = self.controller.claim(SampledLoop).proof
        assert found is not None
        return found

    def _kicked(self, tube: Tube) -> Tube:
        """Return a tube in units of what V^½ of it is at most by all kicks."""
        h, added = self.ranges.bounds.errors.gains.sample_time, 0.0
        for columns, sizes in self._kicks:
            added += float(np.sqrt(np.max([squares_in(Q.P, columns) for Q in tube.Q], axis=0)) @ sizes)
        level = added / (1 - np.sqrt(1 - tube.b) * np.exp(-tube.a / 2 * h)) * _OVER
        own = {each.name: getattr(tube, each.name) for each in fields(tube)}
        return _Kicked(**own | {"sizes": tuple(level * size for size in tube.sizes)}, level=level)

    @cached_property
    def _kicks(self) -> list[tuple[Array, Array]]:
        """By what z is kicked in each sample, as columns, and how often such columns at most together."""
        errors, (n, m, N, *_) = self.ranges.bounds.errors, self.ranges.bounds.errors.widths
        eye = np.eye(errors.order)
        predicted = [(eye[:, n + m + i * N :][:, :N], self.predicted) for i in range(errors.predicted)]
        (measured,) = corrected(errors, BallMatrix.of(np.eye(N)))
        return [*predicted, (measured.floats, self.corrected)]

    @cached_property
    def sizes(self) -> dict[str, Array]:
        """How large numbers may be, in units: those of ranges; v is (x̂, ŝ), known (ŝ, η̂, w, 1); what y is missed by."""
        of, most = self.numbers, self._largest(self.ranges)
        each = {name: self.room * size / of.units[name] + of.spare[name] for name, size in most.items()}
        v = np.concatenate([each["x_hat"], each["s_hat"]])
        return {
            **each,
            "v": v,
            "known": np.concatenate([each["s_hat"], each["eta_hat"], each["w"], [of.one]]),
            "missed": np.abs(of.program.C) @ (v * of.x) / of.units["y"] + each["y"],
        }

    @cached_property
    def predicted(self) -> Array:
        """By how much a prediction of one sample is off, (N,): in all substeps, with what other cells make of it."""
        of, sizes, program = self.numbers, self.sizes, self.numbers.program
        (m, n), N = program.K.shape, len(of.x)
        rounded = of.off("observer", np.concatenate([sizes["u"], sizes["v"], [of.one]])) + of.kept(sizes["v"])
        beside = np.zeros(N)
        if len(program.h):
            planes = of.off("normals", sizes["v"][:n]) + of.off("offsets", np.ones(1))
            contradicted = planes + planes.max()  # of the cell that is chosen, in units: the right one is by as much
            beside[:n] = beside_cells(program, contradicted * of.units["planes"])
        back = np.abs(program.observer[:, :, m : m + N]).max(axis=0) @ beside
        return np.asarray(program.substeps * (rounded * of.x + beside + back))

    @cached_property
    def corrected(self) -> Array:
        """By how much (x̂, ŝ) is off by correcting it, with y rounded as it is read, (N,)."""
        of, sizes = self.numbers, self.sizes
        missed = of.off("outputs", sizes["v"]) + of.kept(sizes["y"]) + of.kept(sizes["missed"])
        rounded = of.off("correction", sizes["missed"]) + of.kept(sizes["v"])
        return np.asarray(rounded * of.x + np.abs(of.program.M) @ (missed * of.units["y"]))

    @property
    def put_out(self) -> Array:
        """By how much u is off, (m,): by the law, and by x_d, η̂ and w as they are stepped."""
        return np.asarray(self.law + self._reference)

    @property
    def law(self) -> Array:
        """By how much u is off what the law makes of x̂, x_d, η̂ and w as they are, (m,)."""
        of, sizes = self.numbers, self.sizes
        counts = of.off("feedforward", sizes["known"]) + of.off("gain", sizes["x_hat"] + sizes["x_d"])
        return np.asarray((counts + of.kept(sizes["u"])) * of.units["u"])

    @cached_property
    def _stepped(self) -> tuple[dict[str, Array], dict[str, Array]]:
        """What the program that was proved, and that which runs, make of the reference along the run."""
        real = along(_reference_alone(self.proved), self.started, self.given)
        return real, self.numbers.along(_reference_alone(self.numbers.program), self.given)

    @cached_property
    def _reference(self) -> Array:
        """By how much u_ff − K x_d is off in the run, but for the last rounding, (m,): by stepping nothing else."""
        (real, made), count, each = self._stepped, len(self.given), list[Array]()
        loads = np.zeros((count, len(self.numbers.units["s_hat"])))
        for found, program in ((real, self.proved), (made, self.numbers.program)):
            known = np.hstack([loads, found["eta_hat"], found["w"], np.ones((count, 1))])
            u_ff = np.einsum("kmc,kc->km", program.u_ff[found["cell_d"]], known)
            each.append(u_ff - found["x_d"] @ self.proved.K.T)
        return np.asarray(np.abs(each[1] - each[0]).max(axis=0) * OVER_POWERS)

    def _largest(self, ranges: ProgramRanges) -> dict[str, Array]:
        """Return how large numbers get; where the reference is from outside, what it makes is seen."""
        found = largest(ranges, self.given)
        made = self._stepped[1] if self.given.shape[1] else {}
        return found | {
            name: np.maximum(found[name], np.abs(made[name]).max(axis=0)) for name in ("x_d", "eta_hat") if made
        }


def largest(ranges: ProgramRanges, given: Array) -> dict[str, Array]:
    """Return how large the numbers of a program get that are remembered; w where it is given as it is there."""
    most = {name: np.abs(ends).max(axis=1) for name, ends in ranges.ranges.items() if name != "u_ff"}
    return most | ({"w": np.abs(given).max(axis=0)} if given.shape[1] else {})


def _reference_alone(program: SampledController) -> SampledController:
    """Return a program of which x̂ and u stay as they are, while all else runs."""
    m, N = len(program.K), len(program.M)
    return replace(
        program,
        observer=np.zeros_like(program.observer) + np.eye(N, m + N + 1, m),
        M=np.zeros_like(program.M),
        E=np.zeros((0, m)),
        K=np.zeros_like(program.K),
        u_ff=np.zeros_like(program.u_ff),
        limits=np.tile([-np.inf, np.inf], (m, 1)),
        change=np.full(m, np.inf),
        quantum=np.zeros(m),
    )


def beside_cells(program: SampledController, off: Array) -> Array:
    """Return how far at most a point of a cell of x̂ is from any at which its planes are contradicted by `off`, (n,)."""
    found = np.zeros(program.H.shape[1])
    for signs in program.signs:
        planes = np.flatnonzero(signs)
        count = min(len(planes), program.H.shape[1])
        chosen = [each for size in range(1, count + 1) for each in combinations(planes.tolist(), size)]
        if len(chosen) > _MOST:
            raise CheckFailed(f"{NOT_KNOWN}a cell has more than {_MOST:,} sets of planes")
        for each in map(list, chosen):
            H = program.H[each]
            if np.linalg.matrix_rank(H) == len(each):
                found = np.maximum(found, np.abs(np.linalg.pinv(H)) @ off[each])
    return found * _OVER


def of_run(controller: ProvedController, code: Source, kind: Literal["float32", "int32"], given: Array) -> Rounding:
    """Return code in a run of its spec, in numbers of a kind; whole ones in units that their ranges just fit in.

    Raises OutsideTheory or CheckFailed for what is not made in whole numbers, or not proved.
    """
    program, ranges = code.program, next(iter(controller.claims_of(ProgramRanges)), None)
    estimated = any(bounds.errors.estimates is not None for bounds in controller.claims_of(SampledBounds))
    outside = {
        "the program is emulated, and nothing is proved of it": not program.sampling.corrects,
        "it makes y_d of set-points, whose ranges are not known": len(program.pace) > 0,
        "x_d or u_ff depend on estimates that are no constants at inputs": estimated,
    }
    for why, so in outside.items():
        if so:
            raise OutsideTheory(NOT_KNOWN + why, hint=_OTHER)
    if ranges is None:
        message = f"{NOT_KNOWN}between what its numbers are is not proved: see 'sampled loop' of the design"
        raise CheckFailed(message, hint=_OTHER)
    of_all: Any = {"controller": controller, "ranges": ranges, "given": given, "proved": runs(code.file)}
    of_all["started"] = started = code.file.started

    def within(room: float) -> Rounding:
        units = units_of(program, {name: _LESS * room * size for name, size in largest(ranges, given).items()})
        numbers: FixedPoint | SingleFloats = FixedPoint(program=program, units=units, starts=code.starts)
        if kind == "float32":
            spare = {name: 2.0**31 * unit for name, unit in units.items()}  # as much again
            numbers = SingleFloats(program=program, started=started, spare=spare)
        return Rounding(numbers=numbers, room=room, **of_all)

    *rooms, last = _ROOMS if kind == "int32" else _ROOMS[:1]
    return next(filter(lambda found: found.fits, map(within, rooms)), within(last))


def units_of(program: SampledController, most: dict[str, Array]) -> dict[str, Array]:
    """Return the units of a program whose numbers are at most so large."""
    limits = np.where(np.isfinite(program.limits), np.abs(program.limits), 0.0).max(axis=1)
    most["u"] = np.maximum(most["u"], limits)  # so that they are reached, where that is not proved to be never so
    x = np.maximum(most["x_hat"], most["x_d"])
    known = np.concatenate([most["s_hat"], most["eta_hat"], most["w"], [1.0]])
    units = {
        **{name: unit_of(most[name]) for name in ("s_hat", "eta_hat", "w", "u")},
        "x_hat": unit_of(x),
        "x_d": unit_of(x),
        "y": unit_of(np.abs(program.C) @ np.concatenate([x, most["s_hat"]]) + most["y"]),
        "planes": unit_of(np.abs(program.H) @ x + np.abs(program.h)),
        "guards": unit_of(np.abs(program.guards) @ known),
    }
    steps = program.quantum > 0
    halved = np.clip(np.floor(np.log2(program.quantum[steps] / units["u"][steps])), 0, 30)
    units["u"][steps] = program.quantum[steps] / 2.0**halved
    return units
