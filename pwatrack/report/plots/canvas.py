"""What all pictures have in common: styles, sizes, titles, labels, scales."""

import textwrap
import warnings
from collections.abc import Sequence
from io import BytesIO
from typing import Any

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


def label(axes: Axes, x: str, y: str, shown: Array | Sequence[float]) -> None:
    """Name both axes, and show from the first to the last of these times, or of whatever goes to the right."""
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(plain(y), fontsize=9)
    axes.set_xlim(shown[0], shown[-1])
    axes.tick_params(labelsize=8)
    axes.yaxis.get_offset_text().set_fontsize(8)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


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


def plain(text: str) -> str:
    """Return text that matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def limits(result: SimulatedLoop, figure: str, signal: str | None = None) -> list[float]:
    """Return the limits of a figure of the run, or of one of its signals."""
    asked = (wish for wish in result.spec.requirements if wish.figure == figure and wish.share is None)
    return [wish.limit for wish in asked if wish.signal in (None, signal)]
