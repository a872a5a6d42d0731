"""The section `system` as pydantic models: cells or nonlinearities, matrices, names."""

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
from pwatrack.spec.section import Section


class CellSection(Section):
    """One cell: where it is, and A, b there. A cell has no B of its own in class (1)."""

    model_config = ConfigDict(json_schema_extra={"not": {"required": ["where", "signs"]}})

    name: Label
    where: list[Inequalities] | None = None
    signs: list[Literal["+", "-", "0"]] | None = None
    A: ExactRows
    b: ExactVector | None = None
    B: ExactRows | None = None


class HyperplaneSection(Section):
    """The set H x + h = 0."""

    H: Normal
    h: Exact = Real.of(0)


class ElementSection(Section):
    """What all scalar nonlinearities have: s = of, and d(state)/dt += factor φ(s) for each state in `into`."""

    name: Label
    of: Form
    into: Annotated[dict[str, Exact], Field(min_length=1)]


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
    units: dict[str, Label] = {}
    sizes: dict[str, Positive] = {}
    B: ExactRows
    C: ExactRows
    cells: Annotated[list[CellSection], Field(min_length=1)] | None = None
    hyperplanes: list[HyperplaneSection] | None = None
    A: ExactRows | None = None
    b: ExactVector | None = None
    nonlinearities: list[Element] | None = None

    @property
    def tracked(self) -> tuple[str, ...]:
        """Names of what is to follow a reference: all outputs where nothing is said."""
        return self.outputs if self.track is None else tuple(self.track)
