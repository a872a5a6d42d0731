"""Bounds on signals along a walked trajectory, at all times and not at samples alone.

Between two breaks a signal is r ζ(σ) with ζ' = F ζ, a sum of p(σ) e^{λσ}. On a piece of length ℓ, with τ = σ/ℓ,

    r ζ = Σ_{j ≤ k} r T_j τʲ + ρ,   T_j = (F ℓ)ʲ ζ(0) / j!,   |ρ| ≤ |r| R |T_{k+1}|,   R ≥ sup_{σ ≤ ℓ} |e^{Fσ}|,

Taylor's theorem with its remainder, entry by entry. The Bernstein coefficients of the polynomial enclose it, and for
several rows together the curve is in the convex hull of its control points, so that no norm is above the largest of
theirs. What arithmetic may be off by is added. T_{k+1} has the signs of ζ: where what is fast has decayed it is small,
however long the piece. R is known for lengths s 2ᵈ by doubling, R(2s) = max(R(s), R(s) |e^{Fs}|).

Only pieces whose bound is above the largest value that is surely attained, by more than 1e-6 of the signal's size, are
split, at a length s 2ᵈ where e^{Fs} is known (branch and bound); all pieces of a mode at once.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from math import comb

import numpy as np

from pwatrack.arrays import TINY, Array, IntArray, balancing
from pwatrack.simulation.flow import Flow, Mode
from pwatrack.simulation.tables import taylor, unit
from pwatrack.simulation.trace import Trace

CLOSE = 1e-6  # of the size of a signal: what is said is at most so much above what is attained
_SHORT = 0.5  # ‖F s‖ for the length s from which on there is doubling
_DEGREE = 3  # of the polynomial: of a higher one rounding grows faster with the length than it gains
_STIFF = 9  # doublings of s from which on a chord is better: ε ‖F ℓ‖⁴ / 4! is above 1e-7
_DEEPEST = -80  # halvings of s: by then any step is below the rounding of time
_MOST_PIECES = 3_000_000  # of a call: after half a minute what is said stays true but is less close
_OUTWARD = 1 + 1e-12  # covers the rounding of a sum of positive terms
_NOISE = 8  # times what rounding is: bounds that are closer cannot be told apart

Rows = Callable[[Mode], Array]


@dataclass(frozen=True, kw_only=True)
class Segments:
    """M stretches of time on each of which ζ' = F[number] ζ.

    Attributes:
        modes: The D modes that occur.
        F: Their matrices, (D, N, N).
        number: Which of them each segment has, (M,).
        t: When it begins, in s, (M,).
        zeta: From where, (M, N).
        length: In s; 0 stands for a single point, (M,).
        reading: Makes of rows on z rows on ζ.
    """

    modes: tuple[Mode, ...]
    F: Array
    number: IntArray
    t: Array
    zeta: Array
    length: Array
    reading: Callable[[Array], Array] = field(default=np.asarray)

    @staticmethod
    def of(flow: Flow, trace: Trace) -> "Segments":
        """Return what was walked: from each sample and each break to the next, jumps and all, from both sides.

        Args:
            flow: What was walked.
            trace: One block of it, as `trace_blocks` or `simulate_flow` give it, with its breaks.
        """
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
        changed = {name: getattr(self, name)[keep] for name in ("number", "t", "zeta", "length")}
        return replace(self, **changed)


@dataclass(frozen=True, kw_only=True)
class Range:
    """What signals are within.

    Attributes:
        low, high: Bounds, at most 1e-6 of the largest |signal| off, (q,).
        inner: A value near each that is attained, (q, 2); where the work ran out the distance says how close they are.
        times: When that is, in s, (q, 2); of peaks that differ by less than 1e-6 of that the first one.
    """

    low: Array
    high: Array
    inner: Array
    times: Array


def enclosed(blocks: Iterable[Segments], rows: Rows) -> Range:
    """Return what r z(t) is within, for each of some rows.

    Args:
        blocks: All that was walked.
        rows: Rows on z in a mode, (q, N).

    Example: 2 sin(t) − 0.2 from t = 0 to 10 with a sample in each second, on none of which it is extreme.

        >>> from pwatrack.simulation.flow import SwitchedPart
        >>> from pwatrack.simulation.propagate import trace_blocks
        >>> one = SwitchedPart(name="all", cells=("R",), guards=np.zeros((0, 3)), signs=np.zeros((1, 0), dtype=int),
        ...     F=np.zeros((1, 3, 3)))
        >>> flow = Flow(F0=np.array([[0, 1.0, 0], [-1.0, 0, 0], [0, 0, 0]]), parts=(one,))
        >>> walked = trace_blocks(flow, np.array([0, 2.0, 1.0]), duration=10.0, sample_time=1.0, most=4)
        >>> found = enclosed((Segments.of(flow, trace) for trace in walked), lambda mode: np.array([[1.0, 0.0, -0.2]]))
        >>> bool(-2.200003 < found.low[0] <= -2.2 and 1.8 <= found.high[0] < 1.800003), (found.times / np.pi).round(3)
        (True, array([[1.5, 0.5]]))
    """
    enclosing = Enclosing(rows)
    for block in blocks:
        enclosing.see(block)
    return enclosing.range()


def largest_norm(blocks: Iterable[Segments], rows: Rows) -> Range:
    """Return the largest ‖r z(t)‖, r being (q, N), as `high` of a range of one signal; `low` is 0."""
    enclosing = Enclosing(rows, norm=True)
    for block in blocks:
        enclosing.see(block)
    return enclosing.range()


@dataclass(frozen=True, kw_only=True)
class _Pieces:
    """P pieces in one mode, none longer than s 2^level."""

    t: Array
    zeta: Array
    length: Array


class _Tables:
    """What is known of a mode."""

    def __init__(self, F: Array, rows: Array) -> None:
        d = balancing(F[None])
        norm = max(float(np.linalg.norm(F / d[:, None] * d)), TINY)
        self.F, self.rows, self.u = F.T, rows.T, unit(len(F))
        self.s = 2.0 ** np.floor(np.log2(_SHORT / norm))
        terms = taylor(F * self.s)
        self._turns = {0: terms[::-1, 0].sum(axis=0)}
        self._reach = [_OUTWARD * terms[::-1, 1].sum(axis=0)]

    def level(self, length: Array) -> IntArray:
        """Return the least d with length ≤ s 2ᵈ, (P,)."""
        with np.errstate(divide="ignore"):
            found = np.ceil(np.log2(length / self.s))
        found = np.where(self.s * 2.0**found < length, found + 1, found)
        return np.asarray(np.maximum(found, _DEEPEST), dtype=np.int64)

    def turn(self, d: int) -> Array:
        """Return e^{F s 2ᵈ}."""
        if d not in self._turns:
            half = self.turn(d - 1) if d > 0 else None
            self._turns[d] = taylor(self.F.T * self.s * 2.0**d)[::-1, 0].sum(axis=0) if half is None else half @ half
        return np.asarray(self._turns[d])

    def reach(self, d: int) -> Array:
        """Return a bound on |r| |e^{Fσ}| for all σ ≤ s 2ᵈ, transposed, (N, q)."""
        while len(self._reach) <= d:
            last, turn = self._reach[-1], np.abs(self.turn(len(self._reach) - 1))
            self._reach.append(np.maximum(last, _OUTWARD * (last @ turn)))
        return np.asarray((np.abs(self.rows).T @ self._reach[max(d, 0)]).T)


class Enclosing:
    """Encloses signals block by block.

    Args:
        rows: Rows on z in a mode, (q, N).
        norm: Whether of all of them together the norm is meant.
    """

    def __init__(self, rows: Rows, *, norm: bool = False) -> None:
        self._rows, self._norm, self._left = rows, norm, _MOST_PIECES
        self._tables: dict[Mode, _Tables] = {}
        self._best = self._high = np.zeros(0)  # what is attained, and the bound, of each side: highs, then −lows
        self._seen = list[tuple[Array, Array]]()  # values near the best, −inf elsewhere, (P, sides), and when, (P,)
        self._step = 0.0  # the longest segment in s

    def see(self, block: Segments) -> None:
        """Take more of a trajectory into account."""
        if not len(block.t):
            return
        queue = dict[tuple[int, int], list[_Pieces]]()
        for number, mode in enumerate(block.modes):
            here = np.flatnonzero(block.number == number)
            if not len(here):
                continue
            if mode not in self._tables:
                self._tables[mode] = _Tables(block.F[number], block.reading(self._rows(mode)))
            table = self._tables[mode]
            self._attain(self._sides(block.zeta[here] @ table.rows), block.t[here])
            self._queue(
                queue, number, table, _Pieces(t=block.t[here], zeta=block.zeta[here], length=block.length[here])
            )
        self._step = max(self._step, float(block.length.max(initial=0.0)))
        while queue:
            following = dict[tuple[int, int], list[_Pieces]]()
            for (number, level), parts in queue.items():
                table = self._tables[block.modes[number]]
                for rest in self._narrowed(table, level, _joined(parts)):
                    self._queue(following, number, table, rest)
            queue = following
        self._forget()

    def range(self) -> Range:
        """Return the bounds on all that was seen."""
        highs, times = np.maximum(self._high, self._best), np.zeros(len(self._best))
        for k in range(len(times)):
            values = np.concatenate([v[:, k] for v, _ in self._seen])
            t = np.concatenate([at for _, at in self._seen])
            order = np.argsort(t[values >= self._least[k]], kind="stable")
            t, values = t[values >= self._least[k]][order], values[values >= self._least[k]][order]
            first = int(np.append(np.flatnonzero(np.diff(t) > 2 * self._step), len(t) - 1)[0]) + 1
            top = values[:first].max()
            times[k] = t[np.argmax(values[:first] >= top - 1e-12 * abs(top))]
        if self._norm:
            return Range(low=np.zeros(1), high=highs, inner=np.array([[0.0, *self._best]]), times=times[[0, 0]][None])
        q = len(highs) // 2
        inner, when = (np.column_stack([part[q:], part[:q]]) for part in (self._best, times))
        inner[:, 0] *= -1
        return Range(low=-highs[q:], high=highs[:q], inner=inner, times=when)

    @property
    def _tolerance(self) -> Array:
        """How close a bound must be, (sides,)."""
        size = np.abs(self._best)
        return CLOSE * (size if self._norm else np.tile(size.reshape(2, -1).max(axis=0), 2))

    @property
    def _least(self) -> Array:
        return self._best - self._tolerance

    def _sides(self, values: Array) -> Array:
        """Return of values (…, q) what is to be kept from above, (…, sides)."""
        if self._norm:
            return np.asarray(np.linalg.norm(values, axis=-1, keepdims=True))
        return np.concatenate([values, -values], axis=-1)

    def _spread(self, off: Array) -> Array:
        """Return by how much that can rise where the values change by at most so much."""
        return (
            np.asarray(np.linalg.norm(off, axis=-1, keepdims=True))
            if self._norm
            else np.concatenate([off, off], axis=-1)
        )

    def _attain(self, values: Array, t: Array) -> None:
        """Take note of values (P, sides) that are attained, or as good as that."""
        top = values.max(axis=0, initial=-np.inf)
        if not len(self._best):
            self._best = self._high = np.full(values.shape[1], -np.inf)
        self._best = np.maximum(self._best, top)
        with np.errstate(invalid="ignore"):
            near = (values >= self._least).any(axis=1)
        self._seen.append((values[near], t[near]))

    def _forget(self) -> None:
        """Drop values that have turned out to be smaller than the best."""
        values, t = (np.concatenate(part) for part in zip(*self._seen, strict=True))
        near = (values >= self._least).any(axis=1)
        self._seen = [(values[near], t[near])]

    def _queue(self, queue: dict[tuple[int, int], list[_Pieces]], number: int, table: _Tables, pieces: _Pieces) -> None:
        levels = table.level(pieces.length)
        for level in np.unique(levels).tolist():
            here = (levels == level) & (pieces.length > 0)
            if here.any():
                part = _Pieces(t=pieces.t[here], zeta=pieces.zeta[here], length=pieces.length[here])
                queue.setdefault((number, level), []).append(part)

    def _narrowed(self, table: _Tables, level: int, pieces: _Pieces) -> Iterator[_Pieces]:
        """Bound the signals on pieces of a level, and yield the halves of those that may be above the best."""
        degree, lengths = _DEGREE if level < _STIFF else 1, pieces.length[:, None]
        with np.errstate(over="ignore", invalid="ignore"):
            term, size, total = pieces.zeta, np.abs(pieces.zeta), np.abs(pieces.zeta)
            power = [term @ table.rows]
            for j in range(1, degree + 2):
                term, size = term @ table.F * (lengths / j), size @ np.abs(table.F) * (lengths / j)
                total = total + size
                if j <= degree:
                    power.append(term @ table.rows)
            off = _OUTWARD * ((np.abs(term) + table.u * total) @ table.reach(level))
            powers = np.array(power)
            control = np.tensordot(_BERNSTEIN[degree], powers, 1)  # (degree + 1, P, q)
            upper = self._sides(control).max(axis=0) + self._spread(off)
            upper = np.where(np.isnan(upper), np.inf, upper)
            self._tops(powers, off, pieces)
            noise = _NOISE * self._spread(table.u * np.abs(pieces.zeta) @ table.reach(0))
            above = np.asarray(np.any(upper > self._best + np.maximum(self._tolerance, noise), axis=1))
        self._left -= len(above)
        if self._left < 0 or level <= _DEEPEST:
            above[:] = False
        self._high = np.maximum(self._high, upper[~above].max(axis=0, initial=-np.inf))
        if above.any():
            half = table.s * 2.0 ** (level - 1)
            t, zeta, length = pieces.t[above], pieces.zeta[above], pieces.length[above]
            yield _Pieces(t=t, zeta=zeta, length=np.minimum(length, half))
            yield _Pieces(t=t + half, zeta=zeta @ table.turn(level - 1).T, length=length - half)

    def _tops(self, powers: Array, off: Array, pieces: _Pieces) -> None:
        """Take note of what the polynomials attain at their ends and at their stationary points."""
        places = [np.ones_like(off)]
        if len(powers) > 2 and not self._norm:
            a, b, c = 3 * powers[3], 2 * powers[2], powers[1]
            root = np.sqrt(np.maximum(b * b - 4 * a * c, 0.0))
            half = -(b + np.copysign(root, b)) / 2
            with np.errstate(divide="ignore"):
                places += [np.clip(np.nan_to_num(tau), 0.0, 1.0) for tau in (half / a, c / half)]
        for tau in places:
            values = np.zeros_like(off)
            for coefficient in powers[::-1]:
                values = values * tau + coefficient
            sides = self._sides(values) - self._spread(off)
            sides[np.isnan(sides)] = -np.inf
            top = sides.max(axis=0)
            if (top >= self._least).any():
                when = pieces.t[:, None] + tau * pieces.length[:, None]
                for k in range(1 if self._norm else off.shape[1]):
                    only = np.full_like(sides, -np.inf)
                    columns = [0] if self._norm else [k, k + off.shape[1]]
                    only[:, columns] = sides[:, columns]
                    self._attain(only, when[:, k])


def _joined(parts: list[_Pieces]) -> _Pieces:
    if len(parts) == 1:
        return parts[0]
    return _Pieces(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in ("t", "zeta", "length")})


def bernstein(degree: int) -> Array:
    """Return what makes of power coefficients on [0, 1] those of Bernstein's form."""
    return np.array([[comb(i, j) / comb(degree, j) for j in range(degree + 1)] for i in range(degree + 1)])


_BERNSTEIN = {degree: bernstein(degree) for degree in (1, _DEGREE)}
