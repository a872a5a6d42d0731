"""What a disturbance, noise or a start can do to each signal: what is stored, said and drawn of `control.bounds`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import OVER_SUMS, Array
from pwatrack.claims.exact_text import bounds_content, read_bounds
from pwatrack.control.bounds import Bounds, Channel, Form, Loops, signal_bounds, start_bounds
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Seen
from pwatrack.control.envelope import from_start, with_acting
from pwatrack.control.words import Words
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.solve import asking

BOUNDS = "bounds.json"
_CAUSES, _SIGNALS = 6, 6  # that are printed of all that act and of all that each does

_Pair = tuple[tuple[Bounds, ...], tuple[Bounds, ...]]


@dataclass(frozen=True, kw_only=True)
class SignalBounds(Claim):
    """Bounds of each signal, for each disturbance, noise and entry of the start by itself.

    They are proved once, for whoever asks first; a controller that is changed in another part has them too.

    Attributes:
        loops: What they are about.
        solver: Who is asked for them.
        known: What was proved of them before.
    """

    loops: Loops
    solver: Solver = "structured"
    known: _Pair | None = field(default=None, repr=False)

    statement: ClassVar[str] = (
        "Under bounds: from x = x_hat = x_d on, what d = 1 at most, on one state equation or one measured output, can "
        "make of each signal; of a start, what 1 in that entry of (x - x_d, x_hat - x), the states of loads last, can."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"bounds": []}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked) -> Iterator["SignalBounds"]:
        """Yield the bounds, which are searched for when they are looked at first: they take longer than the design."""
        yield cls(loops=loops_of(controller), solver=asked.solver)

    @classmethod
    def read(cls, content: Mapping[str, Any], controller: ProvedController, asked: Asked) -> Iterator["SignalBounds"]:
        """Yield what was proved; a channel that nothing was proved of has no bounds."""
        loops = loops_of(controller)
        found = {bounds.channel: bounds for bounds in map(read_bounds, content["bounds"])}
        acting: list[Channel] = [("disturbance", k) for k in range(loops.n)]
        acting += [("noise", k) for k in range(loops.L.shape[1])]
        begun: list[Channel] = [("start", group[0]) for group in loops.starts]
        both = (tuple(_with_peaks(loops, channel, found) for channel in channels) for channels in (acting, begun))
        yield cls(loops=loops, known=(next(both), next(both)))

    @cached_property
    def both(self) -> _Pair:
        """What each disturbance and noise, and what each entry of a start can do."""
        if self.known is not None:
            return self.known
        with asking(self.solver):
            return signal_bounds(self.loops), start_bounds(self.loops)

    @property
    def acting(self) -> tuple[Bounds, ...]:
        """What a disturbance of each state equation and the noise of each sensor can do to each signal."""
        return self.both[0]

    @property
    def starts(self) -> tuple[Bounds, ...]:
        """What each entry of the start, of x − x_d, of x̂ − x and of the estimates of loads, can do to each signal."""
        return self.both[1]

    def data(self, controller: ProvedController) -> dict[str, Any]:
        """Return those of all channels that something is proved of."""
        return {"bounds": [bounds_content(bounds) for part in self.both for bounds in part if bounds.sizes]}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        """Yield what acts and what it does to what is tracked, the inputs and what has a size; declared ones first."""
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
        """Return how large each signal may be from its start and for what has acted so far."""
        if not seen.designed:
            return {}
        most = from_start(self.acting, self.starts, seen.start, seen.t, states=self.loops.n)
        _with_norms(most, controller, seen)
        return with_acting(most, self.acting, seen.acting)


def loops_of(controller: ProvedController) -> Loops:
    """Return the loops of a controller, exact."""
    K, L = controller.design.exact
    X, output = controller.compensation.X, controller.tracking == "output"
    return Loops(controller.plant, K, L, controller.proofs, X, output=output)


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


def _with_peaks(loops: Loops, channel: Channel, found: Mapping[Channel, Bounds]) -> Bounds:
    one = found.get(channel, Bounds(channel=channel, sizes={}, parts=()))
    peaks = {form: gain for form, gain in loops.peaks(channel).items() if form in one.sizes}
    sizes = {form: min(size, peaks.get(form, (0.0, np.inf))[1]) for form, size in one.sizes.items()}
    return replace(one, sizes=sizes, peaks=peaks)


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
        if kind in ("output", "state"):
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
