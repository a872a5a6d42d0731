"""Linear forms of the states, with a constant, and elements that are another one in each of their cells."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.arrays import Array, IntArray
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


@dataclass(frozen=True, kw_only=True)
class PiecewiseElement:
    """Adds direction · f to ẋ, where f is another linear form of the states in each of its cells."""

    name: str  # for the names of the cells
    direction: Any  # (n,)

    @property
    def planes(self) -> Sequence[LinearForm]:
        """Forms that are 0 where its cells end."""
        raise NotImplementedError

    @property
    def cells(self) -> Sequence[tuple[str, Sequence[int] | IntArray, LinearForm]]:
        """Of each cell its name, the signs of the planes, 0 where one does not bound it, and f."""
        raise NotImplementedError

    @cached_property
    def segments(self) -> tuple[str, ...]:
        """A name for each cell."""
        return tuple(name for name, _, _ in self.cells)

    @cached_property
    def forms(self) -> tuple[LinearForm, ...]:
        """What f is in each cell."""
        return tuple(form for _, _, form in self.cells)

    @cached_property
    def signs(self) -> IntArray:
        """Of its planes in each cell, (cells, planes)."""
        return np.array([signs for _, signs, _ in self.cells], dtype=np.int64)

    @cached_property
    def alike(self) -> tuple[int, ...]:
        """The first cell with the gradient of each."""
        rows = [form.coefficients for form in self.forms]
        return tuple(map(rows.index, rows))

    def located(self, sides: IntArray) -> IntArray:
        """Return its cell for each row of sides of its planes, (l, planes)."""
        fits = (self.signs == 0) | (self.signs == sides[:, None])
        return np.asarray(fits.all(axis=2).argmax(axis=1))

    def on(self, cell: int) -> tuple[BallMatrix, BallMatrix]:
        """Return what it adds to A, (n, n), and to b, (n, 1), in one of its cells."""
        form, column = self.forms[cell], BallMatrix.of([[v] for v in self.direction])
        return column @ BallMatrix.of([form.coefficients]), column @ BallMatrix.of([[form.offset]])
