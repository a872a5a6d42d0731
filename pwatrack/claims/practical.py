"""Practical tracking: where cells are merged, errors end below a bound that is proved for every signal.

f = f̃ + Σ E_k w_k with |w_k| ≤ w̄_k at every x (`model.simplification`): generator and feedforward run f̃, the plant
is f. Then (e, Δ)' = M (e, Δ) + Σ (E_k, −E_k) w_k with M in the hull of the M_ij of f̃, and each w_k by itself is
bounded as any disturbance is: see `docs/theory/beyond.md`, *Practical tracking*. An ellipsoid for several w_k with
weights that sum to 1 gives nothing less than the sum of those of each: p_k Q is one for w_k alone.

Where (9) holds for the cells of f the observer may run these: then Δ goes to 0 whatever w does, and in the end e' = (Â
+ B K) e + Σ E_k w_k.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from pwatrack.arrays import OVER_SUMS, number_text, up
from pwatrack.ball_matrix import BallMatrix, text
from pwatrack.claims.bounds import loops_of
from pwatrack.claims.exact_text import FUNCTION, TERM, bounds_content, plant_content, read_bounds, signals
from pwatrack.claims.limits import ideal
from pwatrack.control.bounds import Bounds, Channel, Form, Loop, Loops, SignalEllipsoid
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.words import Words, sized
from pwatrack.errors import Problem
from pwatrack.lmi.peak_gain import PeakGain, peak_gain
from pwatrack.model.nonlinearity import ScalarForm
from pwatrack.model.pwa import PWASystem, linear_form_text
from pwatrack.model.simplification import Simplification, merges, scalar_form, widest
from pwatrack.model.sizes import Sizes

_SHOWN = 8  # signals beside what is tracked
_MOST = 40  # mergings that are tried
_TRIES = 6  # values of a for each ellipsoid


@dataclass(frozen=True, kw_only=True)
class Practical(Claim):
    """What is proved of the loop with the true plant, where the design is that of one with merged cells."""

    plant: PWASystem  # the true plant, f
    merges: tuple[Simplification, ...]  # what is merged in it; f̃ is the plant of the controller
    replaced: tuple[Problem, ...]  # why the error cannot be proved to go to 0
    evidence: Any  # the proof of that, where there is one
    # what 1 of each w_k can make of each signal in the end, in the order of `merges`: of what is tracked, of each
    # input, of states, of the observer's errors
    bounds: tuple[Bounds, ...]
    beyond: Mapping[Form, float] = field(default_factory=dict)  # size of what need not end below its reference

    statement: ClassVar[str] = (
        "Under practical: the field of the true plant there is that of this plant and the sum of direction (function - "
        "merged)(row x + constant), each difference at most largest; the loop is that of the true plant, and each "
        "signal ends below ends_below, from every start."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"practical": None}
    beside: ClassVar[str] = "what is merged"

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["Practical"]:
        """Yield what a certificate tells: what is merged is chosen where exact tracking is refused.

        See `workflow.simplified`.
        """
        if told is not None and (content := told["practical"]) is not None:
            bounds, plant = tuple(map(read_bounds, content["bounds"])), controller.running
            ways = merged_ways(content["merged"], plant)
            yield cls(plant=plant, merges=ways, replaced=(), evidence=None, bounds=bounds)

    @cached_property
    def final(self) -> dict[Form, float]:
        """Below what the size of each signal ends, from every start, in its unit."""
        total = dict.fromkeys(self.bounds[0].sizes, Fraction(0))
        for merge, bounds in zip(self.merges, self.bounds, strict=True):
            for signal in total:
                size = bounds.sizes[signal]
                total[signal] += merge.largest * Fraction(float(np.nextafter(size, np.inf))) if size else 0
        return {signal: float(np.nextafter(float(size), np.inf)) if size else 0.0 for signal, size in total.items()}

    def leaves(self, form: Form) -> float | None:
        return self.final.get(form)

    def leaves_norm(self, of: Literal["output", "state", "estimate"], sizes: Sequence[float]) -> float:
        each = [self.final[of, k] / size for k, size in enumerate(sizes)]
        return float(np.linalg.norm(each)) * OVER_SUMS

    def data(self, controller: ProvedController) -> dict[str, Any]:
        ends = ((form, size) for form, size in self.final.items() if size or form[0] == controller.tracking)
        return {
            "practical": {
                "plant": plant_content(self.plant),
                "merged": [_merge_content(merge) for merge in self.merges],
                "observer_runs": "all cells" if controller.plant.watched is not None else "merged cells",
                "ends_below": signals(ends),
                "bounds": [bounds_content(bounds) for bounds in self.bounds],
            }
        }

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        found = {
            "exact_tracking": [problem.message for problem in self.replaced],
            "merged": [
                {
                    "name": merge.nonlinearity.name,
                    "of": _form_text(words, merge),
                    "from": float(merge.nonlinearity.function.breakpoints[merge.first]),
                    "to": float(merge.nonlinearity.function.breakpoints[merge.last]),
                    "unit": _unit(words, merge),
                    "largest": float(merge.largest),
                    "deviates_by": {words.cause(("disturbance", j))[1]: size for j, size in _deviations(merge).items()},
                }
                for merge in self.merges
            ],
            "observer_runs": "all cells" if controller.plant.watched is not None else "merged cells",
            "ends_below": {
                name: {"bound": size, "unit": unit}
                for (name, unit), size in ((words.signal(form), size) for form, size in self.final.items())
            },
            "per_deviation": [
                {words.signal(form)[0]: size for form, size in bounds.sizes.items()} for bounds in self.bounds
            ],
        }
        return {"verdict": "practical", "practical": found}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        tracked, final = controller.tracking, self.final
        ends = list[str]()
        for form in (form for form in final if form[0] == tracked):
            name, unit = words.signal(form)
            larger = ", larger than the reference" if form in self.beyond else ""
            ends.append(f"{sized(name)} {'' if ends else 'ends '}below {up(final[form])} {unit}".rstrip() + larger)
        widths = ", ".join(_width_text(words, merge) for merge in self.merges)
        yield "practical tracking", f"{', '.join(ends)}, proved for every start; {widths}"
        for problem in self.replaced:
            yield "exact tracking", f"refused: {problem.short or problem.message}"
        for merge in self.merges:
            yield "merged", _merge_text(words, merge)
        others = [(form, size) for form, size in final.items() if form[0] not in (tracked, "estimate")]
        if others:
            yield "", f"also in the end: {', '.join(words.limits(others[:_SHOWN]))}"
        cells = len(controller.plant.model.cell_names)
        if controller.plant.watched is not None:
            yield "", f"the observer runs all {cells} cells of the plant, and its error goes to 0"
        else:
            estimates = [(form, size) for form, size in final.items() if form[0] == "estimate"]
            limits = ", ".join(words.limits(estimates[:_SHOWN]))
            yield "", f"the observer runs the merged cells too: {limits} in the end"

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        tracked = controller.tracking
        ends = words.limits((form, size) for form, size in self.final.items() if form[0] == tracked)
        constant, widths = up(1 / controller.guarantees.rate), ", ".join(_width_text(words, m) for m in self.merges)
        said = f"proved: in the end {', '.join(ends)} from every start, time constant {constant} s"
        yield "ideal loop", f"{said}; {ideal(controller, words)}; exact tracking is refused: {widths}"


def least_merges(
    form: ScalarForm, sizes: Sizes, works: Callable[[Mapping[int, Simplification]], bool]
) -> dict[int, Simplification] | None:
    """Return how each element is merged such that none of them can be merged less while the others stay.

    It begins with all of them merged whole. One after the other, that of the largest deviation first (in sizes of the
    states), is then left as it is or merged in the way of the least deviation that will do. Less merged is harder in
    every way, since (8), (9) and (17) then speak of more cells: so what was found for one element stays the least while
    others are merged less. `works` says whether a design is found; it is asked 40 times at most, what is left then
    stays merged. None where even all merged does not work, or nothing can be merged.
    """
    chosen = widest(form)
    ways = {k: merges(form, k) for k in chosen}
    if not chosen or not works(chosen):
        return None

    def effect(k: int) -> float:
        column = chosen[k].column.floats[:, 0]
        return float(np.abs(column / sizes.state).max() * float(chosen[k].largest))

    tried = 0
    for k in sorted(chosen, key=effect, reverse=True):
        others = {j: merge for j, merge in chosen.items() if j != k}
        for trial in [others, *(others | {k: way} for way in ways[k] if way.largest < chosen[k].largest)]:
            if not trial or tried == _MOST:
                continue
            tried += 1
            if works(trial):
                chosen = trial
                break
    return dict(sorted(chosen.items()))


def deviation_bounds(
    controller: ProvedController, columns: Sequence[BallMatrix], states: Sequence[int] = ()
) -> tuple[Bounds, ...] | None:
    """Bound what each deviation can do to each signal in the end, proved exactly, per 1 of it; None if one cannot.

    The plant of the controller is f̃; if its observer runs another one, that has no deviation. The columns are E_k, (n,
    1); some `states` are to be bounded beside what is tracked and inputs.
    """
    loops = loops_of(controller, deviations=columns)
    signals = loops.tracked + loops.inputs + [("state", k) for k in states if controller.tracking == "output"]
    found = [bounds for k in range(len(columns)) if (bounds := _ended(loops, k, signals)) is not None]
    return tuple(found) if len(found) == len(columns) else None


def _ended(loops: Loops, k: int, signals: Sequence[Form]) -> Bounds | None:
    """Return the bounds in the end; without a deviation in the observer that is what the controller's loop says."""
    channel: Channel = ("deviation", k)
    loop: Loop = "joint" if loops.seen else "controller"
    estimates = [form for form in loops.estimates if form[1] < loops.n]
    sizes, parts = loops.sizes("observer", channel, estimates)
    peaks = dict[int, PeakGain]()
    if loop in loops.M:
        for signal in signals:
            size, part = loops.sizes(loop, channel, [signal], tries=_TRIES)
            sizes, parts = sizes | size, parts + part
            if part and (gain := _proved_peak(loops, part[0], signal)) is not None and gain.size < size[signal]:
                peaks[len(parts) - 1] = gain
                sizes[signal] = gain.size
    else:
        size, part = loops.in_two_steps(channel)
        sizes, parts = sizes | size, parts + part
    if any(form not in sizes for form in (*signals, *estimates)):
        return None
    sizes = {form: sizes[form] for form in (*signals, *estimates)}
    return Bounds(channel=channel, sizes=sizes, parts=parts, proved=peaks)


def _proved_peak(loops: Loops, part: SignalEllipsoid, signal: Form) -> PeakGain | None:
    if len(loops.M[part.loop]) != 1:
        return None
    drive, row = loops.drive(part.loop, part.channel), loops.row(part.loop, signal)
    return peak_gain(loops.M[part.loop][0], drive, row, part.ellipsoid)


def merged_ways(told: Any, plant: PWASystem) -> tuple[Simplification, ...]:
    """Return what a certificate says to be merged, as it would be in a plant, or refuse what is nothing of it."""
    form, found = scalar_form(plant), dict[tuple[int, int, int], Simplification]()
    if form is not None:
        each = (way for k in range(len(form.elements)) for way in merges(form, k))
        found = {(way.element, way.first, way.last): way for way in each}
    places = [(one["element"], one["first"], one["last"]) for one in told]
    if not set(places) <= found.keys():
        raise ValueError("what is merged, in practical, is nothing of this plant")
    return tuple(found[place] for place in places)


def _merge_content(merge: Simplification) -> dict[str, Any]:
    place = {"element": merge.element, "first": merge.first, "last": merge.last}
    found = place | {"name": merge.nonlinearity.name} | TERM.write(merge.nonlinearity)
    return found | {"merged": FUNCTION.write(merge.function), "largest": text(merge.largest)}


def _width_text(words: Words, merge: Simplification) -> str:
    marks, unit = merge.nonlinearity.function.breakpoints, _unit(words, merge)
    low, high = float(marks[merge.first]), float(marks[merge.last])
    if low == -high:
        return f"the {merge.nonlinearity.name} is ±{number_text(high, '.6g')} {unit}".rstrip()
    between = f"from {number_text(low, '.6g')} to {number_text(high, '.6g')} {unit}".rstrip()
    return f"the {merge.nonlinearity.name} is merged {between}"


def _merge_text(words: Words, merge: Simplification) -> str:
    """Say what becomes of an element, and by how much the plant then deviates at most."""
    slopes = merge.function.slopes
    straight = slopes[0].centre == slopes[-1].centre and len(slopes) == 2
    count = merge.last - merge.first + 1
    gone = len(merge.nonlinearity.function.breakpoints) - len(merge.function.breakpoints)
    became = "one line" if straight else f"with {count} corners fewer" if gone == count else "with one corner"
    each = ((size, words.cause(("disturbance", j))) for j, size in _deviations(merge).items())
    most = ", ".join(f"{up(size)} {unit} on {on}".replace("  ", " ") for size, (_, on, unit) in each)
    of = _form_text(words, merge)
    return f"{merge.nonlinearity.name}, of {of}, {became}: it deviates by at most {most}"


def _deviations(merge: Simplification) -> dict[int, float]:
    """Return by how much each state equation deviates at most, where it does."""
    column = np.abs(merge.column.floats[:, 0])
    return {int(j): float(column[j]) * float(merge.largest) for j in np.flatnonzero(column)}


def _form_text(words: Words, merge: Simplification) -> str:
    return linear_form_text(np.array([float(v) for v in merge.nonlinearity.row]), words.plant.states)


def _unit(words: Words, merge: Simplification) -> str:
    """Return the unit of what an element looks at, where all states in it have the same and count once."""
    row = [float(v) for v in merge.nonlinearity.row]
    names = [name for name, v in zip(words.plant.states, row, strict=True) if v]
    units = {words.units.get(name, "") for name in names}
    return units.pop() if len(units) == 1 and all(abs(v) in (0.0, 1.0) for v in row) else ""
