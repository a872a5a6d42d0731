"""Sections of a spec that do not go together, or ask for what has no meaning."""

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from pwatrack.causes import Subject
from pwatrack.errors import Problem
from pwatrack.spec.entries import Context
from pwatrack.spec.names import unknown_names
from pwatrack.spec.plant_section import CellSection, HyperplaneSection, SystemSection
from pwatrack.spec.schema import SpecFile
from pwatrack.spec.signal_section import CourseSection
from pwatrack.spec.simulation_section import SimulationSection
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
    return [Problem(message=message, subject=subject) for message, subject in problems + _tracked_problems(system)]


def _tracked_problems(system: SystemSection) -> list[tuple[str, Subject]]:
    """Check that what is tracked is an output, or a form without a constant: its desired value is the reference."""
    where: Subject = ("system", "track")
    if isinstance(system.track, dict):
        offset = "a constant does not belong into what is tracked: put it into the reference"
        forms = system.track.items()
        return [(f"track: {name}: {offset}", (*where, name)) for name, form in forms if form.offset.centre]
    names = unknown_names(system.track or (), system.outputs)
    known = ", ".join(system.outputs)
    return [(f"track: {shown(name)} is no output; outputs: {known}{meant}", where) for name, meant in names]


def load_problems(file: SpecFile) -> list[Problem]:
    """Check that each load acts on states, and on some."""
    problems, estimate = list[Problem](), file.design.estimate
    for name, load in estimate.items() if isinstance(estimate, dict) else ():
        where: Subject = ("design", "estimate", name, "into")
        for state, meant in unknown_names(load.into, file.system.states):
            message = f"load '{name}': {shown(state)} is no state{meant}"
            problems.append(Problem(message=message, subject=(*where, state)))
        if not any(factor.centre for factor in load.into.values()):
            problems.append(Problem(message=f"load '{name}': all factors are 0: it does nothing", subject=where))
    return problems


def _sign_problems(
    cells: Sequence[CellSection], hyperplanes: Sequence[HyperplaneSection] | None
) -> list[tuple[str, Subject]]:
    """Check that cells have one sign for each hyperplane, and none without hyperplanes."""
    problems: list[tuple[str, Subject]] = []
    for k, cell in enumerate(cells):
        subject, given, wanted = ("system", "cells", k, "signs"), len(cell.signs or []), len(hyperplanes or [])
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
    fitting = (["output"] if tracking != "state" else []) + (
        ["state", "input", "setpoint"] if tracking != "output" else []
    )
    problems = []
    if tracking == "practical" and file.design.uncertain:
        message = "practical tracking is proved without uncertain parameters"
        problems.append(Problem(message=message, subject=("design", "uncertain"), hint="leave out one or the other"))
    if len(given) != 1 or given[0] not in fitting:
        found = " and ".join(given) or "nothing"
        message = f"{tracking} tracking needs a reference that is {' or '.join(fitting)}, found {found}"
        problems.append(Problem(message=message, subject=("reference",)))
    if reference.start is not None and reference.input is None:
        problems.append(Problem(message="start goes with a reference 'input' only", subject=("reference", "start")))
    if reference.preview != "auto" and reference.output is None:
        message = "reference.preview goes with reference.output"
        problems.append(Problem(message=message, subject=("reference", "preview")))
    if reference.input is not None and reference.start is None:
        message = "reference.start is missing: x_d(0), or 'periodic'"
        problems.append(Problem(message=message, subject=("reference",)))
    if reference.output is not None and given == fitting:
        problems += _output_problems(reference.output, file.system.tracked)
    if reference.setpoint is not None and set(reference.setpoint) != set(file.system.tracked):
        message = f"setpoint must give every output: {', '.join(file.system.tracked)}"
        problems.append(Problem(message=message, subject=("reference", "setpoint")))
    return problems


def _output_problems(output: CourseSection | Mapping[str, CourseSection], tracked: Sequence[str]) -> list[Problem]:
    """Check that there is a signal for each tracked output, and none for anything else."""
    where: Subject = ("reference", "output")
    if isinstance(output, CourseSection):
        if len(tracked) == 1:
            return []
        message = f"reference.output is one signal, and {len(tracked)} outputs are tracked: {', '.join(tracked)}"
        first = tracked[0]
        hint = f"give each its own, output: {{{first}: …}}, or say which one follows the reference: track: [{first}]"
        return [Problem(message=message, subject=where, hint=hint)]
    problems = [
        Problem(
            message=f"reference.output.{name}: {shown(name)} is no tracked output ({', '.join(tracked)}){meant}",
            subject=(*where, name),
            hint=f"entries of a signal are {', '.join(CourseSection.model_fields)}",
        )
        for name, meant in unknown_names(output, tracked)
    ]
    missing = [name for name in tracked if name not in output]
    if missing and not problems:
        message = f"reference.output must give every tracked output, and leaves out {', '.join(missing)}"
        problems.append(Problem(message=message, subject=where))
    return problems
