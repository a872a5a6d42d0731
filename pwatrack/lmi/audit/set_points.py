"""What set-points take of the inputs: an interval that u_ff of (16) never leaves, whatever they are.

Rows on (xi, eta, y^(r), 1) are read as rows on (v, z, 1): v is (xi, y^(r)) less the middle of its box, and
eta = centre + z + M (xi less its middle).
"""

from fractions import Fraction
from itertools import accumulate
from typing import Any, NamedTuple

from .balls import Ball, beyond, falls, sides, squared, stacked, unlike, zero
from .bounds import Loop
from .form import coordinates, once
from .matrices import AuditFault, added, definite, identity, spend, times
from .plant import AuditedPlant
from .reading import matrix, number, packed, place
from .shape import NUMBER, PACKED, ROWS, TEXT, WHOLE, of

PART = {"of": TEXT, "k": WHOLE, "a": NUMBER, "Q": PACKED, "sizes": [NUMBER]}
KEPT = {"box": [(None, [NUMBER, NUMBER])], "start": [NUMBER], "cell": WHOLE, "centre": [NUMBER], "parts": [PART]}
KEPT |= of(ROWS, "M forms u_ff") | {"cells": [(of(ROWS, "lowest highest"), {"not_reached": [NUMBER]})]}
SHAPE = {"set_points": (None, KEPT)}


class Row(NamedTuple):
    """A row of numbers, and by how much each may be off."""

    at: list[Fraction]
    off: list[Fraction]

    @property
    def sizes(self) -> list[Fraction]:
        """Return the largest size of each number."""
        return [abs(v) + r for v, r in zip(*self, strict=True)]


class ToldSetPoints:
    """What is told of set-points, for a plant in its normal form."""

    def __init__(self, content: Any, plant: AuditedPlant, generator: Any) -> None:
        if generator is None or plant.elements is not None:
            raise AuditFault("what set-points take is of output tracking, with all cells listed")
        self.degrees = generator["relative_degrees"]
        n, self.p, self.r = len(plant.B[0]), len(self.degrees), sum(self.degrees)
        self.q = n - self.r
        ends = [entry and [number(v) for v in entry] for entry in content["box"]]
        self.open = [k for k, entry in enumerate(ends) if entry is None]
        firsts = [0, *accumulate(self.degrees[:-1])]
        self.middle = [(low + high) / 2 for low, high in (entry or [Fraction(0)] * 2 for entry in ends)]
        self.widths = [(high - low) / 2 for low, high in (entry or [Fraction(0)] * 2 for entry in ends)]
        self.eta, self.M = [number(v) for v in content["centre"]], matrix(content["M"])
        self.start, self.forms = [number(v) for v in content["start"]], matrix(content["forms"])
        fits = (len(ends), len(self.eta), len(self.start)) == (self.r + self.p, self.q, n)
        fits = fits and [len(row) for row in self.M] == [self.r] * self.q
        fits = fits and {len(row) for row in self.forms} <= {self.q} and self.forms[: self.q] == identity(self.q, 1)
        if not fits or any(k not in firsts for k in self.open) or min(self.widths) < 0:
            raise AuditFault("what set-points keep does not fit the plant")
        if any(v for k, v in enumerate(self.middle) if k not in firsts):
            raise AuditFault("a derivative is not as large upward as downward")
        self.cells = self.rows(plant, generator)

    def rows(self, plant: AuditedPlant, generator: Any) -> list[tuple[list[Row], list[Row], list[Row]]]:
        """Return u_ff, eta', and what is nowhere negative in each cell, on (xi, eta, y^(r), 1)."""
        Z, last = Ball(matrix(generator["directions"])), [k - 1 for k in accumulate(self.degrees)]
        T, _ = coordinates(plant, generator)
        found = list[tuple[list[Row], list[Row], list[Row]]]()
        for i, (T_i, back) in enumerate(zip(T, once(Ball.inverse, T), strict=True)):
            A, b = plant.A[i], plant.b[i]
            o = stacked(*(T_i.row(k - 1) @ b if self.higher(k) else zero(1, 1) for k in range(len(T_i.centre))))
            whole = T_i @ A @ back
            field = sides(whole, T_i @ b - whole @ o)
            X = Z @ (stacked(*map(T_i.row, last)) @ plant.B @ Z).inverse()
            u = sides(-(X @ stacked(*map(field.row, last))), X)
            inside = list[Row]()
            for plane, side in zip(plant.cells.planes, plant.cells.signs[i], strict=True):
                if side:
                    *line, constant = (side * v for v in plane)
                    H = Ball([line]) @ back
                    inside.append(self.ordered(sides(H, Ball([[constant]]) - H @ o), 0))
            rates = [self.ordered(field, self.r + j) for j in range(self.q)]
            found.append(([self.ordered(u, k) for k in range(len(X.centre))], rates, inside))
        return found

    def higher(self, k: int) -> bool:
        """Say whether a coordinate is the derivative of the one before."""
        return k < self.r and k not in (0, *accumulate(self.degrees))

    def ordered(self, ball: Ball, k: int) -> Row:
        """Return a row of a matrix on (xi, eta, 1, y^(r)), or on (xi, eta, 1), as one on (xi, eta, y^(r), 1)."""
        n, row = self.r + self.q, (ball.centre[k], (ball.radius or times(ball.centre, 0))[k])
        return Row(*([*v[:n], *(v[n + 1 :] or [Fraction(0)] * self.p), v[n]] for v in row))

    def moved(self, row: Row) -> Row:
        """Return a row on (xi, eta, y^(r), 1) as one on (v, z, 1)."""
        r, n = self.r, self.r + self.q
        found = list[list[Fraction]]()
        size = [[[abs(v) for v in line] for line in self.M], *([abs(v) for v in x] for x in (self.middle, self.eta))]
        for v, (M, middle, eta) in zip(row, ([self.M, self.middle, self.eta], size), strict=True):
            xi = [v[k] + sum((v[r + j] * M[j][k] for j in range(self.q)), Fraction(0)) for k in range(r)]
            constant = v[-1] + dot(v[:r], middle[:r]) + dot(v[r:n], eta)
            found.append([*xi, *v[n:-1], *v[r:n], constant])
            spend(r * self.q + len(v))
        return Row(*found)

    def driving(self, i: int) -> list[Row]:
        """Return z' in a cell on (v, z, 1): eta' less M xi'."""
        found, firsts = [self.moved(row) for row in self.cells[i][1]], [0, *accumulate(self.degrees)]
        for row, line in zip(found, self.M, strict=True):
            for k, v in enumerate(line):
                row.at[self.r + firsts.index(k + 1) - 1 if k + 1 in firsts else k + 1] -= v
        return found


def dot(one: list[Fraction], other: list[Fraction]) -> Fraction:
    """Return the sum of products."""
    return sum((a * b for a, b in zip(one, other, strict=True) if a and b), Fraction(0))


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the intervals of the inputs for all set-points, and what they claim."""
    content = whole["set_points"]
    if content is None:
        return [], []
    kept = ToldSetPoints(content, loop.plant, whole["generator"])
    faults = list[str]()
    for k in kept.open:
        unlike_cells = kept.cells if len(kept.cells) > 1 else [(*cell[:2], list[Row]()) for cell in kept.cells]
        if any(row.sizes[k] for cell in unlike_cells for rows in cell for row in rows):
            faults.append("an output that u_ff depends on has no range")
    sizes, wrong = bounded(kept, content["parts"], place(content["cell"], len(kept.cells))) if kept.q else ([], [])
    faults += wrong + intervals(kept, content, sizes)
    ends = "; ".join(f"{low} to {high}" for low, high in content["u_ff"])
    return [f"set-points: {fault}" for fault in faults], [f"set-points: whatever they are, u_ff is within {ends}"]


def bounded(kept: ToldSetPoints, parts: Any, cell: int) -> tuple[list[Fraction], list[str]]:
    """Return what all rows of z are at most, by the ellipsoids of what drives it; and what is wrong with these."""
    faults, q, width = list[str](), kept.q, len(kept.widths)
    point = [*kept.middle[: kept.r], *kept.eta, *[Fraction(0)] * kept.p, Fraction(1)]
    if any(dot(row.at, point) < dot(row.off, [abs(v) for v in point]) for row in kept.cells[cell][2]):
        faults.append("the middle is not in its cell")
    rates = [kept.driving(i) for i in range(len(kept.cells))]
    M = [Ball([row.at[width:-1] for row in rate], [row.off[width:-1] for row in rate]) for rate in rates]
    acting = list(drives(kept, rates, cell))
    if [(part["of"], part["k"]) for part in parts] != [(name, k) for name, k, _, _ in acting]:
        raise AuditFault("the ellipsoids are not of what drives the internal states")
    totals = [Fraction(0)] * len(kept.forms)
    for part, (name, _, column, size) in zip(parts, acting, strict=True):
        each = [number(v) for v in part["sizes"]]
        if len(each) != len(kept.forms):
            raise AuditFault("an ellipsoid has not a size for each row")
        if not stays([ball for _, ball in unlike(M)], column, part, start=name == "start"):
            faults.append("an ellipsoid of internal states can be left")
        Q, _ = packed(part["Q"])
        for line, most in zip(kept.forms, each, strict=True):
            if beyond(Ball([line]), Q, most):
                faults.append("a row of internal states is not bounded by its size")
        totals = [total + v * size for total, v in zip(totals, each, strict=True)]
    return totals, faults if q else []


def drives(kept: ToldSetPoints, rates: list[list[Row]], cell: int) -> Any:
    """Yield what drives z: each entry of v, as in one cell; by how much more others are; the start."""
    own, q, one = rates[cell], range(kept.q), Fraction(1)
    for k, w in enumerate(kept.widths):
        if w and any(row.sizes[k] for row in own):
            yield "v", k, Ball([[row.at[k]] for row in own], [[row.off[k]] for row in own]), w
    for j in q:
        most = Fraction(0)
        for rate in rates:
            if rate is not own:
                pairs = zip(rate[j].at, own[j].at, rate[j].off, own[j].off, strict=True)
                off = [abs(a - b) + r + s for a, b, r, s in pairs]
                most = max(most, dot(off[: len(kept.widths)], kept.widths))
        most += own[j].sizes[-1]
        if most:
            yield "rest", j, Ball([[one * (i == j)] for i in q]), most
    xi = [a - b for a, b in zip(kept.start[: kept.r], kept.middle[: kept.r], strict=True)]
    z = [a - b - dot(line, xi) for a, b, line in zip(kept.start[kept.r :], kept.eta, kept.M, strict=True)]
    if any(z):
        yield "start", 0, Ball([[v] for v in z]), one


def stays(matrices: list[Ball], column: Ball, part: Any, *, start: bool) -> bool:
    """Decide whether z from 0 on, driven by a column of at most 1, or from that column on, stays in an ellipsoid."""
    (Q, powers), rate = packed(part["Q"]), number(part["a"])
    if rate <= 0 or not definite(Q) or (start and not definite(added(Q, squared(column)[0], -1))):
        return False
    push = () if start else squared(column, 1 / rate)
    return all(falls(X, Q, powers, *push, rate=rate / 2) for X in matrices)


def intervals(kept: ToldSetPoints, content: Any, sizes: list[Fraction]) -> list[str]:
    """Return what is wrong with the intervals: multipliers say how far u_ff goes in each cell."""
    widths, faults = [*kept.widths, *sizes[: kept.q]], list[str]()
    count, ends, zero = len(kept.cells[0][0]), matrix(content["u_ff"]), [Fraction(0)] * len(kept.widths)
    if len(content["cells"]) != len(kept.cells) or [len(pair) for pair in ends] != [2] * count:
        raise AuditFault("there is not an interval for each input, or not all cells are there")
    slabs = [
        Row([*zero, *(sign * v for v in line), size], [Fraction(0)] * (len(widths) + 1))
        for sign in (1, -1)
        for line, size in zip(kept.forms[kept.q :], sizes[kept.q :], strict=True)
    ]
    for (u_ff, _, inside), told in zip(kept.cells, content["cells"], strict=True):
        bounds = [*(kept.moved(row) for row in inside), *slabs]
        if "not_reached" in told:
            nothing = Row([Fraction(0)] * (len(widths) + 1), [Fraction(0)] * (len(widths) + 1))
            if largest(nothing, told["not_reached"], bounds, widths) >= 0:
                faults.append("a cell that is said not to be reached may be")
            continue
        if [len(told[name]) for name in ("lowest", "highest")] != [count] * 2:
            raise AuditFault("a cell has not multipliers for each input")
        for row, low, high, (least, most) in zip(u_ff, told["lowest"], told["highest"], ends, strict=True):
            here = kept.moved(row)
            negative = Row([-v for v in here.at], here.off)
            if largest(here, high, bounds, widths) > most or largest(negative, low, bounds, widths) > -least:
                faults.append("an input may leave its interval")
    return faults


def largest(row: Row, weights: Any, bounds: list[Row], widths: list[Fraction]) -> Fraction:
    """Return what a row is at most in the box where bounds are nowhere negative, by multipliers of these."""
    each = [number(v) for v in weights]
    if len(each) != len(bounds) or any(v < 0 for v in each):
        raise AuditFault("the multipliers of a cell do not fit, or one is negative")
    at, off = list(row.at), list(row.off)
    for weight, bound in zip(each, bounds, strict=True):
        if weight:
            at = [a + weight * b for a, b in zip(at, bound.at, strict=True)]
            off = [a + weight * b for a, b in zip(off, bound.off, strict=True)]
            spend(2 * len(at))
    return at[-1] + off[-1] + dot([abs(a) + b for a, b in zip(at[:-1], off[:-1], strict=True)], widths)
