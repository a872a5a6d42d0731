"""From a spec to its result, step by step as in Section IV of the paper. No input or output."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.claims.practical import Practical
from pwatrack.claims.registry import proved
from pwatrack.control.controller import Asked, ProvedController
from pwatrack.control.demand import Demand
from pwatrack.control.goal import Given
from pwatrack.control.headroom import Headroom, InputConstraint, Starts
from pwatrack.control.program import SampledController, program
from pwatrack.control.proof import prove_design
from pwatrack.control.sampled_disturbances import Acting, LateStart
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.synthesis import synthesize, with_starts_inside
from pwatrack.errors import InvalidSpec, PwatrackError
from pwatrack.lmi.solve import asking
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import SetPoint
from pwatrack.simulation.acting import acting
from pwatrack.simulation.bounded import left_by_rounding
from pwatrack.simulation.closed_loop import ClosedLoop, Response, closed_loop
from pwatrack.simulation.desired import desired_flow
from pwatrack.simulation.figures import Figures, Measuring
from pwatrack.simulation.late_start import late_start
from pwatrack.simulation.propagate import sample_count, trace_blocks
from pwatrack.simulation.sampled_runs import check_sample_time, not_simulated, refused, sampling_remarks
from pwatrack.simulation.steady_state import LONGEST_PERIOD, SteadyState, from_measured, measured_start, periodic_state
from pwatrack.simulation.trace import Trace, TraceOnDisk
from pwatrack.spec.box import corners
from pwatrack.spec.spec import Measured, Spec, Steady
from pwatrack.workflow.headroom import demand_of, room_of_signals, room_within_limits
from pwatrack.workflow.outcome import RunMonitor, SimulatedLoop
from pwatrack.workflow.sampled_starts import with_sampled_starts_inside
from pwatrack.workflow.simplified import may_merge, merged_spec, not_worth, practical_design
from pwatrack.workflow.sizing import spec_sizes
from pwatrack.workflow.tracking import (
    check_breaks,
    check_unknown,
    desired_trajectory,
    generator_start,
    observer_start,
    plant_start,
    start_fixed,
    start_given_twice,
    starts_of,
    starts_periodic,
)

MOST_KEPT = 250_000  # samples


def design(spec: Spec, *, growing: bool = False) -> ProvedController:
    """Find the gains and prove that the closed loop tracks: what `pwatrack.api.design` does, which says the rest.

    With `growing` a design is also made where x_d is seen to grow without bound, for a look at how it grows.
    """
    with asking(spec.objectives.solver):
        try:
            controller, room, taken = _with_gains(spec, growing)
            with spec.located():
                if spec.scenario.conditions.sampling is not None:
                    program(controller, spec.scenario.conditions)  # or a refusal: a sample may be too long
                    if spec.scenario.conditions.pace is not None:
                        program(controller, spec.scenario.conditions, given=True)
                wanted = asked_of(spec, room, controller, taken)
                return with_sampled_starts_inside(proved(controller, wanted), wanted)
        except PwatrackError as refusal:
            return _practical(spec, growing, refusal)


def _practical(spec: Spec, growing: bool, refusal: PwatrackError) -> ProvedController:
    """Design with cells merged where exact tracking is refused, or raise that refusal."""
    if not may_merge(spec, refusal):
        raise refusal
    found = practical_design(spec, refusal, lambda merged: _with_gains(merged, growing, exact=False)[0])
    remark = f"; practical tracking is asked for, and not found: {found}"
    if isinstance(found, ProvedController):
        practical = found.claim(Practical)
        little = not_worth(spec, practical)
        if spec.objectives.practical or not little:
            less = merged_spec(spec, practical.merges, watched=found.plant.watched is not None)
            return proved(found, asked(less, found))
        remark = f"; practical tracking is proved, and not worth having: {little}; 'tracking: practical' takes it"
    elif not spec.objectives.practical:
        raise refusal
    told = (p.followed(remark) for p in refusal.problems)
    raise type(refusal)(*told, evidence=refusal.evidence) from None


def asked_of(
    spec: Spec, room: Headroom | None, controller: ProvedController, set_points: Demand | None = None
) -> Asked:
    """Return what a spec asks to be proved, given what feedforward and set-points leave of limits of inputs, if any."""
    problem, goals, conditions = spec.problem, spec.objectives, spec.scenario.conditions
    sampling, rates = conditions.sampling, conditions.rates
    corrects = sampling is not None and sampling.corrects
    return Asked(
        words=spec.words,
        room=room,
        set_points=set_points,
        signals=room_of_signals(spec, controller),
        box=goals.uncertain,
        corners=lambda plant: corners(problem.parametric, plant, goals.uncertain),
        solver=goals.solver,
        sampled=controller.sampled_gains(sampling) if sampling is not None and corrects else None,
        measured=(
            from_measured(controller.sizes, controller.plant.C)
            if isinstance(spec.scenario.initial.observer, Measured)
            else None
        ),
        changes=None if sampling is None or rates is None else rates * sampling.sample_time,
        acting=lambda proved, errors: _acting(spec, proved, errors),
        begins=lambda proved: _begins(spec, proved),
        late=lambda proved, errors, noise: _late(spec, proved, errors, noise),
    )


def _acting(spec: Spec, controller: ProvedController, errors: SampledErrors) -> Acting | None:
    """Return how large what acts on the errors of a sampled loop gets in the run; None where that is not known."""
    conditions, duration = spec.scenario.conditions, spec.scenario.duration
    with suppress(PwatrackError):  # a start that is refused is so where it runs
        return acting(controller, conditions, errors, _generator_start(spec, controller)[0], duration)
    return None


def _begins(spec: Spec, controller: ProvedController) -> Starts | None:
    """Return the errors with which the run begins; None where it is not known where its generator does."""
    with suppress(PwatrackError):
        eta, _, x = _plant_and_generator_start(spec, controller)
        return next(starts_of(spec, controller.trajectory, x, eta, controller.sizes), None)
    return None


def _late(spec: Spec, controller: ProvedController, errors: SampledErrors, noise: Array) -> LateStart | None:
    """Return where the run is as its first input acts, which is late; None where that is not known."""
    initial, n = spec.scenario.initial, len(controller.plant.B)
    if "generator" in spec.scenario.regions:
        return None
    with suppress(PwatrackError):
        eta, _, x = _plant_and_generator_start(spec, controller)
        if isinstance(initial.observer, Measured):
            read = from_measured(controller.sizes, controller.plant.C)
            x_hat, off = read @ controller.plant.C @ x, np.abs(read) @ noise
        else:
            x_hat, off = observer_start(spec, controller.trajectory, eta), np.zeros(n)
        return late_start(controller, spec.scenario.conditions, errors, (x, x_hat, eta), off=off, noise=noise)
    return None


def _with_gains(
    spec: Spec, growing: bool, *, exact: bool = True
) -> tuple[ProvedController, Headroom | None, Demand | None]:
    """Find the gains with their proofs, and the room that limits leave, for which K is made if it is exact."""
    with spec.located():
        check_unknown(spec)
        trajectory = desired_trajectory(spec, growing)  # (15)–(17), or (3)
        generator = trajectory.generator
        plant = spec.problem.plant if generator is None else generator.form.plant
        goals, sizes = spec.objectives, spec_sizes(spec)
        taken = demand_of(spec, trajectory)
        room = room_within_limits(spec, trajectory, sizes, taken)
        within = _within(spec, room, sizes.state)
        gains = synthesize(  # (8), (9)
            plant, controller=goals.controller, observer=goals.observer, sizes=sizes, within=within
        )
        declared = None if room is None else room.around(sizes.state)
        if declared is not None and exact and trajectory.preview is None:
            gains = with_starts_inside(plant, gains, goals.controller, sizes, declared)
        check_breaks(spec, trajectory, gains)
        proofs = prove_design(plant, gains, generator, sizes=sizes)
        controller = ProvedController(  # (18), (19)
            plant=plant, running=plant, design=gains, trajectory=trajectory, proofs=proofs, sizes=sizes
        )
        return controller, room, taken


def _within(spec: Spec, room: Headroom | None, sizes: Array) -> InputConstraint | None:
    """Return what limits ask of K, where it is to be such that none is reached."""
    within = getattr(spec.objectives.controller, "within", None)
    if within is None:
        return None
    if room is None:
        message = f"'within: {within}' is asked of K, and no input has a limit"
        hint = "say what inputs can do under simulation: actuator: {limits: {…: […, …]}}"
        raise InvalidSpec(message, subject=("design", "controller", "within"), hint=hint)
    return room.within(sizes) if within == "limits" else None


def asked(spec: Spec, controller: ProvedController, content: Any = None) -> Asked:
    """Return what a spec asks to be proved of a controller; what set-points take, as a certificate tells it."""
    taken = demand_of(spec, controller.trajectory, content)
    room = room_within_limits(spec, controller.trajectory, controller.sizes, taken)
    return asked_of(spec, room, controller, taken)


def not_judged(spec: Spec) -> Iterator[str]:
    """Yield that `design` judges limits and sampling, or what is known of the latter with given gains."""
    conditions, goals = spec.scenario.conditions, spec.objectives
    if conditions.limits is not None and not isinstance(spec.problem.reference, SetPoint):
        yield "whether the reference keeps the limits of inputs is not judged here: 'design' does"
    if conditions.sampling is None:
        return
    if isinstance(goals.controller, Given) and isinstance(goals.observer, Given):
        with suppress(PwatrackError):  # `design` says what
            controller = design(spec, growing=True)
            found, known = refused(controller, conditions), list(sampling_remarks(controller))
            yield from [not_simulated(found[0]), *known] if found else known
            return
    yield f"sampling every {conditions.sampling.sample_time:g} s is not judged here: 'design' does, with its gains"


def simulate(
    spec: Spec, controller: ProvedController | None = None, runs: SampledController | None = None
) -> SimulatedLoop:
    """Run the closed loop from event to event: what `pwatrack.api.simulate` does, which says the rest.

    Without a controller one is designed, also where x_d grows without bound; where it is sampled, `runs` is the program
    of it, if that was kept. Of a long run some samples are kept in memory and all of them on disk: see `TraceOnDisk`.
    """
    controller = controller or design(spec, growing=True)
    with spec.located():
        check_sample_time(controller, spec.scenario.conditions)
        loop = closed_loop(controller, spec.scenario.conditions, runs)
        start, steady_state = start_of(spec, loop)
        if steady_state is not None and starts_periodic(spec):
            where = ("reference", "start")
            if (left := left_by_rounding(steady_state, duration=spec.scenario.duration, subject=where)) is not None:
                trajectory = replace(controller.trajectory, bounded=False, growth=left)
                controller = replace(controller, trajectory=trajectory)
                loop = replace(loop, controller=controller)
        response, figures, watch, spool = _run(spec, loop, start)
        return SimulatedLoop(
            spec=spec,
            controller=controller,
            loop=loop,
            response=response,
            figures=figures,
            outcome=watch.outcome(figures),
            w=watch.w,
            start=start,
            steady_state=steady_state,
            spool=spool,
        )


def start_of(spec: Spec, loop: ClosedLoop) -> tuple[Array, SteadyState | None]:
    """Return z(0), as a spec says it, once, and a period of the generator's steady state where it has one."""
    controller, initial = loop.controller, spec.scenario.initial
    if start_fixed(spec, controller) and not isinstance(initial.generator, Steady | None):
        raise start_given_twice(("simulation", "initial", "generator"))
    eta, steady_state, x = _plant_and_generator_start(spec, controller)
    observer = (
        measured_start(loop, x)
        if isinstance(initial.observer, Measured)
        else observer_start(spec, controller.trajectory, eta)
    )
    return loop.start(plant=x, observer=observer, generator=eta), steady_state


def _plant_and_generator_start(spec: Spec, controller: ProvedController) -> tuple[Array, SteadyState | None, Array]:
    """Return η̂(0), (p,), a period of the steady state where there is one, and x(0), (n,)."""
    eta, steady_state = _generator_start(spec, controller)
    fixed = controller.trajectory.eta0 is not None or (steady_state is not None and starts_periodic(spec))
    return eta, steady_state, plant_start(spec, controller.trajectory, eta if fixed else None)


def _generator_start(spec: Spec, controller: ProvedController) -> tuple[Array, SteadyState | None]:
    """Return η̂(0), (p,), and a period of the steady state where there is one."""
    trajectory, fixed = controller.trajectory, controller.trajectory.eta0
    eta = generator_start(spec, trajectory) if fixed is None else fixed
    steady_state = _steady_state(spec, controller, eta)
    if steady_state is not None and starts_periodic(spec):
        eta = steady_state.z[0, : trajectory.rate.shape[1]]
    return eta, steady_state


def _run(spec: Spec, loop: ClosedLoop, start: Array) -> tuple[Response, Figures, RunMonitor, TraceOnDisk | None]:
    """Return the signals, thinned where they are too many to keep; figures, what was watched, and all on disk."""
    times = {"duration": spec.scenario.duration, "sample_time": spec.scenario.sample_time}
    samples, resets = sample_count(**times), loop.resets(spec.scenario.duration)
    watch = RunMonitor(loop, samples, units=spec.problem.units, box=spec.objectives.uncertain)
    measuring = Measuring(samples, **spec.measured, loop=loop)
    step, kept = -(-samples // MOST_KEPT), list[Trace]()
    spool = TraceOnDisk() if step > 1 else None

    number = 0
    for trace in trace_blocks(loop.flow, start, **times, resets=resets, most=MOST_KEPT):
        kept.append(trace if spool is None else trace.every(step, number))
        if spool is not None:
            spool.add(replace(trace, breaks=None))
        number += len(trace.t)
        response = loop.response(trace)
        watch.see(response)
        measuring.see(response)
    if spool is None:
        return response, measuring.figures([response]), watch, None
    return loop.response(Trace.coarse(kept)), measuring.figures(map(loop.response, spool)), watch, spool


def _steady_state(spec: Spec, controller: ProvedController, eta_hat0: Array) -> SteadyState | None:
    """Return a period of the generator's steady state, where it has one; any time is a period of a constant."""
    trajectory = controller.trajectory
    p, system = trajectory.rate.shape[1], trajectory.exosystem
    period = system.period if not system.constant else spec.scenario.duration if starts_periodic(spec) else None
    if not p or period is None or not (controller.generator or starts_periodic(spec)):
        return None
    if controller.plant.loads is not None and not starts_periodic(spec):
        return None  # it goes where the loads are
    radians = float(np.abs(system.rates.imag).max(initial=0.0)) * period
    if radians > LONGEST_PERIOD and not starts_periodic(spec):
        return None
    if radians > LONGEST_PERIOD:
        message = f"start: periodic, but the inputs together have a period of {period:.3g} s, {radians:.3g} rad of the "
        message += f"fastest; up to {LONGEST_PERIOD:.0e} are followed"
        hint = "give x_d(0) as start, or inputs whose frequencies have simpler ratios"
        raise InvalidSpec(message, subject=("reference", "start"), hint=hint)
    start = np.concatenate([eta_hat0, system.w0, [1.0]])
    return periodic_state(desired_flow(controller.plant, trajectory), start, free=p, period=period)


def proved_for(spec: Spec, controller: ProvedController) -> ProvedController:
    """Return a controller with all that a spec asks to be proved of it: another box than it was designed for."""
    with spec.located(), asking(spec.objectives.solver):
        return proved(replace(controller, claims=()), asked(spec, controller))


def check_plant(spec: Spec, designed: PWASystem) -> None:
    """Refuse a design for another plant: it is the design's that would run."""
    plant = spec.problem.plant
    pairs = (
        *((getattr(plant, name), getattr(designed, name)) for name in ("A", "b", "B", "C")),
        *((getattr(plant.partition, name), getattr(designed.partition, name)) for name in ("H", "h", "signs")),
    )
    if not all(np.array_equal(one, other) for one, other in pairs):
        hint = "other values of parameters in the plant that runs stand in the scenario: simulation.plant.parameters"
        raise InvalidSpec("simulate: the design is for another plant", subject=None, hint=hint)
