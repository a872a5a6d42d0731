"""Signals over time, each beside what it should be: outputs, states, inputs, loads, internal states."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pwatrack.arrays import Array
from pwatrack.report.plots.canvas import (
    ACTUAL,
    BAND,
    DESIRED,
    ENLARGED,
    ESTIMATE,
    LIMIT,
    REQUIRED,
    canvas,
    column,
    desired_label,
    label,
    labelled,
    legend,
    span,
    window,
    zoom,
)
from pwatrack.report.plots.requirements import limits, step_lines
from pwatrack.workflow.result import SimulatedLoop

_MOST = 12  # states in a picture
_Lines = Callable[[Axes, int], list[float]]  # draws lines into the panel of a signal, and returns their values


def outputs(result: SimulatedLoop) -> Figure:
    """Draw what is tracked, then what else is measured, each with its desired value; one alone also at both ends."""
    response, plant = result.response, result.spec.problem.plant
    others = [k for k, name in enumerate(plant.outputs) if name not in plant.tracked_names]
    names = [*plant.tracked_names, *(plant.outputs[k] for k in others)]
    actual = np.hstack([response.tracked, response.y[:, others]])
    desired = np.hstack([response.tracked_d, response.y_d[:, others]])

    def lines(axes: Axes, k: int) -> list[float]:
        tracked = k < len(plant.tracked_names)
        return step_lines(axes, result, names[k], actual[:, k], desired[:, k]) if tracked else []

    return _pairs(result, "Outputs", names, actual, desired, ("output", "desired"), lines)


def states(result: SimulatedLoop) -> Figure:
    """Draw each state beside where it should be and what the observer takes it for."""
    response, names = result.response, result.spec.problem.plant.states[:_MOST]
    more = len(result.spec.problem.plant.states) - len(names)
    figure, panels = column(result, f"States{f', without {more} more' if more else ''}", len(names))
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        curves = [values[:, k] for values in (response.x, response.x_d, response.x_hat)]
        for values, style, said in zip(
            curves, (ACTUAL, DESIRED, ESTIMATE), ("plant", "desired", "estimate"), strict=True
        ):
            axes.plot(response.t, values, label=said, **style)
        zoom(axes, response.t, curves, unit=result.spec.problem.units.get(name, ""))
        label(axes, "time t (s)" if k == len(names) - 1 else "", labelled(result, name), span(response.t))
    legend(panels[0], columns=3)
    return figure


def estimates(result: SimulatedLoop) -> Figure:
    """Draw the estimate of each unknown load beside what it is."""
    loads, response = result.controller.plant.loads, result.response
    assert loads is not None
    return _pairs(result, "Unknown loads", loads.names, response.estimates, response.loads, ("estimate", "load"))


def control_input(result: SimulatedLoop) -> Figure:
    """Draw each input with its feedforward part, its limits and what is proved of it, whole and at both ends."""
    response, names = result.response, result.spec.problem.plant.inputs
    labels = ("input (19)", "its feedforward part (16)")
    if result.controller.tracking == "state":
        labels = ("input (10)", "its feedforward part")

    def lines(axes: Axes, k: int) -> list[float]:
        drawn = list[float]()
        if (actuator := result.loop.conditions.limits) is not None:
            drawn += [limit for limit in actuator[k].tolist() if np.isfinite(limit)]
            for limit in drawn:
                axes.axhline(limit, label="limit", **LIMIT)
        for wish in limits(result, "largest_input", names[k]):
            for sign in (-1, 1):
                axes.axhline(sign * wish, label="required", **REQUIRED)
            drawn += [-wish, wish]
        if (band := result.bands.get(("input", k))) is not None:
            middle = response.u_ff[:, k]
            near = band <= np.ptp(middle) / 2  # what is wider shows nothing but grey
            if near.any():
                axes.fill_between(response.t, middle - band, middle + band, where=near, label="proved", **BAND)
        return drawn

    return _pairs(result, "Control input", names, response.u, response.u_ff, labels, lines)


def internal_states(result: SimulatedLoop) -> Figure:
    """Draw each internal state η with its desired trajectory from the generator (Figure 3)."""
    response, names = result.response, result.controller.trajectory.names
    figure, panels = column(result, "Internal states" if result.controller.generator else "States", len(names))
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        axes.plot(response.t, response.eta[:, k], label="plant", **ACTUAL)
        axes.plot(response.t, response.eta_hat[:, k], label=desired_label(result), **DESIRED)
        label(axes, "time t (s)" if k == len(names) - 1 else "", labelled(result, name), span(response.t))
        curves = [response.eta[:, k], response.eta_hat[:, k]]
        zoom(axes, response.t, curves, unit=result.spec.problem.units.get(name, ""))
    legend(panels[0])
    return figure


def steady_state(result: SimulatedLoop) -> Figure:
    """Draw the generator's periodic steady state over two periods (Figure 4)."""
    trace = result.steady_state
    assert trace is not None
    names = result.controller.trajectory.names
    period = trace.t[-1]
    title = f"Periodic steady state of the desired trajectory, period {period:.6g} s"
    figure, panels = column(result, title, len(names))
    t = np.concatenate([trace.t, trace.t[1:] + period])
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        values = trace.z[:, k]
        axes.plot(t, np.concatenate([values, values[1:]]), label=desired_label(result), **ACTUAL)
        axes.axvline(period, color="0.5", linewidth=0.8, linestyle=":", label="one period")
        label(
            axes,
            "time t in two periods (s)" if k == len(names) - 1 else "",
            labelled(result, name),
            span(t),
        )
    legend(panels[0])
    return figure


def _pairs(
    result: SimulatedLoop,
    title: str,
    names: Sequence[str],
    actual: Array,
    desired: Array,
    labels: tuple[str, str],
    lines: _Lines = lambda _axes, _k: [],
) -> Figure:
    """Draw pairs of curves: one pair over the whole time and, where it is long, both ends; several below each other."""
    t, units = result.response.t, result.spec.problem.units
    spans = [span(t)]
    ends = window(result)
    if len(names) == 1 and ends < ENLARGED * (t[-1] - t[0]):
        figure, panels = canvas(result, title, [[0, 0], [1, 2]], height=5.2)
        spans += [(float(t[0]), ends), (float(t[-1]) - ends, float(t[-1]))]
        panels[1].set_title("start", fontsize=9)
        panels[2].set_title("end", fontsize=9)
        for small in panels[1:]:
            small.locator_params(axis="x", nbins=6)
    else:
        figure, panels = column(result, title, len(names))
        spans *= len(names)
    for k, (axes, (first, last)) in enumerate(zip(panels, spans, strict=True)):
        signal = k if len(names) > 1 else 0
        shown = (t >= first) & (t <= last)
        curves = [values[shown, signal] for values in (actual, desired)]
        for text, values, style in zip(labels, curves, (ACTUAL, DESIRED), strict=True):
            axes.plot(t[shown], values, label=text, **style)
        drawn = lines(axes, signal)
        bottom = k == len(panels) - 1 or len(names) == 1
        label(axes, "time t (s)" if bottom else "", labelled(result, names[signal]), (first, last))
        zoom(axes, t[shown], curves, drawn, units.get(names[signal], ""), whole=signal < k)
    legend(panels[0], columns=5)
    return figure
