"""Hyperplanes H_jᵀx + h_j = 0, the polyhedral cells Λ_i they bound, and the facets between cells."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from pwatrack.arrays import Array, IntArray, readonly
from pwatrack.errors import OutsideTheory, Problem, Undecided

_INTERIOR = 1e-9  # least inner radius of a set with an interior, in units of the least distance of a plane from 0


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

    @cached_property
    def empty_cells(self) -> tuple[int, ...]:
        """The cells whose inequalities leave them no interior; nothing is lost without them."""
        return tuple(i for i in range(len(self.names)) if self.interior_point(self.signs[i]) is None)

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
        if not problems:
            problems += self._lonely()
        if problems:
            raise OutsideTheory(*problems)

    def _lonely(self) -> list[Problem]:
        """Cover and disjointness imply that facets connect all cells; where they do not, rounding hid one."""
        full = [i for i in range(len(self.names)) if i not in self.empty_cells]
        reached, frontier = set(full[:1]), full[:1]
        while frontier:
            i = frontier.pop()
            for facet in self.facets:
                for one, other in ((facet.i, facet.j), (facet.j, facet.i)):
                    if one == i and other in full and other not in reached:
                        reached.add(other)
                        frontier.append(other)
        return [
            Problem(
                message=f"cell '{self.names[i]}' shares no facet with the others: its borders do not match theirs",
                subject=("system", "cells", i),
                hint="write the border between two cells with the same numbers in both",
            )
            for i in full
            if i not in reached
        ]

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

        Raises:
            Undecided: If the linear program is not solved.
        """
        rows = np.flatnonzero(signs)
        rows = rows[rows != on] if on is not None else rows
        H, h, d = self._scaled
        n = H.shape[1]
        if not len(rows):
            return np.zeros(n) if on is None else -h[on] * H[on] * d
        solution = linprog(
            np.append(np.zeros(n), -1.0),
            A_ub=np.column_stack([-signs[rows, None] * H[rows], np.ones(len(rows))]),
            b_ub=signs[rows] * h[rows],
            A_eq=None if on is None else np.append(H[on], 0.0)[None],
            b_eq=None if on is None else [-h[on]],
            bounds=[(None, None)] * n + [(None, 1.0)],
            method="highs",
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if solution.status == 2 or solution.x is None:
            return None
        if solution.status != 0:
            raise Undecided(f"a linear program on the cells was not solved: {solution.message}")
        return d * np.asarray(solution.x[:-1], dtype=np.float64) if solution.x[-1] >= _INTERIOR else None

    @cached_property
    def _scaled(self) -> tuple[Array, Array, Array]:
        """Return H' (k, n) with unit rows, h' (k,) and d (n,) with H x + h ∝ H' z + h', x = d z, and |h'| ≥ 1 or 0."""
        return _equilibrated(self.H, self.h)


def _join(one: IntArray, other: IntArray) -> IntArray:
    return np.where(one != 0, one, other)


def _equilibrated(H: Array, h: Array) -> tuple[Array, Array, Array]:
    d = np.ones(H.shape[1])
    rows = H.copy()
    for _ in range(4):
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        size = np.abs(rows).max(axis=0, initial=0.0)
        factor = np.where(size > 0, 2.0 ** -np.round(np.log2(np.where(size > 0, size, 1.0))), 1.0)
        rows, d = rows * factor, d * factor
    norm = np.linalg.norm(H * d, axis=1)
    distance = h / norm
    unit = float(np.abs(distance)[distance != 0].min(initial=np.inf))
    unit = unit if np.isfinite(unit) else 1.0
    return H * d / norm[:, None], distance / unit, d * unit


def _merge(H: Array, h: Array, signs: IntArray) -> tuple[Array, Array, IntArray]:
    """Merge hyperplanes that are equal as sets, except where a cell claims both sides of one."""
    kept: list[int] = []
    table = np.zeros_like(signs)
    unit_H, unit_h, _ = _equilibrated(H, h)
    unit = np.column_stack([unit_H, unit_h])
    for k in range(len(h)):
        for position, other in enumerate(kept):
            side = _same(unit[k], unit[other]) * signs[:, k]
            if side.any() and (table[:, position] * side >= 0).all():
                table[:, position] = np.where(side != 0, side, table[:, position])
                break
        else:
            table[:, len(kept)] = signs[:, k]
            kept.append(k)
    return readonly(H[kept]), readonly(h[kept]), table[:, : len(kept)].copy()


def _same(one: Array, other: Array) -> int:
    """Return ±1 if two scaled rows (unit normal, offset) are one hyperplane to `_INTERIOR`, else 0."""
    sign = 1 if one[:-1] @ other[:-1] > 0 else -1
    near = np.abs(one - sign * other) <= 0.5 * _INTERIOR * np.append(np.ones(len(one) - 1), max(1.0, abs(one[-1])))
    return sign if near.all() else 0


def _point(x: Array) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in x) + ")"
