"""Tracking and observer errors, within what is proved of them."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pwatrack.arrays import Array, number_text
from pwatrack.report.figures import norm_unit
from pwatrack.report.plots.canvas import ACTUAL, BOUND, REQUIRED, ROUNDING, band, canvas, label, legend, limits, plain
from pwatrack.simulation.trace import last_tenth
from pwatrack.workflow.outcome import SimulatedLoop

_Kind = Literal["output", "state", "estimate"]  # of what errors are: see `Form`
_MOST = 8  # panels of single errors
_BEYOND = 3.0  # times the largest error: how much of a band is shown
_DEPTH = 1e-6  # of where rounding begins: how far below it an error is shown
_HIGH, _LOW = 1.6, 0.85  # inches of a panel, where there are one or two and where there are more


def tracking_error(result: SimulatedLoop) -> Figure:
    """Draw each tracking error over time within its proved band, and their norm, logarithmic (Figure 2)."""
    controller, response = result.controller, result.response
    kind, names, unit = controller.tracking, controller.error_names, norm_unit(result.spec, controller.error_names)
    desired = response.tracked_d if kind == "output" else response.x_d
    title = f"Tracking error: at most {result.outcome.final} in the last tenth of the time"
    title += ", at the samples" * ("final_error" in result.figures.sampled)
    bound = result.bands.get((kind, 0)) if len(names) == 1 else result.tracking_bound
    figure, panels = _panels(result, title, kind, names, response.tracking_error, desired, response.error_sizes)
    if len(names) == 1:
        _error_lines(panels[0], result, (-1, 1))
        legend(panels[0], columns=4)
    norm = "‖e‖" if len(names) > 1 else "size"
    floor = ROUNDING * float(np.abs(desired / response.error_sizes).max())
    _magnitude(panels[-1], response.t, response.error_norm, bound, floor, f"{norm}{f' ({unit})' if unit else ''}")
    _error_lines(panels[-1], result, (1,))
    legend(panels[-1], columns=4)
    return figure


def observer_error(result: SimulatedLoop) -> Figure:
    """Draw each observer error over time within its proved band, and ‖x − x̂‖, logarithmic (Figure 2)."""
    states, response = result.spec.problem.plant.states, result.response
    error, unit = response.observer_error, norm_unit(result.spec, result.spec.problem.plant.states)
    off, x = response.x_hat - response.x, response.x
    floor = ROUNDING * float(np.abs(x / (response.state_sizes if len(states) > 1 else 1.0)).max())
    end = f"{number_text(error[-1], '.2g')} {unit}".rstrip() if error[-1] >= floor else "that of rounding"
    title = f"Observer error: {end} at the end"
    figure, panels = _panels(result, title, "estimate", states, off, x, response.state_sizes)
    bound = result.bands.get(("estimate", 0)) if len(states) == 1 else result.observer_bound
    _magnitude(panels[-1], response.t, error, bound, floor, f"‖x̂ − x‖{f' ({unit})' if unit else ''}")
    mark = REQUIRED | {"linestyle": "none", "marker": "_", "markersize": 14}
    for limit in limits(result, "final_observer_error"):
        panels[-1].plot(response.t[-1:], [limit], label="required at the end", **mark)
    legend(panels[-1], columns=4)
    return figure


def _panels(
    result: SimulatedLoop, title: str, kind: _Kind, names: Sequence[str], errors: Array, signals: Array, sizes: Array
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each error (K, n), of many for the furthest off, and room for their norm."""
    t, shown = result.response.t, list(range(len(names)))
    if len(names) > _MOST:
        shown = sorted(np.argsort(-np.abs(errors).max(axis=0) / sizes)[:_MOST].tolist())
        title += f"; the {_MOST} that are furthest off, in sizes"
    count = len(shown)
    heights = [_HIGH if count <= 2 else _LOW] * count
    height = 1.3 + sum(heights) + 0.2 * count + 2.1
    figure, panels = canvas(result, title, [[k] for k in range(count + 1)], height=height, ratios=[*heights, 2.1])
    for axes, k in zip(panels, shown, strict=False):
        name, error = names[k], errors[:, k]
        seen = max(float(np.abs(error).max()), ROUNDING * float(np.abs(signals[:, k]).max()))
        if (proved := result.bands.get((kind, k))) is not None:
            band(axes, t, -proved, proved, "proved, whatever the switching")
            for edge in (-proved, proved):
                axes.plot(t, edge, color="0.6", linewidth=0.8)
            seen = max(seen, min(_BEYOND * seen, float(proved.max())))
        axes.axhline(0, color="0.6", linewidth=0.8)
        if kind != "estimate":
            seen = max([seen, *_error_lines(axes, result, (-1, 1), name)])
        axes.plot(t, error, label="simulated", **ACTUAL)
        axes.set_ylim(-1.06 * seen or -1.0, 1.06 * seen or 1.0)
        text = f"{name}_hat − {name}" if kind == "estimate" else f"{name} − {name}_d"
        axes.set_title(plain(text), loc="left", fontsize=8, pad=3)
        label(axes, "", plain(result.spec.problem.units.get(name, "")), t)
    legend(panels[0], columns=4)
    return figure, panels


def _magnitude(axes: Axes, t: Array, size: Array, bound: Array | None, floor: float, name: str) -> None:
    """Draw the size of an error on a logarithmic scale, under its proved bound, and where it is rounding alone."""
    if bound is not None and (above := bound > floor).any():
        axes.semilogy(t[above], bound[above], label="proved bound, whatever the switching", **BOUND)
    if not (size > 0).any():
        axes.text(0.5, 0.5, "0 at all times, in the simulation", transform=axes.transAxes, ha="center", fontsize=9)
    axes.semilogy(t, np.where(size > 0, size, np.nan), label="simulated", **ACTUAL)
    low, high = axes.get_ylim()
    if low < floor:
        axes.axhspan(low, floor, color="0.92", linewidth=0, label="rounding of the simulation")
        axes.set_ylim(max(low, _DEPTH * floor), max(high, floor))
    label(axes, "time t (s)", f"{name}, logarithmic", t)


def _error_lines(axes: Axes, result: SimulatedLoop, signs: Sequence[int], signal: str | None = None) -> list[float]:
    """Draw the largest error that is required, of one signal or of the norm, late and ever; return the values."""
    t, drawn = result.response.t, list[float]()
    late = float(t[last_tenth(len(t)).start])
    for figure, start in (("final_error", late), ("largest_error", float(t[0]))):
        for limit in limits(result, figure if signal is None else f"{figure}s", signal):
            for sign in signs:
                axes.plot([start, t[-1]], [sign * limit] * 2, label="required", **REQUIRED)
                drawn.append(sign * limit)
    return drawn
