"""Plant, observer, desired trajectory and exosystem as one flow."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.control.controller import Controller
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import StateReset
from pwatrack.simulation.trace import Trace

PARTS = ("plant", "observer", "generator")


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """The closed loop of Theorem 2 or 3 with state z = (x, x̂, η̂, w, 1).

    Attributes:
        controller: The design.
        flow: ż = F(mode) z, mode = (cell of x, cell of x̂, cell of x_d).
        resets: When the exosystem starts a new piece.
        x, x_hat, eta_hat, w: Where each sits in z.
        x_d: Rows with x_d = x_d z, (n, N).
        u_ff, u: Rows with u_ff = u_ff[cell of x_d] z, (l, m, N); likewise u.
    """

    controller: Controller
    flow: Flow
    resets: tuple[StateReset, ...]
    x: slice
    x_hat: slice
    eta_hat: slice
    w: slice
    x_d: Array
    u_ff: Array
    u: Array

    def start(self, *, plant: Array, observer: Array, generator: Array) -> Array:
        """Return z(0) for x(0), x̂(0) and η̂(0)."""
        return np.concatenate([plant, observer, generator, self.controller.trajectory.exosystem.w0, [1.0]])

    def response(self, trace: Trace) -> "Response":
        """Read the signals of the loop off a trace of its flow."""
        z, cell = trace.z, trace.modes[:, PARTS.index("generator")]
        plant, trajectory = self.controller.plant, self.controller.trajectory
        x, x_d = z[:, self.x], z @ self.x_d.T
        y, y_d = x @ plant.C.T, x_d @ plant.C.T
        return Response(
            trace=trace,
            x=x,
            x_hat=z[:, self.x_hat],
            x_d=x_d,
            eta=x @ trajectory.to_eta.T + trajectory.eta_offset,
            eta_hat=z[:, self.eta_hat],
            y=y,
            y_d=y_d,
            u=_switched(self.u, cell, z),
            u_ff=_switched(self.u_ff, cell, z),
            tracking_error=x - x_d if self.controller.generator is None else y - y_d,
        )

    @property
    def tracking_error(self) -> Array:
        """Rows with e = rows z for what goes to 0: y − y_d for output tracking, x − x_d for state tracking, (q, N)."""
        rows = np.eye(self.x_d.shape[1])[self.x] - self.x_d
        return rows if self.controller.generator is None else np.asarray(self.controller.plant.C @ rows)

    def generator_flow(self) -> Flow:
        """Return the flow of (η̂, w, 1) alone: no other part acts on it."""
        return self.flow.subsystem("generator", np.arange(self.eta_hat.start, self.x_d.shape[1]))


@dataclass(frozen=True, kw_only=True)
class Response:
    """The signals of a closed loop at K sample times.

    Attributes:
        trace: The trace they are read from.
        x, x_hat, x_d: States of plant and observer, and desired states, (K, n).
        eta, eta_hat: What the generator's state is for, and that state, (K, p).
        y, y_d: Outputs and their desired values, (K, q).
        u, u_ff: Inputs and their feedforward parts, (K, m).
        tracking_error: What goes to 0: y − y_d for output tracking, x − x_d for state tracking.
    """

    trace: Trace
    x: Array
    x_hat: Array
    x_d: Array
    eta: Array
    eta_hat: Array
    y: Array
    y_d: Array
    u: Array
    u_ff: Array
    tracking_error: Array

    @property
    def t(self) -> Array:
        """Sample times in s, (K,)."""
        return self.trace.t

    @property
    def observer_error(self) -> Array:
        """‖x − x̂‖, (K,)."""
        return np.asarray(np.linalg.norm(self.x - self.x_hat, axis=1))


def closed_loop(controller: Controller) -> ClosedLoop:
    """Connect (1), the observer (18), the controller (19) and the desired trajectory."""
    plant, design, trajectory = controller.plant, controller.design, controller.trajectory
    reference = trajectory.exosystem
    n, p, s = plant.A.shape[1], trajectory.rate.shape[1], len(reference.w0)
    N = 2 * n + p + s + 1
    x, x_hat, eta_hat, w = slice(0, n), slice(n, 2 * n), slice(2 * n, 2 * n + p), slice(2 * n + p, N - 1)

    widened = np.eye(N)[2 * n :]  # (η̂, w, 1) in z
    x_d = trajectory.x_d @ widened
    u_ff = trajectory.u_ff @ widened
    u_fb = -design.K @ x_d
    u_fb[:, x_hat] += design.K

    F0 = np.zeros((N, N))
    F0[x] = F0[x_hat] = plant.B @ u_fb
    F0[x_hat, x] -= design.L @ plant.C
    F0[x_hat, x_hat] += design.L @ plant.C
    F0[w, w] = reference.S

    F_plant, F_observer, F_generator = np.zeros((3, len(plant.cell_names), N, N))
    F_plant[:, x, x], F_plant[:, x, -1] = plant.A, plant.b
    F_observer[:, x_hat, x_hat], F_observer[:, x_hat, -1] = plant.A, plant.b
    F_generator[:, x] = F_generator[:, x_hat] = plant.B @ u_ff
    F_generator[:, eta_hat] = trajectory.rate @ widened

    eye = np.eye(N)
    parts = []
    for name, rows, F in zip(PARTS, (eye[x], eye[x_hat], x_d), (F_plant, F_observer, F_generator), strict=True):
        guards = plant.partition.H @ rows
        guards[:, -1] += plant.partition.h
        parts.append(SwitchedPart(name=name, cells=plant.cell_names, guards=guards, signs=plant.partition.signs, F=F))
    return ClosedLoop(
        controller=controller,
        flow=Flow(F0=F0, parts=tuple(parts)),
        resets=tuple(
            StateReset(t=r.t, where=slice(w.start + r.where.start, w.start + r.where.stop), value=r.w)
            for r in reference.resets
        ),
        x=x,
        x_hat=x_hat,
        eta_hat=eta_hat,
        w=w,
        x_d=x_d,
        u_ff=u_ff,
        u=u_ff + u_fb,
    )


def _switched(rows: Array, cell: IntArray, z: Array) -> Array:
    """Return rows[cell] z at every sample, (K, m), one cell at a time."""
    values = np.empty((len(z), rows.shape[1]))
    for i in range(len(rows)):
        here = cell == i
        values[here] = z[here] @ rows[i].T
    return values
