"""x_d(t) by itself: the cells that it visits, what must hold along it for Theorem 2, (3), and peaks of signals."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from pwatrack.arrays import TINY, Array
from pwatrack.control.headroom import Peak
from pwatrack.control.realisable import ROUNDING, LeftOver, left_over
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import CheckFailed, OutsideTheory, Problem, ProblemPart, Remedy, Subject, Undecided, Way
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Exosystem
from pwatrack.simulation.enclosure import Segments, enclosed
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import trace_blocks
from pwatrack.simulation.trace import Trace

STEPS = 2000  # from sample to sample, of a walk
_BLOCK = 500  # samples: a walk stops after the block in which something is found
_LONGEST = 5e6  # radians, or time constants, that a walk may take
_LOOKS = 64  # times at which the largest residual of a stay is looked for
_PRINTED = 1e-6  # of the terms of an equation: what is left over by constants in decimals is less
_GOLDEN = (5**0.5 - 1) / 2  # its multiples are in step with no signal


def desired_flow(plant: PWASystem, trajectory: DesiredTrajectory) -> Flow:
    """Return the flow of (η̂, w, 1), with the cells of x_d."""
    p = trajectory.rate.shape[1]
    F0 = block_diag(np.zeros((p, p)), trajectory.exosystem.S, np.zeros((1, 1)))
    F = np.zeros((len(plant.A), *F0.shape))
    F[:, :p] = trajectory.rate
    part = SwitchedPart(name="x_d", cells=plant.cell_names, guards=trajectory.guards, signs=trajectory.signs, F=F)
    return Flow(F0=F0, parts=(part,))


def blocks(plant: PWASystem, trajectory: DesiredTrajectory, z0: Array, duration: float) -> Iterator[Trace]:
    """Walk (η̂, w, 1) from z0 for a time in s, with the cells of x_d.

    Raises Undecided if that would take too long; CheckFailed as `simulate_flow`.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    radians = float(np.abs(system.rates.imag).max(initial=0.0)) * duration
    if radians > _LONGEST:
        raise Undecided(
            f"x_d is not followed from cell to cell: {radians:.3g} rad in {duration:.6g} s, "
            f"at most {_LONGEST:.0e} are walked",
            subject=(ProblemPart.REFERENCE,),
            hint="shorten the simulation, or choose frequencies with whole-number ratios: one period is enough",
        )
    resets = [each.behind(p) for each in system.resets]
    flow, step = desired_flow(plant, trajectory), duration / STEPS
    return trace_blocks(flow, z0, duration=duration, sample_time=step, resets=resets, most=_BLOCK)


def stays(
    plant: PWASystem, trajectory: DesiredTrajectory, z0: Array, duration: float
) -> Iterator[tuple[int, float, float]]:
    """Yield (cell, from, to) of each stay of x_d, long ones in parts."""
    cell, since = -1, 0.0
    for trace in blocks(plant, trajectory, z0, duration):
        cell = trace.first_mode[0] if cell < 0 else cell
        for event in trace.events:
            yield cell, since, event.t
            cell, since = event.after[0], event.t
        if trace.t[-1] > since:
            yield cell, since, float(trace.t[-1])
            since = float(trace.t[-1])
    if duration > since:
        yield cell, since, duration


def realised(
    plant: PWASystem, trajectory: DesiredTrajectory, *, horizon: float, subject: Subject = ()
) -> DesiredTrajectory:
    """Prove (3) for x_d in closed form, in every cell that it visits, and return the trajectory with what is proved.

    On each piece of x_d it is known of every cell whether (3) holds there, whenever x_d is in it: see `LeftOver`. Where
    that differs from cell to cell, x_d is walked from facet to facet, for one period if it is periodic. (3) is asked
    for up to the horizon, in s; `subject` is what in the description x_d is, the state follows. Raises OutsideTheory if
    no u_ff satisfies (3): first time and cell, state equations and sizes; Undecided if the walk would take too long.
    """
    system = trajectory.exosystem
    starts = np.unique(np.append(0.0, system.breaks[system.breaks < horizon]))
    ends = np.append(starts[1:], horizon)
    rest = left_over(plant, trajectory)
    left, size = rest.sizes(starts, ends - starts)
    scale = np.maximum(size.max(axis=(0, 1)), TINY)  # (n,)
    wrong = (left > ROUNDING * scale).any(axis=2)  # (l, pieces)
    everywhere = not wrong[:, -1].any()  # the last piece goes on for ever
    if wrong.any():
        periodic = system.period is not None and system.period <= horizon
        duration = system.period if periodic and system.period is not None else horizon
        starts = starts[starts < duration]
        ends = np.append(starts[1:], np.inf)
        walked = stays(plant, trajectory, np.append(system.w0, 1.0), duration) if len(plant.A) > 1 else None
        for cell, start, end in walked or [(0, 0.0, duration)]:
            first, last = np.searchsorted(starts, [start, end], side="right") - 1
            for k in first + np.flatnonzero(wrong[cell, first : last + 1]):
                problems = _problems(plant, rest, cell, max(start, starts[k]), min(end, ends[k]), scale, subject)
                if problems:
                    raise OutsideTheory(*problems)
        everywhere = periodic
    return trajectory if everywhere and system.end is None else replace(trajectory, until=horizon)


def _problems(
    plant: PWASystem, rest: LeftOver, cell: int, start: float, end: float, scale: Array, subject: Subject
) -> list[Problem]:
    """Return what is left over of (3) in a stay, at its worst time, one problem per state equation."""
    fastest = float(np.abs(rest.trajectory.exosystem.rates.imag).max(initial=0.0))
    short = min(end - start, 4 * np.pi / fastest) if fastest else end - start
    fractions = _GOLDEN * np.arange(_LOOKS) % 1.0
    times = start + np.append(fractions * (end - start), fractions * short)
    left = np.abs(rest.at(cell, times))
    k = int(np.argmax((left / scale).max(axis=1)))
    rounded = left[k] <= _PRINTED * scale
    return [
        Problem(
            message=f"x_d is not realisable: at t = {times[k]:.6g} s in cell '{plant.cell_names[cell]}' no input "
            f"satisfies the equation of state '{plant.states[j]}' in (3); {left[k, j]:.4g} is left over",
            subject=(*subject, j),
            hint=f"that is {left[k, j] / scale[j]:.1e} of its terms"
            if rounded[j]
            else "a state that the input does not drive directly must follow from the others",
            remedy=Remedy(Way.EXACT_NUMBERS) if rounded[j] else None,
        )
        for j in np.flatnonzero(left[k] > ROUNDING * scale).tolist()
    ]


def desired_peak(
    plant: PWASystem, trajectory: DesiredTrajectory, gains: Array, start: Array | None, duration: float
) -> Peak | None:
    """Return the largest and smallest of signals along x_d from t = 0 to the end, and when.

    They are enclosed at all times, between samples, where x_d crosses a facet and where signals have new pieces: none
    is above what is said, and that is at most 1e-6 of the largest above one that there is. `gains` make them of
    (η̂, w, 1) in each cell, (l, m, S): u_ff, or rows of x_d. It begins at η̂(0), (p,) if that matters. None is returned
    where x_d takes too long to follow or does not stay within numbers.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    duration = duration if system.end is None else min(duration, system.end)
    segments: Iterable[Segments]
    if w_alone(gains, p):
        segments = [along(system, duration, before=p)]
    elif start is None and p:
        return None
    else:
        flow, z0 = desired_flow(plant, trajectory), np.concatenate([np.zeros(0) if start is None else start, system.w0])
        segments = (Segments.of(flow, block) for block in blocks(plant, trajectory, np.append(z0, 1.0), duration))
    try:
        found = enclosed(segments, lambda mode: gains[mode[0]])
    except (CheckFailed, Undecided):
        return None
    bounded = np.isfinite([found.low, found.high]).all()
    return Peak(low=found.low, high=found.high, times=found.times) if bounded else None


def w_alone(gains: Array, p: int) -> bool:
    """Say whether neither η̂, (p,), nor the cell of x_d matters to what such gains make of (η̂, w, 1), (l, m, S)."""
    return not gains[:, :, :p].any() and not (gains - gains[0]).any()


def along(system: Exosystem, duration: float, *, before: int = 0, steps: int = STEPS) -> Segments:
    """Return (0, w, 1), with so many 0 before w, from piece to piece of an exosystem, and step to step of the time."""
    t = np.unique([*np.linspace(0.0, duration, steps + 1), *system.breaks[system.breaks < duration]])
    zeta = np.hstack([np.zeros((len(t), before)), system.states(t), np.ones((len(t), 1))])
    F = block_diag(np.zeros((before, before)), system.S, np.zeros((1, 1)))
    number, length = np.zeros(len(t), dtype=np.int64), np.diff(t, append=t[-1])
    return Segments(modes=((0,),), F=F[None], number=number, t=t, zeta=zeta, length=length)
