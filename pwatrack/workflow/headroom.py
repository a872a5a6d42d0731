"""What limits of signals mean for a design: the room that the reference leaves, and what any set-points take of it."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from pwatrack.arrays import CLOSE, Array, number_text
from pwatrack.control.bounds import state_rows
from pwatrack.control.controller import ProvedController
from pwatrack.control.demand import Demand, Kept, told
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.headroom import OFF, Headroom, Peak, SignalRoom, Starts
from pwatrack.control.program import PACE
from pwatrack.control.set_points import demand, not_tried, unsaid
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.control.words import down
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem, ProblemPart, Subject
from pwatrack.lmi.exact import Certificate
from pwatrack.model.reference import SetPoint
from pwatrack.model.sizes import Sizes
from pwatrack.simulation.desired import desired_peak, w_alone
from pwatrack.simulation.steady_state import steady_start
from pwatrack.spec.spec import Spec
from pwatrack.workflow.bands import declared
from pwatrack.workflow.tracking import generator_start, plant_start, starts_of

_STILL = 1e-12  # of the terms of w': what is less is rounding
_INSIDE = 1e-6  # of the terms of a guard: what rests farther off a facet stays in its cell, whatever rounding does
_HALVINGS = 12  # of a limit of set-points, until it is known how much of it would do
_RESTING = Fraction(1, 10**6)  # of what moves set-points: as good as 0
_IN_RANGE = "however slow they move, as far as is proved: take a smaller range, or a wider limit of the input"
_NOT_FOUND = "no ellipsoid was found that the internal states stay in"


def room_within_limits(
    spec: Spec, trajectory: DesiredTrajectory, sizes: Sizes, set_points: Demand | None = None
) -> Headroom | None:
    """Return what the feedforward takes of the limits of the inputs; None where there are none.

    Raises OutsideTheory if following the reference takes more; what only the generator's start makes of it dies out.
    """
    limits, names = spec.scenario.conditions.limits, spec.problem.plant.inputs
    if limits is None:
        return None
    room = replace(_room(spec, trajectory, sizes, limits, trajectory.u_ff), set_points=set_points)
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
    ends = np.array(list(limits.values()))
    room = _room(spec, trajectory, controller.sizes, ends, rows @ trajectory.x_d)
    itself = [kind == "output" for kind, _ in forms]
    known = controller.running is plant and plant.loads is None
    said = [f"the reference goes to {name}" if known or own else "" for name, own in zip(names, itself, strict=True)]
    _check(spec, room, said, [("require", "limits", name) for name in names], "widen the limit")
    return SignalRoom(names=names, forms=forms, room=room, acting=declared(spec, controller, always=True))


def _room(spec: Spec, trajectory: DesiredTrajectory, sizes: Sizes, limits: Array, gains: Array) -> Headroom:
    """Return what signals along x_d take of their limits, (m, 2), and with which errors a run may begin."""
    plant, system, duration = spec.problem.plant, trajectory.exosystem, spec.scenario.duration
    given, steady, generator = trajectory.eta0, None, trajectory.generator
    if given is None and generator is not None:
        given = generator_start(spec, trajectory)
    if generator is not None and trajectory.names:
        with suppress(InvalidSpec, OutsideTheory):  # the reference begins otherwise
            steady = steady_start(trajectory, generator)  # the η̂(0) that forgets nothing
    if not trajectory.names or w_alone(gains, trajectory.rate.shape[1]):  # it has no past
        duration = system.period or duration
    peak = desired_peak(plant, trajectory, gains, given, duration)
    lasting = peak if steady is None else desired_peak(plant, trajectory, gains, steady, system.period or duration)
    if lasting is not None:
        peak = None if peak is None else peak.with_also(lasting)
    x = plant_start(spec, trajectory, trajectory.eta0)
    starts = (*Starts.within(sizes), *starts_of(spec, trajectory, x, given, sizes))
    ends = None if steady is None or given is None else (given, steady)
    ever = peak is not None and _goes_on(trajectory, gains, peak, ends, spec.scenario.duration)
    return Headroom(limits=limits, lasting=lasting, peak=peak, ever=ever, starts=starts)


def _goes_on(
    trajectory: DesiredTrajectory, all_gains: Array, peak: Peak, ends: tuple[Array, Array] | None, duration: float
) -> bool:
    """Say whether signals along x_d, as `desired_peak` has them, are within their peak after the run too.

    They are if no piece of the reference is to come, and they repeat or are at rest; where a state of the generator
    matters, if by the P of (17) that is so close to its steady state by then that they cannot differ by what the peak
    is known to, or if it rests from the start on, inside of a cell. `ends` are η̂(0) and that of the steady state.
    """
    system, p, generator = trajectory.exosystem, trajectory.rate.shape[1], trajectory.generator
    if system.end is not None or (system.breaks > duration).any():
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


def _check(spec: Spec, room: Headroom, said: Sequence[str], at: Sequence[Subject], remedy: str) -> None:
    """Refuse what is lasting beyond a limit, by `said` and where it stands; nothing is said of what has no words."""
    problems, limits, peak = list[Problem](), room.limits, room.lasting
    if peak is None:
        return
    ends = np.column_stack([peak.low, peak.high])
    for k, side in peak.beyond(limits):
        unit, when = spec.problem.units.get(str(at[k][-1]), ""), f" at t = {peak.times[k, side]:.6g} s"
        message = _beyond_text(said[k], ends[k, side], limits[k, side], side, unit, when)
        still = isinstance(spec.problem.reference, SetPoint)
        hint = f"{'choose another set-point' if still else 'let the reference be slower or smaller'}, or {remedy}"
        problems += [Problem(message=message, subject=at[k], hint=hint)] if said[k] else []
    if problems:
        raise OutsideTheory(*problems)


def _beyond_text(what: str, needed: float, limit: float, side: int, unit: str, when: str = "") -> str:
    needs, ends = (f"{number_text(float(v), '.4g')} {unit}".rstrip() for v in (needed, limit))
    return f"{what} = {needs}{when}, {'above its upper' if side else 'below its lower'} limit, {ends}"


def demand_of(spec: Spec, trajectory: DesiredTrajectory, content: Any = None) -> Demand | None:
    """Return what set-points take of the inputs, as a certificate tells it or searched and proved; None without limits.

    Raises InvalidSpec if that has no end as no range is given, OutsideTheory if it is more than limits of inputs, for a
    plant without internal states, and ValueError if what was told is of other limits.
    """
    conditions, system, generator = spec.scenario.conditions, trajectory.exosystem, trajectory.generator
    if conditions.pace is None or conditions.set_range is None or generator is None or generator.played_back:
        return None
    if max(generator.form.degrees) > conditions.pace.shape[1]:
        return None  # `program` refuses it
    eta, limits = generator_start(spec, trajectory), conditions.limits
    kept = Kept.of(generator.form, conditions.pace, conditions.set_range, system(0.0), eta)
    if limits is not None and (open_ := unsaid(generator.form, kept)):
        names = " and ".join(open_)
        text = f"no range of {names} is given: what it takes of the inputs, which have limits, has no end"
        hint = f"say what set-points may be, {{{open_[0]}: {{range: [low, high], …}}}}"
        raise InvalidSpec(text, subject=(ProblemPart.SET_POINTS,), hint=hint)
    if content is None:
        found = demand(generator, kept)
    elif content["set_points"] is None:
        found = Demand.unknown(kept, generator.form.D.shape[2], not_tried(generator, kept) or _NOT_FOUND)
    else:
        found = told(kept, content["set_points"], CLOSE)
    if limits is not None and not generator.form.eta_names:
        _check_demand(spec, generator, found, limits)
    return found


def _check_demand(spec: Spec, generator: TrajectoryGenerator, found: Demand, limits: Array) -> None:
    """Refuse what may be beyond a limit of an input, with what limits of the set-points would do."""
    problems, names, beyond = list[Problem](), spec.problem.plant.inputs, found.beyond(limits)
    would = _would_do(spec, generator, found.kept, limits) if beyond else ()
    resting = demand(generator, _slow(found.kept)).beyond(limits) if beyond and not would else ()
    for k, side in beyond:
        unit, ends = spec.problem.units.get(names[k], ""), (found.low, found.high)[side]
        message = _beyond_text(f"set-points may take {names[k]}", ends[k], limits[k, side], side, unit)
        within = f"it is within with {' or '.join(would)}"
        slower = "no limit of them by itself would do: lower several"
        hint = within if would else _IN_RANGE if (k, side) in resting else slower
        problems.append(Problem(message=message, subject=(ProblemPart.SET_POINTS,), hint=hint))
    if problems:
        raise OutsideTheory(*problems)


def _slow(kept: Kept) -> Kept:
    """Return what is kept with all that moves set-points nearly 0: what is beyond a limit then is so by their range."""
    for k in range(len(kept.box)):
        if kept.of_output(k)[1]:
            kept = kept.times(k, _RESTING)
    return kept


def _would_do(spec: Spec, generator: TrajectoryGenerator, kept: Kept, limits: Array) -> Sequence[str]:
    """Return which single limits of set-points would do, and how low they have to be: that of least change first."""
    outputs, units, found = spec.problem.plant.tracked_names, spec.problem.units, list[tuple[float, str]]()
    for k, ends in enumerate(kept.box):
        if ends is None or ends[0] == ends[1] or demand(generator, kept.times(k, Fraction(0))).beyond(limits):
            continue
        low, high = Fraction(0), Fraction(1)
        for _ in range(_HALVINGS):
            share = (low + high) / 2
            low, high = (low, share) if demand(generator, kept.times(k, share)).beyond(limits) else (share, high)
        if not low:
            continue  # only if it is 0, which no limit may be
        output, order = kept.of_output(k)
        less = kept.times(k, low).box[k]
        assert less is not None
        unit = units.get(outputs[output], "")
        name = f" of {outputs[output]}" * (len(outputs) > 1)
        if order:
            per = f" {unit}/s{order if order > 1 else ''}" if unit else ""
            found.append((float(low), f"{PACE[order - 1]}{name} {down(float(less[1]))}{per}"))
        else:
            lower, upper = number_text(-float(down(-float(less[0]))), ".4g"), down(float(less[1]))
            found.append((float(low), f"range{name} [{lower}, {upper}]"))
    return [text for _, text in sorted(found, reverse=True)]
