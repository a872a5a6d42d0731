"""What no input can make up for in (3), Assumption 1: exactly, as a linear condition on the exosystem."""

from dataclasses import dataclass
from math import factorial

import numpy as np
from scipy.linalg import block_diag

from pwatrack.arrays import Array
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import spectral_terms

ROUNDING = 1e-11  # of the largest terms of an equation of (3) over the run: what is left over is more
_LARGEST_EXPONENT = 600.0  # e^{λT} is not followed further


@dataclass(frozen=True, kw_only=True)
class LeftOver:
    """The part of ẋ_d − A_i x_d − b_i that no input makes up for: r_i(t) = rows_i (w(t), 1), in cell i.

    As e^{St} = Σ_λ e^{λt} Σ_m t^m/m! E_λm, r_i is 0 on a stretch of time, however short, exactly where every
    rows_i E_λm (w, 1) is 0: the same as N Sᵏ w = 0 for k < dim S, but without powers of S.

    Attributes:
        rows: (l, n, p + 1).
        terms: Bounds of the terms that each row is the difference of, (l, n, p + 1).
        trajectory: Of x_d in closed form.
    """

    rows: Array
    terms: Array
    trajectory: DesiredTrajectory

    def sizes(self, starts: Array, lengths: Array) -> tuple[Array, Array]:
        """Return bounds of |r_i| on pieces of x_d and of their terms, both (l, pieces, n), from all coefficients.

        Args:
            starts: Of the pieces, in s, (pieces,).
            lengths: In s, (pieces,).
        """
        system = self.trajectory.exosystem
        w = np.column_stack([system.states(starts), np.ones(len(starts))])
        S, rates = block_diag(system.S, np.zeros((1, 1))), np.append(system.rates, 0.0)
        left = np.zeros((len(self.rows), len(starts), self.rows.shape[1]))
        size = np.zeros_like(left)
        with np.errstate(over="ignore"):
            for rate, chain in spectral_terms(S, rates):
                grown = np.exp(np.minimum(max(rate.real, 0.0) * lengths, _LARGEST_EXPONENT))
                for m, E in enumerate(chain):
                    weight = np.minimum(grown * lengths**m / factorial(m), 1e300)[:, None]
                    coefficients = weight * (w @ E.T)
                    left += np.abs(np.einsum("ijp,kp->ikj", self.rows, coefficients))
                    size += np.einsum("ijp,kp->ikj", self.terms, np.abs(coefficients))
        return left, size

    def at(self, cell: int, times: Array) -> Array:
        """Return r_i at some times in s, (T, n)."""
        w = np.column_stack([self.trajectory.exosystem.states(times), np.ones(len(times))])
        return np.asarray(w @ self.rows[cell].T)


def left_over(plant: PWASystem, trajectory: DesiredTrajectory) -> LeftOver:
    """Return what u_ff of a trajectory in closed form leaves over of (3).

    Args:
        plant: The system (1).
        trajectory: From `state_trajectory`.
    """
    Q, Q_rate = trajectory.exosystem.derivative_rows(1)
    needed = needed_inputs(plant, Q, Q_rate)
    terms = np.concatenate(
        [np.abs(Q_rate) + np.abs(plant.A) @ np.abs(Q), np.abs(plant.b)[:, :, None]],
        axis=2,
    )
    mixed = np.abs(plant.B) @ np.abs(pseudo_inverse(plant.B))  # u_ff carries the rounding of the other equations
    return LeftOver(rows=needed - plant.B @ trajectory.u_ff, terms=terms + mixed @ terms, trajectory=trajectory)


def needed_inputs(plant: PWASystem, Q: Array, Q_rate: Array) -> Array:
    """Return B u_ff = ẋ_d − A_i x_d − b_i of (3) as rows on (w, 1), (l, n, p + 1), for x_d = Q w and ẋ_d = Q_rate w."""
    return np.concatenate([Q_rate - plant.A @ Q, -plant.b[:, :, None]], axis=2)


def pseudo_inverse(B: Array) -> Array:
    """Return B⁺ (m, n) in units where rows and columns of B have size 1; 0 where an input does nothing.

    Example:
        >>> pseudo_inverse(np.array([[0.0, 0.0], [2e-9, 0.0]])).round(6).tolist()
        [[0.0, 500000000.0], [0.0, 0.0]]
    """
    rows, columns = np.ones(len(B)), np.ones(B.shape[1])
    for _ in range(3):
        rows = rows * _inverse(np.abs(rows[:, None] * B * columns).max(axis=1, initial=0.0))
        columns = columns * _inverse(np.abs(rows[:, None] * B * columns).max(axis=0, initial=0.0))
    return np.asarray(columns[:, None] * np.linalg.pinv(rows[:, None] * B * columns) * rows)


def _inverse(size: Array) -> Array:
    """Return powers of two that bring these sizes to about 1; 1 for 0."""
    return np.asarray(np.ldexp(1.0, np.where(size > 0, -np.frexp(size)[1], 0)))
