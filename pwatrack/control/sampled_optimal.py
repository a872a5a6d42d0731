"""Gains of least cost for a controller that runs once in a sample time: its regulator and its Kalman filter.

Both have the weights and densities of the goals in continuous time, so that a short sample gives nearly those gains:
of the mean of all cells, or with a cost or covariance for all of them. Which of them do, a proof decides.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from pwatrack.arrays import Array
from pwatrack.control.goal import Given, Goal, LeastCost, demands
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.task import Task
from pwatrack.lmi.clocked_gains import correction, feedback
from pwatrack.lmi.exact import short
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER, Role
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes

_LITTLE = 1e-9  # of the mean weight of a cost, in sizes: what is added to each
_ROUNDING = 1e-13  # of the largest entry of a gain, in sizes


def candidates(
    plant: PWASystem, sizes: Sizes, goals: Mapping[Role, Goal], made: SampledGains
) -> Iterator[SampledGains]:
    """Yield gains in the order in which they are tried: those made of K and L, with M, then K and M, of least cost.

    These are of the mean of all cells first, then for all. Where a cost is the goal of K or M, that of least cost is
    the first; a gain that is given is made of nothing else.
    """
    goals = {role: goal for role, goal in goals.items() if not isinstance(goal, Given)}
    costs = {role for role, goal in goals.items() if isinstance(goal, LeastCost)}
    ways: dict[Role, Callable[..., Array | None]] = {CONTROLLER: regulator, OBSERVER: kalman}

    def found(role: Role, *, for_all: bool) -> Array | None:
        task = Task.of(plant, role, sizes=sizes)
        return ways[role](task, goals[role], made.sample_time, for_all=for_all)

    seen, best = set[tuple[bytes, bytes]](), dict[Role, Array]()
    for for_all in (False, True):
        with np.errstate(all="ignore"):
            each = {role: found(role, for_all=for_all) for role in goals}
        best |= {role: gain for role, gain in each.items() if gain is not None}
        for taken in (costs, costs | {OBSERVER}, costs | {CONTROLLER, OBSERVER}):
            own = ((CONTROLLER, made.K), (OBSERVER, made.M))
            K, M = (best.get(role, gain) if role in taken else gain for role, gain in own)
            if (key := (K.tobytes(), M.tobytes())) not in seen:
                seen.add(key)
                yield replace(made, K=K, M=M)


def regulator(task: Task, goal: Goal, h: float, *, for_all: bool = False) -> Array | None:
    """Return K of u_k = K x_k with the least ∫(xᵀ Q x + uᵀ R u) dt, u held for h (Van Loan 1978), or None.

    It is that of the mean of all cells, or with a cost that is a bound for all of them, whatever the switching.

    Example: x' = u with short samples: the least ∫(x² + u²) dt has u = −x.

        >>> task = Task(A=np.zeros((1, 1, 1)), B=np.ones((1, 1)), cells=["all"])
        >>> regulator(task, LeastCost(Q=np.eye(1), R=np.eye(1)), 1e-4).round(3).tolist()
        [[-1.0]]
    """
    A, B, Q, R = _weighed(task, goal)
    n, m = B.shape
    whole = np.block([[A.mean(axis=0), B], [np.zeros((m, n + m))]])
    over, cost = _sampled(whole, np.block([[Q, np.zeros((n, m))], [np.zeros((m, n)), R]]), h)
    S = _least_cost(over[:n, :n], over[:n, n:], cost[:n, :n], cost[n:, n:], cost[:n, n:])
    if S is None:
        return None
    after = cost + over[:n].T @ S @ over[:n]
    if for_all:
        both = np.concatenate([task.scale.state, task.scale.input])
        K = feedback(A, B, _definite(Q, task.scale.state), R, period=h, near=_definite(after, both))
    else:
        K = np.asarray(-np.linalg.solve(after[n:, n:], after[n:, :n]))
    return None if K is None else _clean(K, task)


def kalman(task: Task, goal: Goal, h: float, *, for_all: bool = False) -> Array | None:
    """Return M of x̂⁺ = x̂ + M (C x̂ − y) for noise of density Q on x' and of variance R / h in each sample; or None.

    The task is (9) transposed. The covariance is that of the mean of all cells, or a bound for all of them.
    """
    A, B, Q, R = _weighed(task, goal)
    turned, noise = _sampled(A.mean(axis=0), Q, h)
    P = _least_cost(turned, B, noise, R / h, np.zeros_like(B))
    if P is None:
        return None
    if for_all:
        Q, P = (_definite(X, task.scale.state) for X in (Q, P))
        M = correction(A.transpose(0, 2, 1), B.T, Q, R, period=h, near=P)
    else:
        M = np.asarray(-np.linalg.solve(R / h + B.T @ P @ B, B.T @ P).T)
    return None if M is None else _clean(M.T, task).T


def _definite(X: Array, sizes: Array) -> Array:
    """Return a matrix of a cost with a little more of each entry: of what it does not see it is 0."""
    mean = float(np.mean(X.diagonal() * sizes**2))
    return X + _LITTLE * mean * np.diag(sizes**-2.0)


def _clean(K: Array, task: Task) -> Array:
    """Return a gain with as many digits as it is printed with, and 0 for what is rounding beside its largest entry."""
    size = np.abs(task.scale.gain(K))
    return short(np.where(size > _ROUNDING * size.max(initial=0.0), K, 0.0))


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
    """Return A, (v, n, n), and B of all cells with the rate that is asked for added, and the weights."""
    A = task.A + demands(goal)[0] * np.eye(task.A.shape[1])
    if isinstance(goal, LeastCost):
        return A, task.B, goal.Q, goal.R
    return A, task.B, np.diag(task.scale.state**-2.0), np.diag(task.scale.input**-2.0)
