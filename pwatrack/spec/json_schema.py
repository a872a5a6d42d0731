"""The form of a spec file as a JSON Schema: editors complete and check with it."""

import json
from typing import Any

from pwatrack.spec.requirement import QUANTITIES
from pwatrack.spec.schema import SpecFile

_VALUE = {"type": ["number", "string"]}
_NUMBER = _VALUE | {"minimum": 0}
_LIMIT = {"anyOf": [_NUMBER, {"type": "object", "additionalProperties": _NUMBER, "minProperties": 1}]}


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
