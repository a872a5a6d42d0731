"""The picture of a sweep: curves over one parameter, maps over two."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from pwatrack.arrays import Array

_SHOWN = {"rate": "proved decay rate (1/s)", "norm_K": "‖K‖ in sizes", "final_error": "final error"}
_LOGARITHMIC = ("final_error",)
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


def curves(title: str, name: str, at: Array, figures: Mapping[str, Array], ends: Sequence[float]) -> Figure:
    """Draw figures over one parameter; where there is none, nothing is proved. `ends` are where the proof ends."""
    shown = [(key, label) for key, label in _SHOWN.items() if key in figures]
    rows, order = max(1, len(shown)), np.argsort(at)
    figure = Figure(figsize=(7.5, 1.0 + 2.0 * rows), layout="constrained")
    figure.suptitle(title, fontsize=10)
    panels = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (key, label) in zip(panels, shown, strict=False):
        axes.plot(at[order], figures[key][order], marker="o", markersize=3, color=_COLOURS["proved"])
        for end in ends:
            axes.axvline(end, color="0.45", linewidth=0.8, linestyle=":")
        if key in _LOGARITHMIC and np.nanmin(figures[key]) > 0:
            axes.set_yscale("log")
        axes.set_ylabel(label, fontsize=9)
        axes.grid(color="0.9")
    figure.axes[-1].set_xlabel(name)
    return figure


def maps(
    title: str,
    names: tuple[str, str],
    at: tuple[Array, Array],
    verdicts: Sequence[str],
    figures: Mapping[str, Array],
    ends: Sequence[tuple[float, float]],
) -> Figure:
    """Draw the verdict and figures over two parameters, with the ends of the proof."""
    shown = [(key, label) for key, label in _SHOWN.items() if key in figures and np.isfinite(figures[key]).any()]
    figure = Figure(figsize=(4.2 * (1 + len(shown)), 3.8), layout="constrained")
    figure.suptitle(title, fontsize=10)
    first, *others = figure.subplots(1, 1 + len(shown), squeeze=False)[0]
    codes = np.array([list(_COLOURS).index(verdict) for verdict in verdicts], dtype=float)
    _map(first, at, codes, cmap=ListedColormap(list(_COLOURS.values())), vmin=-0.5, vmax=len(_COLOURS) - 0.5)
    for verdict in dict.fromkeys(verdicts):
        first.plot([], [], "s", color=_COLOURS[verdict], label=verdict)
    first.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=7, frameon=False)
    for axes, (key, label) in zip(others, shown, strict=True):
        values = figures[key]
        logarithmic = key in _LOGARITHMIC and np.nanmin(values) > 0
        drawn = _map(axes, at, values, norm="log" if logarithmic else "linear", cmap="viridis")
        figure.colorbar(drawn, ax=axes, location="top", label=label)
    for axes in (first, *others):
        if ends:
            axes.plot(*np.array(sorted(ends)).T, ".", color="white", markersize=4, markeredgecolor="black")
        axes.set_xlabel(names[0])
        axes.set_ylabel(names[1])
    return figure


def _map(axes: Axes, at: tuple[Array, Array], values: Array, **style: Any) -> ScalarMappable:
    """Colour a grid, or points that are none."""
    x, y = (np.unique(part) for part in at)
    if len(x) * len(y) == len(values):
        return axes.pcolormesh(x, y, values.reshape(len(x), len(y)).T, shading="nearest", **style)
    return axes.scatter(*at, c=values, s=20, **style)
