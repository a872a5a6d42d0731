"""The cells that x_d(t) visits, and when: x_d by itself, walked from facet to facet."""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import block_diag

from pwatrack.arrays import Array
from pwatrack.causes import ProblemPart
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import Problem, Undecided
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import pieces, trace_blocks
from pwatrack.simulation.trace import Trace

STEPS = 2000  # from sample to sample, of a walk
_BLOCK = 500  # samples: a walk stops after the block in which something is found
_LONGEST = 5e6  # radians, or time constants, that a walk may take


def stays(
    plant: PWASystem, trajectory: DesiredTrajectory, z0: Array, duration: float
) -> Iterator[tuple[int, float, float]]:
    """Yield (cell, from, to) of each stay of x_d, long ones in parts."""
    cell, since = -1, 0.0
    for trace in blocks(plant, trajectory, z0, duration):
        cell = trace.first_mode[0] if cell < 0 else cell
        for event in trace.events:
            yield cell, since, event.t
            cell, since = event.after[0], event.t
        if trace.t[-1] > since:
            yield cell, since, float(trace.t[-1])
            since = float(trace.t[-1])
    if duration > since:
        yield cell, since, duration


def desired_flow(plant: PWASystem, trajectory: DesiredTrajectory) -> Flow:
    """Return the flow of (η̂, w, 1), with the cells of x_d."""
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    F0 = block_diag(np.zeros((p, p)), system.S, np.zeros((1, 1)))
    F = np.zeros((len(plant.A), *F0.shape))
    F[:, :p] = trajectory.rate
    part = SwitchedPart(name="x_d", cells=plant.cell_names, guards=trajectory.guards, signs=trajectory.signs, F=F)
    return Flow(F0=F0, parts=(part,))


def blocks(
    plant: PWASystem, trajectory: DesiredTrajectory, z0: Array, duration: float, *, steps: int = STEPS
) -> Iterator[Trace]:
    """Walk (η̂, w, 1) for a time, with the cells of x_d.

    Args:
        plant: It has the cells.
        trajectory: What is walked.
        z0: Where it starts.
        duration: In s.
        steps: From sample to sample.

    Raises:
        Undecided: If that would take too long.
        CheckFailed: As `simulate_flow`.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    radians = float(np.abs(system.rates.imag).max(initial=0.0)) * duration
    if radians > _LONGEST:
        raise Undecided(
            Problem(
                message=f"x_d is not followed from cell to cell: {radians:.3g} rad in {duration:.6g} s, "
                f"at most {_LONGEST:.0e} are walked",
                subject=(ProblemPart.REFERENCE,),
                hint="shorten the simulation, or choose frequencies with whole-number ratios: one period is enough",
            )
        )
    resets = pieces(system, slice(p, p + len(system.w0)))
    flow, step = desired_flow(plant, trajectory), duration / steps
    return trace_blocks(flow, z0, duration=duration, sample_time=step, resets=resets, most=_BLOCK)
