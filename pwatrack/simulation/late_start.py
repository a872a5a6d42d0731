"""What a run whose inputs are late is like up to the tick at which the first input acts.

Till then x goes on under no input and the run's own disturbances, whatever is measured: it is walked from facet to
facet, with x_d of the true loads beside it. The program predicts: without noise each prediction x̃ is c, known too, and
noise adds what tubes of `control.sampled_disturbances` are of. What is left where x̃ begins a substep in another cell
than c is bounded all along it: see `docs/theory/beyond.md`, *The start of a run with late inputs*.

Where ticks are up to θ off their times, as in `control.off_time`, c is what is predicted from y at these times. So y is
measured off by θ sup |C x'| more; and as the first input acts x − x_d is off what it is at its time by θ sup of its
rate. That e₀ has begun by then, or not, is added in `control.sampled_disturbances`.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag, expm

from pwatrack.arrays import OVER_SUMS, Array, IntArray
from pwatrack.control.bounds import Form
from pwatrack.control.controller import ProvedController
from pwatrack.control.off_time import OffTime
from pwatrack.control.program import program
from pwatrack.control.sampled_disturbances import LateStart, joined
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.errors import CheckFailed
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.simulation.controller_arrays import cells, memory
from pwatrack.simulation.enclosure import Segments, spans
from pwatrack.simulation.flow import Flow, Mode, SwitchedPart
from pwatrack.simulation.held import Held
from pwatrack.simulation.loads_along import LoadsAlong, with_loads
from pwatrack.simulation.propagate import trace_blocks
from pwatrack.simulation.trace import Trace

_ROUNDED = 1e-11  # of sizes: what is nearer to a plane may be on its other side
_ON_TICK = 1e-9  # of a substep: a break that is nearer before one is on it but for rounding


def late_start(
    controller: ProvedController,
    conditions: Conditions,
    errors: SampledErrors,
    start: tuple[Array, Array, Array],
    *,
    off: Array,
    noise: Array,
) -> LateStart | None:
    """Return what a run is like as its first input acts; None where that is not found.

    Args:
        controller: With the gains of `errors`.
        conditions: Of which disturbances count.
        errors: Of a loop with inputs that are late.
        start: x(0), x̂(0) and η̂(0).
        off: How far x̂(0) may be from that, (n,).
        noise: How much is measured off at most, (q,).
    """
    try:
        with np.errstate(all="ignore"):  # what is out of range is not found
            return _Waiting(controller, conditions, errors, start).found(off, noise)
    except CheckFailed:
        return None


class _Waiting:
    """The walk of (x, η, w, disturbance, 1) as long as no input may act, and the predictions c beside it."""

    def __init__(
        self,
        controller: ProvedController,
        conditions: Conditions,
        errors: SampledErrors,
        start: tuple[Array, Array, Array],
    ) -> None:
        gains, (x, x_hat, self._eta) = errors.gains, start
        sampling = Sampling(sample_time=gains.sample_time, delay=gains.delay)
        self._runs = program(controller, Conditions(sampling=sampling))
        self._controller, self._errors = controller, errors
        self._parts, self._step = gains.substeps, gains.sample_time / gains.substeps
        self._count, self._late = gains.delay * gains.substeps, OffTime.of(gains)
        loads = LoadsAlong.of(controller, conditions, gains)  # what steps as the first input acts steps after it
        self._loads = replace(loads, steps={tick: s for tick, s in loads.steps.items() if tick < gains.delay})
        self._trajectory, self._n = with_loads(controller, self._loads), len(x)
        self._x_hat = np.concatenate([x_hat, np.zeros(len(loads.start))])
        plant = controller.plant
        self._laws = np.array([np.pad(A.floats, ((0, 1), (0, 1))) for A in plant.observed.A])
        self._laws[:, : self._n, -1] = plant.model.b  # F of (x̃, s̃, 1) in each cell of the program, without input
        self._flow, self._trace = self._walked(conditions, x)
        self._c, self._cells, self._last = self._predicted(self._trace.z[:, : self._n] @ plant.C.T)

    def _walked(self, conditions: Conditions, x: Array) -> tuple[Flow, Trace]:
        """Return the flow of what is walked, and its samples: one as each substep begins, and the last."""
        trajectory, disturbance, n, p = self._trajectory, conditions.disturbance, self._n, len(self._eta)
        plant, model, w = self._controller.running, self._controller.plant, trajectory.exosystem
        S, d = (np.zeros((0, 0)), np.zeros(0)) if disturbance is None else (disturbance.S, disturbance.w0)
        F0 = block_diag(np.zeros((n + p, n + p)), w.S, S, np.zeros((1, 1)))
        order, own = len(F0), n + p + len(w.w0)
        resets = [each.behind(n + p) for each in w.resets]
        if disturbance is not None:
            F0[:n, own:-1] = disturbance.Q
            resets += [each.behind(own) for each in disturbance.resets]
        field, moves = np.zeros((len(plant.A), order, order)), np.zeros((len(trajectory.rate), order, order))
        field[:, :n, :n], field[:, :n, -1] = plant.A, plant.b
        moves[:, n : n + p] = self._wide(trajectory.rate, order)
        guards, signs = self._wide(trajectory.guards, order), trajectory.signs
        of_x_d = SwitchedPart(name="x_d", cells=model.cell_names, guards=guards, signs=signs, F=moves)
        flow = Flow(F0=F0, parts=(SwitchedPart.of("plant", plant, np.eye(n, order), field), of_x_d))
        z0, count = np.concatenate([x, self._eta, w.w0, d, [1.0]]), self._count + self._late.near
        times = {"duration": count * self._step, "sample_time": self._step}
        return flow, next(trace_blocks(flow, z0, **times, resets=resets, most=count + 1))

    def _wide(self, rows: Array, order: int) -> Array:
        """Return rows on (η, w, 1) as rows on all that is walked."""
        found = np.zeros((*rows.shape[:-1], order))
        found[..., self._n : self._n + rows.shape[-1] - 1], found[..., -1] = rows[..., :-1], rows[..., -1]
        return found

    def _predicted(self, y: Array) -> tuple[Array, IntArray, Array]:
        """Return the predictions as each substep begins, (K, d, N), in which cells, and those as the first input comes.

        The newest comes first; up to the tick at which one is made it is the start of the observer.
        """
        runs, (m, n) = self._runs, self._runs.K.shape
        v, found, where = np.tile(self._x_hat, (runs.sampling.delay, 1)), list[Array](), list[IntArray]()
        ends = [v]
        for j in range(len(y) - 1):
            if j % self._parts == 0:
                v = np.vstack([v[0] + runs.M @ (runs.C @ v[0] - y[j]), v[:-1]])
            found.append(v)
            where.append(cells(runs.signs, v[:, :n] @ runs.H.T + runs.h))
            known = np.pad(np.pad(v, ((0, 0), (m, 0))), ((0, 0), (0, 1)), constant_values=1.0)
            v = np.einsum("dNk,dk->dN", runs.observer[where[-1]], known)
            ends.append(v)
        return np.array(found), np.array(where), ends[self._count]

    def _segments(self) -> tuple[IntArray, Segments]:
        """Return the substep of each segment, and segments with predictions before ζ."""
        segments, laws, (K, d, N) = Segments.of(self._flow, self._trace), self._laws, self._c.shape
        before = segments.t < (K - _ON_TICK) * self._step
        t, number, order = segments.t[before], segments.number[before], segments.F.shape[1]
        at = np.floor(t / self._step + _ON_TICK).astype(np.int64)
        kinds, kind = np.unique(np.column_stack([number, self._cells[at]]), axis=0, return_inverse=True)
        F = np.zeros((len(kinds), d * N + order, d * N + order))
        for F_k, (of, *here) in zip(F, kinds.tolist(), strict=True):
            F_k[: d * N, : d * N], F_k[d * N :, d * N :] = block_diag(*laws[here, :N, :N]), segments.F[of]
            F_k[: d * N, -1] = laws[here, :N, -1].ravel()
        since = np.maximum(t - at * self._step, 0.0)
        c = np.pad(self._c[at], ((0, 0), (0, 0), (0, 1)), constant_values=1.0)
        for each, s, here in zip(c, since, self._cells[at], strict=True):
            each[:] = [expm(laws[i] * s) @ one for i, one in zip(here, each, strict=True)] if s else each
        return at, replace(
            segments,
            modes=tuple((*segments.modes[of], *here) for of, *here in kinds.tolist()),
            F=F,
            number=kind.reshape(-1).astype(np.int64),
            t=t,
            zeta=np.hstack([c[:, :, :N].reshape(len(at), d * N), segments.zeta[before]]),
            length=segments.length[before],
            reading=np.asarray,
        )

    def _rows(self, mode: Mode) -> Array:
        """Return rows on (predictions, what is walked).

        They are what is tracked, −u_ff, the newest x̃ − x, y; x', y' and e'; and predictions.
        """
        (d, N), n, order, plant = self._c.shape[1:], self._n, self._trace.z.shape[1], self._controller.plant
        x, seen, turns = np.eye(n, order), np.eye(d * N, d * N + order), self._flow.matrix(mode[:2])
        e = x - self._wide(self._trajectory.x_d[mode[1]], order)
        tracked = e if self._controller.tracking == "state" else plant.tracked @ e
        walked = [tracked, -self._wide(self._trajectory.u_ff[mode[1]], order), -x, plant.C @ x]
        walked += [rows @ turns for rows in (x, plant.C @ x, e)]
        found = np.vstack([np.pad(np.vstack(walked), ((0, 0), (d * N, 0))), seen])
        found[len(tracked) + plant.B.shape[1] :][:n] += seen[:n]
        return found

    def found(self, off: Array, noise: Array) -> LateStart | None:
        """Return what is asked for, from x̂(0) that may be so far off, with so much that is measured off."""
        (_, d, N), (n, m), q, K = self._c.shape, self._controller.plant.B.shape, len(noise), self._count
        at, segments = self._segments()
        each, kind = spans(segments, self._rows).in_steps(at), self._controller.tracking
        ends = np.stack([each.low, each.high])
        tracked = ends.shape[2] - d * N - 2 * (n + q) - n - m
        signals, y, rates, c = np.split(ends, np.cumsum([tracked + m + n, q, 2 * n + q]), axis=2)
        most, rates = (self._late.most(np.abs(some).max(axis=0))[:K] for some in (signals, rates))
        moved = np.split(self._late.theta * rates, [n, n + q], axis=1)  # x, y and e, up to half of the jitter later
        missed = moved[1].max(axis=0)
        between, kept, last, clear = self._off(c[:, :K].reshape(2, K, d, N), off, noise + missed)
        if not (np.isfinite(between).all() and np.isfinite(rates).all()):
            return None
        most[:, tracked + m :] += between[:, 0, :n] + moved[0]
        forms: list[Form] = [*((kind, k) for k in range(tracked)), *(("input", k) for k in range(m))]
        forms += [("estimate", k) for k in range(n)]
        z, end = np.zeros(self._errors.order), self._trace.z[K]  # just before the first input acts, without noise
        z[:n] = end[:n] - self._wide(self._trajectory.x_d[self._trace.modes[K, 1]], len(end)) @ end
        loads = n + len(self._eta) + len(self._trajectory.exosystem.w0)
        z[n + m : n + m + d * N] = (self._last - np.concatenate([end[:n], end[loads - (N - n) : loads]])).ravel()
        if self._errors.more and self._errors.more[-1]:
            own = memory(self._runs, self._x_hat, self._eta)["memory"][self._runs.places["eta_hat"]]
            z[-len(own) :] = own - Held(self._runs, self._eta, self._loads).take(d + 1).eta_hat[d]
        made = np.arange(d) <= np.arange(K)[:, None] // self._parts  # a prediction that there is
        c, start = c[:, :K].reshape(2, K, d, N), np.pad(off, (0, N - n))
        seen = joined(
            _hull(np.stack([c[0] - kept, c[1] + kept])[:, made]),
            np.column_stack([self._x_hat - start, self._x_hat + start]),
        )
        along = {"x_hat": seen[:n], "y": _hull(np.stack([y[0] - noise, y[1] + noise])), "u": np.zeros((m, 2))}
        return LateStart(
            z=z,
            off=np.concatenate([np.zeros(n + m), last.ravel(), np.zeros(self._errors.order - n - m - d * N)]),
            moved=moved[2][-1],
            missed=missed,
            beside=dict(zip(forms, most.T, strict=True)),
            along=along | ({"s_hat": seen[n:]} if n < N else {}),
            clear=clear,
        )

    def _off(self, c: Array, off: Array, noise: Array) -> tuple[Array, Array, Array, float]:
        """Return how large ε is in each substep, (K, d, N); c is between its ends, (2, …).

        Then how far all predictions are off c as they begin and end, likewise; ε in the end, (d, N); and how many sizes
        more they may be off in each substep, and no other cell is met.
        """
        (_, K, d, N), runs, laws, sizes = c.shape, self._runs, self._laws, self._controller.sizes
        keeps, (between, kept), clear = np.abs(np.eye(N) + runs.M @ runs.C), np.zeros((2, K, d, N)), np.inf
        r, more, added = np.zeros((3, d, N))  # ε, what noise adds, and what a size more at each tick does
        r[:, : self._n] = off
        for j in range(K):
            if j % self._parts == 0:
                r = np.vstack([keeps @ r[0], r[:-1]])
                more = np.vstack([keeps @ more[0] + np.abs(runs.M) @ noise, more[:-1]])
                added = np.vstack([keeps @ added[0], added[:-1]])
            added, kept[j] = added + np.concatenate([sizes.state, sizes.load]), r + more
            for i, here in enumerate(self._cells[j]):
                reached = self._reached(self._c[j, i], r[i] + more[i], added[i])
                met = [here, *(k for k in np.flatnonzero(reached <= 0).tolist() if k != here)]
                clear = min(clear, float(reached[reached > 0].min(initial=np.inf)))
                turn = np.abs(runs.observer[met, :, -N - 1 : -1]).max(axis=0)
                D, ends = (laws[met] - laws[here])[:, :N], c[:, j, i]
                size = np.abs(D[:, :, :-1] @ ends.mean(axis=0) + D[:, :, -1])
                driven = self._step * (size + np.abs(D[:, :, :-1]) @ ((ends[1] - ends[0]) / 2)).max(axis=0)
                if r[i].any() or driven.any():
                    grown = expm(np.abs(laws[met, :N, :N]).max(axis=0) * self._step)
                    between[j, i], r[i] = grown @ (r[i] + driven), turn @ r[i] + grown @ driven
                more[i], added[i] = turn @ more[i], turn @ added[i]
            kept[j] = np.maximum(kept[j], r + more)
        return between * OVER_SUMS, kept * OVER_SUMS, r * OVER_SUMS, clear

    def _reached(self, c: Array, off: Array, added: Array) -> Array:
        """Return how often `added` beside what is so far from c may be till a cell is reached, (l,); 0 where it is."""
        H, h, signs, c = self._runs.H, self._runs.h, self._runs.signs, c[: self._n]
        sizes = np.maximum(np.abs(c), self._controller.sizes.state)
        wide = np.abs(H) @ (off[: self._n] + _ROUNDED * sizes) + _ROUNDED * np.abs(h)
        beyond = np.maximum(-signs * (H @ c + h) - wide * np.abs(signs), 0.0)
        return np.asarray((beyond / (np.abs(H) @ added[: self._n])).max(axis=1, initial=0.0))


def _hull(ends: Array) -> Array:
    """Return between what all of some numbers are that are between two ends, (2, …, k): (k, 2)."""
    low, high = ends.reshape(2, -1, ends.shape[-1])
    return np.column_stack([low.min(axis=0), high.max(axis=0)])
