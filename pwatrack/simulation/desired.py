"""What must hold along x_d(t) for Theorem 2, decided by walking it: (3)."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import TINY, Array
from pwatrack.causes import Remedy, Subject, Way
from pwatrack.control.realisable import ROUNDING, LeftOver, left_over
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import OutsideTheory, Problem
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.mode_sequence import stays

BoolArray = NDArray[np.bool_]
_LOOKS = 64  # times at which the largest residual of a stay is looked for
_PRINTED = 1e-6  # of the terms of an equation: what is left over by constants in decimals is less
_GOLDEN = (5**0.5 - 1) / 2  # its multiples are in step with no signal


def realised(
    plant: PWASystem, trajectory: DesiredTrajectory, *, horizon: float, subject: Subject = ()
) -> DesiredTrajectory:
    """Prove (3) for x_d in closed form, in every cell that it visits, and return the trajectory with what is proved.

    On each piece of x_d it is known of every cell whether (3) holds there, whenever x_d is in it: see `LeftOver`.
    Where that differs from cell to cell, x_d is walked from facet to facet, for one period if it is periodic.

    Args:
        plant: The system (1).
        trajectory: From `state_trajectory`.
        horizon: Up to when (3) is asked for, in s.
        subject: What in the description x_d is; the state follows.

    Raises:
        OutsideTheory: If no u_ff satisfies (3): first time and cell, state equations and sizes.
        Undecided: If the walk would take too long.
    """
    system = trajectory.exosystem
    reset = np.array([r.t for r in system.resets if r.t < horizon])
    starts = np.unique(np.append(0.0, reset))
    ends = np.append(starts[1:], horizon)
    rest = left_over(plant, trajectory)
    left, size = rest.sizes(starts, ends - starts)
    scale = np.maximum(size.max(axis=(0, 1)), TINY)  # (n,)
    wrong = (left > ROUNDING * scale).any(axis=2)  # (l, pieces)
    everywhere = not wrong[:, -1].any()  # the last piece goes on for ever
    if wrong.any():
        periodic = system.period is not None and system.period <= horizon
        duration = system.period if periodic and system.period is not None else horizon
        for cell, start, end in _stays(plant, trajectory, duration, wrong):
            problems = _problems(plant, rest, cell, start, end, scale, subject)
            if problems:
                raise OutsideTheory(*problems)
        everywhere = periodic
    return trajectory if everywhere and system.end is None else replace(trajectory, until=horizon)


def _stays(
    plant: PWASystem, trajectory: DesiredTrajectory, duration: float, wrong: BoolArray
) -> Iterator[tuple[int, float, float]]:
    """Yield (cell, from, to) of what x_d spends on one piece in a cell where (3) does not hold there."""
    system = trajectory.exosystem
    starts = np.unique(np.append(0.0, [r.t for r in system.resets if r.t < duration]))
    walked = stays(plant, trajectory, np.append(system.w0, 1.0), duration) if len(plant.A) > 1 else ()
    for cell, start, end in walked or [(0, 0.0, duration)]:
        first, last = np.searchsorted(starts, [start, end], side="right") - 1
        for k in range(first, last + 1):
            if wrong[cell, k]:
                yield cell, max(start, starts[k]), min(end, starts[k + 1] if k + 1 < len(starts) else end)


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
