"""What one file asks for: a tracking problem, the objectives of its design, and the scenario that is simulated."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Literal

from pwatrack.arrays import Array, amount
from pwatrack.control.goal import Goal
from pwatrack.control.words import Words
from pwatrack.errors import Place, PwatrackError, Subject
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER, Role, Solver
from pwatrack.model.conditions import Conditions
from pwatrack.model.linear_form import LinearForm
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import OutputReference, Reference
from pwatrack.real import Box
from pwatrack.simulation.region import Region
from pwatrack.spec.parametric import ParametricPlant
from pwatrack.spec.requirement import RANGES, Requirement
from pwatrack.spec.spelling import located


@dataclass(frozen=True, kw_only=True)
class TrackingProblem:
    """A plant, and what it is to track."""

    plant: PWASystem
    units: Mapping[str, str]  # unit of each state, input and output that has one
    sizes: Mapping[str, float]  # deviation that matters of each state, input and output for which the file says one
    reference: Reference
    parametric: ParametricPlant  # the plant as a function of the parameters

    @property
    def tracking(self) -> Literal["output", "state"]:
        """What follows the reference: the output (Theorem 3) or the state (Theorem 2)."""
        return "output" if isinstance(self.reference, OutputReference) else "state"


@dataclass(frozen=True, kw_only=True)
class Objectives:
    """What the design is to achieve."""

    controller: Goal  # of K
    observer: Goal  # of Lᵀ
    solver: Solver  # which interior-point solver to ask
    uncertain: Box = ()  # parameters of which only intervals are known
    practical: bool = False  # whether cells are merged after any refusal of the theory

    @property
    def goals(self) -> dict[Role, Goal]:
        """What each gain is to achieve, by its role."""
        return {CONTROLLER: self.controller, OBSERVER: self.observer}


@dataclass(frozen=True)
class Measured:
    """A start of the observer: from what is measured then."""


@dataclass(frozen=True)
class Steady:
    """A start in steady state for the reference as it begins: of the generator, or of plant and observer, on x_d."""


@dataclass(frozen=True, kw_only=True)
class InitialStates:
    """Where a simulation starts: plant (n,), observer (n,), generator (p,) or some entries by name.

    None is zero, and of the generator as `Steady`.
    """

    plant: Array | Steady | None = None
    observer: Array | Measured | Steady | None = None
    generator: Array | Mapping[str, float] | Steady | None = None


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What is simulated, and how it may vary."""

    duration: float  # in s
    sample_time: float  # in s
    initial: InitialStates
    conditions: Conditions  # what is not as the theorems assume
    regions: Mapping[str, Region]  # where the members of an ensemble start, by part; empty where the file says nothing
    plane: tuple[int, int]  # two states in which members differ, where they are to start in a plane
    intervals: Mapping[str, tuple[float, float]]  # lowest and highest values of the plant's parameters; likewise
    portraits: tuple[tuple[LinearForm, LinearForm], ...]  # forms of the states to draw
    bands: Mapping[str, float]  # how far from its rest an output counts as settled, in its unit


@dataclass(frozen=True, kw_only=True, repr=False)
class Spec:
    """What one file, one mapping or one problem from arrays asks for.

    Attributes:
        name: Title of the problem.
        path: The file.
        sha256: Of the file's bytes.
        text: What the file would hold, where there is none: the description came from Python.
        parameters: Values of the parameters.
        overrides: What was set from outside the file, as it was written.
        problem: What is controlled, and what it is to track.
        objectives: What the gains are to achieve.
        scenario: What is simulated.
        requirements: What figures of design, run and ensemble must achieve.
        expected_exit: How a run of this spec should end; 0 unless the file says otherwise.
        places: Where each part of the description stands in the file, or how it is called in Python.

    Example:
        >>> from pwatrack import load_spec
        >>> spec = load_spec("specs/two_mass_backlash.yaml")
        >>> spec.name, spec.problem.plant.states, spec.scenario.duration
        ('Two masses with backlash', ('z1', 'v1', 'z2', 'v2'), 60.0)
    """

    name: str
    path: Path
    sha256: str
    text: str | None
    parameters: Mapping[str, float]
    overrides: Mapping[str, float | str]
    problem: TrackingProblem
    objectives: Objectives
    scenario: Scenario
    requirements: tuple[Requirement, ...]
    expected_exit: int
    places: Mapping[Subject, Place]

    def __repr__(self) -> str:
        (n, m), plant = self.problem.plant.B.shape, self.problem.plant
        cells = amount(len(plant.A), "cell")
        return f"<spec {self.name!r}: {self.problem.tracking} tracking, {cells}, n = {n}, m = {m}>"

    @property
    def words(self) -> Words:
        """What its signals are called, and what is asked of its gains."""
        problem, conditions, goals = self.problem, self.scenario.conditions, self.objectives.goals
        return Words(plant=problem.plant, units=problem.units, sizes=problem.sizes, conditions=conditions, goals=goals)

    @property
    def measured(self) -> dict[str, Any]:
        """What a run of it is measured with: arguments of `Measuring`."""
        plant, follow = self.problem.plant, self.problem.tracking == "state"
        names = {"outputs": plant.tracked_names, "inputs": plant.inputs, "states": plant.states if follow else ()}
        limited = {name: self.words.form(name) for name in self.limited}
        return {**names, "bands": self.scenario.bands, "limited": limited}

    @property
    def limited(self) -> dict[str, tuple[float, float]]:
        """Lower and upper limit of each output or state that has some, infinite on one side where it has none there."""
        found = dict[str, tuple[float, float]]()
        for asked in self.requirements:
            if asked.signal is not None and asked.figure in RANGES:
                low, high = found.get(asked.signal, (-inf, inf))
                ends = (max(low, asked.limit), high) if asked.figure == "lowest" else (low, min(high, asked.limit))
                found[asked.signal] = ends
        return found

    @contextmanager
    def located(self) -> Iterator[None]:
        """Give every refusal raised inside the place in the file that it is about."""
        try:
            yield
        except PwatrackError as error:
            raise located(error, self.places) from None
