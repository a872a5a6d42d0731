"""Continuity of the field of (1) across facets, decided exactly, and the exact repair of data that jump by rounding.

With F_i = [A_i b_i] and a hyperplane G = [Hᵀ h], the field is continuous across a facet between cells i and j on it
exactly where F_i − F_j = g G for some column g.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pwatrack.arrays import Array, balancing, readonly
from pwatrack.model.cells import Facet, Partition
from pwatrack.rational import Rational, beside, column_space, floats, left_null_space, on_entries, rational, stacked

_MOST_CYCLES = 2_000  # tree edges times other facets: with more, facets that do not close are refused at once


@dataclass(frozen=True, kw_only=True)
class Discontinuity:
    """What is left of F_i − F_j − g G on a facet."""

    facet: Facet
    A: Array  # (n, n)
    b: Array  # (n,)
    relative: float  # the largest row of it, of the terms of that row at a point of the facet of typical size


@dataclass(frozen=True, kw_only=True)
class Repair:
    """By how much the data were changed to make the field exactly continuous."""

    A: Array  # the largest change of each entry over the cells, (n, n)
    b: Array  # likewise, (n,)
    B: Array  # the change of each entry, (n, m)
    relative: float  # the largest change of a row, of the terms of that row; see `Discontinuity`

    def and_then(self, other: "Repair | None") -> "Repair":
        """Return both repairs as one."""
        if other is None:
            return self
        A, b, B = self.A + other.A, self.b + other.b, self.B + other.B
        return Repair(A=A, b=b, B=B, relative=self.relative + other.relative)

    @property
    def size(self) -> str:
        """How large the change is, in words."""
        return f"at most {self.relative:.1e} of the terms of an equation"

    def disturbance(self, x: Array, u: Array) -> Array:
        """Return by how much ẋ may differ between both, (n,), for |x| and |u| that are at most these, (n,) and (m,)."""
        return np.asarray(self.A @ np.abs(x) + self.b + self.B @ np.abs(u))


class Discontinuous(Exception):
    """The field jumps at some facets by more than rounding: its arguments are a `Discontinuity` for each."""


def repaired(
    partition: Partition, given: Sequence[Rational], inputs: int, tolerance: float
) -> tuple[Sequence[Rational], Repair | None]:
    """Return F_i = [A_i b_i], (n, n + 1), of an exactly continuous field: those given but for rounding.

    Where every facet is continuous already nothing is changed. Otherwise F̃_j = F̃_i + g G along a tree of facets;
    where the others do not close then, the g are projected to the nearest ones with which they do. A row may change by
    the tolerance, of its own terms at a facet. Raises `Discontinuous` with every facet at which it jumps by more.
    """
    lines = ([*H, h] for H, h in zip(partition.exact_H, partition.exact_h, strict=True))
    planes = [rational([line], (1, len(line))) for line in lines]  # [Hᵀ h]
    facets = partition.facets
    open_ = [f for f in facets if _across(given[f.i] - given[f.j], planes[f.k]) is None]
    if not open_:
        return given, None
    sizes = _Sizes(partition, np.array([floats(cell) for cell in given]))
    jumps = [_jump(f, given, planes, sizes) for f in open_]
    large = [jump for jump in jumps if jump.relative > tolerance]
    if large:
        raise Discontinuous(*large)
    closed = _closed(facets, given, planes, sizes.pivots)
    if closed is None:
        raise Discontinuous(*jumps)
    changes = [floats(new - old) for new, old in zip(closed, given, strict=True)]
    relative = max(sizes.relative(f, changes[i]) for f in facets for i in (f.i, f.j))
    if relative > tolerance:
        raise Discontinuous(*jumps)
    most = np.abs(changes).max(axis=0)
    B = np.zeros((len(most), inputs))
    return closed, Repair(A=readonly(most[:, :-1]), b=readonly(most[:, -1]), B=B, relative=relative)


class _Sizes:
    """How large the terms of each row are at a point of a facet of typical size, in balanced units of the states."""

    def __init__(self, partition: Partition, F: Array) -> None:
        self.F = F
        self.unit = balancing(F[:, :, :-1])
        H = partition.H * self.unit
        self.pivots = np.argmax(np.abs(H), axis=1).tolist()
        distance = np.abs(partition.h) / np.linalg.norm(H, axis=1)
        others = distance[distance > 0]
        speed = np.abs(F[:, :, :-1] / self.unit[:, None] * self.unit).max()
        offsets = np.abs(F[:, :, -1] / self.unit).max()
        usual = others.min() if len(others) else offsets / speed if offsets and speed else 1.0
        self.points = np.where(distance > 0, distance, usual)[:, None] * self.unit

    def relative(self, facet: Facet, change: Array) -> float:
        """Return the largest row of a change of F, relative to that row of the cells of a facet."""
        at = np.append(self.points[facet.k], 1.0)
        terms = np.abs(self.F[[facet.i, facet.j]]).max(axis=0) @ at
        rows = np.abs(change) @ at
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.max(np.where(rows > 0, rows / terms, 0.0), initial=0.0))


def _jump(facet: Facet, F: Sequence[Rational], planes: Sequence[Rational], sizes: _Sizes) -> Discontinuity:
    difference, plane = F[facet.i] - F[facet.j], planes[facet.k]
    left = floats(difference - _step(difference, plane, sizes.pivots[facet.k]) * plane)
    return Discontinuity(facet=facet, A=left[:, :-1], b=left[:, -1], relative=sizes.relative(facet, left))


def _step(difference: Rational, plane: Rational, pivot: int) -> Rational:
    """Return the column g that g G and a difference have in common at one entry of H."""
    return on_entries(difference, range(difference.nrows()), [pivot]) * (1 / plane[0, pivot])


def _across(difference: Rational, plane: Rational) -> Rational | None:
    """Return g with difference = g G, or None if there is none."""
    pivot = next(k for k, v in enumerate(plane.entries()) if v != 0)
    g = _step(difference, plane, pivot)
    return g if g * plane == difference else None


def _closed(
    facets: Sequence[Facet], F: Sequence[Rational], planes: Sequence[Rational], pivots: Sequence[int]
) -> list[Rational] | None:
    """Return F̃_i near F_i that are continuous across all facets, or None."""
    tree = _tree(facets, len(F))
    used = {id(edge) for edge, _, _ in tree}
    rest = [f for f in facets if id(f) not in used]

    def along(steps: Sequence[Rational]) -> list[Rational]:
        found: list[Any] = [F[0]] + [None] * (len(F) - 1)
        for (f, i, j), g in zip(tree, steps, strict=True):
            found[j] = found[i] + g * planes[f.k]
        return found

    def closes(whole: Sequence[Rational]) -> bool:
        return all(_across(whole[f.i] - whole[f.j], planes[f.k]) is not None for f in rest)

    steps = [_step(F[j] - F[i], planes[f.k], pivots[f.k]) for f, i, j in tree]
    whole = along(steps)
    if closes(whole):
        return whole
    if len(tree) * len(rest) > _MOST_CYCLES:
        return None
    whole = along(_projected(tree, rest, steps, planes, len(F)))
    return whole if closes(whole) else None


def _tree(facets: Sequence[Facet], cells: int) -> list[tuple[Facet, int, int]]:
    """Return facets with the cells (i, j) they lead from and to, such that each cell but the first is reached once."""
    beside: list[list[tuple[Facet, int]]] = [[] for _ in range(cells)]
    for f in facets:
        beside[f.i].append((f, f.j))
        beside[f.j].append((f, f.i))
    reached, tree, frontier = {0}, [], [0]
    for i in frontier:
        for f, j in beside[i]:
            if j not in reached:
                reached.add(j)
                tree.append((f, i, j))
                frontier.append(j)
    return tree


def _projected(
    tree: Sequence[tuple[Facet, int, int]],
    rest: Sequence[Facet],
    steps: Sequence[Rational],
    planes: Sequence[Rational],
    cells: int,
) -> list[Rational]:
    """Return the nearest g with Σ ± g_e G_e N = 0 around each cycle, N the null space of the plane that closes it."""
    signs = np.zeros((cells, len(tree)))  # of the steps on the way to each cell
    for e, (_, i, j) in enumerate(tree):
        signs[j] = signs[i]
        signs[j, e] = 1.0
    blocks = []
    for f in rest:
        null = left_null_space(planes[f.k].transpose()).transpose()
        way = signs[f.j] - signs[f.i]
        blocks.append(stacked([planes[edge.k] * null * int(s) for (edge, _, _), s in zip(tree, way, strict=True)]))
    M = column_space(beside(blocks))
    g = stacked([step.transpose() for step in steps])  # one row for each edge, one column for each state equation
    if M.ncols():
        g = g - M * (M.transpose() * M).inv() * (M.transpose() * g)
    return [on_entries(g, [e], range(g.ncols())).transpose() for e in range(len(tree))]
