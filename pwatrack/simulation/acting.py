"""What acts on the errors of a sampled loop in a run, enclosed at all times: see `control.sampled_disturbances`.

The desired trajectory is walked from substep to substep and facet to facet; beside it the generator of the program is
stepped as it runs, by itself. With x̂ = x_d at a tick the program would hold

    u_k = u_ff,k + K (x_d(t_k) − x_d,k)

x_d,k and u_ff,k as it has them: what this is off u_ff(t) until the next tick is ω(t), the mean over the sample, what
its steps leave of (15) and pieces of the reference that it sees at the next tick and all. The integral of u_ff is
walked too, so that its mean ū from tick to tick is known: ω is u_k − ū in the mean, and W' = ū − u_ff. W goes along as
a state, and what is held, ū and x_d + B W as it was at the last substep as states at rest, so that Bernstein
coefficients enclose the differences.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import EPS, OVER_POWERS, Array, IntArray
from pwatrack.control.bounds import Channel
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController, program
from pwatrack.control.sampled_disturbances import Acting
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.errors import CheckFailed, Undecided
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.simulation.closed_loop import drawn
from pwatrack.simulation.desired import along, desired_flow
from pwatrack.simulation.enclosure import Segments, enclosed
from pwatrack.simulation.flow import Flow, Mode
from pwatrack.simulation.propagate import pieces, trace_blocks
from pwatrack.simulation.trace import Trace

_MOST = 500_000  # substeps of a run that is walked: half a minute
BLOCK = 20_000  # of them at a time
_ROUNDING = 1e-11  # of the size of what is held: what differs by less differs by rounding
_ON_TICK = 1e-9  # of a substep: a break that is nearer before one is on it but for rounding
_LOST = 8 * EPS  # of the integral of u_ff: what is lost in a difference of it


def acting(
    controller: ProvedController, conditions: Conditions, errors: SampledErrors, eta: Array, duration: float
) -> Acting | None:
    """Return how large what acts gets up to a time (s); None where that is not known.

    It is not for an η that is played back, where loads move x_d, where inputs are late, and for very many samples.

    Args:
        controller: With the gains of `errors`.
        conditions: Of the run: noise as it is drawn in it, steps, disturbances.
        errors: Of the sampled loop.
        eta: η̂(0), (p,).
        duration: Of the run.
    """
    gains, trajectory = errors.gains, controller.trajectory
    sampling = Sampling(sample_time=gains.sample_time, delay=gains.delay)
    runs, count = program(controller, Conditions(sampling=sampling)), duration / gains.sample_time * gains.substeps
    moving = (rows[..., : runs.sizes["N"] - runs.sizes["n"]] for rows in (runs.generator, runs.guards, runs.x_d))
    played = trajectory.preview is not None or any(rows.any() for rows in moving)
    if played or gains.delay or count > _MOST:
        return None
    end = trajectory.exosystem.end
    walk, m = _Walk(controller, errors, runs), len(runs.K)
    try:
        found = enclosed(walk.segments(eta, duration if end is None else min(duration, end)), walk.rows)
    except (CheckFailed, Undecided):
        return None
    sizes = np.append(walk.mean, np.maximum(np.abs(found.low), np.abs(found.high)) * OVER_POWERS)
    if not np.isfinite(sizes).all():
        return None
    sizes[sizes <= walk.rounding] = 0.0
    mean, off, ripple, moved = np.split(sizes, [m, 2 * m, 3 * m])
    total, steps = _outside(controller, conditions, duration), np.zeros(m)
    if conditions.quanta is not None:
        steps = conditions.quanta.inputs / 2
    inside: dict[Literal["input", "ripple", "moved"], Array]
    inside = {"input": mean + steps, "ripple": ripple, "moved": moved}
    total |= {(kind, k): size for kind, all_ in inside.items() for k, size in enumerate(all_.tolist())}
    return Acting(sizes={channel: size for channel, size in total.items() if size}, off=off + steps)


def _outside(controller: ProvedController, conditions: Conditions, duration: float) -> dict[Channel, float]:
    """Return how large disturbances get, what is measured is off by noise and steps, at the times of ticks and all."""
    loads, disturbance, found = controller.plant.loads, conditions.disturbance, dict[Channel, float]()
    if disturbance is not None and not (loads is not None and loads.are(disturbance)):
        rows = np.hstack([disturbance.Q, np.zeros((len(disturbance.Q), 1))])
        within = enclosed([along(disturbance, duration)], lambda _: rows)
        sizes = np.maximum(np.abs(within.low), np.abs(within.high)).tolist()
        found |= {("disturbance", k): size for k, size in enumerate(sizes)}
    off = np.zeros(len(controller.plant.C))
    if conditions.noise is not None:
        off += np.abs(drawn(conditions.noise, duration)["values"]).max(axis=0)
    if conditions.quanta is not None:
        off += conditions.quanta.outputs / 2
    return found | {("noise", k): size for k, size in enumerate(off.tolist())}


class _Walk:
    """x_d with what the program holds at ticks, and x_d + B W at substeps, beside it."""

    def __init__(self, controller: ProvedController, errors: SampledErrors, runs: SampledController) -> None:
        self._plant, self._trajectory, self._runs = controller.plant, controller.trajectory, runs
        self._R, self._RB, self._parts = errors.R.floats, errors.R.floats @ controller.plant.B, errors.gains.substeps
        self._step = errors.gains.sample_time / self._parts
        self._m = m = len(runs.K)
        self.mean = np.zeros(m)  # of ω from tick to tick, the largest
        self._largest = np.zeros(2 * m + len(self._R))  # of what is held, and of the integral of u_ff

    @property
    def rounding(self) -> Array:
        """What counts as rounding of the mean of ω, of ω, W and what moves."""
        u, integral, moved = np.split(self._largest, [self._m, 2 * self._m])
        h = self._step * self._parts
        mean = np.maximum(_ROUNDING * u, _LOST * integral / h)
        return np.concatenate([mean, _ROUNDING * u, mean * h, _ROUNDING * moved])

    def rows(self, mode: Mode) -> Array:
        """Return rows of ω, W, and of what R (x_d + B W) was less what it is, on (W, what is held, ∫ u_ff, η̂, w, 1)."""
        m, q = self._m, len(self._R)
        u_ff, x_d = self._trajectory.u_ff[mode[0]], self._R @ self._trajectory.x_d[mode[0]]
        of_W, held = np.vstack([np.zeros((m, m)), np.eye(m), -self._RB]), np.zeros((2 * m + q, 2 * m + q))
        held[:m, :m], held[2 * m :, 2 * m :] = np.eye(m), np.eye(q)
        now = np.vstack([-u_ff, np.zeros_like(u_ff), -x_d])
        return np.hstack([of_W, held, np.zeros((2 * m + q, m)), now])

    def segments(self, eta: Array, duration: float) -> Iterator[Segments]:
        """Yield the walk block by block."""
        m, system, p, held = self._m, self._trajectory.exosystem, len(eta), self._held(eta)
        flow, z0 = self._flow(), np.concatenate([np.zeros(m), eta, system.w0, [1.0]])
        resets = pieces(system, slice(m + p, m + p + len(system.w0)))
        for trace in trace_blocks(
            flow, z0, duration=duration, sample_time=self._step, resets=resets, most=BLOCK * self._parts
        ):
            x_d = np.einsum("knj,kj->kn", self._trajectory.x_d[trace.modes[:, 0]], trace.z[:, m:])
            known = zip(x_d[:: self._parts], held, strict=False)
            u = np.array([u_ff + self._runs.K @ (now - wanted) for now, (wanted, u_ff) in known])
            yield self._beside(Segments.of(flow, trace), trace, x_d @ self._R.T, u)

    def _flow(self) -> Flow:
        """Return the flow of (∫ u_ff, η̂, w, 1)."""
        flow, m = desired_flow(self._plant, self._trajectory), self._m
        (part,) = flow.parts
        F, guards = np.pad(part.F, ((0, 0), (m, 0), (m, 0))), np.pad(part.guards, ((0, 0), (m, 0)))
        F[:, :m, m:] = self._trajectory.u_ff
        return Flow(F0=np.pad(flow.F0, (m, 0)), parts=(replace(part, guards=guards, F=F),))

    def _beside(self, segments: Segments, trace: Trace, moving: Array, u: Array) -> Segments:
        """Return segments with W and what is held in each of them before ζ; each block begins at a tick."""
        m, parts, size = self._m, self._parts, 3 * self._m + len(self._R)
        assert trace.breaks is not None
        end = expm(segments.F[segments.number[-1]] * segments.length[-1]) @ segments.zeta[-1]
        ticks, total = np.append(trace.t[::parts], trace.breaks.until), np.vstack([trace.z[::parts, :m], end[:m]])
        length = np.diff(ticks)[:, None]
        mean = np.divide(np.diff(total, axis=0), length, out=u.copy(), where=length > _ON_TICK * self._step)
        self.mean = np.maximum(self.mean, np.abs(u - mean).max(axis=0))

        def W(substep: IntArray, t: Array, now: Array) -> Array:
            tick = substep // parts
            return np.asarray(mean[tick] * (t - ticks[tick])[:, None] - (now - total[tick]))

        moving = moving + W(np.arange(len(trace.t)), trace.t, trace.z[:, :m]) @ self._RB.T
        self._largest = np.maximum(self._largest, np.hstack([np.abs(X).max(axis=0) for X in (u, total, moving)]))
        at = np.searchsorted(trace.t, segments.t + _ON_TICK * self._step, side="right") - 1
        before = W(at, segments.t, segments.zeta[:, :m]), u[at // parts], mean[at // parts], moving[at]
        F = np.pad(segments.F, ((0, 0), (size, 0), (size, 0)))
        F[:, :m, 2 * m : 3 * m] = np.eye(m)
        F[:, :m, size + m :] = -self._trajectory.u_ff[[mode[0] for mode in segments.modes]]
        return replace(segments, F=F, zeta=np.hstack([*before, segments.zeta]))

    def _held(self, eta: Array) -> Iterator[tuple[Array, Array]]:
        """Yield x_d and u_ff as the program has them, tick by tick; loads that it estimates move no x_d."""
        runs, follows = self._runs, self._runs.follows
        assert follows is not None
        loads = runs.sizes["N"] - runs.sizes["n"]
        rows = (runs.guards, runs.x_d, runs.u_ff, runs.generator)
        guards, x_d, u_ff, generator = (X[..., loads:] for X in rows)
        starts, w, tick = {(piece.tick, piece.start): piece.w for piece in follows.pieces}, follows.w0.copy(), 0
        begins = sorted(starts)
        while True:
            while begins and begins[0][0] <= tick:
                begin = begins.pop(0)
                w[begin[1] : begin[1] + len(starts[begin])] = starts[begin]
            s = np.concatenate([eta, w, [1.0]])
            cell = int(np.argmax((runs.sides * np.sign(guards @ s) >= 0).all(axis=1)))
            yield x_d[cell] @ s, u_ff[cell] @ s
            eta, w, tick = generator[cell] @ s, follows.turn[0] @ w if len(w) else w, tick + 1
