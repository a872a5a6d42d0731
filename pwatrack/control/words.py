"""How signals, what acts on them, and numbers are written: the same in files, at the terminal and in pictures."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_FLOOR, Context
from typing import Literal

from pwatrack.arrays import Array, number_text, up
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.goal import Goal
from pwatrack.lmi.inequality import Role
from pwatrack.model.conditions import Conditions, per_second
from pwatrack.model.loads import Load
from pwatrack.model.pwa import PWASystem

Kind = Literal["disturbance", "noise", "load", "start", "uncertain"]


@dataclass(frozen=True, kw_only=True)
class Words:
    """What a problem calls its signals, and what it asks: enough to say what was proved of it."""

    plant: PWASystem  # as it was described
    units: Mapping[str, str]  # unit of each signal that has one
    sizes: Collection[str]  # signals that were given a size
    conditions: Conditions  # what is not as the theorems assume in a simulation
    goals: Mapping[Role, Goal]  # what each gain is to achieve

    def signal(self, form: Form) -> tuple[str, str]:
        """Return a signal that is bounded, as text, and its unit."""
        kind, k = form
        plant = self.plant
        of = {"output": plant.tracked_names, "measured": plant.outputs, "input": plant.inputs}
        named = of.get(kind, plant.states)
        name = named[k] if k < len(named) else self._loads[k - len(named)]
        texts = {"input": f"{name} - {name}_ff", "estimate": f"{name}_hat - {name}"}
        return texts.get(kind, f"{name} - {name}_d"), self.units.get(name, "")

    def form(self, name: str) -> Form:
        """Return what a name of something tracked, of a state or of a measured output stands for; in this order."""
        plant = self.plant
        of: Mapping[Literal["output", "state", "measured"], Sequence[str]] = {
            "output": plant.tracked_names,
            "state": plant.states,
            "measured": plant.outputs,
        }
        return next((kind, names.index(name)) for kind, names in of.items() if name in names)

    def cause(self, channel: Channel, *, uncertain: bool = False) -> tuple[Kind, str, str]:
        """Return what acts: its kind, where or what it is, and its unit. On dv/dt that is the one of v per second."""
        kind, k = channel
        plant, units = self.plant, self.units
        n = len(plant.states)
        if kind == "noise":
            return "noise", f"measured {plant.outputs[k]}", units.get(plant.outputs[k], "")
        if kind == "disturbance":
            name = plant.states[k]
            where = f"w in d{name}/dt" if uncertain else f"d{name}/dt"
            return "uncertain" if uncertain else "disturbance", where, per_second(units.get(name, ""))
        if k < 2 * n:
            name = plant.states[k % n]
            return "start", f"{name} - {name}_d" if k < n else f"{name}_hat - {name}", units.get(name, "")
        name = self._loads[k - 2 * n]
        return "load", name, units.get(name, "")

    @property
    def _loads(self) -> Mapping[int, str]:
        loads = self.plant.loads
        return {} if loads is None else dict(zip(loads.where, loads.names, strict=True))

    def declared(self, channel: Channel) -> bool:
        """Whether the simulation has this disturbance or noise."""
        kind, k = channel
        disturbance, noise = self.conditions.disturbance, self.conditions.noise
        if kind == "noise":
            return noise is not None and bool(noise.std[k])
        return disturbance is not None and bool(disturbance.Q[k].any())

    @property
    def as_designed(self) -> str:
        """What is added to what is proved of a run with the plant of the design, where another one runs."""
        return ", with the plant as designed" * self.conditions.another_plant

    @property
    def undisturbed(self) -> str:
        """What is added to what is proved of a loop that nothing disturbs, where something does in a run."""
        return " while nothing disturbs" * (not self.conditions.beside(self.plant.loads).undisturbed)

    @property
    def off_limits(self) -> str:
        """What is added to what is proved of a loop without limits, where inputs, or their rates, have some."""
        limited, slowed = self.conditions.limits is not None, self.conditions.rates is not None
        held = ["is at a limit"] * limited + ["changes as fast as it may"] * slowed
        return f", while no input {' or '.join(held)}" if held else ""

    def limits(self, sizes: Iterable[tuple[Form, float]]) -> Iterator[str]:
        """Yield the bounds of signals in words, rounded up."""
        for form, size in sizes:
            name, unit = self.signal(form)
            yield f"{sized(name)} ≤ {up(size)} {unit}".rstrip()

    def unit_of_tracked(self) -> str:
        """Return the unit of all that is tracked, where they have one."""
        units = {self.units.get(name, "") for name in self.plant.tracked_names}
        return units.pop() if len(units) == 1 else ""


def all_cells(count: int) -> str:
    """Return all cells of a plant in words."""
    return "the one cell" if count == 1 else f"all {count} cells"


def load_kind(load: Load) -> str:
    """Return what is known of an unknown load."""
    return f"{number_text(float(load.frequency), 'g')} rad/s" if load.frequency.centre else "constant"


def sized(name: str) -> str:
    """Return the size of a signal in words."""
    return f"|{name.replace('-', '−')}|"


def down(value: float) -> str:
    """Return a number in four digits, not larger: what is said must be proved too.

    Example:
        >>> down(0.0826799), down(1.4009)
        ('0.08267', '1.4')
    """
    return number_text(float(Context(prec=4, rounding=ROUND_FLOOR).create_decimal(value)), ".4g")


def matrix_text(X: Array) -> str:
    """Return a matrix in a line."""
    return "[" + "; ".join(" ".join(map(number_text, row)) for row in X) + "]"
