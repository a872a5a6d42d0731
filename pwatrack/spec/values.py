"""Values from Python -> the tree of texts that a YAML file is read as, and that tree as a YAML file.

So every rule, default and message of a file is also that of arrays and mappings; only the places have other names.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from numbers import Rational
from typing import Any

import yaml

from pwatrack.causes import Subject
from pwatrack.errors import Place, Problem
from pwatrack.spec.wording import shown
from pwatrack.spec.yaml_tree import DEEPEST, Document, path_text

WRITTEN = "from_python.yaml"  # what such a description is called as a file
_SURROGATE = re.compile("[\ud800-\udfff]")
_WIDEST = 2**30  # columns: no line is broken
_DUMPER: Any = getattr(yaml, "CBaseDumper", yaml.BaseDumper)  # which takes every text for a text


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


def in_mapping(subject: Subject) -> str:
    """Return how the value of a path is called where the whole spec is one mapping."""
    return "spec" + subscripts(subject)


def subscripts(subject: Subject) -> str:
    """Return a path as Python's subscripts, counted from 0."""
    return "".join(f"[{part!r}]" for part in subject)


def document_of(data: Mapping[str, Any], named: Callable[[Subject], str] = in_mapping) -> Document:
    """Return a mapping from Python as the tree that a file with the same content is read as.

    Numbers become the shortest decimals that read as the same doubles, fractions stay exact; arrays and tuples are
    lists; what is None is not there. `named` says how the value of a path is called in Python.
    """
    reading = _Reading(Arguments(named))
    return Document(data=reading.mapping(data, ()), places=reading.places, problems=reading.problems)


class _Reading:
    """Turns values into a tree, and collects what can be none of it."""

    def __init__(self, places: Arguments) -> None:
        self.places, self.problems = places, list[Problem]()

    def mapping(self, data: Mapping[Any, Any], path: Subject) -> dict[str, Any]:
        self.places.add(path)
        for key in data:
            if not isinstance(key, str):
                self._fault(path, f"the key {shown(str(key))} is no text")
        known = {key: value for key, value in data.items() if isinstance(key, str) and value is not None}
        return {key: self._value(value, (*path, key)) for key, value in known.items()}

    def _value(self, value: Any, path: Subject) -> Any:
        value = value.tolist() if hasattr(value, "tolist") else value
        if len(path) > DEEPEST:
            return self._fault(path, f"nested deeper than {DEEPEST} levels")
        if isinstance(value, Mapping):
            return self.mapping(value, path)
        self.places.add(path)
        if isinstance(value, list | tuple | range):
            return [self._value(entry, (*path, k)) for k, entry in enumerate(value)]
        return self._text(value, path)

    def _text(self, value: Any, path: Subject) -> str:
        if isinstance(value, str):
            return self._fault(path, "this text has half of a surrogate pair") if _SURROGATE.search(value) else value
        if isinstance(value, bool) or not isinstance(value, Rational | float | Decimal):
            kind = type(value).__name__
            return self._fault(path, f"a value of type {kind} is no number, text, list, array or mapping")
        if not isinstance(value, Rational) and math.isnan(value):
            return self._fault(path, "nan is no number")
        if not isinstance(value, Rational) and math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
        return repr(value) if isinstance(value, float) else str(value)

    def _fault(self, path: Subject, what: str) -> str:
        self.problems.append(Problem(message=f"{path_text(path)}: {what}" if path else what, subject=path))
        return "0"


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
