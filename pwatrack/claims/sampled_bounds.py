"""How large what is left of the errors of a sampled loop is: of each signal, in this run, between ticks too.

Along one solution the errors are linear in their start and in all that acts together. What the start leaves goes to 0;
what 1 of each channel of `control.sampled_disturbances` leaves is bounded by a tube of its own, and the mean square of
each, with the weights that the tube has for what is past, is enclosed all along the run. The sum of the products, and
what the nominal loop has, is a bound of each signal in every substep: from error 0 on, and with the start always.

Where a prediction begins and ends in one cell, moving drives nothing. A bound of how far x and x̂ are from x_d + e₀ says
in which substeps that is so; then less is driven, which makes that bound less, and so on.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from itertools import product
from math import ceil
from typing import Any, ClassVar, Self

import numpy as np

from pwatrack.arrays import CLOSE, OVER_POWERS, OVER_SUMS, Array, IntArray, rounded_up, up
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims import tube_text
from pwatrack.claims.bounds import in_ellipsoid
from pwatrack.claims.channel_text import channel_text, rounding
from pwatrack.claims.practical import Practical
from pwatrack.claims.sampled import SampledLoop, errors_of
from pwatrack.claims.sampled_start import from_start, is_start, of_this_start
from pwatrack.claims.tube_search import KINDS, TubeSearch
from pwatrack.claims.tube_text import Sizes, Tubes
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Seen, Told
from pwatrack.control.off_time import OffTime
from pwatrack.control.sampled_disturbances import SUMMED, Acting, across, level, shifted
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_search import work
from pwatrack.control.words import Words
from pwatrack.lmi.clocked import ClockedProof
from pwatrack.lmi.clocked_tubes import Tube

_ROUNDED = 1e-9  # of a time in ticks
_MOST = 300_000  # work of one proof times tubes that are looked for: an auditor decides each, in 10 steps for each
_LONGEST = 3e11  # tubes times the cube of the unknowns of each: two minutes
_ALONE = 4e6  # tubes of one each times the square of the unknowns: ten seconds; one of several leaves a tenth more
_CORNERS = 64  # of boxes of flows, up to which each is looked at for tubes: bounds are up to a half less then
_END = 10  # the end of a run is a tenth of it
_DIGITS = 4  # of what is told
_LOOKS = 30  # at where predictions may cross planes, at most
_Levels = Sequence[tuple[Sizes, Sequence[tuple[Array, Tube]]]]  # V^½ of the tubes of what acts, in each substep, (K,)


@dataclass(frozen=True, kw_only=True)
class TubeBounds(Claim):
    """Tubes for all that acts in a run, of the plant as designed or of others."""

    errors: SampledErrors = field(repr=False)  # of the loop with its program
    acts: Acting = field(repr=False)  # on them in the run
    tubes: Tubes  # those that are proved, each of one channel or of several together
    forms: tuple[Form, ...]  # what the sizes of a tube are of

    KEY: ClassVar[str]

    @classmethod
    def known(cls, controller: ProvedController, asked: Asked) -> Iterator[tuple[ClockedProof, SampledErrors, Acting]]:
        """Yield the proof of the loop, its errors and what acts on them, where these are known."""
        raise NotImplementedError

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator[Self]:
        """Yield the bounds, where the sampled loop is proved and it is known what acts."""
        before = None if told is None else tube_text.read(told[cls.KEY])
        for proof, errors, acts in cls.known(controller, asked):
            found = cls(errors=errors, acts=acts, tubes=(), forms=tuple(seen(controller)))
            if before is not None:
                yield found._told(*before)
                continue
            few, opened = found._sought(proof)
            if opened is not None:
                search = TubeSearch.of(controller, found.forms, opened, proof)
                found = replace(found, tubes=tuple(search.together(acts) if few is None else search.tubes(few)))
            yield found

    def _sought(self, proof: ClockedProof) -> tuple[Acting | None, SampledErrors | None]:
        """Return for which of what acts tubes are looked for, all if not said, and with which boxes; none is too much.

        All have one each, or but one each, or none for the start, from which nothing is said then, or one together.
        """
        acts, opened = self.acts, replace(self.errors, few=_CORNERS)
        few = replace(acts, means={one: each for one, each in acts.means.items() if one[0] in SUMMED})
        last = replace(few, squares={one: each for one, each in acts.squares.items() if one[0] != "start"})
        unknowns = len(proof.P) * self.errors.order * (self.errors.order + 1) // 2
        for each, errors in product((acts, few, None, last), (opened, self.errors)):
            tubes = KINDS if each is None else len([*each.squares, *each.means])
            quick = each is None or tubes * unknowns**2 <= _ALONE
            if quick and tubes * work(errors) <= _MOST and tubes * unknowns**3 <= _LONGEST:
                return each, errors
        return None, None

    def _told(self, entries: Sequence[tuple[Sizes, Tube]], starts: Mapping[Channel, Any]) -> Self:
        """Return the bounds with the tubes, and the start, of a certificate."""
        same, errors = of_this_start(starts, self.errors)
        tubes = dict[Any, tuple[Sizes, tuple[Tube, ...]]]()
        for whole, tube in entries:
            of = {channel: size for channel, size in whole.items() if same or channel[0] != "start"}
            if not of:
                continue
            if not of.keys() <= self.acts.squares.keys():
                raise ValueError("a tube is of something that does not act")
            if not tube.summed and any(kind == "swap" for kind, _ in of):
                raise ValueError("what u is off its time is summed")
            key = tuple(whole.items())
            tubes[key] = of, (*tubes.get(key, (of, ()))[1], tube)
        return replace(self, errors=errors, tubes=tuple(tubes.values()))

    def data(self, controller: ProvedController) -> dict[str, Any]:
        each = ((of, tube) for of, tubes in self.tubes for tube in tubes)
        return {self.KEY: list(tube_text.told(each, self.forms, self.errors.starts or ()))}

    @property
    def covered(self) -> set[Channel]:
        """All channels that have a tube, alone or together."""
        return {channel for of, _ in self.tubes for channel in of}

    def ends_below(self, controller: ProvedController) -> dict[Form, float]:
        """Return below what each signal is in the end of the run, if what its start left is gone.

        That is its last tenth, or the last period of the reference where that is longer. What processors may round
        otherwise is no less, see `CLOSE`.
        """
        last, sizes = self._last(controller), controller.sizes
        of = {"output": sizes.tracked, "state": sizes.state, "input": sizes.input, "estimate": sizes.state}
        least = {form: CLOSE * float(of[form[0]][form[1]]) for form in self.from_zero}
        ends = {form: float(most[last].max()) for form, most in self.from_zero.items()}
        return {form: rounded_up(max(most, least[form]) if most else 0.0, _DIGITS) for form, most in ends.items()}

    def ends_by(self, controller: ProvedController, form: Form) -> dict[Channel, float]:
        """Return what each channel leaves of a signal there at most; of those with one tube the share of it."""
        k, last, found = self.forms.index(form), self._last(controller), dict[Channel, float]()
        for of, each in self._settled or ():
            most = min(float((V[last] * one.sizes[k]).max()) for V, one in each)
            parts = {one: self._alone(one, size, each[0][1])[last].max() for one, size in of.items()}
            total = sum(parts.values())
            found |= {one: most * float(part / total) for one, part in parts.items() if part > 0}
        return found

    def _alone(self, channel: Channel, size: float, tube: Tube) -> Array:
        """Return the part that a channel has of V, or V^½ of what is summed, in each substep, (K,)."""
        V = level(self.acts.together({channel: size}, tube, {}), tube, self.errors.gains)
        return V if tube.summed else V**2

    def _last(self, controller: ProvedController) -> slice:
        """Return the substeps of the end of the run."""
        step, count = self.errors.gains.sample_time / self.errors.gains.substeps, len(self.acts.near)
        period = ceil((controller.trajectory.exosystem.period or 0.0) / step)
        return slice(-max(count // _END, period) - 1, None)

    @cached_property
    def from_zero(self) -> dict[Form, Array]:
        """What each signal is at most in each substep, (K,), from error 0 on; nothing where something has no tube."""
        return self._total(self._settled)

    @cached_property
    def from_start(self) -> dict[Form, Array]:
        """The same from the start of the run on; nothing where that is not known, or has no tube."""
        return {} if self.errors.starts is None else self._total(self._looked(start=True), start=True)

    @cached_property
    def _settled(self) -> _Levels | None:
        """V^½ of each tube in each substep, from error 0 on, with predictions crossing planes where they may."""
        return self._looked(start=False)

    def _looked(self, *, start: bool) -> _Levels | None:
        where = np.ones((2, len(self.acts.near)), dtype=bool)
        planes, of = self.acts.planes, self.errors
        rows = (self.acts.near, across(of, planes)), (self.acts.apart, shifted(of, planes))
        for _ in range(_LOOKS):
            levels = self._levels(where, start=start)
            near = np.array([(least <= self._off(levels, each)).any(axis=1) for least, each in rows])
            if (near >= where).all():
                break
            where = near & where
        return levels

    @cached_property
    def anywhere(self) -> dict[Form, Array]:
        """The same where a prediction may cross planes at any time: to be added to what the start leaves."""
        return self._total(self._everywhere)

    @property
    def idle(self) -> bool:
        """Whether nothing acts in the run."""
        acts = any(kind != "start" for kind, _ in self.acts.squares)
        return not acts and not any(each.any() for each in self.acts.beside.values())

    @property
    def noise(self) -> Array:
        """How much is measured off at most at any tick, (q,)."""
        return self.acts.noise(len(self.errors.plant.C))

    def taken(self, inputs: Sequence[int], rows: Array) -> tuple[Array, Array]:
        """Return how far off u_ff all that acts takes some inputs at most, from error 0 on, for any switching.

        Then by how much it changes them from one tick to the next at most, with all that they change by along x_d, from
        0 on. It is for the loop without limits; `rows` read them off z, less estimates of loads, so that loads that
        step, and are in no start, are added. Before the first input acts none is taken.
        """
        first = self.errors.gains.delay * self.errors.gains.substeps
        at = np.array(self.errors.plant.load_inputs, dtype=np.int64)
        most = self.off(rows) + [self.acts.loads[: len(at)][at == k].sum() for k in inputs]
        beside = [self.acts.beside.get(("input", k), np.zeros(1))[first:].max(initial=0.0) for k in inputs]
        return (most + beside) * OVER_SUMS, (2 * most + self.acts.changes[list(inputs)]) * OVER_SUMS

    def off(self, rows: Array, *, start: bool = False) -> Array:
        """Return what all that acts makes of other rows of z at most, (s,), for any switching.

        That is from error 0 on, or from the start of the run.
        """
        levels = self._levels(np.ones((2, len(self.acts.near))), start=True) if start else self._everywhere
        return np.asarray(self._sum(levels, len(rows), lambda one: one.spread(rows)).max(axis=0))

    @property
    def begun(self) -> Array | None:
        """Where the run is as its first input acts, if that is late, known, and not on x_d, (order, k)."""
        starts = self.errors.starts
        return np.hstack([column.floats for column in starts]) if starts and self.acts.late is not None else None

    @cached_property
    def _everywhere(self) -> _Levels | None:
        """V^½ of each tube in each substep, where predictions may cross planes at any time, from error 0 on."""
        return self._levels(np.ones((2, len(self.acts.near))))

    def _levels(self, where: Array, *, start: bool = False) -> _Levels | None:
        """Return V^½ of each tube in each substep, where predictions, and x_d by estimates, cross planes at most.

        None where something has no tube.
        """
        found, left = list[tuple[Sizes, list[tuple[Array, Tube]]]](), {*self.acts.squares}
        left = left if start else {one for one in left if one[0] != "start"}
        acting = {"moved": where[0], "drawn": where[1], "cell": where[1], "eta": where[1]}
        for whole, tubes in self.tubes:
            of = {one: size for one, size in whole.items() if one in left}
            if ("rounding", 0) in of:
                found.append((of, [(np.sqrt(self.acts.squares["rounding", 0]), tube) for tube in tubes]))
            elif of:
                each = ((self.acts.together(of, tube, acting), tube) for tube in tubes)
                found.append((of, [(level(d, tube, self.errors.gains), tube) for d, tube in each]))
            left -= of.keys()
        return None if left else found

    def _off(self, levels: _Levels | None, rows: Array) -> Array:
        """Return what some rows (A, P, order) read off z at most, the largest of each A, (K, P)."""
        if not len(rows):
            return np.full((len(self.acts.near), rows.shape[1]), -1.0)
        flat = np.concatenate(rows)
        each = self._sum(levels, len(flat), lambda one: one.spread(flat))
        return np.asarray(each.reshape(len(each), *rows.shape[:2]).max(axis=1))

    def _total(self, levels: _Levels | None, *, start: bool = False) -> dict[Form, Array]:
        """Return what signals are at most in each substep; from the start on with what is before the first input."""
        if levels is None:
            return {}
        beside, late = dict(self.acts.beside), self.acts.late if start else None
        for form, first in late.beside.items() if late is not None else ():
            beside[form] = np.append(first, beside.get(form, np.zeros(len(self.acts.near)))[len(first) :])
        most = self._sum(levels, len(self.forms), lambda one: np.array(one.sizes))
        return {form: each + beside.get(form, 0.0) for form, each in zip(self.forms, most.T, strict=True)}

    def _sum(self, levels: _Levels | None, count: int, sizes: Callable[[Tube], Array]) -> Array:
        """Return what all channels leave of so many signals in each substep, (K, s); ∞ where one has no tube."""
        total = np.full((len(self.acts.near), count), np.inf if levels is None else 0.0)
        for _, each in levels or ():
            total = total + reduce(np.minimum, (V[:, None] * sizes(one) for V, one in each))
        return np.asarray(total * OVER_SUMS)

    def allows(self, controller: ProvedController, seen: Seen) -> dict[Form, Array]:
        """Return how large each signal of the sampled loop may be: what all leaves, and what the start does.

        Between ticks what is bounded is what the program predicts, and x̂ is what it was at the last tick: of x̂ − x
        nothing is returned where not all samples are at ticks.
        """
        n, gains = len(controller.plant.B), self.errors.gains
        if gains.delay or not (seen.sampled and self.anywhere):
            return {}  # what waits at the start is not seen
        times, firsts = seen.t / gains.sample_time, self._firsts(seen.start[:n], seen.start[n:])
        passed = np.maximum(seen.t - gains.jitter / 2, 0.0)  # by the program's time at least
        most = dict.fromkeys(self.anywhere, np.full(len(seen.t), np.inf))
        for one in (one for _, each in self.tubes for one in each):
            size = max(in_ellipsoid(one.Q[0], z) for z in firsts)
            ticks = np.floor(passed / gains.sample_time * (1 - _ROUNDED))
            fallen = np.exp(-one.a / 2 * passed + np.log1p(-one.b) / 2 * ticks)
            for form, each in zip(most, one.sizes, strict=True):
                most[form] = np.minimum(most[form], each * size * OVER_POWERS * fallen)
        at, near = np.floor(times * gains.substeps).astype(np.int64), 1 + OffTime.of(gains).near
        ticking = not gains.jitter and (np.abs(times - np.rint(times)) <= _ROUNDED * np.maximum(times, 1.0)).all()
        told = {form: each for form, each in self.anywhere.items() if ticking or form[0] != "estimate"}
        found = {form: _around(each, at, near) + most[form] for form, each in told.items()}
        if self.from_start and is_start(self.errors, seen.start, self.noise):
            found |= {form: np.minimum(found[form], _around(self.from_start[form], at, near)) for form in found}
        return found

    def _firsts(self, e: Array, delta: Array) -> list[Array]:
        """Return what z may be after the tick at t = 0, (order,) each, for x less the x_d of the program."""
        errors, of = self.errors, self.errors.estimates
        if of is not None:
            e = e + of.X.floats @ delta[len(e) :]
        columns = (BallMatrix.of(v[:, None], (len(v), 1)) for v in (e, delta, np.zeros(0 if of is None else of.eta)))
        rho = np.zeros(errors.R.shape[0])
        each = ((nu.floats[:, 0], rest.floats[:, 0]) for nu, rest in errors.put_out(*columns))
        return [np.concatenate([e, nu, delta, rho, rest]) for nu, rest in each]

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        ends = self.ends_below(controller)
        acts = self._acting(words, controller)
        never = {form: rounded_up(float(each.max()), _DIGITS) for form, each in self.from_start.items()}
        return {
            self.KEY: {
                "acts": {name: {"at_most": size, "unit": unit} for name, size, unit in acts.values()},
                "per_1": {
                    acts[channel][0]: {
                        words.signal(form)[0]: most / size for form, most in zip(self.forms, one.sizes, strict=True)
                    }
                    for of, (one, *_) in self.tubes
                    for channel, size in of.items()
                    if channel in acts
                },
                **{
                    key: {
                        name: {"bound": size, "unit": unit}
                        for (name, unit), size in ((words.signal(form), size) for form, size in sizes.items())
                    }
                    for key, sizes in (("ends_below", ends), ("never_above", never))
                },
            }
        }

    def _acting(self, words: Words, controller: ProvedController) -> dict[Channel, tuple[str, float, str]]:
        """Return what acts, but for a start: in words, its size, and its unit."""
        found = dict[Channel, tuple[str, float, str]]()
        for channel, squares in self.acts.squares.items():
            if channel[0] != "start":
                name, unit = channel_text(channel, self.errors, words, controller)
                size = max(float(np.sqrt(squares.max())), rounding(channel, self.errors, controller))
                found[channel] = name, rounded_up(size, _DIGITS), unit
        return found


@dataclass(frozen=True, kw_only=True)
class SampledBounds(TubeBounds):
    """Those of the plant as designed."""

    statement: ClassVar[str] = (
        "Under sampled_bounds: from z = 0 on, in the loop under sampled, what 1 of a channel at most can make of each "
        "signal: of a disturbance of a state equation, of what is merged, as under practical, of what is measured off "
        "at ticks, of the steps of u and of what a program in another cell puts out, beside nu, and makes of eta_hat, "
        "at ticks, of what a load steps by just before a tick, which s_hat - s loses, as x - x_d does what x_d moves "
        "by, of a start, what it tells of z before the first tick, or that of the first late input, of what drives x - "
        "x_d alone as x_d moves in a sample, of what R x_nom moves in a substep, beside every rho, and of R (x_nom - "
        "x_d), which acts by F less F "
        "of the mean of the A_i that have all others in their hull; where x_d depends on loads, eta_hat is held "
        "against that of the program with the true ones. x_nom is x in the loop of that mean, from x_d on, without "
        "noise, and z here is less what it is there. Where ticks are off their times, x is less x_nom at the time as "
        "it passes, and x_hat_i less x_nom at that of the program; then a swap is what u is there less what it is "
        "here, predicted what else drives the i-th x_hat_i - x in its k-th row, at i n + k, and nominal at p + k what "
        "F less F of the mean has of p rows beside, by that mean, as the time between ticks differs. With Q linear "
        "in time between the knots of each substep, q V of "
        "what it is beside, and g and h how it acts between ticks, at the middle of a box, and at ticks, c Q c^T <= "
        "size^2 at all knots, -(Q_k+1 - Q_k) / step + F Q_e + Q_e F^T + a Q_e + U T_e U^T + Q_e V^T T_e^-1 V Q_e + r "
        "r^T / (a - q^T T_e^-1 q) < 0 with r = g + Q_e V^T T_e^-1 q at both ends e of each segment, J Q_N J^T / (1 - "
        "b) + h h^T / b < Q_0 at ticks, and J Q_N J^T < Q_0 at the ends of substeps: so z^T Q^-1 z is at most a mean "
        "of d^2, with weights that fall as e^(-a t), or by 1 - b at ticks. With summed, in place of the terms with r "
        "and h, g g^T < Q_e at all knots, for g at all corners, or h h^T < Q_0: so the root of z^T Q^-1 z is at most "
        "the integral of |d|, with weights that fall as e^(-a t / 2), or the sum, with weights that fall by the root "
        "of 1 - b. Where several have one tube, d^2 is the sum of the squares of what each is of its size, with the "
        "matrices of all their columns times these sizes for g, h and q, and (a I - q^T T_e^-1 q)^-1 between g and "
        "g^T; summed is the root of it."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"sampled_bounds": []}
    KEY: ClassVar[str] = "sampled_bounds"

    @classmethod
    def known(cls, controller: ProvedController, asked: Asked) -> Iterator[tuple[ClockedProof, SampledErrors, Acting]]:
        for loop in controller.claims_of(SampledLoop):
            if loop.proof is not None:
                merged = (merge for claim in controller.claims_of(Practical) for merge in claim.merges)
                deviations = [(merge.column, float(np.nextafter(float(merge.largest), np.inf))) for merge in merged]
                errors = replace(errors_of(controller, loop.gains), deviations=deviations)
                acts = asked.acting(controller, errors)
                if acts is not None:
                    yield loop.proof, *from_start(controller, asked, errors, acts)

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        each = dict[tuple[str, str], float]()  # of several that have one name the largest
        for name, size, unit in self._acting(words, controller).values():
            each[name, unit] = max(size, each.get((name, unit), 0.0))
        acts = ", ".join(f"{name} up to {up(size)} {unit}".rstrip() for (name, unit), size in each.items())
        ends = ", ".join(words.limits(shown(self.ends_below(controller))))
        off = words.as_designed + words.off_limits
        most = self.from_start or self.from_zero
        always = words.limits(shown({form: float(each.max()) for form, each in most.items()}))
        begins = "from the start of this run on" if self.from_start else "from x = x̂ = x_d on"
        never = f"{begins} never more than {', '.join(always)}{off}"
        if self.idle:
            late = " from its first input on" * bool(self.errors.gains.delay)
            yield "in this run", f"nothing acts on the sampled loop{late}: its errors go to 0, but for rounding{off}"
            if late and self.from_start:
                yield "", never
        elif ends:
            said = f"{ends} in the end in the sampled loop, for any switching, between ticks too"
            yield "in this run", f"{said}, beside what is left of the start{off}"
            if self.from_start or not self.errors.gains.delay:
                yield "", never
            yield "", f"that is what these leave, as they act in this run: {acts or 'u_ff as it is held'}"
        else:
            proof = controller.claim(SampledLoop).proof
            tried = "found" if proof and self._sought(proof)[1] else "looked for, which takes too long,"
            yield "in this run", f"no bound was {tried} for what these leave in the sampled loop: {acts}"


def _around(most: Array, at: IntArray, near: int) -> Array:
    """Return the largest of some substeps and of so many beside: of a sample on a tick rounding says which it is."""
    last = len(most) - 1
    return np.asarray(np.max([most[np.clip(at + k, 0, last)] for k in range(-near, near + 1)], axis=0))


def shown(sizes: Mapping[Form, float]) -> Iterator[tuple[Form, float]]:
    """Yield what is told of signals: of inputs and of what is tracked."""
    return ((form, size) for form, size in sizes.items() if form[0] != "estimate")


def seen(controller: ProvedController) -> Iterator[Form]:
    """Yield the signals that are bounded: what is tracked, errors of the prediction; inputs if no load moves x_d."""
    n, m = controller.plant.B.shape
    tracked = controller.tracking
    yield from ((tracked, k) for k in range(n if tracked == "state" else len(controller.plant.tracked)))
    if controller.compensation.alone:
        yield from (("input", k) for k in range(m))
    yield from (("estimate", k) for k in range(n))
