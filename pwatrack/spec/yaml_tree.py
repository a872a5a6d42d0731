"""YAML text as a tree of mappings, lists and strings, with the place of every node.

Every scalar stays text, so YAML's guesses (`no` is False, `010` is 8,
`12:30:45` is 45045, `1e-3` is a string) never happen: a number is whatever the
expression reader makes of the text. Anchors, aliases and tags are refused.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import yaml
from yaml.reader import Reader

from pwatrack.causes import Subject
from pwatrack.errors import InvalidSpec, Place, Problem

_LONGEST_PART = 100  # characters of one key in a path


def path_text(subject: Subject) -> str:
    """Return a path as an engineer reads it, counted from 1."""
    text = ""
    for part in subject:
        name = part if isinstance(part, str) and len(part) <= _LONGEST_PART else f"{str(part)[:_LONGEST_PART]}…"
        text += f"[{part + 1}]" if isinstance(part, int) else f".{name}" if text else name
    return text or "the file"


def at_path(data: Any, subject: Subject) -> Any:
    """Return what stands in a tree at a path, None for nothing."""
    for part in subject:
        if isinstance(data, dict):
            data = data.get(str(part))
        else:
            data = data[part] if isinstance(data, list) and isinstance(part, int) else None
    return data


_USE_PARAMETERS = "give the value a name under 'parameters' and use it in expressions"
DEEPEST = 20  # levels: more than twice what a spec needs
_LONGEST = 2**20  # characters
_Node = (yaml.ScalarEvent, yaml.SequenceStartEvent, yaml.MappingStartEvent)
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class Document:
    """The root mapping with strings as leaves, where each path stands, and what did not stop the reading."""

    data: dict[str, Any]
    places: Mapping[Subject, Place]
    problems: list[Problem] = field(default_factory=list)


def parse_yaml(text: str, file: str) -> Document:
    """Read one YAML document whose root is a mapping, without aliases and tags; `file` is for messages."""
    if len(text) > _LONGEST:
        message = f"the file has {len(text)} characters, at most {_LONGEST} are read"
        raise InvalidSpec(Problem(message=message, place=Place(file, 1, 1)))
    control = Reader.NON_PRINTABLE.search(text)
    if control:
        message = f"not valid YAML: character {ord(control.group()):#06x} is not allowed"
        raise InvalidSpec(Problem(message=message, place=_place_in(text, control.start(), file)))
    try:
        return _Builder(file).build(yaml.parse(text, Loader=_Loader))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = Place(file, mark.line + 1, mark.column + 1) if mark else Place(file, 1, 1)
        reason = ", ".join(part for part in (error.context, error.problem) if part)
        lines = text.replace("\ufeff", "").splitlines()
        first = lines[place.line - 1][place.column - 1 :][:1] if place.line <= len(lines) else ""
        hint = ""
        if first == "\t" or "'\\t'" in reason:
            hint = "that is a tab: YAML wants spaces at the start of a line"
        elif first and first in "@`%":
            hint = f"a plain value does not begin with {first}: put the value in quotes"
        raise InvalidSpec(Problem(message=f"not valid YAML: {reason}", place=place, hint=hint)) from None
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise InvalidSpec(Problem(message=f"not valid YAML: {reason}", place=Place(file, 1, 1))) from None


def _place_in(text: str, position: int, file: str) -> Place:
    before = text[:position]
    return Place(file, before.count("\n") + 1, position - before.rfind("\n"))


@dataclass
class _Open:
    """A mapping or list that is being read, its path, and the key whose value comes next; no path for the root."""

    value: Any
    path: Subject | None
    key: str | None = None

    @property
    def wants_key(self) -> bool:
        return isinstance(self.value, dict) and self.key is None

    def put(self, value: Any) -> Subject:
        """Add what was read, and return its path."""
        if self.path is None:
            self.value.append(value)
            return ()
        step: str | int = len(self.value)
        if isinstance(self.value, dict):
            step, self.key = self.key or "", None
            self.value[step] = value
        else:
            self.value.append(value)
        return (*self.path, step)


class _Builder:
    """Builds the tree from parser events, with an explicit stack: depth and size are bounded."""

    def __init__(self, file: str) -> None:
        self.places: dict[Subject, Place] = {}
        self.document = Document(data={}, places=self.places)
        self.file = file

    def build(self, events: Iterable[Any]) -> Document:
        root: list[Any] = []
        stack = [_Open(root, None)]
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent) and root:
                self._stop(event, "a second document starts here; a spec is one document")
            self._check_plain(event)
            if isinstance(event, yaml.CollectionEndEvent):
                stack.pop()
            elif isinstance(event, _Node) and stack[-1].wants_key:
                stack[-1].key = self._key(event, stack[-1].value)
            elif isinstance(event, _Node):
                value = self._value(event)
                here = stack[-1].put(value)
                self.places[here] = self._place(event)
                if isinstance(value, dict | list):
                    if len(stack) > DEEPEST:
                        self._stop(event, f"nested deeper than {DEEPEST} levels")
                    stack.append(_Open(value, here))
        if not root or not isinstance(root[0], dict):
            message = "the file must hold a mapping of sections (name, system, …)"
            raise InvalidSpec(Problem(message=message, place=Place(self.file, 1, 1)))
        self.document.data.update(root[0])
        return self.document

    def _check_plain(self, event: Any) -> None:
        """Refuse what lets a short file stand for a long one, or for objects."""
        if isinstance(event, yaml.AliasEvent):
            self._stop(event, f"alias '*{event.anchor}': anchors and aliases are not supported", _USE_PARAMETERS)
        if isinstance(event, _Node) and event.anchor:
            self._stop(event, f"anchor '&{event.anchor}': anchors and aliases are not supported", _USE_PARAMETERS)
        if isinstance(event, _Node) and event.tag and not _plain_tag(event):
            self._stop(event, f"tag '{event.tag}': tags are not supported")

    def _value(self, event: Any) -> Any:
        if isinstance(event, yaml.ScalarEvent):
            return event.value
        return {} if isinstance(event, yaml.MappingStartEvent) else []

    def _key(self, event: Any, container: dict[str, Any]) -> str:
        if not isinstance(event, yaml.ScalarEvent):
            self._stop(event, "a key must be a plain word")
        name = str(event.value)
        if name == "<<":
            self._stop(event, "merge keys '<<' are not supported")
        if name in container:
            self.document.problems.append(
                Problem(message=f"key '{name}' stands here a second time", place=self._place(event))
            )
        return name

    def _place(self, event: Any) -> Place:
        return Place(self.file, event.start_mark.line + 1, event.start_mark.column + 1)

    def _stop(self, event: Any, message: str, hint: str = "") -> None:
        raise InvalidSpec(Problem(message=message, hint=hint, place=self._place(event)))


def _plain_tag(event: Any) -> bool:
    return bool(event.implicit if isinstance(event.implicit, bool) else any(event.implicit))
