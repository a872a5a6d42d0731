"""The section `design` as pydantic models: what is asked of the gains."""

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from pwatrack.lmi.inequality import Solver
from pwatrack.spec.entries import (
    Exact,
    ExactPositive,
    Name,
    PositiveOrLargest,
    PositiveOrSmallest,
    Rows,
    ShareOrInterval,
    estimate_kind,
)
from pwatrack.spec.section import Section


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

    tracking: Literal["output", "state", "practical"] = "output"
    controller: ControllerSection = ControllerSection()
    observer: ObserverSection = ObserverSection()
    estimate: Estimate | None = None
    solver: Solver = "structured"
    uncertain: dict[Name, ShareOrInterval] = {}
    """Parameters that are known to lie in an interval, or within a share of their value."""
