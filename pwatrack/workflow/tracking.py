"""What a spec wants tracked: its reference, checked, and the desired trajectory."""

from dataclasses import replace

import numpy as np

from pwatrack.control.compensation import check_played_back, compensation
from pwatrack.control.controller import ProvedController
from pwatrack.control.generator import TrajectoryGenerator, trajectory_generator
from pwatrack.control.modes import check_loads
from pwatrack.control.realisable import input_trajectory, set_point, state_trajectory
from pwatrack.control.synthesis import Gains
from pwatrack.control.trajectory import DesiredTrajectory, check_timing, output_trajectory
from pwatrack.errors import CheckFailed, InvalidSpec, PwatrackError, Subject
from pwatrack.model.normal_form import NormalForm
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
from pwatrack.simulation.bounded import bounded_response
from pwatrack.simulation.desired import realised
from pwatrack.simulation.stable_inversion import played_back
from pwatrack.spec.spec import Spec
from pwatrack.workflow.sizing import advised, spec_form


def check_reference(spec: Spec, form: NormalForm | None = None) -> str:
    """Check what can be known of the reference before an inequality is solved, and say it in a few words.

    That is: bounded, smooth enough for the relative degree (Theorem 3), realisable (3), an equilibrium of some cell.
    """
    problem = spec.problem
    with spec.located():
        check_loads(problem.plant, output=problem.tracking == "output")
        if isinstance(problem.reference, OutputReference):
            form = form or spec_form(spec)
            _output_signals(problem.reference, form)
            return f"y_d is bounded and smooth enough for relative degree {form.degrees_text}"
        _state_desired(spec)
        if isinstance(problem.reference, SetPoint):
            return "x_d is an equilibrium with the wanted outputs"
        if isinstance(problem.reference, InputReference):
            return "u_ff is bounded; x_d is the response of the plant"
        return "x_d is bounded and satisfies (3)"


def desired_trajectory(
    spec: Spec, growing: bool, form: NormalForm | None = None
) -> tuple[DesiredTrajectory, TrajectoryGenerator | None]:
    """Return the desired trajectory, and for output tracking the generator it comes from, in a form that is known."""
    plant, reference = spec.problem.plant, spec.problem.reference
    if not isinstance(reference, OutputReference):
        trajectory, where = _state_desired(spec), ("reference", "start")
        if not isinstance(reference, InputReference):
            return trajectory, None
        horizon = spec.scenario.duration
        try:
            return bounded_response(plant, trajectory, horizon=horizon, subject=where), None
        except CheckFailed as growth:
            if not growing:
                raise
            return replace(trajectory, bounded=False, growth=growth.problems[0]), None
    form = form or spec_form(spec)
    y_d = _output_signals(reference, form)
    generator = spec_generator(spec, form, known=reference.preview)
    trajectory = output_trajectory(generator, exosystem(y_d))
    if not generator.played_back:
        return trajectory, generator
    check_played_back(form)
    return played_back(trajectory, spec.scenario.duration), generator


def spec_generator(spec: Spec, form: NormalForm, *, known: bool) -> TrajectoryGenerator:
    """Return the generator of a plant in the form (11), or advise state tracking where no eigenvalue is against it."""
    try:
        return trajectory_generator(form, preview=known)
    except PwatrackError as refusal:
        raise advised(refusal, spec) from None


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
        return set_point(plant, reference.y, subject=("reference", "setpoint"))
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


def check_breaks(
    spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None, gains: Gains
) -> None:
    """Refuse a reference whose breaks cannot be timed well enough."""
    plant, reference, tracking = spec.problem.plant, spec.problem.reference, spec.problem.tracking
    rounded = reference.courses if isinstance(reference, OutputReference | StateReference) else ()
    smooth = shortest_rounding(rounded)
    try:
        check_timing(
            plant,
            gains.K,
            trajectory,
            outputs=np.eye(len(plant.states)) if tracking == "state" else plant.tracked,
            smooth=None if smooth is None else (smooth, 1 if generator is None else min(generator.form.degrees)),
            subject=("reference", tracking),
        )
    except InvalidSpec as fast:
        said = "" if smooth is None else f"smooth: {smooth:g} s is too short: "
        raise InvalidSpec(*(p.prefixed(said) for p in fast.problems)) from None


def _check(signals: list[Signal], r: int | None, subject: Subject, name: str) -> None:
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


def start_given_twice(subject: Subject) -> InvalidSpec:
    """Return the refusal of a start of the desired trajectory beside that of the reference."""
    where = ".".join(map(str, subject))
    message = f"{where}: the reference itself says where the desired trajectory starts"
    return InvalidSpec(message, subject=subject, hint="leave it out")
