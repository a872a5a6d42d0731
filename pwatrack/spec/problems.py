"""What can be wrong with the form of a spec's tree, each thing said once, with its path."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, get_args, get_origin

from pydantic import ValidationError

from pwatrack.causes import Subject
from pwatrack.errors import Problem
from pwatrack.spec.entries import Context
from pwatrack.spec.expression import BrokenParameter, UnknownName
from pwatrack.spec.paths import at_path, path_text
from pwatrack.spec.requirement import QUANTITIES
from pwatrack.spec.schema import SpecFile
from pwatrack.spec.section import Section
from pwatrack.spec.wording import guess, shown

MOST = 100  # for so many faults of a file it is guessed what was meant

_LARGEST: dict[Subject, int] = {  # entries of a list, before anything is made of them
    ("system", "states"): 100,
    ("system", "inputs"): 100,
    ("system", "outputs"): 100,
    ("system", "cells"): 100_000,
    ("system", "hyperplanes"): 1_000,
    ("system", "nonlinearities"): 1_000,
}

_SHAPES: dict[Subject, tuple[str, ...]] = {
    ("system", "B"): ("states", "inputs"),
    ("system", "C"): ("outputs", "states"),
    ("system", "A"): ("states", "states"),
    ("system", "b"): ("states",),
    ("reference", "state"): ("states",),
    ("reference", "input"): ("inputs",),
    ("reference", "start"): ("states",),
    ("design", "controller", "K"): ("inputs", "states"),
    ("design", "observer", "L"): ("states_and_estimates", "outputs"),
    ("design", "controller", "cost", "Q"): ("states", "states"),
    ("design", "controller", "cost", "R"): ("inputs", "inputs"),
    ("design", "observer", "cost", "Q"): ("states_and_estimates", "states_and_estimates"),
    ("design", "observer", "cost", "R"): ("outputs", "outputs"),
    ("simulation", "initial", "plant"): ("states",),
    ("simulation", "initial", "observer"): ("states",),
}


def size_problems(data: Mapping[str, Any]) -> list[Problem]:
    """Compare the lists that memory and time grow with to their limits, on the raw tree."""
    found = ((subject, at_path(data, subject), most) for subject, most in _LARGEST.items())
    return [
        Problem(message=f"{path_text(subject)}: {len(entries):,} entries, at most {most:,} are read", subject=subject)
        for subject, entries, most in found
        if isinstance(entries, list) and len(entries) > most
    ]


def shape_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Compare the shape of every matrix and vector in the raw tree with the declared names.

    It is done on the raw tree so that an error inside a matrix hides none of its shape.
    """
    flat = flat_matrices(data)
    problems = [
        Problem(
            message=f"{path_text(subject)}: a list of rows is expected, each in its own brackets",
            subject=subject,
            hint="write [[1, 0], [0, 1]] for two rows, [[1, 0]] for one",
        )
        for subject in flat
    ]
    for subject, axes in _shapes(data).items():
        if subject in flat:
            continue
        for where, entries, axis in _axes(at_path(data, subject), subject, axes):
            wanted = len(getattr(context, axis))
            if wanted and len(entries) != wanted:
                kind = "row" if where == subject and len(axes) == 2 else "entry"
                found = f"{len(entries)} {kind if len(entries) == 1 else _PLURAL[kind]}"
                message = (
                    f"{path_text(where)}: {found}, expected {wanted}, one for each of the {_called(context, axis)}"
                )
                problems.append(Problem(message=message, subject=where))
    return problems


def _called(context: Context, axis: str) -> str:
    return axis.replace("_", " ") if context.loads else axis.partition("_")[0]


def _shapes(data: Mapping[str, Any]) -> dict[Subject, tuple[str, ...]]:
    """Return which names each axis of each matrix and vector in the tree goes with."""
    shapes = dict(_SHAPES)
    cells = at_path(data, ("system", "cells"))
    for k in range(len(cells) if isinstance(cells, list) else 0):
        shapes["system", "cells", k, "A"] = ("states", "states")
        shapes["system", "cells", k, "b"] = ("states",)
        shapes["system", "cells", k, "B"] = ("states", "inputs")
    hyperplanes = at_path(data, ("system", "hyperplanes"))
    for k in range(len(hyperplanes) if isinstance(hyperplanes, list) else 0):
        shapes["system", "hyperplanes", k, "H"] = ("states",)
    return shapes


_PLURAL = {"row": "rows", "entry": "entries"}


def _axes(value: Any, subject: Subject, axes: tuple[str, ...]) -> list[tuple[Subject, list[Any], str]]:
    if not isinstance(value, list):
        return []
    found: list[tuple[Subject, list[Any], str]] = [(subject, value, axes[0])]
    for k, row in enumerate(value if len(axes) > 1 else []):
        found += _axes(row, (*subject, k), axes[1:])
    return found


def flat_matrices(data: Mapping[str, Any]) -> list[Subject]:
    """Return the matrices that are written as a list of numbers instead of a list of rows."""
    return [
        subject
        for subject, axes in _shapes(data).items()
        if len(axes) == 2
        and isinstance(value := at_path(data, subject), list)
        and any(isinstance(v, str) for v in value)
    ]


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


def known_keys() -> list[str]:
    """Return every key that some section has."""
    return sorted({name for _, model in _sections() for name in model.written_keys()} | {*QUANTITIES, "members"})


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
    return guess(key, sorted(siblings)) or guess(
        key, sorted({n for _, model in _sections() for n in model.written_keys()})
    )


_EXPECTED = {
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "string_type": "a text",
}


def validation_problems(error: ValidationError, data: Any) -> list[Problem]:
    """Say what pydantic found wrong with a tree, in the words and paths of the file."""
    problems: list[Problem] = []
    flat = flat_matrices(data)
    for item in error.errors(include_url=False):
        if isinstance(item.get("ctx", {}).get("error"), BrokenParameter):
            continue
        subject = _in_tree(item["loc"], data, missing=item["type"] == "missing")
        if any(subject[: len(matrix)] == matrix for matrix in flat):
            continue  # said once for the whole matrix
        message = f"{path_text(subject)}{_fault(item, subject, guessed=len(problems) < MOST)}"
        problems.append(Problem(message=message, subject=subject[:-1] if item["type"] == "missing" else subject))
    return problems


def _fault(item: Any, subject: Subject, *, guessed: bool) -> str:
    """Return what is wrong with an entry, to be put behind its path; guesses at what was meant take a while."""
    kind, context = item["type"], item.get("ctx", {})
    cause = context.get("error")
    if kind == "missing":
        return " is missing"
    if kind == "extra_forbidden":
        return f": unknown key{_unknown_key(subject) if guessed else ''}"
    if kind in _EXPECTED:
        return f": {_EXPECTED[kind]} is expected"
    if kind == "literal_error":
        found, word = _found(item["input"]), context["expected"]
        either = "a word" in item["loc"]  # or numbers
        return f": {found} is neither {word} nor a list or mapping" if either else f": {found} is not {word}"
    if kind == "union_tag_invalid":
        return f": kind {shown(str(context['tag']))} is none of {context['expected_tags']}"
    if kind == "union_tag_not_found":
        return ": kind is missing"
    if kind == "too_short":
        return f": at least {context['min_length']} entry is expected"
    if kind == "too_long":
        return f": {context['actual_length'] or 'too many'} entries, at most {context['max_length']} are read"
    if kind == "greater_than_equal":
        return f": {item['input']} is below {context['ge']}"
    if kind == "less_than_equal":
        return f": {item['input']} is above {context['le']}"
    if isinstance(cause, UnknownName):
        return f": {cause}{cause.guess if guessed else ''}"
    return f": {cause or item['msg'][0].lower() + item['msg'][1:]}"


def _found(value: Any) -> str:
    return shown(value) if isinstance(value, str) else "a mapping" if isinstance(value, dict) else "a list"


def _in_tree(loc: Sequence[str | int], data: Any, *, missing: bool) -> Subject:
    """Return a path of pydantic without the parts that name a variant instead of an entry of the file."""
    subject: list[str | int] = []
    for k, part in enumerate(loc):
        there = part in data if isinstance(data, dict) else isinstance(data, list) and part in range(len(data))
        if there:
            data = data[part]
        if there or (missing and k == len(loc) - 1):
            subject.append(part)
    return tuple(subject)
