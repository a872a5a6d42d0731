"""Hyperplanes H_jᵀx + h_j = 0, the polyhedral cells Λ_i they bound, and the facets between cells."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from pwatrack.arrays import Array, IntArray, readonly
from pwatrack.errors import OutsideTheory, Problem

_INTERIOR = 1e-6  # least inner radius of a full-dimensional set, in units of the least |h_j|


@dataclass(frozen=True)
class Facet:
    """Cells `i` and `j` touch along hyperplane `k` in a set of dimension n − 1."""

    i: int
    j: int
    k: int


@dataclass(frozen=True, kw_only=True)
class Partition:
    """Polyhedral cells that cover ℝⁿ, as in Section II of the paper.

    Cell i is the set of x with `signs[i, j] * (H[j] @ x + h[j]) >= 0` for all
    j; a sign of 0 means that hyperplane j does not bound the cell.

    Attributes:
        H: Normals of the hyperplanes, (k, n).
        h: Offsets of the hyperplanes, (k,).
        signs: Side of each hyperplane that each cell is on, (l, k), entries −1, 0, 1.
        names: Name of each cell, l of them.

    Example:
        >>> halves = Partition.create(H=[[1.0]], h=[0.0], signs=[[-1], [1]], names=["left", "right"])
        >>> halves.names[halves.locate(np.array([3.0]))]
        'right'
    """

    H: Array
    h: Array
    signs: IntArray
    names: tuple[str, ...]

    @classmethod
    def create(cls, *, H: object, h: object, signs: object, names: Sequence[str]) -> "Partition":
        """Check the shapes, merge hyperplanes that are the same set, and return the partition.

        Raises:
            ValueError: If the shapes do not fit or a hyperplane has a zero normal.
        """
        cell_names = tuple(names)
        sign_table = np.array(signs, dtype=np.int64).reshape(len(cell_names), -1)
        count = sign_table.shape[1]
        normals = readonly(H, shape=(count, None), name="H")
        offsets = readonly(h, shape=(count,), name="h")
        if count and not np.abs(normals).max(axis=1).all():
            raise ValueError("a hyperplane has a zero normal")
        normals, offsets, sign_table = _merge(normals, offsets, sign_table)
        sign_table.flags.writeable = False
        return cls(H=normals, h=offsets, signs=sign_table, names=cell_names)

    def locate(self, x: Array) -> int:
        """Return the cell that contains x (n,), the first one if x lies on a facet."""
        inside = (self.signs * (self.H @ x + self.h)).min(axis=1, initial=0.0)
        return int(np.argmax(inside))

    def substitute(self, T: Array, offset: Array) -> tuple[Array, Array]:
        """Return (H, h) in the coordinates z with x = T z + offset."""
        return self.H @ T, self.H @ offset + self.h

    def between(self, i: int, j: int) -> list[int]:
        """Return the hyperplanes that cells i and j are on opposite sides of."""
        return [int(k) for k in np.flatnonzero(self.signs[i] * self.signs[j] < 0)]

    @cached_property
    def facets(self) -> tuple[Facet, ...]:
        """All pairs of cells that share a facet.

        Two cells with disjoint interiors that meet in dimension n − 1 are on
        opposite sides of exactly one hyperplane; a linear program decides
        whether they really touch there.
        """
        found = []
        for i, j in combinations(range(len(self.names)), 2):
            opposite = self.between(i, j)
            if len(opposite) == 1:
                k = opposite[0]
                if self.interior_point(_join(self.signs[i], self.signs[j]), on=k) is not None:
                    found.append(Facet(i, j, k))
        return tuple(found)

    def empty_cells(self) -> list[int]:
        """Return the cells whose inequalities leave them no interior; nothing is lost without them."""
        return [i for i in range(len(self.names)) if self.interior_point(self.signs[i]) is None]

    def without(self, cells: Sequence[int]) -> "Partition":
        """Return the partition without some of its cells."""
        kept = [i for i in range(len(self.names)) if i not in cells]
        return Partition(H=self.H, h=self.h, signs=self.signs[kept], names=tuple(self.names[i] for i in kept))

    def check(self) -> None:
        """Prove by linear programs that the cells do not overlap and cover ℝⁿ.

        Raises:
            OutsideTheory: With one problem per overlapping pair, and a witness point for a hole.
        """
        problems = []
        for i, j in combinations(range(len(self.names)), 2):
            if not (self.signs[i] * self.signs[j] < 0).any():
                witness = self.interior_point(_join(self.signs[i], self.signs[j]))
                if witness is not None:
                    problems.append(
                        Problem(
                            message=f"cells '{self.names[i]}' and '{self.names[j]}' overlap, "
                            f"for example at x = {_point(witness)}",
                            subject=("system", "cells", j),
                            hint="interiors of cells must be disjoint (Section II)",
                        )
                    )
        if not problems:
            hole = self._hole(np.zeros_like(self.signs[0]), list(range(len(self.names))))
            if hole is not None:
                problems.append(
                    Problem(
                        message=f"the cells do not cover the state space: no cell contains x = {_point(hole)}",
                        subject=("system", "cells"),
                        hint="every state must belong to a cell (Section II)",
                    )
                )
        if problems:
            raise OutsideTheory(*problems)

    def _hole(self, region: IntArray, cells: list[int]) -> Array | None:
        """Return a point inside `region` (a sign vector) that is in none of `cells`."""
        point = self.interior_point(region)
        if point is None:
            return None
        for position, i in enumerate(cells):
            if (region * self.signs[i] < 0).any():
                continue
            open_rows = np.flatnonzero((self.signs[i] != 0) & (region == 0))
            inside = region.copy()
            for k in open_rows:
                outside = inside.copy()
                outside[k] = -self.signs[i, k]
                hole = self._hole(outside, cells[position + 1 :])
                if hole is not None:
                    return hole
                inside[k] = self.signs[i, k]
            return None
        return point

    def interior_point(self, signs: IntArray, on: int | None = None) -> Array | None:
        """Return an inner point (n,) of the polyhedron of a sign vector (k,), or None if it has no interior.

        With `on`, the interior is meant relative to that hyperplane.
        """
        rows = np.flatnonzero(signs)
        rows = rows[rows != on] if on is not None else rows
        unit = self._unit
        if not len(rows):
            centre: Array = np.zeros(self.H.shape[1]) if on is None else -self.h[on] * self.H[on]
            return centre / (1.0 if on is None else float(self.H[on] @ self.H[on]))
        n = self.H.shape[1]
        norm = np.linalg.norm(self.H, axis=1)
        H, h = self.H / norm[:, None], self.h / (norm * unit)
        upper = np.column_stack([-signs[rows, None] * H[rows], np.ones(len(rows))])
        equal = None if on is None else np.append(H[on], 0.0)[None]
        solution = linprog(
            np.append(np.zeros(n), -1.0),
            A_ub=upper,
            b_ub=signs[rows] * h[rows],
            A_eq=equal,
            b_eq=None if on is None else [-h[on]],
            bounds=[(None, None)] * n + [(None, 1.0)],
            method="highs",
        )
        if solution.x is None or solution.status != 0 or solution.x[-1] < _INTERIOR:
            return None
        return unit * np.asarray(solution.x[:-1], dtype=np.float64)

    @cached_property
    def _unit(self) -> float:
        distance = np.abs(self.h) / np.linalg.norm(self.H, axis=1)
        return float(distance[distance > 0].min(initial=np.inf)) if (distance > 0).any() else 1.0


def _join(one: IntArray, other: IntArray) -> IntArray:
    return np.where(one != 0, one, other)


def _merge(H: Array, h: Array, signs: IntArray) -> tuple[Array, Array, IntArray]:
    """Merge hyperplanes that are equal as sets, except where a cell claims both sides of one."""
    kept: list[int] = []
    table = np.zeros_like(signs)
    for k in range(len(h)):
        for position, other in enumerate(kept):
            side = _ratio(np.append(H[k], h[k]), np.append(H[other], h[other])) * signs[:, k]
            if side.any() and (table[:, position] * side >= 0).all():
                table[:, position] = np.where(side != 0, side, table[:, position])
                break
        else:
            table[:, len(kept)] = signs[:, k]
            kept.append(k)
    return readonly(H[kept]), readonly(h[kept]), table[:, : len(kept)].copy()


def _ratio(one: Array, other: Array) -> int:
    """Return ±1 if the two rows are multiples of each other (sign of the factor), else 0."""
    pivot = int(np.argmax(np.abs(other)))
    factor = one[pivot] / other[pivot]
    if factor == 0 or np.abs(one - factor * other).max() > 1e-12 * np.abs(one).max():
        return 0
    return 1 if factor > 0 else -1


def _point(x: Array) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in x) + ")"
