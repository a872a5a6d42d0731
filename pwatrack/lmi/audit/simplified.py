"""Cells that are merged: the field of the true plant is that of the plant of the design and bounded deviations."""

from fractions import Fraction
from typing import Any

from .balls import Ball, stacked, zero
from .bounds import BOUNDS, SIGNALS, Loop
from .elements import Element, Function
from .matrices import AuditFault, Matrix, added, spend
from .plant import AuditedPlant, at_centres
from .reading import amount, distinct, number, place
from .shape import FUNCTION, LISTED, NUMBER, TERM, TEXT, WHOLE, of

MERGED = TERM | of(WHOLE, "element first last") | {"name": TEXT, "merged": FUNCTION, "largest": NUMBER}
SPLIT = {"plant": LISTED, "merged": [MERGED], "observer_runs": TEXT, "ends_below": SIGNALS, "bounds": BOUNDS}
SHAPE = {"practical": (None, SPLIT)}
Field = list[list[Fraction]]  # [A b] less what merged elements add


class SimplifiedElement(Element):
    """direction f(row x + constant) in the true field, direction g(row x + constant) in that of the design."""

    def __init__(self, content: Any, n: int) -> None:
        super().__init__(content, n)
        self.other, self.largest = Function(content["merged"]), number(content["largest"])

    def faults(self) -> list[str]:
        """Return whether f and g differ by more than is said: at a breakpoint, or without bound."""
        f, g = self.function, self.other
        if (f.slopes[0], f.slopes[-1]) != (g.slopes[0], g.slopes[-1]):
            return ["a merged element deviates without bound"]
        gaps = [abs(f.at(s) - g.at(s)) for s in (*f.breakpoints, *g.breakpoints)]
        return ["a merged element deviates by more than is said"] if max(gaps) > self.largest else []

    def part(self, function: Function, plant: AuditedPlant, cell: int) -> Field:
        """Return what it adds to [A b] in a cell of a plant."""
        low: Fraction | None = None
        high: Fraction | None = None
        pivot = next(p for p, v in enumerate(self.row) if v)
        spend(len(plant.cells.planes))
        for plane, sign in zip(plant.cells.planes, plant.cells.signs[cell], strict=True):
            scale = plane[pivot] / self.row[pivot]
            if not sign or not scale or [scale * v for v in self.row] != plane[:-1]:
                continue
            s = self.constant - plane[-1] / scale  # where the plane is: row x = -h / scale
            if sign * scale > 0:
                low = s if low is None else max(low, s)
            else:
                high = s if high is None else min(high, s)
        line = function.line(function.segment(low, high), self.row, self.constant)
        return [[d * v for v in line] for d in self.direction]


class Deviations(Loop):
    """The loop of the design, where the true plant runs: driven by what merged elements leave out."""

    def __init__(self, plant: AuditedPlant, content: Any, K: Matrix, L: Matrix, X: Ball | None) -> None:
        super().__init__(plant, K, L, X)
        n = len(plant.B[0])
        self.true, self.watched = AuditedPlant(content["plant"]), content["observer_runs"] == "all cells"
        if plant.elements or self.true.elements:
            raise AuditFault("where cells are merged, all of them are listed")
        self.elements = [SimplifiedElement(one, n) for one in content["merged"]]
        true = self.true
        same = (true.B, true.C, true.tracked) == (plant.B, plant.C, plant.tracked)
        if not self.elements or not same or true.loads != plant.loads or (self.watched and plant.loads):
            raise AuditFault("the true plant is not that of the design but for merged cells")

    def differs(self) -> bool:
        """Say whether the fields, each less what merged elements add to it, differ in cells that may meet."""
        true, plant = self.true, self.plant
        rest = [self.rest(true, i, [(e, e.function) for e in self.elements]) for i in range(len(true.A))]
        other = [self.rest(plant, j, [(e, e.other) for e in self.elements]) for j in range(len(plant.A))]
        places = {(plane[0], plane[1]): k for k, plane in enumerate(true.cells.parallel)}
        shared = [
            (places[direction, offset], k, turned * true.cells.parallel[places[direction, offset]][2])
            for k, (direction, offset, turned) in enumerate(plant.cells.parallel)
            if (direction, offset) in places
        ]
        for i, signs in enumerate(true.cells.signs):
            for j, others in enumerate(plant.cells.signs):
                spend(1 + len(shared) / 10)
                apart = any(signs[k] * others[p] * same < 0 for k, p, same in shared)
                if not apart and rest[i] != other[j]:
                    return True
        return False

    def rest(self, plant: AuditedPlant, cell: int, parts: list[tuple[SimplifiedElement, Function]]) -> Field:
        """Return [A b] of a cell less what merged elements add."""
        field = [[*row, *b] for row, b in zip(plant.A[cell][0], plant.b[cell][0], strict=True)]
        for element, function in parts:
            field = added(field, element.part(function, plant, cell), -1)
        return field

    def drive(self, loop: str, channel: Any) -> Ball:
        """Return the column by which a deviation enters a loop."""
        if channel[0] != "deviation":
            raise AuditFault("a bound of what is merged is one of a deviation")
        element = self.elements[place(channel[1], len(self.elements))]
        e, N = Ball([[v] for v in element.direction]), len(self.L)
        Delta = zero(N, 1) if self.watched else -stacked(e, zero(N - len(element.direction), 1))
        return {"joint": stacked(e, Delta), "controller": e, "observer": Delta}[loop]


def decided(of_design: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with a split of the true field and with its bounds, and what they claim."""
    content = whole["practical"]
    loop = Deviations(of_design.plant, content, of_design.K, of_design.L, of_design.X)
    tracked = whole["tracking"]  # what goes with the reference: "output" or "state"
    faults = [f"true plant: {fault}" for fault in loop.true.faults()]
    faults += [fault for element in loop.elements for fault in element.faults()]
    if loop.differs():
        faults.append("the true field is not that of the design and what is merged")
    if [entry["channel"] for entry in content["bounds"]] != [["deviation", k] for k in range(len(loop.elements))]:
        raise AuditFault("what is merged has not its bounds")
    faults += [f"bound of {entry['channel']}: {fault}" for entry in content["bounds"] for fault in loop.faults(entry)]
    known = [{(kind, k): number(size) for kind, k, size in entry["signals"]} for entry in content["bounds"]]
    count, wanted = len(loop.elements), len(loop.plant.tracked[0] if tracked == "output" else loop.plant.B[0])
    told = [(kind, k) for kind, k, _ in content["ends_below"]]
    distinct(told, "a signal of ends_below")
    if not {(tracked, k) for k in range(wanted)} <= {*told}:
        raise AuditFault("ends_below has not all that is tracked")
    for kind, k, size in content["ends_below"]:
        total = sum(e.largest * sizes[kind, k] for e, sizes in zip(loop.elements, known, strict=True))
        if total > number(size):
            faults.append(f"{kind} {k} does not end below {size}")
    sizes = ", ".join(str(size) for kind, _, size in content["ends_below"] if kind == tracked)
    said = f"practical tracking: the field of {len(loop.true.A)} cells is that and {amount(count, 'bounded deviation')}"
    said = f"{said}; what is tracked ends below {sizes}{at_centres(whole)}"
    return [f"practical tracking: {fault}" for fault in faults], [said]
