"""Values from Python -> the tree of texts that a YAML file is read as, and that tree as a YAML file.

So every rule, default and message of a file is also that of arrays and mappings; only the places have other names.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from numbers import Rational
from typing import Any

from pwatrack.causes import Subject
from pwatrack.errors import Place, Problem
from pwatrack.spec.wording import shown
from pwatrack.spec.yaml_tree import DEEPEST, Document, path_text

WRITTEN = "from_python.yaml"  # what such a description is called as a file
_PLAIN = re.compile(r"-?[A-Za-z0-9_.(](?:[A-Za-z0-9_.+*/()<>= -]*[A-Za-z0-9_.)])?", re.ASCII)


@dataclass(frozen=True)
class Argument(Place):
    """A value that was given in Python: `file` is how it is called there, `line` its number among all of them."""

    def __str__(self) -> str:
        return self.file


class Arguments(Mapping[Subject, Place]):
    """Where each value stands that was given in Python.

    Args:
        named: Returns how the value of a path is called there, whether there is one or not.
        numbers: For each path that is there, the number of its value.
    """

    def __init__(self, named: Callable[[Subject], str], numbers: Mapping[Subject, int]) -> None:
        self.named, self._numbers = named, numbers

    def __getitem__(self, subject: Subject) -> Place:
        return Argument(self.named(subject), self._numbers[subject], 0)

    def __iter__(self) -> Iterator[Subject]:
        return iter(self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)

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
    """Return how the value of a path is called where the whole spec is one mapping.

    Example:
        >>> in_mapping(("system", "cells", 1, "A"))
        "spec['system']['cells'][1]['A']"
    """
    return "spec" + subscripts(subject)


def subscripts(subject: Subject) -> str:
    """Return a path as Python's subscripts, counted from 0."""
    return "".join(f"[{part!r}]" for part in subject)


def document_of(data: Mapping[str, Any], named: Callable[[Subject], str] = in_mapping) -> Document:
    """Return a mapping from Python as the tree that a file with the same content is read as.

    Numbers become the shortest decimals that read as the same doubles, fractions stay exact; arrays and tuples are
    lists; what is None is not there.

    Args:
        data: Mappings, lists, arrays, numbers and texts in each other.
        named: Returns how the value of a path is called in Python.

    Example:
        >>> from fractions import Fraction
        >>> document_of({"A": [[0.1, Fraction(1, 3)], (2, "k/m")], "b": None}).data
        {'A': [['0.1', '1/3'], ['2', 'k/m']]}
    """
    reading = _Reading()
    tree = reading.mapping(data, ())
    return Document(data=tree, places=Arguments(named, reading.numbers), problems=reading.problems)


class _Reading:
    """Turns values into a tree, and collects what can be none of it."""

    def __init__(self) -> None:
        self.numbers: dict[Subject, int] = {}
        self.problems: list[Problem] = []

    def mapping(self, data: Mapping[Any, Any], path: Subject) -> dict[str, Any]:
        self.numbers[path] = len(self.numbers)
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
        self.numbers[path] = len(self.numbers)
        if isinstance(value, list | tuple | range):
            return [self._value(entry, (*path, k)) for k, entry in enumerate(value)]
        return self._text(value, path)

    def _text(self, value: Any, path: Subject) -> str:
        if isinstance(value, str):
            return value if _encodes(value) else self._fault(path, "this text has half of a surrogate pair")
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


def _encodes(text: str) -> bool:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True


def yaml_text(tree: Mapping[str, Any]) -> str:
    """Return a tree as a YAML file that is read as the same tree.

    Example:
        >>> print(yaml_text({"name": "cart: 1", "system": {"A": [["0", "1"], ["-k/m", "0"]], "units": {"z": "m"}}}))
        name: "cart: 1"
        system:
          A:
            - [0, 1]
            - [-k/m, 0]
          units: {z: m}
        <BLANKLINE>
    """
    lines = list[str]()
    for key, value in tree.items():
        if not isinstance(value, dict) or not value:
            lines.append(f"{_scalar(key)}: {_flow(value)}")
            continue
        lines.append(f"{_scalar(key)}:")
        for name, entry in value.items():
            if isinstance(entry, list) and any(isinstance(each, list | dict) for each in entry):
                lines += [f"  {_scalar(name)}:", *(f"    - {_flow(each)}" for each in entry)]
            else:
                lines.append(f"  {_scalar(name)}: {_flow(entry)}")
    return "".join(f"{line}\n" for line in lines)


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_scalar(key)}: {_flow(entry)}" for key, entry in value.items()) + "}"
    return f"[{', '.join(map(_flow, value))}]" if isinstance(value, list) else _scalar(value)


def _scalar(text: str) -> str:
    """Return a text as it is where YAML reads it as that, else in quotes."""
    if _PLAIN.fullmatch(text):
        return text
    quoted = json.dumps(text, ensure_ascii=False)
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in quoted)
