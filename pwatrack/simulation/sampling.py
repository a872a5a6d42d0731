"""The controller as a program: it reads, computes and writes once in a sample time; the plant goes on in between."""

from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.model.conditions import Sampling
from pwatrack.simulation.actuator import Actuator
from pwatrack.simulation.flow import Clock, Flow, SwitchedMap
from pwatrack.simulation.layout import Layout


def sampled(flow: Flow, sampling: Sampling, at: Layout, *, measured: Array, law: Array) -> Flow:
    """Return a closed loop whose controller runs at every multiple of a sample time.

    At each tick the program steps observer and generator on from the last tick, in the cells they were in then,
    with the input and the measured output that it holds. Then it measures and computes the new input, and
    cuts it off at the limits of the actuator; where it is late, the input goes behind those that wait, and the first of
    them is put out. The first tick, at t = 0, has no step.

    Args:
        flow: The same loop, where observer and generator move in continuous time under held u, y and w.
        sampling: The sample time, and how to step.
        at: Where everything sits in z.
        measured: Rows of the measured output, (q, N).
        law: Rows of the input (10) or (19) by the cell of x_d, (l, m, N).
    """
    z = np.eye(at.order)
    plant, observer, generator, *_ = flow.parts
    actuators = [part for part in flow.parts if isinstance(part, Actuator)]
    step, read, cut = z.copy(), z.copy(), z.copy()
    program, control = np.zeros((len(generator.F), *z.shape)), np.zeros((len(generator.F), *z.shape))
    step[at.x_hat], step[at.eta_hat], step[at.w_held] = 0.0, 0.0, z[at.w]
    program[:, at.eta_hat] = [_step(F + _rows(flow.F0, at.w_held), sampling)[at.eta_hat] for F in generator.F]
    estimate = np.zeros_like(observer.F)
    estimate[:, at.x_hat] = [_step(F + _rows(flow.F0, at.x_hat), sampling)[at.x_hat] for F in observer.F]
    m, waiting = at.u.stop - at.u.start, slice(at.u.start, at.late.stop)
    read[at.y] = measured
    read[waiting] = np.vstack([z[at.late], np.zeros((m, at.order))])  # each moves up by one
    control[:, at.computed] = law
    maps = [
        SwitchedMap(J0=step, parts={"observer": estimate, "generator": program}),
        SwitchedMap(J0=read, parts={"generator": control}),
    ]
    cuts = {}
    for part in actuators:
        row = at.computed.start + part.input
        cut[row] = 0.0
        cuts[part.name] = np.zeros((len(part.cells), *z.shape))
        for j, level in enumerate(part.levels):
            cuts[part.name][j, row] = z[row] if level is None else level * z[-1]
    if cuts:
        maps.append(SwitchedMap(J0=cut, parts=cuts))

    F0 = flow.F0.copy()
    F0[at.x_hat], F0[at.w_held] = 0.0, 0.0
    still = [replace(part, F=np.zeros_like(part.F)) for part in (observer, generator, *actuators)]
    return Flow(F0=F0, parts=(plant, *still), clock=Clock(period=sampling.sample_time, maps=tuple(maps), first=1))


def _rows(F: Array, where: slice) -> Array:
    """Return F with all other rows 0."""
    kept = np.zeros_like(F)
    kept[where] = F[where]
    return kept


def _step(F: Array, sampling: Sampling) -> Array:
    """Return the map of one sample time under ż = F z."""
    F = F * sampling.sample_time
    step: Array = expm(F) if sampling.method == "exponential" else np.eye(len(F)) + F
    return step
