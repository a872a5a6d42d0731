"""A program beside its plant, which is integrated by itself: what a machine would see of it."""

from collections.abc import Callable

import numpy as np

from pwatrack.arrays import Array
from pwatrack.model.pwa import PWASystem


def beside(
    plant: PWASystem,
    step: Callable[[int, Array], Array],
    x: Array,
    *,
    ticks: int,
    h: float,
    disturbance: Callable[[float], Array] | None = None,
    substeps: int = 20,
) -> Array:
    """Return x at so many ticks, h apart: u = step(k, x) acts from each on; x' is disturbed from tick on."""
    found = list[Array]()
    for k in range(ticks):
        found.append(x)
        held = plant.B @ step(k, x) + (0.0 if disturbance is None else disturbance(k * h))
        x = moved(plant, x, held, h / substeps, substeps)
    return np.array(found)


def moved(plant: PWASystem, x: Array, held: Array, dt: float, steps: int) -> Array:
    """Return x after some steps by Runge and Kutta, in the cell in which each stage is."""

    def rate(x: Array) -> Array:
        i = plant.partition.locate(x)
        return np.asarray(plant.A[i] @ x + plant.b[i] + held)

    for _ in range(steps):
        k1 = rate(x)
        k2 = rate(x + dt / 2 * k1)
        k3 = rate(x + dt / 2 * k2)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + dt * k3))
    return x
