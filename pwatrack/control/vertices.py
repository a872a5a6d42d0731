"""Matrices that have some others in their hull, exactly, boxes of them, and the rows in which they, or plants, differ.

Cells of n elements are the corners of a box with an edge for each: what is said of a middle and of its edges, one by
one, is n times as much work, where corners are 2ⁿ.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import permutations

import flint
import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.ball_matrix import BallMatrix, different
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.rational import Rational, fraction_of, identity, number, on_entries, stacked

_HALF = Fraction(1, 2)  # of an edge: from the middle to a corner


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


@dataclass(frozen=True)
class Box:
    """All middle + Σ ε_k D_k with |ε_k| ≤ 1."""

    middle: BallMatrix  # (j, k)
    # D_k, (j, k) each, of rank 1, the first entry of each that is not 0 above 0, sorted
    edges: tuple[Rational, ...] = ()

    def part(self, rows: Sequence[int], columns: Sequence[int]) -> "Box":
        """Return the entries of some rows and columns."""
        return Box(self.middle.part(rows, columns), tuple(on_entries(D, rows, columns) for D in self.edges))

    @property
    def differences(self) -> "Box":
        """Those of any two matrices in it."""
        radius = None if self.middle.radius is None else self.middle.radius * 2
        return Box(BallMatrix(self.middle.centre * 0, radius), tuple(D * 2 for D in self.edges))


def boxes(matrices: Sequence[BallMatrix]) -> list[Box]:
    """Return one box whose corners some different matrices are, or each by itself.

    Example: the slopes of two elements.

        >>> A = [BallMatrix.of([[0, 1], [a, b]]) for a in (-3, -1) for b in (0, 4)]
        >>> (box,) = boxes(A)
        >>> box.middle.floats.tolist(), [D.tolist() for D in box.edges]
        ([[0.0, 1.0], [-2.0, 2.0]], [[[0, 0], [0, 2]], [[0, 0], [1, 0]]])
        >>> len(boxes(A[:3]))
        3
    """
    if not matrices:
        return []
    alone, (first, *others) = [Box(X) for X in matrices], [X.centre for X in matrices]
    off = [X - first for X in others]
    points = {tuple(X.entries()) for X in off}
    edges = [X for X in off if not any(tuple((X - Y).entries()) in points for Y in off)]
    if len(matrices) != 2 ** len(edges) or any(X.rank() != 1 for X in edges):
        return alone
    corners = [first * 0]
    for X in edges:
        corners += [Y + X for Y in corners]
    if {tuple(X.entries()) for X in corners[1:]} != points:
        return alone
    radii = [X.radius for X in matrices if X.radius is not None]
    most = [max(each) for each in zip(*(X.entries() for X in radii), strict=True)]
    radius = flint.fmpq_mat(first.nrows(), first.ncols(), most) if radii else None
    middle = first + sum((X * number(_HALF) for X in edges), first * 0)
    halves = [X * number(_HALF if next(filter(None, X.entries())) > 0 else -_HALF) for X in edges]
    return [Box(BallMatrix(middle, radius), tuple(sorted(halves, key=lambda X: [*X.entries()])))]


def differences(matrices: Sequence[BallMatrix]) -> list[Box]:
    """Return those of any two different matrices in the hull of some, in boxes; none of one matrix."""
    found = boxes(matrices)
    if len(found) == 1:
        return [found[0].differences] if found[0].edges else []
    return boxes(outermost([one - other for one, other in permutations(matrices, 2)]))


def factors(X: Rational) -> tuple[list[Fraction], list[Fraction]]:
    """Return u and v with u vᵀ = X, of rank 1: the first entry of v that is not 0 is 1."""
    rows = [[fraction_of(v) for v in row] for row in X.tolist()]
    first = next(row for row in rows if any(row))
    at = next(k for k, v in enumerate(first) if v)
    return [row[at] for row in rows], [v / first[at] for v in first]


def outermost(matrices: Sequence[BallMatrix]) -> list[BallMatrix]:
    """Return different matrices, without those between two others, exactly: the hull stays what it is."""
    found = different(matrices)
    if any(X.radius is not None for X in found):
        return found
    points = [X.centre.entries() for X in found]
    return [X for X, point in zip(found, points, strict=True) if not _between(points, point)]


def outermost_cells(plant: PWASystem) -> list[BallMatrix]:
    """Return A_i of the cells that have those of all cells in their hull."""
    return outermost([plant.exact.A[i] for i in plant.hull])


def _between(points: Sequence[Sequence[Rational]], point: Sequence[Rational]) -> bool:
    """Say whether one of some different points is between two others: from it they lie in opposite directions."""
    seen = set[tuple[Fraction, ...]]()
    for change in ([v - w for v, w in zip(other, point, strict=True)] for other in points if other is not point):
        size = abs(next(v for v in change if v != 0))
        direction = tuple(fraction_of(v / size) for v in change)
        if tuple(-v for v in direction) in seen:
            return True
        seen.add(direction)
    return False


def held_rows(differences: Sequence[Box], n: int) -> BallMatrix:
    """Return R with a row for each dimension in which A_a − A_b differ, and 1 alone in some column of each row.

    Where these have radii: unit rows for all columns that are not 0.
    """
    if not differences:
        return BallMatrix.of([], (0, n))
    changes = [X for box in differences for X in (box.middle, *(BallMatrix(D) for D in box.edges))]
    if all(X.radius is None for X in changes):
        form, rank = stacked([X.centre for X in changes]).rref()
        return BallMatrix(form).part(range(rank), range(n))
    sizes = [np.abs(X.floats) + (0 if X.radius is None else np.abs(BallMatrix(X.radius).floats)) for X in changes]
    taken = np.flatnonzero(np.max(sizes, axis=(0, 1)))
    return BallMatrix(identity(n)).part(taken.tolist(), range(n))
