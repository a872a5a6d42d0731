"""How large what is left of the errors of a sampled loop is: of each signal, in this run, between ticks too.

Along one solution the errors are linear in their start and in all that acts together. What the start leaves goes to 0;
what 1 of each channel of `control.sampled_disturbances` leaves is bounded by a tube of its own, and how large each gets
in the run is enclosed. The sum of the products is a bound of each signal in the end, and with the start at all times.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, Context
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import OVER_POWERS, OVER_SUMS, Array, up
from pwatrack.ball_matrix import above
from pwatrack.claims.bounds import in_ellipsoid
from pwatrack.claims.exact_text import decimal, double, packed, read_channel, read_signals, signals, whole
from pwatrack.claims.sampled import SampledLoop
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Seen
from pwatrack.control.sampled_disturbances import driven, row
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.words import Words
from pwatrack.lmi.clocked import ClockedProof
from pwatrack.lmi.clocked_tubes import Tube, tube
from pwatrack.lmi.exact import Packed, rounded_down
from pwatrack.lmi.tube_program import TubeProgram
from pwatrack.rational import floats

_BESIDE = 0.01  # of the weight of what is tracked, in sizes: that of inputs and of other signals
_ROUNDED = 1e-9  # of a time in ticks
_SHARES = (0.5, 0.25, 0.1)  # of the rate that vertices have by themselves: what tubes decay with, until one is found
_MORE = (1.6, 2.0)  # times that, as long as bounds get less


@dataclass(frozen=True, kw_only=True)
class SampledBounds(Claim):
    """Tubes for all that acts in a run.

    Attributes:
        errors: Of the loop with its program.
        acts: How large each channel gets in the run, and none where that is not known; but for those that are 0.
        tubes: What 1 of each of these leaves: those that are proved.
        signals: What the sizes of a tube are of.
    """

    errors: SampledErrors = field(repr=False)
    acts: Mapping[Channel, float]
    tubes: Mapping[Channel, Tube]

    statement: ClassVar[str] = (
        "Under sampled_bounds: from z = 0 on, in the loop under sampled, what 1 of a channel at most can make of each "
        "signal: of a disturbance of a state equation, of what is measured off at ticks, of u off what it is meant to "
        "be, beside nu, and of R (x_d - x_d at p), beside rho. With Q linear in time between the knots of each "
        "substep and g and h how it acts between ticks and at them, c Q c^T <= size^2 at all knots, "
        "-(Q_k+1 - Q_k) / step + F Q_e + Q_e F^T + a Q_e + g g^T / a < 0 at both ends e of each segment, "
        "J Q_N J^T / (1 - b) + h h^T / b < Q_0 at ticks, and J Q_N J^T < Q_0 at the ends of substeps."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"sampled_bounds": []}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked) -> Iterator["SampledBounds"]:
        """Yield the bounds, where the sampled loop is proved and it is known what acts."""
        for proof, errors, acts in _known(controller, asked):
            yield cls(errors=errors, acts=acts, tubes=dict(_tubes(controller, errors, proof, list(acts))))

    @classmethod
    def read(cls, content: Mapping[str, Any], controller: ProvedController, asked: Asked) -> Iterator["SampledBounds"]:
        """Yield what was proved."""
        told = content["sampled_bounds"]
        tubes = {read_channel(entry["channel"]): _read_tube(entry) for entry in told}
        for _, errors, acts in _known(controller, asked):
            if not tubes.keys() <= acts.keys():
                raise ValueError("a tube is of something that does not act")
            yield cls(errors=errors, acts=acts, tubes=tubes)

    def data(self, controller: ProvedController) -> dict[str, Any]:
        """Return the tubes."""
        forms = list(seen(controller))
        entries = [
            {
                "channel": list(channel),
                "a": decimal(one.a),
                "b": decimal(one.b),
                "Q": [packed(Q.integers, Q.exponents) for Q in one.Q],
                "signals": signals(zip(forms, one.sizes, strict=True)),
            }
            for channel, one in self.tubes.items()
        ]
        return {"sampled_bounds": entries}

    def ends_below(self, controller: ProvedController) -> dict[Form, float]:
        """Return below what each signal ends in the run; nothing where something acts that has no tube."""
        if self.tubes.keys() != self.acts.keys():
            return {}
        total = dict.fromkeys(seen(controller), 0.0)
        for channel, size in self.acts.items():
            for form, each in zip(total, self.tubes[channel].sizes, strict=True):
                total[form] += each * size
        for form in total:
            beside = self.acts.get(("input", form[1]), 0.0) if form[0] == "input" else 0.0
            total[form] = (total[form] + beside) * OVER_SUMS
        return total

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        """Yield what acts, and what it leaves."""
        acts = ", ".join(f"{name} up to {up(size)} {unit}".rstrip() for (name, unit), size in self._named(words))
        shown = ((form, size) for form, size in self.ends_below(controller).items() if form[0] != "estimate")
        ends = ", ".join(words.limits(shown))
        if not acts:
            yield "in this run", "nothing acts on the sampled loop: its errors go to 0, but for rounding"
        elif ends:
            yield "in this run", f"{ends} in the end in the sampled loop, for any switching, between ticks too"
            yield "", f"that is what these leave, as large as they get in this run: {acts}"
        else:
            yield "in this run", f"no bound was found for what these leave in the sampled loop: {acts}"

    def allows(self, controller: ProvedController, seen: Seen) -> dict[Form, Array]:
        """Return how large each signal of the sampled loop may be: what all leaves, and what the start does."""
        ends, n = self.ends_below(controller), len(controller.plant.B)
        if not (seen.sampled and ends):
            return {}
        e, delta, h = seen.start[:n], seen.start[n:], self.errors.gains.sample_time  # after the tick at t = 0
        rho = np.zeros(self.errors.R.shape[0])
        first = np.concatenate([e, self.errors.gains.K @ (e + delta[:n]), delta, rho])
        most = dict.fromkeys(ends, np.full(len(seen.t), np.inf))
        for one in self.tubes.values():
            size, ticks = in_ellipsoid(one.Q[0], first) * OVER_POWERS, np.floor(seen.t / h * (1 - _ROUNDED))
            fallen = np.exp(-one.a / 2 * seen.t + np.log1p(-one.b) / 2 * ticks)
            for form, each in zip(most, one.sizes, strict=True):
                most[form] = np.minimum(most[form], each * size * fallen)
        return {form: size + most[form] for form, size in ends.items()}

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        """Return what acts, what 1 of it leaves of each signal, and what all of it does."""
        ends, forms = self.ends_below(controller), list(seen(controller))
        acts = dict(zip(self.acts, self._named(words), strict=True))
        return {
            "sampled_bounds": {
                "acts": {name: {"at_most": size, "unit": unit} for (name, unit), size in acts.values()},
                "per_1": {
                    acts[channel][0][0]: {
                        words.signal(form)[0]: size for form, size in zip(forms, one.sizes, strict=True)
                    }
                    for channel, one in self.tubes.items()
                },
                "ends_below": {
                    name: {"bound": size, "unit": unit}
                    for (name, unit), size in ((words.signal(form), size) for form, size in ends.items())
                },
            }
        }

    def _named(self, words: Words) -> Iterator[tuple[tuple[str, str], float]]:
        """Yield what acts in words, with its unit, and its size."""
        plant, units = words.plant, words.units
        for (kind, k), size in self.acts.items():
            if kind == "input":
                yield (f"{plant.inputs[k]} off {plant.inputs[k]}_ff", units.get(plant.inputs[k], "")), size
            elif kind == "moved":
                rows = zip(self.errors.R.texts[k], plant.states, strict=True)
                entries = [(v, name) for v, name in rows if v != "0"]
                terms = [f"{name}_d" if v == "1" else f"({v}) {name}_d" for v, name in entries]
                yield (f"{' + '.join(terms)} moving in a substep", units.get(entries[0][1], "")), size
            else:
                yield words.cause((kind, k))[1:], size


def seen(controller: ProvedController) -> Iterator[Form]:
    """Yield the signals that are bounded: what is tracked, inputs, errors of the prediction."""
    n, m = controller.plant.B.shape
    tracked = controller.tracking
    yield from ((tracked, k) for k in range(n if tracked == "state" else len(controller.plant.tracked)))
    yield from (("input", k) for k in range(m))
    yield from (("estimate", k) for k in range(n))


def _known(
    controller: ProvedController, asked: Asked
) -> Iterator[tuple[ClockedProof, SampledErrors, Mapping[Channel, float]]]:
    """Yield the proof of the sampled loop, its errors and what acts on them, where these are known."""
    for loop in controller.claims_of(SampledLoop):
        if loop.proof is not None and asked.acting is not None and not (loop.gains.delay or loop.gains.jitter):
            errors = SampledErrors.of(controller.plant, loop.gains)
            acts = asked.acting(controller, errors)
            if acts is not None:
                yield loop.proof, errors, {channel: _above(size) for channel, size in acts.items()}


def _tubes(
    controller: ProvedController, errors: SampledErrors, proof: ClockedProof, channels: Sequence[Channel]
) -> Iterator[tuple[Channel, Tube]]:
    """Yield a tube for each channel that one is proved for; with what the first of them decays with best."""
    system, forms = errors.clocked, list(seen(controller))
    program = TubeProgram(system=system, near=floats(proof.P[0].P), knots=len(proof.P) // system.parts - 1)
    rows, weights, share = above(*(row(errors, form) for form in forms)), _weights(controller, forms), 0.0

    def at(channel: Channel, share: float) -> tuple[float, float, Tube] | None:
        found = tube(program, driven(errors, channel), rows, weights, rounded_down(share * program.most, 3))
        return None if found is None else (float(weights @ np.square(found.sizes)), share, found)

    for channel in channels:
        best = next(filter(None, (at(channel, one) for one in ([share, *_SHARES] if share else _SHARES))), None)
        if best is None:
            continue
        first = best[1]
        for factor in () if share else _MORE:
            more = at(channel, factor * first)
            if more is None or more[0] > best[0]:
                break
            best = more
        _, share, found = best
        yield channel, found


def _weights(controller: ProvedController, forms: list[Form]) -> Array:
    """Return what the square of each signal counts: of what is tracked, in sizes, most."""
    sizes = controller.sizes
    of = {"output": sizes.tracked, "state": sizes.state, "input": sizes.input, "estimate": sizes.state}
    each = ((1.0 if kind == controller.tracking else _BESIDE) / of[kind][k] ** 2 for kind, k in forms)
    return np.array(list(each))


def _above(size: float) -> float:
    """Return a number of four digits, not smaller: two processors enclose the same."""
    return float(Context(prec=4, rounding=ROUND_CEILING).create_decimal(size))


def _read_tube(entry: Any) -> Tube:
    return Tube(
        Q=tuple(Packed(**whole(Q)) for Q in entry["Q"]),
        a=double(entry["a"]),
        b=double(entry["b"]),
        sizes=tuple(size for _, size in read_signals(entry["signals"])),
    )
