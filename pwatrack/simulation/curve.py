"""The cells that a curve in polynomials visits, and how well it satisfies η' = A_i η + B_i (w, 1) there: enclosed.

On each stretch of time η is a polynomial and w' = S w turns so little that its Taylor polynomial is exact to rounding.
So guards and residuals are polynomials, whose Bernstein coefficients enclose them. What w, arithmetic and Taylor's
remainder may be off by is added. A stretch on which a guard may have either sign is halved, until it has one, or is so
short that its ends are one time in floating point, or the guard is within rounding of 0 on all of it: there x_d may be
in either cell, and the residual is enclosed in both. No stay beyond a facet is missed, however short.
"""

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import EPS, Array, IntArray
from pwatrack.errors import Problem, Undecided
from pwatrack.simulation.enclosure import bernstein

MOST_TURN = 1.0  # |rate| times length of a stretch: so short that the Taylor polynomial below is exact
_DEGREE = 20  # of the Taylor polynomials: 1 / 21! is 2e-20, and 2^10.5 / 21! for what is damped as fast as it turns
_UNIT = (_DEGREE + 4) * EPS  # of the sum of the sizes of all terms: what a coefficient may be off by
_GRAZING = 4.0  # times what a guard may be off by: if it is nowhere larger it may be halved for ever
_SHARP, _DEEP = 1.25, 6  # a residual that is said is at most so many times one attained, after so many halvings
_MOST = 4_000_000  # stretches in all
_AT_ONCE = 2**21  # numbers in an array of coefficients
_TO_BERNSTEIN = bernstein(_DEGREE)
_LEFT = np.array([[comb(k, j) / 2.0**k for j in range(_DEGREE + 1)] for k in range(_DEGREE + 1)])  # half, likewise
_RIGHT = _LEFT[::-1, ::-1]


@dataclass(frozen=True, kw_only=True)
class Curve:
    """η = Σ c_k τᵏ, τ the time since the start, and w' = S w on each of N stretches.

    Attributes:
        start, length: In s, (N,).
        c: (N, p, K).
        w, off: w at the start, and what it may be off by, (N, s).
        of: A number that each is known by, (N,).
    """

    start: Array
    length: Array
    c: Array
    w: Array
    off: Array
    of: IntArray


@dataclass(frozen=True, kw_only=True)
class Looked:
    """Stretches in order of time on each of which the cell of x_d is known, or cannot be told from others.

    Attributes:
        start, length: In s, (M,).
        of: The number of the stretch that each is part of, (M,).
        possible: Which cells x_d may be in, (M, l).
        ends: η' − A_i η − B_i (w, 1) at both ends, (M, 2, l, p).
        residual: Above its size in all cells that are possible, (M, p).
    """

    start: Array
    length: Array
    of: IntArray
    possible: NDArray[np.bool_]
    ends: Array
    residual: Array

    def cells(self) -> IntArray:
        """Return one cell for each, (M,): that of before where there are several."""
        sure = self.possible.sum(axis=1) == 1
        last = np.maximum.accumulate(np.where(sure, np.arange(len(sure)), -1))
        last = np.where(last < 0, np.argmax(sure), last)
        return np.asarray(self.possible[last].argmax(axis=1), dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class InternalDynamics:
    """η' = rate[i] (η, w, 1) in the cell i, the one on whose side of all guards (η, w, 1) is, and w' = S w.

    Attributes:
        rate: (l, p, p + s + 1).
        guards: (G, p + s + 1).
        signs: Side of each guard that each cell is on, 0 where that does not bound it, (l, G).
        S: (s, s).
    """

    rate: Array
    guards: Array
    signs: IntArray
    S: Array

    def look(self, curve: Curve, *, sharp: bool) -> Looked:
        """Return where x_d is in which cell, and how well it satisfies its equation there.

        Args:
            curve: What x_d is made of; its stretches are short enough for `MOST_TURN`.
            sharp: Whether the residual is enclosed closely.

        Raises:
            Undecided: If there are too many crossings.
        """
        cells, p, columns = self.rate.shape
        step = max(1, _AT_ONCE // ((_DEGREE + 1) * (cells * p + len(self.guards) + columns)))
        attained = np.zeros(p)
        found = [
            part
            for first in range(0, len(curve.start), step)
            for part in self._halved(curve, slice(first, first + step), attained, sharp=sharp)
        ]
        looked = {name: np.concatenate([getattr(part, name) for part in found]) for name in Looked.__annotations__}
        order = np.argsort(looked["start"], kind="stable")
        return Looked(**{name: values[order] for name, values in looked.items()})

    def _halved(self, curve: Curve, at: slice, attained: Array, *, sharp: bool) -> list[Looked]:
        """Return stretches that need not be halved any more; what is attained is noted."""
        start, length, of = curve.start[at], curve.length[at], curve.of[at]
        b, slack = self._coefficients(curve, at)
        found, depth, total = list[Looked](), 0, 0
        shape, G = (-1, *self.rate.shape[:2]), len(self.guards)
        while len(start):
            guards, most = b[:, :G], np.abs(b).max(axis=2) + slack
            low, high = guards.min(axis=2) - slack[:, :G], guards.max(axis=2) + slack[:, :G]
            signs = self.signs
            outside = ((signs > 0) & (high < 0)[:, None]) | ((signs < 0) & (low > 0)[:, None])
            possible = ~outside.any(axis=2)
            told = (low > 0) | (high < 0) | (most[:, :G] <= _GRAZING * slack[:, :G])
            instant = length <= 4 * EPS * (start + length)
            open_ = (possible.sum(axis=1) > 1) & ~told.all(axis=1) & ~instant
            residual = np.where(possible[:, :, None], most[:, G:].reshape(shape), 0.0).max(axis=1)
            ends = b[:, G:][:, :, [0, -1]].transpose(0, 2, 1).reshape(-1, 2, *shape[1:])
            sure = possible.sum(axis=1) == 1
            if sharp:
                seen = np.abs(ends).max(axis=1) - slack[:, G:].reshape(shape)
                seen = np.where((possible & sure[:, None])[:, :, None], seen, 0.0).max(axis=1)
                np.maximum(attained, seen.max(axis=0, initial=0.0), out=attained)
                noise = np.where(possible[:, :, None], slack[:, G:].reshape(shape), 0.0).max(axis=1)
                dull = residual > np.maximum(_SHARP * attained, _GRAZING * noise)
                open_ |= dull.any(axis=1) & (depth < _DEEP)
            kept = ~open_
            values = (start, length, of, possible, ends, residual)
            found.append(Looked(**dict(zip(Looked.__annotations__, (v[kept] for v in values), strict=True))))
            total += len(start)
            if total > _MOST:
                raise Undecided(Problem(message="x_d crosses facets too often to be followed"))
            half = length[open_] / 2
            start, length, of = (
                np.concatenate(pair)
                for pair in ((start[open_], start[open_] + half), (half, half), (of[open_], of[open_]))
            )
            slack = slack[open_] + _DEGREE * EPS * np.abs(b[open_]).max(axis=2, initial=0.0)
            b, slack, depth = (
                np.concatenate([b[open_] @ _LEFT.T, b[open_] @ _RIGHT.T]),
                np.tile(slack, (2, 1)),
                depth + 1,
            )
        return found

    def _coefficients(self, curve: Curve, at: slice) -> tuple[Array, Array]:
        """Return Bernstein coefficients of guards and residuals, (N, G + l p, degree + 1), and what they may be off by.

        Both are sums of terms that are known order by order, in powers of time over length.
        """
        h, c, off = curve.length[at], curve.c[at], curve.off[at]
        rate = self.rate.reshape(-1, self.rate.shape[2])
        rows, p = np.vstack([self.guards, -rate]), c.shape[1]
        G, size, turn = len(self.guards), np.abs(rows), np.abs(self.S)
        powers, slack = np.zeros((len(h), len(rows), _DEGREE + 1)), np.zeros((len(h), len(rows)))
        w, most, wide = curve.w[at], np.abs(curve.w[at]), off
        of_w = slice(p, p + w.shape[1])
        for k in range(2 * _DEGREE):
            if k <= _DEGREE:
                powers[:, :, k] = w @ rows[:, of_w].T
                slack += (_UNIT * most + wide) @ size[:, of_w].T
            else:  # the remainder: its terms fall faster than by halves from here on
                slack += 2 * most @ size[:, of_w].T
            scale = (h / (k + 1))[:, None]
            w, most, wide = scale * (w @ self.S.T), scale * (most @ turn.T), scale * (wide @ turn.T)
        powers[:, :, 0] += rows[:, -1]
        slack += _UNIT * size[:, -1]
        for k in range(c.shape[2]):
            part = c[:, :, k] * h[:, None] ** k
            powers[:, :, k] += part @ rows[:, :p].T
            slack += _UNIT * np.abs(part) @ size[:, :p].T
            if k:  # and those of η'
                slope = np.tile(k * c[:, :, k] * h[:, None] ** (k - 1), (1, len(self.rate)))
                powers[:, G:, k - 1] += slope
                slack[:, G:] += _UNIT * np.abs(slope)
        return powers @ _TO_BERNSTEIN.T, slack
