"""A whole spec file as a pydantic model, and as a JSON Schema: editors complete and check with it."""

import json
import re
from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import PlainValidator, WithJsonSchema

from pwatrack.model.pwa import ROUNDING
from pwatrack.spec.axis import SweepSection
from pwatrack.spec.design_section import DesignSection
from pwatrack.spec.entries import ExitNumber, Label, Name, Rounding
from pwatrack.spec.plant_section import SystemSection
from pwatrack.spec.requirement import QUANTITIES, Requirement, read_requirements
from pwatrack.spec.section import Context, Fault, Section, named
from pwatrack.spec.signal_section import ReferenceSection
from pwatrack.spec.simulation_section import SimulationSection

_OTHER = "choose another name"
_COLUMN = re.compile(
    r"eta_hat[1-9][0-9]*|cell_(plant|observer|generator|(actuator|rate)_.+)"
)  # of the trace, beside signals
_VALUE = {"type": ["number", "string"]}
_NUMBER = _VALUE | {"minimum": 0}
_LIMIT = {"anyOf": [_NUMBER, {"type": "object", "additionalProperties": _NUMBER, "minProperties": 1}]}


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

    @classmethod
    def declared(cls, context: Context) -> Iterator[Fault]:
        """Yield the names that stand for two things."""
        taken: dict[str, str] = {}
        for kind in ("parameters", "states", "inputs", "outputs", "track", "estimate"):
            for name in getattr(context, {"track": "tracked", "estimate": "loads"}.get(kind, kind)):
                if taken.get(name, kind) != kind:
                    listed = kind == "track" and taken[name] == "outputs"
                    hint = f"an output that is tracked is listed by its name: track: [{name}]" if listed else _OTHER
                    at = ("design" if kind == "estimate" else "system", kind)
                    yield Fault(f"'{name}' is declared under {taken[name]} and under {kind}", at, hint)
                taken[name] = kind
        known = set(context.signals)
        for name in context.signals:
            for suffix in ("_hat", "_d", "_ff", "_measured"):
                if name + suffix in known:
                    text = f"'{name}{suffix}' is how the trace names a signal that belongs to '{name}'"
                    yield Fault(text, ("system",), _OTHER)
            if _COLUMN.fullmatch(name):
                yield Fault(f"'{name}' is how the trace names a column of its own", ("system",), _OTHER)


class SpecFile(PlantFile):
    """A whole spec file."""

    name: Label
    description: str = ""
    design: DesignSection = DesignSection()
    reference: ReferenceSection
    simulation: SimulationSection
    expect: ExpectSection | None = None
    sweep: Annotated[SweepSection, named("parameter", "parameters")] | None = None
    """Which parameters `pwatrack sweep` varies: ranges, or lists of values."""
    require: Annotated[tuple[Requirement, ...], PlainValidator(read_requirements), WithJsonSchema({})] = ()


def json_schema() -> dict[str, Any]:
    """Return the schema, made from the models that read a file. What only they can check, such as shapes, it leaves.

    Example:
        >>> sorted(json_schema()["required"])
        ['name', 'reference', 'simulation', 'system']
    """
    schema = SpecFile.model_json_schema()
    figures = {name: {"description": quantity.best, **_LIMIT} for name, quantity in QUANTITIES.items()}
    of_members = {name: figures[name] for name, quantity in QUANTITIES.items() if quantity.of == "member"}
    members = {"members": {"description": "All of them, or a share.", **_VALUE, "exclusiveMinimum": 0, "maximum": 1}}
    schema["properties"]["require"] = _closed(
        "Figures that a run must keep, with their limits.",
        figures | {"ensemble": _closed("What members of an ensemble must keep.", members | of_members)},
    )
    schema["allOf"] = [_needs("state", {"not": {"required": ["output"]}}), _needs("output", {"required": ["output"]})]
    about = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "A spec of pwatrack"}
    return about | {key: _plain(value) for key, value in schema.items() if key != "title"}


def _closed(description: str, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": False, "description": description, "properties": properties}


def _needs(tracking: str, reference: dict[str, Any]) -> dict[str, Any]:
    """Return that one way of tracking needs such a reference; nothing said is output tracking."""
    named = {"required": ["design"], "properties": {"design": {"required": ["tracking"]}}}
    asked: dict[str, Any] = {"properties": {"design": {"properties": {"tracking": {"const": tracking}}}}}
    asked = asked if tracking == "output" else {"allOf": [named, asked]}
    return {"if": asked, "then": {"properties": {"reference": reference}}}


def schema_text() -> str:
    """Return the schema as the text of a file."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"


def _plain(schema: Any) -> Any:
    """Return a schema without what a model adds and a file does not say: titles, empty defaults, null."""
    if isinstance(schema, list):
        return [_plain(value) for value in schema]
    if not isinstance(schema, dict):
        return schema
    kept = {key: value for key, value in schema.items() if not _said_by_model(key, value)}
    if kept.get("additionalProperties") is True:  # parameters
        kept["additionalProperties"] = _VALUE
    choices = [choice for choice in kept.pop("anyOf", []) if choice != {"type": "null"}]
    if len(choices) == 1:
        return _plain(kept | choices[0])
    return {key: _plain(value) for key, value in kept.items()} | ({"anyOf": _plain(choices)} if choices else {})


def _said_by_model(key: str, value: object) -> bool:
    return (key == "title" and isinstance(value, str)) or (key == "default" and isinstance(value, dict | list | None))
