"""Many results in one picture: members of an ensemble, rates of a design, runs, points of a sweep."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from pwatrack.arrays import Array, amount, number_text
from pwatrack.control.pareto import Front
from pwatrack.report.figures import norm_unit
from pwatrack.report.plots.canvas import COLUMNS, LOOK, RARE, ROUNDING, WIDTH, canvas, label, legend, limits, plain
from pwatrack.report.required import Checked
from pwatrack.workflow.variation import EnsembleResult, sections

_STYLES = ("-", "--", "-.", ":")  # told apart without colour too
_SHOWN = {"rate": "proved decay rate (1/s)", "norm_K": "‖K‖ in sizes", "final_error": "final error"}
_SETTLING = "settling_time_"
_LOGARITHMIC = ("final_error",)
_ERRORS = {"final_error": " in the last tenth", "largest_error": ""}  # required of members: when
_COLOURS = {  # of verdicts
    "proved": "#12355b",
    "proved by a polynomial": "#2f7f86",
    "practical": "#8cc5a4",
    "check failed": "#4f83b5",
    "infeasible": "#e08e2b",
    "outside the theory": "#c9c9c9",
    "undecided": "#f2d7a8",
    "invalid spec": "#8f8f8f",
    "lost": "#000000",
    "crashed": "#b42318",
}
_ROOM = 1.05  # of what is shown of a plane
_SMALL: dict[str, Any] = {"s": 12, "facecolors": "none", "edgecolors": "0.45", "linewidths": 0.8}
_OFF: dict[str, Any] = {"s": 16, "marker": "x", "color": "#a3195b", "linewidths": 0.9}
_PROVED = {"start forgotten, limits reached or not": LOOK["actual"], "no limit is reached": LOOK["bound"]}


def fan(many: EnsembleResult, checked: Sequence[Checked] = ()) -> Figure:
    """Draw how errors of an ensemble spread, linear until most have settled, and logarithmic; what is required."""
    kept, result = many.ensemble, many.nominal
    unit = norm_unit(result.spec, result.controller.error_names)
    largest = f"{number_text(max(figures.final_error for figures in many.figures), '.2g')} {unit}".rstrip()
    said = f"{amount(len(kept.error), 'member')} {many.variation.text}"
    title = f"{said}: tracking error at most {largest} in the last tenth of the time"
    title += ", at the samples" * any("final_error" in figures.sampled for figures in many.figures)
    last = "last to be small" if np.isfinite(kept.small_from).all() else "largest at the end"
    strips = [each for each in checked if each.members and each.requirement.figure not in _ERRORS]
    mosaic, ratios = [[k] for k in range(2 + len(strips))], (2.6, 2.6, *(0.75 for _ in strips))
    figure, (linear, logarithmic, *below) = canvas(result, title, mosaic, height=1.0 + sum(ratios), ratios=ratios)
    for axes, each in zip(below, strips, strict=True):
        _strip(axes, each)
    response = result.response
    desired = response.tracked_d if result.controller.tracking == "output" else response.x_d
    floor = ROUNDING * float(np.abs(desired / response.error_sizes).max())
    names = result.controller.plant.tracked_names if result.controller.generator else ("x",)
    size = f"|{names[0]} − {names[0]}_d|" if result.controller.generator and len(names) == 1 else "‖e‖"
    slowest = int(np.lexsort((kept.final, kept.small_from))[-1])
    falling = kept.t[kept.error.max(axis=0) > floor][-1:]  # until the last error is rounding
    ends = (np.quantile(kept.small_from, 0.95, method="higher"), 1.2 * falling[0] if len(falling) else 0.0)
    for axes, end, member, name in (
        (linear, ends[0], int(np.argmax(kept.largest)), "largest"),
        (logarithmic, ends[1], slowest, last),
    ):
        columns = np.flatnonzero(kept.t <= max(end, kept.t[1]))
        columns = columns[:: max(1, len(columns) // COLUMNS)]
        t, error = kept.t[columns], kept.error[:, columns]
        low, quarter, middle, three_quarters, high = np.quantile(error, (0.05, 0.25, 0.5, 0.75, 0.95), axis=0)
        axes.fill_between(t, low, high, color="0.82", linewidth=0, label="90 % of the members")
        axes.fill_between(t, quarter, three_quarters, color="0.6", linewidth=0, label="50 %")
        axes.plot(t, middle, label="median", **LOOK["actual"])
        axes.plot(t, error[member], label=f"{name}: member {member + 1}", **LOOK["worst"])
        for wish, when in _ERRORS.items():
            for limit in limits(result, wish, members=True):
                axes.axhline(limit, label=f"required{when}", **LOOK["required"])
        legend(axes, columns=3)
        label(axes, "time t (s)", size + (f" ({unit})" if unit else ""), t)
        bottom = float(np.quantile(low, RARE)) / 3
    linear.set_ylim(bottom=0)
    logarithmic.set_yscale("log")
    logarithmic.set_ylim(bottom=max(bottom, floor / 10))
    if bottom < floor:
        logarithmic.axhspan(logarithmic.get_ylim()[0], floor, color="0.92", linewidth=0)
        logarithmic.annotate(
            "rounding", (logarithmic.get_xlim()[1], floor), ha="right", va="top", fontsize=8, color="0.3"
        )
    return figure


def _strip(axes: Axes, checked: Checked) -> None:
    """Draw a figure of all members beside what is required of it; those that it never comes to are counted."""
    unit, scale = checked.unit, checked.scale
    limit = scale * checked.requirement.limit
    values = scale * np.array(checked.members)
    found = values[np.isfinite(values)]
    axes.axvline(limit, **LOOK["required"])
    if len(found):
        low, quarter, middle, three_quarters, high = np.quantile(found, (0.05, 0.25, 0.5, 0.75, 0.95))
        worst = found.max() if checked.requirement.quantity.best == "at most" else found.min()
        axes.fill_between([low, high], -1, 1, color="0.82", linewidth=0)
        axes.fill_between([quarter, three_quarters], -1, 1, color="0.6", linewidth=0)
        axes.plot([middle, middle], [-1, 1], **LOOK["actual"])
        axes.plot([worst, worst], [-1, 1], **LOOK["worst"])
    never = len(values) - len(found)
    name = f"{checked.label} ({unit})" if unit else checked.label
    name += f": worst {number_text(scale * checked.found, '.4g')}" * bool(np.isfinite(checked.found))
    name += f", {checked.requirement.quantity.best} {number_text(limit, '.4g')} required"
    name += f"; {never:,} of {len(values):,} never" * bool(never)
    shown = np.append(found, limit)
    around = 0.04 * (np.ptp(shown) or abs(limit) or 1.0)
    label(axes, name, "", (shown.min() - around, shown.max() + around))
    axes.set_yticks([])
    axes.set_ylim(-1.4, 1.4)


def pareto_fronts(name: str, fronts: Sequence[Front]) -> Figure:
    """Draw the smallest gain against the decay rate for controller and observer, with the chosen points."""
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    figure.suptitle(textwrap.fill(f"{name}: what a faster decay costs", 90), fontsize=11)
    for axes, front in zip(figure.subplots(1, len(fronts)), fronts, strict=True):
        letter, rate, norm = front.role.letter, *front.chosen
        axes.plot(front.rates, front.norms, marker="o", markersize=3.5, label="smallest found", **LOOK["actual"])
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


def run_errors(runs: Mapping[str, tuple[Array, Array]], unit: str) -> Figure:
    """Draw the norm of the tracking error of each run over time, (t, error), logarithmic; '' is of several units."""
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    for k, (name, (t, error)) in enumerate(runs.items()):
        colour = colormaps["viridis"](0.85 * k / max(1, len(runs) - 1))
        axes.plot(t, np.where(error > 0, error, np.nan), label=plain(name), color=colour, linestyle=_STYLES[k % 4])
    axes.set_yscale("log")
    axes.set_xlabel("time t (s)", fontsize=9)
    axes.set_ylabel("tracking error" + (f" ({plain(unit)})" if unit else ""), fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.9", linewidth=0.6)
    legend(axes)
    return figure


def sweep_curves(title: str, name: str, at: Array, figures: Mapping[str, Array], ends: Sequence[float]) -> Figure:
    """Draw figures over one parameter; where there is none, nothing is proved. `ends` are where the proof ends."""
    shown = _shown(figures)
    rows, order = max(1, len(shown)), np.argsort(at)
    figure = Figure(figsize=(7.5, 1.0 + 2.0 * rows), layout="constrained")
    figure.suptitle(title, fontsize=10)
    panels = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (key, text) in zip(panels, shown, strict=False):
        axes.plot(at[order], figures[key][order], marker="o", markersize=3, color=_COLOURS["proved"])
        for end in ends:
            axes.axvline(end, color="0.45", linewidth=0.8, linestyle=":")
        if key in _LOGARITHMIC and np.nanmin(figures[key]) > 0:
            axes.set_yscale("log")
        axes.set_ylabel(text, fontsize=9)
        axes.grid(color="0.9")
    figure.axes[-1].set_xlabel(name)
    return figure


def sweep_maps(
    title: str,
    names: tuple[str, str],
    at: tuple[Array, Array],
    verdicts: Sequence[str],
    figures: Mapping[str, Array],
    ends: Sequence[tuple[float, float]],
) -> Figure:
    """Draw the verdict and figures over two parameters, with the ends of the proof."""
    shown = [(key, text) for key, text in _shown(figures) if np.isfinite(figures[key]).any()]
    figure = Figure(figsize=(4.2 * (1 + len(shown)), 3.8), layout="constrained")
    figure.suptitle(title, fontsize=10)
    first, *others = figure.subplots(1, 1 + len(shown), squeeze=False)[0]
    codes = np.array([list(_COLOURS).index(verdict) for verdict in verdicts], dtype=float)
    _map(first, at, codes, cmap=ListedColormap(list(_COLOURS.values())), vmin=-0.5, vmax=len(_COLOURS) - 0.5)
    for verdict in dict.fromkeys(verdicts):
        first.plot([], [], "s", color=_COLOURS[verdict], label=verdict)
    first.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=7, frameon=False)
    for axes, (key, text) in zip(others, shown, strict=True):
        values = figures[key]
        logarithmic = key in _LOGARITHMIC and np.nanmin(values) > 0
        drawn = _map(axes, at, values, norm="log" if logarithmic else "linear", cmap="viridis")
        figure.colorbar(drawn, ax=axes, location="top", label=text)
    for axes in (first, *others):
        if ends:
            axes.plot(*np.array(sorted(ends)).T, ".", color="white", markersize=4, markeredgecolor="black")
        axes.set_xlabel(names[0])
        axes.set_ylabel(names[1])
    return figure


def _shown(figures: Mapping[str, Array]) -> list[tuple[str, str]]:
    times = [key for key in figures if key.startswith(_SETTLING)]
    settling = ((key, f"settling time of {key.removeprefix(_SETTLING)} (s)") for key in times)
    return [*((key, text) for key, text in _SHOWN.items() if key in figures), *settling]


def _map(axes: Axes, at: tuple[Array, Array], values: Array, **style: Any) -> ScalarMappable:
    x, y = (np.unique(part) for part in at)
    if len(x) * len(y) == len(values):
        drawn = axes.pcolormesh(x, y, values.reshape(len(x), len(y)).T, shading="nearest", **style)
        for show, ends in ((axes.set_xlim, x), (axes.set_ylim, y)):
            if len(ends) > 1:
                show(ends[0], ends[-1])  # not beyond what was looked at
        return drawn
    return axes.scatter(*at, c=values, s=20, **style)


def starts_in_plane(many: EnsembleResult) -> Figure:
    """Draw where members in a plane start and how they end, and the regions that are proved there."""
    result, plane = many.nominal, list(many.nominal.spec.scenario.plane)
    names = [result.controller.plant.states[k] for k in plane]
    proved = list(sections(result.controller, result.loop.conditions, plane))
    title = f"Starts in a plane, x̂ = x, all other errors 0: {amount(len(many.outcomes), 'member')}"
    title += ", and what is proved" if proved else "; no region in this plane is proved of this loop"
    figure, (axes,) = canvas(result, title, [[0]], height=5.6)
    starts = np.column_stack([many.variation.values[name] for name in names]) - result.response.x_d[0, plane]
    small = np.array(many.small)
    for which, said, style in ((small, "gets small", _SMALL), (~small, "does not, in this run", _OFF)):
        if which.any():
            axes.scatter(starts[which, 0], starts[which, 1], label=said, **style)
    seen = [starts]
    for said, edge in proved:
        axes.plot(*edge.T, label=f"proved: {said}", **_PROVED[said])
        seen.append(edge)
    units = result.spec.problem.units
    texts = [f"{name} − {name}_d" + (f" ({units[name]})" if units.get(name) else "") for name in names]
    most = _ROOM * np.abs(np.vstack(seen)).max(axis=0)
    label(axes, texts[0], texts[1], (-most[0], most[0]))
    axes.set_ylim(-most[1], most[1])
    legend(axes, columns=2)
    return figure
