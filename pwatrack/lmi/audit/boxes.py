"""Matrices that are the corners of a box: what holds for its middle and edges holds for all of them."""

from collections.abc import Callable
from fractions import Fraction
from itertools import permutations
from typing import NamedTuple

from .balls import Ball, outermost
from .matrices import Matrix, added, product, rank, spend, times, transposed


class AuditedBox(NamedTuple):
    """All middle + sum of e_k D_k with |e_k| <= 1; D_k of rank 1, the first entry but 0 of each above 0, sorted."""

    middle: Ball
    edges: list[Matrix]

    def image(self, of: Callable[[Ball], Ball]) -> "AuditedBox":
        """Return what a linear function makes of it."""
        return AuditedBox(of(self.middle), [of(Ball(D)).centre for D in self.edges])

    @property
    def factors(self) -> tuple[Matrix, Matrix]:
        """U and V, a column of one and a row of the other for each edge u v^T: the first entry of v but 0 is 1."""
        U, V = list[list[Fraction]](), list[list[Fraction]]()
        for D in self.edges:
            row = next(row for row in D if any(row))
            at = next(k for k, v in enumerate(row) if v)
            U.append([other[at] for other in D])
            V.append([v / row[at] for v in row])
        return transposed(U), V

    @property
    def corners(self) -> list[Ball]:
        """All of them."""
        found = [self.middle]
        for D in self.edges:
            found = [X + edge for X in found for edge in (Ball(D), -Ball(D))]
        return found


def boxes(matrices: list[Ball]) -> list[AuditedBox]:
    """Return the box whose corners some different matrices are, or each by itself."""
    if not matrices:
        return []
    (first, _), off = matrices[0], set[tuple[Fraction, ...]]()
    for centre, _ in matrices[1:]:
        off.add(tuple(v for row in added(centre, first, -1) for v in row))
    spend(len(off) ** 2 * len(first) * len(first[0]) / 10)
    single = [one for one in off if not any(tuple(v - w for v, w in zip(one, two, strict=True)) in off for two in off)]
    sums = [(Fraction(0),) * (len(first) * len(first[0]))]
    for one in single if 2 ** len(single) == len(matrices) else []:
        sums += [tuple(v + w for v, w in zip(one, two, strict=True)) for two in sums]
    width, halves = len(first[0]), list[list[Fraction]]()
    for one in single:
        sign = next(v for v in one if v)
        halves.append([v / 2 if sign > 0 else -v / 2 for v in one])
    edges = [[half[k : k + width] for k in range(0, len(half), width)] for half in sorted(halves)]
    if {*sums[1:]} != off or any(rank(D) != 1 for D in edges):
        return [AuditedBox(ball, []) for ball in matrices]
    middle = first
    for one in single:
        middle = added(middle, [list(one[k : k + width]) for k in range(0, len(one), width)], Fraction(1, 2))
    radii = [R for _, R in matrices if R]
    largest = [[max(each) for each in zip(*rows, strict=True)] for rows in zip(*radii, strict=True)]
    return [AuditedBox(Ball(middle, largest), edges)]


def differences(matrices: list[Ball]) -> list[AuditedBox]:
    """Return the differences of any two matrices in the hull of some different ones, in boxes; none of one."""
    found = boxes(matrices)
    if len(found) > 1:
        return boxes(outermost([one - other for one, other in permutations(matrices, 2)]))
    return [AuditedBox((one.middle - one.middle), [times(D, 2) for D in one.edges]) for one in found if one.edges]


def squares(U: Matrix, V: Matrix, T: list[Fraction]) -> Matrix:
    """Return U T^-1 U^T + V^T T V: above U e V + V^T e U^T for all diagonal e between -I and I; [] without edges."""
    if not T:
        return []
    heavy = [times([row], t)[0] for row, t in zip(V, T, strict=True)]
    light = [[v / t for v, t in zip(row, T, strict=True)] for row in U]
    return added(product(transposed(V), heavy), product(light, transposed(U)))
