"""What acts on a sampled loop where x_d, u_ff and η̂ depend on estimates of loads: see `control.estimated_loads`.

Beside the trajectory of the true loads s the program is walked with s in place of ŝ, as y = (s, η̂, w, 1) at ticks. A
program that is at ŷ goes on by the law of its own cell a, and not by that of the cell b of y. With Φ_a of y' = Φ_a y,
P and Q of Φ_a as there, and U_a the rows of u_ff, it then makes of its tick more than what errors of estimates do by

    [(P(Φ_a) − P(Φ_b)) Φ_b y]_η  of η̂,    (U_a Q(Φ_a) − U_b Q(Φ_b)) Φ_b y + u_ab  of u,   B u_ab = (T_a⁻¹ T_b − I) x_d',

the last of which is how u_ff jumps. a is any cell that errors of estimates can come to from b: no facet is crossed by
them that depends on neither. In the sample x − x_d is driven by (A_c − A_c') (x_d(t) − x_d,k) besides, x_d,k that of
the program at the tick, with means that differ by what D_j ε crosses.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import OVER_SUMS, Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import flows, means, on_estimates
from pwatrack.control.sampled_disturbances import ROUNDING
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.vertices import Box, differences, factors
from pwatrack.rational import pivots, rational
from pwatrack.simulation.controller_arrays import cells

_ON_FACET = 1e-12  # of its terms: a form of y that is nearer to 0 may have either sign


def crossed(errors: SampledErrors) -> tuple[Array, Array]:
    """Return U (n, g) and V (g, n) with |(A_c − A_c') x| ≤ U |V x| in each entry, of what D_j ε crosses; g = 0 of none.

    Of a box these are its edges that some D_j ε moves along; else all of R, if any does.
    """
    n = errors.plant.B.shape[0]
    if errors.estimates is None:
        return np.zeros((n, 0)), np.zeros((0, n))
    U, V, D = list[Array](), list[Array](), [D for _, D in errors.estimates.hull]
    changes = differences(errors.cells)
    match changes:
        case [Box(edges=edges)] if edges:
            for u, v in map(factors, edges):
                if _moves(BallMatrix(rational([v], (1, n))), D):
                    U.append(np.abs(np.array(u, dtype=float)))
                    V.append(np.array(v, dtype=float))
        case _ if changes and _moves(errors.R, D):
            largest = np.max([_largest(box.middle) for box in changes], axis=0)
            U, V = [*largest[:, pivots(errors.R.centre)].T], [*errors.R.floats]
    return np.array(U).reshape(-1, n).T * OVER_SUMS, np.array(V).reshape(-1, n)


def _moves(rows: BallMatrix, D: Sequence[BallMatrix]) -> bool:
    """Say whether some rows see some D_j ε."""
    return any(X.radius is not None or any(X.centre.entries()) for X in (rows @ each for each in D))


def _largest(X: BallMatrix) -> Array:
    return np.abs(X.floats) + (0.0 if X.radius is None else np.abs(BallMatrix(X.radius).floats))


class OtherCells:
    """What a program makes of its ticks if errors of estimates have brought it into another cell."""

    def __init__(self, controller: ProvedController, errors: SampledErrors) -> None:
        trajectory, added, form = controller.trajectory, controller.compensation, controller.form
        assert errors.estimates is not None
        loads, n, h = errors.estimates.loads, len(controller.plant.B), errors.gains.sample_time
        self._flows = flows(controller, trajectory)
        self._guards, self._sides = on_estimates(trajectory.guards, added.guards), trajectory.signs
        self._x_d = on_estimates(trajectory.x_d, added.X.floats)
        self._u_ff = on_estimates(trajectory.u_ff, added.u_ff)
        p = trajectory.rate.shape[1]
        self._fixed = ~self._guards[:, : loads + p * bool(errors.estimates.eta)].any(axis=1)
        self._eta = h * means(self._flows, h)[:, loads : loads + errors.estimates.eta]
        zero, eye = np.zeros(self._flows.shape[1:]), np.eye(len(self._flows[0]))
        wholes = (np.block([[F * h, eye, zero], [zero, zero, eye], [zero, zero, zero]]) for F in self._flows)
        seconds = [h * expm(whole)[: len(eye), 2 * len(eye) :] for whole in wholes]  # Q(Φ) = ∫ (h − τ) e^(Φ τ) dτ / h
        self._held = self._u_ff @ np.array(seconds)
        self._T = [np.eye(n)] * len(self._flows) if form is None else form.T
        self._back = [np.eye(n)] * len(self._flows) if form is None else form.T_inverse
        self._push = np.linalg.pinv(controller.plant.B)

    def at(self, y: Array) -> tuple[Array, Array]:
        """Return how much more of u and of η̂ there is at most, (K, m) and (K, p), with y (K, ·) at ticks."""
        sides = y @ self._guards.T
        near = np.abs(sides) <= _ON_FACET * (np.abs(y) @ np.abs(self._guards).T)
        here = cells(self._sides, sides)
        u, eta = np.zeros((len(y), self._held.shape[1])), np.zeros((len(y), self._eta.shape[1]))
        for b in np.unique(here).tolist():
            at = np.flatnonzero(here == b)
            rates = y[at] @ self._flows[b].T
            moving, sizes = rates @ self._x_d[b].T, np.abs(rates) @ np.abs(np.vstack([self._held[b], self._eta[b]])).T
            least, m = ROUNDING * sizes.max(axis=0, initial=0.0), u.shape[1]
            for a in range(len(self._flows)):
                apart = self._fixed & (self._sides[a] != 0)
                reached = ~((sides[at] * self._sides[a] < 0) & ~near[at] & apart).any(axis=1)
                if a == b or not reached.any():
                    continue
                more, moved = rates @ (self._held[a] - self._held[b]).T, rates @ (self._eta[a] - self._eta[b]).T
                if not np.array_equal(self._T[a], self._T[b]):
                    J = self._push @ (self._back[a] @ self._T[b] - np.eye(len(self._T[b])))
                    jump, terms = moving @ J.T, np.abs(moving) @ np.abs(J).T
                    more = more + np.where(np.abs(jump) <= ROUNDING * terms, 0.0, jump)
                each = np.where(reached[:, None], np.abs(np.hstack([more, moved])), 0.0)
                each[:, each.max(axis=0) <= least] = 0.0
                u[at], eta[at] = np.maximum(u[at], each[:, :m]), np.maximum(eta[at], each[:, m:])
        return u * OVER_SUMS, eta * OVER_SUMS
