"""What a spec wants tracked: its reference, checked, the desired trajectory, and where the parts of a run start."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from pwatrack.arrays import EPS, Array
from pwatrack.claims.robust import check_without_loads
from pwatrack.control.compensation import check_played_back, compensation
from pwatrack.control.controller import ProvedController
from pwatrack.control.generator import TrajectoryGenerator, trajectory_generator
from pwatrack.control.goal import DEFAULT
from pwatrack.control.headroom import Starts
from pwatrack.control.modes import check_loads, check_modes
from pwatrack.control.realisable import input_trajectory, set_point, state_trajectory
from pwatrack.control.synthesis import Gains
from pwatrack.control.trajectory import DesiredTrajectory, output_trajectory, timing_error
from pwatrack.errors import CheckFailed, Infeasible, InvalidSpec, OutsideTheory, Problem, PwatrackError, Remedy, Way
from pwatrack.model.normal_form import NormalForm, normal_form
from pwatrack.model.profile import Table
from pwatrack.model.reference import (
    InputReference,
    OutputReference,
    SetPoint,
    StateReference,
    check_bounded,
    check_smooth,
    exosystem,
    shortest_rounding,
)
from pwatrack.model.signal import Signal
from pwatrack.model.simplification import scalar_form, widest
from pwatrack.model.sizes import Sizes
from pwatrack.simulation.bounded import bounded_response
from pwatrack.simulation.desired import realised
from pwatrack.simulation.region import BoxRegion, Region
from pwatrack.simulation.stable_inversion import played_back
from pwatrack.simulation.steady_state import consistent_start, from_measured
from pwatrack.spec.box import check_box
from pwatrack.spec.spec import Measured, Spec, Steady
from pwatrack.spec.wording import guess, shown
from pwatrack.workflow.sizing import spec_sizes

ALLOWED = 1e-9  # of the size of the reference: what timing may miss, as exact as everything else that is shown
_ROUNDED = 1e-12  # of its size: x̂ that is no further off x at the start is x


def check_reference(spec: Spec, form: NormalForm | None = None) -> str:
    """Check what can be known of the reference before an inequality is solved, and say it in a few words.

    That is: bounded, smooth enough for the relative degree (Theorem 3), realisable (3), an equilibrium of some cell.
    """
    problem = spec.problem
    with spec.located():
        check_unknown(spec)
        if isinstance(problem.reference, OutputReference):
            form = form or spec_form(spec)
            _output_signals(problem.reference, form)
            if not isinstance(spec.scenario.initial.generator, Steady | None):
                _given_start(spec, form.eta_names)
            return f"y_d is bounded and smooth enough for relative degree {form.degrees_text}"
        _state_desired(spec)
        if isinstance(problem.reference, SetPoint):
            said = "x_d is an equilibrium with the wanted outputs"
            if problem.plant.B.shape[1] > len(problem.plant.tracked):
                said += ", of many the least in sizes"
                said += ", within limits of inputs" * (spec.scenario.conditions.limits is not None)
            return said
        if isinstance(problem.reference, InputReference):
            return "u_ff is bounded; x_d is the response of the plant"
        return "x_d is bounded and satisfies (3)"


def check_unknown(spec: Spec) -> None:
    """Refuse loads and parameters that are not known, where nothing is proved of such: before anything is solved."""
    problem, box = spec.problem, spec.objectives.uncertain
    check_loads(problem.plant, output=problem.tracking == "output")
    if box:
        check_box(problem.parametric, box)
        check_without_loads(problem.plant)


def desired_trajectory(spec: Spec, growing: bool, form: NormalForm | None = None) -> DesiredTrajectory:
    """Return the desired trajectory; for output tracking that of a generator, in a form that is known."""
    plant, reference = spec.problem.plant, spec.problem.reference
    if not isinstance(reference, OutputReference):
        trajectory, where = _state_desired(spec), ("reference", "start")
        if not isinstance(reference, InputReference):
            return trajectory
        try:
            return bounded_response(plant, trajectory, horizon=spec.scenario.duration, subject=where)
        except CheckFailed as growth:
            if not growing:
                raise
            return replace(trajectory, bounded=False, growth=growth.problems[0])
    form = form or spec_form(spec)
    y_d = _output_signals(reference, form)
    generator = spec_generator(spec, form, known=reference.preview)
    trajectory = output_trajectory(generator, exosystem(y_d))
    if not generator.played_back:
        return trajectory
    check_played_back(form)
    return played_back(trajectory, spec.scenario.duration, reference.played)


def spec_form(spec: Spec) -> NormalForm:
    """Return the normal form (11) of a plant; of more inputs than outputs, u_ff takes the least in their sizes."""
    plant = spec.problem.plant
    several = plant.B.shape[1] > len(plant.tracked)
    try:
        return normal_form(plant, input_sizes=spec_sizes(spec).input if several else None)
    except OutsideTheory as refusal:
        raise _advised(refusal, spec) from None


def _advised(refusal: PwatrackError, spec: Spec) -> PwatrackError:
    """Return the refusal with the kinds of tracking that may help in place of the one it names.

    State tracking, where no eigenvalue decides against it; practical tracking, where that is not tried by itself.
    """
    plant, goals = spec.problem.plant, spec.objectives
    try:
        check_modes(plant, DEFAULT, DEFAULT, spec_sizes(spec))
        by_state = True
    except Infeasible:
        by_state = False
    by_itself = isinstance(refusal, Infeasible)
    form = None if by_itself or goals.practical or goals.uncertain else scalar_form(plant)
    merging = form is not None and bool(widest(form))
    ways = {(True, True): Way.STATE_OR_PRACTICAL, (True, False): Way.STATE_TRACKING, (False, True): Way.PRACTICAL}
    way, named = ways.get((by_state, merging)), Remedy(Way.STATE_TRACKING)
    remedy = None if way is None else Remedy(way)
    told = (replace(p, remedy=remedy) if p.remedy == named else p for p in refusal.problems)
    return type(refusal)(*told, evidence=refusal.evidence)


def spec_generator(spec: Spec, form: NormalForm, *, known: bool) -> TrajectoryGenerator:
    """Return the generator of a plant in the form (11), or advise state tracking where no eigenvalue is against it."""
    try:
        return trajectory_generator(form, preview=known)
    except PwatrackError as refusal:
        raise _advised(refusal, spec) from None


def _output_signals(reference: OutputReference, form: NormalForm) -> list[Signal]:
    """Return y_d, each checked for what its own relative degree needs."""
    compensation(form.plant, form, 0)  # refuses loads that nothing is known to make up for
    signals, names = reference.signals(form.degrees), form.plant.tracked_names
    for signal, name, r in zip(signals, names, form.degrees, strict=True):
        alone = len(names) == 1
        _check([signal], r, ("reference", "output", *(() if alone else (name,))), "y_d" if alone else f"{name}_d")
    return signals


def _state_desired(spec: Spec) -> DesiredTrajectory:
    """Return the desired trajectory of state tracking."""
    plant, reference = spec.problem.plant, spec.problem.reference
    if isinstance(reference, SetPoint):
        sizes, limits = spec_sizes(spec), spec.scenario.conditions.limits
        of_all = np.concatenate([sizes.state, sizes.input])
        return set_point(plant, reference.y, sizes=of_all, limits=limits, subject=("reference", "setpoint"))
    assert not isinstance(reference, OutputReference)
    signals = reference.signals()
    if isinstance(reference, InputReference):
        _check(signals, None, ("reference", "input"), "u_ff")
        u_ff = exosystem(signals)
        if starts_periodic(spec) and u_ff.period is None and not u_ff.constant:
            message = "start: periodic, but the inputs together have no period"
            hint = "give x_d(0) as start, or inputs whose frequencies have whole-number ratios"
            raise InvalidSpec(message, subject=("reference", "start"), hint=hint)
        return input_trajectory(plant, u_ff, reference.start)
    _check(signals, 1, ("reference", "state"), "x_d")
    x_d = state_trajectory(plant, exosystem(signals))
    return realised(plant, x_d, horizon=spec.scenario.duration, subject=("reference", "state"))  # (3)


def reference_remarks(spec: Spec, form: NormalForm | None) -> tuple[str, ...]:
    """Say where the feedforward of a plant in form (11) follows noise of a measured reference rather than that."""
    reference = spec.problem.reference
    if not isinstance(reference, OutputReference) or form is None:
        return ()
    plant, said = spec.problem.plant, list[str]()
    pairs = [(j, course) for j, courses in enumerate(reference.courses) for course in courses]
    for j, course in pairs:
        r, needed = form.degrees[j], np.abs(form.right_inverse[:, :, j]).max(axis=0)
        rough = course.roughness(r) if isinstance(course, Table) else None
        if rough is not None:
            k = int(np.argmax(needed))
            unit = spec.problem.units.get(plant.inputs[k], "")
            whole, left = (f"{abs(size * needed[k]):.3g} {unit}".rstrip() for size in (rough.whole, rough.left))
            said.append(
                f"noise or corners of the table make its derivative {r} {rough.whole / rough.left:.3g} times as large "
                f"as what is left of it below {rough.cutoff:.3g} Hz; the feedforward follows: about {whole} instead of "
                f"{left}; 'filter: {{cutoff: {rough.cutoff:.3g}}}' in the table takes them away"
            )
    return tuple(said)


def check_breaks(spec: Spec, trajectory: DesiredTrajectory, gains: Gains) -> None:
    """Refuse a reference that changes so fast that the rounding of its break times can be seen.

    Where its corners are rounded, the shortest rounding that would do is said.
    """
    plant, reference, tracking = spec.problem.plant, spec.problem.reference, spec.problem.tracking
    outputs = np.eye(len(plant.states)) if tracking == "state" else plant.tracked
    worst, time = timing_error(plant, gains.K, trajectory, outputs=outputs)
    if worst <= ALLOWED:
        return
    smooth = shortest_rounding(reference.courses if isinstance(reference, OutputReference | StateReference) else ())
    said, remedy = "", None
    if smooth is not None:
        reached = 1 if trajectory.generator is None else min(trajectory.generator.form.degrees)  # derivatives, by u_ff
        said = f"smooth: {smooth:g} s is too short: "
        remedy = Remedy(Way.LONGER_ROUNDING, (smooth * (worst / ALLOWED) ** (1 / reached),))
    raise InvalidSpec(
        f"{said}the time of a break at t = {time:.6g} s is known to {EPS * time:.1g} s, and the reference "
        f"is so fast there that this alone makes a tracking error of about {worst:.1g} of its own size; "
        f"up to {ALLOWED:g} is taken",
        subject=("reference", tracking),
        hint="round its corners over a longer time",
        remedy=remedy,
    )


def _check(signals: list[Signal], r: int | None, subject: tuple[str, ...], name: str) -> None:
    for signal in signals:
        check_bounded(signal, name=name, subject=subject)
        if r is not None:
            check_smooth(signal, r, name=name, subject=subject)


def start_fixed(spec: Spec, controller: ProvedController) -> bool:
    """Say whether the reference itself says where the desired trajectory starts."""
    return controller.trajectory.eta0 is not None or starts_periodic(spec)


def starts_periodic(spec: Spec) -> bool:
    """Say whether the desired trajectory is to be the periodic response to given inputs."""
    return isinstance(spec.problem.reference, InputReference) and spec.problem.reference.start is None


def start_given_twice(subject: tuple[str, ...]) -> InvalidSpec:
    """Return the refusal of a start of the desired trajectory beside that of the reference."""
    message = f"{'.'.join(subject)}: the reference itself says where the desired trajectory starts"
    return InvalidSpec(message, subject=subject, hint="leave it out")


def generator_start(spec: Spec, trajectory: DesiredTrajectory) -> Array:
    """Return η̂(0), in order or by the generator's names of states; that of `consistent_start` if none is given."""
    if isinstance(spec.scenario.initial.generator, Steady | None):
        return consistent_start(trajectory, trajectory.generator)[0]
    return _given_start(spec, trajectory.names)


def _given_start(spec: Spec, names: Sequence[str]) -> Array:
    """Return η̂(0) that is given; refuses entries that a generator with states of these names has not."""
    given, subject = spec.scenario.initial.generator, ("simulation", "initial", "generator")
    assert not isinstance(given, Steady | None)
    if not names:
        text = f"{'.'.join(subject)}: the trajectory generator has no states here"
        raise InvalidSpec(text, subject=subject, hint="leave it out")
    if not isinstance(given, Mapping):
        return initial_values(given, len(names), "generator")
    unknown = [
        Problem(
            message=f"{'.'.join(subject)}: {shown(name)} is no state of the generator: "
            f"{', '.join(names)}{guess(name, names)}",
            subject=(*subject, name),
        )
        for name in given
        if name not in names
    ]
    if unknown:
        raise InvalidSpec(*unknown)
    return np.array([given.get(name, 0.0) for name in names])


def start_remarks(spec: Spec, trajectory: DesiredTrajectory) -> tuple[str, ...]:
    """Say what was taken where a steady state is asked for that there is not, and where x̂ begins beside one."""
    initial, found = spec.scenario.initial, list[str]()
    asked = [part for part in ("plant", "generator") if isinstance(getattr(initial, part), Steady)]
    if asked and trajectory.eta0 is None and (said := consistent_start(trajectory, trajectory.generator)[1]):
        found.append(f"simulation.initial.{asked[-1]}: there is no steady state: {said}")
    apart = isinstance(initial.plant, Steady) and initial.observer is None and "observer" not in spec.scenario.regions
    if apart and plant_start(spec, trajectory, trajectory.eta0).any():
        found.append(
            "simulation.initial: the plant begins on x_d, its observer at 0: 'observer: steady' begins there too"
        )
    return tuple(found)


def plant_start(spec: Spec, trajectory: DesiredTrajectory, eta: Array | None = None) -> Array:
    """Return x(0); in steady state it is x_d(0), from which the plant follows its reference, or rests with it.

    `eta` is η̂(0), where the reference says it; else it is that of `consistent_start`.
    """
    given = spec.scenario.initial.plant
    if not isinstance(given, Steady):
        return initial_values(given, len(spec.problem.plant.states), "plant")
    eta = consistent_start(trajectory, trajectory.generator)[0] if eta is None else eta
    return trajectory.state(np.concatenate([eta, trajectory.exosystem.w0, [1.0]]))


def observer_start(spec: Spec, trajectory: DesiredTrajectory, eta: Array) -> Array:
    """Return x̂(0), where it is not what is measured; in steady state it is x_d(0), as η̂(0) has it."""
    given = spec.scenario.initial.observer
    assert not isinstance(given, Measured)
    if isinstance(given, Steady):
        return trajectory.state(np.concatenate([eta, trajectory.exosystem.w0, [1.0]]))
    return initial_values(given, len(spec.problem.plant.states), "observer")


def initial_values(values: Array | None, length: int, part: str) -> Array:
    """Return where a part starts, 0 where nothing is said; refuses another number of entries."""
    if values is None:
        return np.zeros(length)
    if len(values) != length:
        subject = ("simulation", "initial", part)
        raise InvalidSpec(f"simulation.initial.{part}: {len(values)} entries, expected {length}", subject=subject)
    return values


def starts_of(
    spec: Spec, trajectory: DesiredTrajectory, plant_at: Array, generator: Array | None, sizes: Sizes
) -> Iterator[Starts]:
    """Yield the errors with which a run begins, and the members of its ensemble, where it is known where x_d does.

    Noise and steps of a sensor are left out, and a disturbance that is no load which is estimated, from 0 on. In the
    sizes the observer makes the least of what is measured. `plant_at` is x(0), `generator` η̂(0) if it is known.
    """
    plant, initial, regions = spec.problem.plant, spec.scenario.initial, spec.scenario.regions
    if "generator" in regions or (generator is None and trajectory.names):
        return
    eta = np.zeros(0) if generator is None else generator
    x_d = trajectory.state(np.concatenate([eta, trajectory.exosystem.w0, [1.0]]))
    n, loads, disturbance = len(x_d), plant.loads, spec.scenario.conditions.disturbance
    acting, loaded = np.zeros(len(sizes.load)), False
    if loads is not None and disturbance is not None and loads.are(disturbance):
        loaded = True
        acting[list(loads.where)] = -loads.truth(disturbance.Q, disturbance.rates) @ disturbance.w0
    for varied in ({}, regions) if regions else ({},):
        x = _columns(varied.get("plant"), plant_at)
        if isinstance(initial.observer, Measured):
            x_hat, own = from_measured(sizes, plant.C) @ plant.C @ x, np.zeros((n, 0))
        else:
            start = _columns(varied.get("observer"), observer_start(spec, trajectory, eta))
            x_hat, own = np.hstack([start[:, :1], np.zeros((n, x.shape[1] - 1))]), start[:, 1:]
        e = np.hstack([x, np.zeros(own.shape)])
        e[:, 0] -= x_d
        load, delta = np.zeros((len(sizes.load), e.shape[1])), np.hstack([x_hat - x, own])
        load[:, 0] = acting
        if not (varied or loaded) and (np.abs(delta) <= _ROUNDED * sizes.state[:, None]).all():
            yield Starts(kind="run", e=e)
            continue
        kind: Literal["ensemble", "run"] = "ensemble" if varied else "run"
        yield Starts(kind=kind, e=e, delta=delta, load=load if len(load) else None)
        if varied:
            yield Starts(kind="members", e=e[:, : x.shape[1]])


def _columns(region: Region | None, point: Array) -> Array:
    """Return the centre of a region and, for each entry that varies, by how much; of an ellipsoid the box around it."""
    if region is None:
        return point[:, None]
    if isinstance(region, BoxRegion):
        centre, radii = (region.low + region.high) / 2, (region.high - region.low) / 2
    else:
        centre, radii = region.center, region.radii
    return np.hstack([centre[:, None], np.diag(radii)[:, radii > 0]])
