"""What a disturbance, noise or a start can do to each signal: what is stored, said and drawn of `control.bounds`.

And how large each signal may be over time, from where a run starts and under what acts on it. Every ellipsoid of
`control.bounds` is one for a start too: V = zᵀ Q⁻¹ z has √V ≤ √V(0) e^(−a t / 2) + sup |d|, so each linear form c z of
a loop is at most √(c Q cᵀ) √V(0) e^(−a t / 2), plus what d does from 0. The least of all of these holds, and so does
the sum of the bounds for each entry of the start.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import OVER_POWERS, OVER_SUMS, Array
from pwatrack.ball_matrix import BallMatrix, zero
from pwatrack.claims.exact_text import bounds_content, read_bounds
from pwatrack.control.bounds import Bounds, Channel, Form, Loops
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Seen, Told
from pwatrack.control.words import Words
from pwatrack.lmi.exact import Packed
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.norm import root_above
from pwatrack.lmi.solve import asking
from pwatrack.rational import doubles

BOUNDS = "bounds.json"
_CAUSES, _SIGNALS = 6, 6  # that are printed of all that act and of all that each does


@dataclass(frozen=True, kw_only=True)
class SignalBounds(Claim):
    """Bounds of each signal, for each disturbance, noise and entry of the start by itself.

    They are proved once, for whoever asks first; a controller that is changed in another part has them too.
    """

    loops: Loops  # what they are about
    solver: Solver = "structured"  # who is asked for them
    known: Mapping[Channel, Bounds] | None = field(default=None, repr=False)  # what a certificate has of them

    statement: ClassVar[str] = (
        "Under bounds: from x = x_hat = x_d on, what d = 1 at most, on one state equation or one measured output, can "
        "make of each signal; of a start, what 1 in that entry of (x - x_d, x_hat - x), the states of loads last, can."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"bounds": []}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["SignalBounds"]:
        """Yield the bounds, which are searched for when they are looked at first: they take longer than the design."""
        loops = loops_of(controller, () if asked.signals is None else asked.signals.forms)
        known = None if told is None else {bounds.channel: bounds for bounds in map(read_bounds, told["bounds"])}
        yield cls(loops=loops, solver=asked.solver, known=known)

    @cached_property
    def both(self) -> tuple[tuple[Bounds, ...], tuple[Bounds, ...]]:
        """What each disturbance and noise, and what each entry of a start can do."""
        with asking(self.solver):
            acting = tuple(map(self._bounds, self.loops.acting))
            return acting, tuple(self._bounds(("start", group[0])) for group in self.loops.starts)

    def _bounds(self, channel: Channel) -> Bounds:
        if self.known is None:
            return self.loops.bounds(channel)
        one = self.known.get(channel, Bounds(channel=channel, sizes={}, parts=()))
        peaks = {form: gain for form, gain in self.loops.peaks(channel).items() if form in one.sizes}
        sizes = {form: min(size, peaks.get(form, (0.0, np.inf))[1]) for form, size in one.sizes.items()}
        return replace(one, sizes=sizes, peaks=peaks)

    @property
    def acting(self) -> tuple[Bounds, ...]:
        """What a disturbance of each state equation and the noise of each sensor can do to each signal.

        Example: the paper's example. A push of 1 N on the first mass, 1 m/s² there, moves it by 1 m at most.

            >>> from pwatrack import design, load_spec
            >>> push = design(load_spec("specs/two_mass_backlash.yaml")).bounds[1]
            >>> push.channel, 0.9 < push.sizes["output", 0] < 1.1
            (('disturbance', 1), True)
        """
        return self.both[0]

    @property
    def starts(self) -> tuple[Bounds, ...]:
        """What each entry of the start, of x − x_d, of x̂ − x and of the estimates of loads, can do to each signal.

        A load that steps by 1 is an estimate that is off by 1.

        Example: the first mass of the paper's example starts 1 m off.

            >>> from pwatrack import design, load_spec
            >>> first = design(load_spec("specs/two_mass_backlash.yaml")).starts[0]
            >>> first.channel, 1.0 < first.sizes["output", 0] < 1.1
            (('start', 0), True)
        """
        return self.both[1]

    def data(self, controller: ProvedController) -> dict[str, Any]:
        return {"bounds": [bounds_content(bounds) for part in self.both for bounds in part if bounds.sizes]}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        found = sorted(self.acting, key=lambda bounds: not words.declared(bounds.channel))
        yield (
            "bounds",
            "in the loop as designed, for any switching, each signal is in the end at most the sum of these"
            f"{controller.beside}, in proportion to what acts; from error 0 at all times",
        )
        for bounds in found[:_CAUSES]:
            kind, on, unit = words.cause(bounds.channel)
            yield "", f"{_shown(words, bounds.sizes)} per {unit or '1'} {'of noise ' * (kind == 'noise')}on {on}"
        if len(found) > _CAUSES:
            yield "", f"{len(found) - _CAUSES} more in {BOUNDS}"
        for bounds in self.starts[2 * self.loops.n :]:
            _, name, unit = words.cause(bounds.channel)
            yield "", f"{_shown(words, bounds.sizes)} per {unit or '1'} of {name} that sets in, and 0 in the end"
        within = _shown(words, self.from_sizes(controller))
        yield "", f"from a start with all errors within their sizes, at all times {within}"

    def under(self, controller: ProvedController, acting: Mapping[Channel, float]) -> dict[Form, float]:
        """Return the most that each signal is in the end while disturbances and noises are no larger than these."""
        each, total = {bounds.channel: bounds.sizes for bounds in self.acting}, dict[Form, float]()
        for form in next((each[channel] for channel in acting), {}):
            if all(form in each[channel] for channel in acting):
                sizes = [each[channel][form] * size for channel, size in acting.items()]
                total[form] = sum(sizes) * OVER_POWERS
        return controller.with_left({form: size for form, size in total.items() if np.isfinite(size)})

    def from_sizes(self, controller: ProvedController) -> dict[Form, float]:
        """Return the most that each signal is at any time from a start with all errors of x, x̂ and loads in sizes."""
        sizes = controller.sizes
        within = [*sizes.state.tolist(), *sizes.state.tolist(), *sizes.load.tolist()]
        shared = (form for form in self.starts[0].sizes if all(form in bounds.sizes for bounds in self.starts))
        total = dict.fromkeys(shared, 0.0)
        for bounds in self.starts:
            for form in total:
                total[form] += bounds.sizes[form] * within[bounds.channel[1]] * OVER_SUMS
        return controller.with_left(total)

    def allows(self, controller: ProvedController, seen: Seen) -> dict[Form, Array]:
        if not seen.designed:
            return {}
        most = from_start(self.acting, self.starts, seen.start, seen.t, states=self.loops.n)
        _with_norms(most, controller, seen)
        for t, step in seen.steps:  # each is an estimate that is off by it from then on
            start, since = np.append(np.zeros(2 * self.loops.n), step), np.maximum(seen.t - t, 0.0)
            more = from_start(self.acting, self.starts, start, since, states=self.loops.n)
            most = {form: most[form] + np.where(seen.t >= t, more[form], 0.0) for form in most.keys() & more.keys()}
        return with_acting(most, self.acting, seen.acting)


def from_start(
    found: Sequence[Bounds], starts: Sequence[Bounds], start: Array, t: Array, *, states: int
) -> dict[Form, Array]:
    """Return the most that each signal is over time from a start, (K,), where nothing else acts and it is proved.

    The ellipsoids of the bounds `found` are looked at, and those of all entries of a start, `starts`, or none. It is
    (x − x_d, x̂ − x, ŝ − s) at t = 0, (2 n + p,); t (K,) are times in s, and n is `states`.
    """
    most: dict[Form, Array] = {}
    first = [bounds.channel[1] for bounds in starts]
    for signal in {signal for bounds in starts for signal in bounds.sizes}:
        if all(signal in bounds.sizes for bounds in starts):
            groups = zip(starts, np.split(start, first[1:]), strict=True)
            total = sum(bounds.sizes[signal] * float(np.linalg.norm(entries)) for bounds, entries in groups)
            most[signal] = np.full(len(t), total * OVER_POWERS)
    for part in (part for bounds in (*found, *starts) for part in bounds.parts):
        if part.loop == "controller":
            continue  # e by itself is driven by Δ
        size = in_ellipsoid(part.ellipsoid, start if part.loop == "joint" else start[states:])
        decay = size * np.exp(-part.ellipsoid.a / 2 * t) * OVER_POWERS
        for signal, bound in zip(part.signals, part.ellipsoid.sizes, strict=True):
            if part.loop == "joint" or signal[0] == "estimate":  # the observer's loop has its half of others
                most[signal] = np.minimum(most.get(signal, np.inf), bound * decay)
    return most


def with_acting(
    most: Mapping[Form, Array], found: Sequence[Bounds], acting: Mapping[Channel, Array]
) -> dict[Form, Array]:
    """Add to `from_start` what disturbances and noises do, as large as each has been so far, where all is bounded."""
    by_channel = {bounds.channel: bounds.sizes for bounds in found}
    return {
        signal: values + sum(by_channel[channel][signal] * size * OVER_POWERS for channel, size in acting.items())
        for signal, values in most.items()
        if all(signal in by_channel[channel] for channel in acting)
    }


def in_ellipsoid(Q: Packed, z: Array) -> float:
    """Return √(zᵀ Q⁻¹ z), rounded up."""
    column = doubles(z[:, None])
    return root_above((column.transpose() * Q.P.solve(column))[0, 0])


def loops_of(
    controller: ProvedController,
    limited: Sequence[Form] = (),
    *,
    unmoved: bool = False,
    deviations: Sequence[BallMatrix] = (),
) -> Loops:
    """Return the loops of a controller, exact; with further signals of x − x_d that are to be bounded, and deviations.

    With `unmoved` they are for rows of (e, Δ) where estimates of loads do not move x_d.
    """
    (K, L), X = controller.design.exact, controller.compensation.X
    X, output = zero(*X.shape) if unmoved else X, controller.tracking == "output"
    return Loops(controller.plant, K, L, controller.proofs, X, output=output, limited=limited, deviations=deviations)


def bound_entry(words: Words, bounds: Bounds, *, uncertain: bool = False) -> dict[str, Any]:
    """Return what bounds.json says of one channel."""
    kind, of, unit = words.cause(bounds.channel, uncertain=uncertain)
    passes = kind in ("load", "start")
    signals = dict[str, dict[str, Any]]()
    for form, size in bounds.sizes.items():
        name, its = words.signal(form)
        signals[name] = {"in_the_end": 0.0 if passes else size, "at_worst": size, "unit": its}
        if form in bounds.peaks:
            signals[name] |= {"certified": bounds.certified[form], "peak_gain": list(bounds.peaks[form])}
    return {"kind": kind, "of": of, "per": f"1 {unit}".rstrip(), "signals": signals}


def _with_norms(most: dict[Form, Array], controller: ProvedController, seen: Seen) -> None:
    """Lower the bounds of errors to what the norms of (8) and (9) say of them; they are about loads that are known."""
    promised, sizes, n, start = controller.guarantees, controller.sizes.state, len(controller.plant.B), seen.start
    if start[2 * n :].any():
        return
    output = controller.tracking == "output"
    tracking = promised.tracking_error(seen.t, start[:n], start[n : 2 * n], output=output)
    observer, counted = promised.observer_error(seen.t, start[n : 2 * n]), sizes if n > 1 else np.ones(1)
    for form in list(most):
        kind, k = form
        if kind == controller.tracking:
            most[form] = np.minimum(most[form], tracking * controller.error_sizes[k] * OVER_SUMS)
        elif kind == "estimate" and k < n:
            most[form] = np.minimum(most[form], observer * counted[k] * OVER_SUMS)


def _shown(words: Words, sizes: Mapping[Form, float]) -> str:
    """Say the bounds of what is tracked, of inputs, and of estimates of states that were given a size."""
    states: Sequence[str] = words.plant.states
    shown = {
        form: size
        for form, size in sizes.items()
        if form[0] != "estimate" or (form[1] < len(states) and states[form[1]] in words.sizes)
    }
    return ", ".join(words.limits(list(shown.items())[:_SIGNALS])) or "no bound proved"
