"""What can be wrong with the form of a spec's tree, each thing said once, with its path."""

from collections.abc import Iterator
from functools import cache
from typing import Any, get_args, get_origin

from pydantic import ValidationError

from pwatrack.causes import Subject
from pwatrack.errors import Problem
from pwatrack.spec.expression import BrokenParameter, UnknownName
from pwatrack.spec.requirement import QUANTITIES
from pwatrack.spec.schema import SpecFile
from pwatrack.spec.section import MOST, Fault, Faults, Section
from pwatrack.spec.wording import guess, shown
from pwatrack.spec.yaml_tree import path_text

_EXPECTED = {
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "string_type": "a text",
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


def validation_problems(error: ValidationError, data: Any) -> list[Problem]:
    """Say what pydantic and the rules of sections found wrong with a tree, in the words and paths of the file."""
    problems: list[Problem] = []
    for loc, item in _items(error):
        if isinstance(item, Fault):
            subject = (*_in_tree(loc, data), *item.at)
            message = path_text(subject) * (item.text[:1] in ":. ") + item.text
            problems.append(Problem(message=message, subject=(*subject, *item.key), hint=item.hint))
        else:
            missing = item["type"] == "missing"
            subject = (*_in_tree(loc[:-1] if missing else loc, data), *(loc[-1:] if missing else ()))
            message = f"{path_text(subject)}{_fault(item, subject, guessed=len(problems) < MOST)}"
            problems.append(Problem(message=message, subject=subject[:-1] if missing else subject))
    return problems


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


def _in_tree(loc: Subject, data: Any) -> Subject:
    """Return a path of pydantic without the parts that name a variant instead of an entry of the file."""
    subject: list[Any] = []
    for part in loc:
        if part in data if isinstance(data, dict) else isinstance(data, list) and part in range(len(data)):
            data = data[part]
            subject.append(part)
    return tuple(subject)
