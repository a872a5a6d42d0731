"""Regions from which start states are drawn."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array


@dataclass(frozen=True, kw_only=True)
class BoxRegion:
    """All x with low ≤ x ≤ high, entry by entry; an entry with low = high stays as it is."""

    low: Array  # in the units of the states, (n,)
    high: Array

    def draw(self, random: np.random.Generator, count: int) -> Array:
        """Return points drawn uniformly, (count, n); fewer points are the first of more."""
        share = random.random((count, len(self.low)))
        points: Array = np.clip(self.low + share * (self.high - self.low), self.low, self.high)
        return points


@dataclass(frozen=True, kw_only=True)
class EllipsoidRegion:
    """All x with Σ ((x_i − center_i) / radii_i)² ≤ 1; an entry of radius 0 stays at its centre."""

    center: Array  # in the units of the states, (n,)
    radii: Array

    def draw(self, random: np.random.Generator, count: int) -> Array:
        """Return points drawn uniformly, (count, n); fewer points are the first of more."""
        varied = np.flatnonzero(self.radii)
        # Archimedes: n coordinates of a uniform point on the sphere in n + 2 dimensions are uniform in the ball.
        sphere = random.standard_normal((count, len(varied) + 2))
        sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        points = np.tile(self.center, (count, 1))
        points[:, varied] += sphere[:, : len(varied)] * self.radii[varied]
        return points


Region = BoxRegion | EllipsoidRegion
