"""A whole spec file as a pydantic model."""

from typing import Any

from pwatrack.model.pwa import ROUNDING
from pwatrack.spec.axis import SweepSection
from pwatrack.spec.design_section import DesignSection
from pwatrack.spec.entries import (
    ExitNumber,
    Label,
    Name,
    Rounding,
)
from pwatrack.spec.plant_section import SystemSection
from pwatrack.spec.section import Section
from pwatrack.spec.signal_section import ReferenceSection
from pwatrack.spec.simulation_section import SimulationSection


class ToleranceSection(Section):
    """Rounding in the data that is repaired, relative to the terms of each equation at a facet."""

    continuity: Rounding = ROUNDING


class ExpectSection(Section):
    """How a run of this spec should end."""

    exit: ExitNumber


class PlantFile(Section):
    """What of a spec file a plant is made of."""

    parameters: dict[Name, Any] = {}
    system: SystemSection
    tolerance: ToleranceSection = ToleranceSection()


class SpecFile(PlantFile):
    """A whole spec file."""

    name: Label
    description: str = ""
    design: DesignSection = DesignSection()
    reference: ReferenceSection
    simulation: SimulationSection
    expect: ExpectSection | None = None
    sweep: SweepSection | None = None
    """Which parameters `pwatrack sweep` varies: ranges, or lists of values."""
    require: Any = None  # see `requirement`
