"""What all pictures have in common: styles, sizes, titles, labels, and where panels are: as large as labels allow."""

import re
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO, StringIO
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.layout_engine import LayoutEngine
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from pwatrack.arrays import Array
from pwatrack.workflow.outcome import SimulatedLoop

# Dark solid and light dashed: told apart without colour too.
LOOK: dict[str, dict[str, Any]] = {
    "actual": {"color": "#12355b", "linewidth": 1.3},
    "desired": {"color": "#e08e2b", "linewidth": 1.1, "linestyle": (0, (4, 2))},
    "behind": {"color": "#f0bc80", "linewidth": 2.6, "zorder": 1.5},  # what another line runs along
    "estimate": {"color": "0.25", "linewidth": 1.2, "linestyle": (0, (1, 1.2))},
    "bound": {"color": "0.45", "linewidth": 1.3, "linestyle": (0, (6, 2))},
    "band": {"color": "0.88", "linewidth": 0, "zorder": 0},
    "worst": {"color": "black", "linewidth": 0.9, "linestyle": (0, (3, 1.5))},
    "limit": {"color": "0.3", "linewidth": 1.0, "linestyle": (0, (5, 1, 1, 1))},
    "binds": {"color": "0.65", "linewidth": 5, "marker": "s", "markersize": 5, "markeredgewidth": 0, "zorder": 1},
    "required": {"color": "#a3195b", "linewidth": 1.1, "linestyle": (0, (2, 1))},
}
WIDTH = 7.5  # inches
COLUMNS = 2000  # of a picture: more times than this cannot be told apart in print
ROUNDING = 1e-11  # of a signal: an error of it below that is rounding of the simulation, which no proof bounds
RARE = 0.01  # of the samples of an error: of so few a logarithmic scale does not go down to the least
_PAD = 1 / 24  # inches between what panels need, and around it
_FIRST = (0.6, 0.05, 0.2, 0.3)  # inches that a panel may need to the left, right, above and below
_AROUND, _BELOW = 1.2, 0.4  # inches: of a picture above its panels, and of a panel below what is drawn, about
_SIZE, _SMALL = 9, 7  # points of what is written along an axis; the other where there is little room
_LETTER, _FEWEST = 0.0075, 8  # inches of a letter for each point; letters of a line at least
_LONG = re.compile(r"\d+\.\d{4,}")  # numbers with more digits than there is room for beside an axis
_UNIT = re.compile(r"(?<=\d) (?=\S)")  # a space behind a number
_ROUNDS = 3  # of measuring: ticks change with the size of a panel, but seldom more than once


def canvas(
    result: SimulatedLoop, title: str, mosaic: Any, *, height: float, ratios: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    """Return a figure of a run and its panels in the order of their numbers in the mosaic."""
    conditions = "; ".join(result.loop.conditions.texts(result.spec.problem.plant, result.spec.problem.units))
    parts = (result.spec.name, 90), (f"({conditions})" if conditions else "", 100), (title, 100)
    kept = ((_UNIT.sub("\u00a0", text), most) for text, most in parts)  # no line ends between a number and its unit
    lines = [line.replace("\u00a0", " ") for text, most in kept for line in textwrap.wrap(text, most)]
    return sheet(lines, mosaic, height=height, ratios=ratios)


def sheet(
    lines: Sequence[str], mosaic: Any, *, height: float, ratios: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    """Return a figure under some lines, and its panels in the order of their numbers in the mosaic."""
    figure = Figure(figsize=(WIDTH, height))
    FigureCanvasAgg(figure)
    figure.set_layout_engine(_Panels(figure.suptitle(plain("\n".join(lines)), fontsize=10)))
    panels: dict[int, Axes] = figure.subplot_mosaic(mosaic, height_ratios=ratios)
    return figure, [panels[key] for key in sorted(panels)]


def png(figure: Figure) -> bytes:
    """Return a picture as a PNG file."""
    figure.set_dpi(150)
    file, canvas = BytesIO(), FigureCanvasAgg(figure)
    with _any_letter():
        canvas.print_png(file, pil_kwargs={"compress_level": 1})  # type: ignore[no-untyped-call]
    return file.getvalue()


def svg(figure: Figure) -> str:
    """Return a picture as an SVG file, sharp at any size; the same picture is the same file."""
    file, canvas = StringIO(), FigureCanvasSVG(figure)
    with _any_letter(), mpl.rc_context({"svg.hashsalt": "pwatrack"}):
        canvas.print_svg(file, metadata={"Date": None, "Creator": None})  # type: ignore[no-untyped-call]
    return file.getvalue()


@contextmanager
def _any_letter() -> Iterator[None]:
    """Draw a letter that the font lacks as a box, and say nothing."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


def label(axes: Axes, x: str, y: str, shown: Array | Sequence[float]) -> None:
    """Name both axes, and show from the first to the last of these times, or of whatever goes to the right."""
    axes.set_xlabel(x, fontsize=9)
    spec: Any = axes.get_subplotspec()
    figure: Any = axes.get_figure()
    ratios = np.array(spec.get_gridspec().get_height_ratios())
    share = float(ratios[spec.rowspan.start : spec.rowspan.stop].sum() / ratios.sum())
    room = float(figure.get_size_inches()[1] - _AROUND) * share - _BELOW  # the height in inches, about
    size = _SIZE if len(y) < room / (_LETTER * _SIZE) else _SMALL
    short = _LONG.sub(lambda number: f"{float(number[0]):.3g}", y)
    kept = short.replace("+ ", "+\u00a0").replace("- ", "-\u00a0")  # a sign stays with what follows
    lines = textwrap.wrap(kept, max(_FEWEST, int(room / (_LETTER * size))), max_lines=4, placeholder=" …")
    axes.set_ylabel(plain("\n".join(lines).replace("\u00a0", " ")), fontsize=size)
    axes.set_xlim(shown[0], shown[-1])
    axes.tick_params(which="both", labelsize=8)
    for axis in (axes.xaxis, axes.yaxis):
        axis.get_offset_text().set_fontsize(8)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def legend(axes: Axes, columns: int = 2, others: Sequence[Axes] = ()) -> None:
    """Explain the curves above the panel, each name once; those of other panels too. A limit out of sight has none."""
    named = dict[str, Any]()
    for panel in (axes, *others):
        low, high = panel.get_ylim()
        for handle, text in zip(*panel.get_legend_handles_labels(), strict=True):
            at = np.ravel(handle.get_ydata())[0] if isinstance(handle, Line2D) and text == "limit" else low
            if low <= at <= high:
                named.setdefault(text, handle)
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


def band(axes: Axes, t: Array, low: Array, high: Array, name: str) -> None:
    """Fill what is between two curves, (K,) each, at no more times than can be told apart."""
    few = slice(None, None, max(1, len(t) // COLUMNS))
    axes.fill_between(t[few], low[few], high[few], label=name, **LOOK["band"])


def plain(text: str) -> str:
    """Return text that matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def limits(result: SimulatedLoop, figure: str, signal: str | None = None, *, members: bool = False) -> list[float]:
    """Return the limits of a figure of the run, or of one of its signals; or those of members of an ensemble."""
    asked = (wish for wish in result.spec.requirements if wish.figure == figure and (wish.share is not None) == members)
    return [wish.limit for wish in asked if wish.signal in (None, signal)]


class _Panels(LayoutEngine):
    """Panels in a grid under a title, the names of those below each other in line.

    Each panel is measured once, and again only if ticks have changed since. The layout of matplotlib measures twice,
    and once more for names in line, which takes longer than to draw.
    """

    _adjust_compatible = False
    _colorbar_gridspec = False

    def __init__(self, title: Text) -> None:
        super().__init__()
        self._title = title

    def execute(self, fig: Any) -> None:
        """Place the panels, when the figure is drawn for the first time."""
        panels = [axes for axes in fig.axes if axes.get_in_layout()]  # a panel that is placed is no longer
        if not panels:
            return
        beside = [axes.yaxis.label for axes in panels if axes.get_ylabel()]
        smallest = min((text.get_fontsize() for text in beside), default=_SIZE)
        for text in beside:
            text.set_fontsize(smallest)
        pad, (_, height) = _PAD * fig.dpi, fig.bbox.size
        self._title.set_y(1 - pad / height)
        below = height - self._title.get_window_extent().height - 2 * pad
        first = np.array([axes.get_subplotspec().colspan.start for axes in panels])
        needs = np.tile(np.array(_FIRST) * fig.dpi, (len(panels), 1))
        _place(panels, needs + pad, fig.bbox.size, below)
        for _ in range(_ROUNDS):
            ticks = _ticks(panels)
            needs = np.array([_needs(axes) for axes in panels])
            offsets = np.array([axes.yaxis.label.get_position()[0] - axes.bbox.x0 for axes in panels])
            furthest = np.array([offsets[first == column].min() for column in first])
            thick = [axes.yaxis.label.get_window_extent().width for axes in panels]
            needs[:, 0] = np.maximum(needs[:, 0], thick - furthest)  # names in line
            _place(panels, needs + pad, fig.bbox.size, below)
            if _ticks(panels) == ticks:
                break
        for axes, offset in zip(panels, furthest, strict=True):
            axes.yaxis.set_label_coords(offset / axes.bbox.width, 0.5)


def _needs(axes: Axes) -> tuple[float, float, float, float]:
    """Return the pixels that a panel needs to the left, right, above and below for what is written there."""
    inner, outer = axes.bbox, axes.get_tightbbox(for_layout_only=True)
    if outer is None:
        return 0.0, 0.0, 0.0, 0.0
    return inner.x0 - outer.x0, outer.x1 - inner.x1, outer.y1 - inner.y1, inner.y0 - outer.y0


def _ticks(panels: Sequence[Axes]) -> list[list[float]]:
    return [axis.get_majorticklocs().tolist() for axes in panels for axis in (axes.xaxis, axes.yaxis)]


def _place(panels: Sequence[Axes], needs: Array, size: Sequence[float], top: float) -> None:
    """Give each panel its place, with what the neediest of its row and column needs, (panels, 4) in pixels."""
    specs: list[Any] = [axes.get_subplotspec() for axes in panels]
    grid = specs[0].get_gridspec()
    columns = _intervals(size[0], grid.get_width_ratios(), [s.colspan for s in specs], needs[:, :2])
    rows = _intervals(top, grid.get_height_ratios(), [s.rowspan for s in specs], needs[:, 2:])
    for axes, (x0, x1), (y1, y0) in zip(panels, columns, top - rows, strict=True):
        axes.set_position(Bbox([[x0 / size[0], y0 / size[1]], [x1 / size[0], y1 / size[1]]]))


def _intervals(length: float, ratios: Sequence[float], spans: Sequence[range], needs: Array) -> Array:
    """Return where each panel begins and ends in one direction, (panels, 2): needs are before and after it."""
    before, after = np.zeros(len(ratios)), np.zeros(len(ratios))
    for span, (first, last) in zip(spans, needs, strict=True):
        before[span.start] = max(before[span.start], first)
        after[span.stop - 1] = max(after[span.stop - 1], last)
    inner = np.array(ratios) / np.sum(ratios) * max(1.0, length - before.sum() - after.sum())
    ends = np.cumsum(before + inner + after) - after
    return np.array([(ends[span.start] - inner[span.start], ends[span.stop - 1]) for span in spans])
