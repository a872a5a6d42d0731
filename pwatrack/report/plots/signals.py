"""Signals over time, each beside what it should be: outputs, states, inputs, loads, internal states."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pwatrack.arrays import Array
from pwatrack.report.plots.canvas import (
    ACTUAL,
    BINDS,
    DESIRED,
    ESTIMATE,
    LIMIT,
    REQUIRED,
    ROUNDING,
    band,
    canvas,
    label,
    legend,
    limits,
)
from pwatrack.simulation.figures import Move
from pwatrack.simulation.trace import last_tenth
from pwatrack.spec.requirement import RANGES
from pwatrack.workflow.outcome import SimulatedLoop

_MOST = 12  # states in a picture
_BESIDE = 4  # signals that have their start beside the whole: more panels take long to draw
_INSETS = 6  # panels below each other that have room for insets
_SPENT, _SEVERAL = 0.05, 4.0  # of the largest that is off: what has decayed; times until then, what is shown of a start
_ENLARGED = 0.6  # of the time: a longer part at either end is not worth a panel of its own
_SPIKE, _EARLY = 3.0, 0.02  # so many times the rest is a spike, in so much of the time at the start
_STILL = 0.01  # of the size of a curve: a rest that moves less is not worth the scale
_MOVES = 1e-9  # of the size of a reference: by less it does not move from sample to sample
_AFTER = 1.1  # times the end of a move: so far the start is shown where one goes on
_INSET = 0.55  # of a panel: the room of an inset, with what is written around it
_ROOM = 0.06  # of a scale, above and below what it shows
_FLAT = 0.01  # of the size of a curve: an axis spans at least that
_Curve = tuple[Array, str, dict[str, Any]]  # of each signal, (K, ·); its label and style
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
        drawn = _step_lines(axes, result, names[k], actual[:, k], desired[:, k]) if tracked else []
        return drawn + _limit_lines(axes, result, names[k])

    curves = [(actual, "output", ACTUAL), (desired, "desired", DESIRED)]
    return _over_time(result, "Outputs", names, curves, lines, ends=True)


def states(result: SimulatedLoop) -> Figure:
    """Draw each state beside where it should be and what the observer takes it for."""
    response, names = result.response, result.spec.problem.plant.states[:_MOST]
    more = len(result.spec.problem.plant.states) - len(names)
    curves = [(response.x, "plant", ACTUAL), (response.x_d, "desired", DESIRED), (response.x_hat, "estimate", ESTIMATE)]
    title = f"States{f', without {more} more' if more else ''}"
    return _over_time(result, title, names, curves, lambda axes, k: _limit_lines(axes, result, names[k]))


def _limit_lines(axes: Axes, result: SimulatedLoop, name: str) -> list[float]:
    """Draw the limits of an output or state, where it has some."""
    drawn = [limit for figure in RANGES for limit in limits(result, figure, name)]
    for limit in drawn:
        axes.axhline(limit, label="limit", **LIMIT)
    return drawn


def estimates(result: SimulatedLoop) -> Figure:
    """Draw the estimate of each unknown load beside what it is."""
    loads, response = result.controller.plant.loads, result.response
    assert loads is not None
    curves = [(response.estimates, "estimate", ACTUAL), (response.loads, "load", DESIRED)]
    return _over_time(result, "Unknown loads", loads.names, curves, ends=True)


def control_input(result: SimulatedLoop) -> Figure:
    """Draw each input, its feedforward part, its limits, where it is at them and what is proved; also at both ends."""
    response, names = result.response, result.spec.problem.plant.inputs
    said = ("input (19)", "its feedforward part (16)")
    if result.controller.tracking == "state":
        said = ("input (10)", "its feedforward part")

    def lines(axes: Axes, k: int) -> list[float]:
        drawn = list[float]()
        if (actuator := result.loop.conditions.limits) is not None:
            drawn += [limit for limit in actuator[k].tolist() if np.isfinite(limit)]
            for limit in drawn:
                axes.axhline(limit, label="limit", **LIMIT)
                binds = np.abs(response.u[:, k] - limit) <= ROUNDING * np.abs(response.u[:, k]).max()
                if binds.any():
                    axes.plot(response.t, np.where(binds, limit, np.nan), label="at a limit", **BINDS)
        for wish in limits(result, "largest_input", names[k]):
            for sign in (-1, 1):
                axes.axhline(sign * wish, label="required", **REQUIRED)
            drawn += [-wish, wish]
        if (proved := result.bands.get(("input", k))) is not None:
            middle = response.u_ff[:, k]
            near = proved <= np.ptp(middle) / 2  # what is wider shows nothing but grey
            if near.any():
                shown = np.where(near, proved, np.nan)
                band(axes, response.t, middle - shown, middle + shown, "proved")
        return drawn

    curves = [(response.u, said[0], ACTUAL), (response.u_ff, said[1], DESIRED)]
    return _over_time(result, "Control input", names, curves, lines, ends=True)


def internal_states(result: SimulatedLoop) -> Figure:
    """Draw each internal state η with its desired trajectory from the generator (Figure 3)."""
    title = "Internal states" if result.controller.generator else "States"
    curves = [(result.response.eta, "plant", ACTUAL), (result.response.eta_hat, _desired_label(result), DESIRED)]
    return _over_time(result, title, result.controller.trajectory.names, curves)


def steady_state(result: SimulatedLoop) -> Figure:
    """Draw the generator's periodic steady state over two periods (Figure 4)."""
    trace, names = result.steady_state, result.controller.trajectory.names
    assert trace is not None
    period = trace.t[-1]
    title = f"Periodic steady state of the desired trajectory, period {period:.6g} s"
    figure, panels = _column(result, title, len(names))
    t = np.concatenate([trace.t, trace.t[1:] + period])
    for axes, name, values in zip(panels, names, trace.z.T, strict=False):
        axes.plot(t, np.concatenate([values, values[1:]]), label=_desired_label(result), **ACTUAL)
        axes.axvline(period, color="0.5", linewidth=0.8, linestyle=":", label="one period")
        label(axes, "time t in two periods (s)" if axes is panels[-1] else "", _labelled(result, name), t)
    legend(panels[0])
    return figure


def _over_time(
    result: SimulatedLoop,
    title: str,
    names: Sequence[str],
    curves: Sequence[_Curve],
    lines: _Lines = lambda _axes, _k: [],
    *,
    ends: bool = False,
) -> Figure:
    """Draw curves of signals below each other; for `ends`, beside a few their start, below one both ends."""
    t, end, count = result.response.t, _start(result), len(names)
    first = min(end, _brief(t, curves[0][0] - curves[1][0])) if ends else end
    enlarged, left = ends and first < _ENLARGED * (t[-1] - t[0]), (1 - _ENLARGED) * float(t[-1] - t[0])
    whole, start, last = (t[0], t[-1]), (float(t[0]), first), (float(t[-1]) - min(end, left), float(t[-1]))
    if enlarged and count == 1:
        figure, panels = canvas(result, title, [[0, 0], [1, 2]], height=5.2)
        spans, of = [whole, start, last], [0, 0, 0]
    elif enlarged and count <= _BESIDE:
        mosaic = [[k, k, count + k] for k in range(count)]
        figure, panels = canvas(result, title, mosaic, height=1.2 + 1.7 * count)
        spans, of = [whole] * count + [start] * count, [*range(count)] * 2
    else:
        figure, panels = _column(result, title, count)
        spans, of = [whole] * count, list(range(count))
    for k, (axes, span, signal) in enumerate(zip(panels, spans, of, strict=True)):
        shown = (t >= span[0]) & (t <= span[1])
        for values, text, style in curves:
            axes.plot(t[shown], values[shown, signal], label=text, **style)
        constant = lines(axes, signal)
        below = "time t (s)" if signal == count - 1 else ""
        beside = "" if k >= count > 1 else _labelled(result, names[signal])
        label(axes, below, beside, span)
        styled = [(values[shown, signal], style) for values, _, style in curves]
        inset = _zoom(axes, t[shown], styled, constant, whole=span != whole or count > _INSETS)
        if inset is not None:
            lines(inset, signal)
        if span != whole:
            axes.locator_params(axis="x", nbins=6 if count == 1 else 4)
    for axes, text in zip(panels[count:], ("start", "end")[: 1 + (count == 1)], strict=False):
        axes.set_title(text, fontsize=9)
    legend(panels[0], columns=3 if len(panels) == 2 * count else 5, others=panels[1:])
    return figure


def _brief(t: Array, off: Array) -> float:
    """Return how long what is off at first is worth a panel, in s: a few times as long as it is large."""
    large = (np.abs(off) > _SPENT * np.abs(off).max(axis=0)).any(axis=1)
    last = int(np.flatnonzero(large).max(initial=0))
    return _SEVERAL * float(t[min(last + 1, len(t) - 1)] - t[0])


def _start(result: SimulatedLoop) -> float:
    """Return how long a start is worth a panel of its own, in s: five periods of the reference, or a tenth of the time.

    A move of the reference that goes on then is shown to its end, and a little longer.
    """
    t, y_d, period = result.response.t, result.response.tracked_d, result.controller.trajectory.exosystem.period
    if period:
        return min(float(t[-1]), 5 * period)
    end = float(t[-1]) / 10
    moves = (np.abs(np.diff(y_d, axis=0)) > _MOVES * np.abs(y_d).max(axis=0)).any(axis=1)
    rests = t[1:][~moves & (t[1:] > end)]
    moving = moves[t[1:] <= end][-1:].any()
    return min(float(t[-1]), _AFTER * float(rests[0])) if moving and len(rests) else end


def _column(result: SimulatedLoop, title: str, count: int) -> tuple[Figure, list[Axes]]:
    """Return panels below each other."""
    each = 1.7 if count <= 6 else 1.1
    return canvas(result, title, [[k] for k in range(count)], height=1.2 + each * count)


def _zoom(
    axes: Axes, t: Array, curves: Sequence[tuple[Array, dict[str, Any]]], lines: Sequence[float], *, whole: bool
) -> Axes | None:
    """Show curves (K,); where a spike at the start squashes the rest, that has an inset, which is returned.

    The inset is above or below the rest, whose scale makes room for it. Lines at constant values are shown where they
    do not squash what is shown; so are bands, up to the edge.
    """
    values = np.array([curve for curve, _ in curves])
    low, high = float(values.min()), float(values.max())
    size, late = max(abs(low), abs(high)), t >= t[0] + _EARLY * (t[-1] - t[0])
    rest = values[:, late]
    least, most = float(rest.min(initial=high)), float(rest.max(initial=low))
    _show(axes, low, high, size, lines)
    if whole or not high - low > _SPIKE * (most - least) > _SPIKE * _STILL * size:
        return None
    bottom, top = axes.get_ylim()
    below = least - bottom > top - most
    if below:
        axes.set_ylim(min(bottom, top - (top - least) / (1 - _INSET)), top)
    else:
        axes.set_ylim(bottom, max(top, bottom + (most - bottom) / (1 - _INSET)))
    inset: Axes = axes.inset_axes((0.45, 0.13 if below else 1.13 - _INSET, 0.5, _INSET - 0.26))
    for curve, style in curves:
        inset.plot(t[late], curve[late], **style)
    inset.set_xlim(t[late][0], t[-1])
    inset.tick_params(labelsize=6)
    inset.locator_params(axis="x", nbins=4)
    for axis in (inset.xaxis, inset.yaxis):
        axis.get_offset_text().set_fontsize(6)
    inset.set_title("without the start", fontsize=7, pad=2)
    _show(inset, least, most, size, lines)
    return inset


def _show(axes: Axes, low: float, high: float, size: float, lines: Sequence[float]) -> None:
    """Let an axis show from low to high, with lines that do not squash that; rounding of a size is not magnified."""
    room = high - low or max(abs(low), abs(high)) or 1.0
    for line in lines:
        if low - room < line < high + room:
            low, high = min(low, line), max(high, line)
    margin = _ROOM * (high - low or max(abs(low), abs(high)) or 1.0)
    low, high = low - margin, high + margin
    if high - low < _FLAT * size:
        low, high = (low + high - _FLAT * size) / 2, (low + high + _FLAT * size) / 2
    axes.set_ylim(low, high)
    axes.ticklabel_format(axis="y", useOffset=False)


def _step_lines(axes: Axes, result: SimulatedLoop, name: str, y: Array, y_d: Array) -> list[float]:
    """Draw when an output must have settled, within which band, and how far it may go beyond; return the values."""
    t, drawn = result.response.t, list[float]()
    move = Move(result.spec.scenario.bands.get(name))
    move.see(t, y, y_d)
    move.end(float(t[last_tenth(len(t)).start]))
    for limit in limits(result, "settling_time", name):
        axes.axvline(move.start + limit, label="required", **REQUIRED)
        for edge in (-move.band, move.band):
            late = t >= move.start + limit
            axes.plot(t[late], (move.target if move.rests else y_d[late]) + edge + 0 * t[late], **REQUIRED)
    for limit in limits(result, "overshoot", name) if move.distance else ():
        drawn.append(move.target + limit * move.distance)
        axes.plot([move.start, t[-1]], drawn[-1:] * 2, label="required", **REQUIRED)
    return drawn


def _desired_label(result: SimulatedLoop) -> str:
    """Say where the desired trajectory comes from."""
    return "desired, from the generator (15)" if result.controller.generator else "desired, own response to the input"


def _labelled(result: SimulatedLoop, name: str) -> str:
    """Return the name of a signal with its unit."""
    unit = result.spec.problem.units.get(name, "")
    return f"{name} ({unit})" if unit else name
