"""Matrices that have some others in their hull, exactly, and the rows in which they, or plants, differ."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.ball_matrix import BallMatrix, different
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.rational import Rational, fraction_of, identity, stacked


@dataclass(frozen=True, kw_only=True)
class Differences:
    """Rows of A_i(p) − A_i, b_i(p) − b_i and B(p) − B of some plants, each once."""

    A: Array  # in each cell, (R, l, n)
    b: Array  # (R, l)
    B: Array  # (R, m)
    of: IntArray  # in which state equation each is, (R,)

    @classmethod
    def of_corners(cls, exact: Matrices, corners: Sequence[Matrices]) -> "Differences":
        """Return those of plants at some corners from one."""
        (n, m), cells = exact.B.shape, len(exact.A)
        found = np.zeros((len(corners), cells, n, n + 1 + m))
        for F, corner in zip(found, corners, strict=True):
            pairs = (corner.A, exact.A), (corner.b, exact.b)
            A, b = (np.array([(X - Y).floats for X, Y in zip(*pair, strict=True)]) for pair in pairs)
            F[...] = np.concatenate([A, b, np.broadcast_to((corner.B - exact.B).floats, (cells, n, m))], axis=2)
        each = [np.unique(found[:, :, k], axis=0) for k in range(n)]
        each = [rows if rows.any() else rows[:0] for rows in each]
        F = np.concatenate(each)
        of = np.repeat(np.arange(n), [len(rows) for rows in each])
        return cls(A=F[..., :n], b=F[..., n], B=F[:, 0, n + 1 :], of=of)

    def rows(self, cell: int, x: Array) -> Array:
        """Return rows of what is different of f at x = x (z, 1) in a cell, (R, p), for rows x (n, p)."""
        rows = self.A[:, cell] @ x
        rows[:, -1] += self.b[:, cell]
        return np.asarray(rows)


def outermost(matrices: Sequence[BallMatrix]) -> list[BallMatrix]:
    """Return different matrices, without those between two others, exactly: the hull stays what it is."""
    found = different(matrices)
    if any(X.radius is not None for X in found):
        return found
    points = [X.centre.entries() for X in found]
    return [X for k, X in enumerate(found) if not _between(points, k)]


def outermost_cells(plant: PWASystem) -> list[BallMatrix]:
    """Return A_i of the cells that have those of all cells in their hull."""
    return outermost([plant.exact.A[i] for i in plant.hull])


def _between(points: Sequence[Sequence[Rational]], k: int) -> bool:
    """Say whether a point is between two others: from it they lie in opposite directions."""
    seen = set[tuple[int, ...]]()
    for j, point in enumerate(points):
        if j == k:
            continue
        change = [v - w for v, w in zip(point, points[k], strict=True)]
        size = abs(next(v for v in change if v != 0))
        direction = tuple(fraction_of(v / size) for v in change)
        if tuple(-v for v in direction) in seen:
            return True
        seen.add(direction)  # type: ignore[arg-type]
    return False


def held_rows(changes: Sequence[BallMatrix], n: int) -> BallMatrix:
    """Return R with a row for each dimension in which A_a − A_b differ, and 1 alone in some column of each row.

    Where these have radii: unit rows for all columns that are not 0.
    """
    if not changes:
        return BallMatrix.of([], (0, n))
    if all(X.radius is None for X in changes):
        form, rank = stacked([X.centre for X in changes]).rref()
        return BallMatrix(form).part(range(rank), range(n))
    sizes = [np.abs(X.floats) + (0 if X.radius is None else np.abs(BallMatrix(X.radius).floats)) for X in changes]
    taken = np.flatnonzero(np.max(sizes, axis=(0, 1)))
    return BallMatrix(identity(n)).part(taken.tolist(), range(n))
