"""What limits of the inputs leave for the controller."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array

_OFF = 1e-6  # of the feedforward: its peak is known to that, see `simulation.peak`


@dataclass(frozen=True, kw_only=True)
class Peak:
    """How small and how large the feedforward gets.

    Attributes:
        low, high: Of each input, (m,).
        times: When it gets there, in s, (m, 2).
    """

    low: Array
    high: Array
    times: Array

    def left(self, limits: Array) -> Array:
        """Return how far each input may be from its feedforward, (m,): what is left on the smaller side of its limits.

        Args:
            limits: (m, 2); infinite where there is none.

        Example:
            >>> peak = Peak(low=np.array([-1.0]), high=np.array([3.0]), times=np.zeros((1, 2)))
            >>> peak.left(np.array([[-5.0, 5.0]])).round(4).tolist(), peak.left(np.array([[-np.inf, 2.0]])).tolist()
            ([2.0], [0.0])
        """
        off = _OFF * np.maximum(np.abs(self.low), np.abs(self.high))
        room = np.minimum(limits[:, 1] - self.high, self.low - limits[:, 0])
        return np.asarray(np.maximum(room - off, 0.0))

    def beyond(self, limits: Array) -> list[tuple[int, int]]:
        """Return where the feedforward is beyond a limit, by more than it is known to: (input, 0 for its lower one)."""
        off = _OFF * np.maximum(np.abs(self.low), np.abs(self.high))
        over = np.column_stack([limits[:, 0] - self.low > off, self.high - limits[:, 1] > off])
        return [(int(k), int(side)) for k, side in np.argwhere(over)]

    def with_also(self, other: "Peak") -> "Peak":
        """Return the peak of two stretches of time."""
        lower, higher = other.low < self.low, other.high > self.high
        return Peak(
            low=np.where(lower, other.low, self.low),
            high=np.where(higher, other.high, self.high),
            times=np.where(np.column_stack([lower, higher]), other.times, self.times),
        )


@dataclass(frozen=True, kw_only=True)
class Limited:
    """Limits of the inputs, and what the feedforward takes of them.

    Attributes:
        limits: Lower and upper limit of each input, (m, 2); infinite where there is none.
        lasting: What the feedforward takes whatever the generator starts with, where that is known: in its steady
            state for the reference as it begins, and from there on.
        peak: The same from the start of the generator in this run too; None where it could not be followed.
    """

    limits: Array
    lasting: Peak | None
    peak: Peak | None

    @property
    def left(self) -> Array | None:
        """How far each input may be from its feedforward at any time, (m,); None where nothing is left or known."""
        left = None if self.peak is None else self.peak.left(self.limits)
        return None if left is None or not (left > 0).all() else left
