"""The nonlinearities of a plant: each φ(s) with its slopes, what it adds to which rate, and where a run was."""

import textwrap
from collections.abc import Mapping
from math import ceil
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pwatrack.arrays import Array, number_text
from pwatrack.errors import InvalidSpec
from pwatrack.model.conditions import per_second
from pwatrack.model.contact import Contact
from pwatrack.model.linear_form import LinearForm
from pwatrack.model.nonlinearity import Nonlinearity
from pwatrack.model.pwa import PWASystem, linear_form_text
from pwatrack.report.plots.canvas import LOOK, label, plain, png, sheet
from pwatrack.report.run_folder import written_at_once
from pwatrack.spec.spec import Spec

_MOST = 12  # in a picture: the first
_BEYOND = 0.25  # of what is to be seen, on either side of it
_LETTERS = 48  # in a line above a panel, of two beside each other: 8 points each
_LINE = 0.15  # inches of such a line
_PANEL = 1.9  # inches
_STYLES = LOOK["actual"], LOOK["desired"], LOOK["estimate"]  # of a contact at rest, closing and leaving
_POINTS = 400  # of its curves


def write_nonlinearities(path: Path, spec: Spec) -> None:
    """Draw the nonlinearities of a spec into a file; raises InvalidSpec if there are none, or it cannot be written."""
    plant = spec.problem.plant
    if not plant.elements:
        raise InvalidSpec("--picture: the plant is written by its cells, there is no φ(s) to draw")
    figure = nonlinearities(spec.name, plant, spec.problem.units)
    with written_at_once(path) as temporary:
        temporary.write_bytes(png(figure))


def nonlinearities(name: str, plant: PWASystem, units: Mapping[str, str], x: Array | None = None) -> Figure:
    """Draw each φ(s) of a plant that has some; with states of a run, (K, n), also where it was."""
    found = plant.elements
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
        axes.locator_params(axis="x", nbins=10 // columns)  # with more, numbers touch each other
    return figure


def _draw(
    axes: Axes, element: Nonlinearity | Contact, plant: PWASystem, units: Mapping[str, str], x: Array | None
) -> None:
    of, touches = element.of, isinstance(element, Contact)
    if isinstance(element, Contact):  # bends at rest
        bends = [element.upper] if element.lower is None else [element.lower, element.upper]
    else:
        bends = [*element.function.breakpoints]
    marks = [float(mark) for mark in bends]
    seen = [*marks, 0.0] if len(marks) == 1 else list(marks)
    if x is not None:
        s = x @ of.row + of.constant
        ends = float(s.min()), float(s.max())
        axes.axvspan(*ends, color="0.9", linewidth=0)
        seen += ends
    low, high = min(seen), max(seen)
    room = _BEYOND * (high - low) or 1.0
    points = [low - room, *marks, high + room]
    for mark in marks:
        axes.axvline(mark, color="0.45", linewidth=0.8, linestyle=":")
    unit = _unit(of, plant, units)
    if isinstance(element, Contact):
        rates = _rates(element, room, x)
        unit_of_rate = _unit(element.rate, plant, units)
        for rate, style in zip(rates, _STYLES, strict=True):
            fine = np.linspace(points[0], points[-1], _POINTS)
            said = f"ṡ = {number_text(rate, '.2g')} {unit_of_rate}".rstrip()
            axes.plot(fine, [element(float(s), rate) for s in fine], label=said, **style)
        axes.legend(fontsize=7, frameon=False)
    else:
        axes.plot(points, [element.function(s) for s in points], **LOOK["actual"])
    form, constant = linear_form_text(of.row, plant.states), of.constant
    form += f" {'-' if constant < 0 else '+'} {abs(constant):.6g}" if constant else ""
    text = f"{'' if form == 's' else 's = '}{form}{f' ({unit})' if unit else ''}"
    label(axes, plain(text), "φ(s, ṡ)" if touches else "φ(s)", points)


def _rates(element: Contact, room: float, x: Array | None) -> tuple[float, float, float]:
    """Return at which speeds a contact is drawn: at rest, and either way with a quarter of the largest of a run."""
    rate = float(element.stiffness) * room / float(element.damping) / 2
    if x is not None:
        rate = float(np.abs(x @ element.rate.row + element.rate.constant).max()) / 4 or rate
    return 0.0, rate, -rate


def _texts(element: Nonlinearity | Contact, plant: PWASystem, units: Mapping[str, str], letters: int) -> str:
    """Return what is said above a panel: the name, what φ adds to which rate, and its slope in each cell."""
    least = 1e-12 * max(abs(float(d)) for d in element.direction)
    added = [
        f"{number_text(float(d), '.4g')} φ to d{name}/dt{f' ({unit})' if unit else ''}"
        for name, d in zip(plant.states, element.direction, strict=True)
        for unit in [per_second(units.get(name, ""))]
        if abs(float(d)) > least
    ]
    lines = [f"{element.name}: {', '.join(added)}"]
    if isinstance(element, Contact):
        stiffness, damping = (number_text(float(v), ".6g") for v in (element.stiffness, element.damping))
        lines.append(f"φ pushes and never pulls: stiffness {stiffness}, damping {damping}")
    else:
        slopes = zip(element.function.segments, element.function.slopes, strict=True)
        said = ", ".join(f"{segment}: {number_text(float(slope), '.6g')}" for segment, slope in slopes)
        unit = _unit(element.of, plant, units)
        lines.append(f"slopes of φ{f' per {unit}' if unit else ''}: {said}")
    return "\n".join(part for line in lines for part in textwrap.wrap(line, letters, max_lines=3, placeholder=" …"))


def _unit(form: LinearForm, plant: PWASystem, units: Mapping[str, str]) -> str:
    found = {units.get(name, "") for name, v in zip(plant.states, form.coefficients, strict=True) if float(v)}
    return found.pop() if len(found) == 1 else ""
