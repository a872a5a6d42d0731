"""Whether the plant's own response x_d(t) to given inputs stays bounded: Theorem 2 needs that."""

from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from math import e, factorial

import numpy as np
from scipy.linalg import block_diag, solve_continuous_lyapunov, solve_sylvester

from pwatrack.arrays import EPS, TINY, Array, balancing
from pwatrack.ball_matrix import different
from pwatrack.control.convergence import prove_convergence
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import CheckFailed, Infeasible, Problem, Remedy, Subject, Undecided, Way
from pwatrack.lmi.inequality import PLANT
from pwatrack.lmi.polynomial import exactly
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import spectral_terms
from pwatrack.rational import is_hurwitz
from pwatrack.simulation.desired import STEPS, blocks
from pwatrack.simulation.steady_state import SteadyState
from pwatrack.simulation.trace import tenths

_FURTHER = 10  # times the duration, to see whether what grows goes on to grow
_MORE = 1.01  # times what was before: the peaks of an oscillation that settles rise by less
_LOST = 0.01  # of the largest state: what differs by more from a periodic solution is not on it
_SOLVED = 1e-9  # of the terms of an equation: what is missed by less is rounding
_CLEAR = 1e-6  # of the terms of a bound: what leaves more than this is no rounding


def bounded_response(
    plant: PWASystem, trajectory: DesiredTrajectory, *, horizon: float, subject: Subject = ()
) -> DesiredTrajectory:
    """Return the trajectory with whether x_d is proved bounded, or refuse it where x_d is seen to grow.

    It is bounded if (7) holds (Theorem 1); or if from the end of the run on it never leaves a cell that is stable by
    itself, where it is a sum of exponentials. Of a periodic solution that is still to be found, a trajectory without a
    start, only (7) is asked. The horizon is the duration of the run in s, `subject` what in the description the start
    is. Raises CheckFailed if neither is proved, |x_d| in the last tenth of the run is above that of every tenth before
    it and above the size of start and inputs, and so it is in a run of ten times the duration. Where the inputs end,
    and there is no longer run, the cell at the end must be unstable instead.
    """
    if _convergent(plant):
        return trajectory
    unproved = replace(trajectory, bounded=False)
    if trajectory.eta0 is None:
        return unproved
    try:
        most, cell, z = _walked(plant, trajectory, horizon)
    except Undecided:  # too long a walk
        return unproved
    if np.isfinite(most).all() and _stays(plant, trajectory, cell, z, horizon):
        return trajectory
    grows = _grows(plant, trajectory, most, horizon)
    if grows and trajectory.exosystem.end is not None:
        grows = bool(np.linalg.eigvals(plant.A[cell]).real.max() > 0)
    elif grows:
        with suppress(Undecided):
            longer = _walked(plant, trajectory, _FURTHER * horizon)[0]
            grows = _grows(plant, trajectory, longer, _FURTHER * horizon)
    if grows:
        last, before = most[-1], np.maximum(most[:-1].max(axis=0), TINY)
        k = int(np.argmax(last / before))
        reached = f"{last[k]:.3g}" if np.isfinite(last[k]) else "more than 1e+100"
        seen = f"|{plant.states[k]}| reaches {reached} in the last tenth of {horizon:g} s, {before[k]:.3g} before"
        raise CheckFailed(_unbounded(f"x_d grows without bound, as far as can be seen: {seen}", subject))
    return unproved


def left_by_rounding(found: SteadyState, *, duration: float, subject: Subject = ()) -> Problem | None:
    """Say that x_d, started on a periodic solution, is not on it to the end of a run, or return None.

    What differs from an unstable one is multiplied in each period by the largest of its multipliers; all that there is
    of it in floating point is a start that is off by its rounding. The duration is in s; `subject` is what in the
    description asks for the solution.
    """
    period, largest = float(found.t[-1]), float(np.abs(found.multipliers).max(initial=0.0))
    if largest <= 1:
        return None
    lost = period * np.log(_LOST / max(found.residual, EPS)) / np.log(largest)
    if duration < lost:
        return None
    return _unbounded(
        f"x_d leaves its periodic solution by rounding: what differs from it is multiplied by {largest:.3g} in "
        f"{period:.6g} s, one period, so that this is seen after about {lost:.3g} s",
        subject,
    )


def _convergent(plant: PWASystem) -> bool:
    if np.linalg.eigvals(plant.A).real.max() >= 0:
        return False
    try:
        found = prove_convergence(np.swapaxes(plant.A, 1, 2), claim="(7)", cells=plant.cell_names)
    except (Infeasible, Undecided):
        return False
    return exactly(PLANT, [A_i.transpose() for A_i in different(plant.exact.A)], found) is not None


def _walked(plant: PWASystem, trajectory: DesiredTrajectory, duration: float) -> tuple[Array, int, Array]:
    """Return the largest |x_d| in each tenth by state, (10, n), inf beyond bounds; cell and (x_d, w, 1) at the end."""
    assert trajectory.eta0 is not None
    n = len(trajectory.eta0)
    z = np.concatenate([trajectory.eta0, trajectory.exosystem.w0, [1.0]])
    largest, cell, seen = np.zeros((10, n)), plant.partition.locate(trajectory.eta0), np.zeros((0, n))
    try:
        for trace in blocks(plant, trajectory, z, duration):
            seen = np.vstack([seen, np.abs(trace.z[:, :n])])
            z, cell = trace.z[-1], int(trace.modes[-1, 0])
    except CheckFailed:  # beyond all bounds
        largest[-1] = np.inf
    for k, (first, last) in enumerate(pairwise(tenths(STEPS + 1))):
        largest[k] = np.maximum(largest[k], seen[first:last].max(axis=0, initial=0.0))
    return largest, cell, z


def _grows(plant: PWASystem, trajectory: DesiredTrajectory, most: Array, duration: float) -> bool:
    """Whether |x_d| in the last tenth is above all before it, and above the size of start and inputs."""
    d, system = balancing(plant.A), trajectory.exosystem
    size = np.linalg.norm(most / d, axis=1)
    times = np.linspace(0.0, duration, 200)
    inputs = np.linalg.norm(system.states(times) @ (plant.B @ system.Q).T / d, axis=1).max(initial=0.0)
    rate = max(float(np.linalg.norm(plant.A / d[:, None] * d, 2, axis=(1, 2)).max()), 1 / duration)
    assert trajectory.eta0 is not None
    return bool(size[-1] > _MORE * max(size[:-1].max(), np.linalg.norm(trajectory.eta0 / d), inputs / rate))


def _unbounded(what: str, subject: Subject) -> Problem:
    return Problem(
        message=f"{what}; Theorem 2 is about a bounded x_d",
        subject=subject,
        hint="the plant does not stay bounded under these inputs by itself",
        remedy=Remedy(Way.DESIRED_STATE),
    )


def _stays(plant: PWASystem, trajectory: DesiredTrajectory, i: int, z: Array, horizon: float) -> bool:
    """Prove that x_d = X (w, 1) + e^{At} e never again leaves its cell, which is stable, and so stays bounded.

    With AᵀP + PA ≺ 0, |h e^{At} e| ≤ (h P⁻¹ hᵀ)^½ (eᵀ P e)^½; each term t^m e^{λt} of X (w, 1) has a largest size.
    """
    system, n = trajectory.exosystem, plant.A.shape[1]
    if system.end is not None or (system.breaks > horizon).any():
        return False
    if not is_hurwitz(plant.exact.A[i].centre):
        return False
    d = balancing(plant.A[i : i + 1])
    A, R = plant.A[i] / d[:, None] * d, trajectory.rate[i, :, n:] / d[:, None]
    S = block_diag(system.S, np.zeros((1, 1)))
    try:
        X, P = solve_sylvester(A, -S, -R), solve_continuous_lyapunov(A.T, -np.eye(n))
    except np.linalg.LinAlgError:  # w has a mode of the plant's
        return False
    missed = np.abs(A @ X - X @ S + R).max(initial=0.0)
    solved = missed <= _SOLVED * (np.abs(A) @ np.abs(X) + np.abs(X) @ np.abs(S) + np.abs(R)).max(initial=0.0)
    definite = np.linalg.eigvalsh(P)[0] > 0 and np.linalg.eigvalsh(A.T @ P + P @ A)[-1] < -0.5
    if not (solved and definite):
        return False
    w = z[n:]
    away = z[:n] / d - X @ w
    bounding = np.flatnonzero(plant.partition.signs[i])
    H = plant.partition.signs[i][bounding, None] * plant.partition.H[bounding] * d
    h = plant.partition.signs[i][bounding] * plant.partition.h[bounding]
    reach = np.sqrt(np.einsum("kn,nk->k", H, np.linalg.solve(P, H.T)) * max(float(away @ P @ away), 0.0))
    level, swing = h.copy(), np.zeros_like(h)
    for rate, chain in spectral_terms(S, np.append(system.rates, 0.0)):
        for m, E in enumerate(chain):
            part = H @ X @ (E @ w)
            if rate == 0 and m == 0:
                level += part.real
            else:
                grows = rate.real > 0 or (rate.real == 0 and m)
                largest = np.inf if grows else (m / (e * -rate.real)) ** m / factorial(m) if m else 1.0
                swing += np.abs(part) * largest  # of t^m e^{rate t} / m! for t ≥ 0
    return bool((level - swing - reach > _CLEAR * (np.abs(level) + swing + reach)).all())
