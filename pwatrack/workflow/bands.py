"""How large each signal of a run may be over time, proved for what acts in it: the bands of its pictures."""

from dataclasses import replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import Seen
from pwatrack.model.box import Box, inside
from pwatrack.model.conditions import Conditions
from pwatrack.simulation.actuator import Actuator
from pwatrack.simulation.closed_loop import ClosedLoop, Response


def covered(box: Box, conditions: Conditions) -> bool:
    """Say whether the plant of a run is one of a box that bounds are proved for, and nothing else is changed."""
    others = {name: value for name, value in vars(conditions).items() if name not in ("plant", "parameters")}
    return bool(box) and all(v is None for v in others.values()) and inside(box, conditions.parameters or {})


def bands(loop: ClosedLoop, response: Response, box: Box, w: Array | None) -> dict[Form, Array]:
    """Return what the proofs allow of each signal at the samples of a run, (K,); nothing where they are about another.

    They are about a run with disturbances and noise, also with limits that no input comes to, and about another plant
    if it is one of the box. What acts counts as large as it has been at the samples so far, noise as it ever gets.

    Args:
        loop: What ran.
        response: Its signals from the start on.
        box: The parameters that are uncertain.
        w: How large each entry of w is so far, (K, n), where there are some.
    """
    conditions, controller, first = loop.conditions, loop.controller, response
    free = replace(conditions, limits=None) if not _limited(loop, response) else conditions
    start = np.concatenate([first.x[0] - first.x_d[0], first.x_hat[0] - first.x[0], _estimates_off(loop, response)])
    seen = Seen(
        t=response.t,
        start=start,
        acting=_acting(loop, response),
        designed=replace(free, disturbance=None, noise=None).nominal,
        w=w if covered(box, free) else None,
    )
    found = dict[Form, Array]()
    for claim in controller.claims:
        found |= claim.allows(controller, seen)
    return controller.with_left(found)


def _limited(loop: ClosedLoop, response: Response) -> bool:
    """Say whether an input was at a limit."""
    visited = response.trace.visited()
    return any(
        isinstance(part, Actuator) and any(part.levels[mode[k]] is not None for mode in visited)
        for k, part in enumerate(loop.flow.parts)
    )


def _estimates_off(loop: ClosedLoop, response: Response) -> Array:
    """Return ŝ − s at the start; s = 0 where the disturbance is not what the loads are at all times."""
    loads, disturbance, at = loop.controller.plant.loads, loop.conditions.disturbance, loop.at
    s_hat = np.asarray(response.trace.z[0, at.s_hat])
    if loads is None or disturbance is None or not loads.are(disturbance):
        return s_hat
    s, rows = np.zeros(len(s_hat)), loads.truth(disturbance.Q, disturbance.rates)
    for load, row, group in zip(loads.each, rows, loads.groups, strict=True):
        s[group[0]] = row @ disturbance.w0
        if load.order == 2:
            s[group[1]] = row @ disturbance.S @ disturbance.w0 / float(load.frequency)
    return s_hat - s


def _acting(loop: ClosedLoop, response: Response) -> dict[Channel, Array]:
    """Return the largest size of each disturbance and noise so far, (K,); what loads make up is none."""
    conditions, at, acting = loop.conditions, loop.at, dict[Channel, Array]()
    loads, disturbance, z = loop.controller.plant.loads, conditions.disturbance, response.trace.z
    if disturbance is not None and not (loads is not None and loads.are(disturbance)):
        sizes = np.maximum.accumulate(np.abs(z[:, at.d] @ disturbance.Q.T))
        acting |= {("disturbance", k): sizes[:, k] for k in np.flatnonzero(disturbance.Q.any(axis=1)).tolist()}
    if conditions.noise is not None:
        drawn = next(resets for resets in loop.resets(float(response.t[-1])) if resets.where == at.v)
        largest = np.abs(drawn.values).max(axis=0)
        acting |= {("noise", k): np.full(len(z), size) for k, size in enumerate(largest.tolist()) if size}
    return acting
