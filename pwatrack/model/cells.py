"""Hyperplanes H_jᵀx + h_j = 0, the polyhedral cells Λ_i they bound, and the facets between cells."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from fractions import Fraction
from functools import cached_property
from itertools import chain, islice
from typing import Any

import numpy as np

from pwatrack.arrays import EPS, Array, IntArray, readonly
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem, ProblemPart
from pwatrack.model.hyperplanes import Arrangement, TooMany, arrangement, claims, merge
from pwatrack.model.polyhedron import (
    Row,
    borders,
    coordinates,
    interior_point,
    oriented,
    primitive,
    value,
)
from pwatrack.model.tiling import Tiling
from pwatrack.real import Real

_SIZES = Fraction(1, 10**100), Fraction(10**100)  # of the largest entry of a normal, beyond which it is rescaled


@dataclass(frozen=True)
class Facet:
    """Cells `i` and `j` touch along hyperplane `k` in a set of dimension n − 1."""

    i: int
    j: int
    k: int


@dataclass(frozen=True, kw_only=True)
class Partition:
    """Polyhedral cells that cover ℝⁿ, as in Section II of the paper.

    Cell i is the set of x with `signs[i, j] * (H[j] @ x + h[j]) >= 0` for all j; a sign of 0 means that hyperplane j
    does not bound the cell. Which cells have an interior, share a facet, overlap or leave a hole is decided for the
    exact numbers, in whole numbers, whatever their sizes.

    Example:
        >>> halves = Partition.create(H=[[1.0]], h=[0.0], signs=[[-1], [1]], names=["left", "right"])
        >>> halves.names[halves.locate(np.array([3.0]))]
        'right'
    """

    H: Array  # normals of the hyperplanes, (k, n): the doubles nearest to `exact_H`
    h: Array  # offsets of the hyperplanes, (k,): likewise
    signs: IntArray  # side of each hyperplane that each cell is on, (l, k), entries −1, 0, 1
    names: tuple[str, ...]  # name of each cell, l of them
    # as they were written, of a ball the middle; beyond 1e±100 over the largest entry
    exact_H: tuple[tuple[Fraction, ...], ...]
    exact_h: tuple[Fraction, ...]  # likewise
    complete: bool = False  # whether they are all regions of the hyperplanes, by construction: nothing is left to prove
    repair: float = 0.0  # largest change of a border that two cells write with different roundings, of its numbers
    remarks: tuple[str, ...] = ()  # what was noticed when it was made

    @classmethod
    def create(cls, *, H: object, h: object, signs: object, names: Sequence[str]) -> "Partition":
        """Check the shapes, merge hyperplanes that are the same set, and return the partition.

        H is (k, n), h (k,), signs (l, k): int, Fraction, `Real`, or float, which means the decimal that it is printed
        as. Hyperplanes whose numbers differ by at most 1e-12 of themselves are merged too, where no cell is between
        them: the first one stands for both, and a remark says so.

        Raises ValueError if the shapes do not fit, a number is not finite or a normal is 0; InvalidSpec for an offset
        beyond the range of a double.
        """
        cell_names = tuple(names)
        sign_table = np.array(signs, dtype=np.int64).reshape(len(cell_names), -1)
        planes, n = _exact_planes(H, h, sign_table.shape[1])
        found = merge([primitive(plane) for plane in planes], sign_table)
        remarks = []
        for k, other, size in found.repairs:
            one, first = (cell_names[int(np.argmax(sign_table[:, j] != 0))] for j in (k, other))
            remarks.append(
                f"the borders of cells '{first}' and '{one}' differ by {float(size):.1e} of their numbers: "
                f"they are taken for one, as '{first}' writes it"
            )
        created = cls._of([planes[k] for k in found.kept], n, found.signs, cell_names)
        repair = float(max((size for *_, size in found.repairs), default=Fraction(0)))
        return replace(created, repair=repair, remarks=tuple(remarks))

    @classmethod
    def regions(cls, *, H: object, h: object, most: int) -> "Partition":
        """Return all regions that some hyperplanes cut ℝⁿ into, as cells without names; InvalidSpec for too many.

        They cover ℝⁿ and do not overlap, as each is the set of all x with its signs; two of them share a facet if
        and only if they differ in one sign. Hyperplanes are merged only where they are exactly the same.
        """
        planes, n = _exact_planes(H, h, None)
        kept: dict[Row, list[Fraction]] = {}
        for plane in planes:
            kept.setdefault(oriented(primitive(plane))[0], plane)
        planes = list(kept.values())
        try:
            found = arrangement([primitive(plane) for plane in planes], most)
        except TooMany:
            message = f"{len(planes)} hyperplanes make more than {most:,} cells"
            raise InvalidSpec(message, subject=(ProblemPart.PLANT,), hint="fewer nonlinearities") from None
        bits = np.array([[region >> k & 1 for k in range(len(planes))] for region in found.points], dtype=np.int64)
        signs = 2 * bits.reshape(len(found.points), len(planes)) - 1
        return replace(cls._of(planes, n, signs, ("",) * len(signs)), complete=True)

    @classmethod
    def _of(cls, planes: list[list[Fraction]], n: int, signs: IntArray, names: tuple[str, ...]) -> "Partition":
        exact = [_rescaled(plane) for plane in planes]
        try:
            doubles = np.array([[float(v) for v in plane] for plane in exact]).reshape(len(exact), n + 1)
        except OverflowError:
            problem = Problem(
                message="a border of the cells lies beyond the range of numbers", subject=(ProblemPart.PLANT,)
            )
            raise InvalidSpec(problem) from None
        return cls(
            H=readonly(doubles[:, :-1]),
            h=readonly(doubles[:, -1]),
            signs=_frozen(signs),
            names=names,
            exact_H=tuple(tuple(plane[:-1]) for plane in exact),
            exact_h=tuple(plane[-1] for plane in exact),
        )

    def locate(self, x: Array) -> int:
        """Return the cell that contains x (n,), the first one if x lies on a facet."""
        sides = self.H @ x + self.h
        doubt = (len(x) + 3) * EPS * (np.abs(self.H) @ np.abs(x) + np.abs(self.h)) + 1e-300
        for k in np.flatnonzero((np.abs(sides) <= doubt) & np.isfinite(doubt)):
            side = value(self.rows[k], primitive([*map(Fraction, x.tolist()), Fraction(1)]))
            sides[k] = (side > 0) - (side < 0)
        return int(np.argmax((self.signs * np.sign(sides) >= 0).all(axis=1)))

    def between(self, i: int, j: int) -> list[int]:
        """Return the hyperplanes that cells i and j are on opposite sides of."""
        return [int(k) for k in np.flatnonzero(self.signs[i] * self.signs[j] < 0)]

    @cached_property
    def facets(self) -> tuple[Facet, ...]:
        """All pairs of cells that share a facet, a set of dimension n − 1; of a partition that passes `check`."""
        if self._cells is None:
            numbers = {oriented(row)[0]: k for k, row in reversed(list(enumerate(self.rows)))}
            found = [Facet(min(i, j), max(i, j), numbers[plane]) for i, j, plane in self._tiling.facets()]
        else:  # regions that differ in one sign: a line from one to the other crosses no other hyperplane
            signs = ((region, i, k) for region, i in self._cells.items() for k in range(len(self.h)))
            beside = ((i, self._cells.get(region ^ 1 << k, -1), k) for region, i, k in signs)
            found = [Facet(i, j, k) for i, j, k in beside if j > i]
        return tuple(sorted(found, key=lambda facet: (facet.i, facet.j)))

    @cached_property
    def empty_cells(self) -> tuple[int, ...]:
        """The cells whose inequalities leave them no interior; nothing is lost without them."""
        if self.complete:
            return ()
        full = self._tiling.cells if self._cells is None else self._cells.values()
        return tuple(sorted(set(range(len(self.names))).difference(full)))

    def without(self, left_out: Collection[int]) -> "Partition":
        """Return the partition without some of its cells, and without the hyperplanes that then bound none."""
        kept = [i for i in range(len(self.names)) if i not in left_out]
        used = [int(k) for k in np.flatnonzero(self.signs[kept].any(axis=0))]
        return replace(
            self,
            H=readonly(self.H[used]),
            h=readonly(self.h[used]),
            signs=_frozen(self.signs[kept][:, used]),
            names=tuple(self.names[i] for i in kept),
            exact_H=tuple(self.exact_H[k] for k in used),
            exact_h=tuple(self.exact_h[k] for k in used),
            complete=self.complete and len(kept) == len(self.names),
        )

    def ordered(self, order: Sequence[int] | IntArray, names: tuple[str, ...]) -> "Partition":
        """Return the same cells in another order, with these names."""
        return replace(self, signs=_frozen(self.signs[order]), names=names)

    def sides(self, *, H: object, h: object) -> IntArray:
        """Return the side of some hyperplanes of the partition that each cell is on, (l, k)."""
        own = [oriented(row) for row in self.rows]
        numbers = {plane: k for k, (plane, _) in enumerate(own)}
        given = [oriented(primitive(plane)) for plane in _exact_planes(H, h, None)[0]]
        places = [numbers[plane] for plane, _ in given]
        turned: IntArray = np.array([side * own[k][1] for k, (_, side) in zip(places, given, strict=True)])
        return self.signs[:, places] * turned

    def check(self) -> None:
        """Prove that the cells do not overlap and cover ℝⁿ; raise a problem per overlapping pair, or one for a hole."""
        if self.complete:
            return
        cells, arranged = self._cells, self._arrangement
        if cells is None or arranged is None:
            problems = self._faults()
        else:  # all cells are different regions: they do not overlap
            missing = (region for region in arranged.points if region not in cells)
            problems = [_hole(arranged.point(region, self.H.shape[1])) for region in islice(missing, 1)]
        if problems:
            raise OutsideTheory(*problems)

    def interior_point(self, signs: IntArray) -> tuple[Fraction, ...] | None:
        """Return an inner point (n,) of the polyhedron of a sign vector (k,), or None if it has no interior."""
        point = interior_point(claims(self.rows, signs), self.H.shape[1])
        return None if point is None else coordinates(point)

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """The hyperplanes in whole numbers (H_j, h_j), times a positive factor each."""
        return tuple(primitive([*H, h]) for H, h in zip(self.exact_H, self.exact_h, strict=True))

    @cached_property
    def _arrangement(self) -> Arrangement | None:
        """All regions of the hyperplanes, where every cell claims a side of every one and the cells may be all."""
        distinct = len({oriented(row)[0] for row in self.rows}) == len(self.rows)
        if not distinct or not self.signs.all() or len(set(self._regions)) < len(self.names):
            return None
        try:
            return arrangement(self.rows, 2 * len(self.names) + 100)
        except TooMany:
            return None

    @cached_property
    def _regions(self) -> list[int]:
        """The number of each cell as a region of an arrangement."""
        return [sum(1 << k for k in np.flatnonzero(row > 0).tolist()) for row in self.signs]

    @cached_property
    def _cells(self) -> dict[int, int] | None:
        """The cells with an interior by their numbers as regions; None where cells are not regions."""
        cells = {region: i for i, region in enumerate(self._regions)}
        if self.complete:
            return cells
        if self._arrangement is None:
            return None
        return {region: cells[region] for region in self._arrangement.points if region in cells}

    @cached_property
    def _tiling(self) -> Tiling:
        shapes = (borders(claims(self.rows, signs), self.H.shape[1]) for signs in self.signs)
        return Tiling({i: shape for i, shape in enumerate(shapes) if shape is not None}, self.H.shape[1])

    def _faults(self) -> list[Problem]:
        """Return a problem per overlapping pair, or else one for a hole."""
        faults, shapes, n = self._tiling.faults(), self._tiling.cells, self.H.shape[1]
        overlaps: dict[tuple[int, int], Any] = {}
        for point, owners in faults:
            if len(owners) > 1:
                overlaps.setdefault((owners[0], owners[1]), coordinates(point))
        for i in sorted(set(chain.from_iterable(overlaps))):  # these may overlap others too
            for j in shapes:
                pair = (min(i, j), max(i, j))
                if i != j and pair not in overlaps and borders(shapes[i] + shapes[j], n) is not None:
                    overlaps[pair] = coordinates(interior_point(shapes[i] + shapes[j], n) or ())
        if not overlaps:
            return [_hole(coordinates(point)) for point, owners in faults[:1]]
        return [
            Problem(
                message=f"cells '{self.names[i]}' and '{self.names[j]}' overlap, for example at x = {_point(witness)}",
                subject=(ProblemPart.CELLS, j),
                hint="interiors of cells must be disjoint (Section II)",
            )
            for (i, j), witness in sorted(overlaps.items())
        ]


def _frozen(signs: IntArray) -> IntArray:
    found = signs.copy()
    found.flags.writeable = False
    return found


def _exact_planes(H: Any, h: Any, count: int | None) -> tuple[list[list[Fraction]], int]:
    """Return the rows (H_j, h_j) as fractions, and n."""
    normals, offsets = np.array(H, dtype=object), np.array(h, dtype=object)
    count = len(offsets) if count is None else count
    if normals.ndim != 2 or offsets.shape != (count,) or len(normals) != count:
        raise ValueError(f"H has shape {normals.shape} and h {offsets.shape}, expected ({count}, n) and ({count},)")
    planes = [[_exact(v) for v in (*row, c)] for row, c in zip(normals.tolist(), offsets.tolist(), strict=True)]
    if not all(any(plane[:-1]) for plane in planes):
        raise ValueError("a hyperplane has a zero normal")
    return planes, normals.shape[1]


def _exact(number: Any) -> Fraction:
    return Real.of(number.item() if isinstance(number, np.generic) else number).centre


def _rescaled(plane: list[Fraction]) -> list[Fraction]:
    """Return a hyperplane with numbers that doubles can hold, where its normal is very small or very large."""
    size = max(abs(v) for v in plane[:-1])
    return plane if _SIZES[0] <= size <= _SIZES[1] else [v / size for v in plane]


def _hole(x: Sequence[Fraction]) -> Problem:
    return Problem(
        message=f"the cells do not cover the state space: no cell contains x = {_point(x)}",
        subject=(ProblemPart.CELLS,),
        hint="every state must belong to a cell (Section II)",
    )


def _point(x: Sequence[Fraction]) -> str:
    return "(" + ", ".join(f"{Decimal(v.numerator) / Decimal(v.denominator):.4g}" for v in x) + ")"
