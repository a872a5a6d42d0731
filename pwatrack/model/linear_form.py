"""Linear forms of the states, with a constant."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.model.signal import NotRepresentable
from pwatrack.real import Real, Ring


@dataclass(frozen=True)
class LinearForm(Ring):
    """The form coefficients · x + offset, in exact numbers; sums and multiples are forms again."""

    coefficients: tuple[Real, ...]
    offset: Real

    @property
    def row(self) -> Array:
        """The row in doubles, (n,)."""
        return np.array([float(c) for c in self.coefficients])

    @property
    def constant(self) -> float:
        """The constant as a double."""
        return float(self.offset)

    def __add__(self, other: "LinearForm | Real | float") -> "LinearForm":
        if isinstance(other, LinearForm):
            both = zip(self.coefficients, other.coefficients, strict=True)
            return LinearForm(tuple(a + b for a, b in both), self.offset + other.offset)
        return LinearForm(self.coefficients, self.offset + other)

    def __mul__(self, other: "LinearForm | Real | float") -> "LinearForm":
        if isinstance(other, LinearForm):
            raise NotRepresentable("is not linear in the states")
        return LinearForm(tuple(c * other for c in self.coefficients), self.offset * other)

    __radd__, __rmul__ = __add__, __mul__

    def __truediv__(self, other: "LinearForm | Real | float") -> "LinearForm":
        return self * (other if isinstance(other, LinearForm) else 1 / Real.of(other))

    def __rtruediv__(self, other: float) -> "LinearForm":
        raise NotRepresentable("is not linear in the states")

    __pow__ = __rpow__ = __rtruediv__


def added(direction: Sequence[Any], form: LinearForm) -> tuple[BallMatrix, BallMatrix]:
    """Return direction · form as what it adds to A, (n, n), and to b, (n, 1)."""
    column = BallMatrix.of([[v] for v in direction])
    return column @ BallMatrix.of([form.coefficients]), column @ BallMatrix.of([[form.offset]])
