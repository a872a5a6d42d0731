"""Bounds on signals along a walked trajectory, at all times and not at samples alone.

Between two breaks a signal is r ζ(σ) with ζ' = F ζ, a sum of p(σ) e^{λσ}. On a piece of length ℓ, with τ = σ/ℓ,

    r ζ = Σ_{j ≤ k} r T_j τʲ + ρ,   T_j = (F ℓ)ʲ ζ(0) / j!,   |ρ| ≤ |r| R |T_{k+1}|,   R ≥ sup_{σ ≤ ℓ} |e^{Fσ}|,

Taylor's theorem with its remainder, entry by entry. The Bernstein coefficients of the polynomial enclose it, and for
several rows together the curve is in the convex hull of its control points, so that no norm is above the largest of
theirs. What arithmetic may be off by is added. T_{k+1} has the signs of ζ: where what is fast has decayed it is small,
however long the piece. R is known for lengths s 2ᵈ by doubling, R(2s) = max(R(s), R(s) |e^{Fs}|).

Only pieces whose bound is above the largest value that is surely attained, by more than 1e-7 of the signal's size, are
split, at a length s 2ᵈ where e^{Fs} is known (branch and bound); all pieces of a mode at once.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from math import comb, factorial
from typing import Any, NamedTuple

import numpy as np

from pwatrack.arrays import OVER_SUMS, TINY, Array, IntArray, balancing
from pwatrack.simulation.flow import Flow, Mode
from pwatrack.simulation.tables import taylor, unit
from pwatrack.simulation.trace import Trace

CLOSE = 1e-7  # of the size of a signal: what is said is at most so much above what is attained
_SAME = 1e-6  # of the size: of peaks that differ by less the first one counts
_FIRST = 1e-12  # of a signal: what is nearer to the highest of one peak is it, but for rounding
_SHORT = 0.5  # ‖F s‖ for the length s from which on there is doubling
_DEGREE = 3  # of the polynomial: of a higher one rounding grows faster with the length than it gains
_ONE_LOOK = 6  # the degree where pieces are short, and none is split
_STIFF = 9  # doublings of s from which on a chord is better: ε ‖F ℓ‖⁴ / 4! is above 1e-7
_DEEPEST = -80  # halvings of s: by then any step is below the rounding of time
MOST_NUMBERS = 150_000_000  # of all pieces of a trajectory: ten seconds or so; after it no bound is known
TOGETHER = 20_000_000  # numbers of pieces that are bounded together: 160 MB, a few times
_NOISE = 8  # times what rounding is: bounds that are closer cannot be told apart

Rows = Callable[[Mode], Array]


@dataclass(frozen=True, kw_only=True)
class Segments:
    """M stretches of time on each of which ζ' = F[number] ζ."""

    modes: tuple[Mode, ...]  # the D modes that occur
    F: Array  # their matrices, (D, N, N)
    number: IntArray  # which of them each segment has, (M,)
    t: Array  # when it begins, in s, (M,)
    zeta: Array  # from where, (M, N)
    length: Array  # in s; 0 stands for a single point, (M,)
    reading: Callable[[Array], Array] = np.asarray  # makes of rows on z rows on ζ

    @staticmethod
    def of(flow: Flow, trace: Trace) -> "Segments":
        """Return what was walked in a block: from each sample and each break to the next, jumps and all."""
        assert trace.breaks is not None
        t = np.concatenate([trace.t, trace.breaks.t])
        order = np.argsort(t, kind="stable")
        t = t[order]
        z = np.concatenate([trace.z, trace.breaks.z])[order]
        modes, number = np.unique(np.concatenate([trace.modes, trace.breaks.modes])[order], axis=0, return_inverse=True)
        met = tuple(tuple(int(cell) for cell in mode) for mode in modes)
        return Segments(
            modes=met,
            F=np.array([flow.matrix(mode) for mode in met]),
            number=number.reshape(-1).astype(np.int64),
            t=t,
            zeta=flow.relative(z),
            length=np.maximum(np.diff(t, append=trace.breaks.until), 0.0),
            reading=flow.rows,
        )

    def since(self, t: float) -> "Segments":
        """Return those that begin at a time in s or later."""
        keep = self.t >= t
        return replace(self, number=self.number[keep], t=self.t[keep], zeta=self.zeta[keep], length=self.length[keep])


@dataclass(frozen=True, kw_only=True)
class Range:
    """What signals are within.

    The bounds are at most 1e-7 of the largest |signal| off, or within rounding; infinite where finding them took too
    long. Of peaks that differ by less than 1e-6 of that the time of the first one is given.
    """

    low: Array  # (q,)
    high: Array
    inner: Array  # a value near each that is attained, (q, 2)
    times: Array  # when that is, in s, (q, 2)


def enclosed(blocks: Iterable[Segments], rows: Rows, *, norm: bool = False) -> Range:
    """Return what r z(t) is within, for each of the rows (q, N); as a norm, what ‖r z(t)‖ is, with 0 from below."""
    enclosing = Enclosing(rows, norm=norm)
    for block in blocks:
        enclosing.see(block)
    return enclosing.range()


class _Pieces(NamedTuple):
    """P pieces in one mode."""

    t: Array
    zeta: Array
    length: Array


class _Tables:
    """What is known of e^{Fσ} and of some rows in a mode; transposed where products run along rows."""

    def __init__(self, F: Array, rows: Array, degree: int = _DEGREE) -> None:
        d = balancing(F[None])
        norm = max(float(np.linalg.norm(F / d[:, None] * d)), TINY)
        self._F, self.s, self.rows, self.u = F, 2.0 ** np.floor(np.log2(_SHORT / norm)), rows.T, unit(len(F))
        self.degree, self.numbers = degree, len(F) + (degree + 2) * len(rows)  # of each piece
        terms = taylor(F * self.s)
        self._turns = {0: terms[::-1, 0].sum(axis=0)}
        self._reach = [OVER_SUMS * terms[::-1, 1].sum(axis=0)]
        self._terms: dict[int, Array] = {}
        self._bounds: dict[int, Array] = {}

    def levels(self, length: Array) -> IntArray:
        """Return the least d with length ≤ s 2ᵈ, (P,)."""
        found = np.ceil(np.log2(np.maximum(length / self.s, TINY)))  # where nothing moves s is very large
        found += self.s * 2.0**found < length
        return np.asarray(np.maximum(found, _DEEPEST), dtype=np.int64)

    def turn(self, d: int) -> Array:
        """Return e^{F s 2ᵈ}."""
        if d not in self._turns:
            half = self.turn(d - 1) if d > 0 else None
            self._turns[d] = taylor(self._F * self.s * 2.0**d)[::-1, 0].sum(axis=0) if half is None else half @ half
        return np.asarray(self._turns[d])

    def reach(self, d: int) -> Array:
        """Return R, a bound on |e^{Fσ}| for all σ ≤ s 2ᵈ."""
        while len(self._reach) <= d:
            last, turn = self._reach[-1], np.abs(self.turn(len(self._reach) - 1))
            self._reach.append(np.maximum(last, OVER_SUMS * (last @ turn)))
        return np.asarray(self._reach[max(d, 0)])

    def terms(self, degree: int) -> Array:
        """Return r Fʲ for j up to the degree, and F to one more, side by side, (N, (degree + 1) q + N)."""
        if degree not in self._terms:
            powers = [self.rows]
            for _ in range(degree):
                powers.append(self._F.T @ powers[-1])
            self._terms[degree] = np.hstack([*powers, np.linalg.matrix_power(self._F.T, degree + 1)])
        return self._terms[degree]

    def bounds(self, d: int) -> Array:
        """Return |r| R |F|ʲ for j up to one more than the degree, R for all σ ≤ s 2ᵈ, side by side, (N, …)."""
        if d not in self._bounds:
            powers = [(np.abs(self.rows).T @ self.reach(d)).T]
            for _ in range(self.degree + 1):
                powers.append(np.abs(self._F.T) @ powers[-1])
            self._bounds[d] = OVER_SUMS * np.hstack(powers)
        return self._bounds[d]

    def polynomials(self, zeta: Array, length: Array, longest: int) -> tuple[Array, Array]:
        """Return the coefficients of powers of τ on pieces no longer than s 2^longest, and what signals are off them.

        Their shapes are (degree + 1, P, q) and (P, q).
        """
        q, degree = self.rows.shape[1], self.degree if longest < _STIFF else 1
        scale = np.array([length**j / factorial(j) for j in range(degree + 2)])[:, :, None]
        terms, bounds = zeta @ self.terms(degree), self.bounds(longest)
        powers = scale[:-1] * terms[:, : q * (degree + 1)].reshape(-1, degree + 1, q).swapaxes(0, 1)
        rest = scale[-1] * (np.abs(terms[:, q * (degree + 1) :]) @ bounds[:, :q])
        rounded = (np.abs(zeta) @ bounds[:, : q * (degree + 2)]).reshape(-1, degree + 2, q).swapaxes(0, 1)
        return powers, np.asarray(OVER_SUMS * (rest + self.u * (scale * rounded).sum(axis=0)))


class Spans(NamedTuple):
    """What signals are within on each segment, and the integrals of their squares and sizes at most, (M, q) each."""

    low: Array
    high: Array
    squares: Array
    areas: Array

    @property
    def most(self) -> Array:
        """How large signals are at most."""
        return np.maximum(np.abs(self.low), np.abs(self.high))

    @property
    def near(self) -> Array:
        """How near to 0 they come."""
        return np.maximum(np.maximum(self.low, -self.high), 0.0)

    @property
    def ends(self) -> tuple[Array, Array]:
        """Between what they are on all segments, (q,) each."""
        return self.low.min(axis=0), self.high.max(axis=0)

    def in_steps(self, at: IntArray) -> "Spans":
        """Return the same of steps: of each segment `at` is the number of its own, 0, 1, … in order, (M,)."""
        first = np.flatnonzero(np.diff(at, prepend=-1))
        squares, areas = np.zeros((2, len(first), self.low.shape[1]))
        np.add.at(squares, at, self.squares)
        np.add.at(areas, at, self.areas)
        return Spans(np.minimum.reduceat(self.low, first), np.maximum.reduceat(self.high, first), squares, areas)


def spans(block: Segments, rows: Rows) -> Spans:
    """Enclose r z on each segment of a block, for each of the rows (q, N), in one look.

    Sizes of Bernstein coefficients are those of a polynomial above |r z|, whose integral is their mean times the
    length; that of the square of the polynomial is known.
    """
    found = list[tuple[IntArray | Array, ...]]()
    for number, mode in enumerate(block.modes):
        here = np.flatnonzero(block.number == number)
        if not len(here):
            continue
        table = _Tables(block.F[number], block.reading(rows(mode)), _ONE_LOOK)
        length = np.maximum(block.length[here], TINY)
        powers, off = table.polynomials(block.zeta[here], length, int(table.levels(length).max()))
        control = np.tensordot(_BERNSTEIN[len(powers) - 1], powers, 1)
        mean, over = np.abs(control).mean(axis=0), OVER_SUMS * block.length[here, None]
        square = np.einsum("ipq,ij,jpq->pq", control, _squares(len(powers) - 1), control)
        square = np.maximum(square, 0.0) + (OVER_SUMS - 1) * mean**2
        squares, areas = square + 2 * off * mean + off**2, mean + off
        found.append((here, control.min(axis=0) - off, control.max(axis=0) + off, over * squares, over * areas))
    order = np.argsort(np.concatenate([here for here, *_ in found]))
    return Spans(*(np.concatenate(part)[order] for part in list(zip(*found, strict=True))[1:]))


class Enclosing:
    """Encloses signals block by block, given by rows on z in a mode, (q, N), or the norm of all of them together."""

    def __init__(self, rows: Rows, *, norm: bool = False) -> None:
        self._rows, self._norm, self._left = rows, norm, MOST_NUMBERS
        self._tables: dict[Mode, _Tables] = {}
        self._best = self._high = self._size = np.zeros(0)  # attained, bounds, sizes of each side: highs, then −lows
        self._seen = list[tuple[IntArray, Array, Array]]()  # the side of values that are near its best, they, and when
        self._step = 0.0  # the longest segment in s

    def see(self, block: Segments) -> None:
        """Take more of a trajectory into account."""
        if not len(block.t):
            return
        self._step = max(self._step, float(block.length.max()))
        order = np.argsort(block.number, kind="stable")
        edges = np.searchsorted(block.number[order], np.arange(len(block.modes) + 1))
        queue = list[tuple[_Tables, _Pieces]]()
        for number, mode in enumerate(block.modes):
            here = order[edges[number] : edges[number + 1]]
            if not len(here):
                continue
            if mode not in self._tables:
                self._tables[mode] = _Tables(block.F[number], block.reading(self._rows(mode)))
            table, pieces = self._tables[mode], _Pieces(block.t[here], block.zeta[here], block.length[here])
            self._attain(self._sides(pieces.zeta @ table.rows), pieces.t)
            queue += [(table, part) for part in _parts(table, pieces)]
        while queue:  # in turn, but where they are many the last ones first, so that they do not become more
            many = sum(part.zeta.size for _, part in queue) > TOGETHER
            table, pieces = queue.pop(-1 if many else 0)
            halves = self._narrowed(table, pieces)
            if halves is not None:
                queue += [(table, part) for part in _parts(table, halves)]
        side, values, t = map(np.concatenate, zip(*self._seen, strict=True))
        near = values >= self._least[side]
        self._seen = [(side[near], values[near], t[near])]

    def range(self) -> Range:
        """Return the bounds on all that was seen."""
        highs, times = np.maximum(self._high, self._best), np.zeros(len(self._best))
        side, seen, when = map(np.concatenate, zip(*self._seen, strict=True))
        for k in range(len(times)):
            near = (side == k) & (seen >= self._least[k])
            order = np.argsort(when[near], kind="stable")
            t, values = when[near][order], seen[near][order]
            first = int(np.append(np.flatnonzero(np.diff(t) > 2 * self._step), len(t) - 1)[0]) + 1
            top = values[:first].max()
            times[k] = t[np.argmax(values[:first] >= top - _FIRST * self._size[k])]
        inner, q = self._best, len(highs) // 2
        highs = highs if self._left >= 0 else np.full_like(highs, np.inf)
        if self._norm:  # from below there is 0
            inner, times, highs, q = *(np.append(part, 0.0) for part in (inner, times, highs)), 1
        inner, times = (np.column_stack([part[q:], part[:q]]) for part in (inner, times))
        inner[:, 0] *= -1
        return Range(low=-highs[q:], high=highs[:q], inner=inner, times=times)

    @property
    def _least(self) -> Array:
        """What is as good as the best, (sides,)."""
        return np.asarray(self._best - _SAME * self._size)

    def _sides(self, values: Array) -> Array:
        """Return of values (…, q) what is to be kept from above, (…, sides)."""
        if self._norm:
            return np.asarray(np.linalg.norm(values, axis=-1, keepdims=True))
        return np.concatenate([values, -values], axis=-1)

    def _attain(self, values: Array, t: Array) -> None:
        """Take note of values (P, sides) that are attained at times (P,) or (P, sides), or as good as that."""
        top = values.max(axis=0)
        if not len(self._best):
            self._best = self._high = np.full(values.shape[1], -np.inf)
        elif not (top >= self._least).any():
            return
        self._best = np.maximum(self._best, top)
        size = np.abs(self._best)
        self._size = size if self._norm else np.tile(size.reshape(2, -1).max(axis=0), 2)
        row, side = np.nonzero(values >= self._least)
        self._seen.append((side, values[row, side], t[row] if t.ndim == 1 else t[row, side]))

    def _narrowed(self, table: _Tables, pieces: _Pieces) -> _Pieces | None:
        """Bound the signals on some pieces, and return the halves of those that may be above the best, if any."""
        keep = pieces.length > 0
        t, zeta, length = (part[keep] for part in pieces)
        if not len(t) or self._left < 0:
            return None
        self._left -= len(t) * table.numbers
        levels = table.levels(length)
        with np.errstate(over="ignore", invalid="ignore"):
            powers, off = table.polynomials(zeta, length, int(levels.max()))
            control = np.tensordot(_BERNSTEIN[len(powers) - 1], powers, 1)  # (degree + 1, P, q)
            upper = self._sides(control).max(axis=0) + np.abs(self._sides(off))
            upper = np.where(np.isnan(upper), np.inf, upper)
            above = self._above(table, upper, zeta)
            if above.any():
                self._tops(powers[:, above], off[above], t[above], length[above])
                above[above] = self._above(table, upper[above], zeta[above])
        above &= levels > _DEEPEST
        if self._left < 0:
            above[:] = False
        self._high = np.maximum(self._high, upper[~above].max(axis=0, initial=-np.inf))
        if not above.any():
            return None
        t, zeta, length, levels = t[above], zeta[above], length[above], levels[above]
        half, middle = table.s * 2.0 ** (levels - 1), np.empty_like(zeta)
        for level in np.unique(levels).tolist():
            here = levels == level
            middle[here] = zeta[here] @ table.turn(level - 1).T
        pairs = (t, t + half), (zeta, middle), (np.minimum(length, half), length - half)
        return _Pieces(*map(np.concatenate, pairs))

    def _above(self, table: _Tables, upper: Array, zeta: Array) -> Any:
        """Return which pieces may be above the best by more than they need be, (P,)."""
        above = np.asarray((upper > self._best + CLOSE * self._size).any(axis=1))
        if above.any():  # not by noise alone
            noise = table.u * np.abs(zeta[above]) @ table.bounds(0)[:, : table.rows.shape[1]]
            above[above] = (upper[above] > self._best + _NOISE * np.abs(self._sides(noise))).any(axis=1)
        return above

    def _tops(self, powers: Array, off: Array, t: Array, length: Array) -> None:
        """Take note of what the polynomials attain at their ends and at their stationary points."""
        places = [np.ones_like(off)]
        if len(powers) > 2 and not self._norm:
            a, b, c = 3 * powers[3], 2 * powers[2], powers[1]
            half = -(b + np.copysign(np.sqrt(np.maximum(b * b - 4 * a * c, 0.0)), b)) / 2
            with np.errstate(divide="ignore"):
                places += [np.clip(np.nan_to_num(tau), 0.0, 1.0) for tau in (half / a, c / half)]
        for tau in places:
            values = np.zeros_like(off)
            for coefficient in powers[::-1]:
                values = values * tau + coefficient
            sides = self._sides(values) - np.abs(self._sides(off))
            sides[np.isnan(sides)] = -np.inf
            if (sides.max(axis=0) >= self._least).any():
                at = tau[:, :1] if self._norm else np.hstack([tau, tau])
                self._attain(sides, t[:, None] + at * length[:, None])


def _parts(table: _Tables, pieces: _Pieces) -> Iterator[_Pieces]:
    """Yield pieces, so many at a time as can be bounded together."""
    count = len(pieces.t)
    most = max(TOGETHER // table.numbers, 1)
    for k in range(0, count, most):
        yield _Pieces(*(part[k : k + most] for part in pieces)) if count > most else pieces


def bernstein(degree: int) -> Array:
    """Return what makes of power coefficients on [0, 1] those of Bernstein's form."""
    return np.array([[comb(i, j) / comb(degree, j) for j in range(degree + 1)] for i in range(degree + 1)])


def _squares(degree: int) -> Array:
    """Return the integrals over [0, 1] of products of Bernstein polynomials."""
    k = range(degree + 1)
    return np.array([[comb(degree, i) * comb(degree, j) / comb(2 * degree, i + j) for j in k] for i in k]) / (
        2 * degree + 1
    )


_BERNSTEIN = {degree: bernstein(degree) for degree in (1, _DEGREE, _ONE_LOOK)}
