"""Stacks of symmetric matrices, side by side in one vector: where they stand, their scalings, how far they may go.

All matrices of one order are one stack (l, N, N), so that each operation is one call for all of them. For S ≻ 0 and
Z ≻ 0 there is one E with E S Eᵀ = E⁻ᵀ Z E⁻¹ = D, diagonal: the coordinates of Nesterov and Todd.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import ceil, log

import numpy as np

from pwatrack.arrays import Array

_FURTHER = 1.12  # the longest step that is told apart from longer ones: nine tenths of it are a whole step
_NEXT, _ROUGHLY = 0.98, 0.9  # of a length: the next shorter one that is tried
_NOWHERE = 1000  # times that: no way to go
_FEW = 120  # rows of matrices of which all eigenvalues are quicker than whether more of them are definite


class Blocks:
    """The places of the matrices of several constraints in one vector.

    Attributes:
        shapes: (l, N) of each stack.
        size: Number of entries of the vector.
    """

    def __init__(self, constraints: Sequence[tuple[int, int]], *, padded: bool = False) -> None:
        """Place matrices, (l, N) for each constraint; padded, all have the order of the largest."""
        largest = max(N for _, N in constraints)
        places, cells = list[tuple[int, int, int, int]](), dict[int, int]()
        for count, N in constraints:
            order = largest if padded else N
            first = cells.get(order, 0)
            cells[order] = first + count
            places.append((list(cells).index(order), first, first + count, N))
        self.shapes = [(count, N) for N, count in cells.items()]
        self._places = places
        ends = np.cumsum([count * N * N for count, N in self.shapes]).tolist()
        self.size = int(ends[-1])
        self._slices = [
            (slice(end - count * N * N, end), (count, N, N)) for end, (count, N) in zip(ends, self.shapes, strict=True)
        ]

    @property
    def order(self) -> int:
        """Sum of the orders of all matrices."""
        return sum(count * N for count, N in self.shapes)

    def stacks(self, x: Array) -> list[Array]:
        """Return views of the stacks in a vector, or in each of several, (…, size)."""
        return [x[..., place].reshape(*x.shape[:-1], *shape) for place, shape in self._slices]

    def parts(self, x: Array) -> list[Array]:
        """Return views of the matrices of each constraint in a vector, or in each of several, (…, size)."""
        stacks = self.stacks(x)
        return [stacks[k][..., first:last, :N, :N] for k, first, last, N in self._places]

    def unscaled(self, changes: Sequence[Array], scalings: "Sequence[Scaling]") -> Array:
        """Return the vector of changes of Z whose scaled forms these are."""
        z = np.empty(self.size)
        for Z, change, scaling in zip(self.stacks(z), changes, scalings, strict=True):
            Z[:] = scaling.back(change)
        return z

    def of(self, parts: Sequence[Array], beside: float = 0.0) -> Array:
        """Return the vector with these matrices; those that are filled up have this beside them on the diagonal."""
        x = np.zeros(self.size)
        for stack in self.stacks(x) if beside else ():
            np.einsum("ijj->ij", stack)[:] = beside
        for place, part in zip(self.parts(x), parts, strict=True):
            place[:] = part
        return x


@dataclass(frozen=True)
class Scaling:
    """E (l, N, N) and the diagonal of D, (l, N), for one stack."""

    E: Array
    d: Array

    @classmethod
    def of(cls, S: Array, Z: Array) -> "Scaling":
        """Return the scaling of S and Z.

        Raises LinAlgError if one of the matrices is not positive definite to working precision.
        """
        L = np.linalg.cholesky(S)
        values, Q = np.linalg.eigh(L.transpose(0, 2, 1) @ Z @ L)
        if not values.min() > 0:
            raise np.linalg.LinAlgError("a matrix is not positive definite")
        d = np.sqrt(values)
        G = (L @ Q) / np.sqrt(d)[:, None]
        return cls((G.transpose(0, 2, 1) @ Z) / d[:, :, None], d)

    def into(self, X: Array) -> Array:
        """Return E X Eᵀ: how S changes."""
        return np.asarray(self.E @ X @ self.E.transpose(0, 2, 1))

    def back(self, X: Array) -> Array:
        """Return Eᵀ X E: how Z changes when its scaled form changes by X."""
        return np.asarray(self.E.transpose(0, 2, 1) @ X @ self.E)


def step_lengths(
    s: Sequence[Array], z: Sequence[Array], scalings: Sequence[Scaling], *, roughly: bool = False
) -> tuple[float, float]:
    """Return how far S = D and Z = D may go along scaled changes before they leave their cone; or a little less.

    Each is the first of a falling sequence of lengths from above 1.1 on that does, so that rounding seldom changes it.
    """
    ratio = _ROUGHLY if roughly else _NEXT
    found = (_lengths(np.array([*pair]), scaling.d, ratio) for *pair, scaling in zip(s, z, scalings, strict=True))
    primal, dual = map(min, zip(*found, strict=True))
    return primal, dual


def _lengths(X: Array, d: Array, ratio: float) -> list[float]:
    """Return them for one stack of each, (2, l, N, N).

    Of large stacks the matrices that change most say them, if the others stay as well.
    """
    root = 1 / np.sqrt(d)
    Y = X * (root[:, :, None] * root[:, None, :])
    few = max(1, _FEW // Y.shape[2])
    if Y.shape[1] > few:
        most = np.argpartition(np.einsum("ijkl,ijkl->ij", Y, Y), -few, axis=1)[:, -few:]
        found = _first(np.take_along_axis(Y, most[:, :, None, None], axis=1), ratio)
        with suppress(np.linalg.LinAlgError):
            np.linalg.cholesky(np.eye(Y.shape[2]) + np.array(found)[:, None, None, None] * Y)
            return found
    return _first(Y, ratio)


def _first(Y: Array, ratio: float) -> list[float]:
    """Return the first of falling lengths at which all I + length · Y are positive definite, for both stacks."""
    least = np.linalg.eigvalsh(Y)[..., 0].min(axis=1).tolist()
    steps = [ceil(log(max(1.0, -_FURTHER * each)) / -log(ratio)) for each in least]
    return [_FURTHER * ratio**k if k < _NOWHERE else 0.0 for k in steps]
