"""Everything that can be wrong with the tree of a spec, each thing said once, with its path."""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, get_args, get_origin

import numpy as np
from pydantic import ValidationError

from pwatrack.errors import Problem, Subject
from pwatrack.spec.entries import Context
from pwatrack.spec.expression import BrokenParameter, UnknownName
from pwatrack.spec.schema import (
    CostSection,
    GoalSection,
    Section,
    SimulationSection,
    SpecFile,
    SystemSection,
)
from pwatrack.spec.wording import guess, shown

MOST = 100  # for so many faults of a file it is guessed what was meant

_LONGEST_PART = 100  # characters of one key in a path
_MOST_SAMPLES = 10_000_000
_COLUMN = re.compile(r"eta_hat[1-9][0-9]*|cell_(plant|observer|generator|actuator_.+)")  # of the trace, beside signals
_MOST_TICKS = 2_000_000  # all of them are kept in memory

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
    ("design", "observer", "L"): ("states", "outputs"),
    ("design", "controller", "cost", "Q"): ("states", "states"),
    ("design", "controller", "cost", "R"): ("inputs", "inputs"),
    ("design", "observer", "cost", "Q"): ("states", "states"),
    ("design", "observer", "cost", "R"): ("outputs", "outputs"),
    ("simulation", "initial", "plant"): ("states",),
    ("simulation", "initial", "observer"): ("states",),
}


def size_problems(data: Mapping[str, Any]) -> list[Problem]:
    """Compare the lists that memory and time grow with to their limits, on the raw tree."""
    found = ((subject, _at(data, subject), most) for subject, most in _LARGEST.items())
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
        for where, entries, axis in _axes(_at(data, subject), subject, axes):
            wanted = len(getattr(context, axis))
            if wanted and len(entries) != wanted:
                kind = "row" if where == subject and len(axes) == 2 else "entry"
                found = f"{len(entries)} {kind if len(entries) == 1 else _PLURAL[kind]}"
                message = f"{path_text(where)}: {found}, expected {wanted}, one for each of the {axis}"
                problems.append(Problem(message=message, subject=where))
    return problems


def _shapes(data: Mapping[str, Any]) -> dict[Subject, tuple[str, ...]]:
    """Return which names each axis of each matrix and vector in the tree goes with."""
    shapes = dict(_SHAPES)
    cells = _at(data, ("system", "cells"))
    for k in range(len(cells) if isinstance(cells, list) else 0):
        shapes["system", "cells", k, "A"] = ("states", "states")
        shapes["system", "cells", k, "b"] = ("states",)
        shapes["system", "cells", k, "B"] = ("states", "inputs")
    hyperplanes = _at(data, ("system", "hyperplanes"))
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
        if len(axes) == 2 and isinstance(value := _at(data, subject), list) and any(isinstance(v, str) for v in value)
    ]


def _at(data: Any, subject: Subject) -> Any:
    for part in subject:
        if isinstance(data, dict):
            data = data.get(str(part))
        else:
            data = data[part] if isinstance(data, list) and isinstance(part, int) else None
    return data


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
    return sorted({name for _, model in _sections() for name in model.model_fields})


def _unknown_key(subject: Subject) -> str:
    """Say where an unknown key belongs, or which one may be meant: one of its section first."""
    *section, key = (str(part) for part in subject)
    siblings, places = set[str](), list[str]()
    for path, model in _sections():
        here = len(path) == len(section) and all(p in ("*", q) for p, q in zip(path, section, strict=True))
        if here:
            siblings |= set(model.model_fields)
        elif key in model.model_fields and "*" not in path:
            below = path[: len(section)] == tuple(section)
            places.append(".".join(str(p) for p in (path[len(section) :] if below else path)) or "the top of the file")
    if places and key not in siblings:
        return f"; '{key}' belongs under {' or '.join(places[:3])}"
    return guess(key, sorted(siblings)) or guess(
        key, sorted({n for _, model in _sections() for n in model.model_fields})
    )


def path_text(subject: Subject) -> str:
    """Return a path as an engineer reads it, counted from 1.

    Example:
        >>> path_text(("system", "cells", 1, "A", 0))
        'system.cells[2].A[1]'
    """
    text = ""
    for part in subject:
        name = part if isinstance(part, str) and len(part) <= _LONGEST_PART else f"{str(part)[:_LONGEST_PART]}…"
        text += f"[{part + 1}]" if isinstance(part, int) else f".{name}" if text else name
    return text or "the file"


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
        return f": {_found(item['input'])} is not {context['expected']}"
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


def name_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Check on the raw tree that every name stands for one thing."""
    problems = []
    taken: dict[str, str] = {}
    for kind in ("parameters", "states", "inputs", "outputs"):
        for name in context.parameters if kind == "parameters" else getattr(context, kind):
            if taken.get(name, kind) != kind:
                message = f"'{name}' is declared under {taken[name]} and under {kind}"
                problems.append(Problem(message=message, subject=("system", kind)))
            taken[name] = kind
    signals = {name: None for kind in (context.states, context.inputs, context.outputs) for name in kind}
    for name in signals:
        for suffix in ("_hat", "_d", "_ff"):
            if name + suffix in signals:
                message = f"'{name}{suffix}' is how the trace names a signal that belongs to '{name}'"
                problems.append(Problem(message=message, subject=("system",), hint="choose another name"))
    problems += [
        Problem(
            message=f"'{name}' is how the trace names a column of its own",
            subject=("system",),
            hint="choose another name",
        )
        for name in signals
        if _COLUMN.fullmatch(name)
    ]
    system = data.get("system")
    system = system if isinstance(system, dict) else {}
    units = system.get("units")
    problems += [
        Problem(
            message=f"system.units: {shown(name)} is no state, input or output{meant}",
            subject=("system", "units", name),
        )
        for name, meant in _unknown(units if isinstance(units, dict) and context.states else (), signals)
    ]
    for section, kind in (("cells", "cell"), ("nonlinearities", "nonlinearity")):
        seen = set[str]()
        entries = system.get(section)
        for k, entry in enumerate(entries if isinstance(entries, list) else []):
            name = entry.get("name") if isinstance(entry, dict) else None
            subject: Subject = ("system", section, k, "name")
            if not isinstance(name, str):
                continue
            if not name.strip():
                problems.append(Problem(message=f"this {kind} has an empty name", subject=subject))
            elif name.strip() in seen:
                problems.append(Problem(message=f"a second {kind} is named {shown(name.strip())}", subject=subject))
            seen.add(name.strip())
    return problems


def start_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Check on the raw tree that initial states and start regions name states, and that these are not empty."""
    subject: Subject = ("simulation", "ensemble", "initial")
    regions, problems = _at(data, subject), list[Problem]()
    if isinstance(regions, dict) and not any(regions.values()):
        message = f"{path_text(subject)}: nothing is varied"
        problems.append(Problem(message=message, subject=subject, hint="for example plant: {z1: [-0.1, 0.1]}"))
    for part in ("plant", "observer"):
        inside: Subject = (*subject, part, "ellipsoid")
        places: list[Subject] = [("simulation", "initial", part)]
        places += [(*inside, "radii"), (*inside, "center")] if isinstance(_at(data, inside), dict) else [inside[:-1]]
        for at in places:
            names = _at(data, at)
            for name, meant in _unknown(names if isinstance(names, dict) and context.states else (), context.states):
                message = (
                    f"{path_text((*at, name))}: {shown(name)} is no state; states: {_listed(context.states)}{meant}"
                )
                problems.append(Problem(message=message, subject=(*at, name)))
    return problems


def sampling_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Check that the samples are neither too many nor too few, where both numbers can be read."""
    try:
        section = SimulationSection.model_validate(data.get("simulation"), context=context)
    except ValidationError:
        return []
    duration, step, subject = section.duration, section.sample_time, ("simulation", "sample_time")
    problems = []
    if step > duration:
        message = f"sample_time {step:g} s is longer than the duration {duration:g} s"
        problems.append(Problem(message=message, subject=subject))
    hint = "the sample time moves no event; a longer one only draws fewer points"
    counted: list[tuple[float, int, Subject, str, str]] = [(step, _MOST_SAMPLES, subject, "samples", hint)]
    for name, what in (("noise", "draws"), ("controller", "ticks")):
        if (part := getattr(section, name)) is not None:
            where: Subject = ("simulation", name, "sample_time")
            counted.append((part.sample_time, _MOST_TICKS, where, what, ""))
    problems += [
        Problem(message=f"{duration / period:.3g} {what}, at most {most:,} are taken", subject=where, hint=advice)
        for period, most, where, what, advice in counted
        if duration / period > most
    ]
    return problems


def plant_problems(system: SystemSection) -> list[Problem]:
    """Check that the plant is written in exactly one of the three ways."""
    problems: list[tuple[str, Subject]] = []
    if system.cells is None:
        if system.A is None:
            problems.append(("system.cells, or system.A with nonlinearities, is missing", ("system",)))
        if system.hyperplanes is not None:
            problems.append(("hyperplanes need cells with signs", ("system", "hyperplanes")))
    else:
        problems += [
            (f"system.{name} does not go with cells: give one or the other", ("system", name))
            for name in ("A", "b", "nonlinearities")
            if getattr(system, name) is not None
        ]
        wanted = "where" if system.hyperplanes is None else "signs"
        for k, cell in enumerate(system.cells):
            subject: Subject = ("system", "cells", k)
            if wanted == "signs" and (cell.where is not None or len(cell.signs or []) != len(system.hyperplanes or [])):
                count = len(system.hyperplanes or [])
                found = "none" if cell.signs is None else str(len(cell.signs))
                problems.append((f"cell '{cell.name}': {found} signs, expected {count}, one per hyperplane", subject))
            if wanted == "where" and cell.signs is not None:
                problems.append((f"cell '{cell.name}' has signs but the system has no hyperplanes", subject))
    for k, element in enumerate(system.nonlinearities or []):
        for state, meant in _unknown(element.into, system.states):
            subject = ("system", "nonlinearities", k, "into", state)
            problems.append((f"nonlinearity '{element.name}': {shown(state)} is no state{meant}", subject))
    return [Problem(message=message, subject=subject) for message, subject in problems]


def reference_problems(file: SpecFile) -> list[Problem]:
    """Check that there is one reference, of the kind that is tracked."""
    reference, tracking = file.reference, file.design.tracking
    given = [kind for kind in ("output", "state", "input", "setpoint") if getattr(reference, kind) is not None]
    fitting = ["output"] if tracking == "output" else ["state", "input", "setpoint"]
    problems = []
    if len(given) != 1 or given[0] not in fitting:
        found = " and ".join(given) or "nothing"
        message = f"{tracking} tracking needs a reference that is {' or '.join(fitting)}, found {found}"
        problems.append(Problem(message=message, subject=("reference",)))
    if reference.start is not None and reference.input is None:
        problems.append(Problem(message="start goes with a reference 'input' only", subject=("reference", "start")))
    if reference.input is not None and reference.start is None:
        message = "reference.start is missing: x_d(0), or 'periodic'"
        problems.append(Problem(message=message, subject=("reference",)))
    if reference.setpoint is not None and set(reference.setpoint) != set(file.system.outputs):
        message = f"setpoint must give every output: {', '.join(file.system.outputs)}"
        problems.append(Problem(message=message, subject=("reference", "setpoint")))
    return problems


def condition_problems(file: SpecFile, parameters: Mapping[str, Any]) -> list[Problem]:
    """Check that every name under `simulation` is one of its kind."""
    simulation, system = file.simulation, file.system
    given: list[tuple[Subject, Mapping[str, Any], Sequence[str], str]] = []
    if simulation.plant is not None:
        given.append((("plant", "parameters"), simulation.plant.parameters, tuple(parameters), "parameter"))
    given.append((("ensemble", "parameters"), simulation.ensemble.parameters, tuple(parameters), "parameter"))
    if simulation.actuator is not None:
        given.append((("actuator", "limits"), simulation.actuator.limits, system.inputs, "input"))
    if simulation.disturbance is not None:
        given.append((("disturbance",), simulation.disturbance, system.states, "state"))
    if simulation.noise is not None:
        given.append((("noise", "std"), simulation.noise.std, system.outputs, "output"))
    return [
        Problem(
            message=f"{path_text(('simulation', *where))}: {shown(name)} is no {kind} ({_listed(known)}){meant}",
            subject=("simulation", *where, name),
        )
        for where, names, known, kind in given
        for name, meant in _unknown(names, known)
    ]


def _unknown(names: Iterable[str], known: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield the names that are not known, the first ones with a guess at what was meant."""
    wanted, count = set(known), 0
    for name in names:
        if name not in wanted:
            yield name, guess(name, known) if count < MOST else ""
            count += 1


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:20]) + (", …" if len(names) > 20 else "") or "none"


def goal_problems(file: SpecFile) -> list[Problem]:
    """Check that what is asked of each gain makes sense."""
    problems = []
    for part, letter in (("controller", "K"), ("observer", "L")):
        section: GoalSection = getattr(file.design, part)
        subject: Subject = ("design", part)
        where = path_text(subject)
        given = [name for name in (letter, "cost", "rate", "gain") if getattr(section, name, None) is not None]
        if given[0:1] in ([letter], ["cost"]) and len(given) > 1:
            message = f"{where}: '{given[0]}' settles the gain, '{given[1]}' beside it has no meaning"
            problems.append(Problem(message=message, subject=(*subject, given[1])))
        if section.gain == "smallest" and not isinstance(section.rate, float):
            message = f"{where}: 'gain: smallest' is the smallest gain of a given rate in 1/s, and none is given"
            problems.append(Problem(message=message, subject=(*subject, "gain"), hint="for example rate: 0.1"))
        if section.cost is not None:
            problems += _weight_problems(section.cost, (*subject, "cost"))
    return problems


def _weight_problems(cost: CostSection, subject: Subject) -> list[Problem]:
    problems = []
    for letter, strict in (("Q", False), ("R", True)):
        X = np.array(getattr(cost, letter))
        where, at = path_text((*subject, letter)), (*subject, letter)
        skew, least = float(np.abs(X - X.T).max()), float(np.linalg.eigvalsh(X)[0])
        size = float(np.abs(X).max())
        if skew > 1e-9 * size:
            problems.append(Problem(message=f"{where} is not symmetric: entries differ by {skew:.4g}", subject=at))
        elif least <= 0 if strict else least < -1e-9 * size:
            wanted = "positive definite" if strict else "positive semidefinite"
            problems.append(
                Problem(message=f"{where} is not {wanted}: its least eigenvalue is {least:.4g}", subject=at)
            )
    return problems
