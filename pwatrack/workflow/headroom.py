"""What limits of signals mean for a design: whether they leave room for the reference, and how much beside it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pwatrack.arrays import Array, number_text
from pwatrack.control.bounds import state_rows
from pwatrack.control.controller import ProvedController
from pwatrack.control.demand import Demand
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.headroom import OFF, Headroom, Peak, SignalRoom, Starts
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem, Subject
from pwatrack.lmi.exact import Certificate
from pwatrack.model.sizes import Sizes
from pwatrack.simulation.desired import desired_peak, w_alone
from pwatrack.simulation.steady_state import steady_start
from pwatrack.spec.spec import Spec
from pwatrack.workflow.bands import declared
from pwatrack.workflow.starting import generator_start, plant_start, starts_of

_STILL = 1e-12  # of the terms of w': what is less is rounding
_INSIDE = 1e-6  # of the terms of a guard: what rests farther off a facet stays in its cell, whatever rounding does


def room_within_limits(
    spec: Spec,
    trajectory: DesiredTrajectory,
    generator: TrajectoryGenerator | None,
    sizes: Sizes,
    set_points: Demand | None = None,
) -> Headroom | None:
    """Return what the feedforward takes of the limits of the inputs; None where there are none.

    Raises OutsideTheory if following the reference takes more than the limits: input, time, figure and limit. What only
    the generator's start makes of it is no reason: it dies out.
    """
    limits, names = spec.scenario.conditions.limits, spec.problem.plant.inputs
    if limits is None:
        return None
    room = replace(_room(spec, trajectory, generator, sizes, limits, trajectory.u_ff), set_points=set_points)
    at = [("simulation", "actuator", "limits", name) for name in names]
    _check(spec, room, [f"the reference takes {name}" for name in names], at, "take a stronger drive")
    return room


def room_of_signals(spec: Spec, controller: ProvedController) -> SignalRoom | None:
    """Return what the reference takes of the limits of outputs and states; None where there are none.

    Raises OutsideTheory if the reference itself leaves them: signal, time, figure and limit. Where estimates of loads
    move x_d, or cells are merged, that is said of what is tracked only.
    """
    limits, plant, words = spec.limited, controller.plant, spec.words
    if not limits:
        return None
    names, forms = tuple(limits), tuple(words.form(name) for name in limits)
    rows, trajectory = state_rows(plant, forms), controller.trajectory
    room = _room(
        spec, trajectory, controller.generator, controller.sizes, np.array(list(limits.values())), rows @ trajectory.x_d
    )
    itself = [kind == "output" for kind, _ in forms]
    known = controller.running is plant and plant.loads is None
    said = [f"the reference goes to {name}" if known or own else "" for name, own in zip(names, itself, strict=True)]
    _check(spec, room, said, [("require", "limits", name) for name in names], "widen the limit")
    return SignalRoom(names=names, forms=forms, room=room, acting=declared(spec, controller))


def _room(
    spec: Spec,
    trajectory: DesiredTrajectory,
    generator: TrajectoryGenerator | None,
    sizes: Sizes,
    limits: Array,
    gains: Array,
) -> Headroom:
    """Return what signals along x_d take of their limits, (m, 2), and with which errors a run may begin.

    What the generator's start makes of it beyond a limit dies out: that is not in `lasting`.
    """
    plant, system, duration = spec.problem.plant, trajectory.exosystem, spec.scenario.duration
    given = trajectory.eta0
    if given is None and generator is not None:
        given = generator_start(spec, trajectory, generator)
    if not trajectory.names or w_alone(gains, trajectory.rate.shape[1]):  # it has no past
        duration = system.period or duration
    peak = desired_peak(plant, trajectory, gains, given, duration)
    steady = _steady(trajectory, generator)
    lasting = peak if steady is None else desired_peak(plant, trajectory, gains, steady, system.period or duration)
    if lasting is not None:
        peak = None if peak is None else peak.with_also(lasting)
    x = plant_start(spec, trajectory, generator, trajectory.eta0)
    starts = (*Starts.within(sizes), *starts_of(spec, trajectory, x, given, sizes))
    ends = None if steady is None or given is None else (given, steady)
    ever = peak is not None and _goes_on(trajectory, generator, gains, peak, ends, spec.scenario.duration)
    return Headroom(limits=limits, lasting=lasting, peak=peak, ever=ever, starts=starts)


def _goes_on(
    trajectory: DesiredTrajectory,
    generator: TrajectoryGenerator | None,
    all_gains: Array,
    peak: Peak,
    ends: tuple[Array, Array] | None,
    duration: float,
) -> bool:
    """Say whether signals along x_d, as `desired_peak` has them, are within their peak after the run too.

    They are if the reference has no piece to come, and they repeat or are at rest; where a state of the generator
    matters, if that is so close to its steady state by then that they cannot differ by what the peak is known to, by
    the P of (17), or if it rests from the start on, inside of a cell.
    `ends` are η̂(0) and that of the steady state, where there is one; the duration is in s.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    if system.end is not None or any(reset.t > duration for reset in system.resets):
        return False
    if not p or w_alone(all_gains, p):
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
        return False  # they may jump: however close, it may be of another cell
    if not isinstance(generator.certificate, Certificate):
        return False
    P, gains = generator.certificate.P, all_gains[:, :, :p]
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


def _check(spec: Spec, room: Headroom, said: Sequence[str], at: Sequence[Subject], remedy: str) -> None:
    """Refuse what is lasting beyond a limit, by `said` and where it stands; nothing is said of what has no words."""
    problems, limits, peak = list[Problem](), room.limits, room.lasting
    if peak is None:
        return
    ends = np.column_stack([peak.low, peak.high])
    for k, side in peak.beyond(limits):
        unit = spec.problem.units.get(str(at[k][-1]), "")
        needed, limit = (f"{number_text(float(v[k, side]), '.4g')} {unit}".rstrip() for v in (ends, limits))
        way = "above its upper" if side else "below its lower"
        message = f"{said[k]} = {needed} at t = {peak.times[k, side]:.6g} s, {way} limit, {limit}"
        hint = f"let the reference be slower or smaller, or {remedy}"
        problems += [Problem(message=message, subject=at[k], hint=hint)] if said[k] else []
    if problems:
        raise OutsideTheory(*problems)
