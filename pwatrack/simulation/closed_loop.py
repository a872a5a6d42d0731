"""Plant, observer, trajectory generator and exosystem as one flow."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.controller import Controller
from pwatrack.model.reference import Reference
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.trace import Trace

PARTS = ("plant", "observer", "generator")


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """The closed loop of Theorem 3 with state z = (x, x̂, η̂, w, 1).

    Attributes:
        controller: The design.
        reference: y_d as an exosystem with state w.
        flow: ż = F(mode) z, mode = (cell of x, cell of x̂, cell of x̂_d).
        x, x_hat, eta_hat, w: Where each sits in z.
        x_d: Rows with x̂_d = x_d z, (n, N).
        y_d: Row with y_d = y_d z, (N,).
        u_ff: Rows with û_ff = u_ff[cell of x̂_d] z, (l, N).
        u: Rows with u = u[cell of x̂_d] z, (l, N).
    """

    controller: Controller
    reference: Reference
    flow: Flow
    x: slice
    x_hat: slice
    eta_hat: slice
    w: slice
    x_d: Array
    y_d: Array
    u_ff: Array
    u: Array

    def start(self, *, plant: Array, observer: Array, generator: Array) -> Array:
        """Return z(0) for x(0), x̂(0) and η̂(0)."""
        return np.concatenate([plant, observer, generator, self.reference.w0, [1.0]])

    def response(self, trace: Trace) -> "Response":
        """Read the signals of the loop off a trace of its flow."""
        z, cell = trace.z, trace.modes[:, PARTS.index("generator")]
        form = self.controller.generator.form
        to_eta = form.T[form.r :]
        return Response(
            trace=trace,
            x=z[:, self.x],
            x_hat=z[:, self.x_hat],
            x_d=z @ self.x_d.T,
            eta=z[:, self.x] @ to_eta.T,
            eta_hat=z[:, self.eta_hat],
            y=z[:, self.x] @ self.controller.plant.C[0],
            y_d=z @ self.y_d,
            u=np.einsum("kn,kn->k", z, self.u[cell]),
            u_ff=np.einsum("kn,kn->k", z, self.u_ff[cell]),
        )

    def generator_flow(self) -> Flow:
        """Return the flow of (η̂, w, 1) alone: no other part acts on it."""
        return self.flow.subsystem("generator", np.r_[self.eta_hat, self.w, len(self.y_d) - 1])


@dataclass(frozen=True, kw_only=True)
class Response:
    """The signals of a closed loop at K sample times.

    Attributes:
        trace: The trace they are read from.
        x, x_hat, x_d: States of plant and observer, and desired states, (K, n).
        eta, eta_hat: The part η of the plant's state and the generator's, (K, n − r).
        y, y_d: Output and reference, (K,).
        u, u_ff: Input and its feedforward part, (K,).
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

    @property
    def t(self) -> Array:
        """Sample times in s, (K,)."""
        return self.trace.t

    @property
    def tracking_error(self) -> Array:
        """y − y_d, (K,)."""
        return self.y - self.y_d

    @property
    def observer_error(self) -> Array:
        """‖x − x̂‖, (K,)."""
        return np.asarray(np.linalg.norm(self.x - self.x_hat, axis=1))


def closed_loop(controller: Controller, reference: Reference) -> ClosedLoop:
    """Connect (1), (15), (16), (18) and (19) to the exosystem of the reference."""
    plant, design, generator = controller.plant, controller.design, controller.generator
    n, p, r, s = plant.A.shape[1], generator.A_eta.shape[1], generator.r, len(reference.w0)
    N = 2 * n + p + s + 1
    x, x_hat, eta_hat, w = slice(0, n), slice(n, 2 * n), slice(2 * n, 2 * n + p), slice(2 * n + p, N - 1)

    xi_d = np.zeros((r + 1, N))  # ξ_d and y_d⁽ʳ⁾
    xi_d[:, w] = reference.derivative_rows(r)
    X_xi, X_eta, x_0 = generator.state()
    x_d = X_xi @ xi_d[:r]
    x_d[:, eta_hat] += X_eta
    x_d[:, -1] += x_0
    F_xi, F_eta, f = generator.feedforward()
    u_ff = F_xi @ xi_d
    u_ff[:, eta_hat] += F_eta
    u_ff[:, -1] += f
    u_fb = -design.K @ x_d
    u_fb[:, x_hat] += design.K

    F0 = np.zeros((N, N))
    F0[x] = F0[x_hat] = plant.B @ u_fb
    F0[x_hat, x] -= design.L @ plant.C
    F0[x_hat, x_hat] += design.L @ plant.C
    F0[w, w] = reference.S

    cells = len(plant.cell_names)
    F_plant, F_observer, F_generator = (np.zeros((cells, N, N)) for _ in range(3))
    F_plant[:, x, x], F_plant[:, x, -1] = plant.A, plant.b
    F_observer[:, x_hat, x_hat], F_observer[:, x_hat, -1] = plant.A, plant.b
    F_generator[:, x] = F_generator[:, x_hat] = plant.B @ u_ff[:, None, :]
    F_generator[:, eta_hat] = generator.B_eta @ xi_d
    F_generator[:, eta_hat, eta_hat] += generator.A_eta
    F_generator[:, eta_hat, -1] += generator.b_eta

    eye = np.eye(N)
    parts = []
    for name, rows, F in zip(PARTS, (eye[x], eye[x_hat], x_d), (F_plant, F_observer, F_generator), strict=True):
        guards = plant.partition.H @ rows
        guards[:, -1] += plant.partition.h
        parts.append(SwitchedPart(name=name, cells=plant.cell_names, guards=guards, signs=plant.partition.signs, F=F))
    return ClosedLoop(
        controller=controller,
        reference=reference,
        flow=Flow(F0=F0, parts=tuple(parts)),
        x=x,
        x_hat=x_hat,
        eta_hat=eta_hat,
        w=w,
        x_d=x_d,
        y_d=xi_d[0],
        u_ff=u_ff,
        u=u_ff + u_fb,
    )
