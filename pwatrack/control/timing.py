"""What the rounding of times does to a reference in pieces: none begins at exactly the time that is meant."""

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import EPS, Array
from pwatrack.causes import Remedy, Subject, Way
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import InvalidSpec, Problem
from pwatrack.model.pwa import PWASystem

ALLOWED = 1e-9  # of the size of the reference: as exact as everything else that is shown
_MOST_DOUBLINGS = 60  # of a fraction of the fastest time constant: no plant has slower ones


def check_timing(
    plant: PWASystem,
    K: Array,
    trajectory: DesiredTrajectory,
    *,
    outputs: Array,
    smooth: tuple[float, int] | None = None,
    subject: Subject = (),
) -> None:
    """Refuse a reference that changes so fast that the rounding of its break times can be seen.

    Args:
        plant, K, trajectory, outputs: As for `timing_error`.
        smooth: The time (s) over which corners were rounded, and how many derivatives of the reference reach u_ff.
        subject: What in the description the reference is.

    Raises:
        InvalidSpec: With the time, the error to expect, and the shortest rounding that would do.
    """
    worst, time = timing_error(plant, K, trajectory, outputs=outputs)
    if worst <= ALLOWED:
        return
    shortest = None if smooth is None else smooth[0] * (worst / ALLOWED) ** (1 / smooth[1])
    raise InvalidSpec(
        Problem(
            message=f"the time of a break at t = {time:.6g} s is known to {EPS * time:.1g} s, and the reference "
            f"is so fast there that this alone makes a tracking error of about {worst:.1g} of its own size; "
            f"up to {ALLOWED:g} is taken",
            subject=subject,
            hint="round its corners over a longer time",
            remedy=None if shortest is None else Remedy(Way.LONGER_ROUNDING, (shortest,)),
        )
    )


def timing_error(plant: PWASystem, K: Array, trajectory: DesiredTrajectory, *, outputs: Array) -> tuple[float, float]:
    """Estimate the tracking error that the rounding of break times makes, relative to the reference, and its time.

    A break at t is known to ε t only. The plant follows the old piece for that much longer, and then is off by
    ẋ_d(t) ε t; from there the error runs as e^{(A_i + BK)t}, which is followed here at times 1, 2, 4, … of a fraction
    of the fastest time constant.

    Args:
        plant: The system (1).
        K: Gain of the controller.
        trajectory: The desired one.
        outputs: What of x shall follow, (q, n): C, or I for state tracking.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    if not system.resets:
        return 0.0, 0.0
    rows = trajectory.x_d[:, :, p:-1]
    times, jumps = [0.0], [np.zeros(len(plant.B))]
    for where, t, _ in system.pieces():
        rates = system.states(t) @ system.S.T
        for X in np.unique(rows, axis=0):
            off = rates[:, where] @ X[:, where].T * (EPS * t[:, None])  # ẋ_d ε t
            for k in sorted(set(np.abs(off).argmax(axis=0).tolist())):
                times.append(float(t[k]))
                jumps.append(off[k])
    breaks = np.unique([0.0, *(reset.t for reset in system.resets)])
    wanted = system.states(breaks) @ (outputs @ rows[0]).T
    size = np.maximum(np.ptp(wanted, axis=0), EPS * np.abs(wanted).max(axis=0))
    with np.errstate(all="ignore"):
        relative = _largest(plant, K, outputs, np.array(jumps).T) / size[:, None]
    relative = np.where(np.isnan(relative), 0.0, relative)  # nothing off, and nothing wanted
    k = int(np.argmax(relative.max(axis=0)))
    return float(relative[:, k].max()), times[k]


def _largest(plant: PWASystem, K: Array, outputs: Array, starts: Array) -> Array:
    """Return the largest entries of outputs e^{(A_i + BK)t} starts, about, over all t and cells, (q, starts)."""
    found = np.abs(outputs @ starts)
    for A in plant.A + plant.B @ K:
        speed = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
        if not 0 < speed < np.inf:
            continue
        step = expm(0.25 / speed * A)
        for _ in range(_MOST_DOUBLINGS):
            found = np.maximum(found, np.abs(outputs @ step @ starts))
            if not 1e-3 < np.abs(step).max() < 1e30:
                break
            step = step @ step
    return found
