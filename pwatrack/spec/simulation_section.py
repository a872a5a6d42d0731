"""The section `simulation` as pydantic models: starts, what a machine adds, ensembles."""

from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Discriminator, Field, Tag

from pwatrack.errors import Subject
from pwatrack.model.conditions import Method, Quanta
from pwatrack.spec.entries import (
    FormPair,
    Interval,
    Limits,
    Name,
    NotNegative,
    Number,
    Positive,
    StartOrSteady,
    StartOrWord,
    Whole,
    whole,
)
from pwatrack.spec.section import Context, Fault, Section, named, shaped
from pwatrack.spec.signal_section import Signal

_MOST_PORTRAITS = 50  # each is a picture
_MOST_SAMPLES = 10_000_000  # more are hours of a run, and gigabytes of its trace
_MOST_TICKS = 2_000_000  # all of them are kept in memory
_MOST_LATE = 10  # samples: each adds the inputs to the states of the loop
_RENAMED = BeforeValidator(lambda method: "emulated" if method == "exponential" else method)  # as before
_OF_INPUTS = " ({}); limits of outputs and states stand under require: limits"
_OF_STATES = named("state", "states", "; states: {}")


class InitialSection(Section):
    """x(0), x̂(0) and η̂(0). States stand in their order, or by name; or a word says how.

    Zero where not given, and of the generator its steady state.
    """

    plant: Annotated[StartOrSteady, _OF_STATES, shaped("states")] | None = None
    observer: Annotated[StartOrWord, _OF_STATES, shaped("states")] | None = None
    generator: StartOrSteady | None = None


class PlantSection(Section):
    """Parameters of the plant that runs, where they are not those of the design."""

    parameters: Annotated[dict[Name, Any], Field(min_length=1), named("parameter", "parameters")]


class ActuatorSection(Section):
    """Lower and upper limit of inputs, by name."""

    limits: Annotated[dict[str, Limits], Field(min_length=1), named("input", "inputs", _OF_INPUTS)]


class NoiseSection(Section):
    """Normal noise on outputs, by name, drawn anew at every multiple of a sample time (s) and held in between."""

    std: Annotated[dict[str, NotNegative], Field(min_length=1), named("output", "outputs")]
    sample_time: Positive
    seed: Annotated[Whole, Field(ge=0), whole(0)] = 1


class TicksSection(Section):
    """A sample time (s), and by how much the time between two ticks may differ from it, either way."""

    nominal: Positive
    jitter: NotNegative

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield where a tick could come before the one before."""
        if self.jitter >= self.nominal:
            text = f".jitter {self.jitter:g} s is not below the nominal sample time {self.nominal:g} s"
            yield Fault(text, (), "5 % of it, for example", ("jitter",))


SampleTime = Annotated[
    Annotated[Positive, Tag("a time")] | Annotated[TicksSection, Tag("with jitter")],
    Discriminator(lambda value: "with jitter" if isinstance(value, dict) else "a time"),
]


class SampledSection(Section):
    """The controller as a program that runs once in a sample time (s), its output late by some samples."""

    sample_time: SampleTime
    method: Annotated[Method, _RENAMED] = "corrected"
    delay: Annotated[Whole, Field(ge=0, le=_MOST_LATE), whole(0, _MOST_LATE)] = 0

    @property
    def period(self) -> float:
        """The nominal sample time, in s."""
        return self.sample_time.nominal if isinstance(self.sample_time, TicksSection) else self.sample_time

    @property
    def jitter(self) -> float:
        """By how much the time between two ticks may differ from that, in s."""
        return self.sample_time.jitter if isinstance(self.sample_time, TicksSection) else 0.0


class RadiiSection(Section):
    """By name: the radius of each entry that varies, and where the centre is not the nominal one."""

    radii: Annotated[dict[str, Positive], Field(min_length=1), _OF_STATES]
    center: Annotated[dict[str, Number], _OF_STATES] = {}


class EllipsoidSection(Section):
    """Start states with Σ ((x − center) / radius)² ≤ 1."""

    ellipsoid: RadiiSection


def _region_kind(value: Any) -> str:
    """A mapping under `ellipsoid` is one; a state of that name has an interval, which is a list."""
    return "an ellipsoid" if isinstance(value, dict) and isinstance(value.get("ellipsoid"), dict) else "a box"


Region = Annotated[
    Annotated[dict[str, Interval], _OF_STATES, Tag("a box")] | Annotated[EllipsoidSection, Tag("an ellipsoid")],
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
    parameters: Annotated[dict[Name, Interval], named("parameter", "parameters")] = {}
    plane: list[Name] | None = None

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield where a plane is not one of two states."""
        if self.plane is not None:
            known = not context.states or set(self.plane) <= set(context.states)
            if len(set(self.plane)) != 2 or len(self.plane) != 2 or not known:
                text = f": two different states are expected, of {', '.join(context.states)}"
                yield Fault(text, ("plane",), "such as [z, v]")


class SimulationSection(Section):
    """How long, how finely, from where, and what is not as the theorems assume."""

    model_config = ConfigDict(
        json_schema_extra={"dependentRequired": {"quantum": ["controller"], "rate_limit": ["controller"]}}
    )

    duration: Positive
    sample_time: Positive
    settled: Annotated[dict[str, Positive], named("output", "followed")] = Field(
        {}, description="By name: how far from its rest an output counts as settled, in its unit."
    )
    initial: InitialSection = InitialSection()
    plant: PlantSection | None = None
    actuator: ActuatorSection | None = None
    disturbance: Annotated[dict[str, Signal], Field(min_length=1), named("state", "states")] | None = None
    noise: NoiseSection | None = None
    quantum: Annotated[dict[str, Positive], named("input or output", "ports")] = Field(
        {}, description="Steps of inputs and measured outputs, by name, in their units."
    )
    rate_limit: Annotated[dict[str, Positive], named("input", "inputs")] = Field(
        {}, description="By how much inputs may change, by name, in their unit per second."
    )
    controller: SampledSection | None = None
    portraits: Annotated[list[FormPair], Field(max_length=_MOST_PORTRAITS)] = []
    ensemble: EnsembleSection = EnsembleSection()

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield samples that are too many or too few, and what does not go together."""
        duration, step = self.duration, self.sample_time
        for name in ("quantum", "rate_limit"):
            if getattr(self, name) and self.controller is None:
                text = f".{name} is about the values of a sampled controller, and there is none"
                yield Fault(text, (), "for example controller: {sample_time: 0.001} under simulation", (name,))
        for name, (low, high) in self.actuator.limits.items() if self.actuator else ():
            size = self.quantum.get(name, 0.0)
            whole = Quanta(inputs=np.array([size]), outputs=np.zeros(0)).within(np.array([[low, high]]))
            if not whole[0, 1] > whole[0, 0]:
                text = f": at most one multiple of {size:g} is within the limits of {name}, {low:g} to {high:g}"
                yield Fault(text, ("quantum", name))
        if step > duration:
            yield Fault(f"sample_time {step:g} s is longer than the duration {duration:g} s", ("sample_time",))
        counted: list[tuple[Subject, float, int, str]] = [((), step, _MOST_SAMPLES, "samples")]
        if self.noise is not None:
            counted.append((("noise",), self.noise.sample_time, _MOST_TICKS, "draws"))
        if self.controller is not None:
            counted.append((("controller",), self.controller.period, _MOST_TICKS, "ticks"))
        for at, period, most, what in counted:
            if duration / period > most:
                hint = "" if at else "the sample time moves no event; a longer one only draws fewer points"
                yield Fault(f"{duration / period:.3g} {what}, at most {most:,} are taken", (*at, "sample_time"), hint)
        at, regions = ("ensemble", "initial"), self.ensemble.initial
        if regions is None:
            return
        if not (regions.plant or regions.observer or regions.generator):
            yield Fault(": nothing is varied", at, "for example plant: {z1: [-0.1, 0.1]}")
        if self.initial.observer == "measured" and regions.observer is not None:
            hint = "leave it out, or 'observer: measured' under simulation.initial"
            yield Fault(": each observer starts from what is measured then", (*at, "observer"), hint)
        for part in ("plant", "observer"):
            if getattr(self.initial, part) == "steady" and getattr(regions, part) is not None:
                hint = "give its start under simulation.initial in numbers"
                yield Fault(f": where '{part}: steady' is, is not known before the design", (*at, part), hint)
