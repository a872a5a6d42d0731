"""What set-points take of the inputs: an interval that u_ff of (16) never leaves, whatever they are.

Rows on (xi, eta, y^(r), 1) are read as rows on (v, z, 1): v is (xi, y^(r)) less the middle of its box, and
eta = centre + z + M (xi less its middle).
"""

from fractions import Fraction
from itertools import accumulate
from typing import Any

from .balls import Ball, added_or, beyond, sides, stacked, unit, unlike, zero
from .bounds import Loop, leaving
from .form import coordinates, once
from .matrices import AuditFault, identity, times
from .plant import AuditedPlant
from .reading import matrix, number, packed, place
from .shape import NUMBER, PACKED, ROWS, TEXT, WHOLE, of

PART = {"of": TEXT, "k": WHOLE, "a": NUMBER, "Q": PACKED, "sizes": [NUMBER]}
KEPT = {"box": [(None, [NUMBER, NUMBER])], "start": [NUMBER], "cell": WHOLE, "centre": [NUMBER], "parts": [PART]}
KEPT |= of(ROWS, "M forms u_ff") | {"cells": [(of(ROWS, "lowest highest"), {"not_reached": [NUMBER]})]}
SHAPE = {"set_points": (None, KEPT)}


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
        (r, p, q), middle, eta = (self.r, self.p, self.q), Ball([self.middle[: self.r]]).T, Ball([self.eta]).T
        self.shift = stacked(  # by which rows on (xi, eta, y^(r), 1) are ones on (v, z, 1)
            sides(Ball(identity(r, 1)), zero(r, p + q), middle),
            sides(Ball(self.M), zero(q, p), Ball(identity(q, 1)), eta),
            sides(zero(p, r), Ball(identity(p, 1)), zero(p, q + 1)),
            unit(r + p + q + 1, r + p + q).T,
        )
        self.cells = self.rows(plant, generator)

    def rows(self, plant: AuditedPlant, generator: Any) -> list[tuple[Ball, Ball, Ball]]:
        """Return u_ff, eta', and what is nowhere negative in each cell, on (xi, eta, y^(r), 1)."""
        Z, last = Ball(matrix(generator["directions"])), [k - 1 for k in accumulate(self.degrees)]
        n, (T, _), found = self.r + self.q, coordinates(plant, generator), list[tuple[Ball, Ball, Ball]]()
        for i, (T_i, back) in enumerate(zip(T, once(Ball.inverse, T), strict=True)):
            A, b = plant.A[i], plant.b[i]
            o = stacked(*(T_i.row(k - 1) @ b if self.higher(k) else zero(1, 1) for k in range(n)))
            field = T_i @ A @ back
            rest = T_i @ b - field @ o
            X = Z @ (stacked(*map(T_i.row, last)) @ plant.B @ Z).inverse()
            u = sides(-(X @ stacked(*map(field.row, last))), X, -(X @ stacked(*map(rest.row, last))))
            rates = sides(field.rows(self.r, n), zero(self.q, self.p), rest.rows(self.r, n))
            pairs = zip(plant.cells.planes, plant.cells.signs[i], strict=True)
            planes = [[side * v for v in plane] for plane, side in pairs if side]
            H, h = Ball([plane[:-1] for plane in planes]) @ back, Ball([plane[-1:] for plane in planes])
            found.append((u, rates, sides(H, zero(len(planes), self.p), h - H @ o)))
        return found

    def higher(self, k: int) -> bool:
        """Say whether a coordinate is the derivative of the one before."""
        return k < self.r and k not in (0, *accumulate(self.degrees))

    def driving(self, i: int) -> Ball:
        """Return z' in a cell on (v, z, 1): eta' less M xi'."""
        ends, width = [*accumulate(self.degrees)], self.r + self.p + self.q + 1
        places = [self.r + ends.index(k) if k in ends else k for k in range(1, self.r + 1)]
        return self.cells[i][1] @ self.shift - Ball(self.M) @ stacked(*(unit(width, k).T for k in places))


def dot(one: list[Fraction], other: list[Fraction]) -> Fraction:
    """Return the sum of products."""
    return sum((a * b for a, b in zip(one, other, strict=True) if a and b), Fraction(0))


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the intervals of the inputs for all set-points, and what they claim."""
    content = whole["set_points"]
    kept = ToldSetPoints(content, loop.plant, whole["generator"])
    faults = list[str]()
    for k in kept.open:
        depending = [rows for cell in kept.cells for rows in (cell if len(kept.cells) > 1 else cell[:2])]
        if any(row[k] for rows in depending for row in rows.most):
            faults.append("an output that u_ff depends on has no range")
    sizes, wrong = bounded(kept, content["parts"], place(content["cell"], len(kept.cells))) if kept.q else ([], [])
    faults += wrong + intervals(kept, content, sizes)
    ends = "; ".join(f"{low} to {high}" for low, high in content["u_ff"])
    return [f"set-points: {fault}" for fault in faults], [f"set-points: whatever they are, u_ff is within {ends}"]


def bounded(kept: ToldSetPoints, parts: Any, cell: int) -> tuple[list[Fraction], list[str]]:
    """Return what all rows of z are at most, by the ellipsoids of what drives it; and what is wrong with these."""
    faults, width = list[str](), len(kept.widths)
    inside = kept.cells[cell][2] @ kept.shift
    if any(low[-1] < 0 for low in added_or(inside.centre, times(inside.radius, -1))):
        faults.append("the middle is not in its cell")
    rates = [kept.driving(i) for i in range(len(kept.cells))]
    M = [rate.T.rows(width, width + kept.q).T for rate in rates]
    acting = list(drives(kept, rates, cell))
    if [(part["of"], part["k"]) for part in parts] != [(name, k) for name, k, _, _ in acting]:
        raise AuditFault("the ellipsoids are not of what drives the internal states")
    totals = [Fraction(0)] * len(kept.forms)
    for part, (name, _, column, size) in zip(parts, acting, strict=True):
        each = [number(v) for v in part["sizes"]]
        if len(each) != len(kept.forms):
            raise AuditFault("an ellipsoid has not a size for each row")
        faults += leaving([ball for _, ball in unlike(M)], column, part, start=name == "start")
        Q, _ = packed(part["Q"])
        for line, most in zip(kept.forms, each, strict=True):
            if beyond(Ball([line]), Q, most):
                faults.append("a row of internal states is not bounded by its size")
        totals = [total + v * size for total, v in zip(totals, each, strict=True)]
    return totals, faults


def drives(kept: ToldSetPoints, rates: list[Ball], cell: int) -> Any:
    """Yield what drives z: each entry of v, as in one cell; by how much more others are; the start."""
    own, most_of_own = rates[cell], rates[cell].most
    for k, w in enumerate(kept.widths):
        if w and any(row[k] for row in most_of_own):
            yield "v", k, own.column(k), w
    others = [(rate - own).most for rate in rates if rate is not own]
    for j in range(kept.q):
        apart = [dot(rows[j][: len(kept.widths)], kept.widths) for rows in others]
        most = max(apart, default=Fraction(0)) + most_of_own[j][-1]
        if most:
            yield "rest", j, unit(kept.q, j), most
    xi = [a - b for a, b in zip(kept.start[: kept.r], kept.middle[: kept.r], strict=True)]
    z = [a - b - dot(line, xi) for a, b, line in zip(kept.start[kept.r :], kept.eta, kept.M, strict=True)]
    if any(z):
        yield "start", 0, Ball([[v] for v in z]), Fraction(1)


def intervals(kept: ToldSetPoints, content: Any, sizes: list[Fraction]) -> list[str]:
    """Return what is wrong with the intervals: multipliers say how far u_ff goes in each cell."""
    widths, faults = [*kept.widths, *sizes[: kept.q]], list[str]()
    count, ends = len(kept.cells[0][0].centre), matrix(content["u_ff"])
    if len(content["cells"]) != len(kept.cells) or [len(pair) for pair in ends] != [2] * count:
        raise AuditFault("there is not an interval for each input, or not all cells are there")
    forms, limits = Ball(kept.forms[kept.q :]), Ball([[size] for size in sizes[kept.q :]])
    beside = zero(len(forms.centre), len(kept.widths))
    slabs = [sides(beside, side, limits) for side in (forms, -forms)]
    for (u_ff, _, inside), told in zip(kept.cells, content["cells"], strict=True):
        bounds, here = stacked(inside @ kept.shift, *slabs), u_ff @ kept.shift
        if "not_reached" in told:
            if largest(zero(1, len(widths) + 1), told["not_reached"], bounds, widths) >= 0:
                faults.append("a cell that is said not to be reached may be")
            continue
        if [len(told[name]) for name in ("lowest", "highest")] != [count] * 2:
            raise AuditFault("a cell has not multipliers for each input")
        for k, (low, high, (least, most)) in enumerate(zip(told["lowest"], told["highest"], ends, strict=True)):
            row = here.row(k)
            if largest(row, high, bounds, widths) > most or largest(-row, low, bounds, widths) > -least:
                faults.append("an input may leave its interval")
    return faults


def largest(row: Ball, weights: Any, bounds: Ball, widths: list[Fraction]) -> Fraction:
    """Return what a row is at most in the box where bounds are nowhere negative, by multipliers of these."""
    each = [number(v) for v in weights]
    if len(each) != len(bounds.centre) or any(v < 0 for v in each):
        raise AuditFault("the multipliers of a cell do not fit, or one is negative")
    whole = row + Ball([each]) @ bounds if each else row
    return whole.centre[0][-1] + dot(whole.most[0][:-1], widths) + sum(r[-1] for r in whole.radius)
