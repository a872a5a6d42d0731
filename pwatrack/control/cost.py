"""A proved bound of the quadratic cost of a gain, whatever the switching; or of the observer error's covariance."""

import warnings

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from pwatrack.arrays import Array, readonly
from pwatrack.control.synthesis import Task
from pwatrack.errors import Problem, Undecided
from pwatrack.lmi.inequality import weighted
from pwatrack.lmi.presolve import centre, distinct
from pwatrack.lmi.program import least_trace
from pwatrack.lmi.solve import solve
from pwatrack.rational import decimals, is_positive_definite, scalar

_ROOM = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # by so much X is enlarged, until it is proved


def cost_bound(task: Task, K: Array, Q: Array, R: Array) -> Array:
    """Return X (n, n) with X M_i + M_iᵀ X + Q + KᵀRK ≺ 0 for M_i = A_i + B K, proved exactly, of small trace.

    Integrated along any solution of e' = M̂ e, u = K e, it bounds ∫(eᵀQe + uᵀRu) dt by e(0)ᵀ X e(0) (Boyd et al.,
    Linear Matrix Inequalities in System and Control Theory, 1994, section 7.4). For the observer, with A_iᵀ, Cᵀ and Lᵀ,
    X bounds the covariance of x̂ − x under white noise of densities Q on the states and R on the outputs.

    Args:
        task: A (l, n, n) and B (n, m).
        K: (m, n), as printed.
        Q, R: (n, n) and (m, m).

    Raises:
        Undecided: If no X could be proved.

    Example:
        >>> task = Task(A=np.array([[[0.0]]]), B=np.eye(1), cells=["all"])
        >>> cost_bound(task, -np.eye(1), np.eye(1), np.eye(1)).round(4).tolist()
        [[1.0]]
    """
    closed, weight = task.A + task.B @ K, Q + K.T @ R @ K
    matrices, _ = distinct(closed)
    n, speed = len(Q), float(np.linalg.norm(closed, 2, axis=(1, 2)).max())
    slack = 1e-9 * float(np.trace(weight)) / n * np.eye(n)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nearly singular: then the coordinates are those at hand
        mean = solve_continuous_lyapunov(matrices.mean(axis=0).T, -(weight + slack))
    try:
        inverse, V = centre(mean)
        V, inverse = V.T, inverse.T
    except np.linalg.LinAlgError:
        V = inverse = np.eye(n)
    inside = V.T @ (weight + slack) @ V
    size = float(np.linalg.norm(inside, 2))
    inequality = weighted(np.swapaxes(inverse @ matrices @ V, 1, 2) / speed, inside / size)
    candidate = solve(least_trace(inequality), task.solver)
    if candidate is not None:
        X = inverse.T @ candidate.P @ inverse * size / speed
        for room in _ROOM:
            trial = (X + X.T) / 2 * (1 + room)
            if np.isfinite(trial).all() and _proved(task, K, Q, R, trial):
                return readonly(trial)
    raise Undecided(
        Problem(
            message=f"{task.claim}: the gain of least cost was found, but no bound of its cost could be proved",
            subject=("design", task.of, "cost"),
            hint="weights that differ less in size may help",
        )
    )


def _proved(task: Task, K: Array, Q: Array, R: Array, X: Array) -> bool:
    exact, exact_K, exact_B = decimals(X), decimals(K), decimals(task.B)
    weight = decimals(Q) + exact_K.transpose() * decimals(R) * exact_K
    half = [exact * (decimals(A_i) + exact_B * exact_K) for A_i in task.A]
    return is_positive_definite(exact) and all(
        is_positive_definite(scalar(-1.0) * (XM + XM.transpose()) - weight) for XM in half
    )
