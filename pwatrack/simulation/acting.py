"""What acts on the errors of a sampled loop in a run, enclosed at all times: see `control.sampled_disturbances`.

The desired trajectory is walked from substep to substep and facet to facet; beside it the generator of the program is
stepped as it runs, by itself. With x̂ = x_d at a tick the program would hold

    u_k = u_ff,k + K (x_d(t_k) − x_d,k)

x_d,k and u_ff,k as it has them: what this is off u_ff(t) until the next tick is ω(t), the mean over the sample, what
its steps leave of (15) and pieces of the reference that it sees at the next tick and all. What is held, and x_d as it
was at the last substep, go along as states at rest, so that Bernstein coefficients enclose the differences.
"""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import block_diag

from pwatrack.arrays import OVER_POWERS, Array
from pwatrack.control.bounds import Channel
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController, program
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.errors import CheckFailed, Undecided
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.simulation.closed_loop import drawn
from pwatrack.simulation.desired import along, desired_flow
from pwatrack.simulation.enclosure import Segments, enclosed
from pwatrack.simulation.flow import Mode
from pwatrack.simulation.propagate import pieces, trace_blocks
from pwatrack.simulation.trace import Trace

_MOST = 500_000  # substeps of a run that is walked: half a minute
_BLOCK = 20_000  # of them at a time
_ROUNDING = 1e-11  # of the size of what is held: what differs by less differs by rounding
_ON_TICK = 1e-9  # of a substep: a break that is nearer before one is on it but for rounding

Acting = dict[Channel, float]


def acting(
    controller: ProvedController, conditions: Conditions, errors: SampledErrors, eta: Array, duration: float
) -> Acting | None:
    """Return how large each channel gets up to a time (s), but for those that are 0; None where that is not known.

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
    walk = _Walk(controller, errors, runs)
    try:
        found = enclosed(walk.segments(eta, duration if end is None else min(duration, end)), walk.rows)
    except (CheckFailed, Undecided):
        return None
    sizes = np.maximum(np.abs(found.low), np.abs(found.high)) * OVER_POWERS
    if not np.isfinite(sizes).all():
        return None
    sizes[sizes <= _ROUNDING * walk.largest] = 0.0
    m, total = len(runs.K), _outside(controller, conditions, duration)
    for k, size in enumerate(sizes.tolist()):
        total["input" if k < m else "moved", k if k < m else k - m] = size
    if conditions.quanta is not None:
        for k, step in enumerate(conditions.quanta.inputs.tolist()):
            total["input", k] += step / 2
    return {channel: size for channel, size in total.items() if size}


def _outside(controller: ProvedController, conditions: Conditions, duration: float) -> Acting:
    """Return how large disturbances get, what is measured is off by noise and steps, at the times of ticks and all."""
    loads, disturbance, found = controller.plant.loads, conditions.disturbance, Acting()
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
    """x_d with what the program holds at ticks, and x_d at substeps, beside it."""

    def __init__(self, controller: ProvedController, errors: SampledErrors, runs: SampledController) -> None:
        self._plant, self._trajectory, self._runs = controller.plant, controller.trajectory, runs
        self._R, self._parts = errors.R.floats, errors.gains.substeps
        self._step = errors.gains.sample_time / self._parts
        self.largest = np.zeros(len(runs.K) + len(self._R))  # of what is held

    def rows(self, mode: Mode) -> Array:
        """Return rows of what is held less what it is now, on (what is held, η̂, w, 1)."""
        now = np.vstack([self._trajectory.u_ff[mode[0]], self._R @ self._trajectory.x_d[mode[0]]])
        return np.hstack([np.eye(len(now)), -now])

    def segments(self, eta: Array, duration: float) -> Iterator[Segments]:
        """Yield the walk block by block."""
        system, p = self._trajectory.exosystem, len(eta)
        flow, z0 = desired_flow(self._plant, self._trajectory), np.concatenate([eta, system.w0, [1.0]])
        resets, held = pieces(system, slice(p, p + len(system.w0))), self._held(eta)
        last, number = np.zeros(len(self._runs.K)), 0
        for trace in trace_blocks(
            flow, z0, duration=duration, sample_time=self._step, resets=resets, most=_BLOCK * self._parts
        ):
            x_d = np.einsum("knj,kj->kn", self._trajectory.x_d[trace.modes[:, 0]], trace.z)
            u = np.empty((len(x_d), len(last)))
            for k in range(len(x_d)):
                if (number + k) % self._parts == 0:
                    wanted, u_ff = next(held)
                    last = u_ff + self._runs.K @ (x_d[k] - wanted)
                u[k] = last
            number += len(x_d)
            beside = np.hstack([u, x_d @ self._R.T])
            self.largest = np.maximum(self.largest, np.abs(beside).max(axis=0))
            yield self._beside(Segments.of(flow, trace), trace, beside)

    def _beside(self, segments: Segments, trace: Trace, beside: Array) -> Segments:
        """Return segments with what is held in each of them before ζ."""
        place = np.searchsorted(trace.t, segments.t + _ON_TICK * self._step, side="right") - 1
        count = beside.shape[1]
        return Segments(
            modes=segments.modes,
            F=np.array([block_diag(np.zeros((count, count)), F) for F in segments.F]),
            number=segments.number,
            t=segments.t,
            zeta=np.hstack([beside[place], segments.zeta]),
            length=segments.length,
        )

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
