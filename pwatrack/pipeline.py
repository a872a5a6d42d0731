"""From a spec to its result, step by step as in Section IV of the paper. No input or output."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.controller import Controller
from pwatrack.control.cost import cost_bound
from pwatrack.control.generator import TrajectoryGenerator, trajectory_generator
from pwatrack.control.goal import LeastCost
from pwatrack.control.proof import prove_design
from pwatrack.control.set_point import set_point
from pwatrack.control.state_tracking import input_trajectory, state_trajectory
from pwatrack.control.synthesis import Design, synthesize
from pwatrack.control.task import Task
from pwatrack.control.timing import check_timing
from pwatrack.control.trajectory import DesiredTrajectory, output_trajectory
from pwatrack.errors import CheckFailed, InvalidSpec, Problem, Subject
from pwatrack.lmi.role import CONTROLLER, OBSERVER
from pwatrack.model.normal_form import NormalForm, normal_form
from pwatrack.model.reference import (
    InputReference,
    OutputReference,
    SetPoint,
    StateReference,
    check_bounded,
    check_smooth,
    exosystem,
)
from pwatrack.model.signal import Signal
from pwatrack.outcome import Outcome, Watch
from pwatrack.simulation.bounded import bounded_response
from pwatrack.simulation.closed_loop import ClosedLoop, Response, closed_loop
from pwatrack.simulation.desired import realised
from pwatrack.simulation.flow import Mode
from pwatrack.simulation.propagate import sample_count, trace_blocks
from pwatrack.simulation.spool import Spool
from pwatrack.simulation.steady_state import SteadyState, periodic_state
from pwatrack.simulation.trace import Trace, Unresolved, last_tenth
from pwatrack.spec.spec import Spec

_MOST_KEPT = 250_000  # samples
_LONGEST_PERIOD = 1e6  # radians in which a steady state is looked for


@dataclass(frozen=True, kw_only=True)
class Result:
    """A designed and simulated closed loop.

    Attributes:
        spec: What was asked.
        controller: Gains, desired trajectory and their proofs.
        loop: The closed loop.
        response: Its signals; of a run with more than a few hundred thousand samples only every so many-th, and
            in events only what these show.
        figures: What was measured over all samples.
        outcome: How the run ended, said by all samples.
        start: z(0).
        steady_state: One period of the generator's steady state (η̂, w, 1) with its Floquet multipliers,
            or None if it has none.
        spool: All samples and events of a run of which `response` has not all.
    """

    spec: Spec
    controller: Controller
    loop: ClosedLoop
    response: Response
    figures: "Figures"
    outcome: Outcome
    start: Array
    steady_state: SteadyState | None
    spool: Spool | None

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was noticed and changes no verdict."""
        S = self.controller.trajectory.exosystem.S
        fastest = float(np.abs(np.linalg.eigvals(S).imag).max(initial=0.0)) if S.size else 0.0
        remarks = list(dict.fromkeys(self.spec.problem.plant.remarks + self.loop.plant.remarks))
        duration, step = self.spec.scenario.duration, self.spec.scenario.sample_time
        if fastest * step > 2 * np.pi / 10:
            remarks.append(
                f"sample_time {step:g} s is too long for a reference with a period of "
                f"{2 * np.pi / fastest:.4g} s: pictures and largest values miss what lies between samples"
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
        """What the proofs promise of |y − y_d|, for state tracking of |x − x_d|, from these initial states, (K,).

        None if the loop is not the one that they are about.
        """
        if not self.loop.conditions.nominal:
            return None
        r, output = self.response, self.controller.generator is not None
        starts = r.x[0] - r.x_d[0], r.x_hat[0] - r.x[0]
        return self.controller.guarantees.tracking_error(r.t, *starts, output=output)

    @property
    def observer_bound(self) -> Array | None:
        """What the proofs promise of |x̂ − x| from these initial states, (K,); None as for `tracking_bound`."""
        if not self.loop.conditions.nominal:
            return None
        r = self.response
        return self.controller.guarantees.observer_error(r.t, r.x_hat[0] - r.x[0])

    @property
    def end(self) -> float:
        """The time of the last sample in s, whether it was kept or not."""
        step = self.spec.scenario.sample_time
        return (sample_count(self.spec.scenario.duration, step) - 1) * step

    @property
    def generator_start_fixed(self) -> bool:
        """Whether the reference itself says where the desired trajectory starts."""
        return _start_fixed(self.spec, self.controller)

    @property
    def final_error(self) -> float:
        """The largest norm of the tracking error in the last tenth of the simulation."""
        return self.figures.final_tracking_error

    def blocks(self) -> Iterator[Response]:
        """Yield the signals at all samples, with all events; those of a long run block by block, off the disk."""
        if self.spool is None:
            yield self.response
        else:
            yield from map(self.loop.response, self.spool)


@dataclass(kw_only=True)
class Figures:
    """Measures of a run, taken block by block.

    Attributes:
        final_tracking_error: Largest norm in the last tenth of the time.
        largest_tracking_error: Largest norm.
        final_observer_error: ‖x − x̂‖ at the end.
        largest_input: Largest entry of u.
        mode_changes: How many.
        joint_modes: How many there were.
    """

    final_tracking_error: float = 0.0
    largest_tracking_error: float = 0.0
    final_observer_error: float = 0.0
    largest_input: float = 0.0
    mode_changes: int = 0
    joint_modes: int = 0

    @staticmethod
    def of(blocks: Iterable[Response], samples: int) -> "Figures":
        """Measure all blocks of a run of so many samples."""
        figures, visited, number, tail = Figures(), set[Mode](), 0, last_tenth(samples).start
        for block in blocks:
            size = np.linalg.norm(block.tracking_error, axis=1)
            figures.largest_tracking_error = max(figures.largest_tracking_error, float(size.max()))
            last = size[max(0, tail - number) :]
            figures.final_tracking_error = max(figures.final_tracking_error, float(last.max(initial=0.0)))
            figures.final_observer_error = float(block.observer_error[-1])
            figures.largest_input = max(figures.largest_input, float(np.abs(block.u).max()))
            figures.mode_changes += len(block.trace.events)
            visited |= block.trace.visited()
            number += len(size)
        figures.joint_modes = len(visited)
        return figures


def design(spec: Spec, *, growing: bool = False) -> Controller:
    """Find the gains and prove that the closed loop tracks: Theorem 2 or 3.

    Args:
        spec: What is asked.
        growing: Whether to design also where x_d, the response to given inputs, is seen to grow without bound: the
            proofs hold, and the theorem does not speak of it. For a look at how it grows.

    Raises:
        OutsideTheory: If the plant is not of form (11), or the reference is not bounded, smooth or realisable.
        Infeasible: If (8), (9) or (17) is proved to have no solution.
        Undecided: If neither is proved.
        CheckFailed: If x_d, the response to given inputs, is seen to grow without bound, unless `growing`.

    Example:
        >>> from pwatrack import load_spec
        >>> controller = design(load_spec("specs/two_mass_backlash.yaml"))
        >>> controller.generator.shift.round(12).tolist()
        [[1.0, 0.0], [0.0, 0.0]]
    """
    with spec.located():
        trajectory, generator = _desired(spec, growing)  # (15)–(17), or (3)
        plant = spec.problem.plant if generator is None else generator.form.plant
        goals, solver = spec.objectives, spec.objectives.solver
        gains = synthesize(plant, controller=goals.controller, observer=goals.observer, solver=solver)  # (8), (9)
        _check_timing(spec, trajectory, generator, gains)
        proofs = prove_design(plant, gains, generator, solver=solver)
        return Controller(  # (18), (19)
            plant=plant,
            design=gains,
            trajectory=trajectory,
            generator=generator,
            proofs=proofs,
            costs=_costs(spec, gains),
        )


def simulate(spec: Spec, controller: Controller | None = None) -> Result:
    """Run the closed loop from event to event, exactly to rounding: see `simulate_flow`.

    Of a long run some samples are kept in memory and all of them in a temporary file: see `Spool`.

    Args:
        spec: What to simulate.
        controller: What `design(spec)` returned; designed first if not given, also where x_d grows without bound, which
            the outcome says.

    Raises:
        PwatrackError: Whatever `design` and `simulate_flow` raise, and InvalidSpec if the
            generator's initial state has the wrong length, or a long run does not fit on the disk.
    """
    controller = controller or design(spec, growing=True)
    with spec.located():
        loop = closed_loop(controller, spec.scenario.conditions)
        n, p = spec.problem.plant.A.shape[1], controller.trajectory.rate.shape[1]
        fixed, initial = controller.trajectory.eta0, spec.scenario.initial
        if initial.generator is not None and _start_fixed(spec, controller):
            raise start_given_twice(("simulation", "initial", "generator"))
        start = loop.start(
            plant=_initial(initial.plant, n, "plant"),
            observer=_initial(initial.observer, n, "observer"),
            generator=fixed if fixed is not None else _initial(initial.generator, p, "generator"),
        )
        steady_state = _steady_state(spec, controller, start[loop.at.eta_hat])
        if steady_state is not None and _starts_periodic(spec):
            start[loop.at.eta_hat] = steady_state.z[0, :p]
        response, figures, outcome, spool = _run(spec, loop, start)
        return Result(
            spec=spec,
            controller=controller,
            loop=loop,
            response=response,
            figures=figures,
            outcome=outcome,
            start=start,
            steady_state=steady_state,
            spool=spool,
        )


def start_given_twice(subject: Subject) -> InvalidSpec:
    """Return the refusal of a start of the desired trajectory beside that of the reference."""
    where = ".".join(map(str, subject))
    message = f"{where}: the reference itself says where the desired trajectory starts"
    return InvalidSpec(Problem(message=message, subject=subject, hint="leave it out"))


def _run(spec: Spec, loop: ClosedLoop, start: Array) -> tuple[Response, Figures, Outcome, Spool | None]:
    """Return the signals, thinned where they are too many to keep; figures of all, how it ended, and all on disk."""
    times = {"duration": spec.scenario.duration, "sample_time": spec.scenario.sample_time}
    samples, resets = sample_count(**times), loop.resets(spec.scenario.duration)
    watch = Watch(loop, samples, units=spec.problem.units)
    step, kept = -(-samples // _MOST_KEPT), list[Trace]()
    spool = Spool() if step > 1 else None

    def blocks() -> Iterator[Response]:
        number = 0
        for trace in trace_blocks(loop.flow, start, **times, resets=resets, most=_MOST_KEPT):
            kept.append(trace if spool is None else trace.every(step, number))
            if spool is not None:
                spool.add(trace)
            number += len(trace.t)
            response = loop.response(trace)
            watch.see(response)
            yield response

    figures = Figures.of(blocks(), samples)
    return loop.response(kept[0] if spool is None else Trace.coarse(kept)), figures, watch.outcome(), spool


def check_reference(spec: Spec, form: NormalForm | None = None) -> str:
    """Check what can be known of the reference before an inequality is solved, and say it in a few words.

    That is: bounded, smooth enough for the relative degree (Theorem 3), realisable (3), an equilibrium of some cell.

    Args:
        spec: What was asked.
        form: The normal form of its plant, where it is at hand.

    Raises:
        OutsideTheory: If the reference is none that the theorems are about, or the plant is not of form (11).
        InvalidSpec: If a start was to be periodic and there is no period.

    Example:
        >>> from pwatrack import load_spec
        >>> check_reference(load_spec("specs/two_mass_backlash.yaml"))
        'y_d is bounded and smooth enough for relative degree 2'
    """
    problem = spec.problem
    with spec.located():
        if isinstance(problem.reference, OutputReference):
            form = form or normal_form(problem.plant)
            _output_signal(problem.reference, form.r)
            return f"y_d is bounded and smooth enough for relative degree {form.r}"
        _state_desired(spec)
        if isinstance(problem.reference, SetPoint):
            return "x_d is an equilibrium with the wanted outputs"
        if isinstance(problem.reference, InputReference):
            return "u_ff is bounded; x_d is the response of the plant"
        return "x_d is bounded and satisfies (3)"


def _desired(spec: Spec, growing: bool) -> tuple[DesiredTrajectory, TrajectoryGenerator | None]:
    """Return the desired trajectory, and for output tracking the generator it comes from."""
    plant, reference, solver = spec.problem.plant, spec.problem.reference, spec.objectives.solver
    if not isinstance(reference, OutputReference):
        trajectory, where = _state_desired(spec), ("reference", "start")
        if not isinstance(reference, InputReference) or reference.start is None:
            return trajectory, None
        horizon = spec.scenario.duration
        try:
            return bounded_response(plant, trajectory, horizon=horizon, solver=solver, subject=where), None
        except CheckFailed as growth:
            if not growing:
                raise
            return replace(trajectory, bounded=False, growth=growth.problems[0]), None
    form = normal_form(plant)
    y_d = _output_signal(reference, form.r)
    generator = trajectory_generator(form, solver=solver)
    return output_trajectory(generator, exosystem([y_d])), generator


def _output_signal(reference: OutputReference, r: int) -> Signal:
    y_d = reference.signal(r)
    _check([y_d], r, ("reference", "output"), "y_d")
    return y_d


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
        if _starts_periodic(spec) and u_ff.period is None and not u_ff.constant:
            message = "start: periodic, but the inputs together have no period"
            hint = "give x_d(0) as start, or inputs whose frequencies have whole-number ratios"
            raise InvalidSpec(Problem(message=message, subject=("reference", "start"), hint=hint))
        return input_trajectory(plant, u_ff, reference.start)
    _check(signals, 1, ("reference", "state"), "x_d")
    x_d = state_trajectory(plant, exosystem(signals))
    return realised(plant, x_d, horizon=spec.scenario.duration, subject=("reference", "state"))  # (3)


def _check_timing(
    spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None, gains: Design
) -> None:
    """Refuse a reference whose breaks cannot be timed well enough."""
    plant, reference = spec.problem.plant, spec.problem.reference
    smooth = reference.smooth if isinstance(reference, OutputReference | StateReference) else None
    check_timing(
        plant,
        gains.K,
        trajectory,
        outputs=np.eye(len(plant.states)) if generator is None else plant.C,
        smooth=None if smooth is None else (smooth, 1 if generator is None else generator.r),
        subject=("reference", "state" if generator is None else "output"),
    )


def _costs(spec: Spec, gains: Design) -> dict[str, Array]:
    """Return the proved bounds of the costs that were asked for."""
    plant, goals = spec.problem.plant, spec.objectives
    parts = ((CONTROLLER, goals.controller, gains.K), (OBSERVER, goals.observer, gains.L))
    return {
        role.name: cost_bound(Task.of(plant, role, goals.solver), role.oriented(gain), goal.Q, goal.R)
        for role, goal, gain in parts
        if isinstance(goal, LeastCost)
    }


def _check(signals: list[Signal], r: int | None, subject: Subject, name: str) -> None:
    for signal in signals:
        check_bounded(signal, name=name, subject=subject)
        if r is not None:
            check_smooth(signal, r, name=name, subject=subject)


def _start_fixed(spec: Spec, controller: Controller) -> bool:
    return controller.trajectory.eta0 is not None or _starts_periodic(spec)


def _starts_periodic(spec: Spec) -> bool:
    return isinstance(spec.problem.reference, InputReference) and spec.problem.reference.start is None


def _steady_state(spec: Spec, controller: Controller, eta_hat0: Array) -> SteadyState | None:
    """Return a period of the generator's steady state, where it has one; any time is a period of a constant."""
    trajectory = controller.trajectory
    p, system = trajectory.rate.shape[1], trajectory.exosystem
    period = system.period if not system.constant else spec.scenario.duration if _starts_periodic(spec) else None
    if not p or period is None or not (controller.generator or _starts_periodic(spec)):
        return None
    radians = float(np.abs(system.rates.imag).max(initial=0.0)) * period
    if radians > _LONGEST_PERIOD and not _starts_periodic(spec):
        return None
    if radians > _LONGEST_PERIOD:
        message = f"start: periodic, but the inputs together have a period of {period:.3g} s, {radians:.3g} rad of the "
        message += f"fastest; up to {_LONGEST_PERIOD:.0e} are followed"
        hint = "give x_d(0) as start, or inputs whose frequencies have simpler ratios"
        raise InvalidSpec(Problem(message=message, subject=("reference", "start"), hint=hint))
    start = np.concatenate([eta_hat0, system.w0, [1.0]])
    return periodic_state(closed_loop(controller).generator_flow(), start, free=p, period=period)


def _unresolved(trace: Trace) -> list[str]:
    """Return one remark for each guard that was within rounding of 0."""
    found: dict[tuple[str, int], list[Unresolved]] = {}
    for doubt in trace.unresolved:
        found.setdefault((doubt.part, doubt.guard), []).append(doubt)
    remarks = []
    for (part, guard), doubts in found.items():
        span = max(doubt.span for doubt in doubts)
        remarks.append(
            f"the {part} comes within rounding of hyperplane {guard + 1} at t = {doubts[0].t:.9g} s"
            + (f" and {len(doubts) - 1} more times" if len(doubts) > 1 else "")
            + (f", for up to {span:.2g} s" if span else "")
            + ": on which side it is then cannot be told, so that a mode change may be missing, or early or late by "
            + ("that much" if span else "a moment")
            + "; it changes the signals by no more than rounding"
        )
    return remarks


def _initial(values: Array | None, length: int, part: str) -> Array:
    if values is None:
        return np.zeros(length)
    if len(values) != length:
        subject: Subject = ("simulation", "initial", part)
        raise InvalidSpec(
            Problem(message=f"simulation.initial.{part}: {len(values)} entries, expected {length}", subject=subject)
        )
    return values
