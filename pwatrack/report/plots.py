"""The pictures of a closed loop. The only module that knows matplotlib."""

import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from pwatrack.arrays import Array, IntArray
from pwatrack.control.pareto import Front
from pwatrack.model.pwa import linear_form_text
from pwatrack.report.figures import error_unit, states_unit
from pwatrack.result import Result
from pwatrack.spec.expression import LinearForm
from pwatrack.variation import EnsembleResult

# Dark solid and light dashed: told apart without colour too.
_ACTUAL: dict[str, Any] = {"color": "#12355b", "linewidth": 1.3}
_DESIRED: dict[str, Any] = {"color": "#e08e2b", "linewidth": 1.1, "linestyle": (0, (4, 2))}
_BOUND: dict[str, Any] = {"color": "0.45", "linewidth": 1.3, "linestyle": (0, (6, 2))}
_WORST: dict[str, Any] = {"color": "black", "linewidth": 0.9, "linestyle": (0, (3, 1.5))}
_STYLES = ("-", "--", "-.", ":")
_WIDTH = 7.5  # inches
_ENLARGED = 0.6  # of the time: a longer part at either end is not worth a panel of its own
_COLUMNS = 2000  # of a picture: more times than this cannot be told apart in print
_MOST_ROWS = 40  # of cells in a picture
_LONGEST = 60  # characters of the name of a cell beside its row: there is room for half as many again
_ROUNDING = 1e-11  # of the largest state: an error below it is rounding of the simulation, which no proof bounds


def draw(result: Result) -> dict[str, Figure]:
    """Return every picture by file name.

    tracking_error and observer_error are the paper's Figure 2, internal_states
    its Figure 3, steady_state its Figure 4.
    """
    figures = {
        "tracking_error.png": tracking_error(result),
        "observer_error.png": observer_error(result),
        "outputs.png": outputs(result),
        "input.png": control_input(result),
        "cells.png": active_cells(result),
    }
    if result.response.eta.shape[1]:
        figures["internal_states.png"] = internal_states(result)
    if result.steady_state is not None:
        figures["steady_state.png"] = steady_state(result)
    if result.response.estimates.shape[1]:
        figures["estimates.png"] = estimates(result)
    for k, forms in enumerate(result.spec.scenario.portraits):
        figures[f"portrait_{k + 1}.png"] = portrait(result, forms)
    return figures


def tracking_error(result: Result) -> Figure:
    """Draw the tracking error over time, linear and logarithmic with its proved bound (Figure 2)."""
    plant = result.spec.problem.plant
    names = plant.tracked_names if result.controller.generator is not None else plant.states
    error = result.response.tracking_error / result.response.error_sizes
    curves = {f"{name} − {name}_d": error[:, k] for k, name in enumerate(names)}
    unit = error_unit(result)
    title = f"Tracking error: at most {result.final_error:.1e} {unit}".rstrip() + " in the last tenth of the time"
    size = result.response.error_norm
    return _error(result, curves, size, result.tracking_bound, unit, title)


def observer_error(result: Result) -> Figure:
    """Draw ‖x − x̂‖ over time, linear and logarithmic with its proved bound (Figure 2)."""
    error = result.response.observer_error
    unit = states_unit(result.spec)
    title = f"Observer error: {error[-1]:.1e} {unit}".rstrip() + " at the end"
    return _error(result, {"‖x − x̂‖": error}, error, result.observer_bound, unit, title)


def outputs(result: Result) -> Figure:
    """Draw what is tracked, then what else is measured, each with its desired value; one alone also at both ends."""
    response, plant = result.response, result.spec.problem.plant
    others = [k for k, name in enumerate(plant.outputs) if name not in plant.tracked_names]
    names = [*plant.tracked_names, *(plant.outputs[k] for k in others)]
    actual = np.hstack([response.tracked, response.y[:, others]])
    desired = np.hstack([response.tracked_d, response.y_d[:, others]])
    return _pairs(result, "Outputs", names, actual, desired, ("output", "desired"))


def estimates(result: Result) -> Figure:
    """Draw the estimate of each unknown load beside what it is."""
    loads, response = result.controller.plant.loads, result.response
    assert loads is not None
    return _pairs(result, "Unknown loads", loads.names, response.estimates, response.loads, ("estimate", "load"))


def control_input(result: Result) -> Figure:
    """Draw each input with its feedforward part, whole and at both ends."""
    response = result.response
    output = result.controller.generator is not None
    labels = ("input (19)", "its feedforward part (16)") if output else ("input (10)", "its feedforward part")
    return _pairs(result, "Control input", result.spec.problem.plant.inputs, response.u, response.u_ff, labels)


def internal_states(result: Result) -> Figure:
    """Draw each internal state η with its desired trajectory from the generator (Figure 3)."""
    response, names = result.response, result.controller.trajectory.names
    figure, panels = _column(result, "Internal states" if result.controller.generator else "States", len(names))
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        axes.plot(response.t, response.eta[:, k], label="plant", **_ACTUAL)
        axes.plot(response.t, response.eta_hat[:, k], label=_desired_label(result), **_DESIRED)
        _label(axes, "time t (s)" if k == len(names) - 1 else "", _labelled(result, name), _span(response.t))
    _legend(panels[0])
    return figure


def fan(many: EnsembleResult) -> Figure:
    """Draw how the tracking error of an ensemble spreads over time, linear until most have settled, and logarithmic."""
    kept, result = many.ensemble, many.nominal
    unit = error_unit(result)
    largest = f"{kept.final.max():.1e} {unit}".rstrip()
    said = f"{len(kept.error):,} members {many.variation.text}"
    title = f"{said}: tracking error at most {largest} in the last tenth of the time"
    last = "last to be small" if np.isfinite(kept.small_from).all() else "largest at the end"
    figure, (linear, logarithmic) = _canvas(result, title, [[0], [1]], height=6.2)
    floor = _ROUNDING * np.abs(result.response.x).max()
    size = "|y − y_d|" if result.controller.generator else "‖x − x_d‖"
    slowest = int(np.lexsort((kept.final, kept.small_from))[-1])
    falling = kept.t[kept.error.max(axis=0) > floor][-1:]  # until the last error is rounding
    ends = (np.quantile(kept.small_from, 0.95, method="higher"), 1.2 * falling[0] if len(falling) else 0.0)
    for axes, end, member, name in (
        (linear, ends[0], int(np.argmax(kept.largest)), "largest"),
        (logarithmic, ends[1], slowest, last),
    ):
        columns = np.flatnonzero(kept.t <= max(end, kept.t[1]))
        columns = columns[:: max(1, len(columns) // _COLUMNS)]
        t, error = kept.t[columns], kept.error[:, columns]
        low, quarter, middle, three_quarters, high = np.quantile(error, (0.05, 0.25, 0.5, 0.75, 0.95), axis=0)
        axes.fill_between(t, low, high, color="0.82", linewidth=0, label="90 % of the members")
        axes.fill_between(t, quarter, three_quarters, color="0.6", linewidth=0, label="50 %")
        axes.plot(t, middle, label="median", **_ACTUAL)
        axes.plot(t, error[member], label=f"{name}: member {member + 1}", **_WORST)
        _legend(axes, columns=4)
        _label(axes, "time t (s)", size + (f" ({unit})" if unit else ""), _span(t))
        bottom = float(low.min()) / 3
    linear.set_ylim(bottom=0)
    logarithmic.set_yscale("log")
    logarithmic.set_ylim(bottom=max(bottom, floor / 10))
    if bottom < floor:
        logarithmic.axhspan(logarithmic.get_ylim()[0], floor, color="0.92", linewidth=0)
        logarithmic.annotate(
            "rounding", (logarithmic.get_xlim()[1], floor), ha="right", va="top", fontsize=8, color="0.3"
        )
    return figure


def pareto_fronts(name: str, fronts: Sequence[Front]) -> Figure:
    """Draw the smallest gain against the decay rate for controller and observer, with the chosen points."""
    figure = Figure(figsize=(_WIDTH, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(textwrap.fill(f"{name}: what a faster decay costs", 90), fontsize=11)
    for axes, front in zip(figure.subplots(1, len(fronts)), fronts, strict=True):
        letter, rate, norm = front.role.letter, *front.chosen
        axes.plot(front.rates, front.norms, marker="o", markersize=3.5, label="smallest found", **_ACTUAL)
        axes.plot([rate], [norm], "s", color="#e08e2b", markersize=8, markeredgecolor="black", label="this design")
        if np.isfinite(front.limit):
            axes.axvline(front.limit, color="0.45", linewidth=1.0, linestyle=":", label="no gain found from here")
        positive = np.append(front.norms, norm)
        axes.set_yscale("log" if (positive > 0).all() and positive.max() > 30 * positive.min() else "linear")
        axes.set_title(f"{front.role.name}", fontsize=10)
        axes.set_xlabel("certified decay rate (1/s)")
        axes.set_ylabel(f"‖{letter}‖ in sizes{'' if letter == 'K' else ', 1/s'}")
        axes.grid(visible=True, color="0.9")
        axes.legend(fontsize=8, frameon=False)
    return figure


def steady_state(result: Result) -> Figure:
    """Draw the generator's periodic steady state over two periods (Figure 4)."""
    trace = result.steady_state
    assert trace is not None
    names = result.controller.trajectory.names
    period = trace.t[-1]
    title = f"Periodic steady state of the desired trajectory, period {period:.6g} s"
    figure, panels = _column(result, title, len(names))
    t = np.concatenate([trace.t, trace.t[1:] + period])
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        values = trace.z[:, k]
        axes.plot(t, np.concatenate([values, values[1:]]), label=_desired_label(result), **_ACTUAL)
        axes.axvline(period, color="0.5", linewidth=0.8, linestyle=":", label="one period")
        _label(
            axes,
            "time t in two periods (s)" if k == len(names) - 1 else "",
            _labelled(result, name),
            _span(t),
        )
    _legend(panels[0])
    return figure


def portrait(result: Result, forms: tuple[LinearForm, LinearForm]) -> Figure:
    """Draw two linear forms of the plant's state against each other, with the facets and cells that can be seen there.

    A hyperplane is a line in the picture if its normal is a combination of the two forms.
    """
    plant, response = result.loop.plant, result.response
    rows, constants = np.array([form.row for form in forms]), np.array([form.constant for form in forms])
    names = [linear_form_text(form.row, plant.states) for form in forms]
    figure, (axes,) = _canvas(result, f"Phase portrait: {names[1]} against {names[0]}", [[0]], height=5.6)
    actual, desired = (x @ rows.T + constants for x in (response.x, response.x_d))
    last = min(result.controller.trajectory.exosystem.period or response.t[-1] / 2, response.t[-1])
    steady = response.t >= response.t[-1] - last
    axes.plot(*actual.T, label="plant", **_ACTUAL | {"linewidth": 0.8})
    axes.plot(*desired[steady].T, label=f"desired, last {last:.4g} s", **_DESIRED)
    axes.plot(*actual[0], "o", color=_ACTUAL["color"], markersize=5, label="start")
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
    _label(axes, labels[0], labels[1], (limits[0, 0], limits[0, 1]))
    _legend(axes, columns=4)
    figure.draw_without_rendering()  # only now is it known where things are
    placed: list[Bbox] = []
    for name, signs in zip(plant.cell_names, plant.partition.signs, strict=True):
        inside = (sides * signs >= 0).all(axis=-1)
        if not signs[~seen].any() and inside.any():

            def within(points: Array, signs: IntArray = signs) -> bool:
                return bool((np.sign(points @ normals.T + offsets) * signs >= 0).all())

            _name_cell(axes, _plain(name), grid[inside].mean(axis=0), within, placed)
    return figure


def _name_cell(axes: Axes, name: str, middle: Array, within: Callable[[Array], bool], placed: list[Bbox]) -> None:
    """Write the name of a cell in its middle, along or upright, where it fits into it and on no other name."""
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0}
    text = axes.text(middle[0], middle[1], name, fontsize=8, ha="center", va="center", bbox=box)
    for rotation in (0, 90):
        text.set_rotation(rotation)
        extent = text.get_window_extent()
        corners = axes.transData.inverted().transform(extent.corners())
        shown = all(axes.bbox.contains(*corner) for corner in extent.corners())
        if shown and within(corners) and not any(extent.overlaps(other) for other in placed):
            placed.append(extent)
            return
    text.remove()


def active_cells(result: Result) -> Figure:
    """Draw which cell plant, observer and generator are in, and at which limit an input is, over time."""
    trace, parts = result.response.trace, result.loop.flow.parts
    stays = trace.stays()
    seen = [{part.cells[mode[k]] for mode, _, _ in stays} for k, part in enumerate(parts)]
    rows = [
        _grouped([name for name in dict.fromkeys(part.cells) if name in names], part.cells)
        for part, names in zip(parts, seen, strict=True)
    ]
    figure, panels = _canvas(
        result,
        f"Active cells: {result.figures.mode_changes} changes",
        [[k] for k in range(len(parts))],
        height=1.4 + sum(max(0.9, 0.3 + 0.22 * len(names)) for names in rows),
        ratios=[max(0.9, 0.3 + 0.22 * len(names)) for names in rows],
    )
    for k, (axes, part, names) in enumerate(zip(panels, parts, rows, strict=True)):
        for row, group in enumerate(names.values()):
            bars = np.array([(start, end) for mode, start, end in stays if part.cells[mode[k]] in group])
            axes.broken_barh(
                joined(bars, trace.t[-1] / _COLUMNS), (row - 0.4, 0.8), color=_ACTUAL["color"], linewidth=0
            )
        axes.set_yticks(range(len(names)), [_plain(name) for name in names], fontsize=8)
        axes.set_ylim(len(names) - 0.4, -0.6)
        _label(axes, "time t (s)" if k == len(parts) - 1 else "", part.name, _span(trace.t))
    return figure


def _grouped(names: Sequence[str], cells: Sequence[str]) -> dict[str, set[str]]:
    """Return the rows of a picture, each with the cells that it shows: so many that there is room for them."""
    shown = names if len(names) <= _MOST_ROWS else names[: _MOST_ROWS - 1]
    rows = {
        name if len(name) <= _LONGEST else f"{name[:_LONGEST]}… (cell {cells.index(name) + 1})": {name}
        for name in shown
    }
    others = set(names[len(shown) :])
    return rows | ({f"{len(others):,} other cells": others} if others else {})


def joined(bars: Array, dot: float) -> list[tuple[float, float]]:
    """Return (start, length) of bars (start, end) in order, those joined that are nearer to each other than a dot."""
    apart = np.flatnonzero(bars[1:, 0] - bars[:-1, 1] > dot)
    starts, ends = bars[np.append(0, apart + 1), 0], bars[np.append(apart, -1), 1]
    return list(zip(starts.tolist(), (ends - starts).tolist(), strict=True))


def _error(result: Result, curves: dict[str, Array], size: Array, bound: Array | None, unit: str, title: str) -> Figure:
    """Draw error components, and below them their size on a logarithmic scale, under its proved bound."""
    figure, (linear, logarithmic) = _canvas(result, title, [[0], [1]], height=5.2)
    t = result.response.t
    unit = f" ({unit})" if unit else ""
    for k, (label, values) in enumerate(curves.items()):
        linear.plot(
            t, values, label=_plain(label), **_ACTUAL | {"linestyle": _STYLES[k % 4], "alpha": 1 - 0.15 * (k % 4)}
        )
    linear.axhline(0, color="0.6", linewidth=0.8)
    _label(linear, "", (next(iter(curves)) if len(curves) == 1 else "error") + unit, _span(t))
    if len(curves) > 1:
        _legend(linear)
    floor = _ROUNDING * np.abs(result.response.x).max()
    if bound is not None and (above := bound > floor).any():
        logarithmic.semilogy(t[above], bound[above], label="proved bound, whatever the switching", **_BOUND)
    logarithmic.semilogy(t, np.where(size > 0, size, np.nan), label="simulated", **_ACTUAL)
    low, high = logarithmic.get_ylim()
    if low < floor:
        logarithmic.axhspan(low, floor, color="0.92", linewidth=0, label="rounding of the simulation")
        logarithmic.set_ylim(low, max(high, floor))
    _legend(logarithmic, columns=3)
    _label(logarithmic, "time t (s)", f"magnitude{unit}, logarithmic", _span(t))
    return figure


def _pairs(
    result: Result, title: str, names: Sequence[str], actual: Array, desired: Array, labels: tuple[str, str]
) -> Figure:
    """Draw pairs of curves: one pair over the whole time and, where it is long, both ends; several below each other."""
    t = result.response.t
    spans = [_span(t)]
    window = _window(result)
    if len(names) == 1 and window < _ENLARGED * (t[-1] - t[0]):
        figure, panels = _canvas(result, title, [[0, 0], [1, 2]], height=5.2)
        spans += [(float(t[0]), window), (float(t[-1]) - window, float(t[-1]))]
        panels[1].set_title("start", fontsize=9)
        panels[2].set_title("end", fontsize=9)
        for small in panels[1:]:
            small.locator_params(axis="x", nbins=6)
    else:
        figure, panels = _column(result, title, len(names))
        spans *= len(names)
    for k, (axes, (first, last)) in enumerate(zip(panels, spans, strict=True)):
        column = k if len(names) > 1 else 0
        shown = (t >= first) & (t <= last)
        for label, values, style in zip(labels, (actual, desired), (_ACTUAL, _DESIRED), strict=True):
            axes.plot(t[shown], values[shown, column], label=label, **style)
        _label(axes, "time t (s)", _labelled(result, names[column]), (first, last))
        _widen(axes, float(np.abs(actual[:, column]).max()))
    _legend(panels[0])
    return figure


def _desired_label(result: Result) -> str:
    return "desired, from the generator (15)" if result.controller.generator else "desired, own response to the input"


def _column(result: Result, title: str, count: int) -> tuple[Figure, list[Axes]]:
    """Return panels below each other."""
    return _canvas(result, title, [[k] for k in range(count)], height=1.2 + (1.7 if count <= 6 else 1.1) * count)


def _canvas(
    result: Result, title: str, mosaic: Any, *, height: float, ratios: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its panels in the order of their numbers in the mosaic."""
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    conditions = "; ".join(result.loop.conditions.texts(result.spec.problem.plant))
    lines = [*textwrap.wrap(result.spec.name, 90), *textwrap.wrap(f"({conditions})" if conditions else "", 100), title]
    figure.suptitle(_plain("\n".join(lines)), fontsize=10)
    panels: dict[int, Axes] = figure.subplot_mosaic(mosaic, height_ratios=ratios)
    return figure, [panels[key] for key in sorted(panels)]


def _label(axes: Axes, x: str, y: str, span: tuple[float, float]) -> None:
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(_plain(y), fontsize=9)
    axes.set_xlim(*span)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _widen(axes: Axes, size: float) -> None:
    """Keep an axis from magnifying rounding: it spans at least a hundredth of the size of the curve."""
    low, high = axes.get_ylim()
    if high - low < 0.01 * size:
        middle = (low + high) / 2
        axes.set_ylim(middle - 0.005 * size, middle + 0.005 * size)
    axes.ticklabel_format(axis="y", useOffset=False)


def _legend(axes: Axes, columns: int = 2) -> None:
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, fontsize=8, frameon=False, borderaxespad=0.2
    )


def _span(t: Array) -> tuple[float, float]:
    return float(t[0]), float(t[-1])


def _window(result: Result) -> float:
    """Return how much of either end to show: five periods of the reference, or a tenth of the time."""
    total = float(result.response.t[-1])
    period = result.controller.trajectory.exosystem.period
    return min(total, 5 * period if period else total / 10)


def _plain(text: str) -> str:
    """Return text that matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def _labelled(result: Result, name: str) -> str:
    unit = result.spec.problem.units.get(name, "")
    return f"{name} ({unit})" if unit else name
