"""The controller as a program: it reads, computes and writes once in a sample time; the plant goes on in between."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.model.conditions import Conditions, Quanta, Sampling
from pwatrack.simulation.actuator import Actuator, RateLimit
from pwatrack.simulation.flow import Clock, Flow, SwitchedMap
from pwatrack.simulation.layout import Layout


def sampled(flow: Flow, conditions: Conditions, at: Layout, *, measured: Array, law: Array) -> Flow:
    """Return a closed loop whose controller runs at every multiple of a sample time.

    At each tick the program steps observer and generator on from the last tick, in the cells they were in then,
    with the input and the measured output that it holds. Then it measures and computes the new input, keeps it from
    changing too fast, and cuts it off at the limits of the actuator; where it is late, the input goes behind those
    that wait, and the first of them is put out. What is measured and what is put out are whole multiples of their
    quanta. The first tick, at t = 0, has no step.

    Args:
        flow: The same loop, where observer and generator move in continuous time under held u, y and w.
        conditions: Sample time, how to step, and quanta.
        at: Where everything sits in z.
        measured: Rows of the measured output, (q, N).
        law: Rows of the input (10) or (19) by the cell of x_d, (l, m, N).
    """
    sampling, quanta = conditions.sampling, conditions.quanta
    assert sampling is not None
    maps = [_stepped(flow, sampling, at), _read(flow, at, measured, law, quanta)]
    cuts = [[part for part in flow.parts if isinstance(part, kind)] for kind in (RateLimit, Actuator)]
    maps += [_cut_off(parts, at) for parts in cuts if parts]
    if quanta is not None and quanta.inputs.any():
        maps.append(SwitchedMap(J0=np.eye(at.order), parts={}, quantum=_at(at.computed, quanta.inputs, at)))
    F0 = flow.F0.copy()
    F0[at.observer], F0[at.w_held] = 0.0, 0.0
    still = [replace(part, F=np.zeros_like(part.F)) for part in flow.parts[1:]]
    return Flow(
        F0=F0, parts=(flow.parts[0], *still), clock=Clock(period=sampling.sample_time, maps=tuple(maps), first=1)
    )


def _stepped(flow: Flow, sampling: Sampling, at: Layout) -> SwitchedMap:
    """Return the map that steps observer and generator on, and holds the reference as it now is."""
    _, observer, generator, *_ = flow.parts
    step, program, estimate = np.eye(at.order), np.zeros_like(generator.F), np.zeros_like(observer.F)
    step[at.w_held] = step[at.w]
    step[at.observer], step[at.eta_hat] = 0.0, 0.0
    known = _rows(flow.F0, at.w_held)
    known[at.s_hat, at.s_hat] = flow.F0[at.s_hat, at.s_hat]
    program[:, at.eta_hat] = [_step(F + known, sampling)[at.eta_hat] for F in generator.F]
    estimate[:, at.observer] = [_step(F + _rows(flow.F0, at.observer), sampling)[at.observer] for F in observer.F]
    return SwitchedMap(J0=step, parts={observer.name: estimate, generator.name: program})


def _read(flow: Flow, at: Layout, measured: Array, law: Array, quanta: Quanta | None) -> SwitchedMap:
    """Return the map that measures the output and computes the input; those that wait move up by one."""
    generator, z = flow.parts[2], np.eye(at.order)
    read, control = z.copy(), np.zeros_like(generator.F)
    read[at.y] = measured
    read[at.u.start : at.late.stop] = np.vstack([z[at.late], np.zeros((law.shape[1], at.order))])
    control[:, at.computed] = law
    quantum = None if quanta is None else _at(at.y, quanta.outputs, at)
    return SwitchedMap(J0=read, parts={generator.name: control}, quantum=quantum)


def _cut_off(parts: Sequence[Actuator | RateLimit], at: Layout) -> SwitchedMap:
    """Return the map that replaces each computed input which is beyond a limit by that limit."""
    z = np.eye(at.order)
    cut, cuts = z.copy(), {}
    for part in parts:
        row, kept = at.computed.start + part.input, at.before.stop > at.before.start  # for the next comparison
        rows = [row] + [at.before.start + part.input] * kept
        cut[rows], cuts[part.name] = 0.0, np.zeros((len(part.cells), *z.shape))
        for cell, held in enumerate(part.held(z)):
            cuts[part.name][cell, rows] = z[row] if held is None else held
    return SwitchedMap(J0=cut, parts=cuts)


def _at(where: slice, values: Array, at: Layout) -> Array:
    """Return values at their place in z, and 0 elsewhere."""
    z = np.zeros(at.order)
    z[where] = values
    return z


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
