"""The periodic steady state of a convergent flow, by Newton's method on the period map."""

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array, balancing
from pwatrack.errors import OutsideTheory, Problem
from pwatrack.simulation.flow import Flow
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.simulation.trace import Trace

_TOLERANCE = 1e-11  # of the largest state, after one period
_MOST_STEPS = 50
_SINGULAR = 1e-10  # relative distance from 1 at which a multiplier of the period map counts as 1


def periodic_state(flow: Flow, z0: Array, *, free: int, period: float, samples: int = 400) -> Trace:
    """Return one period of the periodic solution of a flow driven by a periodic exosystem.

    The field is continuous, so crossing a facet multiplies the sensitivity by
    the identity, and the derivative of the period map is the product of the
    matrix exponentials of the stays in each mode: exact.

    Args:
        flow: The flow.
        z0: A first guess (N,); its entries from `free` on (the exosystem and
            the constant) are kept and repeat after one period by themselves.
        free: The number of leading coordinates to solve for.
        period: In s.
        samples: Samples in the period.

    Raises:
        OutsideTheory: If Newton's method does not settle, or 1 is a multiplier of the period map.
    """
    z = z0.copy()
    for _ in range(_MOST_STEPS):
        trace = simulate_flow(flow, z, duration=period, sample_time=period / samples)
        residual = trace.z[-1, :free] - z[:free]
        if np.abs(residual).max(initial=0.0) <= _TOLERANCE * max(np.abs(trace.z).max(), 1e-300):
            return trace
        monodromy = np.eye(len(z))
        for mode, start, end in trace.stays():
            monodromy = expm(flow.matrix(mode) * (end - start)) @ monodromy
        gap = np.eye(free) - monodromy[:free, :free]
        d = balancing(monodromy[None, :free, :free])
        least = float(np.linalg.svd(gap / d[:, None] * d, compute_uv=False)[-1])
        if least < _SINGULAR * max(1.0, float(np.linalg.norm(monodromy[:free, :free] / d[:, None] * d))):
            break
        z[:free] += np.linalg.solve(gap, residual)
    raise OutsideTheory(
        Problem(
            message=f"no periodic solution of period {period:.6g} s was found: the state still moves by "
            f"{np.abs(residual).max():.2g} in one period",
            subject=("reference", "start"),
            hint="the plant may not converge by itself, or be in resonance: give x_d(0) as start instead",
        )
    )
