"""What acts on the errors of a sampled loop in a run, enclosed in each substep: see `control.sampled_disturbances`.

The desired trajectory is walked from substep to substep and facet to facet; beside it the generator of the program is
stepped as it runs, by itself. With x̂ = x_d at a tick the program would hold

    u_k = u_ff,k + K (x_d(t_k) − x_d,k)

x_d,k and u_ff,k as it has them: its steps of (15) and pieces of the reference that it sees at the next tick and all. So
the nominal loop, of the mean A₀ of the cells, is off x_d by

    e₀' = A₀ e₀ + B (u_k + K e₀(t_k) − u_ff(t)),   e₀(0) = 0

which is walked too. What is held, and R (x_d + e₀) as it was at the last substep, go along as states at rest, so that
Bernstein coefficients enclose the differences, and what the integrals of their squares are.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import ceil

import numpy as np
import scipy  # whose parts are imported where they are used
from numpy.typing import NDArray
from scipy.linalg import expm

from pwatrack.arrays import OVER_POWERS, Array, IntArray
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController, program
from pwatrack.control.sampled_disturbances import ROUNDING, Acting, joined
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.vertices import Differences
from pwatrack.errors import CheckFailed, Undecided
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.rational import pivots
from pwatrack.simulation.acting_estimates import OtherCells, crossed
from pwatrack.simulation.closed_loop import drawn
from pwatrack.simulation.desired import along, desired_flow
from pwatrack.simulation.enclosure import Segments, spans
from pwatrack.simulation.flow import Flow, Mode
from pwatrack.simulation.held import Held
from pwatrack.simulation.loads_along import LoadsAlong, with_loads
from pwatrack.simulation.propagate import pieces, sample_count, trace_blocks
from pwatrack.simulation.recursions import recursion
from pwatrack.simulation.trace import Trace

_MOST = 500_000  # substeps of a run that is walked: half a minute
BLOCK = 20_000  # of them at a time
AT_ONCE = 4096  # segments whose maps are made together
_ON_TICK = 1e-9  # of a substep: a break that is nearer before one is on it but for rounding


def acting(
    controller: ProvedController, conditions: Conditions, errors: SampledErrors, eta: Array, duration: float
) -> Acting | None:
    """Return how large what acts gets up to a time (s) of the program, substep by substep; None where not known.

    It is not for very many samples, nor for an η that is played back and off (15) by more than rounding. Where inputs
    are late it begins with x̂ = x = x_d as the first input comes. The gains of the controller are those of `errors`.
    """
    gains, trajectory = errors.gains, controller.trajectory
    sampling = Sampling(sample_time=gains.sample_time, delay=gains.delay)
    end = trajectory.exosystem.end
    duration = duration if end is None else min(duration, end)
    known = trajectory.preview is None or trajectory.preview.share <= ROUNDING
    if not known or duration / gains.sample_time * gains.substeps > _MOST:
        return None
    runs, loads = program(controller, Conditions(sampling=sampling)), LoadsAlong.of(controller, conditions, gains)
    walk = _Walk(controller, errors, runs, loads)
    try:
        found = walk.walked(eta, duration)
    except (CheckFailed, Undecided):
        return None
    if not all(np.isfinite(X).all() for X in (*found.squares.values(), *found.beside.values())):
        return None
    squares, beside, count = dict(found.squares), dict(found.beside), len(found.near)
    paced = float(errors.paces[-1])  # d acts for as long as passes
    squares |= {("deviation", k): np.full(count, (paced * most) ** 2) for k, (_, most) in enumerate(errors.deviations)}
    for tick, change in loads.steps.items():
        if tick * gains.substeps < count:
            for k in np.flatnonzero(change).tolist():
                squares.setdefault(("load", k), np.zeros(count))[tick * gains.substeps] = change[k] ** 2
    for channel, each in _outside(controller, conditions, errors, duration, count, loads).items():
        late = np.sqrt(squares.get(channel, np.zeros(count)))
        squares[channel] = (late + np.sqrt(each) * (paced if channel[0] == "disturbance" else 1.0)) ** 2
    if conditions.quanta is not None:
        for k, steps in enumerate((conditions.quanta.inputs / 2).tolist()):
            squares["input", k] = np.full(count, steps**2)
            beside["input", k] = beside["input", k] + steps
    idle = {("nominal", k) for k in range(errors.followed.shape[0])} - {("nominal", k) for k in errors.differing}
    acts = {channel: each for channel, each in squares.items() if each.any() and channel not in idle}
    return replace(found, squares=acts, beside=beside, along=_with_loads(found.along, errors, loads))


def _with_loads(along: Mapping[str, Array], errors: SampledErrors, loads: LoadsAlong) -> dict[str, Array]:
    """Return between what numbers are along x_d, with what estimates of the true loads are, and take off inputs."""
    found = {**along, "s_hat": loads.ends}
    if errors.estimates is None:
        for k, at in enumerate((errors.plant.loads and errors.plant.loads.inputs(errors.plant.exact.B)) or ()):
            for name in ("u", "u_ff"):
                found[name] = found[name].copy()
                found[name][at] -= loads.ends[k, ::-1]
    return found


def _outside(
    controller: ProvedController,
    conditions: Conditions,
    errors: SampledErrors,
    duration: float,
    count: int,
    loads: LoadsAlong,
) -> dict[Channel, Array]:
    """Return the mean squares in each substep of disturbances; of what is measured off by noise and steps, at ticks.

    A tick of a run is up to half of the jitter off its time: it may be a substep before or after that it belongs to.
    """
    disturbance, parts = loads.rest, errors.gains.substeps
    h, found = errors.gains.sample_time, dict[Channel, Array]()
    if disturbance is not None:
        rows = np.hstack([disturbance.Q, np.zeros((len(disturbance.Q), 1))])
        step = h / parts
        segments = along(disturbance, count * step, steps=count)
        at = np.clip(np.floor(segments.t / step + _ON_TICK).astype(np.int64), 0, count - 1)
        squares = np.zeros((count, len(rows)))
        np.add.at(squares, at, spans(segments, lambda _: rows).squares)
        if loads.steps:  # of a difference
            times = np.array([0.0, *(reset.t for reset in disturbance.resets)])
            sizes = (np.abs(disturbance.states(times)) @ np.abs(disturbance.Q).T).max(axis=0)
            squares[squares <= (ROUNDING * sizes) ** 2 * step] = 0.0
        found |= {("disturbance", k): square / step for k, square in enumerate(squares.T)}
    ticks = np.arange(count) // parts
    off = np.zeros((ticks[-1] + 1, len(controller.plant.C)))
    if conditions.noise is not None:
        values = np.abs(drawn(conditions.noise, duration)["values"])
        same = conditions.noise.sample_time == h
        off += values[: len(off)] if same and len(values) >= len(off) else values.max(axis=0)
    if conditions.quanta is not None:
        off += conditions.quanta.outputs / 2
    found |= {("noise", k): off[ticks, k] ** 2 for k in range(off.shape[1])}
    early = ceil(errors.gains.jitter / 2 / (h / parts))
    if not early:
        return found
    around = scipy.ndimage.maximum_filter1d
    return {channel: around(each, 2 * early + 1, mode="nearest") for channel, each in found.items()}


class _Walk:
    """x_d with what the program holds at ticks, and with e₀, and R (x_d + e₀) as it was at substeps, beside it.

    Where x_d depends on loads, these go along, from what they are at first, and what of x_d was crossed since a tick.
    """

    def __init__(
        self, controller: ProvedController, errors: SampledErrors, runs: SampledController, loads: LoadsAlong
    ) -> None:
        estimated = errors.estimates is not None
        self._plant, self._runs, self._loads = controller.plant, runs, loads if estimated else loads.none
        self._stepping = loads.largest
        self._trajectory = with_loads(controller, loads) if estimated else controller.trajectory
        self._others = OtherCells(controller, errors) if estimated else None
        self._made = list[tuple[Array, Array]]()  # by other cells, of u and of η̂, block by block
        self._known = list[Array]()  # x_d of the program, likewise
        self._U, self._V = crossed(errors)
        self._planes = len(controller.plant.model.partition.H) if estimated else 0  # of which it is seen where x_d is
        self._R, self._A0, self._parts = errors.R.floats, errors.mean.floats, errors.gains.substeps
        self._followed = errors.followed.floats
        self._differs = Differences.of_corners(errors.plant.exact, errors.corners)
        self._tracked = np.eye(len(self._A0)) if controller.tracking == "state" else controller.plant.tracked
        self._kind, at = controller.tracking, pivots(errors.followed.centre)
        self._rest = self._A0 - self._A0[:, at] @ self._followed
        self._late = float(errors.paces[-1] - 1)  # by how much more of its time passes than the program counts
        self._step = errors.gains.sample_time / self._parts
        (self._n, self._m), self._q = controller.plant.B.shape, len(self._R)
        self._flow, self._ticks = desired_flow(controller.plant, self._trajectory), 0  # those before the block
        self._e, self._largest = np.zeros(self._n), np.zeros(self._m + self._q)  # of what is held
        self._last, self._changes = np.zeros(self._m), np.zeros(self._m)  # of u
        self._sizes = np.zeros(len(self._followed))  # of x_d, as it is followed
        self._along = dict[str, Array]()  # between what numbers of the program are

    def walked(self, eta: Array, duration: float) -> Acting:
        """Return what acts by the reference alone."""
        count, q, m, H = sample_count(duration, self._step), self._q, self._m, self._plant.model.partition.H
        p, signals, outputs = len(self._followed), m + len(self._tracked), len(self._plant.C)
        squares, areas, first = np.zeros((count, p + q + self._n)), np.zeros((count, p + q)), 0
        most, near = np.zeros((count, signals)), np.full((count, len(H)), np.inf)
        other = np.zeros((count, len(self._differs.of)))
        away, drawn = np.zeros((count, self._n)), np.zeros((count, len(self._V)))
        ends = np.full((2, count, self._planes), -np.inf)  # of H x_d: above it, and above −H x_d
        for segments, at in self._segments(eta, duration):
            found, at = spans(segments, self._rows), at + first
            late, size = p + q + signals + len(H), np.maximum(np.abs(found.low), np.abs(found.high))
            np.add.at(squares, at, found.squares[:, [*range(p + q), *range(late, late + self._n)]])
            np.add.at(areas, at, found.areas[:, : p + q])
            np.maximum.at(most, at, size[:, p + q : p + q + signals])
            np.maximum.at(other, at, size[:, late + self._n :][:, : len(self._differs.of)])
            np.maximum.at(drawn, at, size[:, late + self._n + len(self._differs.of) :][:, : len(self._V)])
            for side, each in zip(ends, (found.high, -found.low), strict=True):
                np.maximum.at(
                    side, at, each[:, late + self._n + len(self._differs.of) + len(self._V) :][:, : self._planes]
                )
            for name, columns in (("x_hat", slice(-self._n - outputs, -outputs)), ("y", slice(-outputs, None))):
                self._see(name, found.low[:, columns], found.high[:, columns])
            apart = np.maximum(np.maximum(found.low, -found.high), 0.0)
            np.minimum.at(near, at, apart[:, p + q + signals :][:, : len(H)])
            first = int(at[-1]) + 1
        squares, areas = squares * OVER_POWERS / self._step, areas * OVER_POWERS / self._step
        least = ROUNDING * np.concatenate([self._sizes, self._largest[m:], np.zeros(self._n)])
        squares[:, np.sqrt(squares.max(axis=0)) <= least] = 0.0
        squares[:, p + q :] *= self._late**2
        for k, each in zip(self._differs.of, other.T, strict=True):
            away[:, k] = np.maximum(away[:, k], each)
        off = drawn @ self._U.T * OVER_POWERS
        squares[:, p + q :] = (
            np.sqrt(squares[:, p + q :]) + (1 + self._late) * OVER_POWERS * away + self._late * off
        ) ** 2
        most[:, :m][most[:, :m] <= ROUNDING * self._largest[:m]] = 0.0
        names: list[Channel] = [*(("nominal", k) for k in range(p)), *(("moved", k) for k in range(q))]
        names += [("disturbance", k) for k in range(self._n)]
        forms: list[Form] = [*(("input", k) for k in range(m)), *((self._kind, k) for k in range(len(self._tracked)))]
        more = [off**2]
        names += [("drawn", k) for k in range(self._n)]
        if self._made:
            u, eta = (np.repeat(np.vstack(each), self._parts, axis=0)[:count] for each in zip(*self._made, strict=True))
            most[:, :m] += u
            more += [u**2 * OVER_POWERS, eta**2 * OVER_POWERS]
            names += [*(("cell", k) for k in range(m)), *(("eta", k) for k in range(eta.shape[1]))]
        return Acting(
            squares=dict(zip(names, np.hstack([squares, *more]).T, strict=True)),
            means=dict(zip(names[p : p + q], areas.T[p:], strict=True)),
            beside=dict(zip(forms, most.T, strict=True)),
            planes=H,
            near=near,
            apart=self._apart(ends, near),
            changes=self._changes * OVER_POWERS,
            loads=self._stepping,
            along=self._along,
        )

    def _apart(self, ends: Array, near: Array) -> Array:
        """Return how near x_d comes to planes in each sample, with x_d of the program at its tick, (K, P)."""
        if not self._made:
            return near
        count, planes, r = len(near), self._plant.model.partition, self._parts
        whole = np.full((2, -(-count // r) * r, near.shape[1]), -np.inf)
        whole[:, :count] = ends
        held = np.vstack(self._known)[: whole.shape[1] // r] @ planes.H.T + planes.h
        whole = whole.reshape(2, whole.shape[1] // r, r, near.shape[1]).max(axis=2)
        high, low = np.maximum(whole[0], held), np.minimum(-whole[1], held)
        return np.repeat(np.maximum(np.maximum(low, -high), 0.0), r, axis=0)[:count]

    def _see(self, name: str, low: Array, high: Array) -> None:
        """Take lower and upper ends of some numbers, (K, k) each, into account."""
        ends = np.column_stack([low.min(axis=0), high.max(axis=0)])
        self._along[name] = joined(ends, self._along.get(name, ends))

    def _rows(self, mode: Mode) -> Array:
        """Return rows on (e₀, what is held, η̂, w, 1).

        They are what is followed of e₀, R (x_d + e₀) moving, u − u_ff, what is tracked, planes, (x_d + e₀)' less A₀ of
        what is followed, f_c(x_d) − f(x_d) + (B_c − B) u of the corners c, what of x_d was crossed since the tick,
        planes of x_d itself, x_d + e₀, and what is measured there.
        """
        n, m, q, planes, D = self._n, self._m, self._q + len(self._V), self._plant.model.partition, self._differs
        u_ff, x_d = self._trajectory.u_ff[mode[0]], self._trajectory.x_d[mode[0]]
        p, R, H, C, B, V = x_d.shape[1], self._R, planes.H, self._tracked, self._plant.B, self._V
        of_planes, nominal = H @ x_d, np.hstack([np.eye(n), np.zeros((n, m + q)), x_d])
        of_planes[:, -1] += planes.h
        zero = np.zeros
        return np.vstack(
            [
                np.hstack([self._followed, zero((len(self._followed), m + q + p))]),
                np.hstack([R, zero((len(R), m)), -np.eye(len(R), q), R @ x_d]),
                np.hstack([zero((m, n)), np.eye(m), zero((m, q)), -u_ff]),
                np.hstack([C, zero((len(C), m + q + p))]),
                np.hstack([H, zero((len(H), m + q)), of_planes]),
                np.hstack([self._rest, B, zero((n, q)), x_d @ self._flow.matrix(mode) - B @ u_ff]),
                np.hstack([zero((len(D.of), n)), D.B, zero((len(D.of), q)), D.rows(mode[0], x_d)]),
                np.hstack([zero((len(V), n + m)), -np.eye(len(V), q, k=q - len(V)), V @ x_d]),
                np.hstack([zero((self._planes, n + m + q)), of_planes[: self._planes]]),
                nominal,
                self._plant.C @ nominal,
            ]
        )

    def _segments(self, eta: Array, duration: float) -> Iterator[tuple[Segments, IntArray]]:
        """Yield the walk block by block, with the substep of the block that each segment is in."""
        system, p, held = self._trajectory.exosystem, len(eta), Held(self._runs, eta, self._loads)
        flow, z0 = self._flow, np.concatenate([eta, system.w0, [1.0]])
        resets = pieces(system, slice(p, p + len(system.w0)))
        for trace in trace_blocks(
            flow, z0, duration=duration, sample_time=self._step, resets=resets, most=BLOCK * self._parts
        ):
            x_d = np.einsum("knj,kj->kn", self._trajectory.x_d[trace.modes[:, 0]], trace.z)
            self._sizes = np.maximum(self._sizes, np.abs(x_d @ self._followed.T).max(axis=0))
            now = x_d[:: self._parts]
            own = held.take(len(now))
            for name in ("x_d", "u_ff", "eta_hat", "w"):
                self._see(name, getattr(own, name), getattr(own, name))
            if self._others is not None:
                y = np.hstack([own.s, own.eta_hat, own.w, np.ones((len(now), 1))])
                self._made.append(self._others.at(y))
                self._known.append(own.x_d)
            u = own.u_ff + (now - own.x_d) @ self._runs.K.T
            u[: max(self._runs.sampling.delay - self._ticks, 0)] = 0.0
            yield self._beside(flow, trace, x_d @ self._R.T, u, own.x_d @ self._V.T)
            self._ticks += len(u)

    def _beside(self, flow: Flow, trace: Trace, moving: Array, u: Array, drawn: Array) -> tuple[Segments, IntArray]:
        """Return segments with e₀ and what is held in each of them before ζ; each block begins at a tick."""
        segments, n, m, q = Segments.of(flow, trace), self._n, self._m, self._q + len(self._V)
        at = np.searchsorted(trace.t, segments.t + _ON_TICK * self._step, side="right") - 1
        F = np.pad(segments.F, ((0, 0), (n + m + q, 0), (n + m + q, 0)))
        F[:, :n, :n], F[:, :n, n : n + m] = self._A0, self._plant.B
        F[:, :n, n + m + q :] = -self._plant.B @ self._trajectory.u_ff[[mode[0] for mode in segments.modes]]
        turns, ticks = self._turns(F, segments), at // self._parts
        driven = np.einsum("knj,kj->kn", turns[:, :, n + m + q :], segments.zeta)
        begins, ticked = np.diff(at, prepend=-1) > 0, np.diff(ticks, prepend=-1) > 0
        resting = ticked & (ticks <= self._runs.sampling.delay - self._ticks)  # as inputs act that were there before
        e, u = self._nominal(turns[:, :, : n + m], driven, u[ticks], ticked, resting)
        begin = np.maximum.accumulate(np.where(begins, np.arange(len(at)), 0))  # of the substep
        before = np.hstack([u, moving[at] + (e @ self._R.T)[begin]])
        put_out = np.vstack([self._last, u[ticked]])
        self._last = put_out[-1]
        self._changes = np.maximum(self._changes, np.abs(np.diff(put_out, axis=0)).max(axis=0))
        self._see("u", u, u)
        self._largest = np.maximum(self._largest, np.abs(before).max(axis=0))
        return replace(segments, F=F, zeta=np.hstack([e, before, drawn[ticks], segments.zeta])), at

    def _nominal(
        self, turns: Array, driven: Array, u: Array, ticked: NDArray[np.bool_], resting: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Return e₀ at the begin of each segment, and what is held in it: u + K e₀ where it begins with a tick."""
        (count, n, _), m, K = turns.shape, self._m, self._runs.K
        both = np.zeros((count + 1, n + m))  # e₀, and what was held before
        both[0, :n] = self._e
        for first in range(0, count, AT_ONCE):
            some = slice(first, min(first + AT_ONCE, count))
            tick, A, B, c = ticked[some], turns[some, :, :n], turns[some, :, n:], np.zeros((some.stop - first, n + m))
            M = np.zeros((len(c), n + m, n + m))
            M[:, :n, :n], M[:, :n, n:], M[:, n:, n:], c[:, :n] = A, B, np.eye(m), driven[some]
            M[tick, :n, :n], M[tick, n:, :n], M[tick, :, n:] = A[tick] + B[tick] @ K, K, 0.0
            c[tick, :n] += np.einsum("knm,km->kn", B[tick], u[some][tick])
            c[tick, n:] = u[some][tick]
            M[resting[some]] = 0.0
            both[first : some.stop + 1] = recursion(M, c, both[first])
        e, self._e = np.where(resting[:, None], 0.0, both[:-1, :n]), both[-1, :n]
        return e, np.where(ticked[:, None], u + e @ K.T, both[:-1, n:])

    def _turns(self, F: Array, segments: Segments) -> Array:
        """Return the rows of e^{F length} that tell e₀ at the end of each segment, (M, n, N)."""
        turns = np.empty((len(segments.t), self._n, F.shape[1]))
        whole = np.abs(segments.length - self._step) <= _ON_TICK * self._step
        for number, F_i in enumerate(F):
            here, turn = whole & (segments.number == number), expm(F_i * self._step)
            less = (segments.length[here] - self._step)[:, None, None]
            turns[here] = turn[: self._n] + less * (turn @ F_i)[: self._n]
        for i in np.flatnonzero(~whole).tolist():
            turns[i] = expm(F[segments.number[i]] * segments.length[i])[: self._n]
        return turns
