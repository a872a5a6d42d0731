"""Gains of least cost for a controller that runs once in a sample time: its regulator and its Kalman filter.

Both are of the mean of all cells, with the weights and densities of the goals in continuous time, so that a short
sample gives nearly those gains. Which of them do, a proof decides.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from pwatrack.arrays import Array
from pwatrack.control.candidates import short
from pwatrack.control.goal import Given, Goal, LeastCost, demands
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.task import Task
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER, Role
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes


def candidates(
    plant: PWASystem, sizes: Sizes, goals: Mapping[Role, Goal], made: SampledGains
) -> Iterator[SampledGains]:
    """Yield gains in the order in which they are tried: those made of K and L, with M, then K and M, of least cost.

    Where a cost is the goal of K or M, that of least cost is the first; a gain that is given is made of nothing else.
    """
    found = dict[Role, Array]()
    with np.errstate(all="ignore"):
        for role, of_least_cost in ((CONTROLLER, regulator), (OBSERVER, kalman)):
            if not isinstance(goals.get(role), Given | None):
                gain = of_least_cost(Task.of(plant, role, sizes=sizes), goals[role], made.sample_time)
                if gain is not None:
                    found[role] = gain
    costs = {role for role in found if isinstance(goals[role], LeastCost)}
    seen = list[set[Role]]()
    for taken in (costs, costs | {OBSERVER}, costs | {CONTROLLER, OBSERVER}):
        if (kept := taken & found.keys()) not in seen:
            seen.append(kept)
            yield replace(
                made,
                K=found[CONTROLLER] if CONTROLLER in kept else made.K,
                M=found[OBSERVER] if OBSERVER in kept else made.M,
            )


def regulator(task: Task, goal: Goal, h: float) -> Array | None:
    """Return K of u_k = K x_k with the least ∫(xᵀ Q x + uᵀ R u) dt, u held for h (Van Loan 1978), or None.

    Example: x' = u with short samples: the least ∫(x² + u²) dt has u = −x.

        >>> task = Task(A=np.zeros((1, 1, 1)), B=np.ones((1, 1)), cells=["all"])
        >>> regulator(task, LeastCost(Q=np.eye(1), R=np.eye(1)), 1e-4).round(3).tolist()
        [[-1.0]]
    """
    A, B, Q, R = _weighed(task, goal)
    n, m = B.shape
    whole = np.block([[A, B], [np.zeros((m, n + m))]])
    over, cost = _sampled(whole, np.block([[Q, np.zeros((n, m))], [np.zeros((m, n)), R]]), h)
    A, B, Q, R, N = over[:n, :n], over[:n, n:], cost[:n, :n], cost[n:, n:], cost[:n, n:]
    P = _least_cost(A, B, Q, R, N)
    return None if P is None else short(np.asarray(-np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + N.T)))


def kalman(task: Task, goal: Goal, h: float) -> Array | None:
    """Return M of x̂⁺ = x̂ + M (C x̂ − y) for noise of density Q on x' and of variance R / h in each sample; or None.

    Args:
        task: (9) transposed: its A are those of the observer transposed, its B is Cᵀ.
        goal: Of L.
        h: In s.
    """
    A, B, Q, R = _weighed(task, goal)
    A, Q = _sampled(A, Q, h)
    P = _least_cost(A, B, Q, R / h, np.zeros_like(B))
    return None if P is None else short(np.asarray(-np.linalg.solve(R / h + B.T @ P @ B, B.T @ P).T))


def _sampled(A: Array, Q: Array, h: float) -> tuple[Array, Array]:
    """Return e^(A h) and the integral of e^(Aᵀ t) Q e^(A t) up to h."""
    n = len(A)
    both = expm(np.block([[-A.T, Q], [np.zeros((n, n)), A]]) * h)
    return np.asarray(both[n:, n:]), np.asarray(both[n:, n:].T @ both[:n, n:])


def _least_cost(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Array | None:
    with suppress(np.linalg.LinAlgError, ValueError):  # there is none, or an entry is not finite
        return np.asarray(solve_discrete_are(A, B, (Q + Q.T) / 2, (R + R.T) / 2, s=N))
    return None


def _weighed(task: Task, goal: Goal) -> tuple[Array, Array, Array, Array]:
    """Return A and B of the mean cell with the rate that is asked for added, and the weights."""
    A = task.A.mean(axis=0) + demands(goal)[0] * np.eye(task.A.shape[1])
    if isinstance(goal, LeastCost):
        return A, task.B, goal.Q, goal.R
    return A, task.B, np.diag(task.scale.state**-2.0), np.diag(task.scale.input**-2.0)
