"""Courses of a reference: formulas, rounded polylines and steps, tables, filtered or not; each becomes a signal."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb, factorial

import numpy as np
import scipy  # whose parts are imported where they are used

from pwatrack.arrays import Array
from pwatrack.model.signal import ExponentialPolynomial, Signal

_BOXES = 4  # moving averages, one after the other: together they weigh with a cubic B-spline
_FALL = 0.2275119577344921  # sinc(x)^4 = 1/√2: of the cutoff times the width of one average
_FITTED = 4  # coefficients of the polynomial that goes on beyond either end
_SLOW = 0.05  # of the rate of the rows: what is slower was meant, if a table has noise
_ROUGH, _ALIKE = 10.0, 0.05  # noise: so many times the derivative of what is slow, which differs so little from it
_FEWEST = 40  # rows: two windows of that filter


def low_passed(t: Array, y: Array, cutoff: float) -> tuple[Array, Array]:
    """Return a coarser table of what is left of samples (t_k, y_k), (K,), below a cutoff frequency in Hz.

    The samples are joined by straight lines and averaged four times over a moving window of 0.2275 / cutoff, centred:
    what is averaged at t is ∫ y(t − s) B(s) ds with a cubic B-spline B. Its gain at f is sinc⁴(0.2275 f / cutoff), so
    0.92 at half of the cutoff, 0.71 at the cutoff, and below 0.3 % for all that is faster than 4.4 times the cutoff.
    Beyond its ends, the table is taken to go on as the cubic that fits it best near that end. There are two points in
    each window: a spline through them misses nothing that is left, and has any number of derivatives. Raises ValueError
    if the filter sees less than two rows at a time, or the whole table.
    """
    box = _FALL / cutoff
    width, span, gap = _BOXES * box, float(t[-1] - t[0]), float(np.median(np.diff(t)))
    if cutoff > 0.5 / gap:
        raise ValueError(f"rows {gap:.3g} s apart tell nothing above {0.5 / gap:.3g} Hz: the cutoff is {cutoff:g} Hz")
    if width > span:
        raise ValueError(f"a cutoff of {cutoff:g} Hz averages over {width:.3g} s, the table lasts {span:.3g} s")
    long_t, long_y = _extended(t, y, width, gap)
    edges = (np.arange(_BOXES + 1) - _BOXES / 2) * box
    kernel = scipy.interpolate.BSpline.basis_element(edges)
    ramp = kernel.antiderivative(2)
    mass = float(kernel.integrate(edges[0], edges[-1]))
    times = np.linspace(t[0], t[-1], int(np.ceil(2 * span / box)) + 1)
    values = np.interp(times, long_t, long_y)
    kinks, corners = np.diff(np.diff(long_y) / np.diff(long_t)), long_t[1:-1]
    first, last = np.searchsorted(corners, times - width / 2), np.searchsorted(corners, times + width / 2)
    near = np.repeat(np.arange(len(times)), last - first)  # times, each with the corners that it sees
    corner = np.arange(len(near)) + np.repeat(first - np.cumsum(np.append(0, last - first))[:-1], last - first)
    ahead = np.clip(times[near] - corners[corner], edges[0], edges[-1])
    rounded = (ramp(ahead) - ramp(edges[0])) / mass - np.maximum(ahead, 0.0)
    return times, values + np.bincount(near, kinks[corner] * rounded, len(times))


def _extended(t: Array, y: Array, width: float, gap: float) -> tuple[Array, Array]:
    """Return the samples, with half a window more at either end."""
    beyond = gap * np.arange(1, int(np.ceil(width / 2 / gap)) + 1)
    parts_t, parts_y = [t], [y]
    for end, sign in ((0, -1), (-1, 1)):
        near = np.abs(t - t[end]) <= max(width, 2 * _FITTED * gap)
        fit = np.polynomial.Polynomial.fit(t[near] - t[end], y[near], min(_FITTED, int(near.sum())) - 1)
        k = slice(None, None, sign)
        parts_t[0 if sign < 0 else len(parts_t) : 0] = [t[end] + sign * beyond[k]]
        parts_y[0 if sign < 0 else len(parts_y) : 0] = [fit(sign * beyond[k])]
    return np.concatenate(parts_t), np.concatenate(parts_y)


def smoothed(corners: "scipy.interpolate.PPoly", width: float, times: int) -> "scipy.interpolate.PPoly":
    """Return a piecewise linear course averaged `times` times over a moving window of width / times, in s.

    Every average adds one continuous derivative. A corner at t_j changes the course only for |t − t_j| < width / 2,
    where a jump of the value becomes the integral of a B-spline and a jump of the slope the integral of that.
    """
    lines = np.vstack([np.zeros((2 - len(corners.c), corners.c.shape[1])), corners.c])  # slope, value
    knots = corners.x[1:-1]
    ends = lines[1, :-1] + lines[0, :-1] * np.diff(corners.x)[:-1]
    jumps, kinks = lines[1, 1:] - ends, np.diff(lines[0])
    edges = (np.arange(times + 1) / times - 0.5) * width
    breaks = np.unique(np.concatenate([corners.x, (knots[:, None] + edges).ravel()]))
    breaks = breaks[np.append(True, np.diff(breaks) > 1e-9 * width)]
    start, middle = breaks[:-1], (breaks[1:] + breaks[:-1]) / 2
    own = np.clip(np.searchsorted(corners.x, middle) - 1, 0, lines.shape[1] - 1)
    pieces = np.zeros((times + 2, len(start)))  # rising powers
    pieces[:2] = lines[1, own] + lines[0, own] * (start - corners.x[own]), lines[0, own]
    first, last = np.searchsorted(middle, knots - width / 2), np.searchsorted(middle, knots + width / 2)
    near = np.repeat(np.arange(len(knots)), last - first)  # knots, each with the pieces that it reaches
    piece = np.arange(len(near)) + np.repeat(first - np.cumsum(np.append(0, last - first))[:-1], last - first)
    ahead, beyond = start[piece] - knots[near], middle[piece] > knots[near]
    for jump, degree in ((jumps[near], 0), (kinks[near], 1)):
        rounded = _rounded_power(degree, ahead, middle[piece] - knots[near], edges, width)
        rounded[0] -= np.where(beyond, ahead if degree else 1.0, 0.0)
        if degree:
            rounded[1] -= beyond
        for row, values in zip(pieces, jump * rounded, strict=False):
            np.add.at(row, piece, values)
    return scipy.interpolate.PPoly(pieces[::-1], breaks)


def _rounded_power(degree: int, start: Array, middle: Array, edges: Array, width: float) -> Array:
    """Return max(0, t)^degree, averaged, about each `start` as rising powers, on the piece that holds `middle`."""
    times = len(edges) - 1
    power = times + degree
    total = np.zeros((power + 1, len(start)))
    for k in range(times + 1):
        weight = (-1) ** k * comb(times, k) * (times / width) ** times * factorial(degree) / factorial(power)
        ahead = start - edges[k]
        here = edges[k] < middle
        for j in range(power + 1):
            total[j] += np.where(here, weight * comb(power, j) * ahead ** (power - j), 0.0)
    return total


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A piecewise linear or constant course, its corners rounded over a time `smooth` (s) if that is given."""

    corners: "scipy.interpolate.PPoly"  # the course, from well before t = 0
    continuous: bool  # whether it is continuous; a step is not
    smooth: float | None  # width of the moving average, or None
    end: float | None  # last time at which it is defined, or None if it stays constant

    def signal(self, r: int) -> Signal:
        """Return the signal; with `smooth` it has r continuous derivatives, and corners are rounded whatever r is."""
        averages = max(r, 1) if self.continuous else r + 1
        course = self.corners if self.smooth is None else smoothed(self.corners, self.smooth, averages)
        return Signal.piecewise_polynomial(course, self.end)


@dataclass(frozen=True, kw_only=True)
class Roughness:
    """What is fast in a derivative of a table."""

    cutoff: float  # in Hz
    whole: float  # largest size of the derivative
    left: float  # that of what is slower than the cutoff


@dataclass(frozen=True)
class Table:
    """Samples (t_k, y_k), joined by a spline with as many continuous derivatives as are needed."""

    t: Array  # in s, (K,)
    y: Array  # (K,)
    filtered: bool = False  # whether what is fast was taken away

    @property
    def end(self) -> float:
        """Last time at which it is defined, in s."""
        return float(self.t[-1])

    def spline(self, r: int) -> "scipy.interpolate.BSpline":
        """Return the spline of odd degree ≥ r + 1."""
        degree = max(3, r + 1 + r % 2)
        return scipy.interpolate.make_interp_spline(self.t, self.y, k=min(degree, len(self.t) - 1))

    def roughness(self, r: int) -> "Roughness | None":
        """Return what noise, or corners, of the table make of its derivative of order r; None if nothing to speak of.

        That is: the largest size of the derivative is more than ten times that of what is left below a twentieth of the
        rate of the rows, while that is within 5 % of the table.
        """
        cutoff = _SLOW / float(np.median(np.diff(self.t)))
        if self.filtered or len(self.t) < _FEWEST:
            return None
        slow = Table(*low_passed(self.t, self.y, cutoff))
        away = np.abs(slow.spline(r)(self.t) - self.y).max()
        whole, left = self._largest(r), slow._largest(r)
        if away > _ALIKE * np.ptp(self.y) or not whole > _ROUGH * left:
            return None
        return Roughness(cutoff=cutoff, whole=whole, left=left)

    def _largest(self, r: int) -> float:
        """The largest size of the derivative of order r, at the rows and between them."""
        return float(np.abs(self.spline(r)(np.sort(np.append(self.t, (self.t[1:] + self.t[:-1]) / 2)), r)).max())

    def signal(self, r: int) -> Signal:
        """Return the spline of odd degree ≥ r + 1."""
        spline = self.spline(r)
        course = scipy.interpolate.PPoly.from_spline((spline.t, spline.c, spline.k))
        inner = np.flatnonzero(np.diff(course.x) > 0)
        return Signal.piecewise_polynomial(
            scipy.interpolate.PPoly(course.c[:, inner], np.append(course.x[inner], course.x[-1])), self.end
        )


@dataclass(frozen=True)
class Formula:
    """A formula in t, on an interval from 0 or for ever."""

    value: ExponentialPolynomial
    end: float | None = None

    def signal(self, r: int) -> Signal:  # noqa: ARG002 - it has all derivatives
        """Return the signal."""
        return Signal((0.0,), (self.value,), self.end)


Course = Formula | Profile | Table


def polyline(t: Sequence[float], y: Sequence[float]) -> "scipy.interpolate.PPoly":
    """Return the piecewise linear course through (t_k, y_k)."""
    times, values = np.array(t, dtype=np.float64), np.array(y, dtype=np.float64)
    return scipy.interpolate.PPoly(np.array([np.diff(values) / np.diff(times), values[:-1]]), times)
