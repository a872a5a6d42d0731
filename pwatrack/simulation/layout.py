"""Where each part of the closed loop sits in z; the parts by which inputs are limited, and their changes."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.model.conditions import Conditions
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.flow import SwitchedPart


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


@dataclass(frozen=True, kw_only=True)
class Actuator(SwitchedPart):
    """The part of a limited input, whose cells are its segments."""

    input: int  # which one it is, from 0
    levels: tuple[float | None, ...]  # at which limit it holds the input in each cell; None where it lets it through


@dataclass(frozen=True, kw_only=True)
class RateLimit(SwitchedPart):
    """The part of an input that may change by so much from one sample to the next."""

    input: int  # which one it is, from 0
    most: float


def actuators(
    limits: Array, u: Array, generator: SwitchedPart, plant: PWASystem, model: PWASystem, at: Layout
) -> list[Actuator]:
    """Return one part for each limited input; beyond a limit it replaces the input by the limit.

    The limits are lower and upper ones, (m, 2), infinite where there is none; u are the rows of the input before them,
    u = u[cell of x_d] z, (l, m, N). Where these depend on the cell of the generator, so do the guards, and the segments
    of the actuator are told apart within each cell. u drives the plant that runs, and its model in the observer.
    """
    parts = list[Actuator]()
    for k, (low, high) in enumerate(limits.tolist()):
        all_: list[tuple[str, float | None]] = [("low", low), ("linear", None), ("high", high)]
        segments = [one for one in all_ if one[1] is None or np.isfinite(one[1])]
        if len(segments) == 1:
            continue
        switched = bool((u[:, k] != u[0, k]).any())
        rows = u[:, k] if switched else u[:1, k]
        levels = [level for _, level in segments if level is not None]
        guards = np.repeat(rows, len(levels), axis=0)
        guards[:, -1] -= np.tile(levels, len(rows))
        sides = 2 * np.tri(len(segments), len(levels), -1, dtype=np.int64) - 1
        signs = np.kron(np.eye(len(rows), dtype=np.int64), sides)
        if switched:
            guards = np.vstack([generator.guards, guards])
            signs = np.hstack([np.repeat(generator.signs, len(segments), axis=0), signs])
        replaced = np.zeros((len(rows), len(segments), len(limits), at.order))  # what is added to u
        for j, (_, level) in enumerate(segments):
            if level is not None:
                replaced[:, j, k] = -rows
                replaced[:, j, k, -1] += level
        F = [at.driven(change, plant, model) for change in replaced.reshape(-1, len(limits), at.order)]
        cells = tuple(name for name, _ in segments) * len(rows)
        parts.append(
            Actuator(
                name=f"actuator {model.inputs[k]}",
                cells=cells,
                guards=guards,
                signs=signs,
                F=np.array(F),
                input=k,
                levels=tuple(level for _, level in segments) * len(rows),
            )
        )
    return parts


def rate_limits(steps: Array, model: PWASystem, at: Layout) -> list[RateLimit]:
    """Return one part for each input of a sampled controller that may change by so much in a sample only, (m,)."""
    change, one = np.eye(at.order)[at.change], np.eye(at.order)[-1]
    return [
        RateLimit(
            name=f"rate {model.inputs[k]}",
            cells=("falls", "free", "rises"),
            guards=np.array([change[k] + most * one, change[k] - most * one]),
            signs=np.array([[-1, -1], [1, -1], [1, 1]]),
            F=np.zeros((3, at.order, at.order)),
            input=k,
            most=most,
        )
        for k, most in enumerate(steps.tolist())
        if np.isfinite(most)
    ]
