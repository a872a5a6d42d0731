"""What all pictures have in common: styles, sizes, titles, labels, scales."""

import textwrap
import warnings
from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pwatrack.arrays import Array
from pwatrack.report.plots.layout import Panels
from pwatrack.workflow.result import SimulatedLoop

# Dark solid and light dashed: told apart without colour too.
ACTUAL: dict[str, Any] = {"color": "#12355b", "linewidth": 1.3}
DESIRED: dict[str, Any] = {"color": "#e08e2b", "linewidth": 1.1, "linestyle": (0, (4, 2))}
ESTIMATE: dict[str, Any] = {"color": "0.25", "linewidth": 1.2, "linestyle": (0, (1, 1.2))}
BOUND: dict[str, Any] = {"color": "0.45", "linewidth": 1.3, "linestyle": (0, (6, 2))}
BAND: dict[str, Any] = {"color": "0.88", "linewidth": 0, "zorder": 0}
WORST: dict[str, Any] = {"color": "black", "linewidth": 0.9, "linestyle": (0, (3, 1.5))}
LIMIT: dict[str, Any] = {"color": "0.3", "linewidth": 1.0, "linestyle": (0, (5, 1, 1, 1))}
REQUIRED: dict[str, Any] = {"color": "#a3195b", "linewidth": 1.1, "linestyle": (0, (2, 1))}
WIDTH = 7.5  # inches
COLUMNS = 2000  # of a picture: more times than this cannot be told apart in print
ROUNDING = 1e-11  # of the largest state: an error below it is rounding of the simulation, which no proof bounds
ENLARGED = 0.6  # of the time: a longer part at either end is not worth a panel of its own
_SPIKE, _EARLY = 3.0, 0.02  # so many times the rest is a spike, in so much of the time at the start
_STILL = 0.01  # of the size of a curve: a rest that moves less is not worth the scale
_ROOM = 0.06  # of a scale, above and below what it shows


def desired_label(result: SimulatedLoop) -> str:
    """Say where the desired trajectory comes from."""
    return "desired, from the generator (15)" if result.controller.generator else "desired, own response to the input"


def column(result: SimulatedLoop, title: str, count: int) -> tuple[Figure, list[Axes]]:
    """Return panels below each other."""
    each = 1.7 if count <= 6 else 1.1
    return canvas(result, title, [[k] for k in range(count)], height=1.2 + each * count)


def canvas(
    result: SimulatedLoop, title: str, mosaic: Any, *, height: float, ratios: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its panels in the order of their numbers in the mosaic."""
    figure = Figure(figsize=(WIDTH, height))
    FigureCanvasAgg(figure)
    conditions = "; ".join(result.loop.conditions.texts(result.spec.problem.plant))
    lines = [*textwrap.wrap(result.spec.name, 90), *textwrap.wrap(f"({conditions})" if conditions else "", 100), title]
    figure.set_layout_engine(Panels(figure.suptitle(plain("\n".join(lines)), fontsize=10)))
    panels: dict[int, Axes] = figure.subplot_mosaic(mosaic, height_ratios=ratios)
    return figure, [panels[key] for key in sorted(panels)]


def png(figure: Figure) -> bytes:
    """Return a picture as a PNG file."""
    figure.set_dpi(150)
    file, canvas = BytesIO(), FigureCanvasAgg(figure)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # drawn as a box
        canvas.print_png(file, pil_kwargs={"compress_level": 1})  # type: ignore[no-untyped-call]
    return file.getvalue()


def label(axes: Axes, x: str, y: str, span: tuple[float, float]) -> None:
    """Name both axes, and show this span of time, or of whatever goes to the right."""
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(plain(y), fontsize=9)
    axes.set_xlim(*span)
    axes.tick_params(labelsize=8)
    axes.yaxis.get_offset_text().set_fontsize(8)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def widen(axes: Axes, size: float) -> None:
    """Keep an axis from magnifying rounding: it spans at least a hundredth of the size of the curve."""
    low, high = axes.get_ylim()
    if high - low < 0.01 * size:
        middle = (low + high) / 2
        axes.set_ylim(middle - 0.005 * size, middle + 0.005 * size)
    axes.ticklabel_format(axis="y", useOffset=False)


def zoom(
    axes: Axes,
    t: Array,
    curves: Sequence[Array],
    lines: Sequence[float] = (),
    unit: str = "",
    *,
    whole: bool = False,
) -> None:
    """Show curves (K,) whole, but for a spike at the start that would squash the rest: that is told in words.

    Lines at constant values are shown where they do not squash it either; so are bands, up to the edge.
    """
    values = np.array(curves)
    low, high = float(values.min()), float(values.max())
    size, rest = max(abs(low), abs(high)), values[:, t >= t[0] + _EARLY * (t[-1] - t[0])]
    least, most = float(rest.min(initial=high)), float(rest.max(initial=low))
    spikes = not whole and high - low > _SPIKE * (most - least) > _SPIKE * _STILL * size
    low, high = (least, most) if spikes else (low, high)
    room = high - low or max(abs(low), abs(high)) or 1.0
    for line in lines:
        if low - room < line < high + room:
            low, high = min(low, line), max(high, line)
    margin = _ROOM * (high - low or max(abs(low), abs(high)) or 1.0)
    axes.set_ylim(low - margin, high + margin)
    if spikes:
        away = values - (least + most) / 2
        curve, k = np.unravel_index(int(np.abs(away).argmax()), away.shape)
        arrow = "↑" if away[curve, k] > 0 else "↓"
        axes.set_title(
            f"{arrow} {values[curve, k]:.3g} {unit}".rstrip() + f" at t = {t[k]:.3g} s", loc="left", fontsize=8
        )
    widen(axes, size)


def legend(axes: Axes, columns: int = 2) -> None:
    """Explain the curves above the panel, each name once."""
    handles, texts = axes.get_legend_handles_labels()
    named = dict(zip(texts, handles, strict=True))
    axes.legend(
        list(named.values()),
        list(named),
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=columns,
        fontsize=8,
        frameon=False,
        borderaxespad=0.2,
    )


def span(t: Array) -> tuple[float, float]:
    """Return the first and the last of some times."""
    return float(t[0]), float(t[-1])


def window(result: SimulatedLoop) -> float:
    """Return how much of either end to show: five periods of the reference, or a tenth of the time."""
    total = float(result.response.t[-1])
    period = result.controller.trajectory.exosystem.period
    return min(total, 5 * period if period else total / 10)


def plain(text: str) -> str:
    """Return text that matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def labelled(result: SimulatedLoop, name: str) -> str:
    """Return the name of a signal with its unit."""
    unit = result.spec.problem.units.get(name, "")
    return f"{name} ({unit})" if unit else name
