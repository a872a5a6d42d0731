"""YAML text as a tree of mappings, lists and strings, with the place of every node.

Every scalar stays text, so YAML's guesses (`no` is False, `010` is 8,
`12:30:45` is 45045, `1e-3` is a string) never happen: a number is whatever the
expression reader makes of the text. Anchors, aliases and tags are refused.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import yaml
from yaml.reader import Reader

from pwatrack.causes import Subject
from pwatrack.errors import InvalidSpec, Place, Problem

_USE_PARAMETERS = "give the value a name under 'parameters' and use it in expressions"
_DEEPEST = 20  # levels: more than twice what a spec needs
_LONGEST = 2**20  # characters
_Node = (yaml.ScalarEvent, yaml.SequenceStartEvent, yaml.MappingStartEvent)
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class Document:
    """A YAML document.

    Attributes:
        data: The root mapping; leaves are strings.
        places: Where the value of each path stands; `()` is the root.
        problems: Duplicate keys and the like, which did not stop the reading.
    """

    data: dict[str, Any]
    places: dict[Subject, Place]
    problems: list[Problem] = field(default_factory=list)


def parse_yaml(text: str, file: str) -> Document:
    """Read one YAML document whose root is a mapping.

    Args:
        text: The YAML text.
        file: Its name, for messages.

    Raises:
        InvalidSpec: If it is not YAML, or has aliases, tags or several documents.

    Example:
        >>> parse_yaml("a: [1e-3, no]", "x.yaml").data
        {'a': ['1e-3', 'no']}
    """
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


class _Builder:
    """Builds the tree from parser events, with an explicit stack: depth and size are bounded."""

    def __init__(self, file: str) -> None:
        self.document = Document(data={}, places={})
        self.file = file

    def build(self, events: Iterable[Any]) -> Document:
        root: list[Any] = []
        stack: list[tuple[Any, Subject]] = [(root, ())]
        key: list[str | None] = [None]
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent) and root:
                self._stop(event, "a second document starts here; a spec is one document")
            if isinstance(event, yaml.AliasEvent):
                self._stop(event, f"alias '*{event.anchor}': anchors and aliases are not supported", _USE_PARAMETERS)
            if isinstance(event, yaml.CollectionEndEvent):
                stack.pop()
                key.pop()
                continue
            if not isinstance(event, _Node):
                continue
            if event.anchor:
                self._stop(event, f"anchor '&{event.anchor}': anchors and aliases are not supported", _USE_PARAMETERS)
            if event.tag and not _plain_tag(event):
                self._stop(event, f"tag '{event.tag}': tags are not supported")
            container, path = stack[-1]
            if isinstance(container, dict) and key[-1] is None:
                key[-1] = self._key(event, container)
                continue
            value: Any = (
                event.value
                if isinstance(event, yaml.ScalarEvent)
                else ({} if isinstance(event, yaml.MappingStartEvent) else [])
            )
            if isinstance(container, dict):
                here: Subject = (*path, key[-1] or "")
                container[key[-1] or ""] = value
                key[-1] = None
            else:
                here = (*path, len(container)) if container is not root else ()
                container.append(value)
            self.document.places[here] = self._place(event)
            if not isinstance(event, yaml.ScalarEvent):
                if len(stack) > _DEEPEST:
                    self._stop(event, f"nested deeper than {_DEEPEST} levels")
                stack.append((value, here))
                key.append(None)
        if not root or not isinstance(root[0], dict):
            raise InvalidSpec(
                Problem(
                    message="the file must hold a mapping of sections (name, system, …)",
                    place=Place(self.file, 1, 1),
                )
            )
        self.document.data.update(root[0])
        return self.document

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
