"""What is asked of P and Y where linear forms, or inputs, are to stay small from some starts: programs, as data."""

from collections.abc import Sequence

import numpy as np

from pwatrack.arrays import Array
from pwatrack.lmi.inequality import Inequality
from pwatrack.lmi.program import Program, of_P


def farthest_starts(inequality: Inequality, rows: Array, starts: Array) -> Program:
    """Maximise t subject to F_i(P) ⪯ 0 for all cells, P ⪰ t Σ, P ⪯ 1e6 I and c P cᵀ ≤ 1 for some rows c.

    What starts in √t times an ellipsoid, {z: z zᵀ ⪯ Σ}, then has |c z| ≤ 1.

    Args:
        inequality: From `lyapunov`.
        rows: c, (s, n), of size 1 at most.
        starts: Σ (n, n), positive semidefinite, of size 1.
    """
    eye = np.eye(inequality.n)
    return Program(
        constraints=(
            inequality,
            of_P(inequality, -1.0, eye, T=starts),
            of_P(inequality, 1.0, 1e-3 * eye, constant=-eye),
            *(of_P(inequality, 1.0, row[None], constant=-np.eye(1)) for row in rows),
        ),
        price=-1.0,
    )


def gain_from_starts(inequality: Inequality, starts: Array, limits: Sequence[tuple[Array, float]]) -> Program:
    """Maximise t subject to F_i(P, Y) ⪯ 0 for all cells, P ⪰ t Σ and [ū², r Y; ·, P] ⪰ 0 for some rows r.

    What starts in √t times an ellipsoid, {z: z zᵀ ⪯ Σ}, then has |r Y P⁻¹ z| ≤ ū.

    Args:
        inequality: From `state_feedback`.
        starts: Σ (n, n), positive semidefinite.
        limits: Rows r (m,), each with its ū.
    """
    kept = (_limit_of_input(inequality, row, most) for row, most in limits)
    around = of_P(inequality, -1.0, np.eye(inequality.n), T=starts)
    return Program(constraints=(inequality, around, *kept), price=-1.0)


def least_worst_cost(inequality: Inequality, starts: Array, limits: Sequence[tuple[Array, float]]) -> Program:
    """Minimise t, the worst cost from an ellipsoid, subject to F_i(P, Y, t) ⪯ 0 for all cells and as above, P ⪰ Σ.

    Args:
        inequality: From `bounded_cost`.
        starts, limits: As for `gain_from_starts`.
    """
    kept = (_limit_of_input(inequality, row, most) for row, most in limits)
    around = of_P(inequality, -1.0, np.eye(inequality.n), constant=starts)
    return Program(constraints=(inequality, around, *kept), price=1.0)


def _limit_of_input(like: Inequality, row: Array, most: float) -> Inequality:
    """Return [ū², r Y; ·, P] ⪰ 0."""
    n, m = like.n, like.m
    low, right = np.vstack([np.zeros((1, n)), np.eye(n)]), np.hstack([np.zeros((n, 1)), np.eye(n)])
    corner = np.zeros((1, 1 + n, 1 + n))
    corner[0, 0, 0] = -(most**2)
    return Inequality(
        L=-low[None] / 2,
        R=right[None],
        M=-np.vstack([row, np.zeros((n, m))])[None],
        N=right[None],
        constant=corner,
    )
