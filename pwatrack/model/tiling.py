"""Polyhedra side by side: which share a facet, and whether they cover ℝⁿ once.

How many polyhedra contain x changes only across a facet of one of them. So they cover ℝⁿ once if they contain one
point once, and if on each hyperplane the facets seen from its two sides cover the same: mostly they are pairwise the
same facets; what is left is the same question in one dimension less. All of it in whole numbers.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from pwatrack.model.polyhedron import (
    Point,
    Row,
    borders,
    generic,
    interior_point,
    lifted,
    moved,
    oriented,
    pivot,
    restricted,
    tightest,
    value,
)

Shape = tuple[Row, ...]


@dataclass(frozen=True)
class WeightedCell:
    """A polyhedron that counts `weight` times; `shape` has its borders, `owner` is the cell that it belongs to."""

    weight: int
    shape: Shape
    owner: int


@dataclass(frozen=True)
class Tiling:
    """Polyhedra with an interior in ℝⁿ, by their number, as `polyhedron.borders` of them.

    Example: two half-lines, and what is missing.

        >>> line = Tiling({0: ((1, 0),), 1: ((-1, -1),)}, 1)
        >>> [coordinates for coordinates, owners in line.faults()]
        [(-1, 4), (-3, 4)]
    """

    cells: dict[int, Shape]
    n: int

    @cached_property
    def pieces(self) -> list[WeightedCell]:
        """The polyhedra, each counting once."""
        return [WeightedCell(1, shape, i) for i, shape in self.cells.items()]

    @cached_property
    def sheets(self) -> dict[Row, list[WeightedCell]]:
        """The facets on each hyperplane in coordinates there, counting 1 above and −1 below."""
        return _sheets(self.pieces)

    def facets(self) -> Iterator[tuple[int, int, Row]]:
        """Give all pairs of polyhedra that meet in dimension n − 1, each on a side of its own, and where."""
        for plane, pieces in self.sheets.items():
            same = defaultdict(list)
            for piece in pieces:
                same[piece.shape].append(piece)
            single = []
            for group in same.values():
                if len(group) == 2 and group[0].weight != group[1].weight:
                    yield group[0].owner, group[1].owner, plane
                else:
                    single += group
            for above in (piece for piece in single if piece.weight > 0):
                for below in (piece for piece in single if piece.weight < 0):
                    if borders(above.shape + below.shape, self.n - 1) is not None:
                        yield above.owner, below.owner, plane

    def faults(self) -> list[tuple[Point, list[int]]]:
        """Return points that are not in exactly one polyhedron, with those that they are in; none if there is none."""
        points = list(_uneven(self.pieces, self.sheets, self.n, 1))
        return [(point, [p.owner for p in self.pieces if _inside(point, p.shape)]) for point in points]


def _sheets(pieces: Sequence[WeightedCell]) -> dict[Row, list[WeightedCell]]:
    found: dict[Row, list[WeightedCell]] = defaultdict(list)
    for piece in pieces:
        for k, row in enumerate(piece.shape):
            plane, side = oriented(row)
            shape = tightest(restricted(piece.shape[:k] + piece.shape[k + 1 :], plane))
            if shape is not None:  # it never is, as the row is a border
                found[plane].append(WeightedCell(side * piece.weight, shape, piece.owner))
    for plane, facets in found.items():  # by their borders alone, but for those that cancel as they are
        weights = _weights(facets).items()
        shapes = {shape: borders(shape, len(plane) - 2) if weight else shape for shape, weight in weights}
        found[plane] = [replace(facet, shape=own) for facet in facets if (own := shapes[facet.shape]) is not None]
    return found


def _weights(pieces: Sequence[WeightedCell]) -> dict[Shape, int]:
    """Return what all pieces of each shape count together."""
    total: dict[Shape, int] = defaultdict(int)
    for piece in pieces:
        total[piece.shape] += piece.weight
    return total


def _uneven(
    pieces: Sequence[WeightedCell], sheets: dict[Row, list[WeightedCell]], n: int, wanted: int
) -> Iterator[Point]:
    """Give points, off all borders, that do not count `wanted`; none if that is what almost all points count."""
    planes, even = list(sheets), True
    for plane, facets in sheets.items():
        owner = {facet.shape: facet.owner for facet in facets}
        rest = [WeightedCell(weight, shape, owner[shape]) for shape, weight in _weights(facets).items() if weight]
        point = next(_uneven(rest, _sheets(rest), n - 1, 0), None) if rest else None
        if point is not None:
            even = False
            yield _beside(point, plane, pieces, planes, wanted)
    if even:
        inside = interior_point(pieces[0].shape if pieces else (), n)
        assert inside is not None
        point = generic(inside, planes)
        if _count(point, pieces) != wanted:
            yield point


def _beside(point: Point, plane: Row, pieces: Sequence[WeightedCell], planes: Sequence[Row], wanted: int) -> Point:
    """Return a point next to one of a hyperplane across which the count jumps."""
    others = [other for other in planes if other != plane]
    crossing = [row for row in restricted(others, plane) if any(row[:-1])]
    on = lifted(generic(point, crossing), plane)
    up = [int(j == pivot(plane)) for j in range(len(plane) - 1)]
    sides = [moved(on, [sign * v for v in up], others) for sign in (1, -1)]
    return next(side for side in sides if _count(side, pieces) != wanted)


def _count(point: Point, pieces: Sequence[WeightedCell]) -> int:
    return sum(piece.weight for piece in pieces if _inside(point, piece.shape))


def _inside(point: Point, shape: Shape) -> bool:
    return all(value(row, point) >= 0 for row in shape)
