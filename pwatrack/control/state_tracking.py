"""Assumption 1: a desired state trajectory x_d(t) and a feedforward u_ff(t) that satisfy (3)."""

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.realisable import needed_inputs, pseudo_inverse
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Exosystem


def state_trajectory(plant: PWASystem, x_d: Exosystem) -> DesiredTrajectory:
    """Return the trajectory for x_d in closed form, with u_ff solved from (3): B u_ff = ẋ_d − A_i x_d − b_i.

    Where no u_ff solves it, something is left over: see `control.realisable` and `simulation.desired`.

    Args:
        plant: The system (1).
        x_d: One signal per state.
    """
    cells, n = plant.A.shape[:2]
    Q, Q_rate = x_d.derivative_rows(1)
    return DesiredTrajectory.linear(
        plant,
        exosystem=x_d,
        names=(),
        to_eta=np.zeros((0, n)),
        eta_offset=np.zeros(0),
        rate=np.zeros((cells, 0, len(x_d.w0) + 1)),
        x_d=np.hstack([Q, np.zeros((n, 1))]),
        u_ff=pseudo_inverse(plant.B) @ needed_inputs(plant, Q, Q_rate),
    )


def input_trajectory(plant: PWASystem, u_ff: Exosystem, start: Array | None) -> DesiredTrajectory:
    """Return the trajectory for a given u_ff: x_d is the plant's own solution, from x_d(0) = start."""
    cells, n = plant.A.shape[:2]
    s = len(u_ff.w0)
    eye = np.hstack([np.eye(n), np.zeros((n, s + 1))])
    rate = np.zeros((cells, n, n + s + 1))
    rate[:, :, :n], rate[:, :, n : n + s], rate[:, :, -1] = plant.A, plant.B @ u_ff.Q, plant.b
    inputs = np.zeros((plant.B.shape[1], n + s + 1))
    inputs[:, n : n + s] = u_ff.Q
    return DesiredTrajectory.linear(
        plant,
        exosystem=u_ff,
        names=plant.states,
        to_eta=np.eye(n),
        eta_offset=np.zeros(n),
        rate=rate,
        x_d=eye,
        u_ff=np.broadcast_to(inputs, (cells, *inputs.shape)),
        eta0=start,
    )
