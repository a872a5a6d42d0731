"""Gains of a controller that runs once in a sample time: it predicts, measures, corrects, and acts in the same tick."""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.lmi.exact import rounded_down, short
from pwatrack.model.conditions import Sampling
from pwatrack.model.pwa import PWASystem

MOST_SUBSTEPS = 64  # of a prediction: more are no program for a machine
_SUBSTEPS = 2  # where a prediction may cross cells


@dataclass(frozen=True, kw_only=True)
class SampledGains:
    """What the program of `control.program` runs with where it predicts and corrects.

    At tick k: x̂_k = x̂⁻_k + M (C x̂⁻_k − y_k) and u_k = K (x̂_k − x_d(t_k)) + u_ff,k; then x̂⁻_{k+1} is predicted from
    x̂_k under u_k, in steps of h / substeps, each with the affine law of the cell in which it begins. With E, x̂_k is
    moved by E (u_k − what was wanted) before that, as far as limits cut u_k off.
    """

    K: Array  # (m, n), in the unit of an input per unit of a state
    M: Array  # (N, q), for states and estimates of loads
    sample_time: float  # h in s
    substeps: int = 1  # of one prediction, at least 1
    delay: int = 0  # how many samples late inputs are
    jitter: float = 0.0  # by how much the time between two ticks may differ from h, in s
    # a gain against windup, (N, m); (0, 0) where there is none
    E: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def passing(self, rate: float) -> float:
        """Return a rate (1/s) of the program's time as one of time as it passes, ticks as far apart as may be."""
        h, late = self.sample_time, self.jitter
        return rounded_down(rate * h / (h + late), 6) if late else rate

    @property
    def into(self) -> Array:
        """What x̂ and ŝ are moved by for what limits cut off, (N, m)."""
        return self.E if len(self.E) else np.zeros((len(self.M), len(self.K)))

    def of(self, sampling: Sampling) -> bool:
        """Say whether they are for this sample time, delay and jitter."""
        own = self.sample_time, self.delay, self.jitter
        return own == (sampling.sample_time, sampling.delay, sampling.jitter)


@np.errstate(all="ignore")
def sampled_gains(plant: PWASystem, K: Array, L: Array, sampling: Sampling) -> SampledGains:
    """Return the gains that do in a sample time what K and L do in continuous time, in the mean of all cells.

    K_h x is the mean of K x over a sample of x' = (A + B K) x, and M adds up what L corrects of x' = (A + L C) x.
    For short samples these are K and h L. Where L or K is fast beside the sample, they stay finite: M → −1 for one
    state that is measured.
    """
    h, C = sampling.sample_time, plant.observed.C.floats
    A, seen = plant.A.mean(axis=0), np.mean([A.floats for A in plant.observed.A], axis=0)
    return SampledGains(
        K=short(K @ _sum_of(A + plant.B @ K, h) / h),
        M=short(_sum_of(seen + L @ C, h) @ L),
        sample_time=h,
        substeps=1 if (plant.A[0] == plant.A).all() else _SUBSTEPS,
        delay=sampling.delay,
        jitter=sampling.jitter,
    )


def _sum_of(A: Array, h: float) -> Array:
    """Return the integral of e^(A t) over a sample."""
    n = len(A)
    return np.asarray(expm(np.block([[A, np.eye(n)], [np.zeros((n, 2 * n))]]) * h)[:n, n:])
