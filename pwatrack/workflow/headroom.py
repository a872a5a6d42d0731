"""What limits of the inputs mean for a design: whether they leave room for the feedforward, and how much beside it."""

import numpy as np

from pwatrack.arrays import Array, number_text
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.headroom import OFF, Headroom, Peak, Starts
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem
from pwatrack.lmi.exact import Certificate
from pwatrack.model.sizes import Sizes
from pwatrack.simulation.desired import feedforward_peak, w_alone
from pwatrack.simulation.steady_state import steady_start
from pwatrack.spec.spec import Spec
from pwatrack.workflow.starting import generator_start, plant_start, starts_of

_STILL = 1e-12  # of the terms of w': what is less is rounding
_INSIDE = 1e-6  # of the terms of a guard: what rests farther off a facet stays in its cell, whatever rounding does


def room_within_limits(
    spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None, sizes: Sizes
) -> Headroom | None:
    """Return what the feedforward takes of the limits of the inputs; None where there are none.

    Raises OutsideTheory if following the reference takes more than the limits: input, time, figure and limit. What only
    the generator's start makes of it is no reason: it dies out.
    """
    limits, plant = spec.scenario.conditions.limits, spec.problem.plant
    if limits is None:
        return None
    system, duration, given = trajectory.exosystem, spec.scenario.duration, trajectory.eta0
    if given is None and generator is not None:
        given = generator_start(spec, trajectory, generator)
    if not trajectory.names or w_alone(trajectory):  # it has no past
        duration = system.period or duration
    peak = feedforward_peak(plant, trajectory, given, duration)
    steady = _steady(trajectory, generator)
    lasting = peak if steady is None else feedforward_peak(plant, trajectory, steady, system.period or duration)
    if lasting is not None:
        _check(spec, limits, lasting)
        peak = None if peak is None else peak.with_also(lasting)
    x = plant_start(spec, trajectory, generator, trajectory.eta0)
    starts = (*Starts.within(sizes), *starts_of(spec, trajectory, x, given, sizes))
    ends = None if steady is None or given is None else (given, steady)
    ever = peak is not None and _goes_on(trajectory, generator, peak, ends, spec.scenario.duration)
    return Headroom(limits=limits, lasting=lasting, peak=peak, ever=ever, starts=starts)


def _goes_on(
    trajectory: DesiredTrajectory,
    generator: TrajectoryGenerator | None,
    peak: Peak,
    ends: tuple[Array, Array] | None,
    duration: float,
) -> bool:
    """Say whether u_ff is within its peak after the run too, not only in it.

    It is if the reference has no piece to come, and u_ff repeats or is at rest; where a state of the generator matters,
    if that is so close to its steady state by then that u_ff cannot differ by what the peak is known to, by the P of
    (17), or if it rests from the start on, inside of a cell.
    `ends` are η̂(0) and that of the steady state, where there is one; the duration is in s.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    if system.end is not None or any(reset.t > duration for reset in system.resets):
        return False
    if not p or w_alone(trajectory):
        w = system.states(np.array([duration]))[0]
        at_rest = np.abs(system.S @ w) <= _STILL * (np.abs(system.S) @ np.abs(w))
        return bool(at_rest.all()) or (system.period is not None and not system.resets)
    if ends is None or generator is None or system.resets:
        return False
    off = ends[0] - ends[1]
    if system.constant and not off.any():
        s = np.concatenate([ends[1], system.w0, [1.0]])
        return bool((np.abs(trajectory.guards @ s) > _INSIDE * (np.abs(trajectory.guards) @ np.abs(s))).all())
    if any(generator.form.piecewise):
        return False  # u_ff jumps: however close, it may be of another cell
    if not isinstance(generator.certificate, Certificate):
        return False
    P, gains = generator.certificate.P, trajectory.u_ff[:, :, :p]
    reach = np.sqrt(
        np.einsum("lmp,lmp->lm", gains, np.linalg.solve(P, gains.swapaxes(1, 2)).swapaxes(1, 2)).max(axis=0)
    )
    left = reach * np.sqrt(float(off @ P @ off)) * np.exp(-generator.rate * duration)
    return bool((left <= OFF * np.maximum(np.abs(peak.low), np.abs(peak.high))).all())


def _steady(trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None) -> Array | None:
    """Return the η̂(0) that forgets nothing, where the generator has one."""
    if generator is None or not trajectory.names:
        return None
    try:
        return steady_start(trajectory, generator)
    except (InvalidSpec, OutsideTheory):  # the reference begins otherwise
        return None


def _check(spec: Spec, limits: Array, peak: Peak) -> None:
    plant, problems = spec.problem.plant, list[Problem]()
    ends = np.column_stack([peak.low, peak.high])
    for k, side in peak.beyond(limits):
        name, unit = plant.inputs[k], spec.problem.units.get(plant.inputs[k], "")
        needed, limit = (f"{number_text(float(v[k, side]), '.4g')} {unit}".rstrip() for v in (ends, limits))
        way = "above its upper" if side else "below its lower"
        problems.append(
            Problem(
                message=f"the reference takes {name} = {needed} at t = {peak.times[k, side]:.6g} s, {way} limit, "
                f"{limit}",
                subject=("simulation", "actuator", "limits", name),
                hint="let the reference be slower or smaller, or take a stronger drive",
            )
        )
    if problems:
        raise OutsideTheory(*problems)
