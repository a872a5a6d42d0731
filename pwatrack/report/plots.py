"""The pictures of a closed loop. The only module that knows matplotlib."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pwatrack.arrays import Array
from pwatrack.pipeline import Result

# Dark solid and light dashed: told apart without colour too.
_ACTUAL: dict[str, Any] = {"color": "#12355b", "linewidth": 1.3}
_DESIRED: dict[str, Any] = {"color": "#e08e2b", "linewidth": 1.1, "linestyle": (0, (4, 2))}
_WIDTH = 7.5  # inches


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
    return figures


def tracking_error(result: Result) -> Figure:
    """y − y_d over time, linear and logarithmic (Figure 2)."""
    return _error(
        result,
        result.response.tracking_error,
        f"tracking error {_output(result)} − {_output(result)}_d",
        _unit(result, _output(result)),
        f"Tracking error: at most {result.final_error:.1e} in the last tenth of the time",
    )


def observer_error(result: Result) -> Figure:
    """‖x − x̂‖ over time, linear and logarithmic (Figure 2)."""
    error = result.response.observer_error
    return _error(result, error, "observer error ‖x − x̂‖", "", f"Observer error: {error[-1]:.1e} at the end")


def outputs(result: Result) -> Figure:
    """Output and reference, whole and at both ends."""
    response, name = result.response, _output(result)
    curves = {f"output {name}": response.y, f"reference {name}_d": response.y_d}
    return _whole_and_ends(result, "Output and reference", name, curves)


def control_input(result: Result) -> Figure:
    """The input with its feedforward part, whole and at both ends."""
    response, name = result.response, result.spec.plant.inputs[0]
    curves = {f"input {name} (19)": response.u, "its feedforward part (16)": response.u_ff}
    return _whole_and_ends(result, "Control input", name, curves)


def internal_states(result: Result) -> Figure:
    """Each internal state η with its desired trajectory from the generator (Figure 3)."""
    response, names = result.response, result.controller.generator.form.eta_names
    figure, panels = _canvas(
        result.spec.name,
        "Internal states and the trajectory generator",
        [[k] for k in range(len(names))],
        height=1.2 + 1.7 * len(names),
    )
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        axes.plot(response.t, response.eta[:, k], label="plant", **_ACTUAL)
        axes.plot(response.t, response.eta_hat[:, k], label="desired, from the generator (15)", **_DESIRED)
        _label(axes, "time t (s)" if k == len(names) - 1 else "", _labelled(result, name), _span(response.t))
    _legend(panels[0])
    return figure


def steady_state(result: Result) -> Figure:
    """The generator's periodic steady state over two periods (Figure 4)."""
    trace = result.steady_state
    assert trace is not None
    names = result.controller.generator.form.eta_names
    period = trace.t[-1]
    figure, panels = _canvas(
        result.spec.name,
        f"Periodic steady state of the trajectory generator, period {period:.6g} s",
        [[k] for k in range(len(names))],
        height=1.2 + 1.7 * len(names),
    )
    t = np.concatenate([trace.t, trace.t[1:] + period])
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        values = trace.z[:, k]
        axes.plot(t, np.concatenate([values, values[1:]]), label="desired, from the generator (15)", **_ACTUAL)
        axes.axvline(period, color="0.5", linewidth=0.8, linestyle=":", label="one period")
        _label(
            axes,
            "time t modulo the period (s)" if k == len(names) - 1 else "",
            _labelled(result, name),
            _span(t),
        )
    _legend(panels[0])
    return figure


def active_cells(result: Result) -> Figure:
    """Which cell plant, observer and generator are in, over time."""
    trace, loop = result.response.trace, result.loop
    cells = result.spec.plant.cell_names
    figure, panels = _canvas(
        result.spec.name,
        f"Active cells: {len(trace.events)} changes, {len(trace.visited())} joint modes",
        [[0], [1], [2]],
        height=1.4 + 3 * max(0.9, 0.22 * len(cells)),
    )
    stays = trace.stays()
    for k, (axes, part) in enumerate(zip(panels, loop.flow.parts, strict=True)):
        for cell in range(len(cells)):
            bars = [(start, end - start) for mode, start, end in stays if mode[k] == cell]
            axes.broken_barh(bars, (cell - 0.4, 0.8), color=_ACTUAL["color"], linewidth=0)
        axes.set_yticks(range(len(cells)), cells, fontsize=8)
        axes.set_ylim(len(cells) - 0.4, -0.6)
        _label(axes, "time t (s)" if k == 2 else "", part.name, _span(trace.t))
    return figure


def _error(result: Result, error: Array, label: str, unit: str, title: str) -> Figure:
    figure, (linear, logarithmic) = _canvas(result.spec.name, title, [[0], [1]], height=5.2)
    t = result.response.t
    unit = f" ({unit})" if unit else ""
    linear.plot(t, error, **_ACTUAL)
    linear.axhline(0, color="0.6", linewidth=0.8)
    _label(linear, "", label + unit, _span(t))
    size = np.abs(error)
    logarithmic.semilogy(t, np.where(size > 0, size, np.nan), **_ACTUAL)
    _label(logarithmic, "time t (s)", f"magnitude{unit}, logarithmic", _span(t))
    return figure


def _whole_and_ends(result: Result, title: str, name: str, curves: dict[str, Array]) -> Figure:
    """Draw an actual and a desired curve over the whole time, and enlarged at the start and the end."""
    figure, (whole, start, end) = _canvas(result.spec.name, title, [[0, 0], [1, 2]], height=5.2)
    t = result.response.t
    total, window = float(t[-1]), _window(result)
    for axes, first, last in ((whole, 0.0, total), (start, 0.0, window), (end, total - window, total)):
        shown = (t >= first) & (t <= last)
        for (label, values), style in zip(curves.items(), (_ACTUAL, _DESIRED), strict=True):
            axes.plot(t[shown], values[shown], label=label, **style)
        _label(axes, "time t (s)", _labelled(result, name), (first, last))
    _legend(whole)
    start.set_title("start", fontsize=9)
    end.set_title("end", fontsize=9)
    return figure


def _canvas(name: str, title: str, mosaic: Any, *, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure and its panels in the order of their numbers in the mosaic."""
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{name}\n{title}", fontsize=10)
    panels: dict[int, Axes] = figure.subplot_mosaic(mosaic)
    return figure, [panels[key] for key in sorted(panels)]


def _label(axes: Axes, x: str, y: str, span: tuple[float, float]) -> None:
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.set_xlim(*span)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _legend(axes: Axes) -> None:
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8, frameon=False, borderaxespad=0.2)


def _span(t: Array) -> tuple[float, float]:
    return float(t[0]), float(t[-1])


def _window(result: Result) -> float:
    """Return how much of either end to show: five periods of the reference, or a tenth of the time."""
    total = float(result.response.t[-1])
    period = result.spec.reference.period
    return min(total, 5 * period if period else total / 10)


def _output(result: Result) -> str:
    return result.spec.plant.outputs[0]


def _unit(result: Result, name: str) -> str:
    return result.spec.units.get(name, "")


def _labelled(result: Result, name: str) -> str:
    unit = _unit(result, name)
    return f"{name} ({unit})" if unit else name
