"""Many members of an ensemble, many rates of a design, or several runs, in one picture."""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from pwatrack.arrays import Array
from pwatrack.control.pareto import Front
from pwatrack.report.figures import error_unit
from pwatrack.report.plots.canvas import ACTUAL, COLUMNS, ROUNDING, WIDTH, WORST, canvas, label, legend, plain
from pwatrack.workflow.variation import EnsembleResult

_STYLES = ("-", "--", "-.", ":")  # told apart without colour too


def fan(many: EnsembleResult) -> Figure:
    """Draw how the tracking error of an ensemble spreads over time, linear until most have settled, and logarithmic."""
    kept, result = many.ensemble, many.nominal
    unit = error_unit(result.spec, result.controller)
    largest = f"{max(figures.final_error for figures in many.figures):.1e} {unit}".rstrip()
    said = f"{len(kept.error):,} members {many.variation.text}"
    title = f"{said}: tracking error at most {largest} in the last tenth of the time"
    title += ", at the samples" * any("final_error" in figures.sampled for figures in many.figures)
    last = "last to be small" if np.isfinite(kept.small_from).all() else "largest at the end"
    figure, (linear, logarithmic) = canvas(result, title, [[0], [1]], height=6.2)
    floor = ROUNDING * np.abs(result.response.x).max()
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
        axes.plot(t, middle, label="median", **ACTUAL)
        axes.plot(t, error[member], label=f"{name}: member {member + 1}", **WORST)
        legend(axes, columns=4)
        label(axes, "time t (s)", size + (f" ({unit})" if unit else ""), t)
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
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    figure.suptitle(textwrap.fill(f"{name}: what a faster decay costs", 90), fontsize=11)
    for axes, front in zip(figure.subplots(1, len(fronts)), fronts, strict=True):
        letter, rate, norm = front.role.letter, *front.chosen
        axes.plot(front.rates, front.norms, marker="o", markersize=3.5, label="smallest found", **ACTUAL)
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
    axes.legend(loc="upper right", fontsize=8, frameon=False)
    return figure
