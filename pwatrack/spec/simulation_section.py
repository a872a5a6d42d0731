"""The section `simulation` as pydantic models: starts, what a machine adds, ensembles."""

from typing import Annotated, Any

from pydantic import ConfigDict, Discriminator, Field, Tag

from pwatrack.model.conditions import Method
from pwatrack.spec.entries import (
    FormPair,
    Interval,
    Limits,
    Name,
    NotNegative,
    Number,
    Positive,
    StartOrMeasured,
    StartOrSteady,
    Whole,
    region_kind,
    whole,
)
from pwatrack.spec.section import Section
from pwatrack.spec.signal_section import Signal

_MOST_PORTRAITS = 50  # each is a picture
_MOST_LATE = 10  # samples: each adds the inputs to the states of the loop


class InitialSection(Section):
    """x(0), x̂(0) and η̂(0). States stand in their order, or by name; or a word says how.

    Zero where not given, and of the generator its steady state.
    """

    plant: StartOrSteady | None = None
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
    seed: Annotated[Whole, Field(ge=0), whole(0)] = 1


class SampledSection(Section):
    """The controller as a program that runs once in a sample time (s), its output late by some samples."""

    sample_time: Positive
    method: Method = "exponential"
    delay: Annotated[Whole, Field(ge=0, le=_MOST_LATE), whole(0, _MOST_LATE)] = 0


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

    model_config = ConfigDict(
        json_schema_extra={"dependentRequired": {"quantum": ["controller"], "rate_limit": ["controller"]}}
    )

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
