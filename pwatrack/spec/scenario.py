"""Checked sections -> courses, reference, objectives and scenario; what none can be built from is refused."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np
import scipy

from pwatrack.arrays import Array, readonly
from pwatrack.control.goal import AtLeast, Fastest, Given, Goal, LeastCost, Smallest
from pwatrack.errors import InvalidSpec, Problem, Subject
from pwatrack.model.conditions import Conditions, Noise, Quanta, Sampling
from pwatrack.model.loads import Load, Loads
from pwatrack.model.profile import Course, Formula, Profile, polyline
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import (
    InputReference,
    OutputReference,
    Reference,
    SetPoint,
    StateReference,
    exosystem,
    total_signal,
)
from pwatrack.model.signal import ExponentialPolynomial
from pwatrack.real import Box, Real, Uncertain
from pwatrack.simulation.region import BoxRegion, EllipsoidRegion, Region
from pwatrack.spec.design_section import DesignSection, GoalSection, LoadSection, ends_of
from pwatrack.spec.parametric import ParametricPlant
from pwatrack.spec.plant_section import SystemSection
from pwatrack.spec.signal_section import (
    OutsideSection,
    PolylineSection,
    ProfileSection,
    ReferenceSection,
    StepSection,
    TrapezoidSection,
)
from pwatrack.spec.simulation_section import EllipsoidSection, InitialSection, SimulationSection, StartRegionsSection
from pwatrack.spec.spec import InitialStates, Measured, Objectives, Scenario, Steady
from pwatrack.spec.table import FINEST, Folder, read_table
from pwatrack.spec.yaml_tree import path_text

_MOST_ROUNDED = 100  # periods of a trapezoid over which its corners are rounded
_MOST_PERIODS = 10_000  # of a trapezoid in a run: each adds pieces to the signal
_FASTEST = 1e9  # |λ| times the duration: further on, a phase is no longer known to eight digits
_AT_ONCE = 1e-12  # of a time: two that differ by less are one, but for rounding
_GROWN = 138.0  # λ times the duration: e^138 is 1e60


def build_reference(section: ReferenceSection, tracked: tuple[str, ...], folder: Folder, horizon: float) -> Reference:
    """Return what is to be tracked, up to a `horizon` in s; raises as `_all_courses`."""
    if section.setpoint is not None:
        return SetPoint(readonly([section.setpoint[name] for name in tracked]))
    kind = next(kind for kind in ("output", "state", "input") if getattr(section, kind) is not None)
    given, signals = getattr(section, kind), list[tuple[ProfileSection, Subject]]()
    if isinstance(given, ProfileSection):
        signals = [(given, ())]
    elif isinstance(given, dict):
        signals = [(given[name], (name,)) for name in tracked]
    else:
        signals = [(signal, (k,)) for k, signal in enumerate(given)]
    courses = _all_courses(signals, folder, horizon, ("reference", kind))
    if kind == "output":
        return OutputReference(courses, preview=section.preview == "auto")
    if kind == "state":
        return StateReference(courses)
    return InputReference(courses, readonly(section.start) if section.start else None)


def _all_courses(
    signals: Sequence[tuple[ProfileSection, Subject]], folder: Folder, horizon: float, subject: Subject
) -> tuple[tuple[Course, ...], ...]:
    """Return the courses whose sum each signal is, up to a `horizon` in s, or refuse with all that makes none at once.

    A signal comes with its path below a subject.
    """
    found, problems = list[tuple[Course, ...]](), list[Problem]()
    for section, where in signals:
        courses = list[Course]()
        for make in _makers(section, folder, horizon, (*subject, *where)):
            try:
                course = make()
                if course.end is not None and course.end < horizon * (1 - _AT_ONCE):
                    text = f" ends at t = {course.end:.6g} s, the simulation lasts until {horizon:.6g} s"
                    hint = "shorten the simulation or lengthen the signal; a move, then rest is a step with 'smooth'"
                    raise _refused(text, (*subject, *where), hint)
                courses.append(course)
            except InvalidSpec as error:
                problems += error.problems
        found.append(tuple(courses))
    if problems:
        raise InvalidSpec(*problems)
    return tuple(found)


def _makers(
    section: ProfileSection, folder: Folder, horizon: float, subject: Subject
) -> Iterator[Callable[[], Course]]:
    others = section.step or section.trapezoid or section.polyline or section.table
    if section.formula is not None or section.sine or section.constant or section.until or not others:
        yield partial(_formula, section, horizon, subject)
    yield from (partial(_step, step, horizon, (*subject, "step", k)) for k, step in enumerate(section.step))
    if section.trapezoid is not None:
        yield partial(_trapezoid, section.trapezoid, horizon, (*subject, "trapezoid"))
    if section.polyline is not None:
        yield partial(_polyline, section.polyline, horizon, (*subject, "polyline", "points"))
    if section.table is not None:
        yield partial(read_table, folder, section.table, (*subject, "table"))


def _refused(text: str, subject: Subject, hint: str = "") -> InvalidSpec:
    return InvalidSpec(path_text(subject) + text, subject=subject, hint=hint)


def _formula(section: ProfileSection, horizon: float, subject: Subject) -> Formula:
    t = ExponentialPolynomial.time()
    total = ExponentialPolynomial.constant(section.constant)
    for sine in section.sine:
        total = total + (t * sine.frequency + sine.phase).sin() * sine.amplitude
    if section.formula is not None:
        total = total + section.formula
    for rate, c in total.terms.items():
        if c.any() and abs(rate) * horizon > _FASTEST:
            what = f"a sine of {rate.imag:.3g} rad/s" if abs(rate.imag) > abs(rate.real) else f"exp({rate.real:.3g}*t)"
            raise _refused(
                f": {what} is too fast for {horizon:g} s: {abs(rate) * horizon:.3g} radians or "
                f"time constants, at most {_FASTEST:g} are followed",
                subject,
            )
        if c.any() and rate.real * horizon > _GROWN and section.until is not None:
            raise _refused(f": exp({rate.real:.3g}*t) is beyond 1e60 before {horizon:g} s", subject)
    return Formula(total, section.until)


def _step(step: StepSection, horizon: float, subject: Subject) -> Profile:
    half = (step.smooth or 0.0) / 2
    if step.at is not None and step.centre is not None:
        raise _refused(": give `at`, when it begins, or `centre`, its middle, not both", subject)
    middle = step.centre if step.at is None else step.at + half
    if middle is None:
        raise _refused(" says neither when it begins, `at`, nor where its middle is, `centre`", subject)
    begins = middle - half
    if begins < -FINEST * (middle + half):
        raise _refused(
            f": the step begins at t = {begins:.6g} s, before t = 0",
            subject,
            "say with at: when it begins, 0 or later; a value from before belongs into constant:",
        )
    _check_rounding(step.smooth, horizon + middle, subject)
    margin = 1.0 + horizon + middle + half
    corners = scipy.interpolate.PPoly(np.array([[0.0, step.size]]), [-margin, middle, margin + middle])
    return Profile(corners=corners, continuous=False, smooth=step.smooth, end=None)


def _trapezoid(shape: TrapezoidSection, horizon: float, subject: Subject) -> Profile:
    """Return the corners of as many trapezoids as the horizon holds; what is rounded begins at the start, too."""
    period = shape.rise + shape.hold + shape.fall + shape.rest
    start = shape.start + (shape.smooth or 0.0) / 2
    span = horizon - start
    if span / period > _MOST_PERIODS:
        message = f": {span / period:.3g} trapezoids until t = {horizon:g} s"
        raise _refused(message, subject, f"at most {_MOST_PERIODS:,} are built; shorten the simulation")
    if shape.smooth and shape.smooth / period > _MOST_ROUNDED:
        message = f": smooth: {shape.smooth:g} s rounds over {shape.smooth / period:.3g} periods of {period:g} s"
        raise _refused(message, subject, f"at most {_MOST_ROUNDED}: little is left of them by far less")
    _check_rounding(shape.smooth, horizon + abs(shape.start), subject)
    for name in ("rise", "fall"):
        _check_fine(f"{name}: {getattr(shape, name):g} s", getattr(shape, name), horizon + abs(shape.start), subject)
    margin = 1.0 + (shape.smooth or 0.0)
    count = max(0, int(np.ceil((span + margin) / period)))
    begins = start + period * np.arange(count)
    marks = begins[:, None] + np.cumsum([0.0, shape.rise, shape.hold, shape.fall])
    first = min(0.0, start) - margin
    last = max(horizon, float(marks[-1, -1]) if count else horizon) + margin + shape.rest + abs(start)
    times = np.concatenate([[first], marks.ravel(), [last]])
    values = np.concatenate([[shape.low], np.tile([shape.low, shape.high, shape.high, shape.low], count), [shape.low]])
    kept = np.append(True, np.diff(times) > 0)
    course = polyline(times[kept].tolist(), values[kept].tolist())
    return Profile(corners=course, continuous=True, smooth=shape.smooth, end=horizon)


def _polyline(section: PolylineSection, horizon: float, subject: Subject) -> Profile:
    for k, row in enumerate(section.points):
        if len(row) != 2:
            raise _refused(": a point is a pair [t, y]", (*subject, k))
    times, values = [row[0] for row in section.points], [row[1] for row in section.points]
    span = horizon + max(map(abs, times))
    for k, (before, after) in enumerate(itertools.pairwise(times)):
        if after <= before:
            message = f": t = {after:g} s does not come after {before:g} s"
            raise _refused(message, (*subject, k + 1), "points are pairs [t, y] with increasing t")
        _check_fine(
            f"points {k + 1} and {k + 2}, {after - before:.3g} s apart,", after - before, span, (*subject, k + 1)
        )
    _check_rounding(section.smooth, span, subject)
    margin = 1.0 + span + (section.smooth or 0.0)
    first, before = times[0] - margin, values[0]
    if times[0] == 0.0 and len(times) > 1:  # nothing is before t = 0, so there is no corner either
        before -= (values[1] - values[0]) / times[1] * margin
        times, values = times[1:], values[1:]
    course = polyline([first, *times, times[-1] + margin], [before, *values, values[-1]])
    half = (section.smooth or 0.0) / 2
    for t, kink in zip(course.x[1:-1].tolist(), np.diff(course.c[0]).tolist(), strict=True):
        if kink and abs(t) < half * (1 - _AT_ONCE):
            raise _refused(
                f": the corner at t = {t:g} s is rounded from t = {t - half:.6g} s on, before t = 0",
                (*subject, [row[0] for row in section.points].index(t)),
                f"let the first corner be at t = {half:g} s or later, or round less; a line that begins at t = 0 has "
                "no corner there",
            )
    return Profile(corners=course, continuous=True, smooth=section.smooth, end=None)


def _check_fine(what: str, length: float, span: float, subject: Subject) -> None:
    """Refuse times that are not apart but for rounding."""
    if length < FINEST * span:
        least = f"at least {FINEST * span:.1g} s are told apart"
        raise _refused(f": {what} is too short beside {span:g} s: {least}", subject)


def _check_rounding(smooth: float | None, span: float, subject: Subject) -> None:
    if smooth is not None:
        _check_fine(f"smooth: {smooth:g} s", smooth, span, subject)


def build_loads(estimate: Literal["input"] | Mapping[str, LoadSection] | None, system: SystemSection) -> Loads | None:
    """Return the loads that are to be estimated; None for none."""
    if estimate is None:
        return None
    if isinstance(estimate, str):
        columns = [
            {j: v for j, v in enumerate(column) if v.centre or v.radius} for column in zip(*system.B, strict=True)
        ]
        loads = [Load(name=f"load_{name}", into=into) for name, into in zip(system.inputs, columns, strict=True)]
    else:
        loads = [
            Load(
                name=name,
                into={system.states.index(state): factor for state, factor in section.into.items()},
                frequency=section.frequency or Real.of(0),
            )
            for name, section in estimate.items()
        ]
    return Loads.of(loads, states=len(system.states))


def _vector(values: Mapping[str, float], names: Sequence[str], missing: float = 0.0) -> Array:
    """Return values in the order of names; `missing` may be infinite."""
    found = np.array([values.get(name, missing) for name in names], dtype=np.float64)
    found.flags.writeable = False
    return found


def _initial_states(section: InitialSection, states: Sequence[str]) -> InitialStates:
    """Return where a run starts; states that are not named start at 0."""

    def start(values: Mapping[str, float] | Sequence[float] | None) -> Array | None:
        return _vector(values, states) if isinstance(values, Mapping) else None if values is None else readonly(values)

    plant, observer, generator = section.plant, section.observer, section.generator
    eta = Steady() if isinstance(generator, str) else readonly(generator) if isinstance(generator, list) else generator
    return InitialStates(
        plant=Steady() if isinstance(plant, str) else start(plant),
        observer=(Measured() if observer == "measured" else Steady()) if isinstance(observer, str) else start(observer),
        generator=eta,
    )


def _regions(section: StartRegionsSection | None, states: Sequence[str], nominal: InitialStates) -> dict[str, Region]:
    """Return where the members of an ensemble start, by part; entries that are not named stay at the nominal start."""
    found: dict[str, Region] = {}
    for part in ("plant", "observer"):
        asked, start = getattr(section, part, None), getattr(nominal, part)
        if asked is None:
            continue
        center = dict.fromkeys(states, 0.0)
        if isinstance(start, np.ndarray):
            center |= zip(states, start.tolist(), strict=True)
        if isinstance(asked, EllipsoidSection):
            center |= asked.ellipsoid.center
            found[part] = EllipsoidRegion(center=_vector(center, states), radii=_vector(asked.ellipsoid.radii, states))
        else:
            low, high = zip(*(asked.get(name, [value, value]) for name, value in center.items()), strict=True)
            found[part] = BoxRegion(low=readonly(low), high=readonly(high))
    if section is not None and section.generator is not None:
        low, high = zip(*section.generator, strict=True) if section.generator else ((), ())
        found["generator"] = BoxRegion(low=readonly(low), high=readonly(high))
    return found


def build_objectives(section: DesignSection, parametric: ParametricPlant) -> Objectives:
    """Return what the gains are to achieve; `parametric` is the plant as a function of its parameters."""
    return Objectives(
        controller=_goal(section.controller, section.controller.K),
        observer=_goal(section.observer, section.observer.L),
        solver=section.solver,
        uncertain=_box(section.uncertain, parametric),
        practical=section.tracking == "practical",
    )


def _goal(section: GoalSection, given: list[list[float]] | None) -> Goal:
    """Return what a gain is to achieve; `given` is K or L itself."""
    rate, gain = section.rate, section.gain
    if given is not None:
        return Given(gain=readonly(given))
    if section.cost is not None:
        return LeastCost(Q=readonly(section.cost.Q), R=readonly(section.cost.R))
    bound = np.inf if gain is None or gain == "smallest" else gain
    within = getattr(section, "within", None)
    if rate == "largest" or (rate is None and gain is not None):
        return Fastest(bound=bound, within=within)
    if gain == "smallest":
        return Smallest(rate=rate or 0.0)
    return AtLeast(rate=rate or 0.0, bound=bound, within=within)


def _box(uncertain: Mapping[str, Real | tuple[Real, Real]], parametric: ParametricPlant) -> Box:
    uses, box = dict[str, frozenset[str]](), []  # the parameters that the value of each is made of
    for name, written in parametric.parameters.items() if uncertain else ():
        direct = written.names & uses.keys()
        uses[name] = direct.union(*(uses[other] for other in direct))
    for name, given in uncertain.items():
        nominal = parametric.names.parameters[name]
        assert nominal is not None
        low, high = ends_of(nominal, given)
        box.append(Uncertain(name=name, nominal=nominal, low=low, high=high, uses=uses[name]))
    return tuple(box)


def build_conditions(
    section: SimulationSection,
    plant: PWASystem,
    parametric: ParametricPlant,
    folder: Folder,
    outside: OutsideSection | None = None,
) -> Conditions:
    """Return what is not as the theorems assume; raises as `_all_courses`, and as the plant does that runs."""
    running = changed = limits = noise = disturbance = quanta = sampling = None
    if section.actuator is not None:
        limits = np.array([section.actuator.limits.get(name, [-np.inf, np.inf]) for name in plant.inputs])
    if section.noise is not None and any(section.noise.std.values()):
        std = _vector(section.noise.std, plant.outputs)
        noise = Noise(std=std, sample_time=section.noise.sample_time, seed=section.noise.seed)
    if section.disturbance is not None:
        signals = [(section.disturbance.get(name, ProfileSection()), (name,)) for name in plant.states]
        courses = _all_courses(signals, folder, section.duration, ("simulation", "disturbance"))
        found = exosystem([total_signal(course, 0) for course in courses])
        disturbance = found if found.Q.any() else None
    if section.plant is not None:
        running, changed = parametric.at(section.plant.parameters, ("simulation", "plant", "parameters"))
    if section.quantum:
        quanta = Quanta(inputs=_vector(section.quantum, plant.inputs), outputs=_vector(section.quantum, plant.outputs))
        limits = None if limits is None else quanta.within(limits)
    if (sampled := section.controller) is not None:
        sampling = Sampling(
            sample_time=sampled.period, method=sampled.method, delay=sampled.delay, jitter=sampled.jitter
        )
    paces = [outside.filter[name] for name in plant.tracked_names] if outside is not None else []
    return Conditions(
        quanta=quanta,
        pace=readonly([pace.limits for pace in paces]) if paces else None,
        set_range=np.array([pace.range or [-np.inf, np.inf] for pace in paces]) if paces else None,
        rates=_vector(section.rate_limit, plant.inputs, np.inf) if section.rate_limit else None,
        plant=running,
        parameters=changed,
        limits=limits if limits is not None and np.isfinite(limits).any() else None,
        disturbance=disturbance,
        noise=noise,
        sampling=sampling,
    )


def build_scenario(section: SimulationSection, states: Sequence[str], conditions: Conditions) -> Scenario:
    """Return what is simulated under given conditions."""
    initial = _initial_states(section.initial, states)
    names = section.ensemble.plane or (states[0], states[min(1, len(states) - 1)])  # one twice where there is one
    first, second = map(states.index, names)
    return Scenario(
        duration=section.duration,
        sample_time=section.sample_time,
        initial=initial,
        conditions=conditions,
        regions=_regions(section.ensemble.initial, states, initial),
        plane=(first, second),
        intervals={name: (low, high) for name, (low, high) in section.ensemble.parameters.items()},
        portraits=tuple((one, other) for one, other in section.portraits),
        bands=section.settled,
    )
