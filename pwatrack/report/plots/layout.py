"""Where the panels of a picture are: as large as their labels allow."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.layout_engine import LayoutEngine
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from pwatrack.arrays import Array

_PAD = 1 / 24  # inches between what panels need, and around it
_FIRST = (0.6, 0.05, 0.2, 0.3)  # inches that a panel may need to the left, right, above and below
_ROUNDS = 3  # of measuring: ticks change with the size of a panel, but seldom more than once


class Panels(LayoutEngine):
    """Panels in a grid under a title, the names of those below each other in line.

    Each panel is measured once, and again only if ticks have changed since. The layout of matplotlib measures twice,
    and once more for names in line, which takes longer than to draw.

    Args:
        title: That of the figure.
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
        pad, (_, height) = _PAD * fig.dpi, fig.bbox.size
        self._title.set_y(1 - pad / height)
        below = height - self._title.get_window_extent().height - 2 * pad
        needs = np.tile(np.array(_FIRST) * fig.dpi, (len(panels), 1))
        _place(panels, needs + pad, fig.bbox.size, below)
        for _ in range(_ROUNDS):
            ticks = _ticks(panels)
            needs = np.array([_needs(axes) for axes in panels])
            offsets = [axes.yaxis.label.get_position()[0] - axes.bbox.x0 for axes in panels]
            _place(panels, needs + pad, fig.bbox.size, below)
            if _ticks(panels) == ticks:
                break
        first = [axes.get_subplotspec().colspan.start for axes in panels]
        for axes, column in zip(panels, first, strict=True):
            furthest = min(offset for offset, c in zip(offsets, first, strict=True) if c == column)
            axes.yaxis.set_label_coords(furthest / axes.bbox.width, 0.5)


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
