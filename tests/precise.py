"""Trajectories and event times in 50-digit arithmetic, to judge floating point by."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from flint import arb, arb_mat, ctx

from pwatrack.arrays import Array
from pwatrack.simulation.flow import Flow, Mode
from pwatrack.simulation.trace import Trace


@contextmanager
def digits(count: int) -> Iterator[None]:
    before, ctx.dps = ctx.dps, count
    try:
        yield
    finally:
        ctx.dps = before


def precise(flow: Flow, z0: Array, trace: Trace) -> tuple[Array, Array]:
    """Return samples (K, N) and event times of a trace, recomputed with 50 digits.

    The order of the modes is taken from the trace, and its event times are first guesses for Newton's
    method; everything else is worked out anew. That the order is right shows at the samples: every one
    of them must lie in the cells that the trace says, in 50 digits.
    """
    with digits(70):  # midpoints, rounded 70 digits down: 20 to spare
        z0 = flow.relative(z0)
        N = len(z0)
        F = {mode: arb_mat(flow.matrix(mode).tolist()) for mode in trace.visited()}
        step = arb(float(trace.t[1]))
        whole = {mode: (matrix * step).exp() for mode, matrix in F.items()}
        guards = [arb_mat([row]) for row in flow.guards().tolist()]
        z, t, k = arb_mat([[v] for v in z0.tolist()]), arb(0), 1
        samples, times = [z0], []

        def flown(mode: Mode, z: arb_mat, duration: arb) -> arb_mat:
            total, term, j = z, z, 1
            while j < 400 and (j < 4 or max(abs(float(term[i, 0])) for i in range(N)) > 1e-60):
                term = F[mode] * term * (duration / j)
                total, j = total + term, j + 1
            return total.mid()

        def sample(mode: Mode, z: arb_mat) -> None:
            sides = flow.sides(mode)
            for side, guard in zip(sides, guards, strict=True):
                assert side == 0 or float(side) * float((guard * z)[0, 0]) > -1e-13, "another mode"
            samples.append(np.array([float(z[i, 0]) for i in range(N)]))

        for event in [*trace.events, None]:
            mode = event.before if event else trace.events[-1].after if trace.events else trace.first_mode
            at = arb(event.t) if event else arb(np.inf)
            while k < len(trace.t) and (event is None or float(step * k - at) < 0):
                on_grid = t == step * (k - 1)
                z = (whole[mode] * z).mid() if on_grid else flown(mode, z, step * k - t)
                t, k = step * k, k + 1
                sample(mode, z)
            if event is None:
                break
            crossed = np.flatnonzero(flow.sides(event.before) * flow.sides(event.after) < 0)
            guard = guards[crossed[0]]
            for _ in range(4):
                there = flown(mode, z, at - t)
                move = (guard * there)[0, 0] / (guard * (F[mode] * there))[0, 0]
                at = (at - move).mid()
                if abs(float(move)) < 1e-30:
                    break
            z, t = flown(mode, z, at - t), at
            times.append(float(at))
        return flow.absolute(np.array(samples)), np.array(times)
