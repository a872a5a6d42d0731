"""The section `system` as pydantic models, with cells or nonlinearities -> the plant (1)."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field

from pwatrack.arrays import number_text
from pwatrack.ball_matrix import BallMatrix
from pwatrack.errors import OutsideTheory, Problem
from pwatrack.model.cells import Partition
from pwatrack.model.contact import Contact
from pwatrack.model.nonlinearity import (
    MOST_LISTED,
    Nonlinearity,
    PiecewiseLinear,
    ScalarForm,
    absolute,
    dead_zone,
    drives_away,
    generate_cells,
    piecewise_linear,
    saturation,
    spring,
)
from pwatrack.model.pwa import PWASystem, linear_form_text
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
    """What all nonlinearities have: s = of, and d(state)/dt += factor φ(s) for each state in `into`."""

    name: Label
    of: Form
    into: Annotated[dict[str, Exact], Field(min_length=1)]

    def function(self) -> PiecewiseLinear:
        """Return φ; a ValueError if its numbers make none."""
        raise NotImplementedError

    def element(self, states: Sequence[str]) -> Nonlinearity | Contact:
        """Return what it adds; a ValueError if its numbers make nothing."""
        return Nonlinearity(
            name=self.name,
            function=self.function(),
            row=self.of.coefficients,
            constant=self.of.offset,
            direction=self.direction(states),
        )

    def direction(self, states: Sequence[str]) -> list[Real]:
        """Return the factor of each state, (n,)."""
        return [self.into.get(state, Real.of(0)) for state in states]

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield what it acts on that is no state, and numbers that make nothing."""
        try:
            self.element(context.states)
        except ValueError as error:
            yield Fault(f"nonlinearity '{self.name}': {error}")
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
        return saturation(lower=self.lower, upper=self.upper, slope=self.slope)


class SpringSection(ElementSection):
    """φ(s) = slope · max(0, s − start)."""

    kind: Literal["spring"]
    start: Exact = Real.of(0)
    slope: Exact = Real.of(1)

    def function(self) -> PiecewiseLinear:
        return spring(start=self.start, slope=self.slope)


class AbsoluteSection(ElementSection):
    """φ(s) = slope · |s|."""

    kind: Literal["absolute"]
    slope: Exact = Real.of(1)

    def function(self) -> PiecewiseLinear:
        return absolute(slope=self.slope)


class PiecewiseLinearSection(ElementSection):
    """φ with free breakpoints and slopes."""

    kind: Literal["piecewise_linear"]
    breakpoints: list[Exact]
    slopes: list[Exact]
    value: Exact | None = None

    def function(self) -> PiecewiseLinear:
        return piecewise_linear(breakpoints=self.breakpoints, slopes=self.slopes, value=self.value)


class TouchSection(ElementSection):
    """A spring with a damper that only push: max(0, min(p + q, 2 p)), p of the spring and q of the damper."""

    rate: Form
    stiffness: Exact
    damping: Exact

    def contact(self, states: Sequence[str], lower: Real | None, upper: Real) -> Contact:
        """Return what it adds where it touches from these ends on, from above alone if there is no lower one."""
        return Contact(
            name=self.name,
            of=self.of,
            rate=self.rate,
            stiffness=self.stiffness,
            damping=self.damping,
            lower=lower,
            upper=upper,
            direction=self.direction(states),
        )


class ContactSection(TouchSection):
    """A contact from start on."""

    kind: Literal["contact"]
    start: Exact = Real.of(0)

    def element(self, states: Sequence[str]) -> Contact:
        return self.contact(states, None, self.start)


class ElastoBacklashSection(TouchSection):
    """A contact on either side of a gap."""

    model_config = ConfigDict(json_schema_extra=increasing("lower", "upper"))

    kind: Literal["elasto_backlash"]
    lower: Exact
    upper: Exact

    def element(self, states: Sequence[str]) -> Contact:
        return self.contact(states, self.lower, self.upper)


Element = Annotated[
    DeadZoneSection
    | SaturationSection
    | SpringSection
    | AbsoluteSection
    | PiecewiseLinearSection
    | ContactSection
    | ElastoBacklashSection,
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
    units: Annotated[dict[str, Label], named("state, input or output", "measured", "")] = {}
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
        elif self.A is None:
            yield Fault(".cells, or system.A with nonlinearities, is missing")
        if self.cells is None and self.hyperplanes is not None:
            yield Fault("hyperplanes need cells with signs", ("hyperplanes",))
        for k, cell in enumerate(self.cells or []):
            at, given, wanted = ("cells", k, "signs"), len(cell.signs or []), len(self.hyperplanes or [])
            if self.hyperplanes is None and cell.signs is not None:
                yield Fault(f"cell '{cell.name}' has signs but the system has no hyperplanes", at)
            if self.hyperplanes is not None and (cell.where is not None or given != wanted):
                found = "none" if cell.signs is None else given
                yield Fault(f"cell '{cell.name}': {found} signs, expected {wanted}, one per hyperplane", at)
        forms = self.track if isinstance(self.track, dict) else {}
        for name, form in forms.items():
            if form.offset.centre:
                text = "a constant does not belong into what is tracked: put it into the reference"
                yield Fault(f"track: {name}: {text}", ("track", name))
        for name, meant in unknown_names(() if forms else self.track or (), self.outputs):
            yield Fault(f"track: {shown(name)} is no output; outputs: {', '.join(self.outputs)}{meant}", ("track",))

    @property
    def tracked(self) -> tuple[str, ...]:
        """Names of what is to follow a reference: all outputs where nothing is said."""
        return self.outputs if self.track is None else tuple(self.track)


def build_plant(system: SystemSection, tolerance: float) -> PWASystem:
    """Return the plant from any of the three ways to write it; OutsideTheory if it is not continuous with one B."""
    _refuse_other_B(system)
    A: Any
    b: Any
    odd: list[str] = []
    written, elements = None, list[Nonlinearity | Contact]()
    if system.cells is None:
        sections = system.nonlinearities or []
        elements = [section.element(system.states) for section in sections]
        n = len(system.states)
        base = BallMatrix.of(system.A, (n, n)), BallMatrix.of([[v] for v in system.b or [Real.of(0)] * n], (n, 1))
        scalar = tuple(one for one in elements if isinstance(one, Nonlinearity))
        written = ScalarForm(A=base[0], b=base[1], elements=scalar) if len(scalar) == len(elements) else None
        partition, A, b = generate_cells(*base, elements)
        if len(A) > MOST_LISTED:
            odd.append(
                f"{len(A):,} cells, of which no tables are written: there is no generator.json and no controller.json"
            )
        for section in sections:
            odd += _oddities(system, section)
    else:
        partition = _partition(system, system.cells)
        A = [cell.A for cell in system.cells]
        b = [cell.b or [0] * len(system.states) for cell in system.cells]
    tracked: list[Any] | None = None  # rows of what is to follow a reference: all that is measured
    if isinstance(system.track, dict):
        tracked = [form.coefficients for form in system.track.values()]
    elif system.track is not None:
        tracked = [system.C[system.outputs.index(name)] for name in system.track]
    plant = PWASystem.create(
        partition=partition,
        A=A,
        b=b,
        B=system.B,
        C=system.C,
        tracked=tracked,
        states=system.states,
        inputs=system.inputs,
        outputs=system.outputs,
        tracked_names=system.tracked,
        tolerance=tolerance,
        continuous=system.cells is None,
    )
    return replace(plant, written=written, elements=tuple(elements), remarks=(*plant.remarks, *odd))


def _oddities(system: SystemSection, section: Element) -> list[str]:
    """Say what is odd about an element, which changes nothing: it acts on nothing, or pushes where it should pull."""
    element, n = section.element(system.states), len(system.states)
    d, row = np.array([float(v) for v in element.direction]), section.of.row
    said = f"nonlinearity '{element.name}'"
    if not d.any() or not any(element.on(k)[0].centre for k in range(len(element.segments))):
        return [f"{said} acts on nothing: its {'slopes' if d.any() else 'factors'} are all 0"]
    found, A = list[str](), BallMatrix.of(system.A or [], (n, n))
    pulls: Sequence[Real] = ()  # the slopes of what should pull back what it looks at
    if isinstance(section, TouchSection):
        pulls = [section.stiffness]
    elif isinstance(section, DeadZoneSection | SpringSection):
        pulls = section.function().slopes
    if wrong := drives_away(A.floats, [float(v) for v in pulls], row, d):
        back = ", ".join(f"{system.states[j]}: {number_text(-d[j])}" for j in wrong)
        of = linear_form_text(row, system.states)
        found.append(
            f"{said} pushes {of} on, away from where it acts: write into: {{{back}}} if it should pull it back"
        )
    if isinstance(section, TouchSection):
        moves = BallMatrix.of([section.of.coefficients]) @ A
        if moves.centre != BallMatrix.of([section.rate.coefficients]).centre:
            rate, really = (linear_form_text(row, system.states) for row in (section.rate.row, moves.floats[0]))
            found.append(f"{said} has rate: {rate}, and d/dt of what it looks at is {really or 'not of the states'}")
    return found


def _refuse_other_B(system: SystemSection) -> None:
    problems = [
        Problem(
            message=f"cell '{cell.name}' has an input matrix of its own: class (1) has one B for all cells; "
            f"it differs by up to {np.abs((BallMatrix.of(cell.B) - BallMatrix.of(system.B)).floats).max():.4g}",
            subject=("system", "cells", k, "B"),
            hint="move what switches into the state, for example an actuator's own dynamics",
        )
        for k, cell in enumerate(system.cells or [])
        if cell.B is not None and cell.B != system.B
    ]
    if problems:
        raise OutsideTheory(*problems)


def _partition(system: SystemSection, cells: Sequence[CellSection]) -> Partition:
    """Return the cells, from their signs or from their inequalities, each of which is a hyperplane."""
    signs: Any
    if system.hyperplanes is not None:
        H: list[Sequence[Real]] = [plane.H for plane in system.hyperplanes]
        h = [plane.h for plane in system.hyperplanes]
        signs = [[{"+": 1, "-": -1, "0": 0}[sign] for sign in cell.signs or []] for cell in cells]
    else:
        forms = [[form for chain in cell.where or [] for form in chain] for cell in cells]
        H, h = [form.coefficients for cell in forms for form in cell], [form.offset for cell in forms for form in cell]
        signs = np.zeros((len(cells), len(H)), dtype=np.int64)
        signs[np.repeat(np.arange(len(cells)), [len(cell) for cell in forms]), np.arange(len(H))] = 1
    return Partition.create(
        H=np.array(H, dtype=object).reshape(-1, len(system.states)),
        h=h,
        signs=signs,
        names=[cell.name for cell in cells],
    )
