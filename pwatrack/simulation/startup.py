"""Where a controller starts that is switched on: its observer from what is measured, its generator in steady state."""

import numpy as np

from pwatrack.arrays import Array
from pwatrack.causes import ProblemPart, Subject
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.trajectory import DesiredTrajectory, output_trajectory
from pwatrack.errors import InvalidSpec, PwatrackError
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.model.sizes import Sizes
from pwatrack.simulation.closed_loop import ClosedLoop
from pwatrack.simulation.desired import desired_flow
from pwatrack.simulation.steady_state import LONGEST_PERIOD, periodic_state

_GENERATOR: Subject = (ProblemPart.GENERATOR_START,)


def measured_start(loop: ClosedLoop, x: Array) -> Array:
    """Return x̂(0) from what is measured at x(0), with its noise: in sizes the smallest x̂ with C x̂ nearest to it."""
    y, C = loop.plant.C @ x, loop.controller.plant.C
    if loop.conditions.noise is not None:
        (drawn,) = (reset.values[0] for reset in loop.resets(0.0) if reset.where == loop.at.v)
        y = y + drawn
    if loop.conditions.quanta is not None:
        y = loop.conditions.quanta.measured(y)
    return np.asarray(from_measured(loop.controller.sizes, C) @ y)


def from_measured(sizes: Sizes, C: Array) -> Array:
    """Return the matrix (n, q) of x̂ = X y: in sizes the smallest x̂ with C x̂ nearest to y."""
    inverse = np.linalg.pinv(C * sizes.state / sizes.output[:, None])
    return np.asarray(sizes.state[:, None] * inverse / sizes.output)


def consistent_start(trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None) -> tuple[Array, str]:
    """Return an η̂(0), (p,), that makes no transient where there is one, and what it is where it is no steady state.

    It is the one of `steady_start`; where that is not found the one at which the generator rests for y_d as it is at
    t = 0; 0 where that is not found either.
    """
    nothing = np.zeros(len(trajectory.names))
    if generator is None or not trajectory.names:
        return nothing, ""
    try:
        return steady_start(trajectory, generator), ""
    except PwatrackError as none:
        why = "; ".join(problem.message for problem in none.problems)
    at_first = exosystem([Signal.of(float(value)) for value in trajectory.exosystem(0.0)])
    try:
        rest = steady_start(output_trajectory(generator, at_first), generator)
    except PwatrackError:
        return nothing, f"{why}; the generator starts at 0"
    return rest, f"{why}; the generator starts where it rests while the reference stays as it is at t = 0"


def steady_start(trajectory: DesiredTrajectory, generator: TrajectoryGenerator) -> Array:
    """Return η̂(0) on the steady state of the generator (15) for the reference as it begins, (p,).

    That is its equilibrium where the reference begins at rest, and its periodic orbit where it begins with sinusoids
    that have a common period. (17) makes either unique.

    Raises:
        InvalidSpec: If the reference begins in another way.
        OutsideTheory: If none is found.
    """
    period, exosystem = trajectory.exosystem.begins(), trajectory.exosystem
    if period is None:
        raise _refused("the reference begins neither at rest nor as a sum of sinusoids with a common period")
    radians = float(np.abs(exosystem.rates.imag).max(initial=0.0)) * period
    if radians > LONGEST_PERIOD:
        message = f"the reference begins with a period of {period:.3g} s, {radians:.3g} rad of the fastest sinusoid"
        raise _refused(f"{message}; up to {LONGEST_PERIOD:.0e} are followed")
    if not period:  # at rest: any time is a period, and after this one deviations are clearly smaller
        period = 1 / generator.rate
    guess = np.concatenate([np.zeros(len(trajectory.names)), exosystem.w0, [1.0]])
    flow = desired_flow(generator.form.plant, trajectory)
    found = periodic_state(flow, guess, free=len(trajectory.names), period=period, subject=_GENERATOR, remedy=None)
    return found.z[0, : len(trajectory.names)]


def _refused(message: str) -> InvalidSpec:
    return InvalidSpec(message, subject=_GENERATOR)
