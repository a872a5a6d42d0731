"""A simulated loop, and how it ended: it tracks, is off, grows without bound, or contradicts its own proof."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.linalg import matrix_balance

from pwatrack.arrays import EPS, OVER_SUMS, Array, amount
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.practical import Practical
from pwatrack.claims.robust import Robust
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import ProvedController, Seen
from pwatrack.errors import ExitCode
from pwatrack.real import Box
from pwatrack.simulation.closed_loop import ClosedLoop, Response
from pwatrack.simulation.figures import ERRORS, Figures
from pwatrack.simulation.layout import Actuator, RateLimit
from pwatrack.simulation.propagate import sample_count
from pwatrack.simulation.steady_state import SteadyState
from pwatrack.simulation.trace import Trace, TraceOnDisk, Unresolved, tenths
from pwatrack.spec.spec import Spec
from pwatrack.workflow.bands import Along, bands, covered, limited, start_of_errors, tube_bounds
from pwatrack.workflow.tracking import reference_remarks, start_remarks

Kind = Literal["tracks", "within its bound", "off", "grows", "above its bound"]

_TRACKS = 0.01  # of the size of reference and start: what is left of an error then is small
_ROUNDING = 8 * EPS  # signals are known to about eps ‖F‖ T of their size, measured: 1.1 times that
_RISE = 1.5  # over the first half of the run: the largest of noise or of a steady oscillation does not differ as much
_STEADY = (1.1, 7)  # likewise, where each of so many last tenths is above the one before: noise, once in 5,000 runs
_FADING = 0.9  # e^(−t/τ) falls to it in three tenths of a run of 0.35 τ: a shorter run tells nothing


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a simulation ended."""

    # in a word. "tracks": in the last tenth of the time no entry of the error is above 1 % of the size of its reference
    # and start, or of its largest size where these are 0. "within its bound": cells are merged, and the norm of the
    # error then is below what it is proved to end below. "off": neither. "grows": an error does, see `grows`, or the
    # desired trajectory. "above its bound": the loop is the one that the proofs are about, and an error is larger than
    # they allow.
    kind: Kind
    text: str  # in words and figures
    final: str = ""  # the norm of the error in the last tenth of the time at most, with its unit
    largest: str = ""  # and at any time
    worst: str = ""  # of several entries of an error that is off the one that is so most, with its unit
    rounded: float = 0.0  # what the simulation is uncertain by in that norm

    @property
    def code(self) -> ExitCode:
        """What the shell sees."""
        return ExitCode.DONE if self.kind in ("tracks", "within its bound", "off") else ExitCode.CHECK_FAILED


def grows(high: Array, low: Array, size: float) -> bool:
    """Say whether a signal grows without bound, as far as a finite trace can tell.

    Its largest size in the last tenth of the time is above that in every tenth before and above `size`; it is at least
    half more than in the first half, which noise and steady oscillations do not do by chance, or a tenth more where it
    rises from each of the last seven tenths to the next; and on the side where it is largest, the last three tenths add
    no less than nine tenths of what the three before them added, so that it does not settle.

    `high` and `low` are the largest and smallest value in each tenth of the time, (10,); `size` is that of what it may
    be anyway: reference and start, in the unit of the signal.
    """
    if not np.isfinite([high, low]).all():
        return False  # less than ten samples
    each = np.maximum(high, -low)
    largest = np.maximum.accumulate(each)
    side = np.maximum.accumulate(high if high[-1] >= -low[-1] else -low)
    slowly, tenths_of_it = _STEADY
    least = slowly if (np.diff(each[-tenths_of_it:]) > 0).all() else _RISE
    rises = largest[9] > largest[8] and largest[9] >= least * largest[4]
    return bool(largest[9] > size and rises and side[9] - side[6] >= _FADING * (side[6] - side[3]))


class RunMonitor:
    """Looks at a run of so many samples block by block, to say in the end how it went; the box is of parameters."""

    def __init__(self, loop: ClosedLoop, samples: int, *, units: Mapping[str, str], box: Box = ()) -> None:
        self._loop, self._units, self._tracked = loop, units, loop.controller.tracking
        self._names = loop.controller.error_names
        self._edges, self._number = tenths(samples), 0
        self._high = np.full((10, len(self._names)), -np.inf)  # of each error, in each tenth of the time
        self._low = -self._high
        self._reference = np.zeros(len(self._names))
        self._scale, self._speed = _balanced(loop)
        self._size = 0.0  # of the largest state so far, balanced
        self._acting: dict[Channel, float] = {}  # largest size of each disturbance and noise so far
        self._first: Response | None = None
        self._end = 0.0  # time of the last sample so far in s
        self._broken = ""
        robust = next(iter(loop.controller.claims_of(Robust)), None)
        self._robust = robust if covered(box, loop.conditions) else None
        conditions = loop.conditions  # what else may be in them is counted in what acts
        self._sampled = conditions.sampling is not None and conditions.sampling.corrects
        self._tubes = tube_bounds(loop.controller, box, conditions)
        self._along = None if robust is None else Along(loop, robust, samples)

    def see(self, block: Response) -> None:
        """Take the next samples into account."""
        self._first, self._end = self._first or block, float(block.t[-1])
        for k, (start, end) in enumerate(pairwise(self._edges)):
            values = block.tracking_error[max(start - self._number, 0) : max(end - self._number, 0)]
            self._high[k] = np.maximum(self._high[k], values.max(axis=0, initial=-np.inf))
            self._low[k] = np.minimum(self._low[k], values.min(axis=0, initial=np.inf))
        self._number += len(block.t)
        desired = block.tracked_d if self._tracked == "output" else block.x_d
        self._reference = np.maximum(self._reference, np.abs(desired).max(axis=0))
        largest = np.abs(np.concatenate([block.x, block.x_hat, block.x_d])).max(axis=0)
        self._size = max(self._size, float((largest / self._scale).max()))
        self._disturbed(block.trace)
        if self._along is not None:
            self._along.see(block.trace)
        for name, error, bound, rounding in () if self._broken else self._bounded(block):
            above = error > bound + rounding
            if above.any() and not self._broken:
                k = int(above.argmax())
                self._broken = (
                    f"above its own proved bound: {name} is {error[k]:.3g} at t = {block.t[k]:.9g} s, where at most "
                    f"{bound[k]:.3g} is proved: numerical error is suspected"
                )

    @property
    def w(self) -> Array | None:
        """How large each entry of w got in each tenth of the time, (10, n); None where it could not be enclosed."""
        return None if self._along is None or not np.isfinite(self._along.w).all() else self._along.w

    def outcome(self, figures: Figures) -> Outcome:
        """Say how the run went, the worst first; `figures` have sizes of the error that hold between samples too."""
        final, largest = self._norms(figures)
        return replace(self._ended(figures), final=final, largest=largest, rounded=self._rounded)

    def _ended(self, figures: Figures) -> Outcome:
        if (growth := self._loop.controller.trajectory.growth) is not None:
            return Outcome(kind="grows", text=growth.message)
        if self._broken:
            return Outcome(kind="above its bound", text=self._broken)
        return self._growing() or self._practical(figures) or self._settled(figures)

    def _bounded(self, block: Response) -> Iterator[tuple[str, Array, Array, float]]:
        """Yield errors that proofs of the loop, or of its box, speak of, what these allow, and their rounding."""
        assert self._first is not None
        first, controller, t = self._first, self._loop.controller, block.t
        e, delta = first.x[0] - first.x_d[0], first.x_hat[0] - first.x[0]
        rounding, states = self._rounding(self._end), block.state_sizes if len(block.state_sizes) > 1 else 1.0
        if self._loop.conditions.nominal:
            off = [rounding / block.error_sizes, self._rounding_of_x(self._end) / states]
            of_e, of_x = (float(np.linalg.norm(each)) for each in off)
            yield self._norm_name, block.error_norm, controller.tracking_bound(t, e, delta), of_e
            yield "‖x̂ − x‖", block.observer_error, controller.observer_bound(t, delta), of_x
            return
        start, allowed = start_of_errors(self._loop, first), dict[Form, Array]()
        if self._robust is not None and self.w is not None:
            w = np.broadcast_to(self.w.max(axis=0), block.x.shape)
            seen = Seen(t=t, start=start[: 2 * len(e)], acting={}, designed=False, w=w)
            allowed = self._robust.allows(controller, seen)
        self._sampled = self._sampled and not limited(self._loop, block)
        for claim in self._tubes if self._sampled else ():
            allowed |= claim.allows(controller, Seen(t=t, start=start, acting={}, designed=False, sampled=True))
        for form, bound in controller.with_left(allowed).items():
            if form[0] == self._tracked:
                k, name = form[1], self._names[form[1]]
                yield f"|{name} − {name}_d|", np.abs(block.tracking_error[:, k]), bound, float(rounding[k])

    def _disturbed(self, trace: Trace) -> None:
        conditions, at, z = self._loop.conditions, self._loop.at, trace.z
        signals: dict[Literal["disturbance", "noise"], Array] = {}
        if conditions.disturbance is not None:
            signals["disturbance"] = z[:, at.d] @ conditions.disturbance.Q.T
        if conditions.noise is not None:
            signals["noise"] = z[:, at.v]
        for kind, values in signals.items():
            for k, size in enumerate(np.abs(values).max(axis=0).tolist()):
                self._acting[kind, k] = max(size, self._acting.get((kind, k), 0.0))

    def _caused(self, k: int) -> float:
        """What disturbances and noise, as large as they were, can make of an error in the loop as designed, if bounded.

        A disturbance that comes late makes an error that is the largest so far, and does not grow without bound.
        """
        signal: Form = (self._tracked, k)
        claims = self._loop.controller.claims_of(SignalBounds) if any(self._acting.values()) else ()
        each = (bounds for claim in claims for bounds in claim.acting)
        return sum(bounds.sizes.get(signal, 0.0) * self._acting.get(bounds.channel, 0.0) for bounds in each)

    def _growing(self) -> Outcome | None:
        """Say which error grows. Of a loop as designed, but for disturbances and noise, or of a box none does."""
        conditions = self._loop.conditions
        designed = conditions.plant is None and conditions.limits is None and conditions.sampling is None
        if designed or self._robust is not None:
            return None
        sizes = np.maximum(self._expected, self._rounding(self._end))
        for k, name in enumerate(self._names):
            seen = self._high[:, k], self._low[:, k]
            if grows(*seen, sizes[k]) and grows(*seen, sizes[k] + self._caused(k)):
                last, expected = (self._with_unit(v, name) for v in (self._largest[9, k], self._expected[k]))
                text = (
                    f"the error grows: |{name} − {name}_d| up to {last} at the samples in the last tenth of the time, "
                )
                text += f"more than at any before; reference and start are up to {expected} there"
                return Outcome(kind="grows", text=text)
        return None

    def _practical(self, figures: Figures) -> Outcome | None:
        """Say that the error is below what it is proved to end below, where cells are merged and it is."""
        controller, beyond = self._loop.controller, self._loop.beyond_the_proofs()
        practical = next(iter(controller.claims_of(Practical)), None)
        if practical is None:
            return None
        bound = practical.leaves_norm(self._tracked, controller.error_sizes.tolist())
        for ends in (claim.ends_below(controller) for claim in controller.claims_of(SampledBounds)):
            acts = replace(self._loop.conditions, sampling=None, noise=None, disturbance=None, quanta=None)
            each = [ends.get((self._tracked, k), np.inf) / size for k, size in enumerate(controller.error_sizes)]
            bound, beyond = float(np.linalg.norm(each)) * OVER_SUMS, acts.texts(controller.plant)
        if beyond or figures.final_error > bound:
            return None
        (final, worst), seen = self._norms(figures), figures.seen(*ERRORS)
        text = f"within its bound{', which is larger than the reference' if practical.beyond else ''}: "
        text += f"{self._norm_name} at most {final}{seen} in the last tenth of the time ({worst} at worst)"
        return Outcome(kind="within its bound", text=text)

    def _settled(self, figures: Figures) -> Outcome:
        """Say what is left of the error, and of which entry most."""
        last, largest, seen = self._largest[9], self._largest.max(axis=0), " at the samples"
        if len(self._names) == 1:
            last, largest = np.array([figures.final_error]), np.array([figures.largest_error])
            seen = figures.seen(*ERRORS)
        size = np.where(self._expected > 0, self._expected, largest)
        allowed = np.maximum(_TRACKS * size, self._rounding(self._end))
        when = "in the last tenth of the time"
        if (last <= allowed).all():
            final, worst = self._norms(figures)
            text = f"tracks: {self._norm_name} at most {final}{figures.seen(*ERRORS)} {when} ({worst} at worst)"
            return Outcome(kind="tracks", text=text)
        k = int(np.argmax(last / allowed))
        name, expected = self._names[k], self._expected[k]
        late, worst, usual = (self._with_unit(v, name) for v in (last[k], largest[k], expected))
        ratio = last[k] / expected if expected else 0.0
        share = f"{ratio:.3g} times the size" if ratio > 1 else f"{100 * ratio:.3g} %"
        share = f", {share} of reference and start, {usual}" if expected else ""
        text = f"off: |{name} − {name}_d| up to {late}{seen} {when}{share} ({worst} at worst)"
        entry = f"|{name} − {name}_d| {late}" if len(self._names) > 1 else ""
        return Outcome(kind="off", text=text, worst=entry)

    @property
    def _largest(self) -> Array:
        """The largest size of each error in each tenth, 0 where there is no sample, (10, q)."""
        return np.asarray(np.maximum(np.maximum(self._high, -self._low), 0.0))

    @property
    def _expected(self) -> Array:
        """The size of reference and start of each entry of the error, in its unit: no error above it is a surprise."""
        assert self._first is not None
        actual = self._first.tracked if self._tracked == "output" else self._first.x
        start = np.maximum(np.abs(actual[0]), np.abs(self._first.tracking_error[0]))
        return np.asarray(np.maximum(self._reference, start))

    def _norms(self, figures: Figures) -> tuple[str, str]:
        """Return the largest norm of the error in the last tenth of the time, and of all, as text."""
        unit = self._units.get(self._names[0], "") if len(self._names) == 1 else "sizes"
        known, of = self._rounded, (figures.final_error, figures.largest_error)
        final, largest = (f"{max(v, known):.3g} {unit}".rstrip() + " (rounding)" * (v < known) for v in of)
        return final, largest

    @property
    def _rounded(self) -> float:
        """What the simulation is uncertain by in the norm of the error."""
        return float(np.linalg.norm(self._rounding(self._end) / self._loop.controller.error_sizes))

    @property
    def _norm_name(self) -> str:
        letter = "y" if self._tracked == "output" else "x"
        return f"|{self._names[0]} − {self._names[0]}_d|" if len(self._names) == 1 else f"‖{letter} − {letter}_d‖"

    def _rounding_of_x(self, t: float) -> Array:
        """What the simulation is uncertain by in each state after a time (s), (n,)."""
        return np.asarray(_ROUNDING * (1 + self._speed * t) * self._size * self._scale)

    def _rounding(self, t: float) -> Array:
        """Likewise in each entry of the tracking error."""
        of_x = self._rounding_of_x(t)
        return np.asarray(np.abs(self._loop.plant.tracked) @ of_x if self._tracked == "output" else of_x)

    def _with_unit(self, value: float, name: str) -> str:
        return f"{value:.3g} {self._units.get(name, '')}".rstrip()


def _balanced(loop: ClosedLoop) -> tuple[Array, float]:
    """Return the size of each state in which the loop is balanced, (n,), and the loop's norm in these units in 1/s."""
    plant, design = loop.controller.plant, loop.controller.design
    F = np.abs(plant.A).max(axis=0) + np.abs(plant.B) @ np.abs(design.K)
    F += np.abs(design.L[: len(plant.B)]) @ np.abs(plant.C)
    balanced, (scale, _) = matrix_balance(F, permute=False, separate=True)
    return np.asarray(scale), float(np.linalg.norm(balanced, 2))


@dataclass(frozen=True, kw_only=True)
class SimulatedLoop:
    """A designed and simulated closed loop."""

    spec: Spec  # what was asked
    controller: ProvedController  # gains, desired trajectory and their proofs
    loop: ClosedLoop  # the closed loop
    response: Response  # its signals; of a very long run only every so many-th, and in events only what these show
    figures: Figures  # what was measured over all samples
    outcome: Outcome  # how the run ended, said by all samples
    start: Array  # z(0)
    steady_state: SteadyState | None  # one period of the generator's (η̂, w, 1), or None if it has none
    spool: TraceOnDisk | None  # all samples and events of a run of which `response` has not all
    # of uncertain parameters, how large each entry of w gets in each tenth of the run for any plant of the box,
    # enclosed: see `workflow.bands`, (10, n). None where that took too long.
    w: Array | None = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was noticed and changes no verdict."""
        S = self.controller.trajectory.exosystem.S
        fastest = float(np.abs(np.linalg.eigvals(S).imag).max(initial=0.0)) if S.size else 0.0
        remarks = list(dict.fromkeys(self.spec.problem.plant.remarks + self.loop.plant.remarks))
        remarks += reference_remarks(self.spec, self.controller.form)
        remarks += start_remarks(self.spec, self.controller.trajectory)
        duration, step = self.spec.scenario.duration, self.spec.scenario.sample_time
        if fastest * step > 2 * np.pi / 10:
            remarks.append(
                f"sample_time {step:g} s is too long for a reference with a period of "
                f"{2 * np.pi / fastest:.4g} s: pictures and times miss what lies between samples"
            )
        if self.end < duration * (1 - 1e-9):
            remarks.append(
                f"the run ends with the last sample, at t = {self.end:.9g} s: the duration, {duration:g} s, "
                f"is no multiple of the sample time, {step:g} s"
            )
        remarks += _unresolved(self.response.trace)
        return tuple(remarks)

    @property
    def tracking_bound(self) -> Array | None:
        """What the proofs promise of the tracking error from this start, (K,); None of a loop they are not about."""
        if not self.loop.conditions.nominal:
            return None
        r = self.response
        return self.controller.tracking_bound(r.t, r.x[0] - r.x_d[0], r.x_hat[0] - r.x[0])

    @property
    def observer_bound(self) -> Array | None:
        """What the proofs promise of |x̂ − x| from these initial states, (K,); None as for `tracking_bound`."""
        if not self.loop.conditions.nominal:
            return None
        r = self.response
        return self.controller.observer_bound(r.t, r.x_hat[0] - r.x[0])

    @cached_property
    def bands(self) -> dict[Form, Array]:
        """What is proved of each signal at the samples that were kept, from this start and for what acts, (K,) each."""
        conditions = self.loop.conditions
        if self.spool is not None and (conditions.limits is not None or conditions.rates is not None):
            return {}  # whether an input came to a limit, what was kept does not tell
        r, w = self.response, self.w
        if w is not None:
            step = self.spec.scenario.sample_time
            starts = np.array(tenths(sample_count(self.spec.scenario.duration, step))[:-1]) * step
            k = np.searchsorted(starts, r.t + step / 2, side="right") - 1  # never an earlier tenth than that of t
            w = np.maximum.accumulate(w)[np.maximum(k, 0)]
        return bands(self.loop, r, self.spec.objectives.uncertain, w)

    @property
    def at_limits(self) -> dict[str, float]:
        """The share of the time that each input with limits, of its rate too, was at one of them, by name."""
        shares, found = self.figures.time_share, dict[str, float]()
        for part in self.loop.flow.parts:
            if isinstance(part, Actuator):
                held = {cell for cell, level in zip(part.cells, part.levels, strict=True) if level is not None}
                time = shares.get(part.name, {}).items()
                found[self.loop.plant.inputs[part.input]] = sum(share for cell, share in time if cell in held)
            if isinstance(part, RateLimit):
                free = shares.get(part.name, {}).get("free", 0.0)
                found[f"the rate of {self.loop.plant.inputs[part.input]}"] = 1.0 - free
        return found

    @property
    def end(self) -> float:
        """The time of the last sample in s, whether it was kept or not."""
        step = self.spec.scenario.sample_time
        return (sample_count(self.spec.scenario.duration, step) - 1) * step

    @property
    def final_error(self) -> float:
        """The largest norm of the tracking error in the last tenth of the simulation."""
        return self.figures.final_error

    def blocks(self) -> Iterator[Response]:
        """Yield the signals at all samples, with all events; those of a long run block by block, off the disk."""
        if self.spool is None:
            yield self.response
        else:
            yield from map(self.loop.response, self.spool)


def _unresolved(trace: Trace) -> list[str]:
    """Return a remark of all guards that were within rounding of 0, if there are any."""
    if not trace.unresolved:
        return []
    found = defaultdict[tuple[str, int], list[Unresolved]](list)
    for doubt in trace.unresolved:
        found[doubt.part, doubt.guard].append(doubt)
    spans = [doubt.span for doubt in trace.unresolved]
    late = " or ".join([f"{max(spans):.2g} s"] * bool(max(spans)) + ["a step of the simulation"] * (0 in spans))
    places = [
        f"{part} at hyperplane {guard + 1}, t = {doubts[0].t:.9g} s"
        + f" and {amount(len(doubts) - 1, 'more time')}" * (len(doubts) > 1)
        for (part, guard), doubts in found.items()
    ]
    said = (
        f"within rounding of a hyperplane for up to {late}, on which side cannot be told; a mode change may be missing "
    )
    said += f"there, or early or late by up to {late}, which changes the signals by no more than rounding"
    return ["; ".join([said, *places])]
