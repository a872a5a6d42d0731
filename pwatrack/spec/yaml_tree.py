"""A spec as a tree of mappings, lists and texts, with the place of every node: from YAML or Python, and as YAML.

Every scalar stays text, so YAML's guesses (`no` is False, `010` is 8, `12:30:45` is 45045, `1e-3` is a string) never
happen: a number is whatever the expression reader makes of the text. Anchors, aliases and tags are refused.
Values from Python become the same texts, so every rule, default and message of a file is also that of arrays and
mappings; only the places have other names.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import takewhile
from numbers import Rational
from typing import Any, NoReturn

import yaml
from yaml.reader import Reader

from pwatrack.errors import KEY, InvalidSpec, Place, Problem, Subject
from pwatrack.spec.wording import shown

WRITTEN = "from_python.yaml"  # what a description from Python is called as a file
DEEPEST = 20  # levels: more than twice what a spec needs
_LONGEST = 2**20  # characters
_LONGEST_PART = 100  # characters of one key in a path
_USE_PARAMETERS = "give the value a name under 'parameters' and use it in expressions"
_SURROGATE = re.compile("[\ud800-\udfff]")
_WIDEST = 2**30  # columns: no line is broken
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER: Any = getattr(yaml, "CBaseDumper", yaml.BaseDumper)  # which takes every text for a text


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


@dataclass(frozen=True)
class Document:
    """The root mapping with strings as leaves, where each path stands, and what did not stop the reading."""

    data: dict[str, Any]
    places: Mapping[Subject, Place]
    problems: list[Problem]


def parse_yaml(text: str, file: str) -> Document:
    """Read one YAML document whose root is a mapping, without aliases and tags; `file` is for messages."""
    if len(text) > _LONGEST:
        message = f"the file has {len(text)} characters, at most {_LONGEST} are read"
        raise InvalidSpec(message, place=Place(file, 1, 1))
    control = Reader.NON_PRINTABLE.search(text)
    if control:
        message = f"not valid YAML: character {ord(control.group()):#06x} is not allowed"
        before = text[: control.start()]
        place = Place(file, before.count("\n") + 1, len(before) - before.rfind("\n"))
        raise InvalidSpec(message, place=place)
    try:
        return _Events(yaml.parse(text, Loader=_LOADER), file).document()
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
        raise InvalidSpec(f"not valid YAML: {reason}", place=place, hint=hint) from None
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise InvalidSpec(f"not valid YAML: {reason}", place=Place(file, 1, 1)) from None


class _Events:
    """Builds the tree from parser events: depth and size are bounded."""

    def __init__(self, events: Iterator[Any], file: str) -> None:
        self.events, self.file = events, file
        self.places, self.problems = dict[Subject, Place](), list[Problem]()

    def document(self) -> Document:
        root: Any = None
        for event in self.events:
            if isinstance(event, yaml.DocumentStartEvent) and root is not None:
                self._stop(event, "a second document starts here; a spec is one document")
            if isinstance(event, yaml.NodeEvent):
                root = self._node(event, ())
        if not isinstance(root, dict):
            message = f"the file must hold a mapping of sections (name, system, …){'; it is empty' * (root is None)}"
            raise InvalidSpec(message, place=Place(self.file, 1, 1))
        return Document(data=root, places=self.places, problems=self.problems)

    def _node(self, event: Any, path: Subject) -> Any:
        self._check_plain(event)
        self.places[path] = self._place(event)
        if isinstance(event, yaml.ScalarEvent):
            return event.value
        if len(path) >= DEEPEST:
            self._stop(event, f"nested deeper than {DEEPEST} levels")
        if isinstance(event, yaml.SequenceStartEvent):
            return [self._node(entry, (*path, k)) for k, entry in enumerate(self._entries())]
        found = dict[str, Any]()
        for key in self._entries():
            name = self._key(key, found)
            self.places[*path, name, KEY] = self._place(key)
            found[name] = self._node(next(self.events), (*path, name))
        return found

    def _entries(self) -> Iterator[Any]:
        """Yield what a mapping or list begins with and goes on with; who takes an entry also takes what is inside."""
        return takewhile(lambda event: not isinstance(event, yaml.CollectionEndEvent), self.events)

    def _check_plain(self, event: Any) -> None:
        """Refuse what lets a short file stand for a long one, or for objects."""
        if event.anchor:
            kind = "alias '*" if isinstance(event, yaml.AliasEvent) else "anchor '&"
            self._stop(event, f"{kind}{event.anchor}': anchors and aliases are not supported", _USE_PARAMETERS)
        if event.tag and not (event.implicit if isinstance(event.implicit, bool) else any(event.implicit)):
            self._stop(event, f"tag '{event.tag}': tags are not supported")

    def _key(self, event: Any, mapping: Mapping[str, Any]) -> str:
        self._check_plain(event)
        if not isinstance(event, yaml.ScalarEvent):
            self._stop(event, "a key must be a plain word")
        name = str(event.value)
        if name == "<<":
            self._stop(event, "merge keys '<<' are not supported")
        if name in mapping:
            self.problems.append(Problem(message=f"key '{name}' stands here a second time", place=self._place(event)))
        return name

    def _place(self, event: Any) -> Place:
        return Place(self.file, event.start_mark.line + 1, event.start_mark.column + 1)

    def _stop(self, event: Any, message: str, hint: str = "") -> NoReturn:
        raise InvalidSpec(message, hint=hint, place=self._place(event))


@dataclass(frozen=True)
class Argument(Place):
    """A value that was given in Python: `file` is how it is called there, `line` its number among all of them."""

    def __str__(self) -> str:
        return self.file


class Arguments(dict[Subject, Place]):
    """Where each value stands that was given in Python; `named` says how the value of a path is called there."""

    def __init__(self, named: Callable[[Subject], str]) -> None:
        self.named = named

    def add(self, path: Subject) -> None:
        """Count the next value."""
        self[path] = Argument(self.named(path), len(self), 0)

    def said(self, problem: Problem) -> Problem:
        """Return the same problem with the path that its message begins with as it is called in Python."""
        for steps in range(len(problem.subject or ()), 0, -1):
            subject = (problem.subject or ())[:steps]
            rest = problem.message.removeprefix(path_text(subject))
            if missing := re.match(r"\.(\w+)(?= is missing)", rest):
                subject, rest = (*subject, missing[1]), rest[missing.end() :]
            if rest != problem.message and rest[:1] in (":", " "):
                return replace(problem, message=self.named(subject) + rest)
        return problem


def subscripts(subject: Subject) -> str:
    """Return a path as Python's subscripts, counted from 0."""
    return "".join(f"[{part!r}]" for part in subject)


def document_of(
    data: Mapping[str, Any], named: Callable[[Subject], str] = lambda subject: "spec" + subscripts(subject)
) -> Document:
    """Return a mapping from Python as the tree that a file with the same content is read as.

    Numbers become the shortest decimals that read as the same doubles, fractions stay exact; arrays and tuples are
    lists; what is None is not there. `named` says how the value of a path is called in Python.
    """
    places, problems = Arguments(named), list[Problem]()

    def fault(path: Subject, what: str) -> str:
        problems.append(Problem(message=f"{path_text(path)}: {what}" if path else what, subject=path))
        return "0"

    def tree(value: Any, path: Subject) -> Any:
        value = value.tolist() if hasattr(value, "tolist") else value
        if len(path) > DEEPEST:
            return fault(path, f"nested deeper than {DEEPEST} levels")
        places.add(path)
        if isinstance(value, Mapping):
            for key in value:
                if not isinstance(key, str):
                    fault(path, f"the key {shown(str(key))} is no text")
            known = {key: entry for key, entry in value.items() if isinstance(key, str) and entry is not None}
            return {key: tree(entry, (*path, key)) for key, entry in known.items()}
        if isinstance(value, list | tuple | range):
            return [tree(entry, (*path, k)) for k, entry in enumerate(value)]
        if isinstance(value, str):
            return fault(path, "this text has half of a surrogate pair") if _SURROGATE.search(value) else value
        if isinstance(value, bool) or not isinstance(value, Rational | float | Decimal):
            return fault(path, f"a value of type {type(value).__name__} is no number, text, list, array or mapping")
        if not isinstance(value, Rational) and math.isnan(value):
            return fault(path, "nan is no number")
        if not isinstance(value, Rational) and math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
        return repr(value) if isinstance(value, float) else str(value)

    return Document(data=tree(data, ()), places=places, problems=problems)


def yaml_text(tree: Mapping[str, Any]) -> str:
    """Return a tree as a YAML file that is read as the same tree.

    Example:
        >>> print(yaml_text({"name": "cart: 1", "system": {"A": [["0", "1"], ["-k/m", "0"]], "units": {"z": "m"}}}))
        name: 'cart: 1'
        system:
          A:
          - [0, 1]
          - [-k/m, 0]
          units: {z: m}
        <BLANKLINE>
    """
    return str(yaml.serialize(_node(tree, 0), Dumper=_DUMPER, allow_unicode=True, width=_WIDEST))


def _node(value: Any, depth: int) -> yaml.Node:
    if isinstance(value, dict):
        pairs = [(_node(key, depth), _node(entry, depth + 1)) for key, entry in value.items()]
        return yaml.MappingNode("tag:yaml.org,2002:map", pairs, flow_style=depth > 1 or not value)
    if isinstance(value, list):
        nested = depth == 2 and any(isinstance(entry, list | dict) for entry in value)
        return yaml.SequenceNode("tag:yaml.org,2002:seq", [_node(v, depth + 1) for v in value], flow_style=not nested)
    return yaml.ScalarNode("tag:yaml.org,2002:str", value)
