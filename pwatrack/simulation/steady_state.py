"""The periodic steady state of a convergent flow, by Newton's method on the period map; and where a controller starts.

It is switched on with its observer at what is measured, and its generator in steady state.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from pwatrack.arrays import TINY, Array, balancing
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.trajectory import DesiredTrajectory, output_trajectory
from pwatrack.errors import InvalidSpec, OutsideTheory, ProblemPart, PwatrackError, Remedy, Subject, Way
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.model.sizes import Sizes
from pwatrack.simulation.closed_loop import ClosedLoop
from pwatrack.simulation.desired import desired_flow
from pwatrack.simulation.flow import Flow
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.simulation.trace import Trace

LONGEST_PERIOD = 1e6  # radians in which a steady state is looked for

_SAMPLES = 400  # in the period
_TOLERANCE = 1e-11  # of what a state is made of, after one period
_MOST_STEPS = 50  # of Newton's method, which settles in a few or not at all
_GIVEN = Remedy(Way.DESIRED_START)
_GENERATOR: Subject = (ProblemPart.GENERATOR_START,)
_SINGULAR = 1e-10  # relative distance from 1 at which a multiplier of the period map counts as 1


@dataclass(frozen=True, kw_only=True)
class SteadyState(Trace):
    """One period of a periodic solution."""

    multipliers: npt.NDArray[np.complex128]  # Floquet multipliers, of deviations in one period, largest first, (free,)
    # by how much a state misses itself after one period, at most, relative to the terms of its sum then: what
    # each state at the start leaves in it
    residual: float


def periodic_state(
    flow: Flow,
    z0: Array,
    *,
    free: int,
    period: float,
    subject: Subject = (ProblemPart.START,),
    remedy: Remedy | None = _GIVEN,
) -> SteadyState:
    """Return one period of the periodic solution of a flow driven by a periodic exosystem.

    The field is continuous, so crossing a facet multiplies the sensitivity by the identity, and the derivative of the
    period map is the product of the matrix exponentials of the stays in each mode, with no difference quotient.

    Of the first guess z0, (N,), the leading `free` coordinates are solved for; the others (the exosystem and the
    constant) are kept, and repeat after one period by themselves. `subject` and `remedy` are what a refusal is about,
    and what may help. Raises OutsideTheory if Newton's method does not settle, or 1 is a multiplier of the period map.
    """
    z, found = z0.copy(), None
    for _ in range(_MOST_STEPS):
        trace = simulate_flow(flow, z, duration=period, sample_time=period / _SAMPLES)
        miss = trace.z[-1, :free] - z[:free]
        whole, most = period_map_derivative(flow, trace), np.abs(trace.z).max(axis=0)
        terms = (most + np.abs(whole) @ most)[:free]
        residual = float((np.abs(miss) / np.maximum(terms, TINY)).max(initial=0.0))
        monodromy = whole[:free, :free]
        if residual <= _TOLERANCE:
            multipliers = np.linalg.eigvals(monodromy).astype(np.complex128)
            multipliers = multipliers[np.argsort(-np.abs(multipliers))]
            last, found = found, SteadyState(**vars(trace), multipliers=multipliers, residual=residual)
            if last is not None or not free:  # one step more: what is small beside its terms settles too
                return found
        gap = np.eye(free) - monodromy
        d = balancing(monodromy[None])
        least = float(np.linalg.svd(gap / d[:, None] * d, compute_uv=False)[-1])
        if least < _SINGULAR * max(1.0, float(np.linalg.norm(monodromy / d[:, None] * d))):
            break
        z[:free] += np.linalg.solve(gap, miss)
    if found is not None:
        return found
    raise OutsideTheory(
        f"no periodic solution of period {period:.6g} s was found: the state still moves by "
        f"{np.abs(miss).max():.2g} in one period",
        subject=subject,
        hint="the plant may not converge by itself, or be in resonance",
        remedy=remedy,
    )


def period_map_derivative(flow: Flow, trace: Trace) -> Array:
    """Return the derivative of the last state of a trace with respect to its first, (N, N)."""
    product = flow.relative(np.eye(trace.z.shape[1])).T
    for mode, start, end in trace.stays():
        product = expm(flow.matrix(mode) * (end - start)) @ product
    return flow.absolute(product.T).T


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
    that have a common period. (17) makes either unique. Raises InvalidSpec if the reference begins in another way;
    OutsideTheory if none is found.
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
