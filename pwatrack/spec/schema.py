"""The sections of a spec file as pydantic models: structure and shapes."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag

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
from pwatrack.real import Real
from pwatrack.spec.entries import (
    Exact,
    ExactPositive,
    ExactRows,
    ExactVector,
    ExitNumber,
    Form,
    FormPair,
    Inequalities,
    Interval,
    Label,
    Limits,
    Name,
    Names,
    Normal,
    NotNegative,
    Number,
    PeriodicOrVector,
    Positive,
    PositiveOrLargest,
    PositiveOrSmallest,
    Rounding,
    Rows,
    Scale,
    ShareOrInterval,
    Start,
    StartOrMeasured,
    StartOrSteady,
    Time,
    Tracked,
    Whole,
    as_course,
    estimate_kind,
    listed,
    region_kind,
)

_MOST_TERMS = 200  # sines or steps of one signal: each adds states to the exosystem
_MOST_PORTRAITS = 50  # each is a picture
_MOST_LATE = 10  # samples: each adds the inputs to the states of the loop


class Section(BaseModel):
    """A mapping in the file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class CellSection(Section):
    """One cell: where it is, and A, b there. A cell has no B of its own in class (1)."""

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


class CostSection(Section):
    """Weights Q and R of ∫(eᵀQe + vᵀRv) dt; for the observer, noise covariance densities of states and outputs."""

    Q: Rows
    R: Rows


class GoalSection(Section):
    """What a gain is to achieve; with nothing said, an LQR or Kalman gain is found."""

    rate: PositiveOrLargest | None = None
    gain: PositiveOrSmallest | None = None
    cost: CostSection | None = None


class ControllerSection(GoalSection):
    """What K is to achieve; a given K is proved instead."""

    K: Rows | None = None


class ObserverSection(GoalSection):
    """What L is to achieve; a given L is proved instead."""

    L: Rows | None = None


class LoadSection(Section):
    """An unknown load, added to d(state)/dt with a factor for each state in `into`; of known frequency in rad/s."""

    into: Annotated[dict[str, Exact], Field(min_length=1)]
    frequency: ExactPositive | None = None


Estimate = Annotated[
    Annotated[Literal["input"], Tag("a word")]
    | Annotated[dict[Name, LoadSection], Field(min_length=1), Tag("by name")],
    Discriminator(estimate_kind),
]


class DesignSection(Section):
    """What to design."""

    tracking: Literal["output", "state"] = "output"
    controller: ControllerSection = ControllerSection()
    observer: ObserverSection = ObserverSection()
    estimate: Estimate | None = None
    solver: Solver = "clarabel"
    uncertain: dict[Name, ShareOrInterval] = {}
    """Parameters that are known to lie in an interval, or within a share of their value."""


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


class FilterSection(Section):
    """What is left of a measured table: what is slower than the cutoff (Hz), without a phase."""

    cutoff: Positive


class TableSection(Section):
    """A text file with a header, a column of times and the signal's column, joined by a spline.

    `scale` is that of the times, in s, or of each column by its name.
    """

    file: str
    column: str | None = None
    time: str = "t"
    scale: Scale = 1.0
    delimiter: Literal[",", ";", "\t", " ", "|"] | None = None
    decimal: Literal[".", ","] | None = None
    filter: FilterSection | None = None


class CourseSection(Section):
    """A signal of time: the sum of everything that is given."""

    constant: Number = 0.0
    sine: Annotated[list[SineSection], Field(max_length=_MOST_TERMS), BeforeValidator(listed)] = []
    formula: Time | None = None
    until: Positive | None = None
    step: Annotated[list[StepSection], Field(max_length=_MOST_TERMS), BeforeValidator(listed)] = []
    trapezoid: TrapezoidSection | None = None
    polyline: PolylineSection | None = None
    table: TableSection | None = None


Signal = Annotated[CourseSection, BeforeValidator(as_course)]


class ReferenceSection(Section):
    """What to track: an output, or for state tracking one of state, input, setpoint."""

    output: Signal | None = None
    state: list[Signal] | None = None
    input: list[Signal] | None = None
    start: PeriodicOrVector | None = None
    """x_d(0); an empty list where it is the periodic steady state."""
    setpoint: dict[str, Number] | None = None


class InitialSection(Section):
    """x(0), x̂(0) and η̂(0); zero where not given. States stand in their order, or by name; or a word says how."""

    plant: Start | None = None
    observer: StartOrMeasured | None = None
    generator: StartOrSteady | None = None


class PlantSection(Section):
    """Parameters of the plant that runs, where they are not those of the design."""

    parameters: Annotated[dict[Name, Any], Field(min_length=1)]


class ActuatorSection(Section):
    """Lower and upper limit of inputs, by name."""

    limits: Annotated[dict[str, Limits], Field(min_length=1)]


class NoiseSection(Section):
    """Normal noise on outputs, by name, drawn anew at every multiple of a sample time (s) and held in between."""

    std: Annotated[dict[str, NotNegative], Field(min_length=1)]
    sample_time: Positive
    seed: Annotated[Whole, Field(ge=0)] = 1


class SampledSection(Section):
    """The controller as a program that runs once in a sample time (s), its output late by some samples."""

    sample_time: Positive
    method: Method = "exponential"
    delay: Annotated[Whole, Field(ge=0, le=_MOST_LATE)] = 0


class RadiiSection(Section):
    """By name: the radius of each entry that varies, and where the centre is not the nominal one."""

    radii: Annotated[dict[str, Positive], Field(min_length=1)]
    center: dict[str, Number] = {}


class EllipsoidSection(Section):
    """Start states with Σ ((x − center) / radius)² ≤ 1."""

    ellipsoid: RadiiSection


Region = Annotated[
    Annotated[dict[str, Interval], Tag("a box")] | Annotated[EllipsoidSection, Tag("an ellipsoid")],
    Discriminator(region_kind),
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
    settled: dict[str, Positive] = {}
    """By name: how far from its rest an output counts as settled, in its unit."""
    initial: InitialSection = InitialSection()
    plant: PlantSection | None = None
    actuator: ActuatorSection | None = None
    disturbance: Annotated[dict[str, Signal], Field(min_length=1)] | None = None
    noise: NoiseSection | None = None
    quantum: dict[str, Positive] = {}
    """Steps of inputs and measured outputs, by name, in their units."""
    rate_limit: dict[str, Positive] = {}
    """By how much inputs may change, by name, in their unit per second."""
    controller: SampledSection | None = None
    portraits: Annotated[
        list[FormPair],
        Field(max_length=_MOST_PORTRAITS),
    ] = []
    ensemble: EnsembleSection = EnsembleSection()


class ToleranceSection(Section):
    """Rounding in the data that is repaired, relative to the terms of each equation at a facet."""

    continuity: Rounding = ROUNDING


class ExpectSection(Section):
    """How a run of this spec should end."""

    exit: ExitNumber


class SpecFile(Section):
    """A whole spec file."""

    name: Label
    description: str = ""
    parameters: dict[Name, Any] = {}
    system: SystemSection
    design: DesignSection = DesignSection()
    reference: ReferenceSection
    simulation: SimulationSection
    tolerance: ToleranceSection = ToleranceSection()
    expect: ExpectSection | None = None
    require: Any = None  # see `requirement`
