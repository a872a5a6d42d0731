"""The scalar nonlinearities of a plant: each φ(s) with its slopes, what it adds to which rate, and where a run was."""

import textwrap
from collections.abc import Mapping, Sequence
from math import ceil
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pwatrack.arrays import Array, number_text
from pwatrack.control.words import per_second
from pwatrack.errors import InvalidSpec
from pwatrack.model.nonlinearity import Nonlinearity
from pwatrack.model.pwa import PWASystem, linear_form_text
from pwatrack.report.plots.canvas import ACTUAL, label, plain, png, sheet
from pwatrack.report.run_folder import written_at_once
from pwatrack.spec.spec import Spec

_MOST = 12  # in a picture: the first
_BEYOND = 0.25  # of what is to be seen, on either side of it
_LETTERS = 48  # in a line above a panel, of two beside each other: 8 points each
_LINE = 0.15  # inches of such a line
_PANEL = 1.9  # inches


def write_nonlinearities(path: Path, spec: Spec) -> None:
    """Draw the nonlinearities of a spec into a file; raises InvalidSpec if there are none, or it cannot be written."""
    plant = spec.problem.plant
    if not elements_of(plant):
        raise InvalidSpec("--picture: the plant is written by its cells, there is no φ(s) to draw")
    figure = nonlinearities(spec.name, plant, spec.problem.units)
    with written_at_once(path) as temporary:
        temporary.write_bytes(png(figure))


def elements_of(plant: PWASystem) -> Sequence[Nonlinearity]:
    """Return the nonlinearities that a plant is written with; none of one that is written by its cells."""
    return () if plant.written is None else plant.written.elements


def nonlinearities(name: str, plant: PWASystem, units: Mapping[str, str], x: Array | None = None) -> Figure:
    """Draw each φ(s) of a plant that has some; with states of a run, (K, n), also where it was."""
    found = elements_of(plant)
    elements, more = found[:_MOST], max(0, len(found) - _MOST)
    columns = min(2, len(elements))
    texts = [_texts(element, plant, units, _LETTERS * 2 // columns) for element in elements]
    rows = ceil(len(elements) / columns)
    mosaic = [[min(columns * r + c, len(elements) - 1) for c in range(columns)] for r in range(rows)]
    height = 1.0 + (_PANEL + _LINE * max(text.count("\n") + 1 for text in texts)) * rows
    title = (
        f"Nonlinearities{f', without {more} more' if more else ''}{'' if x is None else '; grey: where the run was'}"
    )
    figure, panels = sheet([*textwrap.wrap(name, 90), title], mosaic, height=height)
    for axes, element, text in zip(panels, elements, texts, strict=True):
        _draw(axes, element, plant, units, x)
        axes.set_title(plain(text), loc="left", fontsize=8, pad=3)
    return figure


def _draw(axes: Axes, element: Nonlinearity, plant: PWASystem, units: Mapping[str, str], x: Array | None) -> None:
    marks, row = [float(mark) for mark in element.function.breakpoints], np.array([float(v) for v in element.row])
    seen = [*marks, 0.0] if len(marks) == 1 else list(marks)
    if x is not None:
        s = x @ row + float(element.constant)
        ends = float(s.min()), float(s.max())
        axes.axvspan(*ends, color="0.9", linewidth=0)
        seen += ends
    low, high = min(seen), max(seen)
    room = _BEYOND * (high - low) or 1.0
    points = [low - room, *marks, high + room]
    for mark in marks:
        axes.axvline(mark, color="0.45", linewidth=0.8, linestyle=":")
    axes.plot(points, [element.function(s) for s in points], **ACTUAL)
    unit = _unit(element, plant, units)
    label(axes, plain(f"s = {_form(element, plant)}{f' ({unit})' if unit else ''}"), "φ(s)", points)


def _texts(element: Nonlinearity, plant: PWASystem, units: Mapping[str, str], letters: int) -> str:
    """Return what is said above a panel: the name, what φ adds to which rate, and its slope in each cell."""
    added = [
        f"{number_text(float(d), '.4g')} φ to d{name}/dt{f' ({unit})' if unit else ''}"
        for name, d in zip(plant.states, element.direction, strict=True)
        for unit in [per_second(units.get(name, ""))]
        if float(d)
    ]
    slopes = zip(element.function.segments, element.function.slopes, strict=True)
    said = ", ".join(f"{segment}: {number_text(float(slope), '.6g')}" for segment, slope in slopes)
    unit = _unit(element, plant, units)
    lines = [f"{element.name} adds {', '.join(added)}", f"slopes of φ{f' per {unit}' if unit else ''}: {said}"]
    return "\n".join(part for line in lines for part in textwrap.wrap(line, letters, max_lines=3, placeholder=" …"))


def _unit(element: Nonlinearity, plant: PWASystem, units: Mapping[str, str]) -> str:
    """Return the unit of s, where it has one."""
    found = {units.get(name, "") for name, v in zip(plant.states, element.row, strict=True) if float(v)}
    return found.pop() if len(found) == 1 else ""


def _form(element: Nonlinearity, plant: PWASystem) -> str:
    row, constant = np.array([float(v) for v in element.row]), float(element.constant)
    text = linear_form_text(row, plant.states)
    return f"{text} {'-' if constant < 0 else '+'} {abs(constant):.6g}" if constant else text
