"""Signals over time, each beside what it should be, and errors of tracking and observer within what is proved."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pwatrack.arrays import Array, number_text
from pwatrack.report.figures import norm_unit
from pwatrack.report.plots.canvas import LOOK, RARE, ROUNDING, band, canvas, label, legend, limits, plain
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
_Kind = Literal["output", "state", "estimate"]  # of what errors are: see `Form`
_ERRORS = 8  # panels of single errors
_WITHIN = 3.0  # times the largest error: how much of a band is shown
_DEPTH = 1e-6  # of where rounding begins: how far below it an error is shown
_ABOVE = 4.0  # times the largest error or bound: how far a logarithmic scale goes
_HIGH, _LOW = 1.6, 0.85  # inches of a panel, where there are one or two and where there are more


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

    curves = [(actual, "output", LOOK["actual"]), (desired, "desired", LOOK["desired"])]
    return _over_time(result, "Outputs", names, curves, lines, ends=True)


def states(result: SimulatedLoop) -> Figure:
    """Draw each state beside where it should be and what the observer takes it for."""
    response, names = result.response, result.spec.problem.plant.states[:_MOST]
    more = len(result.spec.problem.plant.states) - len(names)
    curves = [(response.x, "plant", LOOK["actual"]), (response.x_d, "desired", LOOK["desired"])]
    curves.append((response.x_hat, "estimate", LOOK["estimate"]))
    title = f"States{f', without {more} more' if more else ''}"
    return _over_time(result, title, names, curves, lambda axes, k: _limit_lines(axes, result, names[k]))


def _limit_lines(axes: Axes, result: SimulatedLoop, name: str) -> list[float]:
    drawn = [limit for figure in RANGES for limit in limits(result, figure, name)]
    for limit in drawn:
        axes.axhline(limit, label="limit", **LOOK["limit"])
    return drawn


def estimates(result: SimulatedLoop) -> Figure:
    """Draw the estimate of each unknown load beside what it is."""
    loads, response = result.controller.plant.loads, result.response
    assert loads is not None
    curves = [(response.estimates, "estimate", LOOK["actual"]), (response.loads, "load", LOOK["desired"])]
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
                axes.axhline(limit, label="limit", **LOOK["limit"])
                binds = np.abs(response.u[:, k] - limit) <= ROUNDING * np.abs(response.u[:, k]).max()
                if binds.any():
                    axes.plot(response.t, np.where(binds, limit, np.nan), label="at a limit", **LOOK["binds"])
        for wish in limits(result, "largest_input", names[k]):
            for sign in (-1, 1):
                axes.axhline(sign * wish, label="required", **LOOK["required"])
            drawn += [-wish, wish]
        if (proved := result.bands.get(("input", k))) is not None:
            middle = response.u_ff[:, k]
            near = proved <= np.ptp(middle) / 2  # what is wider shows nothing but grey
            if near.any():
                shown = np.where(near, proved, np.nan)
                band(axes, response.t, middle - shown, middle + shown, "proved")
        return drawn

    held = LOOK["actual"] | ({"drawstyle": "steps-post"} if result.loop.conditions.sampling else {})
    curves = [(response.u, said[0], held), (response.u_ff, said[1], LOOK["behind"])]
    return _over_time(result, "Control input", names, curves, lines, ends=True)


def internal_states(result: SimulatedLoop) -> Figure:
    """Draw each internal state η with its desired trajectory from the generator (Figure 3)."""
    title = "Internal states" if result.controller.generator else "States"
    desired = (result.response.eta_hat, _desired_label(result), LOOK["desired"])
    curves = [(result.response.eta, "plant", LOOK["actual"]), desired]
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
        axes.plot(t, np.concatenate([values, values[1:]]), label=_desired_label(result), **LOOK["actual"])
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
    """Return how long a start is worth a panel, in s: five periods, or a tenth of the time with a move to its end."""
    t, y_d, period = result.response.t, result.response.tracked_d, result.controller.trajectory.exosystem.period
    if period:
        return min(float(t[-1]), 5 * period)
    end = float(t[-1]) / 10
    moves = (np.abs(np.diff(y_d, axis=0)) > _MOVES * np.abs(y_d).max(axis=0)).any(axis=1)
    rests = t[1:][~moves & (t[1:] > end)]
    moving = moves[t[1:] <= end][-1:].any()
    return min(float(t[-1]), _AFTER * float(rests[0])) if moving and len(rests) else end


def _column(result: SimulatedLoop, title: str, count: int) -> tuple[Figure, list[Axes]]:
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
        axes.axvline(move.start + limit, label="required", **LOOK["required"])
        for edge in (-move.band, move.band):
            late = t >= move.start + limit
            axes.plot(t[late], (move.target if move.rests else y_d[late]) + edge + 0 * t[late], **LOOK["required"])
    for limit in limits(result, "overshoot", name) if move.distance else ():
        drawn.append((move.highest if move.distance > 0 else move.lowest) + limit * move.distance)
        axes.plot([move.start, t[-1]], drawn[-1:] * 2, label="required", **LOOK["required"])
    return drawn


def _desired_label(result: SimulatedLoop) -> str:
    return "desired, from the generator (15)" if result.controller.generator else "desired, own response to the input"


def _labelled(result: SimulatedLoop, name: str) -> str:
    unit = result.spec.problem.units.get(name, "")
    return f"{name} ({unit})" if unit else name


def tracking_error(result: SimulatedLoop) -> Figure:
    """Draw each tracking error over time within its proved band, and their norm, logarithmic (Figure 2)."""
    controller, response = result.controller, result.response
    kind, names, unit = controller.tracking, controller.error_names, norm_unit(result.spec, controller.error_names)
    desired = response.tracked_d if kind == "output" else response.x_d
    title = f"Tracking error: at most {result.outcome.final} in the last tenth of the time"
    title += ", at the samples" * ("final_error" in result.figures.sampled)
    bound = _of_norm(result, kind, response.error_sizes, result.tracking_bound)
    figure, panels = _panels(result, title, kind, names, response.tracking_error, desired, response.error_sizes)
    if len(names) == 1:
        _error_lines(panels[0], result, (-1, 1))
        legend(panels[0], columns=4)
    norm = "‖e‖" if len(names) > 1 else "size"
    floor = ROUNDING * float(np.abs(desired / response.error_sizes).max())
    _magnitude(panels[-1], response.t, response.error_norm, bound, floor, f"{norm}{f' ({unit})' if unit else ''}")
    low, high = panels[-1].get_ylim()
    panels[-1].set_ylim(low, max([high, *(_ABOVE * limit for limit in _error_lines(panels[-1], result, (1,)))]))
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
    bound = _of_norm(result, "estimate", response.state_sizes, result.observer_bound)
    _magnitude(panels[-1], response.t, error, bound, floor, f"‖x̂ − x‖{f' ({unit})' if unit else ''}")
    mark = LOOK["required"] | {"linestyle": "none", "marker": "_", "markersize": 14}
    for limit in limits(result, "final_observer_error"):
        panels[-1].plot(response.t[-1:], [limit], label="required at the end", **mark)
    legend(panels[-1], columns=4)
    return figure


def _panels(
    result: SimulatedLoop, title: str, kind: _Kind, names: Sequence[str], errors: Array, signals: Array, sizes: Array
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each error (K, n), of many for the furthest off, and room for their norm."""
    t, shown = result.response.t, list(range(len(names)))
    if len(names) > _ERRORS:
        shown = sorted(np.argsort(-np.abs(errors).max(axis=0) / sizes)[:_ERRORS].tolist())
        title += f"; the {_ERRORS} that are furthest off, in sizes"
    count = len(shown)
    heights = [_HIGH if count <= 2 else _LOW] * count
    height = 1.3 + sum(heights) + 0.2 * count + 2.1
    figure, panels = canvas(result, title, [[k] for k in range(count + 1)], height=height, ratios=[*heights, 2.1])
    for axes, k in zip(panels, shown, strict=False):
        name, error = names[k], errors[:, k]
        seen = max(float(np.abs(error).max()), ROUNDING * max(float(np.abs(signals[:, k]).max()), float(sizes[k])))
        if (proved := result.bands.get((kind, k))) is not None:
            band(axes, t, -proved, proved, "proved, whatever the switching")
            for edge in (-proved, proved):
                axes.plot(t, edge, color="0.6", linewidth=0.8)
            seen = max(seen, min(_WITHIN * seen, float(proved.max())))
        axes.axhline(0, color="0.6", linewidth=0.8)
        if kind != "estimate":
            seen = max([seen, *_error_lines(axes, result, (-1, 1), name)])
        axes.plot(t, error, label="simulated", **LOOK["actual"])
        axes.set_ylim(-1.06 * seen or -1.0, 1.06 * seen or 1.0)
        text = f"{name}_hat − {name}" if kind == "estimate" else f"{name} − {name}_d"
        axes.set_title(plain(text), loc="left", fontsize=8, pad=3)
        label(axes, "", plain(result.spec.problem.units.get(name, "")), t)
    legend(panels[0], columns=4)
    return figure, panels


def _of_norm(result: SimulatedLoop, kind: _Kind, sizes: Array, promised: Array | None) -> Array | None:
    """Return what is proved of the norm of some errors, (K,): what is promised, or what their bands leave of it."""
    bands = [result.bands.get((kind, k)) for k in range(len(sizes))]
    known = [band for band in bands if band is not None]
    if len(known) < len(bands):
        return None if len(bands) == 1 else promised
    if len(known) == 1:
        return known[0]
    norm: Array = np.linalg.norm([band / size for band, size in zip(known, sizes, strict=True)], axis=0)
    return norm if promised is None else np.minimum(norm, promised)


def _magnitude(axes: Axes, t: Array, size: Array, bound: Array | None, floor: float, name: str) -> None:
    """Draw the size of an error on a logarithmic scale, under its proved bound, and where it is rounding alone."""
    if bound is not None and (above := bound > floor).any():
        axes.semilogy(t[above], bound[above], label="proved bound, whatever the switching", **LOOK["bound"])
    if not (size > 0).any():
        axes.text(0.5, 0.5, "0 at all times, in the simulation", transform=axes.transAxes, ha="center", fontsize=9)
    axes.semilogy(t, np.where(size > 0, size, np.nan), label="simulated", **LOOK["actual"])
    most = max(float(size.max()), 0.0 if bound is None else float(bound.max()), floor)
    low = max(axes.get_ylim()[0], float(np.quantile(size, RARE)) / 10)  # that an error crosses 0 is no news
    axes.set_ylim(bottom=low)
    if low < floor:
        axes.axhspan(low, floor, color="0.92", linewidth=0, label="rounding of the simulation")
        axes.set_ylim(max(low, _DEPTH * floor), _ABOVE * most)
    label(axes, "time t (s)", f"{name}, logarithmic", t)


def _error_lines(axes: Axes, result: SimulatedLoop, signs: Sequence[int], signal: str | None = None) -> list[float]:
    """Draw the largest error that is required, of one signal or of the norm, late and ever; return the values."""
    t, drawn = result.response.t, list[float]()
    late = float(t[last_tenth(len(t)).start])
    for figure, start in (("final_error", late), ("largest_error", float(t[0]))):
        for limit in limits(result, figure if signal is None else f"{figure}s", signal):
            for sign in signs:
                axes.plot([start, t[-1]], [sign * limit] * 2, label="required", **LOOK["required"])
                drawn.append(sign * limit)
    return drawn
