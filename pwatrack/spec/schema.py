"""The sections of a spec file as pydantic models: structure, numbers and shapes."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationInfo,
)

from pwatrack.errors import Problem, Subject
from pwatrack.lmi.inequality import Solver
from pwatrack.spec.expression import RESERVED, LinearForm, inequalities, number


@dataclass(frozen=True)
class Context:
    """What the rest of the file is read with.

    Attributes:
        parameters: Their values; None for one that is itself in error.
        states, inputs, outputs: The names declared under `system`.
    """

    parameters: Mapping[str, float | None]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def _number(value: Any, info: ValidationInfo[Context]) -> float:
    if isinstance(value, float):
        return value
    if not isinstance(value, str):
        raise ValueError("a number or an expression is expected")
    return number(value, info.context.parameters)


def _positive(value: float) -> float:
    if value <= 0:
        raise ValueError(f"{value:g} is not positive")
    return value


def _inequalities(value: Any, info: ValidationInfo[Context]) -> list[LinearForm]:
    if not isinstance(value, str):
        raise ValueError("an inequality such as 'z2 - z1 >= 0.05' is expected")
    return inequalities(value, info.context.states, info.context.parameters)


def _name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
        raise ValueError(f"'{value}' is not a name: use letters, digits and _, not starting with a digit")
    if value in RESERVED:
        raise ValueError(f"'{value}' is the name of a constant or function")
    return value


def _names(values: tuple[str, ...]) -> tuple[str, ...]:
    if not values:
        raise ValueError("at least one name is expected")
    doubles = sorted({v for v in values if values.count(v) > 1})
    if doubles:
        raise ValueError(f"'{doubles[0]}' stands in the list twice")
    return values


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


Number = Annotated[float, BeforeValidator(_number)]
Positive = Annotated[Number, AfterValidator(_positive)]
Name = Annotated[str, AfterValidator(_name)]
Names = Annotated[tuple[Name, ...], AfterValidator(_names)]
Vector = list[Number]
Rows = list[list[Number]]


class Section(BaseModel):
    """A mapping in the file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class CellSection(Section):
    """One cell: where it is, and A, b there."""

    name: str
    where: list[Annotated[list[LinearForm], PlainValidator(_inequalities)]] = []
    A: Rows
    b: Vector | None = None


class SystemSection(Section):
    """The plant (1)."""

    states: Names
    inputs: Names
    outputs: Names
    units: dict[str, str] = {}
    B: Rows
    C: Rows
    cells: Annotated[list[CellSection], Field(min_length=1)]


class ControllerSection(Section):
    """How K is found; a given K is proved instead."""

    K: Rows | None = None


class ObserverSection(Section):
    """How L is found; a given L is proved instead."""

    L: Rows | None = None


class DesignSection(Section):
    """What to design."""

    tracking: Literal["output"] = "output"
    controller: ControllerSection = ControllerSection()
    observer: ObserverSection = ObserverSection()
    solver: Solver = "clarabel"


class SineSection(Section):
    """amplitude · sin(frequency · t + phase); frequency in rad/s, phase in rad."""

    amplitude: Number
    frequency: Positive
    phase: Number = 0.0


class OutputReferenceSection(Section):
    """y_d(t) = constant + sum of sinusoids."""

    constant: Number = 0.0
    sine: Annotated[list[SineSection], BeforeValidator(_listed)] = []


class ReferenceSection(Section):
    """What to track."""

    output: OutputReferenceSection


class InitialSection(Section):
    """x(0), x̂(0) and η̂(0); zero where not given."""

    plant: Vector | None = None
    observer: Vector | None = None
    generator: list[Number] | None = None


class SimulationSection(Section):
    """How long, how finely, from where."""

    duration: Positive
    sample_time: Positive
    initial: InitialSection = InitialSection()


class ToleranceSection(Section):
    """Rounding in the data that is accepted, relative to its size."""

    continuity: Positive = 1e-9


class ExpectSection(Section):
    """How a run of this spec should end."""

    exit: Annotated[int, Field(ge=0, le=6)]


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


_SHAPES: dict[Subject, tuple[str, ...]] = {
    ("system", "B"): ("states", "inputs"),
    ("system", "C"): ("outputs", "states"),
    ("design", "controller", "K"): ("inputs", "states"),
    ("design", "observer", "L"): ("states", "outputs"),
    ("simulation", "initial", "plant"): ("states",),
    ("simulation", "initial", "observer"): ("states",),
}


def shape_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Compare the shape of every matrix and vector in the raw tree with the declared names.

    It is done on the raw tree so that an error inside a matrix hides none of its shape.
    """
    shapes = dict(_SHAPES)
    cells = _at(data, ("system", "cells"))
    for k in range(len(cells) if isinstance(cells, list) else 0):
        shapes["system", "cells", k, "A"] = ("states", "states")
        shapes["system", "cells", k, "b"] = ("states",)
    problems = []
    for subject, axes in shapes.items():
        for where, entries, axis in _axes(_at(data, subject), subject, axes):
            wanted = len(getattr(context, axis))
            if wanted and len(entries) != wanted:
                kind = "row" if where == subject and len(axes) == 2 else "entry"
                found = f"{len(entries)} {kind if len(entries) == 1 else _PLURAL[kind]}"
                message = f"{path_text(where)}: {found}, expected {wanted}, one for each of the {axis}"
                problems.append(Problem(message=message, subject=where))
    return problems


_PLURAL = {"row": "rows", "entry": "entries"}


def _axes(value: Any, subject: Subject, axes: tuple[str, ...]) -> list[tuple[Subject, list[Any], str]]:
    if not isinstance(value, list):
        return []
    found: list[tuple[Subject, list[Any], str]] = [(subject, value, axes[0])]
    for k, row in enumerate(value if len(axes) > 1 else []):
        found += _axes(row, (*subject, k), axes[1:])
    return found


def _at(data: Any, subject: Subject) -> Any:
    for part in subject:
        if isinstance(data, dict):
            data = data.get(str(part))
        else:
            data = data[part] if isinstance(data, list) and isinstance(part, int) else None
    return data


def path_text(subject: Subject) -> str:
    """Return a path as an engineer reads it, counted from 1.

    Example:
        >>> path_text(("system", "cells", 1, "A", 0))
        'system.cells[2].A[1]'
    """
    text = ""
    for part in subject:
        text += f"[{part + 1}]" if isinstance(part, int) else (f".{part}" if text else part)
    return text or "the file"
