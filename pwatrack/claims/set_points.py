"""What set-points take of the inputs, whatever they are: what is proved, stored and said of it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import outward
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.demand import Demand
from pwatrack.control.headroom import Headroom
from pwatrack.control.words import Words, down


@dataclass(frozen=True, kw_only=True)
class SetPoints(Claim):
    """Between what u_ff is for any reference that keeps the limits of the file."""

    demand: Demand  # that, or why it is not known
    room: Headroom | None  # what limits of the inputs leave beside it; None where there are none

    statement: ClassVar[str] = (
        "Under set_points: in continuous time, for every y_d with (xi_d, y_d^(r)) in box at all times, the generator "
        "from start: in z = eta - centre - M (xi_d - the middle of box) every row of forms is at most the sum of the "
        "sizes of parts, each times how large what it is of gets, and u_ff is within the interval of each input, "
        "without loads and their estimates; no cell that is not_reached is reached."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"set_points": None}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["SetPoints"]:
        """Yield what set-points take, where the file has limits of them: it is proved before gains are made."""
        if asked.set_points is not None:
            yield cls(demand=asked.set_points, room=asked.room)

    def data(self, controller: ProvedController) -> dict[str, Any]:
        return {} if self.demand.missing else {"set_points": self.demand.proof}

    @property
    def takes(self) -> list[list[float]]:
        """The interval of each input; none where that is not known."""
        return [] if self.demand.missing else np.column_stack([self.demand.low, self.demand.high]).tolist()

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        left = self._left
        inputs = {
            name: {"takes": ends, "left": None if left is None or not np.isfinite(left[k]) else float(left[k])}
            for k, (name, ends) in enumerate(zip(words.plant.inputs, self.takes, strict=False))
        }
        return {"set_points": {"inputs": inputs, "missing": self.demand.missing}}

    @property
    def _left(self) -> Any:
        """What is left of each input beside the reference of the file and all set-points, (m,); None for nothing."""
        return self.room.spare if self.room is not None and self.room.whatever else None

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        label, limits = "set-points", None if self.room is None else self.room.limits
        if self.demand.missing:
            of = "; what is said of limits is of the reference in the file" * (limits is not None)
            yield label, f"what any y_d within its limits takes is not known, since {self.demand.missing}{of}"
            return
        beyond = [] if limits is None else [k for k, _ in self.demand.beyond(limits)]
        loads = ", without estimates of loads" * (controller.plant.loads is not None)
        for k, (low, high) in enumerate(self.takes):
            name, unit = words.plant.inputs[k], words.units.get(words.plant.inputs[k], "")
            ends = f"{outward(low, -1)} to {outward(high, 1)} {unit}".rstrip()
            yield label, f"any y_d within its limits takes {name} from {ends}{loads}{self._leaves(k, unit, beyond)}"
            label = ""

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        """Yield where set-points may take more than the limits of an input, or that is not known."""
        if self.room is not None and not self.room.whatever:
            yield "NOT proved", "limits with set-points at run time"

    def _leaves(self, k: int, unit: str, beyond: list[int]) -> str:
        if self.room is None or k not in self.room.inputs:
            return ""
        if k in beyond:
            return ", as far as is proved: more than its limits; what is said of these is of the reference in the file"
        left = self._left
        if left is None:
            return ""  # another input may be beyond its limits
        much = f"{down(float(left[k]))} {unit}".rstrip() if left[k] else "nothing"
        return f": beside it and the reference of the file {much} is left"
