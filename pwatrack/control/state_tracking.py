"""Assumption 1: a desired state trajectory x_d(t) and a feedforward u_ff(t) that satisfy (3)."""

import numpy as np
from scipy.optimize import linprog

from pwatrack.arrays import Array, readonly
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import OutsideTheory, Problem, Subject, listed
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Exosystem, exosystem

_REALISABLE = 1e-9  # of the size of the terms of (3)
_CHECKS = 20_000  # times at which (3) is checked


def state_trajectory(plant: PWASystem, x_d: Exosystem, *, horizon: float, subject: Subject = ()) -> DesiredTrajectory:
    """Return the trajectory for x_d in closed form, with u_ff solved from (3): B u_ff = ẋ_d − A_i x_d − b_i.

    Args:
        plant: The system (1).
        x_d: One signal per state.
        horizon: Up to when (3) is checked, in s.
        subject: What in the description a refusal is about.

    Raises:
        OutsideTheory: If no u_ff satisfies (3): worst time, state equation and size.
    """
    cells, n = plant.A.shape[:2]
    s = len(x_d.w0)
    Q, Q_rate = x_d.derivative_rows(1)
    needed = np.concatenate([Q_rate - plant.A @ Q, -plant.b[:, :, None]], axis=2)  # B u_ff, on (w, 1)
    rows = 1.0 / np.maximum(np.abs(plant.B).max(axis=1), np.finfo(np.float64).tiny)
    rows[~plant.B.any(axis=1)] = 0.0
    pseudo = np.linalg.pinv(rows[:, None] * plant.B) * rows
    trajectory = DesiredTrajectory(
        exosystem=x_d,
        names=(),
        to_eta=np.zeros((0, n)),
        eta_offset=np.zeros(0),
        rate=np.zeros((cells, 0, s + 1)),
        x_d=np.hstack([Q, np.zeros((n, 1))]),
        u_ff=pseudo @ needed,
    )
    unreached = needed - plant.B @ trajectory.u_ff
    times = np.linspace(0.0, horizon, _CHECKS + 1)
    w = np.hstack([x_d.states(times), np.ones((len(times), 1))])
    cell = np.array([plant.partition.locate(x) for x in w[:, :-1] @ Q.T])
    residual = np.einsum("tij,tj->ti", unreached[cell], w)
    scale = np.einsum("tij,tj->ti", np.abs(Q_rate)[None] + np.abs(plant.A[cell]) @ np.abs(Q), np.abs(w[:, :-1]))
    scale = np.maximum(scale.max(axis=0) + np.abs(plant.b).max(axis=0), np.finfo(np.float64).tiny)
    worst = np.unravel_index(np.argmax(np.abs(residual) / scale), residual.shape)
    if np.abs(residual[worst]) > _REALISABLE * scale[worst[1]]:
        raise OutsideTheory(
            Problem(
                message=f"x_d is not realisable: at t = {times[worst[0]]:.6g} s no input satisfies the equation of "
                f"state '{plant.states[worst[1]]}' in (3); {abs(residual[worst]):.4g} is left over",
                subject=subject,
                hint="a state that the input does not drive directly must follow from the others",
            )
        )
    return trajectory


def input_trajectory(plant: PWASystem, u_ff: Exosystem, start: Array | None) -> DesiredTrajectory:
    """Return the trajectory for a given u_ff: x_d is the plant's own solution, from x_d(0) = start."""
    cells, n = plant.A.shape[:2]
    s = len(u_ff.w0)
    eye = np.hstack([np.eye(n), np.zeros((n, s + 1))])
    rate = np.zeros((cells, n, n + s + 1))
    rate[:, :, :n], rate[:, :, n : n + s], rate[:, :, -1] = plant.A, plant.B @ u_ff.Q, plant.b
    inputs = np.zeros((plant.B.shape[1], n + s + 1))
    inputs[:, n : n + s] = u_ff.Q
    return DesiredTrajectory(
        exosystem=u_ff,
        names=plant.states,
        to_eta=np.eye(n),
        eta_offset=np.zeros(n),
        rate=rate,
        x_d=eye,
        u_ff=np.broadcast_to(inputs, (cells, *inputs.shape)),
        eta0=start,
    )


def set_point(plant: PWASystem, y: Array, *, subject: Subject = ()) -> DesiredTrajectory:
    """Return the constant trajectory with C x_d = y: A_i x_d + b_i + B u_ff = 0 with x_d in cell i.

    Raises:
        OutsideTheory: If no cell holds such an equilibrium.
    """
    misses = []
    for i, name in enumerate(plant.cell_names):
        point = _equilibrium(plant, y, i)
        if isinstance(point, str):
            misses.append(point.format(name))
        else:
            return _constant(plant, *point)
    raise OutsideTheory(
        Problem.of_many(
            lambda most: f"no equilibrium has the wanted outputs: {listed(misses, most, '; ')}",
            subject=subject,
            hint="choose a set-point that the plant can rest at",
        )
    )


def _equilibrium(plant: PWASystem, y: Array, i: int) -> tuple[Array, Array] | str:
    """Return (x_d, u_ff) with A_i x_d + b_i + B u_ff = 0 and C x_d = y deepest in cell i, or why there is none.

    A linear program in (x, u, margin), with rows and columns scaled to size 1.
    """
    n, m, q = plant.A.shape[1], plant.B.shape[1], plant.C.shape[0]
    equal = np.block([[plant.A[i], plant.B, -plant.b[i][:, None]], [plant.C, np.zeros((q, m)), y[:, None]]])
    inner = plant.partition.signs[i][:, None] * np.column_stack([plant.partition.H, plant.partition.h])
    inner = inner[inner.any(axis=1)]
    d = np.ones(n + m)
    for _ in range(8):
        equal = equal / np.maximum(np.abs(equal[:, :-1]).max(axis=1, initial=0.0), 1e-300)[:, None]
        size = np.abs(equal[:, :-1]).max(axis=0)
        factor = np.where(size > 0, 2.0 ** -np.round(np.log2(np.where(size > 0, size, 1.0))), 1.0)
        equal[:, :-1] *= factor
        d *= factor
    unit = max(float(np.abs(equal[:, -1]).max()), 1e-300)  # the solution is of the size of the right-hand side
    sides = np.column_stack([inner[:, :-1] * d[:n], np.zeros((len(inner), m))])
    length = np.maximum(np.linalg.norm(sides, axis=1), 1e-300)
    solution = linprog(
        np.append(np.zeros(n + m), -1.0),
        A_eq=np.column_stack([equal[:, :-1], np.zeros(n + q)]),
        b_eq=equal[:, -1] / unit,
        A_ub=np.column_stack([-sides / length[:, None], np.ones(len(sides))]) if len(sides) else None,
        b_ub=inner[:, -1] / length / unit if len(sides) else None,
        bounds=[(None, None)] * (n + m) + [(None, 1.0)],
        method="highs",
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    if solution.x is None or solution.status != 0:
        return "none at all in cell '{}'"
    if solution.x[-1] < -1e-9:
        return f"that of cell '{{}}' lies outside it, by {-solution.x[-1] * unit:.4g} in scaled units"
    point = np.asarray(solution.x[:-1]) * unit
    gap = equal[:, -1] - equal[:, :-1] @ point
    point = (point + np.linalg.lstsq(equal[:, :-1], gap, rcond=None)[0]) * d  # one step of refinement
    return point[:n], point[n:]


def _constant(plant: PWASystem, x_d: Array, u_ff: Array) -> DesiredTrajectory:
    cells, n = plant.A.shape[:2]
    return DesiredTrajectory(
        exosystem=exosystem([]),
        names=(),
        to_eta=np.zeros((0, n)),
        eta_offset=np.zeros(0),
        rate=np.zeros((cells, 0, 1)),
        x_d=readonly(x_d[:, None]),
        u_ff=np.broadcast_to(u_ff[:, None], (cells, len(u_ff), 1)),
    )
