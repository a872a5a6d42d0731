"""The controller as a program: it reads, computes and writes once in a sample time; the plant goes on in between."""

from dataclasses import replace

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.control.program import SampledController
from pwatrack.model.conditions import Conditions
from pwatrack.simulation.flow import Clock, Flow
from pwatrack.simulation.layout import Layout


def sampled(flow: Flow, program: SampledController, conditions: Conditions, at: Layout, *, measured: Array) -> Flow:
    """Return a closed loop whose controller runs at every multiple of a sample time.

    At each tick the program steps observer and generator on from the last tick, in the cells they were in then,
    with the input and the measured output that it holds. Then it measures and computes the new input, keeps it from
    changing too fast, and cuts it off at the limits of the actuator; where it is late, the input goes behind those
    that wait, and the first of them is put out. What is measured and what is put out are whole multiples of their
    quanta. The first tick, at t = 0, has no step. In every operation it is the program of `docs/arithmetic.md`.

    Args:
        flow: The same loop, where observer and generator move in continuous time under held u, y and w.
        program: What runs.
        conditions: What the measured output is a multiple of.
        at: Where everything sits in z.
        measured: Rows of the measured output, (q, N).
    """
    F0 = flow.F0.copy()
    F0[at.observer], F0[at.w_held] = 0.0, 0.0
    still = [replace(part, F=np.zeros_like(part.F)) for part in flow.parts[1:]]
    (source, place), quanta = seen(program, at), conditions.quanta
    clock = Clock(
        program=program,
        measured=measured,
        quantum=np.zeros(len(measured)) if quanta is None else quanta.outputs,
        source=source,
        place=place,
        scale=np.ones(len(place)),
    )
    return Flow(F0=F0, parts=(flow.parts[0], *still), clock=clock)


def seen(program: SampledController, at: Layout) -> tuple[IntArray, IntArray]:
    """Return which numbers of the program are in z, and where."""
    names = {"y": at.y, "u": at.u, "x_hat": at.x_hat, "s_hat": at.s_hat, "eta_hat": at.eta_hat, "w": at.w_held}
    names |= {"late": at.late, "before": at.before, "wanted": at.wanted, "change": at.change}
    pairs = [(program.places[name], where) for name, where in names.items() if where.stop > where.start]
    source = [np.arange(of.start, of.stop) for of, _ in pairs]
    return np.concatenate(source), np.concatenate([np.arange(where.start, where.stop) for _, where in pairs])
