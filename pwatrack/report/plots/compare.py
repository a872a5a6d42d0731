"""Errors of several runs in one picture."""

from collections.abc import Mapping

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pwatrack.arrays import Array
from pwatrack.report.plots.canvas import WIDTH, plain

_STYLES = ("-", "--", "-.", ":")  # told apart without colour too


def errors(runs: Mapping[str, tuple[Array, Array]], unit: str) -> Figure:
    """Draw the norm of the tracking error of each run over time, logarithmic.

    Args:
        runs: By name: times in s, and the error there, both (K,).
        unit: Of all errors; empty where they have several.
    """
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
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
