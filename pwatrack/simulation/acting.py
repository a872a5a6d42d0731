"""What acts on the errors of a sampled loop in a run, enclosed in each substep: see `control.sampled_disturbances`.

The desired trajectory is walked from substep to substep and facet to facet; beside it the generator of the program is
stepped as it runs, by itself. With x̂ = x_d at a tick the program would hold

    u_k = u_ff,k + K (x_d(t_k) − x_d,k)

x_d,k and u_ff,k as it has them: its steps of (15) and pieces of the reference that it sees at the next tick and all. So
the nominal loop, of the mean A₀ of the cells, is off x_d by

    e₀' = A₀ e₀ + B (u_k + K e₀(t_k) − u_ff(t)),   e₀(0) = 0

which is walked too. What is held, and R (x_d + e₀) as it was at the last substep, go along as states at rest, so that
Bernstein coefficients enclose the differences, and what the integrals of their squares are. What ticks that are off
their times add is made of how fast x_d and e₀ change: see `control.off_time`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from pwatrack.arrays import OVER_POWERS, Array, IntArray
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import ProvedController
from pwatrack.control.off_time import OffTime
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
from pwatrack.simulation.enclosure import Segments, Spans, spans
from pwatrack.simulation.flow import Flow, Mode
from pwatrack.simulation.held import Held
from pwatrack.simulation.loads_along import LoadsAlong, with_loads
from pwatrack.simulation.propagate import trace_blocks
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

    It is not for very many samples, nor for an η that is played back and off (15) by more than rounding, nor for loads
    that step and move x_d where ticks come early and late. Where inputs are late it begins with x̂ = x = x_d as the
    first input comes. The gains of the controller are those of `errors`.
    """
    gains, trajectory = errors.gains, controller.trajectory
    sampling = Sampling(sample_time=gains.sample_time, delay=gains.delay)
    end = trajectory.exosystem.end
    duration = duration if end is None else min(duration, end)
    known = trajectory.preview is None or trajectory.preview.share <= ROUNDING
    if not known or duration / gains.sample_time * gains.substeps > _MOST:
        return None
    runs, loads = program(controller, Conditions(sampling=sampling)), LoadsAlong.of(controller, conditions, gains)
    if gains.jitter and errors.estimates is not None and any(loads.steps):
        return None  # how x_d goes on past a tick at which one steps is not what is walked
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
    p = errors.followed.shape[0]
    idle = {("nominal", k) for k in range(2 * p) if k % p not in errors.differing}
    acts = {channel: each for channel, each in squares.items() if each.any() and channel not in idle}
    return replace(found, squares=acts, beside=beside, along=_with_loads(found.along, errors, loads))


def _with_loads(along: Mapping[str, Array], errors: SampledErrors, loads: LoadsAlong) -> dict[str, Array]:
    """Return between what numbers are along x_d, with what estimates of the true loads are, and take off inputs."""
    found = {**along, "s_hat": loads.ends}
    if errors.estimates is None:
        for k, at in enumerate(errors.plant.load_inputs):
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
        squares = spans(segments, lambda _: rows).in_steps(at).squares
        if loads.steps:  # of a difference
            times = np.append(0.0, disturbance.breaks)
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
    around = OffTime.of(errors.gains).most
    return {channel: around(each) for channel, each in found.items()}


class _Walk:
    """x_d with what the program holds at ticks, and with e₀, and R (x_d + e₀) as it was at substeps, beside it.

    Where x_d depends on loads, these go along, from what they are at first, and what of x_d was crossed since a tick.
    """

    def __init__(
        self, controller: ProvedController, errors: SampledErrors, runs: SampledController, loads: LoadsAlong
    ) -> None:
        estimated = errors.estimates is not None
        self._plant, self._runs, self._loads = controller.plant, runs, loads if estimated else loads.none
        self._stepping, self._errors, self._off = loads.largest, errors, OffTime.of(errors.gains)
        self._trajectory = with_loads(controller, loads) if estimated else controller.trajectory
        self._others = OtherCells(controller, errors) if estimated else None
        self._made = list[tuple[Array, Array]]()  # by other cells, of u and of η̂, block by block
        self._known = list[Array]()  # x_d of the program, likewise
        self._U, self._V = crossed(errors)
        self._planes = len(controller.plant.model.partition.H) if estimated else 0  # of which it is seen where x_d is
        self._R, self._A0, self._parts = errors.R.floats, errors.mean.floats, self._off.parts
        self._followed = errors.followed.floats
        self._differs = Differences.of_corners(errors.plant.exact, errors.corners)
        self._tracked = np.eye(len(self._A0)) if controller.tracking == "state" else controller.plant.tracked
        self._kind = controller.tracking
        self._step = self._off.step
        (self._n, self._m), self._q = controller.plant.B.shape, len(self._R)
        self._flow, self._ticks = desired_flow(controller.plant, self._trajectory), 0  # those before the block
        self._e, self._largest = np.zeros(self._n), np.zeros(self._m + self._q)  # of what is held
        self._last, self._changes = np.zeros(self._m), list[Array]()  # of u, at each tick
        self._sizes = np.zeros(len(self._followed))  # of x_d, as it is followed
        self._along = dict[str, Array]()  # between what numbers of the program are

    def walked(self, eta: Array, duration: float) -> Acting:
        """Return what acts by the reference alone."""
        found, off = self._found(eta, duration), self._off
        p, m, n, count = len(self._followed), self._m, self._n, len(found["nominal"].low)
        squares, moved = (found[name].squares * OVER_POWERS / self._step for name in ("nominal", "moved"))
        moved[:, np.sqrt(moved.max(axis=0, initial=0.0)) <= ROUNDING * self._largest[m:]] = 0.0
        squares[:, np.sqrt(squares.max(axis=0, initial=0.0)) <= ROUNDING * self._sizes] = 0.0
        nominal = off.means(squares, found["nominal"].most * (squares.max(axis=0, initial=0.0) > 0))
        inputs, tracked = off.most(found["input"].most), off.most(found["tracked"].most)
        inputs[inputs <= ROUNDING * self._largest[:m]] = 0.0
        of: dict[Channel, Array] = {("nominal", k): nominal[:, k] for k in range(p)}
        of |= {("moved", k): each for k, each in enumerate(moved.T)}
        beside: dict[Form, Array] = {(self._kind, k): each for k, each in enumerate(tracked.T)}
        rate = self._rates(found)
        drawn = (found["drawn"].most + off.theta * rate["V"]) @ self._U.T * OVER_POWERS
        away = np.zeros((count, n))
        for k, each in zip(self._differs.of, off.most(found["away"].most).T, strict=True):
            away[:, k] = np.maximum(away[:, k], each)
        pushed = (1 + off.late) * OVER_POWERS * away + off.late * drawn
        of |= {("disturbance", k): each**2 for k, each in enumerate(pushed.T)}
        of |= {("drawn", k): each**2 for k, each in enumerate(drawn.T)}
        means: dict[Channel, Array] = {("moved", k): each / self._step for k, each in enumerate(found["moved"].areas.T)}
        if off.theta:
            of |= self._off_time(rate, nominal)
            means |= {("swap", k): each for k, each in enumerate(self._swaps(inputs).T)}
            of |= {channel: each**2 for channel, each in means.items() if channel[0] == "swap"}
            beside |= {("estimate", k): off.theta * each for k, each in enumerate(rate["x"].T)}
        if self._made:
            u, eta = (np.repeat(np.vstack(each), self._parts, axis=0)[:count] for each in zip(*self._made, strict=True))
            inputs = inputs + u
            of |= {("cell", k): each**2 * OVER_POWERS for k, each in enumerate(u.T)}
            of |= {("eta", k): each**2 * OVER_POWERS for k, each in enumerate(eta.T)}
        beside |= {("input", k): each for k, each in enumerate(inputs.T)}
        changes = np.vstack([np.zeros((1, m)), *self._changes])
        return Acting(
            squares=of,
            means={channel: each * OVER_POWERS for channel, each in means.items()},
            beside=beside,
            planes=self._plant.model.partition.H,
            near=found["planes"].near,
            apart=self._apart(found),
            changes=changes.max(axis=0) * OVER_POWERS,
            loads=self._stepping,
            along=self._along,
        )

    def _found(self, eta: Array, duration: float) -> dict[str, Spans]:
        """Return what rows of each name are within in each substep, with squares and areas of the first two."""
        found, summed = list[Spans](), len(self._followed) + self._q
        for segments, at in self._segments(eta, duration):
            seen = spans(segments, lambda mode: np.vstack([*self._rows(mode).values()])).in_steps(at)
            found.append(seen._replace(squares=seen.squares[:, :summed], areas=seen.areas[:, :summed]))
        rows = self._rows((0,))
        ends = np.cumsum([*map(len, rows.values())])[:-1]
        whole = (np.split(np.vstack(each), ends, axis=1) for each in zip(*found, strict=True))
        named = dict(zip(rows, map(Spans, *whole), strict=True))
        self._along |= {name: np.column_stack(named[name].ends) for name in ("x_hat", "y")}
        return named

    def _rates(self, found: Mapping[str, Spans]) -> dict[str, Array]:
        """Return how fast x_n = x_d + e₀ is at most at any t: x_n', C x_n', V x_d', and R x_d' beside R e₀'."""
        ends, rates = np.abs(self._along["x_hat"]).max(axis=1), dict[str, Array]()
        terms = np.abs(self._A0) @ ends + np.abs(self._plant.B) @ self._largest[: self._m]
        rows = {"x": np.eye(self._n), "C": self._plant.C, "V": self._V, "R": np.vstack([self._R, self._R])}
        for name, of in rows.items():
            seen = found.get(f"rate of {name}")
            each = np.zeros((len(found["nominal"].low), len(of))) if seen is None else self._off.most(seen.most)
            rates[name] = each * (each.max(axis=0, initial=0.0) > ROUNDING * (np.abs(of) @ terms))
        return rates

    def _off_time(self, rate: Mapping[str, Array], nominal: Array) -> dict[Channel, Array]:
        """Return what ticks off their times do to predictions, and to what is measured and followed, squared."""
        errors, off, n, q = self._errors, self._off, self._n, self._q
        of: dict[Channel, Array] = {("noise", k): (off.theta * each) ** 2 for k, each in enumerate(rate["C"].T)}
        of |= {("nominal", len(nominal.T) + k): each * off.late**2 for k, each in enumerate(nominal.T)}
        cells, at = np.array([A.floats for A in errors.cells]), pivots(errors.R.centre)
        differ = np.ptp(cells, axis=0)[:, at]  # of G, where differences are G R, the largest entries
        predicted = (off.theta * (rate["R"][:, :q] + rate["R"][:, q:]) @ differ.T * OVER_POWERS) ** 2
        least = ROUNDING * off.theta * np.abs(self._A0) @ rate["x"].max(axis=0, initial=0.0)
        predicted[:, np.sqrt(predicted.max(axis=0, initial=0.0)) <= least] = 0.0
        of |= {("predicted", i * n + k): predicted[:, k] for i in range(errors.predicted) for k in range(n)}
        return of

    def _swaps(self, inputs: Array) -> Array:
        """Return the mean size of inputs at t less those at τ, where inputs are off u_ff by so much, (K, m) each."""
        changes, first = np.vstack(self._changes), self._runs.sampling.delay  # before it u_ff acts
        changes[: first + 1] = 0.0
        if 0 < first < len(changes):
            changes[first] = inputs[first * self._parts]
        changes[:, changes.max(axis=0, initial=0.0) <= ROUNDING * self._largest[: self._m]] = 0.0
        return self._off.swaps(changes, len(inputs)) * OVER_POWERS

    def _apart(self, found: Mapping[str, Spans]) -> Array:
        """Return how near x_d comes to planes in each sample, with x_d of the program at its tick, (K, P)."""
        if not self._made:
            return found["planes"].near
        seen, planes, r = found["planes of x_d"], self._plant.model.partition, self._parts
        count = len(seen.low)
        whole = np.full((2, -(-count // r) * r, len(planes.H)), -np.inf)
        whole[:, :count] = self._off.most(seen.high), self._off.most(-seen.low)
        held = np.vstack(self._known)[: whole.shape[1] // r] @ planes.H.T + planes.h
        whole = whole.reshape(2, whole.shape[1] // r, r, len(planes.H)).max(axis=2)
        high, low = np.maximum(whole[0], held), np.minimum(-whole[1], held)
        return np.repeat(np.maximum(np.maximum(low, -high), 0.0), r, axis=0)[:count]

    def _see(self, name: str, low: Array, high: Array) -> None:
        """Take lower and upper ends of some numbers, (K, k) each, into account."""
        ends = np.column_stack([low.min(axis=0), high.max(axis=0)])
        self._along[name] = joined(ends, self._along.get(name, ends))

    def _rows(self, mode: Mode) -> dict[str, Array]:
        """Return rows on (e₀, what is held, η̂, w, 1), by names.

        They are what is followed of e₀, R (x_d + e₀) moving, u − u_ff, what is tracked, planes, f_c(x_d) − f(x_d) +
        (B_c − B) u of the corners c, what of x_d was crossed since the tick, planes of x_d itself, x_d + e₀, and what
        is measured there; where ticks are off their times the rates of some of them.
        """
        n, m, q, planes, D = self._n, self._m, self._q + len(self._V), self._plant.model.partition, self._differs
        u_ff, x_d = self._trajectory.u_ff[mode[0]], self._trajectory.x_d[mode[0]]
        p, R, H, C, B, V = x_d.shape[1], self._R, planes.H, self._tracked, self._plant.B, self._V
        of_planes, nominal = H @ x_d, np.hstack([np.eye(n), np.zeros((n, m + q)), x_d])
        of_planes[:, -1] += planes.h
        zero = np.zeros
        found = {
            "nominal": np.hstack([self._followed, zero((len(self._followed), m + q + p))]),
            "moved": np.hstack([R, zero((len(R), m)), -np.eye(len(R), q), R @ x_d]),
            "input": np.hstack([zero((m, n)), np.eye(m), zero((m, q)), -u_ff]),
            "tracked": np.hstack([C, zero((len(C), m + q + p))]),
            "planes": np.hstack([H, zero((len(H), m + q)), of_planes]),
            "away": np.hstack([zero((len(D.of), n)), D.B, zero((len(D.of), q)), D.rows(mode[0], x_d)]),
            "drawn": np.hstack([zero((len(V), n + m)), -np.eye(len(V), q, k=q - len(V)), V @ x_d]),
            "planes of x_d": np.hstack([zero((self._planes, n + m + q)), of_planes[: self._planes]]),
            "x_hat": nominal,
            "y": self._plant.C @ nominal,
        }
        if self._off.theta:
            e = np.hstack([self._A0, B, zero((n, q)), -B @ u_ff])
            d = np.hstack([zero((n, n + m + q)), x_d @ self._flow.matrix(mode)])
            found |= {"rate of x": e + d, "rate of C": self._plant.C @ (e + d), "rate of V": V @ d}
            found["rate of R"] = np.vstack([R @ d, R @ e])
        return found

    def _segments(self, eta: Array, duration: float) -> Iterator[tuple[Segments, IntArray]]:
        """Yield the walk block by block, with the substep of the block that each segment is in."""
        system, p, held = self._trajectory.exosystem, len(eta), Held(self._runs, eta, self._loads)
        flow, z0 = self._flow, np.concatenate([eta, system.w0, [1.0]])
        resets = [each.behind(p) for each in system.resets]
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
        self._changes.append(np.abs(np.diff(put_out, axis=0)))
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
