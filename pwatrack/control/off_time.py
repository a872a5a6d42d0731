"""What ticks that come early and late add to what acts on a sampled loop: see `control.sampled_disturbances`.

No tick is more than θ, half of the jitter, off its time. So at a time τ of the program, which is h from tick to tick,
it is some t with |t − τ| ≤ θ, that goes λ times as fast; and x_n = x_d + e₀ moves by at most θ sup |x_n'| from τ to t.
"""

from dataclasses import dataclass
from math import ceil

import numpy as np
import scipy  # whose parts are imported where they are used

from pwatrack.arrays import Array
from pwatrack.control.sampled_gains import SampledGains


@dataclass(frozen=True, kw_only=True)
class OffTime:
    """By how much ticks may be off their times, and what that makes of things known in K substeps, (K, …) each."""

    theta: float  # of a tick, in s
    step: float  # from substep to substep, in s
    parts: int  # substeps of a sample

    @classmethod
    def of(cls, gains: SampledGains) -> "OffTime":
        """Return that of a program with such gains."""
        return cls(theta=gains.jitter / 2, step=gains.sample_time / gains.substeps, parts=gains.substeps)

    @property
    def late(self) -> float:
        """By how much λ may differ from 1."""
        return 2 * self.theta / (self.step * self.parts)

    @property
    def near(self) -> int:
        """How many substeps t may be off τ, begun ones too."""
        return ceil(self.theta / self.step)

    def most(self, each: Array) -> Array:
        """Return the largest at any t, of the largest in each substep."""
        if not self.near:
            return each
        return np.asarray(scipy.ndimage.maximum_filter1d(each, 2 * self.near + 1, axis=0, mode="nearest"))

    def means(self, squares: Array, largest: Array) -> Array:
        """Return mean squares at t, of those in each substep and of what is largest in it.

        Example: what is 1 in the second of three substeps, with ticks off by up to a tenth of a substep.

            >>> off, squares = OffTime(theta=0.1, step=1.0, parts=1), np.array([[0.0], [1.0], [0.0]])
            >>> off.means(squares, squares)[:, 0].round(3).tolist()
            [0.25, 1.0, 0.25]
        """
        if not self.near:
            return squares
        most = self.most(largest) ** 2
        return np.asarray(np.minimum((squares + 2 * self.theta / self.step * most) / (1 - self.late), most))

    def swaps(self, changes: Array, count: int) -> Array:
        """Return mean sizes, in so many substeps, of what is held at t less that at τ, by its change at each tick.

        Example: u is 3 from the second tick on.

            >>> off = OffTime(theta=0.1, step=1.0, parts=1)
            >>> off.swaps(np.array([[0.0], [3.0], [0.0]]), 3)[:, 0].round(3).tolist()
            [0.375, 0.375, 0.0]
        """
        found, ticks = np.zeros((count, changes.shape[1])), self.parts * np.arange(len(changes))
        share = min(1.0, self.theta / self.step / (1 - self.late))
        for k in range(self.near):
            for at in (ticks + k, ticks - 1 - k):
                inside = (at >= 0) & (at < count)
                found[at[inside]] += share * changes[inside]
        return found
