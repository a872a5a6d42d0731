"""Checked sections -> the plant (1) and the reference, as the model knows them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any, Literal

import numpy as np

from pwatrack.arrays import Array, number_text, readonly
from pwatrack.ball_matrix import BallMatrix
from pwatrack.causes import Subject
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem
from pwatrack.model.cells import Partition
from pwatrack.model.course import Course
from pwatrack.model.loads import Load, Loads
from pwatrack.model.nonlinearity import MOST_LISTED, Nonlinearity, ScalarForm, drives_away, generate_cells
from pwatrack.model.pwa import PWASystem, linear_form_text
from pwatrack.model.reference import (
    InputReference,
    OutputReference,
    Reference,
    SetPoint,
    StateReference,
)
from pwatrack.rational import fraction_of
from pwatrack.real import Real
from pwatrack.spec.courses import build_courses
from pwatrack.spec.design_section import LoadSection
from pwatrack.spec.plant_section import DeadZoneSection, SpringSection, SystemSection
from pwatrack.spec.signal_section import CourseSection, ReferenceSection
from pwatrack.spec.table import Folder


def build_plant(system: SystemSection, tolerance: float) -> PWASystem:
    """Return the plant from any of the three ways to write it.

    Raises:
        InvalidSpec: If a nonlinearity contradicts itself.
        OutsideTheory: If it is not a continuous PWA system with one B.
    """
    _refuse_other_B(system)
    A: Any
    b: Any
    odd: list[str] = []
    written = None
    if system.cells is None:
        elements = _elements(system)
        n = len(system.states)
        base = BallMatrix.of(system.A, (n, n)), BallMatrix.of([[v] for v in system.b or [Real.of(0)] * n], (n, 1))
        written = ScalarForm(A=base[0], b=base[1], elements=tuple(elements))
        partition, A, b = generate_cells(*base, elements)
        if len(A) > MOST_LISTED:
            odd.append(
                f"{len(A):,} cells, of which no tables are written: there is no generator.json and no controller.json"
            )
        for section, element in zip(system.nonlinearities or [], elements, strict=True):
            odd += _oddities(system, element, restoring=isinstance(section, SpringSection | DeadZoneSection))
    else:
        cells = system.cells
        partition = _from_signs(system) if system.hyperplanes is not None else _from_inequalities(system)
        A = [cell.A for cell in cells]
        b = [cell.b or [0] * len(system.states) for cell in cells]
    plant = PWASystem.create(
        partition=partition,
        A=A,
        b=b,
        B=system.B,
        C=system.C,
        tracked=_tracked_rows(system),
        states=system.states,
        inputs=system.inputs,
        outputs=system.outputs,
        tracked_names=system.tracked,
        tolerance=tolerance,
        continuous=system.cells is None,
    )
    return replace(plant, written=written, remarks=(*plant.remarks, *odd))


def build_loads(estimate: Literal["input"] | Mapping[str, LoadSection] | None, plant: PWASystem) -> Loads | None:
    """Return the loads that are to be estimated; None for none."""
    if estimate is None:
        return None
    if isinstance(estimate, str):
        columns = [_reals(plant.exact.B.part(range(len(plant.states)), [k])) for k in range(len(plant.inputs))]
        loads = [Load(name=f"load_{name}", into=into) for name, into in zip(plant.inputs, columns, strict=True)]
    else:
        loads = [
            Load(
                name=name,
                into={plant.states.index(state): factor for state, factor in section.into.items()},
                frequency=section.frequency or Real.of(0),
            )
            for name, section in estimate.items()
        ]
    return Loads.of(loads, states=len(plant.states))


def _reals(column: BallMatrix) -> dict[int, Real]:
    """Return the entries of a column that are not 0."""
    centres = [fraction_of(v) for v in column.centre.entries()]
    radii = [Fraction(0)] * len(centres)
    if column.radius is not None:
        radii = [fraction_of(v) for v in column.radius.entries()]
    return {j: Real(c, r) for j, (c, r) in enumerate(zip(centres, radii, strict=True)) if c or r}


def build_reference(section: ReferenceSection, tracked: tuple[str, ...], folder: Folder, horizon: float) -> Reference:
    """Return what is to be tracked.

    Args:
        section: The section of the file, with exactly one kind of reference.
        tracked: Names of what follows the reference.
        folder: Where table files are looked for.
        horizon: Up to when a course that repeats is laid out, in s.

    Raises:
        InvalidSpec: If a table cannot be read, or a course ends before the horizon.
    """
    if section.setpoint is not None:
        return SetPoint(readonly([section.setpoint[name] for name in tracked]))
    kind = next(kind for kind in ("output", "state", "input") if getattr(section, kind) is not None)
    given, signals = getattr(section, kind), list[tuple[CourseSection, Subject]]()
    if isinstance(given, CourseSection):
        signals = [(given, ())]
    elif isinstance(given, dict):
        signals = [(given[name], (name,)) for name in tracked]
    else:
        signals = [(signal, (k,)) for k, signal in enumerate(given)]
    courses, problems = list[tuple[Course, ...]](), list[Problem]()
    for signal, where in signals:
        try:
            courses.append(build_courses(signal, folder, horizon, ("reference", kind, *where)))
        except InvalidSpec as error:
            problems += error.problems
    if problems:
        raise InvalidSpec(*problems)
    if kind == "output":
        return OutputReference(tuple(courses), preview=section.preview == "auto")
    if kind == "state":
        return StateReference(tuple(courses))
    return InputReference(tuple(courses), readonly(section.start) if section.start else None)


def _oddities(system: SystemSection, element: Nonlinearity, *, restoring: bool) -> list[str]:
    """Say what is odd about an element, which changes nothing: it acts on nothing, or pushes where it should pull."""
    d, slopes = np.array([float(v) for v in element.direction]), any(map(float, element.function.slopes))
    if not d.any() or not slopes:
        return [f"nonlinearity '{element.name}' acts on nothing: its {'slopes' if d.any() else 'factors'} are all 0"]
    wrong = drives_away(_doubles(system.A or []), element) if restoring else []
    if not wrong:
        return []
    back = ", ".join(f"{system.states[j]}: {number_text(-d[j])}" for j in wrong)
    of = linear_form_text(np.array([float(v) for v in element.row]), system.states)
    return [
        f"nonlinearity '{element.name}' pushes {of} on, away from where it acts: "
        f"write into: {{{back}}} if it should pull it back"
    ]


def _tracked_rows(system: SystemSection) -> list[Any] | None:
    """Return the rows of what is to follow a reference; None for all that is measured."""
    if system.track is None:
        return None
    if isinstance(system.track, dict):
        return [form.coefficients for form in system.track.values()]
    return [system.C[system.outputs.index(name)] for name in system.track]


def _refuse_other_B(system: SystemSection) -> None:
    problems = [
        Problem(
            message=f"cell '{cell.name}' has an input matrix of its own: class (1) has one B for all cells; "
            f"it differs by up to {np.abs(_doubles(cell.B) - _doubles(system.B)).max():.4g}",
            subject=("system", "cells", k, "B"),
            hint="move what switches into the state, for example an actuator's own dynamics",
        )
        for k, cell in enumerate(system.cells or [])
        if cell.B is not None and cell.B != system.B
    ]
    if problems:
        raise OutsideTheory(*problems)


def _from_inequalities(system: SystemSection) -> Partition:
    cells = system.cells or []
    forms = [[form for chain in cell.where or [] for form in chain] for cell in cells]
    rows = [form.coefficients for cell in forms for form in cell]
    signs = np.zeros((len(forms), len(rows)), dtype=np.int64)
    start = 0
    for i, cell in enumerate(forms):
        signs[i, start : start + len(cell)] = 1
        start += len(cell)
    return Partition.create(
        H=np.array(rows, dtype=object).reshape(-1, len(system.states)),
        h=[form.offset for cell in forms for form in cell],
        signs=signs,
        names=[cell.name for cell in cells],
    )


def _from_signs(system: SystemSection) -> Partition:
    values = {"+": 1, "-": -1, "0": 0}
    planes, cells = system.hyperplanes or [], system.cells or []
    return Partition.create(
        H=np.array([plane.H for plane in planes], dtype=object).reshape(-1, len(system.states)),
        h=[plane.h for plane in planes],
        signs=[[values[sign] for sign in cell.signs or []] for cell in cells],
        names=[cell.name for cell in cells],
    )


def _elements(system: SystemSection) -> list[Nonlinearity]:
    n = len(system.states)
    elements, problems = [], []
    for k, section in enumerate(system.nonlinearities or []):
        try:
            function = section.function()
        except ValueError as error:
            subject: Subject = ("system", "nonlinearities", k)
            problems.append(Problem(message=f"nonlinearity '{section.name}': {error}", subject=subject))
            continue
        direction = [Real.of(0)] * n
        for state, factor in section.into.items():
            direction[system.states.index(state)] = factor
        elements.append(
            Nonlinearity(
                name=section.name,
                function=function,
                row=section.of.coefficients,
                constant=section.of.offset,
                direction=direction,
            )
        )
    if problems:
        raise InvalidSpec(*problems)
    return elements


def _doubles(rows: Sequence[Sequence[Real]]) -> Array:
    return np.array([[float(v) for v in row] for row in rows])
