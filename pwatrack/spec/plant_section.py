"""The section `system` as pydantic models: cells or nonlinearities, matrices, names."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from pwatrack.model.nonlinearity import (
    PiecewiseLinear,
    absolute,
    dead_zone,
    piecewise_linear,
    saturation,
    spring,
)
from pwatrack.real import Real
from pwatrack.spec.entries import (
    Exact,
    ExactRows,
    ExactVector,
    Form,
    Inequalities,
    Label,
    Names,
    Normal,
    Positive,
    Tracked,
    increasing,
)
from pwatrack.spec.section import Context, Fault, Section, distinct, named, shaped, unknown_names
from pwatrack.spec.wording import shown


class CellSection(Section):
    """One cell: where it is, and A, b there. A cell has no B of its own in class (1)."""

    model_config = ConfigDict(json_schema_extra={"not": {"required": ["where", "signs"]}})

    name: Label
    where: list[Inequalities] | None = None
    signs: list[Literal["+", "-", "0"]] | None = None
    A: Annotated[ExactRows, shaped("states", "states")]
    b: Annotated[ExactVector, shaped("states")] | None = None
    B: Annotated[ExactRows, shaped("states", "inputs")] | None = None


class HyperplaneSection(Section):
    """The set H x + h = 0."""

    H: Annotated[Normal, shaped("states")]
    h: Exact = Real.of(0)


class ElementSection(Section):
    """What all scalar nonlinearities have: s = of, and d(state)/dt += factor φ(s) for each state in `into`."""

    name: Label
    of: Form
    into: Annotated[dict[str, Exact], Field(min_length=1)]

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield what it acts on that is no state."""
        for state, meant in unknown_names(self.into, context.states) if context.states else ():
            yield Fault(f"nonlinearity '{self.name}': {shown(state)} is no state{meant}", ("into",), key=(state,))


class DeadZoneSection(ElementSection):
    """φ = 0 in [lower, upper], lines outside; a pair of elastic stops is the same."""

    model_config = ConfigDict(json_schema_extra=increasing("lower", "upper"))

    kind: Literal["dead_zone", "stop"]
    lower: Exact
    upper: Exact
    slope: Exact = Real.of(1)
    lower_slope: Exact | None = None
    upper_slope: Exact | None = None

    def function(self) -> PiecewiseLinear:
        """Return φ."""
        left = self.slope if self.lower_slope is None else self.lower_slope
        right = self.slope if self.upper_slope is None else self.upper_slope
        return dead_zone(lower=self.lower, upper=self.upper, lower_slope=left, upper_slope=right)


class SaturationSection(ElementSection):
    """φ(s) = slope · clip(s, lower, upper)."""

    model_config = ConfigDict(json_schema_extra=increasing("lower", "upper"))

    kind: Literal["saturation"]
    lower: Exact
    upper: Exact
    slope: Exact = Real.of(1)

    def function(self) -> PiecewiseLinear:
        """Return φ."""
        return saturation(lower=self.lower, upper=self.upper, slope=self.slope)


class SpringSection(ElementSection):
    """φ(s) = slope · max(0, s − start)."""

    kind: Literal["spring"]
    start: Exact = Real.of(0)
    slope: Exact = Real.of(1)

    def function(self) -> PiecewiseLinear:
        """Return φ."""
        return spring(start=self.start, slope=self.slope)


class AbsoluteSection(ElementSection):
    """φ(s) = slope · |s|."""

    kind: Literal["absolute"]
    slope: Exact = Real.of(1)

    def function(self) -> PiecewiseLinear:
        """Return φ."""
        return absolute(slope=self.slope)


class PiecewiseLinearSection(ElementSection):
    """φ with free breakpoints and slopes."""

    kind: Literal["piecewise_linear"]
    breakpoints: list[Exact]
    slopes: list[Exact]
    value: Exact | None = None

    def function(self) -> PiecewiseLinear:
        """Return φ."""
        return piecewise_linear(breakpoints=self.breakpoints, slopes=self.slopes, value=self.value)


Element = Annotated[
    DeadZoneSection | SaturationSection | SpringSection | AbsoluteSection | PiecewiseLinearSection,
    Field(discriminator="kind"),
]


class SystemSection(Section):
    """The plant (1), with cells, or with one A and b and scalar nonlinearities."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": ["cells"]}, {"required": ["A"]}],
            "dependentRequired": {"hyperplanes": ["cells"], "b": ["A"], "nonlinearities": ["A"]},
        }
    )

    states: Names
    inputs: Names
    outputs: Names
    track: Tracked | None = None
    units: Annotated[dict[str, Label], named("state, input or output", "signals", "")] = {}
    sizes: Annotated[dict[str, Positive], named("state, input or output", "sized", "")] = {}
    B: Annotated[ExactRows, shaped("states", "inputs")]
    C: Annotated[ExactRows, shaped("outputs", "states")]
    cells: Annotated[list[CellSection], Field(min_length=1), distinct("cell")] | None = None
    hyperplanes: list[HyperplaneSection] | None = None
    A: Annotated[ExactRows, shaped("states", "states")] | None = None
    b: Annotated[ExactVector, shaped("states")] | None = None
    nonlinearities: Annotated[list[Element], distinct("nonlinearity")] | None = None

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield where it is not written in exactly one of the three ways."""
        if self.cells is not None:
            for name in ("A", "b", "nonlinearities"):
                if getattr(self, name) is not None:
                    yield Fault(f".{name} does not go with cells: give one or the other", key=(name,))
            yield from self._wrong_signs(self.cells)
        elif self.A is None:
            yield Fault(".cells, or system.A with nonlinearities, is missing")
        if self.cells is None and self.hyperplanes is not None:
            yield Fault("hyperplanes need cells with signs", ("hyperplanes",))
        yield from self._not_tracked()

    def _wrong_signs(self, cells: list[CellSection]) -> Iterator[Fault]:
        """Yield the cells that have not one sign for each hyperplane, or some without hyperplanes."""
        for k, cell in enumerate(cells):
            at, given, wanted = ("cells", k, "signs"), len(cell.signs or []), len(self.hyperplanes or [])
            if self.hyperplanes is None and cell.signs is not None:
                yield Fault(f"cell '{cell.name}' has signs but the system has no hyperplanes", at)
            if self.hyperplanes is not None and (cell.where is not None or given != wanted):
                found = "none" if cell.signs is None else given
                yield Fault(f"cell '{cell.name}': {found} signs, expected {wanted}, one per hyperplane", at)

    def _not_tracked(self) -> Iterator[Fault]:
        """Yield what is tracked and no output, or a form with a constant: its desired value is the reference."""
        if isinstance(self.track, dict):
            for name, form in self.track.items():
                if form.offset.centre:
                    text = "a constant does not belong into what is tracked: put it into the reference"
                    yield Fault(f"track: {name}: {text}", ("track", name))
            return
        for name, meant in unknown_names(self.track or (), self.outputs):
            yield Fault(f"track: {shown(name)} is no output; outputs: {', '.join(self.outputs)}{meant}", ("track",))

    @property
    def tracked(self) -> tuple[str, ...]:
        """Names of what is to follow a reference: all outputs where nothing is said."""
        return self.outputs if self.track is None else tuple(self.track)
