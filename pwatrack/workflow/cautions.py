"""What an engineer would be warned of before this design goes to its machine: each with its figure, and a way out.

Margins and modes are of each cell by itself, in floating point. What is odd of a plant by itself is asked before any
design: only who knows the machine can say whether the file is right.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import TINY, Array, number_text, up
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.limits import NoSaturation
from pwatrack.claims.sampled import SampledLoop, proved_as_sampled
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_box import SampledBoxBounds
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import ProvedController
from pwatrack.control.goal import AtLeast, Given, Goal
from pwatrack.control.sampled_gains import sampled_gains
from pwatrack.control.synthesis import gain
from pwatrack.control.task import Task
from pwatrack.control.words import Words, sized
from pwatrack.errors import PwatrackError
from pwatrack.lmi.inequality import OBSERVER, Role
from pwatrack.model.nonlinearity import Nonlinearity
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.margins import Margins, loop_margins, worst
from pwatrack.simulation.modes import modes
from pwatrack.simulation.sampled_runs import not_simulated, refused
from pwatrack.spec.spec import Spec
from pwatrack.workflow.bands import declared, tube_bounds
from pwatrack.workflow.causes import FASTER, of_designed, of_sampled, way
from pwatrack.workflow.sizing import reference_sizes

_HALF = 0.5  # of the reference: an error of this size is no tracking
_SINGLE = 2.0**-24  # of a number: what storing it in single precision may change
_NEAR = 0.05  # of the range of an input: what rests nearer to a limit has no room there
_SHORT = 1e-3  # of a sample time: no machine samples so much faster
_TENTH = 0.1  # of the sampling frequency: what a loop is usually slower than
_LITTLE_PHASE = np.pi / 6  # rad: half of what is usually asked for
_HARDLY = 100.0  # times smaller: a K that leaves the plant to itself
_UNDAMPED = 1e-3  # damping of a mode: real machines have more
_CHANGES = (  # of a gain, and what has it designed so
    ("K", 0.5, "lower 'sizes' of inputs"),
    ("K", 2.0, "raise 'sizes' of inputs"),
    ("L", 0.5, "raise 'sizes' of outputs"),
    ("L", 2.0, "lower 'sizes' of outputs"),
)
_OF_LOADS = (("lower", 0.1), ("raise", 10.0))  # times their sizes: what is tried where K and L help little
_LITTLE_GAIN = 1.4  # 3 dB: half of what is usually asked for
_WORTH = 1.2  # times as much margin is worth a word


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """What the proofs mean with what the file declares."""

    acting: Mapping[Channel, float]  # how large noises and disturbances count
    # the most that each signal is in the end under these, nothing where none acts: in the sampled loop where that is
    # proved, else in the loop as designed
    ends: Mapping[Form, float]
    condition: str  # for what, in words
    margins: Sequence[Margins]  # of each cell by itself; none where to look for them would take long
    warnings: tuple[str, ...]  # in the order of their weight
    questions: tuple[str, ...]  # what is odd of the plant, and may be right


def assessed(spec: Spec, controller: ProvedController) -> Assessment:
    """Say what a design means for its machine.

    Example: a wheel that is measured with a noise of up to 3 rad/s is to turn at 1 rad/s.

        >>> from pwatrack import design, load_spec
        >>> spec = load_spec("specs/two_mass_backlash.yaml")
        >>> assessed(spec, design(spec)).ends
        {}
    """
    acting, claims = declared(spec, controller), controller.claims_of(SignalBounds)
    ends = claims[0].under(controller, acting) if acting and claims else {}
    condition = f"while {acting_text(spec.words, acting)}"
    tubes = tube_bounds(controller, spec.objectives.uncertain, spec.scenario.conditions)
    others = isinstance(next(iter(tubes), None), SampledBoxBounds)
    tubes = tubes or controller.claims_of(SampledBounds)
    conditions = spec.scenario.conditions
    known = next((claim for claim in tubes if claim.ends_below(controller)), None)
    if known is not None:
        acts = {"noise": "noise as drawn", "quanta": "quantisation", "disturbance": "disturbance"}
        said = [text for name, text in acts.items() if getattr(conditions, name) is not None]
        said += ["any parameters of the box"] * others
        ends, condition = known.ends_below(controller), f"under {', '.join(said)}" if said else ""

    def made_of(form: Form) -> dict[str, float]:
        if known is not None:
            return of_sampled(known, controller, conditions, form)
        sizes = {bounds.channel: bounds.sizes for bounds in claims[0].acting}
        return of_designed({channel: sizes[channel][form] * size for channel, size in acting.items()}, conditions)

    of = f"{'ideal' if known is None else 'sampled'} loop{'' if others else spec.words.as_designed}"
    every = loop_margins(controller)
    margins = worst(every)
    warnings = [
        *_disturbed(spec, controller, ends, of, made_of, margins),
        *_near_limits(spec, controller),
        *_gentle(controller),
        *_sampling(spec, controller, margins),
        *_little_margin(controller, margins, spec.words.goals),
    ]
    runs = proved_as_sampled(controller)
    return Assessment(
        acting=acting,
        ends=ends if known is not None or not runs else {},  # else they are of another loop than the one that runs
        condition=condition,
        margins=every,
        warnings=tuple(warnings),
        questions=tuple(plant_questions(spec.problem.plant)),
    )


def _little_margin(controller: ProvedController, margins: Margins | None, goals: Mapping[Role, Goal]) -> Iterator[str]:
    """Yield that a cell has little phase or gain margin, and which change of K or L by itself would give most of it."""
    if margins is None or (margins.phase >= _LITTLE_PHASE and margins.least_gain >= _LITTLE_GAIN):
        return
    design, tried = controller.design, list[tuple[Margins, str, str]]()
    for letter, factor, sizes in _CHANGES:
        changed = replace(design, **{letter: factor * getattr(design, letter)})
        other = worst(loop_margins(replace(controller, design=changed)))
        tried += [] if other is None or not other.stable else [(other, f"{letter} × {factor:g} would have", sizes)]
    asked = any(isinstance(goal, AtLeast) and goal.rate for goal in goals.values())
    others = ["a smaller 'rate'"] * asked + ["a sensor or actuator more"]
    no_change = f"halving or doubling K or L helps little: try {', '.join(others)}"
    if margins.phase >= _LITTLE_PHASE:
        gains = [(m.least_gain, f"{made} × {m.least_gain:.3g}: {sizes}") for m, made, sizes in tried]
        most, better = max(gains, default=(0.0, ""))
        better = better if most >= _WORTH * margins.least_gain else no_change
        which = "more" if margins.gain[1] <= margins.least_gain else "less"
        yield f"gain margin × {margins.least_gain:.3g} of each cell by itself: {which} is unstable; {better}"
        return
    found = [(m.phase, f"{made} {np.degrees(m.phase):.2g}°: {sizes}") for m, made, sizes in tried]
    most, better = max(found, default=(0.0, ""))
    if most < _WORTH * margins.phase:
        better = _other_loads(controller, goals, _WORTH * margins.phase) or no_change
    elif most < _LITTLE_PHASE:
        better += "; or try a 'rate' of each"
    where = f"in cell '{controller.plant.cell_names[margins.cell]}'"
    yield f"phase margin {np.degrees(margins.phase):.3g}°, delay {margins.delay:.2g} s, {where}; {better}"


def _other_loads(controller: ProvedController, goals: Mapping[Role, Goal], least: float) -> str:
    """Say which other sizes of loads give an L with more phase margin than a least one (rad); "" if none does."""
    sizes, found = controller.sizes, list[tuple[float, str]]()
    if controller.plant.loads is None or isinstance(goals[OBSERVER], Given):
        return ""
    for change, factor in _OF_LOADS:
        task = Task.of(controller.plant, OBSERVER, sizes=replace(sizes, load=factor * sizes.load))
        with suppress(PwatrackError):
            L = gain(task, goals[OBSERVER])[0].T
            other = worst(loop_margins(replace(controller, design=replace(controller.design, L=L))))
            if other is not None and other.phase > least:
                text = f"{change} 'sizes' of loads: with {factor:g} times these it would have"
                found.append((other.phase, f"{text} {np.degrees(other.phase):.2g}°"))
    return max(found, default=(0.0, ""))[1]


def _disturbed(
    spec: Spec,
    controller: ProvedController,
    ends: Mapping[Form, float],
    of: str,
    made_of: Callable[[Form], Mapping[str, float]],
    margins: Margins | None,
) -> Iterator[str]:
    """Yield where what is proved of some loop's end is more than is required, or half of y_d, and what leaves most."""
    references, little = reference_sizes(spec, controller), margins is not None and margins.phase < _LITTLE_PHASE
    for k, name in enumerate(controller.error_names):
        form: Form = (controller.tracking, k)
        bound, unit = ends.get(form), spec.problem.units.get(name, "")
        limits = [
            wish.limit
            for wish in spec.requirements
            if (wish.figure == "final_errors" and wish.signal in (None, name))
            or (wish.figure == "final_error" and len(controller.error_names) == 1 and wish.share is None)
        ]
        most, what = (min(limits), "required") if limits else (_HALF * float(references[k]), "half the reference")
        if bound is not None and bound > most > 0:
            causes = made_of(form)
            largest = max(causes, key=lambda cause: causes[cause], default="sampling")
            yield (
                f"{of}: no better than {sized(f'{name} - {name}_d')} ≤ {up(bound)} {unit}".rstrip()
                + f" is proved, {most:.3g} {unit}".rstrip()
                + f" is {what}; most by {largest}: {way(largest, controller)}"
                + ", which takes of the margin" * (little and largest in FASTER)
            )


def acting_text(words: Words, acting: Mapping[Channel, float]) -> str:
    """Say what acts, and how large it counts.

    Example:
        >>> from pwatrack import load_spec
        >>> acting_text(load_spec("specs/two_mass_backlash.yaml").words, {("noise", 0): 3e-4})
        'measured y off by up to 0.0003 m'
    """
    said = []
    for channel, size in acting.items():
        kind, on, unit = words.cause(channel)
        amount = f"{up(size)} {unit}".rstrip()
        said.append(f"{on} off by up to {amount}" if kind == "noise" else f"up to {amount} on {on}")
    return ", ".join(said)


def _near_limits(spec: Spec, controller: ProvedController) -> Iterator[str]:
    """Yield which inputs rest near a limit, and which begin beyond one."""
    plant = spec.problem.plant
    for room in (claim.room for claim in controller.claims_of(NoSaturation)):
        for k, name in enumerate(plant.inputs):
            low, high = room.limits[k].tolist()
            unit, ends = spec.problem.units.get(name, ""), [v for v in (low, high) if np.isfinite(v)]
            if room.lasting is None or not ends:
                continue
            span = (high - low if len(ends) == 2 else abs(ends[0])) or 1.0
            lower, upper = float(room.lasting.low[k]), float(room.lasting.high[k])
            left, rests, limit = min((lower - low, lower, low), (high - upper, upper, high))
            if left < _NEAR * span:
                way, side = ("down", "lower") if limit == low else ("up", "upper")
                rest, end = (number_text(round(v / span, 6) * span, ".4g") for v in (rests, limit))
                yield (
                    f"feedforward of {name} {way} to {rest} {unit}".rstrip() + f", {side} limit {end}: "
                    f"{100 * max(left, 0.0) / span:.1f} % of its range left; move reference or limit"
                )
            if room.peak is not None and (beyond := [s for i, s in room.peak.beyond(room.limits) if i == k]):
                first = float((room.peak.low[k], room.peak.high[k])[beyond[0]])
                yield (
                    f"the feedforward of {name} begins with {number_text(first, '.4g')} {unit}".rstrip()
                    + f", limit {number_text((low, high)[beyond[0]], '.4g')}: start it with 'generator: steady'"
                )


def _gentle(controller: ProvedController) -> Iterator[str]:
    """Yield that the K that runs is hardly one, where it is made for starts with inputs at limits."""
    design = controller.design
    pairs = [(loop.cheaper, loop.gains.K) for loop in controller.claims_of(SampledLoop)] or [(design.cheaper, design.K)]
    for cheaper, K in pairs:
        norms = [0.0 if X is None else controller.sizes.norm(X) for X in (cheaper, K)]
        share = norms[0] / max(norms[1], TINY)
        if share > _HARDLY:
            yield (
                f"K is {share:.2g} times smaller than without limits, made for starts with inputs at them: it hardly "
                "acts; more room for inputs, or starts that are nearer, gives a larger one"
            )


def _sampling(spec: Spec, controller: ProvedController, margins: Margins | None) -> Iterator[str]:
    """Yield what sampling and single precision make of the gains, where that is not in a proof."""
    sampling, promised = spec.scenario.conditions.sampling, controller.guarantees
    quadratic = not any(part.degree > 2 for part in (*promised.controller, *promised.observer))
    of_gains = dict(zip("KL", promised.robust[1:], strict=True))
    for letter, share in of_gains.items():
        if quadratic and share < _SINGLE and getattr(controller, letter).any():
            yield (
                f"{letter} may change by {100 * share:.2g} % only, and single precision changes it by "
                f"{100 * _SINGLE:.1g} %: a smaller rate, or 'sizes', helps"
            )
    if sampling is None or proved_as_sampled(controller):
        return
    if found := refused(controller, spec.scenario.conditions):
        yield not_simulated(found[0])
        return
    h, K = sampling.sample_time, controller.K
    made = sampled_gains(controller.plant, K, controller.L, sampling).K
    change = float(np.abs(made - K).max() / np.abs(K).max()) if K.any() and np.isfinite(made).all() else 0.0
    fast, late = (0.0, 0.0) if margins is None else (margins.crossover * h, (0.5 + sampling.delay) * h)
    slow = list[tuple[float, str]]()  # the time (s) that would do, and why this one is too long
    if quadratic and change > of_gains["K"] and not sampling.corrects:  # else its gains are made for the sample time
        said = f"K acts as if changed by {100 * change:.2g} %, proved for {100 * of_gains['K']:.2g} %"
        slow.append((h * of_gains["K"] / change, said))
    if margins is not None and fast > _TENTH * 2 * np.pi:
        said = f"bandwidth {margins.crossover:.3g} rad/s, sampling {2 * np.pi / h:.3g} rad/s"
        slow.append((_TENTH * 2 * np.pi / margins.crossover, said))
    if margins is not None and margins.delay < late:
        where = f"in cell '{controller.plant.cell_names[margins.cell]}'"
        said = f"late by {late:.2g} s, and {margins.delay:.2g} s is the delay margin {where}"
        slow.append((h * margins.delay / late, said))
    if slow:
        short, said = min(slow)
        slower = "lower 'sizes' of inputs: a slower K"
        way = f"sample every {short:.1g} s, or {slower}" if short > _SHORT * h else f"{slower}; no sample time helps"
        yield f"every {number_text(h)} s is slow: {said}; {way}"


def plant_questions(plant: PWASystem) -> list[str]:
    """Say which elements give energy, and which modes of a plant run away or are not damped.

    Example: no cell of the paper's example does.

        >>> from pwatrack import load_spec
        >>> plant_questions(load_spec("specs/two_mass_backlash.yaml").problem.plant)
        []
    """
    found = [(mode, name) for A, name in zip(plant.A, plant.cell_names, strict=True) for mode in modes(A)]
    away, said = [(mode, name) for mode, name in found if mode.frequency and mode.time_constant < 0], list[str]()
    form = plant.written if away else None
    for element, A in () if form is None else ((one, form.A.floats) for one in form.elements):
        each = _pushes(A, element)
        rate, turned = max(each), min(each) >= 0
        if rate > 0 and not any(f"'{element.name}'" in remark for remark in plant.remarks):
            said.append(
                f"'{element.name}' pushes {_looked_at(element, plant)} on, {rate:.3g} 1/s² per unit: "
                + ("turn the sign of its 'into' if it should hold back" if turned else "right if it is to do so")
            )
    if away:
        mode, name = max(away, key=lambda one: -1 / one[0].time_constant)
        cells = f"{len({name for _, name in away})} of {len(plant.A)} cells"
        said.append(
            f"the plant alone runs away in {cells}, time constant {-mode.time_constant:.3g} s; right for pendulum or "
            f"reactor, wrong for a spring; fastest in '{name}'"
        )
    still = [(mode, name) for mode, name in found if mode.frequency and 0 <= mode.damping < _UNDAMPED]
    if still:
        mode, name = min(still, key=lambda one: one[0].damping)
        said.append(
            f"a mode at {mode.frequency:.3g} rad/s has damping {mode.damping:.2g}; if the machine has more, write it; "
            f"in '{name}'"
        )
    return said


def _pushes(A: Array, element: Nonlinearity) -> list[float]:
    """Return by how much each slope of an element drives what it looks at away, per unit of it: in 1/s², by a rate."""
    row, d = (np.array([float(v) for v in values]) for values in (element.row, element.direction))
    if row @ d != 0:
        return [0.0]
    terms = (row @ A) * d
    through = float(terms.sum()) if abs(terms.sum()) > 1e-12 * np.abs(terms).sum() else 0.0
    return [through * float(slope) for slope in element.function.slopes]


def _looked_at(element: Nonlinearity, plant: PWASystem) -> str:
    names = [name for name, v in zip(plant.states, element.row, strict=True) if float(v)]
    return names[0] if len(names) == 1 else "what it looks at"
