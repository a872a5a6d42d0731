"""The sections of a spec file as pydantic models: structure, numbers and shapes."""

import keyword
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    Tag,
    ValidationInfo,
)

from pwatrack.lmi.inequality import Solver
from pwatrack.model.conditions import Method
from pwatrack.model.nonlinearity import (
    PiecewiseLinear,
    absolute,
    dead_zone,
    piecewise_linear,
    saturation,
    spring,
)
from pwatrack.model.pwa import ROUNDING
from pwatrack.model.signal import ExponentialPolynomial, NotRepresentable
from pwatrack.real import Real
from pwatrack.spec.expression import RESERVED, LinearForm, formula, inequalities, linear_form, number, real

_LARGEST = 1e60  # products of a few entries stay finite
_LONGEST_NAME = 100
_COARSEST = 0.01  # rounding of data: with more, little is left of the plant that was written
_INFINITE = {".inf": inf, "inf": inf, "+.inf": inf, "-.inf": -inf, "-inf": -inf}


@dataclass(frozen=True)
class Context:
    """What the rest of the file is read with.

    Attributes:
        parameters: Their values; None for one that is itself in error.
        states, inputs, outputs: The names declared under `system`.
    """

    parameters: Mapping[str, Real | None]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def _number(value: Any, info: ValidationInfo[Context]) -> float:
    if isinstance(value, float):
        return value
    if not isinstance(value, str):
        raise ValueError("a number or an expression is expected")
    result = number(value, info.context.parameters)
    if abs(result) > _LARGEST:
        raise ValueError(f"{result:g} is larger than {_LARGEST:g}")
    return result


def _real(value: Any, info: ValidationInfo[Context]) -> Real:
    if not isinstance(value, str):
        raise ValueError("a number or an expression is expected")
    result = real(value, info.context.parameters)
    if abs(result.centre) > _LARGEST:
        raise ValueError(f"{float(result):g} is larger than {_LARGEST:g}")
    return result


def _form(value: Any, info: ValidationInfo[Context]) -> LinearForm:
    if not isinstance(value, str):
        raise ValueError("a linear form of the states such as 'z2 - z1' is expected")
    form = linear_form(value, info.context.states, info.context.parameters)
    if not form.row.any():
        raise ValueError(f"'{value}' does not depend on any state")
    return form


def _time(value: Any, info: ValidationInfo[Context]) -> ExponentialPolynomial:
    if not isinstance(value, str):
        raise ValueError("an expression in t is expected")
    signal = formula(value, info.context.parameters)
    try:
        signal.check_size()
    except NotRepresentable as error:
        raise ValueError(f"'{value}' {error}") from None
    return signal


def _start(value: Any, info: ValidationInfo[Context]) -> list[float]:
    if value == "periodic":
        return []
    if not isinstance(value, list) or not value:
        raise ValueError("a list of numbers, one for each state, or 'periodic' is expected")
    return [_number(entry, info) for entry in value]


def _as_course(value: Any) -> Any:
    if value == {}:
        raise ValueError("nothing is given: write a formula in t, or entries such as constant, sine, step, table")
    return {"formula": value} if isinstance(value, str) else value


def _positive(value: float) -> float:
    if value <= 0:
        raise ValueError(f"{value:g} is not positive")
    return value


def _no_crash(code: int) -> int:
    if code == 1:
        raise ValueError("1 is a crash, which is never as it should be: 0, or 2 to 6")
    return code


def _pair(values: list[LinearForm]) -> list[LinearForm]:
    if len(values) != 2:
        raise ValueError("two linear forms of the states are expected, such as [z1, v1] or [z2 - z1, v2 - v1]")
    if np.linalg.matrix_rank([form.row for form in values]) < 2:
        raise ValueError("the two forms are multiples of each other: all is on one line")
    return values


def _not_negative(value: float) -> float:
    if value < 0:
        raise ValueError(f"{value:g} is negative")
    return value


def _limits(value: Any, info: ValidationInfo[Context]) -> list[float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("a lower and an upper limit such as [-1, 1] are expected; .inf for none")
    low, high = (_INFINITE[v] if v in _INFINITE else _number(v, info) for v in value)
    if not low < high:
        raise ValueError(f"the lower limit {low:g} is not below the upper one, {high:g}")
    return [low, high]


def _positive_or(word: str) -> Callable[[Any, ValidationInfo[Context]], float | str]:
    """Return a validator of a positive number, or of one word."""

    def validate(value: Any, info: ValidationInfo[Context]) -> float | str:
        return word if value == word else _positive(_number(value, info))

    return validate


def _not_all_zero(values: list[Real]) -> list[Real]:
    if not any(value.centre for value in values):
        raise ValueError("all entries are 0: this is no hyperplane")
    return values


def _inequalities(value: Any, info: ValidationInfo[Context]) -> list[LinearForm]:
    if not isinstance(value, str):
        raise ValueError("an inequality such as 'z2 - z1 >= 0.05' is expected")
    return inequalities(value, info.context.states, info.context.parameters)


def _name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
        shown = value if len(value) <= 40 else value[:40] + "…"
        raise ValueError(f"'{shown}' is not a name: use letters, digits and _, not starting with a digit")
    if len(value) > _LONGEST_NAME:
        raise ValueError(f"a name has {len(value)} characters, at most {_LONGEST_NAME} are read")
    if value in RESERVED or keyword.iskeyword(value):
        raise ValueError(f"'{value}' has a meaning of its own in expressions: choose another name")
    return value


def _names(values: tuple[str, ...]) -> tuple[str, ...]:
    if not values:
        raise ValueError("at least one name is expected")
    doubles = sorted({v for v in values if values.count(v) > 1})
    if doubles:
        raise ValueError(f"'{doubles[0]}' stands in the list twice")
    return values


def _interval(values: list[float]) -> list[float]:
    if len(values) != 2:
        raise ValueError("two numbers [low, high] are expected")
    if values[0] > values[1]:
        raise ValueError(f"low {values[0]:g} is above high {values[1]:g}")
    return values


def _region_kind(value: Any) -> str:
    """A mapping under `ellipsoid` is one; a state of that name has an interval, which is a list."""
    return "ellipsoid" if isinstance(value, dict) and isinstance(value.get("ellipsoid"), dict) else "box"


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


Number = Annotated[float, BeforeValidator(_number)]
Exact = Annotated[Real, PlainValidator(_real)]
Positive = Annotated[Number, AfterValidator(_positive)]
NotNegative = Annotated[Number, AfterValidator(_not_negative)]
Name = Annotated[str, AfterValidator(_name)]
Time = Annotated[ExponentialPolynomial, PlainValidator(_time)]
Names = Annotated[tuple[Name, ...], AfterValidator(_names)]
Vector = list[Number]
Rows = list[list[Number]]
ExactVector = list[Exact]
ExactRows = list[list[Exact]]
Interval = Annotated[list[Number], AfterValidator(_interval)]


class Section(BaseModel):
    """A mapping in the file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class CellSection(Section):
    """One cell: where it is, and A, b there. A cell has no B of its own in class (1)."""

    name: str
    where: list[Annotated[list[LinearForm], PlainValidator(_inequalities)]] | None = None
    signs: list[Literal["+", "-", "0"]] | None = None
    A: ExactRows
    b: ExactVector | None = None
    B: ExactRows | None = None


class HyperplaneSection(Section):
    """The set H x + h = 0."""

    H: Annotated[ExactVector, AfterValidator(_not_all_zero)]
    h: Exact = Real.of(0)


class ElementSection(Section):
    """What all scalar nonlinearities have: s = of, and d(state)/dt += factor φ(s) for each state in `into`."""

    name: str
    of: Annotated[LinearForm, PlainValidator(_form)]
    into: Annotated[dict[str, Exact], Field(min_length=1)]


class DeadZoneSection(ElementSection):
    """φ = 0 in [lower, upper], lines outside; a pair of elastic stops is the same."""

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

    states: Names
    inputs: Names
    outputs: Names
    units: dict[str, str] = {}
    B: ExactRows
    C: ExactRows
    cells: Annotated[list[CellSection], Field(min_length=1)] | None = None
    hyperplanes: list[HyperplaneSection] | None = None
    A: ExactRows | None = None
    b: ExactVector | None = None
    nonlinearities: list[Element] | None = None


class CostSection(Section):
    """Weights Q and R of ∫(eᵀQe + vᵀRv) dt; for the observer, noise covariance densities of states and outputs."""

    Q: Rows
    R: Rows


class GoalSection(Section):
    """What a gain is to achieve; with nothing said, a gentle gain is found."""

    rate: Annotated[float | Literal["largest"] | None, PlainValidator(_positive_or("largest"))] = None
    gain: Annotated[float | Literal["smallest"] | None, PlainValidator(_positive_or("smallest"))] = None
    cost: CostSection | None = None


class ControllerSection(GoalSection):
    """What K is to achieve; a given K is proved instead."""

    K: Rows | None = None


class ObserverSection(GoalSection):
    """What L is to achieve; a given L is proved instead."""

    L: Rows | None = None


class DesignSection(Section):
    """What to design."""

    tracking: Literal["output", "state"] = "output"
    controller: ControllerSection = ControllerSection()
    observer: ObserverSection = ObserverSection()
    solver: Solver = "clarabel"


class SineSection(Section):
    """amplitude · sin(frequency · t + phase); frequency in rad/s, phase in rad."""

    amplitude: Number
    frequency: Positive
    phase: Number = 0.0


class StepSection(Section):
    """A change by `size` at a time (s), rounded over `smooth` (s); added to everything else."""

    size: Number
    at: Number
    smooth: Positive | None = None


class TrapezoidSection(Section):
    """Rise from low to high, hold, fall, rest, and again; times in s, corners rounded over `smooth`."""

    low: Number = 0.0
    high: Number
    start: Number = 0.0
    rise: Positive
    hold: NotNegative = 0.0
    fall: Positive
    rest: NotNegative = 0.0
    smooth: Positive | None = None


class PolylineSection(Section):
    """Straight lines through points (t in s, y), corners rounded over `smooth`; constant before and after."""

    points: Annotated[list[list[Number]], Field(min_length=1)]
    smooth: Positive | None = None


class TableSection(Section):
    """A CSV file with a header: column t (s) and the signal's column, joined by a spline."""

    file: str
    column: str | None = None


class CourseSection(Section):
    """A signal of time: the sum of everything that is given."""

    constant: Number = 0.0
    sine: Annotated[list[SineSection], BeforeValidator(_listed)] = []
    formula: Time | None = None
    until: Positive | None = None
    step: Annotated[list[StepSection], BeforeValidator(_listed)] = []
    trapezoid: TrapezoidSection | None = None
    polyline: PolylineSection | None = None
    table: TableSection | None = None


Signal = Annotated[CourseSection, BeforeValidator(_as_course)]


class ReferenceSection(Section):
    """What to track: an output, or for state tracking one of state, input, setpoint."""

    output: Signal | None = None
    state: list[Signal] | None = None
    input: list[Signal] | None = None
    start: Annotated[list[float] | None, PlainValidator(_start)] = None
    """x_d(0); an empty list where it is the periodic steady state."""
    setpoint: dict[str, Number] | None = None


class InitialSection(Section):
    """x(0), x̂(0) and η̂(0); zero where not given."""

    plant: Vector | None = None
    observer: Vector | None = None
    generator: list[Number] | None = None


class PlantSection(Section):
    """Parameters of the plant that runs, where they are not those of the design."""

    parameters: Annotated[dict[Name, Any], Field(min_length=1)]


class ActuatorSection(Section):
    """Lower and upper limit of inputs, by name."""

    limits: Annotated[dict[str, Annotated[list[float], PlainValidator(_limits)]], Field(min_length=1)]


class NoiseSection(Section):
    """Normal noise on outputs, by name, drawn anew at every multiple of a sample time (s) and held in between."""

    std: Annotated[dict[str, NotNegative], Field(min_length=1)]
    sample_time: Positive
    seed: Annotated[int, Field(ge=0)] = 1


class SampledSection(Section):
    """The controller as a program that runs once in a sample time (s)."""

    sample_time: Positive
    method: Method = "exponential"


class RadiiSection(Section):
    """By name: the radius of each entry that varies, and where the centre is not the nominal one."""

    radii: Annotated[dict[str, Positive], Field(min_length=1)]
    center: dict[str, Number] = {}


class EllipsoidSection(Section):
    """Start states with Σ ((x − center) / radius)² ≤ 1."""

    ellipsoid: RadiiSection


Region = Annotated[
    Annotated[dict[str, Interval], Tag("box")] | Annotated[EllipsoidSection, Tag("ellipsoid")],
    Discriminator(_region_kind),
]


class StartRegionsSection(Section):
    """Where x(0), x̂(0) and η̂(0) may be; what is not named stays at its nominal value."""

    plant: Region | None = None
    observer: Region | None = None
    generator: list[Interval] | None = None


class EnsembleSection(Section):
    """What differs between the members of an ensemble."""

    initial: StartRegionsSection | None = None
    parameters: dict[Name, Interval] = {}


class SimulationSection(Section):
    """How long, how finely, from where, and what is not as the theorems assume."""

    duration: Positive
    sample_time: Positive
    initial: InitialSection = InitialSection()
    plant: PlantSection | None = None
    actuator: ActuatorSection | None = None
    disturbance: Annotated[dict[str, Signal], Field(min_length=1)] | None = None
    noise: NoiseSection | None = None
    controller: SampledSection | None = None
    portraits: list[Annotated[list[Annotated[LinearForm, PlainValidator(_form)]], AfterValidator(_pair)]] = []
    ensemble: EnsembleSection = EnsembleSection()


def _rounding(value: float) -> float:
    if value > _COARSEST:
        raise ValueError(f"{value:g} is more than data are rounded by in print: at most {_COARSEST:g} is accepted")
    return value


class ToleranceSection(Section):
    """Rounding in the data that is repaired, relative to the terms of each equation at a facet."""

    continuity: Annotated[Positive, AfterValidator(_rounding)] = ROUNDING


class ExpectSection(Section):
    """How a run of this spec should end."""

    exit: Annotated[int, Field(ge=0, le=6), AfterValidator(_no_crash)]


class SpecFile(Section):
    """A whole spec file."""

    name: str
    description: str = ""
    parameters: dict[Name, Any] = {}
    system: SystemSection
    design: DesignSection = DesignSection()
    reference: ReferenceSection
    simulation: SimulationSection
    tolerance: ToleranceSection = ToleranceSection()
    expect: ExpectSection | None = None
