"""Names in a spec: each stands for one thing, and is declared before something is said of it."""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from pwatrack.causes import Subject
from pwatrack.errors import Problem
from pwatrack.spec.entries import Context
from pwatrack.spec.paths import at_path, path_text
from pwatrack.spec.problems import MOST
from pwatrack.spec.schema import SpecFile
from pwatrack.spec.wording import guess, shown

_OTHER = "choose another name"
_COLUMN = re.compile(
    r"eta_hat[1-9][0-9]*|cell_(plant|observer|generator|(actuator|rate)_.+)"
)  # of the trace, beside signals


def declared_loads(data: Mapping[str, Any]) -> dict[str, int]:
    """Return the loads that a raw tree asks to be estimated, and how many states each has."""
    estimate, inputs = at_path(data, ("design", "estimate")), at_path(data, ("system", "inputs"))
    if estimate == "input":
        return {f"load_{name}": 1 for name in inputs if isinstance(name, str)} if isinstance(inputs, list) else {}
    loads = estimate.items() if isinstance(estimate, dict) else ()
    return {name: 1 + (isinstance(load, dict) and "frequency" in load) for name, load in loads}


def name_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Check on the raw tree that every name stands for one thing."""
    signals = [*dict.fromkeys((*context.states, *context.inputs, *context.outputs, *context.tracked, *context.loads))]
    problems = [*_declared_twice(context), *_of_the_trace(signals)]
    for key in ("units", "sizes"):
        said = at_path(data, ("system", key))
        named = signals if key == "units" else [name for name in signals if name not in context.tracked]
        for name, meant in unknown_names(said if isinstance(said, dict) and context.states else (), named):
            message = f"system.{key}: {shown(name)} is no state, input or output{meant}"
            problems.append(Problem(message=message, subject=("system", key, name)))
    return [*problems, *_repeated(data, "cells", "cell"), *_repeated(data, "nonlinearities", "nonlinearity")]


def _declared_twice(context: Context) -> Iterator[Problem]:
    taken: dict[str, str] = {}
    for kind in ("parameters", "states", "inputs", "outputs", "track", "estimate"):
        for name in getattr(context, {"track": "tracked", "estimate": "loads"}.get(kind, kind)):
            if taken.get(name, kind) != kind:
                message = f"'{name}' is declared under {taken[name]} and under {kind}"
                listed = kind == "track" and taken[name] == "outputs"
                hint = f"an output that is tracked is listed by its name: track: [{name}]" if listed else _OTHER
                yield Problem(message=message, subject=("design" if kind == "estimate" else "system", kind), hint=hint)
            taken[name] = kind


def _of_the_trace(signals: Collection[str]) -> Iterator[Problem]:
    """Yield a problem for each signal that is called like a column of the trace that is another one."""
    known = set(signals)
    messages = [
        f"'{name}{suffix}' is how the trace names a signal that belongs to '{name}'"
        for name in signals
        for suffix in ("_hat", "_d", "_ff", "_measured")
        if name + suffix in known
    ]
    messages += [f"'{name}' is how the trace names a column of its own" for name in signals if _COLUMN.fullmatch(name)]
    for message in messages:
        yield Problem(message=message, subject=("system",), hint=_OTHER)


def _repeated(data: Mapping[str, Any], section: str, kind: str) -> Iterator[Problem]:
    """Yield a problem for each entry of a section that has no name, or the name of an earlier one."""
    entries, seen = at_path(data, ("system", section)), set[str]()
    for k, entry in enumerate(entries if isinstance(entries, list) else []):
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            continue
        name, subject = name.strip(), ("system", section, k, "name")
        if not name:
            yield Problem(message=f"this {kind} has an empty name", subject=subject)
        elif name in seen:
            yield Problem(message=f"a second {kind} is named {shown(name)}", subject=subject)
        seen.add(name)


def start_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Check on the raw tree that initial states and start regions name states, and that these are not empty."""
    subject: Subject = ("simulation", "ensemble", "initial")
    regions, problems = at_path(data, subject), list[Problem]()
    if isinstance(regions, dict) and not any(regions.values()):
        message = f"{path_text(subject)}: nothing is varied"
        problems.append(Problem(message=message, subject=subject, hint="for example plant: {z1: [-0.1, 0.1]}"))
    both = at_path(data, ("simulation", "initial", "observer")) == "measured"
    if both and at_path(data, (*subject, "observer")) is not None:
        message = f"{path_text((*subject, 'observer'))}: each observer starts from what is measured then"
        hint = "leave it out, or 'observer: measured' under simulation.initial"
        problems.append(Problem(message=message, subject=(*subject, "observer"), hint=hint))
    if at_path(data, ("simulation", "initial", "plant")) == "steady" and at_path(data, (*subject, "plant")) is not None:
        message = f"{path_text((*subject, 'plant'))}: where 'plant: steady' is, is not known before the design"
        hint = "give its start under simulation.initial in numbers"
        problems.append(Problem(message=message, subject=(*subject, "plant"), hint=hint))
    for part in ("plant", "observer"):
        inside: Subject = (*subject, part, "ellipsoid")
        places: list[Subject] = [("simulation", "initial", part)]
        places += (
            [(*inside, "radii"), (*inside, "center")] if isinstance(at_path(data, inside), dict) else [inside[:-1]]
        )
        for at in places:
            names = at_path(data, at)
            for name, meant in unknown_names(
                names if isinstance(names, dict) and context.states else (), context.states
            ):
                message = (
                    f"{path_text((*at, name))}: {shown(name)} is no state; states: {_listed(context.states)}{meant}"
                )
                problems.append(Problem(message=message, subject=(*at, name)))
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
    given.append((("settled",), simulation.settled, system.tracked, "output"))
    given.append((("quantum",), simulation.quantum, (*system.inputs, *system.outputs), "input or output"))
    given.append((("rate_limit",), simulation.rate_limit, system.inputs, "input"))
    return [
        Problem(
            message=f"{path_text(('simulation', *where))}: {shown(name)} is no {kind} ({_listed(known)}){meant}",
            subject=("simulation", *where, name),
        )
        for where, names, known, kind in given
        for name, meant in unknown_names(names, known)
    ]


def sweep_problems(file: SpecFile, parameters: Mapping[str, Any]) -> list[Problem]:
    """Check that what varies in a sweep is a parameter."""
    return [
        Problem(
            message=f"sweep: {shown(name)} is no parameter ({_listed(tuple(parameters))}){meant}",
            subject=("sweep", name),
        )
        for name, meant in unknown_names(file.sweep or (), parameters)
    ]


def unknown_names(names: Iterable[str], known: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield the names that are not known, the first ones with a guess at what was meant."""
    wanted, count = set(known), 0
    for name in names:
        if name not in wanted:
            yield name, guess(name, known) if count < MOST else ""
            count += 1


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:20]) + (", …" if len(names) > 20 else "") or "none"
