"""How large the feedforward gets, known before anything is simulated: limits of inputs have to leave room for it."""

from collections.abc import Iterable

import numpy as np
from scipy.linalg import block_diag

from pwatrack.arrays import Array
from pwatrack.control.headroom import Peak
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import CheckFailed, Undecided
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.enclosure import Segments, enclosed
from pwatrack.simulation.mode_sequence import STEPS, blocks, desired_flow


def feedforward_peak(
    plant: PWASystem, trajectory: DesiredTrajectory, start: Array | None, duration: float
) -> Peak | None:
    """Return the largest and smallest u_ff from t = 0 to the end, and when.

    They are enclosed at all times, between samples, where x_d crosses a facet and where signals have new pieces: no
    u_ff is above what is said, and that is at most 1e-6 of the largest above one that there is.

    Args:
        plant: It has the cells.
        trajectory: What makes u_ff.
        start: η̂(0), (p,), if it matters.
        duration: In s.

    Returns:
        The peak, or None where x_d takes too long to follow or does not stay within numbers.

    Example: what the paper's example takes in its steady state.

        >>> from pwatrack import load_spec
        >>> from pwatrack.simulation.startup import steady_start
        >>> from pwatrack.workflow.tracking import desired_trajectory
        >>> spec = load_spec("specs/two_mass_backlash.yaml")
        >>> trajectory, generator = desired_trajectory(spec, False)
        >>> start = steady_start(trajectory, generator)
        >>> peak = feedforward_peak(spec.problem.plant, trajectory, start, trajectory.exosystem.period)
        >>> peak.high.round(3).tolist(), peak.times.round(3).tolist()
        ([5.886], [[0.253, 0.753]])
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    duration = duration if system.end is None else min(duration, system.end)
    segments: Iterable[Segments]
    if w_alone(trajectory):
        segments = [_of_w(trajectory, duration)]
    elif start is None and p:
        return None
    else:
        flow, z0 = desired_flow(plant, trajectory), np.concatenate([np.zeros(0) if start is None else start, system.w0])
        segments = (Segments.of(flow, block) for block in blocks(plant, trajectory, np.append(z0, 1.0), duration))
    try:
        found = enclosed(segments, lambda mode: trajectory.u_ff[mode[0]])
    except (CheckFailed, Undecided):
        return None
    return (
        Peak(low=found.low, high=found.high, times=found.times) if np.isfinite([found.low, found.high]).all() else None
    )


def w_alone(trajectory: DesiredTrajectory) -> bool:
    """Say whether neither η̂ nor the cell of x_d matters to u_ff."""
    gains = trajectory.u_ff
    return not gains[:, :, : trajectory.rate.shape[1]].any() and not (gains - gains[0]).any()


def _of_w(trajectory: DesiredTrajectory, duration: float) -> Segments:
    """Return (η̂, w, 1) with η̂ = 0, from piece to piece of the reference."""
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    F = block_diag(np.zeros((p, p)), system.S, np.zeros((1, 1)))
    breaks = [reset.t for reset in system.resets if reset.t < duration]
    t = np.unique([*np.linspace(0.0, duration, STEPS + 1), *breaks])
    zeta = np.hstack([np.zeros((len(t), p)), system.states(t), np.ones((len(t), 1))])
    number, length = np.zeros(len(t), dtype=np.int64), np.diff(t, append=t[-1])
    return Segments(modes=((0,),), F=F[None], number=number, t=t, zeta=zeta, length=length)
