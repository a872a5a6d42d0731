"""The periodic steady state of a convergent flow, by Newton's method on the period map."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from pwatrack.arrays import Array, balancing
from pwatrack.causes import ProblemPart, Remedy, Subject, Way
from pwatrack.errors import OutsideTheory
from pwatrack.simulation.flow import Flow
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.simulation.trace import Trace

LONGEST_PERIOD = 1e6  # radians in which a steady state is looked for

_SAMPLES = 400  # in the period
_TOLERANCE = 1e-11  # of the largest state, after one period
_MOST_STEPS = 50  # of Newton's method, which settles in a few or not at all
_GIVEN = Remedy(Way.DESIRED_START)
_SINGULAR = 1e-10  # relative distance from 1 at which a multiplier of the period map counts as 1


@dataclass(frozen=True, kw_only=True)
class SteadyState(Trace):
    """One period of a periodic solution."""

    # Floquet multipliers: what small deviations are multiplied by in one period, the eigenvalues of the derivative of
    # the period map, largest first, (free,)
    multipliers: npt.NDArray[np.complex128]
    residual: float  # by how much the state misses itself after one period, at most, relative to the largest state


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

    The field is continuous, so crossing a facet multiplies the sensitivity by
    the identity, and the derivative of the period map is the product of the
    matrix exponentials of the stays in each mode, with no difference quotient.

    Of the first guess z0, (N,), the leading `free` coordinates are solved for; the others (the exosystem and the
    constant) are kept, and repeat after one period by themselves. `subject` and `remedy` are what a refusal is about,
    and what may help.

    Raises:
        OutsideTheory: If Newton's method does not settle, or 1 is a multiplier of the period map.
    """
    z = z0.copy()
    for _ in range(_MOST_STEPS):
        trace = simulate_flow(flow, z, duration=period, sample_time=period / _SAMPLES)
        miss = trace.z[-1, :free] - z[:free]
        residual = float(np.abs(miss).max(initial=0.0) / max(np.abs(trace.z).max(), 1e-300))
        monodromy = period_map_derivative(flow, trace)[:free, :free]
        if residual <= _TOLERANCE:
            multipliers = np.linalg.eigvals(monodromy).astype(np.complex128)
            return SteadyState(
                **vars(trace), multipliers=multipliers[np.argsort(-np.abs(multipliers))], residual=residual
            )
        gap = np.eye(free) - monodromy
        d = balancing(monodromy[None])
        least = float(np.linalg.svd(gap / d[:, None] * d, compute_uv=False)[-1])
        if least < _SINGULAR * max(1.0, float(np.linalg.norm(monodromy / d[:, None] * d))):
            break
        z[:free] += np.linalg.solve(gap, miss)
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
