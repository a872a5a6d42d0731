"""Plant, observer, desired trajectory and exosystem as one flow."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController, program
from pwatrack.control.realisable import ROUNDING
from pwatrack.model.conditions import NOMINAL, Conditions, Noise
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Exosystem, StateResets
from pwatrack.simulation.flow import Clock, Flow, Mode, SwitchedPart
from pwatrack.simulation.layout import Actuator, Layout, actuators, rate_limits
from pwatrack.simulation.propagate import sample_count
from pwatrack.simulation.trace import Trace

_GENERATOR = 2  # the part of the flow that has the cells of x_d


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """The closed loop of Theorem 2 or 3.

    Where loads are estimated, ŝ drives x_d, u_ff and η̂ beside the reference: see `control.compensation`. The modes of
    the flow are (cell of x, cell of x̂, cell of x_d, segment of each limited actuator); in its ζ x is counted from x_d
    of the first cell and x̂ from x, but for a sampled controller.
    """

    controller: ProvedController
    conditions: Conditions
    at: Layout
    flow: Flow
    x_d: Array  # rows with x_d = x_d[cell of x_d] z, (l, n, N)
    u_ff: Array  # likewise, (l, m, N)
    u: Array  # before its limits

    @property
    def plant(self) -> PWASystem:
        """The plant that runs."""
        return self.conditions.plant or self.controller.running

    def start(self, *, plant: Array, observer: Array, generator: Array) -> Array:
        """Return z(0) for x(0), x̂(0) and η̂(0)."""
        z, at = np.zeros(self.at.order), self.at
        z[at.x], z[at.x_hat], z[at.eta_hat], z[-1] = plant, observer, generator, 1.0
        trajectory = self.controller.trajectory
        z[at.w] = z[at.w_seen] = trajectory.exosystem.w0
        if trajectory.preview is not None:
            z[at.rho] = trajectory.preview.left.w0[: at.rho.stop - at.rho.start]
        if self.conditions.disturbance is not None:
            z[at.d] = self.conditions.disturbance.w0
        return z

    def resets(self, duration: float) -> list[StateResets]:
        """Return all that takes new values up to a time (s): exosystems at their pieces, and the noise."""
        at, conditions = self.at, self.conditions
        trajectory, systems = self.controller.trajectory, list[tuple[Exosystem, slice]]()
        systems.append((trajectory.exosystem, at.w))
        if trajectory.preview is not None and at.rho.stop > at.rho.start:
            systems.append((trajectory.preview.left, at.rho))
        if conditions.disturbance is not None:
            systems.append((conditions.disturbance, at.d))
        found = [each.behind(where.start) for system, where in systems for each in system.resets]
        if conditions.noise is not None:
            found.append(StateResets(**drawn(conditions.noise, duration), where=at.v))
        return found

    def response(self, trace: Trace) -> "Response":
        """Read the signals of the loop off a trace of its flow."""
        z, at, cell, conditions = trace.z, self.at, trace.modes[:, _GENERATOR], self.conditions
        trajectory, limits = self.controller.trajectory, conditions.limits
        running, designed, loads = self.plant, self.controller.plant, self.controller.plant.loads
        x, x_d, u = z[:, at.x], _switched(self.x_d, cell, z), _switched(self.u, cell, z)
        y, tracked, tracked_d = x @ running.C.T, x @ running.tracked.T, x_d @ designed.tracked.T
        return Response(
            trace=trace,
            x=x,
            x_hat=z[:, at.x_hat],
            x_d=x_d,
            eta=x @ trajectory.to_eta.T + trajectory.eta_offset,
            eta_hat=z[:, at.eta_hat],
            y=y,
            y_d=x_d @ designed.C.T,
            measured=z[:, at.y] if conditions.sampling else y + z[:, at.v] if conditions.noise else y,
            tracked=tracked,
            tracked_d=tracked_d,
            u=u if limits is None or conditions.sampling else np.clip(u, limits[:, 0], limits[:, 1]),
            u_ff=_switched(self.u_ff, cell, z),
            estimates=z[:, at.s_hat][:, loads.where] if loads else np.zeros((len(z), 0)),
            loads=z @ self.load_rows.T,
            tracking_error=x - x_d if self.controller.tracking == "state" else tracked - tracked_d,
            state_sizes=self.controller.sizes.state,
            error_sizes=self.controller.error_sizes,
        )

    @property
    def load_rows(self) -> Array:
        """Rows that read the loads off z: what of the disturbances they can make up, (loads, N)."""
        loads, disturbance = self.controller.plant.loads, self.conditions.disturbance
        rows = np.zeros((0 if loads is None else len(loads.each), self.at.order))
        if loads is not None and disturbance is not None:
            rows[:, self.at.d] = loads.truth(disturbance.Q, disturbance.rates)
        return rows

    def beyond_the_proofs(self, units: Mapping[str, str] | None = None) -> list[str]:
        """Say what the loop has that the proofs are not about, each in a few words; estimated loads are in them."""
        return self.conditions.beside(self.controller.plant.loads).texts(self.controller.plant, units)

    @property
    def tracking_error(self) -> Array:
        """Rows with e = rows z for what goes to 0: y − y_d for output tracking, x − x_d for state tracking, (q, N).

        They are the same in all cells: of x_d, only last derivatives of y are not.
        """
        states = len(self.plant.states)
        return self.signal_errors[-states:] if self.controller.tracking == "state" else self.signal_errors

    @property
    def signal_errors(self) -> Array:
        """Rows of y − y_d, and of x − x_d below them where states are tracked, (p or p + n, N)."""
        x, x_d = np.eye(self.at.order)[self.at.x], self.x_d[0]
        y = np.asarray(self.plant.tracked @ x - self.controller.plant.tracked @ x_d)
        return np.vstack([y, x - x_d]) if self.controller.tracking == "state" else y

    def inputs(self, mode: Mode) -> Array:
        """Return rows with u = rows z in a mode, within its limits, (m, N); what a program puts out it has limited."""
        rows: Array = self.u[mode[_GENERATOR]].copy()
        for part, segment in () if self.conditions.sampling else zip(self.flow.parts, mode, strict=True):
            if isinstance(part, Actuator) and part.levels[segment] is not None:
                rows[part.input] = 0.0
                rows[part.input, -1] = part.levels[segment]
        return rows


def drawn(noise: Noise, duration: float) -> dict[str, Array]:
    """Return the noise of a run up to a time (s): from when on it has which `values`, (K,) and (K, q)."""
    t = noise.sample_time * np.arange(sample_count(duration, noise.sample_time), dtype=np.float64)
    return {"t": t, "values": np.random.default_rng(noise.seed).normal(size=(len(t), len(noise.std))) * noise.std}


@dataclass(frozen=True, kw_only=True)
class Response:
    """The signals of a closed loop at K sample times."""

    trace: Trace  # the trace they are read from
    x: Array  # state of the plant, (K, n)
    x_hat: Array  # of the observer
    x_d: Array  # desired
    eta: Array  # what the generator's state is for, (K, p)
    eta_hat: Array  # that state
    y: Array  # measured outputs without their noise, (K, q)
    y_d: Array  # what they are at x_d
    measured: Array  # they as the controller has them: with noise, and of a program in steps and held, (K, q)
    tracked: Array  # what follows a reference, (K, p)
    tracked_d: Array  # its desired value
    u: Array  # inputs, (K, m)
    u_ff: Array  # their feedforward parts
    estimates: Array  # of each load that is estimated, (K, loads)
    loads: Array  # what it is
    tracking_error: Array  # what goes to 0: y − y_d for output tracking, x − x_d for state tracking
    state_sizes: Array  # what states are counted in together, (n,)
    error_sizes: Array  # what entries of the tracking error are

    @property
    def t(self) -> Array:
        """Sample times in s, (K,)."""
        return self.trace.t

    @property
    def observer_error(self) -> Array:
        """‖x − x̂‖, in sizes where there are several states, (K,)."""
        sizes = self.state_sizes if len(self.state_sizes) > 1 else 1.0
        return np.asarray(np.linalg.norm((self.x - self.x_hat) / sizes, axis=1))

    @property
    def error_norm(self) -> Array:
        """The norm of the tracking error, in sizes where it has several entries, (K,)."""
        return np.asarray(np.linalg.norm(self.tracking_error / self.error_sizes, axis=1))


def closed_loop(
    controller: ProvedController, conditions: Conditions = NOMINAL, runs: SampledController | None = None
) -> ClosedLoop:
    """Connect (1), the observer (18), the controller (19) and the desired trajectory.

    Where the controller is sampled, `runs` is the program of it, if it was kept; else it is made.
    """
    plant, model, trajectory = conditions.plant or controller.running, controller.plant, controller.trajectory
    K, L, sampling = controller.design.K, controller.design.L, conditions.sampling
    at = Layout.of(controller, conditions)
    z = np.eye(at.order)  # z[part] are the rows that read it from ζ
    reference = np.vstack([z[at.eta_hat], z[at.w_seen], z[-1:]])
    added, s_hat = controller.compensation, z[at.s_hat]
    shift = added.X.floats @ s_hat
    x_d, u_ff = trajectory.x_d @ reference + shift, trajectory.u_ff @ reference + added.u_ff @ s_hat
    base = np.zeros_like(x_d[0]) if sampling else x_d[0]  # a program holds what it computes: nothing to count from
    x, x_hat = z[at.x] + base, z[at.x_hat] + (0.0 if sampling else z[at.x] + base)
    y = plant.C @ x + (z[at.v] if conditions.noise else 0.0)
    steady, switched = K @ (x_hat - base), u_ff + K @ (base - x_d)  # the input, a sum
    off = model.C @ (x_hat - x) - (y - model.C @ x)  # ŷ − y: of an observer that has the plant's C, C (x̂ − x) alone
    if sampling:  # both are held
        steady, switched, off = z[at.u], np.zeros_like(u_ff), model.C @ x_hat - z[at.y]
    F0 = at.driven(steady, plant, model) + _loads(model, at)
    for where in (at.w, at.w_held) if at.w_held.stop > at.w_held.start else (at.w,):
        F0[where, where] = trajectory.exosystem.S
    if conditions.disturbance is not None:
        F0[at.d, at.d] = conditions.disturbance.S
        F0[at.x, at.d] += conditions.disturbance.Q
    F0[at.observer] += L @ off
    F = np.array([at.driven(rows, plant, model) for rows in switched])
    F[:, at.eta_hat] += trajectory.rate @ reference + added.rate @ s_hat
    guards = trajectory.guards @ reference + added.guards @ s_hat
    parts = [
        SwitchedPart.of("plant", plant, x, z[at.x].T @ _field(plant, x)),
        SwitchedPart.of("observer", model.model, x_hat, z[at.x_hat].T @ _field(model.model, x_hat)),
        SwitchedPart(name="generator", cells=model.cell_names, guards=guards, signs=trajectory.signs, F=F),
    ]
    parts += _limits(conditions, switched + steady, parts[-1], model, at)
    flow = Flow(F0=F0, parts=tuple(parts))
    if sampling:
        flow = _sampled(flow, runs or program(controller, conditions), conditions, at, measured=y)
    else:
        flow = _counted(flow, controller, at, reference, x_d=x_d, u_ff=u_ff, off=off)
    return ClosedLoop(
        controller=controller,
        conditions=conditions,
        at=at,
        flow=flow,
        x_d=trajectory.x_d @ np.vstack([z[at.eta_hat], z[at.w], z[-1:]]) + shift,
        u_ff=u_ff,
        u=switched + steady if sampling else u_ff + K @ (z[at.x_hat] - x_d),
    )


def _limits(
    conditions: Conditions, u: Array, generator: SwitchedPart, model: PWASystem, at: Layout
) -> list[SwitchedPart]:
    """Return a part for each input that is limited, and for each whose changes are; u are those of no sampling."""
    parts, sampling = list[SwitchedPart](), conditions.sampling
    if conditions.limits is not None:
        u = np.broadcast_to(np.eye(at.order)[at.wanted], u.shape) if sampling else u
        parts += actuators(conditions.limits, u, generator, conditions.plant or model, model, at)
    if conditions.rates is not None and sampling:
        parts += rate_limits(conditions.rates * sampling.sample_time, model, at)
    return parts


def _loads(model: PWASystem, at: Layout) -> Array:
    """Return what estimates of loads do in the observer: E ŝ in x̂' and S ŝ, (N, N)."""
    F = np.zeros((at.order, at.order))
    if model.loads is not None:
        F[at.x_hat, at.s_hat], F[at.s_hat, at.s_hat] = model.loads.E.floats, model.loads.S.floats
    return F


def _field(plant: PWASystem, x: Array) -> Array:
    """Return A_i x + b_i for each cell, with x = rows ζ, (n, N): (l, n, N)."""
    rates = plant.A @ x
    rates[:, :, -1] += plant.b
    return np.asarray(rates)


def _counted(
    flow: Flow, controller: ProvedController, at: Layout, reference: Array, *, x_d: Array, u_ff: Array, off: Array
) -> Flow:
    """Return the rates of x less those of x_d in the first cell, and those of x̂ less those of x.

    The derivative of x_d is f(x_d) + B u_ff + E ŝ + X L_s (ŷ − y), see `control.compensation`, less what is left over
    of (3); that is 0 where rounding explains it, so that of x only its error is left. In other cells rows of x_d may
    differ. Of an η that is played back what is left over of (15) is a signal by itself: as a difference of large rows
    it would be lost in rounding. `reference` are the rows of what x_d reads but for ŝ, (S, N), `off` those of ŷ − y.
    """
    plant, trajectory, X = controller.plant, controller.trajectory, controller.compensation.X.floats
    F0, parts, rows = flow.F0.copy(), {part.name: part.F.copy() for part in flow.parts}, trajectory.x_d
    turns = reference @ (F0 + parts["generator"]) if trajectory.turns is None else trajectory.turns @ reference
    loads = _loads(plant, at)
    field, kept = _field(plant, x_d), loads[at.x_hat] - X @ loads[at.s_hat]
    left = field + plant.B @ u_ff - rows @ turns + kept
    size = np.abs(plant.A) @ np.abs(x_d) + np.abs(plant.B) @ np.abs(u_ff) + np.abs(rows) @ np.abs(turns) + np.abs(kept)
    size[:, :, -1] += np.abs(plant.b)
    left = np.where(np.abs(left) > ROUNDING * size, left, 0.0)
    for F in (F0, *parts.values()):
        F[..., at.x_hat, :] -= F[..., at.x, :]
    if trajectory.preview is not None and controller.form is not None:
        F0[at.rho, at.rho] = trajectory.preview.left.S
        F0[at.x, at.rho] -= controller.form.T_inverse[0][:, controller.form.r :] @ trajectory.preview.left.Q
    F0[at.x] -= loads[at.x_hat] + X @ controller.design.L[len(X) :] @ off
    parts["generator"][:, at.x] -= plant.B @ u_ff
    parts["generator"][:, at.x] -= field
    parts["generator"][:, at.x] += left - (rows[0] - rows) @ turns
    counted = np.zeros_like(F0)
    counted[at.x], counted[at.x_hat, at.x] = x_d[0], np.eye(len(x_d[0]))
    return Flow(F0=F0, parts=tuple(replace(part, F=parts[part.name]) for part in flow.parts), counted=counted)


def _sampled(flow: Flow, program: SampledController, conditions: Conditions, at: Layout, *, measured: Array) -> Flow:
    """Return a closed loop whose controller runs at every multiple of a sample time: the program of docs/arithmetic.md.

    In the given flow observer and generator move in continuous time under held u, y and w. Of a program that corrects
    x_d is what (15) makes of the reference in continuous time: what its steps leave of that is an error of the loop.
    """
    F0, corrects = flow.F0.copy(), program.sampling.corrects
    F0[at.observer], F0[at.w_held] = 0.0, 0.0
    moving = {"plant", "generator"} if corrects else {"plant"}
    parts = [part if part.name in moving else replace(part, F=np.zeros_like(part.F)) for part in flow.parts]
    names = {"y": at.y, "u": at.u, "x_hat": at.x_hat, "s_hat": at.s_hat}
    names |= {} if corrects else {"eta_hat": at.eta_hat, "w": at.w_held}
    names |= {"late": at.late, "before": at.before, "wanted": at.wanted, "change": at.change}
    pairs = [(program.places[name], where) for name, where in names.items() if where.stop > where.start]
    source, place = (np.r_[side] for side in zip(*pairs, strict=True))
    clock = Clock(
        program=program,
        measured=measured,
        quantum=np.zeros(len(measured)) if conditions.quanta is None else conditions.quanta.outputs,
        source=source,
        place=place,
        eta=np.r_[at.eta_hat] if corrects else np.zeros(0, dtype=np.int64),
    )
    return Flow(F0=F0, parts=tuple(parts), clock=clock)


def _switched(rows: Array, cell: IntArray, z: Array) -> Array:
    values = np.empty((len(z), rows.shape[1]))
    for i in range(len(rows)):
        here = cell == i
        values[here] = z[here] @ rows[i].T
    return values
