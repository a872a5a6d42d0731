"""What the plants of a box do otherwise along the x_d of a run: w = f_p(x_d) − f(x_d) + (B_p − B) u_ff, enclosed.

In each cell of x_d, for each plant, w is rows of the flow of the loop; it is affine in the matrices, so of all plants
of the box one at a corner has the largest. What is said is of all times: between samples, and on both sides of where
x_d goes from cell to cell or a signal jumps.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.claims.robust import Robust
from pwatrack.simulation.closed_loop import ClosedLoop
from pwatrack.simulation.enclosure import Enclosing, Segments
from pwatrack.simulation.flow import Mode
from pwatrack.simulation.trace import Trace, tenths

_MOST_TOGETHER = 200_000  # rows times pieces: 100 MB while they are bounded


class Along:
    """Encloses each entry of w in each tenth of a run, block by block.

    Args:
        samples: How many the run has.
    """

    def __init__(self, loop: ClosedLoop, robust: Robust, samples: int) -> None:
        self._loop, self._of, self._differences = loop, robust.differences.of, robust.differences
        self._generator = [part.name for part in loop.flow.parts].index("generator")
        self._edges, self._number = tenths(samples), 0
        self._tenths = [Enclosing(self._rows) for _ in self._edges[1:]]
        self.w = np.zeros((len(self._tenths), len(loop.plant.B)))  # the largest size so far, in each tenth

    def see(self, trace: Trace) -> None:
        """Take the next block into account."""
        segments, first = Segments.of(self._loop.flow, trace), self._number
        self._number += len(trace.t)
        for k, enclosing in enumerate(self._tenths):
            start, end = (max(edge - first, 0) for edge in self._edges[k : k + 2])
            if start == end or start >= len(trace.t):
                continue
            until = trace.t[end] if end < len(trace.t) else np.inf
            for part in _parts(segments, float(trace.t[start]), float(until), len(self._of)):
                enclosing.see(part)
            found = enclosing.range()
            np.maximum.at(self.w[k], self._of, np.maximum(np.abs(found.low), np.abs(found.high)))

    def _rows(self, mode: Mode) -> Array:
        """Return the rows of w for each of the differences, (R, N)."""
        cell, D = mode[self._generator], self._differences
        rows = D.A[:, cell] @ self._loop.x_d[cell] + D.B @ self._loop.u_ff[cell]
        rows[:, -1] += D.b[:, cell]
        return np.asarray(rows)


def _parts(segments: Segments, start: float, end: float, rows: int) -> Iterator[Segments]:
    """Yield those that begin in a stretch of time, so many at a time as can be bounded together."""
    chosen, most = np.flatnonzero((segments.t >= start) & (segments.t < end)), max(_MOST_TOGETHER // max(rows, 1), 1)
    for k in range(0, len(chosen), most):
        some = chosen[k : k + most]
        yield replace(segments, **{n: getattr(segments, n)[some] for n in ("number", "t", "zeta", "length")})


def so_far(w: Array, t: Array, samples: int, step: float) -> Array:
    """Return the largest size of each entry of w up to the end of the tenth of the run that a time is in, (K, n).

    Args:
        w: In each tenth, (10, n).
        t: Times in s, (K,).
        samples, step: How many samples the run has, and how far they are apart in s.
    """
    starts = np.array(tenths(samples)[:-1]) * step
    k = np.searchsorted(starts, t + step / 2, side="right") - 1  # never an earlier one than that of t
    return np.asarray(np.maximum.accumulate(w)[np.maximum(k, 0)])
