"""How large each signal of a run may be over time, proved for what acts in it: the bands of its pictures."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.claims.robust import Robust
from pwatrack.claims.sampled_bounds import SampledBounds, TubeBounds
from pwatrack.claims.sampled_box import SampledBoxBounds
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import ProvedController, Seen
from pwatrack.model.conditions import Conditions
from pwatrack.real import Box, inside
from pwatrack.simulation.closed_loop import ClosedLoop, Response
from pwatrack.simulation.desired import along
from pwatrack.simulation.enclosure import Enclosing, Segments, enclosed
from pwatrack.simulation.flow import Mode
from pwatrack.simulation.layout import Actuator, RateLimit
from pwatrack.simulation.loads_along import loads_at_start, steps_of
from pwatrack.simulation.trace import Trace, tenths
from pwatrack.spec.spec import Spec

SIGMAS = 3.0  # of normal noise: 1 value in 370 is larger
_MOST_STEPS = 50  # of loads in a run, up to which each is looked at
_MOST_TOGETHER = 200_000  # rows times pieces: 100 MB while they are bounded


def covered(box: Box, conditions: Conditions) -> bool:
    """Say whether the plant of a run is one of a box that bounds are proved for, and nothing else is changed."""
    same = all(value is None for name, value in vars(conditions).items() if name not in ("plant", "parameters"))
    return bool(box) and same and inside(box, conditions.parameters or {})


def tube_bounds(controller: ProvedController, box: Box, conditions: Conditions) -> Sequence[TubeBounds]:
    """Return what bounds the errors of the sampled loop with the plant of a run; nothing where none is proved of it."""
    if not conditions.another_plant:
        return controller.claims_of(SampledBounds)
    return controller.claims_of(SampledBoxBounds) if box and inside(box, conditions.parameters or {}) else ()


def bands(loop: ClosedLoop, response: Response, box: Box, w: Array | None) -> dict[Form, Array]:
    """Return what the proofs allow of each signal at the samples of a run, (K,); nothing where they are about another.

    They are about a run with disturbances and noise, limits (of rates too) that no input comes to, and any plant of
    the box: then w (K, n) is how large each entry of w is so far; or about the sampled loop with all that acts. What
    acts counts as large as it was so far, noise as it ever gets.
    """
    conditions, controller = loop.conditions, loop.controller
    off_limits = not limited(loop, response)
    free = replace(conditions, limits=None) if off_limits else conditions
    steps = _steps(controller, conditions)
    seen = Seen(
        t=response.t,
        start=start_of_errors(loop, response),
        acting=_acting(loop, response, stepping=bool(steps)),
        steps=steps,
        designed=replace(free, disturbance=None, noise=None).nominal,
        w=w if covered(box, free) else None,
    )
    found = dict[Form, Array]()
    for claim in controller.claims:
        found |= claim.allows(controller, seen)
    as_it_runs = replace(seen, designed=False, w=None, sampled=True)
    for tubes in tube_bounds(controller, box, conditions) if off_limits else ():
        found |= tubes.allows(controller, as_it_runs)
    return controller.with_left(found)


def declared(spec: Spec, controller: ProvedController, *, always: bool = False) -> dict[Channel, float]:
    """Return how large noise, with half of a sensor's step, and each disturbance of a file is, enclosed; no load.

    A load that steps is none either, as what a step leaves goes to 0, but for what is said `always` and not in the end.
    """
    conditions, acting = spec.scenario.conditions.beside(controller.plant.loads), dict[Channel, float]()
    noise, quanta = conditions.noise, conditions.quanta
    disturbance = None if _steps(controller, conditions) and not always else conditions.disturbance
    sensors = np.zeros(len(controller.plant.C)) if noise is None else SIGMAS * noise.std
    sensors = sensors if quanta is None else sensors + quanta.outputs / 2
    acting |= {("noise", k): float(sensors[k]) for k in np.flatnonzero(sensors).tolist()}
    if disturbance is not None:
        rows = np.hstack([disturbance.Q, np.zeros((len(disturbance.Q), 1))])
        found = enclosed([along(disturbance, spec.scenario.duration)], lambda _: rows)
        sizes = np.maximum(np.abs(found.low), np.abs(found.high))
        acting |= {("disturbance", k): float(sizes[k]) for k in np.flatnonzero(sizes).tolist()}
    return acting


def limited(loop: ClosedLoop, response: Response) -> bool:
    """Say whether an input was at a limit, or changed as fast as it may."""
    visited = response.trace.visited()
    return any(
        (isinstance(part, Actuator) and any(part.levels[mode[k]] is not None for mode in visited))
        or (isinstance(part, RateLimit) and any(part.cells[mode[k]] != "free" for mode in visited))
        for k, part in enumerate(loop.flow.parts)
    )


def start_of_errors(loop: ClosedLoop, first: Response) -> Array:
    """Return (x − x_d, x̂ − x, ŝ − s) at the first sample; s = 0 where the disturbance is not at all times the loads."""
    s_hat, s = first.trace.z[0, loop.at.s_hat], loads_at_start(loop.controller, loop.conditions)
    return np.concatenate([first.x[0] - first.x_d[0], first.x_hat[0] - first.x[0], s_hat - s])


def _steps(controller: ProvedController, conditions: Conditions) -> tuple[tuple[float, Array], ...]:
    """Return when loads that are estimated step, and by what, where a disturbance is made of such steps, and of few."""
    loads, disturbance = controller.plant.loads, conditions.disturbance
    if loads is None or disturbance is None or loads.are(disturbance) or not loads.make(disturbance):
        return ()
    steps = tuple((t, step) for t, step, _ in steps_of(loads, disturbance))
    return steps if len(steps) <= _MOST_STEPS else ()


def _acting(loop: ClosedLoop, response: Response, *, stepping: bool) -> dict[Channel, Array]:
    """Return the largest size of each disturbance and noise so far, (K,); what loads make up is none."""
    conditions, at, acting = loop.conditions.beside(loop.controller.plant.loads), loop.at, dict[Channel, Array]()
    disturbance, z = conditions.disturbance, response.trace.z
    if disturbance is not None and not stepping:
        sizes = np.maximum.accumulate(np.abs(z[:, at.d] @ disturbance.Q.T))
        acting |= {("disturbance", k): sizes[:, k] for k in np.flatnonzero(disturbance.Q.any(axis=1)).tolist()}
    if conditions.noise is not None:
        drawn = next(resets for resets in loop.resets(float(response.t[-1])) if resets.where == at.v)
        largest = np.abs(drawn.values).max(axis=0)
        acting |= {("noise", k): np.full(len(z), size) for k, size in enumerate(largest.tolist()) if size}
    return acting


class Along:
    """Encloses each entry of what the plants of a box do otherwise along x_d, in each tenth of a run, block by block.

    That is w = f_p(x_d) − f(x_d) + (B_p − B) u_ff: in each cell of x_d, for each plant, rows of the flow of the loop;
    affine in the matrices, so one at a corner of the box has the largest. It is of all times, also between samples.
    """

    def __init__(self, loop: ClosedLoop, robust: Robust, samples: int) -> None:
        self._loop, self._of, self._differences = loop, robust.differences.of, robust.differences
        self._generator = [part.name for part in loop.flow.parts].index("generator")
        self._edges, self._number = tenths(samples), 0
        self._tenths = [Enclosing(self._rows) for _ in self._edges[1:]]
        self.w = np.zeros((len(self._tenths), len(loop.plant.B)))  # the largest size so far, in each tenth

    def see(self, trace: Trace) -> None:
        """Take the next block into account."""
        segments, first = Segments.of(self._loop.flow, trace), self._number
        self._number += len(trace.t)
        for k, enclosing in enumerate(self._tenths):
            start, end = (max(edge - first, 0) for edge in self._edges[k : k + 2])
            if start == end or start >= len(trace.t):
                continue
            until = trace.t[end] if end < len(trace.t) else np.inf
            for part in _parts(segments, float(trace.t[start]), float(until), len(self._of)):
                enclosing.see(part)
            found = enclosing.range()
            np.maximum.at(self.w[k], self._of, np.maximum(np.abs(found.low), np.abs(found.high)))

    def _rows(self, mode: Mode) -> Array:
        """Return the rows of w for each of the differences, (R, N)."""
        cell, D = mode[self._generator], self._differences
        return np.asarray(D.rows(cell, self._loop.x_d[cell]) + D.B @ self._loop.u_ff[cell])


def _parts(segments: Segments, start: float, end: float, rows: int) -> Iterator[Segments]:
    """Yield those that begin in a stretch of time, so many at a time as can be bounded together."""
    chosen, most = np.flatnonzero((segments.t >= start) & (segments.t < end)), max(_MOST_TOGETHER // max(rows, 1), 1)
    for k in range(0, len(chosen), most):
        some = chosen[k : k + most]
        yield replace(segments, **{n: getattr(segments, n)[some] for n in ("number", "t", "zeta", "length")})
