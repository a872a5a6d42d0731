"""The same bounds for every plant of a box: those at its corners, and all means of them."""

from typing import Any

from .balls import Ball, frozen, sides, stacked, unlike
from .bounds import BOUNDS, Loop
from .matrices import AuditFault, Matrix
from .plant import AuditedPlant
from .reading import distinct
from .shape import NUMBER, RADII, ROWS, TEXT, of

CORNER = of([ROWS], "A b") | {"B": ROWS, "radius": RADII}
SHAPE = {"uncertain": (None, {"parameters": [[TEXT, NUMBER, NUMBER]], "corners": [CORNER], "bounds": BOUNDS})}


class UncertainLoop(Loop):
    """The same loop, where another plant runs that is a mean of some corners."""

    def __init__(self, content: Any, corners: Any, K: Matrix, L: Matrix) -> None:
        plant = AuditedPlant(content)
        super().__init__(plant, K, L, None)
        if plant.elements is not None:
            raise AuditFault("where parameters are uncertain, all cells are listed")
        if plant.loads is not None:
            raise AuditFault("uncertain parameters go without estimated loads")
        self.corners = [AuditedPlant(content | X | {"radius": content["radius"] | X["radius"]}) for X in corners]
        if not corners or any(len(corner.B[0][0]) != len(plant.B[0][0]) for corner in self.corners):
            raise AuditFault("the matrices of the corners do not fit those of the plant")

    def varying(self) -> set[int]:
        """Return the state equations in which a corner differs from the plant."""
        plant = self.plant
        return {
            k
            for corner in self.corners
            for own, other in zip((*plant.A, *plant.b, plant.B), (*corner.A, *corner.b, corner.B), strict=True)
            for k, row in enumerate(own[0])
            if row != other[0][k]
        }

    def matrices(self, name: str) -> list[Ball]:
        """Return the matrices of (e, Delta) for all corners and pairs of cells."""
        if name != "joint":
            raise AuditFault("the bounds of uncertain parameters are those of the joint loop")
        gain = Ball(self.K)
        observer, pairs = self.plant.problem("observer", self.K, self.L, None)[0], list[Ball]()
        for corner in self.corners:
            BK, off = corner.B @ gain, (self.plant.B - corner.B) @ gain
            for A_c, A in zip(corner.A, self.plant.A, strict=True):
                lower = A - A_c + off
                pairs += [stacked(sides(A_c + BK, BK), sides(lower, M.T + off)) for M in observer]
        return [pair for _, pair in unlike(pairs)]


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the bounds for all plants between some corners, and what they claim."""
    content = whole["uncertain"]
    box = UncertainLoop(whole["plant"], content["corners"], loop.K, loop.L)
    faults = [f"corner {k + 1}: {fault}" for k, corner in enumerate(box.corners) for fault in corner.faults()]
    signals = [[signal[:2] for signal in entry["signals"]] for entry in content["bounds"]]
    if [entry["channel"] for entry in content["bounds"]] != [["disturbance", k] for k in sorted(box.varying())]:
        raise AuditFault("the bounds of uncertain parameters are not those of the entries of w that vary, each once")
    if any(one != signals[0] for one in signals):
        faults.append("a signal has no bound of some entry of w")
    faults += [f"entry {entry['channel'][1] + 1}: {f}" for entry in content["bounds"] for f in box.faults(entry)]
    distinct([name for name, _, _ in content["parameters"]], "a parameter")
    names = ", ".join(name for name, _, _ in content["parameters"])
    faults += [] if names else ["none is named, and there are bounds for them"]
    count = len(box.matrices("joint"))
    different = {tuple(map(frozen, (*one.A, *one.b, one.B))) for one in box.corners}  # ends may give one plant
    said = f"uncertain parameters: {names}: {count} inequalities are proved, for {len(different)} corners"
    return [f"uncertain parameters: {fault}" for fault in faults], [said]
