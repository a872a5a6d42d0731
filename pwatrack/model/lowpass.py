"""A filter for measured references: no phase, and what it leaves is as smooth as is wanted."""

import numpy as np
import scipy

from pwatrack.arrays import Array

_BOXES = 4  # moving averages, one after the other: together they weigh with a cubic B-spline
_FALL = 0.2275119577344921  # sinc(x)^4 = 1/√2: of the cutoff times the width of one average
_FITTED = 4  # coefficients of the polynomial that goes on beyond either end


def low_passed(t: Array, y: Array, cutoff: float) -> tuple[Array, Array]:
    """Return a coarser table of what is left of samples (t_k, y_k) below a cutoff frequency.

    The samples are joined by straight lines and averaged four times over a moving window of 0.2275 / cutoff, centred:
    what is averaged at t is ∫ y(t − s) B(s) ds with a cubic B-spline B. Its gain at f is sinc⁴(0.2275 f / cutoff), so
    0.92 at half of the cutoff, 0.71 at the cutoff, and below 0.3 % for all that is faster than 4.4 times the cutoff.
    Beyond its ends, the table is taken to go on as the cubic that fits it best near that end. There are two points in
    each window: a spline through them misses nothing that is left, and has any number of derivatives.

    Args:
        t, y: Times in s, increasing, and values, (K,).
        cutoff: Where 0.71 of an amplitude is left, in Hz.

    Raises:
        ValueError: If the filter sees less than two rows at a time, or the whole table.

    Example: noise goes, and what is slow stays.

        >>> t = np.arange(0.0, 10.0, 0.01)
        >>> noise = np.where(np.arange(1000) % 2, 0.1, -0.1)
        >>> times, values = low_passed(t, np.sin(t) + noise, cutoff=2.0)
        >>> bool(np.abs(values - np.sin(times))[4:-4].max() < 0.003), len(times)
        (True, 177)
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
