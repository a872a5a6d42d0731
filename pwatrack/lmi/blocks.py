"""Stacks of symmetric matrices, side by side in one vector: where they stand, their scalings, how far they may go.

All matrices of one order are one stack (l, N, N), so that each operation is one call for all of them. For S ≻ 0 and
Z ≻ 0 there is one E with E S Eᵀ = E⁻ᵀ Z E⁻¹ = D, diagonal: the coordinates of Nesterov and Todd.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array

_SMALL = 12  # order up to which eigenvalues cost less than the factorizations that are tried in their place
_FURTHER = 1.12  # the longest step that is told apart from longer ones: nine tenths of it are a whole step


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
        """Return views of the stacks in a vector."""
        return [x[place].reshape(shape) for place, shape in self._slices]

    def parts(self, x: Array) -> list[Array]:
        """Return views of the matrices of each constraint in a vector."""
        stacks = self.stacks(x)
        return [stacks[k][first:last, :N, :N] for k, first, last, N in self._places]

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


def step_length(change: Sequence[Array], scalings: Sequence[Scaling], near: float) -> float:
    """Return how far D may go along scaled changes before it leaves its cone, or a number above 1.1; or a little less.

    By a share `near` it may be less.
    """
    length = _FURTHER
    for X, scaling in zip(change, scalings, strict=True):
        if X.shape[1] <= _SMALL:
            root = 1 / np.sqrt(scaling.d)
            least = float(np.linalg.eigvalsh(root[:, :, None] * X * root[:, None]).min())
            length = min(length, -1 / least) if least < 0 else length
        else:
            length = _searched(X, scaling.d, length, near)
    return length


def _searched(X: Array, d: Array, most: float, near: float) -> float:
    """Return a length up to a largest one for which D + length · X is positive definite, by halving an interval."""
    low, high = 0.0, most
    trial = most
    diagonal = np.arange(d.shape[1])
    while high - low > near * high:
        moved = trial * X
        moved[:, diagonal, diagonal] += d
        try:
            np.linalg.cholesky(moved)
            low = trial
        except np.linalg.LinAlgError:
            high = trial
        if low == most or high < 1e-8:
            break
        trial = low + (high - low) * (0.5 if low else 0.75)
    return low
