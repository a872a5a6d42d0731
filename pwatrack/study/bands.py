"""How large each signal of a run may be over time, proved for what acts in it: the bands of its pictures."""

from dataclasses import replace

import numpy as np

from pwatrack.arrays import OVER_SUMS, Array
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import Controller
from pwatrack.control.envelope import from_start, with_acting
from pwatrack.model.conditions import Conditions
from pwatrack.simulation.actuator import Actuator
from pwatrack.simulation.closed_loop import ClosedLoop, Response
from pwatrack.spec.box import Box, inside


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
    conditions, controller = loop.conditions, loop.controller
    free = replace(conditions, limits=None) if not _limited(loop, response) else conditions
    with_noise = replace(free, disturbance=None, noise=None)
    n, first = len(controller.plant.B), response
    start = np.concatenate([first.x[0] - first.x_d[0], first.x_hat[0] - first.x[0], _estimates_off(loop, response)])
    if with_noise.nominal:
        most = from_start(controller.bounds, controller.starts, start, response.t, states=n)
        _with_norms(most, loop, response, start)
        found = _played_back(controller, with_acting(most, controller.bounds, _acting(loop, response)))
        if controller.practical is None:
            return found
        left = controller.practical.final  # what merged cells leave comes on top
        return {form: values + left[form] for form, values in found.items() if form in left}
    robust = controller.robust
    if robust is None or w is None or not covered(box, free):
        return {}
    most = from_start(robust.bounds, (), start, response.t, states=n)
    acting: dict[Channel, Array] = {bounds.channel: w[:, bounds.channel[1]] for bounds in robust.bounds}
    return _played_back(controller, with_acting(most, robust.bounds, acting))


def _played_back(controller: Controller, found: dict[Form, Array]) -> dict[Form, Array]:
    """Return bounds with what is added by an η that is played back."""
    left = controller.left_by_signal
    return (
        {form: v + left[form] for form, v in found.items() if form in left} if controller.trajectory.preview else found
    )


def _with_norms(most: dict[Form, Array], loop: ClosedLoop, response: Response, start: Array) -> None:
    """Lower the bounds of errors to what the norms of (8) and (9) say of them."""
    promised, sizes, n = loop.controller.guarantees, loop.controller.sizes.state, len(loop.controller.plant.B)
    if start[2 * n :].any():
        return  # they are about loads that are known
    output = loop.controller.tracking == "output"
    tracking = promised.tracking_error(response.t, start[:n], start[n : 2 * n], output=output)
    observer, counted = promised.observer_error(response.t, start[n : 2 * n]), sizes if n > 1 else np.ones(1)
    for form in list(most):
        kind, k = form
        if kind in ("output", "state"):
            most[form] = np.minimum(most[form], tracking * loop.controller.error_sizes[k] * OVER_SUMS)
        elif kind == "estimate" and k < n:
            most[form] = np.minimum(most[form], observer * counted[k] * OVER_SUMS)


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
