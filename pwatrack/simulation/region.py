"""Regions from which start states are drawn."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array


@dataclass(frozen=True, kw_only=True)
class BoxRegion:
    """All x with low ≤ x ≤ high, entry by entry; an entry with low = high stays as it is."""

    # in the units of the states, (n,)
    low: Array
    high: Array

    def draw(self, random: np.random.Generator, count: int) -> Array:
        """Return points drawn uniformly, (count, n); fewer points are the first of more.

        Example:
            >>> box = BoxRegion(low=np.array([-1.0, 2.0]), high=np.array([1.0, 2.0]))
            >>> points = box.draw(np.random.default_rng(1), 100)
            >>> bool((np.abs(points[:, 0]) <= 1).all()), points[:, 1].min(), points[:, 1].max()
            (True, np.float64(2.0), np.float64(2.0))
        """
        share = random.random((count, len(self.low)))
        points: Array = np.clip(self.low + share * (self.high - self.low), self.low, self.high)
        return points


@dataclass(frozen=True, kw_only=True)
class EllipsoidRegion:
    """All x with Σ ((x_i − center_i) / radii_i)² ≤ 1; an entry of radius 0 stays at its centre."""

    # in the units of the states, (n,)
    center: Array
    radii: Array

    def draw(self, random: np.random.Generator, count: int) -> Array:
        """Return points drawn uniformly, (count, n); fewer points are the first of more.

        Example:
            >>> disc = EllipsoidRegion(center=np.array([5.0, 0.0]), radii=np.array([1.0, 0.1]))
            >>> points = disc.draw(np.random.default_rng(1), 100)
            >>> bool((((points - disc.center) / disc.radii) ** 2).sum(axis=1).max() < 1 + 1e-12)
            True
        """
        varied = np.flatnonzero(self.radii)
        # Archimedes: n coordinates of a uniform point on the sphere in n + 2 dimensions are uniform in the ball.
        sphere = random.standard_normal((count, len(varied) + 2))
        sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        points = np.tile(self.center, (count, 1))
        points[:, varied] += sphere[:, : len(varied)] * self.radii[varied]
        return points


Region = BoxRegion | EllipsoidRegion
