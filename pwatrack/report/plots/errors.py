"""Tracking and observer errors, within what is proved of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pwatrack.arrays import Array
from pwatrack.control.bounds import Form
from pwatrack.report.plots.canvas import (
    ACTUAL,
    BAND,
    BOUND,
    REQUIRED,
    ROUNDING,
    canvas,
    label,
    legend,
    plain,
    span,
)
from pwatrack.report.plots.requirements import error_lines, limits
from pwatrack.report.wording import error_unit, states_unit
from pwatrack.workflow.result import SimulatedLoop

_MOST = 8  # panels of single errors
_BEYOND = 3.0  # times the largest error: how much of a band is shown
_HIGH, _LOW = 1.6, 0.85  # inches of a panel, where there are one or two and where there are more


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """One error: its name and unit, its values over time, which bound is its, the size of the signal, and which it is.

    An error of the observer has no name of a signal.
    """

    name: str
    unit: str
    values: Array
    form: Form
    of: float
    signal: str = ""


def tracking_error(result: SimulatedLoop) -> Figure:
    """Draw each tracking error over time within its proved band, and their norm, logarithmic (Figure 2)."""
    controller, response, units = result.controller, result.response, result.spec.problem.units
    desired = response.tracked_d if controller.tracking == "output" else response.x_d
    panels = [
        _Panel(
            name=f"{name} − {name}_d",
            unit=units.get(name, ""),
            values=response.tracking_error[:, k],
            form=(controller.tracking, k),
            of=float(np.abs(desired[:, k]).max()),
            signal=name,
        )
        for k, name in enumerate(controller.error_names)
    ]
    unit = error_unit(result)
    title = f"Tracking error: at most {result.final_error:.1e} {unit}".rstrip() + " in the last tenth of the time"
    title += ", at the samples" * ("final_error" in result.figures.sampled)
    bound = result.bands.get(panels[0].form) if len(panels) == 1 else result.tracking_bound
    figure, drawn = _panels(result, title, panels, response.error_sizes)
    if len(panels) == 1:
        error_lines(drawn[0], result, (-1, 1))
        legend(drawn[0], columns=4)
    norm = "‖e‖" if len(panels) > 1 else "size"
    _magnitude(drawn[-1], result, response.error_norm, bound, f"{norm}{f' ({unit})' if unit else ''}")
    error_lines(drawn[-1], result, (1,))
    legend(drawn[-1], columns=4)
    return figure


def observer_error(result: SimulatedLoop) -> Figure:
    """Draw each observer error over time within its proved band, and ‖x − x̂‖, logarithmic (Figure 2)."""
    plant, response, units = result.spec.problem.plant, result.response, result.spec.problem.units
    error, unit = response.observer_error, states_unit(result.spec)
    title = f"Observer error: {error[-1]:.1e} {unit}".rstrip() + " at the end"
    panels = [
        _Panel(
            name=f"{name}_hat − {name}",
            unit=units.get(name, ""),
            values=response.x_hat[:, k] - response.x[:, k],
            form=("estimate", k),
            of=float(np.abs(response.x[:, k]).max()),
        )
        for k, name in enumerate(plant.states)
    ]
    figure, drawn = _panels(result, title, panels, response.state_sizes)
    bound = result.bands.get(panels[0].form) if len(panels) == 1 else result.observer_bound
    _magnitude(drawn[-1], result, error, bound, f"‖x̂ − x‖{f' ({unit})' if unit else ''}")
    mark = REQUIRED | {"linestyle": "none", "marker": "_", "markersize": 14}
    for limit in limits(result, "final_observer_error"):
        drawn[-1].plot(response.t[-1:], [limit], label="required at the end", **mark)
    legend(drawn[-1], columns=4)
    return figure


def _panels(result: SimulatedLoop, title: str, panels: Sequence[_Panel], sizes: Array) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each error, of many those that are furthest off, and room for their norm."""
    t, count = result.response.t, min(len(panels), _MOST)
    if count < len(panels):
        furthest = np.argsort([-np.abs(panel.values).max() / size for panel, size in zip(panels, sizes, strict=True)])
        panels = [panels[k] for k in sorted(furthest[:count].tolist())]
        title += f"; the {count} that are furthest off, in sizes"
    heights = [_HIGH if count <= 2 else _LOW] * count
    height = 1.3 + sum(heights) + 0.2 * count + 2.1
    figure, drawn = canvas(result, title, [[k] for k in range(count + 1)], height=height, ratios=[*heights, 2.1])
    for axes, panel in zip(drawn, panels, strict=False):
        seen = max(float(np.abs(panel.values).max()), ROUNDING * panel.of)
        if (band := result.bands.get(panel.form)) is not None:
            axes.fill_between(t, -band, band, label="proved, whatever the switching", **BAND)
            for edge in (-band, band):
                axes.plot(t, edge, color="0.6", linewidth=0.8)
            seen = max(seen, min(_BEYOND * seen, float(band.max())))
        axes.axhline(0, color="0.6", linewidth=0.8)
        seen = max([seen, *(error_lines(axes, result, (-1, 1), panel.signal) if panel.signal else ())])
        axes.plot(t, panel.values, label="simulated", **ACTUAL)
        axes.set_ylim(-1.06 * seen or -1.0, 1.06 * seen or 1.0)
        axes.set_title(plain(panel.name), loc="left", fontsize=8, pad=3)
        label(axes, "", plain(panel.unit), span(t))
    legend(drawn[0], columns=4)
    return figure, drawn


def _magnitude(axes: Axes, result: SimulatedLoop, size: Array, bound: Array | None, name: str) -> None:
    """Draw the size of an error on a logarithmic scale, under its proved bound."""
    t, floor = result.response.t, ROUNDING * np.abs(result.response.x).max()
    if bound is not None and (above := bound > floor).any():
        axes.semilogy(t[above], bound[above], label="proved bound, whatever the switching", **BOUND)
    axes.semilogy(t, np.where(size > 0, size, np.nan), label="simulated", **ACTUAL)
    low, high = axes.get_ylim()
    if low < floor:
        axes.axhspan(low, floor, color="0.92", linewidth=0, label="rounding of the simulation")
        axes.set_ylim(low, max(high, floor))
    label(axes, "time t (s)", f"{name}, logarithmic", span(t))
