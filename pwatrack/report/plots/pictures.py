"""Every picture of a run, by its name; here those of its cells: over time, and in phase portraits."""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from pwatrack.arrays import Array, IntArray
from pwatrack.model.linear_form import LinearForm
from pwatrack.model.pwa import linear_form_text
from pwatrack.report.figures import percent
from pwatrack.report.plots import signals
from pwatrack.report.plots.canvas import COLUMNS, LOOK, canvas, label, legend, plain
from pwatrack.report.plots.elements import nonlinearities
from pwatrack.report.stays import stays
from pwatrack.workflow.outcome import SimulatedLoop

_PLACES = 200  # of a cell at which its name may stand
_CLEAR = 4.0  # dots of a picture between a name and a curve
_MOST_DOTS = 20_000  # of a curve that are looked at
_HAIR = 0.5  # points: a stay that is shorter than a dot is seen all the same


def pictures(result: SimulatedLoop) -> dict[str, Callable[[], Figure]]:
    """Return what draws each picture, by its name: of some the paper has one, which they name."""
    of_result = {
        "tracking_error": signals.tracking_error,
        "observer_error": signals.observer_error,
        "outputs": signals.outputs,
        "states": signals.states,
        "input": signals.control_input,
        "cells": active_cells,
    }
    if result.response.eta.shape[1]:
        of_result["internal_states"] = signals.internal_states
    if result.steady_state is not None:
        of_result["steady_state"] = signals.steady_state
    if result.response.estimates.shape[1]:
        of_result["estimates"] = signals.estimates
    found: dict[str, Callable[[], Figure]] = {name: partial(draw, result) for name, draw in of_result.items()}
    problem = result.spec.problem
    if problem.plant.elements:
        draw = partial(nonlinearities, result.spec.name, problem.plant, problem.units, result.response.x)
        found["nonlinearities"] = draw
    for k, forms in enumerate(result.spec.scenario.portraits, 1):
        found[f"portrait_{k}"] = partial(portrait, result, forms)
    return found


def portrait(result: SimulatedLoop, forms: tuple[LinearForm, LinearForm]) -> Figure:
    """Draw two linear forms of the plant's state against each other, with the facets and cells that can be seen there.

    A hyperplane is a line in the picture if its normal is a combination of the two forms.
    """
    plant, response = result.loop.plant, result.response
    rows, constants = np.array([form.row for form in forms]), np.array([form.constant for form in forms])
    names = [linear_form_text(form.row, plant.states) for form in forms]
    figure, (axes,) = canvas(result, f"Phase portrait: {names[1]} against {names[0]}", [[0]], height=5.6)
    actual, desired = (x @ rows.T + constants for x in (response.x, response.x_d))
    last = min(result.controller.trajectory.exosystem.period or response.t[-1] / 2, response.t[-1])
    steady = response.t >= response.t[-1] - last
    axes.plot(*actual.T, label="plant", **LOOK["actual"] | {"linewidth": 0.8})
    axes.plot(*desired[steady].T, label=f"desired, last {last:.4g} s", **LOOK["desired"])
    axes.plot(*actual[0], "o", color=LOOK["actual"]["color"], markersize=5, label="start")
    normals = np.linalg.lstsq(rows.T, plant.partition.H.T, rcond=None)[0].T
    seen = np.abs(normals @ rows - plant.partition.H).max(axis=1, initial=0.0) < 1e-9
    offsets = plant.partition.h - normals @ constants
    limits = np.array([axes.get_xlim(), axes.get_ylim()])
    grid = np.stack(np.meshgrid(*np.linspace(limits[:, 0], limits[:, 1], 200).T), axis=-1)
    sides = np.sign(grid @ normals.T + offsets)
    for k in np.flatnonzero(seen):
        style: dict[str, Any] = {"colors": "0.35", "linewidths": 0.9, "linestyles": ":"}
        axes.contour(grid[..., 0], grid[..., 1], grid @ normals[k] + offsets[k], levels=[0.0], **style)
    axes.plot([], [], color="0.35", linewidth=0.9, linestyle=":", label="facets") if seen.any() else None
    axes.set_ylim(*limits[1])
    units = [{result.spec.problem.units.get(plant.states[j], "") for j in np.flatnonzero(row)} for row in rows]
    labels = [
        f"{name} ({min(unit)})" if len(unit) == 1 and min(unit) else name
        for name, unit in zip(names, units, strict=True)
    ]
    label(axes, labels[0], labels[1], limits[0])
    legend(axes, columns=4)
    figure.draw_without_rendering()  # only now is it known where things are
    start = np.repeat(axes.transData.transform(actual[:1]), _MOST_DOTS, axis=0)  # no name is to stand on it
    curves = (_dots(axes.transData.transform(curve)) for curve in (actual, desired[steady]))
    placed, drawn = list[Bbox](), np.concatenate([start, *curves])
    for name, signs in zip(plant.cell_names, plant.partition.signs, strict=True):
        inside = (sides * signs >= 0).all(axis=-1)
        if not signs[~seen].any() and inside.any():

            def within(points: Array, signs: IntArray = signs) -> bool:
                return bool((np.sign(points @ normals.T + offsets) * signs >= 0).all())

            _name_cell(axes, plain(name), grid[inside], within, placed, drawn)
    return figure


def _dots(curve: Array) -> Array:
    """Return dots of a curve (K, 2), in dots of a picture, that are about two apart, (s, 2)."""
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
    at = np.linspace(0.0, along[-1], min(int(along[-1] / 2) + 2, _MOST_DOTS))
    return np.column_stack([np.interp(at, along, x) for x in curve.T])


def _name_cell(
    axes: Axes, name: str, inside: Array, within: Callable[[Array], bool], placed: list[Bbox], drawn: Array
) -> None:
    """Write the name of a cell where it fits into it and on no other name, along or upright: on as little as can be.

    That is in the middle of its points (k, 2), or at another of them if that hides less of what is drawn, (s, 2).
    """
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0}
    text, sizes = axes.text(0, 0, name, fontsize=8, ha="center", va="center", bbox=box), dict[int, Array]()
    for rotation in (0, 90):
        text.set_rotation(rotation)
        sizes[rotation] = np.array(text.get_window_extent().size)
    middle = inside.mean(axis=0)
    best = len(drawn) + 1, middle, 0
    others = inside[np.linspace(0, len(inside) - 1, _PLACES).astype(int)]
    others = others[np.argsort(np.linalg.norm((others - middle) / np.ptp(inside, axis=0).clip(1e-300), axis=1))]
    for place, rotation in product((middle, *others), sizes):
        at, half = axes.transData.transform(place), sizes[rotation] / 2
        extent = Bbox([at - half, at + half])
        corners = axes.transData.inverted().transform(extent.corners())
        shown = all(axes.bbox.contains(*corner) for corner in extent.corners())
        if shown and within(corners) and not any(extent.overlaps(other) for other in placed):
            hidden = int((np.abs(drawn - at) <= half + _CLEAR).all(axis=1).sum())
            best = min(best, (hidden, place, rotation), key=lambda one: one[0])
        if not best[0]:
            break
    if best[0] > len(drawn):
        text.remove()
        return
    text.set(position=best[1], rotation=best[2])
    placed.append(text.get_window_extent())


def active_cells(result: SimulatedLoop) -> Figure:
    """Draw which cell plant, observer and generator are in, and at which limit an input is, over time; and how much."""
    parts = list(stays(result, COLUMNS))
    count = result.figures.mode_changes
    title = f"Active cells, with the share of the time in each: {count} change{'s' * (count != 1)}"
    heights = [max(0.9, 0.3 + 0.22 * len(rows)) for _, rows in parts]
    mosaic = [[k] for k in range(len(parts))]
    figure, panels = canvas(result, title, mosaic, height=1.4 + sum(heights), ratios=heights)
    for axes, (part, rows) in zip(panels, parts, strict=True):
        for row, stay in enumerate(rows):
            axes.broken_barh(stay.bars, (row - 0.4, 0.8), color=LOOK["actual"]["color"], linewidth=_HAIR, snap=False)
        names = [f"{plain(stay.name)}  {percent(stay.share)}" for stay in rows]
        axes.set_yticks(range(len(rows)), names, fontsize=8)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        label(axes, "time t (s)" if axes is panels[-1] else "", part, result.response.t)
    return figure
