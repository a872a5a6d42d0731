"""A whole spec file as a pydantic model, as a JSON Schema for editors, and all that is wrong with one in its words."""

import json
import re
from collections.abc import Iterator
from functools import cache
from typing import Annotated, Any, get_args, get_origin

from pydantic import Field, PlainValidator, ValidationError, WithJsonSchema

from pwatrack.errors import KEY, Problem, Subject, listed
from pwatrack.model.pwa import ROUNDING
from pwatrack.spec.axis import SweepSection
from pwatrack.spec.design_section import DesignSection
from pwatrack.spec.entries import UPWARD, ExitNumber, Label, Name, Rounding
from pwatrack.spec.expression import BrokenParameter, UnknownName
from pwatrack.spec.plant_section import SystemSection
from pwatrack.spec.requirement import LIMITS, QUANTITIES, Requirement, read_requirements
from pwatrack.spec.section import MOST, Context, Fault, Faults, Section, named
from pwatrack.spec.signal_section import ReferenceSection
from pwatrack.spec.simulation_section import SimulationSection
from pwatrack.spec.wording import guess, shown
from pwatrack.spec.yaml_tree import path_text

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
    sweep: Annotated[SweepSection, named("parameter", "parameters")] | None = Field(
        None, description="Which parameters `pwatrack sweep` varies: ranges, or lists of values."
    )
    require: Annotated[tuple[Requirement, ...], PlainValidator(read_requirements), WithJsonSchema({})] = ()


def json_schema() -> dict[str, Any]:
    """Return the schema, made from the models that read a file. What only they can check, such as shapes, it leaves."""
    schema = SpecFile.model_json_schema()
    figures = {name: {"description": quantity.best, **_LIMIT} for name, quantity in QUANTITIES.items()}
    of_members = {name: figures[name] for name, quantity in QUANTITIES.items() if quantity.of == "member"}
    members = {"members": {"description": "All of them, or a share.", **_VALUE, "exclusiveMinimum": 0, "maximum": 1}}
    between = {"type": "object", "minProperties": 1, "additionalProperties": UPWARD}
    limits = {LIMITS: {"description": "Lower and upper limit of outputs and states, by name.", **between}}
    schema["properties"]["require"] = _closed(
        "Figures that a run must keep, with their limits.",
        figures
        | limits
        | {"ensemble": _closed("What members of an ensemble must keep.", members | of_members | limits)},
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
    said: dict[str, Any] = {"title": str, "default": dict | list | None}  # where it is of this type
    kept = {key: value for key, value in schema.items() if not (key in said and isinstance(value, said[key]))}
    if kept.get("additionalProperties") is True:  # parameters
        kept["additionalProperties"] = _VALUE
    choices = [choice for choice in kept.pop("anyOf", []) if choice != {"type": "null"}]
    if len(choices) == 1:
        return _plain(kept | choices[0])
    return {key: _plain(value) for key, value in kept.items()} | ({"anyOf": _plain(choices)} if choices else {})


_SAID = {  # of what pydantic finds, behind the path
    "missing": " is missing",
    "union_tag_not_found": ": kind is missing",
    "list_type": ": a list is expected",
    "tuple_type": ": a list is expected",
    "dict_type": ": a mapping is expected",
    "model_type": ": a mapping is expected",
    "model_attributes_type": ": a mapping is expected",
    "string_type": ": a text is expected",
    "too_short": ": at least {min_length} entry is expected",
    "too_long": ": {actual_length} entries, at most {max_length} are read",
    "greater_than_equal": ": {input} is below {ge}",
    "less_than_equal": ": {input} is above {le}",
}


@cache
def _sections() -> tuple[tuple[Subject, type[Section]], ...]:
    """Return every section of a file with its path; `"*"` stands for an entry of a list, or any name."""

    def inside(annotation: Any, path: Subject) -> Iterator[tuple[Subject, type[Section]]]:
        if isinstance(annotation, type) and issubclass(annotation, Section):
            yield path, annotation
            for name, field in annotation.model_fields.items():
                yield from inside(field.annotation, (*path, name))
        below = (*path, "*") if get_origin(annotation) in (list, dict, tuple) else path
        for argument in get_args(annotation):
            yield from inside(argument, below)

    return tuple(inside(SpecFile, ()))


def _keys() -> set[str]:
    return {name for _, model in _sections() for name in model.written_keys()}


def known_keys() -> list[str]:
    """Return every key that some section has."""
    return sorted(_keys() | {*QUANTITIES, "members"})


def _unknown_key(subject: Subject) -> str:
    """Say where an unknown key belongs, or which one may be meant: one of its section first."""
    *section, key = (str(part) for part in subject)
    siblings, places, kinds = set[str](), list[str](), list[str]()
    for path, model in _sections():
        here = len(path) == len(section) and all(p in ("*", q) for p, q in zip(path, section, strict=True))
        if here:
            siblings |= set(model.written_keys())
            if key in model.written_keys() and "kind" in model.model_fields:
                kinds += get_args(model.model_fields["kind"].annotation)
        elif key in model.written_keys() and "*" not in path:
            below = path[: len(section)] == tuple(section)
            places.append(".".join(str(p) for p in (path[len(section) :] if below else path)) or "the top of the file")
    if kinds:
        return f"; '{key}' is for kind: {' or '.join(map(str, kinds))}"
    if places and key not in siblings:
        return f"; '{key}' belongs under {' or '.join(places[:3])}"
    meant = guess(key, sorted(siblings)) or guess(key, sorted(_keys() - {key}))
    return meant or f"; its section has {listed(sorted(siblings), MOST)}" * bool(siblings)


def validation_problems(error: ValidationError, data: Any) -> list[Problem]:
    """Say what pydantic and the rules of sections found wrong with a tree, in the words and paths of the file."""
    problems, late = list[Problem](), list[Problem]()
    for loc, item in _items(error):
        if isinstance(item, Fault):
            subject = (*_in_tree(loc, data), *item.at)
            message = path_text(subject) * (item.text[:1] in ":. ") + item.text
            problem = Problem(message=message, subject=(*subject, *item.key), hint=item.hint)
            (late if item.late else problems).append(problem)
        else:
            missing = item["type"] == "missing"
            subject = (*_in_tree(loc[:-1] if missing else loc, data), *(loc[-1:] if missing else ()))
            message = f"{path_text(subject)}{_fault(item, subject, guessed=len(problems) < MOST)}"
            key = (*subject, KEY) if item["type"] == "extra_forbidden" else subject
            problems.append(Problem(message=message, subject=subject[:-1] if missing else key))
    return problems or late


def _items(error: ValidationError, above: Subject = ()) -> Iterator[tuple[Subject, Any]]:
    """Yield each fault of a section, or item of pydantic, with its path there."""
    for item in error.errors(include_url=False):
        cause, loc = item.get("ctx", {}).get("error"), (*above, *item["loc"])
        if isinstance(cause, Faults):
            yield from ((loc, fault) for fault in cause.faults)
            if cause.inner is not None:
                yield from _items(cause.inner, loc)
        elif not isinstance(cause, BrokenParameter):
            yield loc, item


def _fault(item: Any, subject: Subject, *, guessed: bool) -> str:
    """Return what is wrong with an entry, to be put behind its path; guesses at what was meant take a while."""
    kind, context = item["type"], item.get("ctx", {})
    cause = context.get("error")
    if kind in _SAID:
        figures = {name: "too many" if value is None else value for name, value in context.items()}
        return _SAID[kind].format(input=item["input"], **figures)
    if kind == "extra_forbidden":
        return f": unknown key{_unknown_key(subject) if guessed else ''}"
    if kind == "literal_error":
        value, word = item["input"], context["expected"]
        found = shown(value) if isinstance(value, str) else "a mapping" if isinstance(value, dict) else "a list"
        either = "a word" in item["loc"]  # or numbers
        meant = guess(value, re.findall(r"'([^']*)'", word)) if isinstance(value, str) and guessed else ""
        return (
            f": {found} is neither {word} nor a list or mapping{meant}" if either else f": {found} is not {word}{meant}"
        )
    if kind == "union_tag_invalid":
        meant = guess(str(context["tag"]), re.findall(r"'([^']*)'", context["expected_tags"])) if guessed else ""
        return f": kind {shown(str(context['tag']))} is none of {context['expected_tags']}{meant}"
    if isinstance(cause, UnknownName):
        return f": {cause}{cause.guess if guessed else ''}"
    return f": {cause or item['msg'][0].lower() + item['msg'][1:]}"


def _in_tree(loc: Subject, data: Any) -> Subject:
    """Return a path of pydantic without the parts that name a variant instead of an entry of the file."""
    subject: list[Any] = []
    for part in loc:
        if part in data if isinstance(data, dict) else isinstance(data, list) and part in range(len(data)):
            data = data[part]
            subject.append(part)
    return tuple(subject)
