"""The same map as `linear_map`, for small programs: as one matrix, and all constraints as one stack.

There the products are so small that their number counts, not their size.
"""

from collections.abc import Sequence

import numpy as np

from pwatrack.arrays import Array, symmetric_part
from pwatrack.lmi.blocks import Scaling
from pwatrack.lmi.linear_map import Equations, LinearMap, Normal, Side, Triangle
from pwatrack.lmi.program import SemidefiniteProgram


class DenseMap(LinearMap):
    """A `LinearMap` that keeps the left-hand sides of all unit vectors."""

    def __init__(self, program: SemidefiniteProgram) -> None:
        super().__init__(program, padded=True)
        self.images = np.zeros((self.size, self.blocks.size))
        cells, order = self.blocks.shapes[0]
        stack, first = self.images.reshape(self.size, cells, order, order), 0
        for side, c in zip(self.sides, program.constraints, strict=True):
            last, N = first + len(c.constant), c.constant.shape[1]
            self._write(stack[:, first:last, :N, :N], side, N)
            first = last
        if self.V is not None:
            k = self.W.n
            stack[: self.P.size, -1, k : k + self.n, k : k + self.n] = -_units(self.P)
            stack[self.main :, -1, :k, :k] = -_units(self.W)

    def _write(self, out: Array, side: Side, N: int) -> None:
        k, eye = self.P.size, np.eye(N)[None]
        if side.L is not None:
            whole = _outer(side.L, eye if side.R is None else side.R)
            out[:k] = symmetric_part(whole[self.P.rows, self.P.columns] + whole[self.P.columns, self.P.rows])
        if side.M is not None:
            whole = _outer(side.M, eye if side.N is None else side.N)
            out[k : self.main - 1] = symmetric_part(whole.reshape(-1, *whole.shape[2:]))
        if side.T is not None:
            out[self.main - 1] = side.T

    def apply(self, v: Array) -> Array:
        return np.asarray(v @ self.images)

    def adjoint(self, z: Array) -> Array:
        return np.asarray(self.images @ z)

    def step(self, scalings: Sequence[Scaling]) -> Equations:
        return DenseEquations(self, scalings[0])


class DenseEquations(Equations):
    """`Equations` with the left-hand sides of all unit vectors."""

    def __init__(self, linear: DenseMap, scaling: Scaling) -> None:
        self._shape = scaling.E.shape
        self._images = scaling.into(linear.images.reshape(-1, *self._shape)).reshape(linear.images.shape)
        self._normal = Normal(self._images @ self._images.T)

    def apply(self, v: Array) -> list[Array]:
        return [(v @ self._images).reshape(self._shape)]

    def adjoint(self, changes: Sequence[Array]) -> Array:
        return np.asarray(self._images @ changes[0].ravel())

    def solve(self, right: Array) -> Array:
        return self._normal.solve(right)


def _outer(front: Array, back: Array) -> Array:
    """Return front_i[:, j] back_i[k, :] as (j, k, i, row, column)."""
    return np.asarray(front.transpose(2, 0, 1)[:, None, :, :, None] * back.transpose(1, 0, 2)[None, :, :, None, :])


def _units(of: Triangle) -> Array:
    units, k = np.zeros((of.size, of.n, of.n)), np.arange(of.size)
    units[k, of.rows, of.columns] = 1.0
    return symmetric_part(units)
