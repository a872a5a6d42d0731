"""Which cells each part of a loop was in, as bars over time: the same in pictures and on the page of a run."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pwatrack.arrays import Array
from pwatrack.workflow.outcome import SimulatedLoop

_MOST_ROWS = 40  # of cells of a part
_LONGEST = 60  # characters of the name of a cell beside its row: there is room for half as many again


class Stay(NamedTuple):
    """A row of a picture: when a part of the loop was in a cell, or in one of those that there is no room for."""

    name: str  # of the cell
    share: float  # of the time
    bars: list[tuple[float, float]]  # since when, in s, and how long


def stays(result: SimulatedLoop, dots: int) -> Iterator[tuple[str, list[Stay]]]:
    """Yield each part of the loop with its rows; bars nearer than a dot, of which the time has so many, are one."""
    trace, shares = result.response.trace, result.figures.time_share
    known = trace.stays()
    modes, times = np.array([mode for mode, _, _ in known]), np.array([ends for _, *ends in known])
    for k, part in enumerate(result.loop.flow.parts):
        seen = {part.cells[cell] for cell in np.unique(modes[:, k]).tolist()}
        rows = _grouped([name for name in dict.fromkeys(part.cells) if name in seen], part.cells)
        share, found = shares.get(part.name, {}), list[Stay]()
        for row, group in rows.items():
            inside = np.isin(modes[:, k], [cell for cell, name in enumerate(part.cells) if name in group])
            total = min(1.0, sum(share.get(name, 0.0) for name in group))
            found.append(Stay(row, total, joined(times[inside], float(trace.t[-1]) / dots)))
        yield part.name, found


def _grouped(names: Sequence[str], cells: Sequence[str]) -> dict[str, set[str]]:
    """Return the rows of a picture, each with the cells that it shows: so many that there is room for them."""
    shown = names if len(names) <= _MOST_ROWS else names[: _MOST_ROWS - 1]
    rows = {
        name if len(name) <= _LONGEST else f"{name[:_LONGEST]}… (cell {cells.index(name) + 1})": {name}
        for name in shown
    }
    others = set(names[len(shown) :])
    return rows | ({f"{len(others):,} other cells": others} if others else {})


def joined(bars: Array, dot: float) -> list[tuple[float, float]]:
    """Return (start, length) of bars (start, end) in order, those joined that are nearer to each other than a dot."""
    apart = np.flatnonzero(bars[1:, 0] - bars[:-1, 1] > dot)
    starts, ends = bars[np.append(0, apart + 1), 0], bars[np.append(apart, -1), 1]
    return list(zip(starts.tolist(), (ends - starts).tolist(), strict=True))
