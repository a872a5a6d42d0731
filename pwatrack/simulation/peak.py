"""How large the feedforward gets, known before anything is simulated: limits of inputs have to leave room for it."""

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.control.limits import Peak
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import CheckFailed, Undecided
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.visits import STEPS, blocks

_PER_RADIAN = 10  # samples of the fastest signal: a parabola through three of them is right to about 1e-6 of it
_MOST = 100_000  # samples
_SAME = 1e-6  # of the largest: of peaks that differ by less the first one counts


def feedforward_peak(
    plant: PWASystem, trajectory: DesiredTrajectory, start: Array | None, duration: float
) -> Peak | None:
    """Return the largest and smallest u_ff from t = 0 to the end, and when.

    u_ff is smooth between the times at which its signals have new pieces or x_d crosses a facet. It is taken there,
    on both sides, and at samples of x_d; between three of them a parabola finds the top.

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
        >>> from pwatrack.study.tracking import desired_trajectory
        >>> spec = load_spec("specs/two_mass_backlash.yaml")
        >>> trajectory, generator = desired_trajectory(spec, False)
        >>> start = steady_start(trajectory, generator)
        >>> peak = feedforward_peak(spec.problem.plant, trajectory, start, trajectory.exosystem.period)
        >>> peak.high.round(3).tolist(), peak.times.round(3).tolist()
        ([5.886], [[0.253, 0.753]])
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    duration = duration if system.end is None else min(duration, system.end)
    speed = float(np.abs(system.rates).max(initial=0.0))
    steps = int(np.clip(_PER_RADIAN * speed * duration, STEPS, _MOST))
    breaks = np.unique([reset.t for reset in system.resets if reset.t < duration])
    free = not trajectory.u_ff[:, :, :p].any() and not (trajectory.u_ff - trajectory.u_ff[0]).any()
    if free:  # neither η̂ nor the cell matters
        t = np.linspace(0.0, duration, steps + 1)
        values = _of_w(trajectory, t)
        nodes = np.sort(np.concatenate([breaks, np.nextafter(breaks, 0.0)]))
        at_nodes = _of_w(trajectory, nodes)
    else:
        if start is None and p:
            return None
        try:
            t, z, cell, crossed, entered = _walked(
                plant, trajectory, np.zeros(0) if start is None else start, duration, steps
            )
        except (CheckFailed, Undecided):
            return None
        values = np.einsum("kms,ks->km", trajectory.u_ff[cell], z)
        breaks = np.unique(np.concatenate([breaks, crossed[crossed < t[-1]]]))
        nodes = np.sort(np.concatenate([breaks, np.nextafter(breaks, 0.0)]))
        at_nodes = _between(trajectory, (t, z, cell), (crossed, entered), nodes)
    columns = [_ends(t, values[:, k], breaks, nodes, at_nodes[:, k]) for k in range(values.shape[1])]
    ends = np.array(columns).reshape(-1, 2, 2)
    return Peak(low=ends[:, 0, 0], high=ends[:, 1, 0], times=ends[:, :, 1])


def _of_w(trajectory: DesiredTrajectory, t: Array) -> Array:
    """Return u_ff at some times, (K, m), where it depends on w alone."""
    rows, p = trajectory.u_ff[0], trajectory.rate.shape[1]
    return np.asarray(trajectory.exosystem.states(t) @ rows[:, p:-1].T + rows[:, -1])


def _walked(
    plant: PWASystem, trajectory: DesiredTrajectory, start: Array, duration: float, steps: int
) -> tuple[Array, Array, IntArray, Array, IntArray]:
    """Return times, (η̂, w, 1) and the cell of x_d there; the times at which x_d changes its cell, and all its cells."""
    z0 = np.concatenate([start, trajectory.exosystem.w0, [1.0]])
    found = list(blocks(plant, trajectory, z0, duration, steps=steps))
    t, z, cell = (np.concatenate(part) for part in zip(*((b.t, b.z, b.modes[:, 0]) for b in found), strict=True))
    events = [event for block in found for event in block.events]
    cells = np.array([cell[0], *(event.after[0] for event in events)])
    return t, z, cell, np.array([event.t for event in events]), cells


def _between(
    trajectory: DesiredTrajectory,
    walked: tuple[Array, Array, IntArray],
    crossings: tuple[Array, IntArray],
    times: Array,
) -> Array:
    """Return u_ff between samples, (K, m): w is known at all times, η̂ by the cubic through its values and slopes."""
    (t, z, cell), p = walked, trajectory.rate.shape[1]
    k = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    h, s = t[k + 1] - t[k], (times - t[k]) / (t[k + 1] - t[k])
    slope = np.einsum("kps,ks->kp", trajectory.rate[cell], z) if p else np.zeros((len(t), 0))
    cubic = (2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, 3 * s**2 - 2 * s**3, s**3 - s**2)
    parts = (z[k, :p], h[:, None] * slope[k], z[k + 1, :p], h[:, None] * slope[k + 1])
    eta: Array = np.sum([c[:, None] * part for c, part in zip(cubic, parts, strict=True)], axis=0)
    here = np.column_stack([eta, trajectory.exosystem.states(times), np.ones(len(times))])
    crossed, entered = crossings
    cells = entered[np.searchsorted(crossed, times, side="right")]  # where u_ff jumps, each side counts
    return np.asarray(np.einsum("kms,ks->km", trajectory.u_ff[cells], here))


def _ends(t: Array, values: Array, breaks: Array, nodes: Array, at_nodes: Array) -> list[tuple[float, float]]:
    """Return the lowest and the highest of values (K,) at samples, between them and at nodes, each with its time."""
    found = []
    before, after = values[:-2] - values[1:-1], values[2:] - values[1:-1]
    smooth = np.searchsorted(breaks, t[2:], side="left") == np.searchsorted(breaks, t[:-2], side="right")
    step = float(t[1] - t[0])
    for sign in (-1.0, 1.0):
        k = np.flatnonzero(smooth & (sign * before <= 0) & (sign * after <= 0) & (before + after != 0))
        bend, tilt = (before + after)[k], (before - after)[k]
        tops, at = values[k + 1] - tilt**2 / (8 * bend), t[k + 1] + step * tilt / (2 * bend)
        both, times = np.concatenate([values, at_nodes, tops]), np.concatenate([t, nodes, at])
        best = float((sign * both).max())
        same = np.flatnonzero(sign * both >= best - _SAME * np.abs(both).max())
        near = same[times[same] <= times[same].min() + 4 * step]
        found.append((sign * best, float(times[near[np.argmax(sign * both[near])]])))
    return found
