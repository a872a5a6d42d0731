"""Sections of a spec that do not go together, or ask for what has no meaning."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import ValidationError

from pwatrack.causes import Subject
from pwatrack.errors import Problem
from pwatrack.spec.entries import Context
from pwatrack.spec.names import unknown_names
from pwatrack.spec.paths import path_text
from pwatrack.spec.schema import (
    CellSection,
    CostSection,
    GoalSection,
    HyperplaneSection,
    SimulationSection,
    SpecFile,
    SystemSection,
)
from pwatrack.spec.wording import shown

_MOST_SAMPLES = 10_000_000  # more are hours of a run, and gigabytes of its trace
_MOST_TICKS = 2_000_000  # all of them are kept in memory


def sampling_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Check that the samples are neither too many nor too few, where both numbers can be read."""
    try:
        section = SimulationSection.model_validate(data.get("simulation"), context=context)
    except ValidationError:
        return []
    given = [name for name in ("quantum", "rate_limit") if getattr(section, name)]
    problems = [
        Problem(
            message=f"simulation.{name} is about the values of a sampled controller, and there is none",
            subject=("simulation", name),
            hint="for example controller: {sample_time: 0.001} under simulation",
        )
        for name in given
        if section.controller is None
    ]
    duration, step, subject = section.duration, section.sample_time, ("simulation", "sample_time")
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
    if system.cells is not None:
        problems += [
            (f"system.{name} does not go with cells: give one or the other", ("system", name))
            for name in ("A", "b", "nonlinearities")
            if getattr(system, name) is not None
        ]
        problems += _sign_problems(system.cells, system.hyperplanes)
    elif system.A is None:
        problems.append(("system.cells, or system.A with nonlinearities, is missing", ("system",)))
    if system.cells is None and system.hyperplanes is not None:
        problems.append(("hyperplanes need cells with signs", ("system", "hyperplanes")))
    for k, element in enumerate(system.nonlinearities or []):
        for state, meant in unknown_names(element.into, system.states):
            subject = ("system", "nonlinearities", k, "into", state)
            problems.append((f"nonlinearity '{element.name}': {shown(state)} is no state{meant}", subject))
    return [Problem(message=message, subject=subject) for message, subject in problems]


def _sign_problems(
    cells: Sequence[CellSection], hyperplanes: Sequence[HyperplaneSection] | None
) -> list[tuple[str, Subject]]:
    """Check that cells have one sign for each hyperplane, and none without hyperplanes."""
    problems: list[tuple[str, Subject]] = []
    for k, cell in enumerate(cells):
        subject, given, wanted = ("system", "cells", k), len(cell.signs or []), len(hyperplanes or [])
        if hyperplanes is None and cell.signs is not None:
            problems.append((f"cell '{cell.name}' has signs but the system has no hyperplanes", subject))
        if hyperplanes is not None and (cell.where is not None or given != wanted):
            found = "none" if cell.signs is None else given
            problems.append((f"cell '{cell.name}': {found} signs, expected {wanted}, one per hyperplane", subject))
    return problems


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
