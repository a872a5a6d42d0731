"""Where each part of the closed loop sits in z."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.model.conditions import Conditions
from pwatrack.model.pwa import PWASystem


@dataclass(frozen=True, kw_only=True)
class Layout:
    """z = (x, x̂, ŝ, η̂, w, ρ, d, v, u, late, before, wanted, change, y, w', 1); what nobody asks for is empty."""

    x: slice
    x_hat: slice
    s_hat: slice  # estimates of loads
    eta_hat: slice
    w: slice  # exosystem
    rho: slice  # that of what is left over of (15) by an η that is played back
    d: slice  # that of the disturbances
    v: slice  # noise
    u: slice  # what a sampled controller holds, as all below: the input
    late: slice  # inputs that wait to be put out, the next one first
    before: slice  # the one computed last, where that matters
    wanted: slice  # the one that it wants before the limits
    change: slice  # by how much that was to change
    y: slice  # the measured output
    w_held: slice  # its own w, of one that corrects nothing: then η̂ is its own, too
    order: int  # N, the length of z

    @staticmethod
    def of(controller: ProvedController, conditions: Conditions) -> "Layout":
        """Return the layout for these conditions."""
        (n, m), q = controller.plant.B.shape, len(controller.plant.C)
        p, s = controller.trajectory.rate.shape[1], len(controller.trajectory.exosystem.w0)
        sizes = {"x": n, "x_hat": n, "s_hat": len(controller.design.L) - n, "eta_hat": p, "w": s}
        preview, sampling = controller.trajectory.preview, conditions.sampling
        sizes["rho"] = len(preview.left.w0) if preview and not sampling else 0  # a program counts from nothing
        sizes["d"] = len(conditions.disturbance.w0) if conditions.disturbance else 0
        sizes["v"] = q if conditions.noise else 0
        sizes |= dict.fromkeys(("u", "late", "before", "wanted", "change", "y", "w_held"), 0)
        if sampling is not None:
            sizes |= {
                "u": m,
                "late": m * sampling.delay,
                "before": m * (conditions.rates is not None),
                "wanted": m * (conditions.limits is not None),
                "change": m * (conditions.rates is not None),
                "y": q,
                "w_held": 0 if sampling.corrects else s,
            }
        edges = np.cumsum([0, *sizes.values()]).tolist()
        return Layout(**dict(zip(sizes, map(slice, edges[:-1], edges[1:]), strict=True)), order=edges[-1] + 1)

    @property
    def observer(self) -> slice:
        """All states of the observer."""
        return slice(self.x_hat.start, self.s_hat.stop)

    @property
    def w_seen(self) -> slice:
        """What x_d is drawn with for w: the controller's own, where it has one."""
        return self.w_held if self.w_held.stop > self.w_held.start else self.w

    def driven(self, u: Array, plant: PWASystem, model: PWASystem) -> Array:
        """Return what an input u = rows z, (m, N), adds to ẋ of the plant and to x̂' of its model, (N, N)."""
        F = np.zeros((self.order, self.order))
        F[self.x], F[self.x_hat] = plant.B @ u, model.B @ u
        return F
