"""A curve in polynomials: its cells, how well it satisfies η' = A_i η + B_i (w, 1) there, how it is played back.

On each stretch of time η is a polynomial and w' = S w turns so little that its Taylor polynomial is exact to rounding.
So guards and residuals are polynomials, whose Bernstein coefficients enclose them. What w, arithmetic and Taylor's
remainder may be off by is added. A stretch on which a guard may have either sign is halved, until it has one, or is so
short that its ends are one time in floating point, or the guard is within rounding of 0 on all of it: there x_d may be
in either cell, and the residual is enclosed in both. No stay beyond a facet is missed, however short.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb, factorial
from typing import Any, TypeVar

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev
from numpy.typing import NDArray

from pwatrack.arrays import CLOSE, EPS, Array, IntArray, alike
from pwatrack.control.trajectory import DesiredTrajectory, NoncausalTrajectory
from pwatrack.errors import Undecided
from pwatrack.model.reference import Exosystem, exosystem
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.simulation.enclosure import bernstein

DEGREE = 9  # of the polynomials that are played back
_MOST_TURN = 1.0  # |rate| times length of a stretch: so short that the Taylor polynomial below is exact
_TAYLOR = 20  # of the Taylor polynomials: 1 / 21! is 2e-20, and 2^10.5 / 21! for what is damped as fast as it turns
_UNIT = (_TAYLOR + 4) * EPS  # of the sum of the sizes of all terms: what a coefficient may be off by
_NEAR = 1e-6  # of its size: what two processors may make of a bounded solution, and more
_GRAZING = 4.0  # times what a guard may be off by: if it is nowhere larger it may be halved for ever
_SHARP, _DEEP = 1.25, 6  # a residual that is said is at most so many times one attained, after so many halvings
_MOST = 4_000_000  # stretches in all
_AT_ONCE = 2**21  # numbers in an array of coefficients
_INSTANT = 1e-9  # of a piece: a shorter stay beyond a facet adds nothing that a simulation could show
_TO_BERNSTEIN = bernstein(_TAYLOR)
_LEFT = np.array([[comb(k, j) / 2.0**k for j in range(_TAYLOR + 1)] for k in range(_TAYLOR + 1)])  # half, likewise
_RIGHT = _LEFT[::-1, ::-1]
_Stretches = TypeVar("_Stretches", "Pieces", "Looked")


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """N polynomials η = Σ c_k τᵏ, τ the time since their starts."""

    start: Array  # in s, (N,)
    length: Array  # in s
    c: Array  # (N, p, K)
    of: IntArray  # the stay that each is in, or the piece that it is cut from

    def at(self, t: Array) -> Array:
        """Return η at times in s, (T, p)."""
        k = np.maximum(np.searchsorted(self.start, t, side="right") - 1, 0)
        powers = (t - self.start[k])[:, None] ** np.arange(self.c.shape[2])
        return np.asarray(np.einsum("tpj,tj->tp", self.c[k], powers))

    def is_near(self, other: "Pieces", units: Array) -> bool:
        """Say whether two curves of one equation are one: what grows, forward or backward, is seen at its ends.

        What is small in `units` in which the η are alike, (p,), beside the others is rounding of these.
        """
        if self.c.shape[1] != other.c.shape[1]:
            return False
        t = np.concatenate([self.start, self.start + self.length / 2, other.start, self.start[-1:] + self.length[-1:]])
        here, there = self.at(t), other.at(t)
        sizes = np.abs(here).max(axis=0)
        return bool((np.abs(here - there) <= _NEAR * np.maximum(sizes, CLOSE * units * (sizes / units).max())).all())

    def is_one_with(self, other: "Pieces") -> bool:
        """Say whether they are the same, but for rounding of their numbers in a file."""
        pairs = (self.start, other.start), (self.c, other.c)
        return all(one.shape == two.shape and np.allclose(one, two, rtol=4 * EPS, atol=0) for one, two in pairs)

    def cut(self, fastest: float) -> "Pieces":
        """Return pieces so short that nothing of such a rate turns much on them; `of` is the piece each is from."""
        count = np.maximum(1, np.ceil(self.length * fastest / _MOST_TURN)).astype(np.int64)
        of = np.repeat(np.arange(len(count)), count)
        length = self.length[of] / count[of]
        since = (np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)) * length
        c, moved = self.c[of].astype(np.longdouble), np.array(since, dtype=np.longdouble)[:, None]
        for k in range(c.shape[2] - 1):  # Horner's rule for each derivative
            for j in range(c.shape[2] - 2, k - 1, -1):
                c[:, :, j] += moved * c[:, :, j + 1]
        return Pieces(start=self.start[of] + since, length=length, c=c.astype(np.float64), of=of)


@dataclass(frozen=True, kw_only=True)
class Looked:
    """Stretches in order of time on each of which the cell of x_d is known, or cannot be told from others."""

    start: Array  # in s, (M,)
    length: Array  # in s
    of: IntArray  # the number of the polynomial that each is part of
    possible: NDArray[np.bool_]  # which cells x_d may be in, (M, l)
    ends: Array  # η' − A_i η − B_i (w, 1) at both ends, (M, 2, l, p)
    residual: Array  # above its size in all cells that are possible, (M, p)

    def cells(self) -> IntArray:
        """Return one cell for each, (M,): that of before where there are several."""
        sure = self.possible.sum(axis=1) == 1
        last = np.maximum.accumulate(np.where(sure, np.arange(len(sure)), -1))
        last = np.where(last < 0, np.argmax(sure), last)
        return np.asarray(self.possible[last].argmax(axis=1), dtype=np.int64)


def joined(parts: Sequence[_Stretches]) -> _Stretches:
    """Return all stretches of some parts as one, in order of time."""
    kind = type(parts[0])
    found = {name: np.concatenate([getattr(part, name) for part in parts]) for name in kind.__annotations__}
    order = np.argsort(found["start"], kind="stable")
    return kind(**{name: values[order] for name, values in found.items()})


def look(trajectory: DesiredTrajectory, curve: Pieces, w: Array, off: Array, *, sharp: bool) -> Looked:
    """Return where x_d is in which cell, and how well η satisfies (15) there, if sharp enclosed closely.

    It is made of polynomials that are cut short, of w at their starts, and what that may be off by, (N, s). Refused
    as undecided if there are too many crossings.
    """
    cells, p, columns = trajectory.rate.shape
    step = max(1, _AT_ONCE // ((_TAYLOR + 1) * (cells * p + len(trajectory.guards) + columns)))
    attained = np.zeros(p)
    found = [
        part
        for first in range(0, len(curve.start), step)
        for part in _halved(trajectory, curve, w, off, slice(first, first + step), attained, sharp=sharp)
    ]
    return joined(found)


def _halved(
    trajectory: DesiredTrajectory, curve: Pieces, w: Array, off: Array, at: slice, attained: Array, *, sharp: bool
) -> list[Looked]:
    """Return stretches that need not be halved any more; what is attained is noted."""
    start, length, of = curve.start[at], curve.length[at], np.arange(len(curve.start))[at]
    b, slack = _coefficients(trajectory, length, curve.c[at], w[at], off[at])
    found, depth, total = list[Looked](), 0, 0
    shape, G = (-1, *trajectory.rate.shape[:2]), len(trajectory.guards)
    while len(start):
        guards, most = b[:, :G], np.abs(b).max(axis=2) + slack
        low, high = guards.min(axis=2) - slack[:, :G], guards.max(axis=2) + slack[:, :G]
        signs = trajectory.signs
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
            raise Undecided("x_d crosses facets too often to be followed")
        half = length[open_] / 2
        start = np.concatenate([start[open_], start[open_] + half])
        length, of, depth = np.tile(half, 2), np.tile(of[open_], 2), depth + 1
        slack = np.tile(slack[open_] + _TAYLOR * EPS * np.abs(b[open_]).max(axis=2, initial=0.0), (2, 1))
        b = np.concatenate([b[open_] @ _LEFT.T, b[open_] @ _RIGHT.T])
    return found


def _coefficients(trajectory: DesiredTrajectory, h: Array, c: Array, w: Array, off: Array) -> tuple[Array, Array]:
    """Return Bernstein coefficients of guards and residuals, (N, G + l p, degree + 1), and what they may be off by.

    Both are sums of terms that are known order by order, in powers of time over length.
    """
    S, rate = trajectory.exosystem.S, trajectory.rate.reshape(-1, trajectory.rate.shape[2])
    rows, p = np.vstack([trajectory.guards, -rate]), c.shape[1]
    G, size, turn = len(trajectory.guards), np.abs(rows), np.abs(S)
    powers, slack = np.zeros((len(h), len(rows), _TAYLOR + 1)), np.zeros((len(h), len(rows)))
    most, wide = np.abs(w), off
    of_w = slice(p, p + w.shape[1])
    for k in range(2 * _TAYLOR):
        if k <= _TAYLOR:
            powers[:, :, k] = w @ rows[:, of_w].T
            slack += (_UNIT * most + wide) @ size[:, of_w].T
        else:  # the remainder: its terms fall faster than by halves from here on
            slack += 2 * most @ size[:, of_w].T
        scale = (h / (k + 1))[:, None]
        w, most, wide = scale * (w @ S.T), scale * (most @ turn.T), scale * (wide @ turn.T)
    powers[:, :, 0] += rows[:, -1]
    slack += _UNIT * size[:, -1]
    for k in range(c.shape[2]):
        part = c[:, :, k] * h[:, None] ** k
        powers[:, :, k] += part @ rows[:, :p].T
        slack += _UNIT * np.abs(part) @ size[:, :p].T
        if k:  # and those of η'
            slope = np.tile(k * c[:, :, k] * h[:, None] ** (k - 1), (1, len(trajectory.rate)))
            powers[:, G:, k - 1] += slope
            slack[:, G:] += _UNIT * np.abs(slope)
    return powers @ _TO_BERNSTEIN.T, slack


_NODES = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
_BETWEEN = np.cos(np.pi * np.arange(DEGREE + 2) / (DEGREE + 1))
POINTS = (1 + np.concatenate([_NODES, _BETWEEN])) / 2  # Chebyshev points of [0, 1], and behind them some between them
_SERIES = np.linalg.inv(chebyshev.chebvander(_NODES, DEGREE))  # from values to a Chebyshev series
_OTHERS = chebyshev.chebvander(_BETWEEN, DEGREE)
_SHIFTED = [Chebyshev.basis(k, domain=[0, 1]).convert(kind=Polynomial).coef for k in range(DEGREE + 1)]
_POWERS = np.array([np.pad(c, (0, DEGREE + 1 - len(c))) for c in _SHIFTED]).T


def fitted(seen: Array, span: Array) -> tuple[Array, Array]:
    """Return polynomials through the first of the values at all points, (N, points, p), and what they miss of others.

    Their coefficients are of powers of the time since the left end of spans (N,), (N, p, DEGREE + 1).
    """
    known, others = seen[:, : DEGREE + 1], seen[:, DEGREE + 1 :]
    return _through(known, span), np.asarray(np.abs(_OTHERS @ (_SERIES @ known) - others).max(axis=(1, 2)))


def _through(known: Array, span: Array) -> Array:
    powers = (_POWERS @ (_SERIES @ known)).transpose(0, 2, 1)
    return np.asarray(powers / span[:, None, None] ** np.arange(DEGREE + 1))


def is_of(told: Mapping[str, Any], system: Exosystem) -> bool:
    """Say whether the reference of a trajectory, as controller.json has it, is one of `system` and what is played back.

    ValueError if it is none at all.
    """
    s, S, w0 = len(system.w0), *(np.array(told[name], dtype=np.float64) for name in ("S", "w0"))
    known = [[piece["t"], piece["start"], *piece["w"]] for piece in told["pieces"] if piece["start"] < s]
    own = [
        [t, one.where.start, *w]
        for one in system.resets
        for t, w in zip(one.t.tolist(), one.values.tolist(), strict=True)
    ]
    there, here = (np.array([number for piece in sorted(each) for number in piece]) for each in (known, own))
    pairs = (S[:s, :s], system.S), (w0[:s], system.w0), (there, here)
    return all(alike(one, other, together=True) for one, other in pairs)


def told_pieces(told: Mapping[str, Any], first: int, turn: float | None, until: float) -> Pieces:
    """Return the polynomials of one turn of a curve that is played back, as controller.json has it; ValueError if none.

    Args:
        told: Its reference: that of the trajectory, with so many states `first`, and behind it a chain for each η.
        first: As said.
        turn: After how long, in s, it repeats; None if it does not.
        until: When it ends then, in s.
    """
    try:
        return _told(told, first, turn, until)
    except (IndexError, StopIteration, KeyError, TypeError) as error:
        raise ValueError("what is told to be played back is no curve in polynomials") from error


def _told(told: Mapping[str, Any], first: int, turn: float | None, until: float) -> Pieces:
    S, Q, w0 = (np.array(told[name], dtype=np.float64) for name in ("S", "Q", "w0"))
    rows = [np.flatnonzero(row) for row in Q if not row[:first].any()]
    times = np.append(0.0, sorted({piece["t"] for piece in told["pieces"] if piece["start"] >= first}))
    times = times if turn is None else times[times < turn]
    c = np.zeros((len(times), len(rows), DEGREE + 1))
    for k, row in enumerate(rows):
        for at in row[:1].tolist():  # none of one that is 0
            terms = next(j for j in range(1, len(w0) + 1) if at + j == len(w0) or not S[at + j - 1, at + j])
            values = [w0[at:], *(np.array(piece["w"]) for piece in told["pieces"] if piece["start"] == at)]
            powers = np.array([float(factorial(j)) for j in range(terms)])
            c[:, k, :terms] = [v[:terms].reshape(terms) / powers for v in values[: len(times)]]
    length = np.diff(np.append(times, until if turn is None else turn))
    if not (length > 0).all():
        raise ValueError("what is told to be played back has pieces beyond its end")
    return Pieces(start=times, length=length, c=c, of=np.zeros(len(times), dtype=np.int64))


def played(
    trajectory: DesiredTrajectory, pieces: Pieces, turns: int, period: float
) -> tuple[tuple[Signal, ...], NoncausalTrajectory]:
    """Return pieces as they are played back, some turns of them, in units given, one signal per η, and their measures.

    In which cells x_d is on them is looked for in one turn, and how well (15) is satisfied in the worst one.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    start = np.concatenate([k * period + pieces.start for k in range(turns)])
    cut = pieces.cut(float(np.abs(system.rates).max(initial=0.0)))
    w = system.states(cut.start.astype(np.longdouble))  # in extended precision, as all below
    off = np.zeros(w.shape)
    for k in range(turns):
        begin = (k * period + pieces.start)[cut.of] + (cut.start - pieces.start[cut.of]).astype(np.longdouble)
        true = system.states(begin)
        phase = np.multiply.outer(np.abs(begin), np.abs(system.rates)) * np.finfo(np.longdouble).eps
        apart = np.abs(true - w) + EPS * np.abs(true) + phase * np.abs(true).max(initial=0.0)
        off = np.maximum(off, apart.astype(np.float64))
    looked = look(trajectory, cut, w.astype(np.float64), off, sharp=True)
    z = np.hstack([cut.c[:, :, 0], w.astype(np.float64), np.ones((len(cut.c), 1))])
    cells = looked.cells()[np.searchsorted(looked.start, cut.start)]
    ends = (pieces.c * pieces.length[:, None, None] ** np.arange(pieces.c.shape[2])).sum(axis=2)
    return tuple(_signal(start, np.tile(pieces.c[:, k], (turns, 1))) for k in range(p)), NoncausalTrajectory(
        names=trajectory.names,
        residual=looked.residual.max(axis=0),
        terms=np.einsum("nps,ns->np", np.abs(trajectory.rate[cells]), np.abs(z)).max(axis=0),
        left=_left(trajectory, pieces, cut, looked, turns, period),
        times=start[1:],
        jumps=np.abs(np.roll(pieces.c[:, :, 0], -1, axis=0) - ends)[np.arange(len(start) - 1) % len(ends)],
        lead=None,
    )


def _signal(starts: Array, c: Array) -> Signal:
    return Signal(tuple(starts.tolist()), tuple(ExponentialPolynomial.polynomial(row) for row in c))


def _left(
    trajectory: DesiredTrajectory, pieces: Pieces, cut: Pieces, looked: Looked, turns: int, period: float
) -> Exosystem:
    """Return ρ = η' − (15) over time, in polynomials between the times at which x_d changes its cell or polynomial.

    It is a difference of large terms, so it is taken with more digits, at Chebyshev points.
    """
    system, cells = trajectory.exosystem, looked.cells()
    piece = cut.of[looked.of]
    long = looked.length > _INSTANT * pieces.length[piece]
    cells, piece, begin = cells[long], piece[long], looked.start[long]
    new = np.append(True, (np.diff(cells) != 0) | (np.diff(piece) != 0))
    cells, piece, begin = cells[new], piece[new], begin[new]
    since = np.where(np.append(True, np.diff(piece) != 0), 0.0, begin - pieces.start[piece])
    until = np.append(since[1:], 0.0)
    until = np.where(np.append(np.diff(piece) != 0, True), pieces.length[piece], until)
    half = (until - since) / 2  # where a polynomial of the next degree is nearly one of this
    since, piece, cells, half = (np.repeat(v, 2) for v in (since, piece, cells, half))
    since[1::2] += half[1::2]
    tau = since[:, None].astype(np.longdouble) + half[:, None] * POINTS[: DEGREE + 1]
    eta = slope = np.zeros((*tau.shape, pieces.c.shape[1]), dtype=np.longdouble)
    for c in pieces.c[piece].transpose(2, 0, 1)[::-1]:  # Horner's rule
        slope, eta = slope * tau[:, :, None] + eta, eta * tau[:, :, None] + c[:, None]
    starts, found = [], []
    for k in range(turns):
        begin = k * period + pieces.start
        t = begin[piece, None] + tau
        w = system.states(t.ravel()).reshape(*t.shape, -1)
        z = np.concatenate([eta, w, np.ones((*t.shape, 1))], axis=2)
        rho = slope - np.einsum("nps,nts->ntp", trajectory.rate[cells], z)
        found.append(_through(rho.astype(np.float64), half))
        starts.append(begin[piece] + since)
    all_ = np.concatenate(found)
    return exosystem([_signal(np.concatenate(starts), all_[:, k]) for k in range(all_.shape[1])])
