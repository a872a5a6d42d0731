"""The bounded solution of internal dynamics with unstable modes: what a controller plays back that knows the reference.

η' = A_i η + B_i (w, 1) in the cell of x_d, driven by an exosystem, has exactly one bounded solution where (17±) holds:
one P = Pᵀ of any sign with P A_i + A_iᵀ P ≺ 0 in all cells makes the difference of two solutions an exponential
dichotomy (Coppel, Dichotomies in Stability Theory, 1978, lecture 7). Run forward, it would be lost at once. Here it is
the solution of a two-point problem: between the times at which x_d crosses a facet or the reference has a new piece, a
stay, the stable part of η runs forward from the left end and the unstable part backward from the right end,

    s(t) = E_s(t − a) s(a) + F_s(t − a) w(a),    u(t) = E_u(b − t) u(b) + F_u(b − t) w(b),

so that nothing grows, however fast a mode or long a stay is. What joins the stays is linear; their times follow by
Newton's method, whose derivative has no terms for them, as the field is continuous.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy  # whose parts are imported where they are used
from numpy.polynomial import Chebyshev, Polynomial, chebyshev

from pwatrack.arrays import EPS, Array, IntArray, balancing
from pwatrack.causes import Part
from pwatrack.control.trajectory import DesiredTrajectory, Preview
from pwatrack.errors import Problem, Undecided
from pwatrack.model.reference import beside
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.simulation.driven import Modes, Turns

_SETTLED = 40.0  # time constants of the slowest mode after which nothing is left of an end: e^-40 = 4e-18
_MISSED = 1e-12  # of the largest rate: what a stay in the wrong cell may be off by
_MOST_STEPS = 30  # of Newton's method, from one guess
_FINEST = 2.0**-10  # part of the way from a linear system to what is asked, in which that must settle
_DEGREE = 9  # of the polynomials that are played back
_FITTED, _NOISE = 1e-14, 1e-13  # of the largest value: how near they are, and what may be rounding
_LEFT = 1e-3  # of the way that an η goes: by more than that it has left its rest
_RESOLVED = 0.5  # of the fastest time constant: over so short a time such a polynomial is exact but for rounding
_SHORT = 2.0**-6  # of that time: over so short a one a Taylor polynomial is exact
_MOST_POINTS = 2_000_000  # at which cells are looked up


def bounded_solution(trajectory: DesiredTrajectory, duration: float) -> tuple[tuple[Signal, ...], Preview]:
    """Return the bounded solution of the internal dynamics from t = 0 on, in pieces that are polynomials.

    A reference with a period is taken to repeat, before and after; any other to go on as its last piece does. The
    stable part then starts as if the first piece had been there before.

    Args:
        trajectory: The desired one, with η̂ that has unstable modes.
        duration: Up to when, in s.

    Returns:
        One signal per η, and what is known of them.

    Raises:
        Undecided: If Newton's method does not settle.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    poles = np.linalg.eigvals(trajectory.rate[:, :, :p])
    period = 1.0 / float(np.abs(poles).max()) if system.constant else system.period
    if period is None:
        last = duration + _SETTLED / float(np.abs(poles.real).min())
        last = last if system.end is None else min(last, max(duration, system.end))
        solution = _Problem(trajectory, last, periodic=False).solve()
    else:
        solution = _Problem(trajectory, period, periodic=True).solve()
    fitted = list(solution.polynomials(duration))
    residual, terms = solution.residual(fitted)
    turns = 1 if period is None or system.constant else int(np.ceil(duration / period))
    starts = tuple(k * (period or 0.0) + a for k in range(turns) for a, _, _ in fitted)
    pieces = [c for _, _, c in fitted] * turns
    signals = tuple(Signal(starts, tuple(ExponentialPolynomial.polynomial(c[k]) for c in pieces)) for k in range(p))
    return signals, Preview(
        names=trajectory.names,
        residual=residual,
        terms=terms,
        times=np.array(starts[1:]),
        jumps=_jumps(fitted, turns),
        lead=_lead(trajectory, solution, duration),
    )


def _jumps(fitted: Sequence[tuple[float, float, Array]], turns: int) -> Array:
    """Return by how much polynomials that follow each other, some turns of them, jump from one to the next, (K, p)."""
    first = np.array([c[:, 0] for _, _, c in fitted])
    last = np.array([c @ (b - a) ** np.arange(c.shape[1]) for a, b, c in fitted])
    return np.asarray(np.abs(np.roll(first, -1, axis=0) - last)[np.arange(turns * len(fitted) - 1) % len(fitted)])


def _lead(trajectory: DesiredTrajectory, solution: "_Solution", duration: float) -> float | None:
    """Return how long before a reference that begins at rest first moves η has left its rest."""
    system = trajectory.exosystem
    if system.constant or not system.resets or system.begins() != 0.0:
        return None
    moves = system.resets[0].t
    still = replace(trajectory, exosystem=replace(system, resets=()))
    rest = _Problem(still, moves, periodic=True).solve().eta(0, np.zeros(1))[0]
    off = [(t, np.abs(solution.eta(k, t) - rest)) for k, t in solution.times(duration)]
    size = np.max([values.max(axis=0) for _, values in off], axis=0)
    left = [t[(values > _LEFT * size).any(axis=1)] for t, values in off]
    return float(max(0.0, moves - min((t[0] for t in left if len(t)), default=moves)))


def played_back(trajectory: DesiredTrajectory, duration: float) -> DesiredTrajectory:
    """Return the desired trajectory with the bounded solution in place of the filter η̂: x_d and u_ff are signals then.

    Args and raises: as `bounded_solution`.
    """
    signals, preview = bounded_solution(trajectory, duration)
    p = trajectory.rate.shape[1]
    system = beside(trajectory.exosystem, signals)
    eta = system.Q[len(trajectory.exosystem.Q) :]

    def read(rows: Array) -> Array:
        """Return what reads (η̂, w, 1) as what reads (w, η's own states, 1)."""
        found = np.zeros((*rows.shape[:-1], len(system.w0) + 1))
        found[..., : rows.shape[-1] - p - 1], found[..., -1] = rows[..., p:-1], rows[..., -1]
        found[..., :-1] += rows[..., :p] @ eta
        return found

    rate = read(trajectory.rate)
    turns = np.zeros((len(rate), *2 * rate.shape[-1:]))
    turns[:, :-1, :-1] = system.S
    rate[..., :-1] -= eta @ system.S
    turns[:, :-1] += eta.T @ rate  # η' as (15) has it
    return replace(
        trajectory,
        exosystem=system,
        names=(),
        to_eta=np.zeros((0, trajectory.to_eta.shape[1])),
        eta_offset=np.zeros(0),
        rate=np.zeros((len(rate), 0, len(system.w0) + 1)),
        turns=turns,
        x_d=read(trajectory.x_d),
        u_ff=read(trajectory.u_ff),
        guards=read(trajectory.guards),
        until=duration,
        preview=preview,
    )


@dataclass(frozen=True)
class _Stay:
    """From `start` to `end`, in s, in one cell and one piece of the reference, which begins at `since`."""

    start: float
    end: float
    cell: int
    piece: int


class _Problem:
    """The two-point problem of a reference, from t = 0 to an end in s."""

    def __init__(self, trajectory: DesiredTrajectory, end: float, *, periodic: bool) -> None:
        p, system = trajectory.rate.shape[1], trajectory.exosystem
        self.d = balancing(trajectory.rate[:, :, :p])
        self.rate = trajectory.rate / self.d[:, None]
        self.rate[:, :, :p] *= self.d
        self.guards = trajectory.guards.copy()
        self.guards[:, :p] *= self.d
        self.signs, self.end, self.periodic, self.p = trajectory.signs, end, periodic, p
        self.turns = Turns(system)
        self.breaks = [0.0, *(t for t in dict.fromkeys(reset.t for reset in system.resets) if 0 < t < end)]
        starts = system.states(np.array(self.breaks))
        self.pieces = [replace(system, w0=w, resets=()) for w in starts]
        poles = np.linalg.eigvals(self.rate[:, :, :p])
        self.fastest, self.settled = float(np.abs(poles).max()), _SETTLED / float(np.abs(poles.real).min())
        self.turning = max(float(np.abs(poles.imag).max()), float(np.abs(system.rates.imag).max(initial=0.0)))

    def solve(self) -> "_Solution":
        """Return the bounded solution: Newton's method, on the way from a linear system where it does not settle."""
        guess = [_Stay(a, b, 0, k) for k, (a, b) in enumerate(pairwise([*self.breaks, self.end]))]
        found, way, step = None, 0.0, 1.0
        while way < 1.0:
            trial = min(1.0, way + step)
            solution = self._settled(guess, trial)
            if solution is None:
                step /= 2
                if step < _FINEST:
                    raise _unsettled("Newton's method does not settle")
                continue
            found, guess, way = solution, solution.visited(), trial
        assert found is not None
        return found

    def _settled(self, stays: Sequence[_Stay], way: float) -> "_Solution | None":
        rate = (1 - way) * self.rate[0] + way * self.rate
        modes = dict[int, Modes]()
        for _ in range(_MOST_STEPS):
            solution = _Solution(self, rate, modes, stays)
            if solution.missed <= _MISSED:
                return solution
            stays = solution.visited()
        return None

    def w(self, piece: int, t: Array) -> Array:
        """Return (w, 1) of a piece at times in s, (K, s + 1)."""
        states = self.pieces[piece].states(t - self.breaks[piece])
        return np.column_stack([states, np.ones(len(t))])

    def cells(self, z: Array) -> IntArray:
        """Return the cell of x_d at each z = (η, w, 1), (K,)."""
        sides = np.sign(z @ self.guards.T)
        return np.asarray([(self.signs * side >= 0).all(axis=1).argmax() for side in sides], dtype=np.int64)


class _Solution:
    """η(t) for given stays: what joins them is linear."""

    def __init__(self, problem: _Problem, rate: Array, modes: dict[int, Modes], stays: Sequence[_Stay]) -> None:
        self.problem, self.rate, self.stays = problem, rate, list(stays)
        for i in {stay.cell for stay in stays} - set(modes):
            modes[i] = Modes(rate[i][:, : problem.p], rate[i][:, problem.p :], problem.turns)
        if len({modes[stay.cell].stable for stay in stays}) > 1:
            raise _unsettled("cells differ in how many unstable modes they have")
        self._modes = modes
        self._ends = self._joined()

    def _joined(self) -> Array:
        """Return s at the left end and u at the right end of each stay, (stays, p)."""
        p, last = self.problem.p, len(self.stays) - 1
        q = self._modes[self.stays[0].cell].stable
        lefts = list[tuple[Array, Array]]()  # η at the left end: a matrix times the unknowns, and the rest
        rights = list[tuple[Array, Array]]()
        for stay in self.stays:
            modes, span = self._modes[stay.cell], np.array([stay.end - stay.start])
            w = self.problem.w(stay.piece, np.array([stay.start, stay.end]))
            (s, s_w), (u, u_w) = modes.forward(span), modes.backward(span)
            forward, backward, right, left = np.eye(p), np.eye(p), np.zeros(p), np.zeros(p)
            forward[:q, :q], backward[q:, q:] = s[0], u[0]
            right[:q], left[q:] = s_w[0] @ w[0], u_w[0] @ w[1]
            lefts.append((modes.V @ backward, modes.V @ left))
            rights.append((modes.V @ forward, modes.V @ right))
        blocks, missing = list[tuple[int, int, Array]](), []
        for k in range(last + 1 if self.problem.periodic else last):
            after = (k + 1) % len(lefts)
            blocks += [(k, k, rights[k][0]), (k, after, -lefts[after][0])]
            missing.append(lefts[after][1] - rights[k][1])
        if not self.problem.periodic:  # the stable part starts, and the unstable one ends, as what is driven alone
            first = np.diag((np.arange(p) < q).astype(np.float64))
            blocks += [(last, 0, first), (last, last, np.eye(p) - first)]
            missing.append(self._far_away())
        i, j = np.indices((p, p))
        rows, columns = (
            np.concatenate([(p * block[n] + index).ravel() for block in blocks]) for n, index in ((0, i), (1, j))
        )
        entries = np.concatenate([block[2].ravel() for block in blocks])
        matrix = scipy.sparse.csc_array((entries, (rows, columns)), shape=(p * len(lefts),) * 2)
        found = np.asarray(scipy.sparse.linalg.spsolve(matrix, np.concatenate(missing)))
        if not np.isfinite(found).all():
            raise _unsettled("the two-point problem is singular")
        return found.reshape(-1, p)

    def _far_away(self) -> Array:
        """Return the stable part at the start, and the unstable one at the end, as if their pieces had no end."""
        problem, found = self.problem, np.zeros(self.problem.p)
        first, last, span = self.stays[0], self.stays[-1], np.array([problem.settled])
        q, ahead = self._modes[first.cell].stable, problem.turns(span)[0]
        before = problem.turns(-span)[0] @ problem.w(first.piece, np.array([first.start]))[0]
        after = ahead @ problem.w(last.piece, np.array([last.end]))[0]
        found[:q] = self._modes[first.cell].forward(span)[1][0] @ before
        found[q:] = self._modes[last.cell].backward(span)[1][0] @ after
        return found

    def eta(self, k: int, t: Array) -> Array:
        """Return η at times in s of a stay, (K, p), in balanced units."""
        stay, end = self.stays[k], self._ends[k]
        modes = self._modes[stay.cell]
        q, w = modes.stable, self.problem.w(stay.piece, np.array([stay.start, stay.end]))
        (s, s_w), (u, u_w) = modes.forward(t - stay.start), modes.backward(stay.end - t)
        return np.asarray(np.hstack([s @ end[:q] + s_w @ w[0], u @ end[q:] + u_w @ w[1]]) @ modes.V.T)

    def z(self, k: int, t: Array) -> Array:
        """Return (η, w, 1), (K, p + s + 1)."""
        return np.hstack([self.eta(k, t), self.problem.w(self.stays[k].piece, t)])

    @cached_property
    def _looked_up(self) -> list[tuple[Array, IntArray]]:
        """Times of each stay, close where something may change fast, and the cell that x_d is in then."""
        found, total = [], 0
        for k, stay in enumerate(self.stays):
            t = _grid(stay.start, stay.end, turning=self.problem.turning, fastest=self.problem.fastest)
            total += len(t)
            if total > _MOST_POINTS:
                raise _unsettled("the reference turns too fast for its length")
            found.append((t, self.problem.cells(self.z(k, t))))
        return found

    def times(self, until: float) -> Iterator[tuple[int, Array]]:
        """Yield each stay that begins before a time in s, with times in it."""
        for k, (t, _) in enumerate(self._looked_up):
            if len(t := t[t <= until]):
                yield k, t

    @property
    def missed(self) -> float:
        """By how much η' is off where x_d is in another cell than was taken, relative to the largest rates."""
        off, size = np.zeros(self.problem.p), np.full(self.problem.p, 1e-300)
        for k, (t, cells) in enumerate(self._looked_up):
            z, taken = self.z(k, t), self.stays[k].cell
            size = np.maximum(size, np.abs(z @ self.rate[taken].T).max(axis=0))
            for i in set(cells.tolist()) - {taken}:
                where = cells == i
                off = np.maximum(off, np.abs(z[where] @ (self.rate[i] - self.rate[taken]).T).max(axis=0))
        return float((off / size.max()).max())

    def visited(self) -> list[_Stay]:
        """Return the stays that this solution has, with the times at which its x_d crosses facets."""
        found = list[_Stay]()
        for k, (t, cells) in enumerate(self._looked_up):
            stay, edges = self.stays[k], list[float]()
            for j in np.flatnonzero(np.diff(cells)).tolist():
                edges += self._crossings(k, float(t[j]), float(t[j + 1]))
            times = np.array([stay.start, *edges, stay.end])
            within = self.problem.cells(self.z(k, (times[:-1] + times[1:]) / 2)).tolist()
            for a, b, cell in zip(times[:-1].tolist(), times[1:].tolist(), within, strict=True):
                if found and found[-1].cell == cell and found[-1].piece == stay.piece:
                    found[-1] = replace(found[-1], end=b)
                elif b > a:
                    found.append(_Stay(a, b, cell, stay.piece))
        return found

    def _crossings(self, k: int, a: float, b: float) -> list[float]:
        """Return the times between a and b at which x_d is on a hyperplane that it is on the other side of then."""
        guards = self.problem.guards
        left, right = self.z(k, np.array([a, b])) @ guards.T
        return sorted(self._crossing(k, guards[j], a, b) for j in np.flatnonzero(left * right < 0))

    def _crossing(self, k: int, guard: Array, a: float, b: float) -> float:
        """Return the time between a and b at which one guard is 0."""

        def value(t: float) -> float:
            return float(self.z(k, np.array([t]))[0] @ guard)

        one, other = value(a), value(b)
        if not one * other < 0:  # alone, one end is on the other side by rounding
            return a if abs(one) < abs(other) else b
        return float(scipy.optimize.brentq(value, a, b, xtol=4 * EPS * b, rtol=4 * EPS))

    def polynomials(self, until: float) -> Iterator[tuple[float, float, Array]]:
        """Yield (from, to, coefficients (p, degree + 1)) of polynomials of the time since `from`, in units given."""
        size = max(float(np.abs(self.eta(k, t)).max()) for k, (t, _) in enumerate(self._looked_up))
        interpolation, resolved = _Interpolation(_DEGREE), _RESOLVED / max(self.problem.fastest, self.problem.turning)
        for k, stay in enumerate(self.stays):
            todo = [(stay.start, min(stay.end, until), np.inf)] if stay.start < until else []
            while todo:
                a, b, before = todo.pop()
                if b - a <= resolved * _SHORT:  # of which a difference of values has no slope
                    yield a, b, self._taylor(k, a) * self.problem.d[:, None]
                    continue
                fitted, off = interpolation(self.eta(k, a + (b - a) * interpolation.points), b - a)
                missed = float(off.max()) / size if size else 0.0  # nothing drives it: it is 0
                noise = missed < _NOISE and missed > before / 8  # halving would take it to 1/1000
                if missed > _FITTED and not noise and b - a > resolved:
                    todo += [((a + b) / 2, b, missed), (a, (a + b) / 2, missed)]
                else:
                    yield a, b, fitted.T * self.problem.d[:, None]

    def _taylor(self, k: int, a: float) -> Array:
        """Return the Taylor coefficients of η at a time in s of a stay, (p, degree + 1), in balanced units."""
        p, stay = self.problem.p, self.stays[k]
        z, turns = self.z(k, np.array([a]))[0], self.problem.turns.S
        found = [z]
        for j in range(1, _DEGREE + 1):
            found.append(np.concatenate([self.rate[stay.cell] @ found[-1], turns @ found[-1][p:]]) / j)
        return np.array(found).T[:p]

    def residual(self, fitted: Sequence[tuple[float, float, Array]]) -> tuple[Array, Array]:
        """Return sup |η' − A_i η − B_i (w, 1)| of polynomials, and sup Σ |terms|, of each entry, (p,) each.

        On each of them this is, to rounding, a polynomial of no more than twice the degree: from so many Chebyshev
        points its largest value is at most 1 / cos(π/4) times what is seen there (Ehlich and Zeller, 1964).
        """
        problem, k = self.problem, 0
        nodes = (1 + np.cos(np.pi * (np.arange(4 * _DEGREE) + 0.5) / (4 * _DEGREE))) / 2
        worst, rate = np.zeros(problem.p), np.zeros(problem.p)
        for a, b, coefficients in fitted:
            while self.stays[k].end <= a:
                k += 1
            tau = (b - a) * nodes
            powers = tau[:, None] ** np.arange(_DEGREE + 1)
            c = coefficients / problem.d[:, None]
            slope = powers[:, :-1] @ (c[:, 1:] * np.arange(1, _DEGREE + 1)).T
            z = np.hstack([powers @ c.T, problem.w(self.stays[k].piece, a + tau)])
            cell = int(problem.cells(z[[len(z) // 2]])[0])
            worst = np.maximum(worst, np.abs(slope - z @ self.rate[cell].T).max(axis=0))
            size = np.abs(z) @ np.abs(self.rate[cell].T)
            rate = np.maximum(rate, size.max(axis=0))
        return worst * problem.d * np.sqrt(2), rate * problem.d


def _grid(a: float, b: float, *, turning: float, fastest: float) -> Array:
    """Return times from a to b: evenly, closer than what turns, and ever closer to both ends, where modes decay."""
    even = np.linspace(0.0, 1.0, 1 + min(_MOST_POINTS, max(16, int(np.ceil((b - a) * turning * 4)))))
    levels = int(np.clip(np.ceil(np.log2(max(2.0, 16 * fastest * (b - a)))), 1, 60))
    near = np.add.outer(0.5 ** np.arange(1, levels + 1), 0.0) * np.array([0.5, 0.625, 0.75, 0.875, 1.0])[:, None]
    parts = np.unique(np.concatenate([even, near.ravel(), 1 - near.ravel()]))
    return np.asarray(a + (b - a) * parts)


class _Interpolation:
    """Polynomials through values at Chebyshev points, as powers of the time since the left end."""

    def __init__(self, degree: int) -> None:
        unit = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
        between = np.cos(np.pi * np.arange(degree + 2) / (degree + 1))
        self.count, self.points = degree + 1, (1 + np.concatenate([unit, between])) / 2
        self._series = np.linalg.inv(chebyshev.chebvander(unit, degree))  # from values to a Chebyshev series
        self._others = chebyshev.chebvander(between, degree)
        shifted = [Chebyshev.basis(k, domain=[0, 1]).convert(kind=Polynomial).coef for k in range(degree + 1)]
        self._powers = np.array([np.pad(c, (0, degree + 1 - len(c))) for c in shifted]).T

    def __call__(self, seen: Array, span: float) -> tuple[Array, Array]:
        """Return the coefficients, (degree + 1, p), and by how much they miss other values, (p,)."""
        known, others = seen[: self.count], seen[self.count :]
        series = self._series @ known
        off = np.abs(self._others @ series - others).max(axis=0)
        return (self._powers @ series) / span ** np.arange(self.count)[:, None], np.asarray(off)


def _unsettled(reason: str) -> Undecided:
    return Undecided(
        Problem(
            message=f"the bounded solution of the internal dynamics was not found: {reason}",
            subject=(Part.REFERENCE,),
            hint="a slower or smoother reference, or state tracking (Theorem 2)",
        )
    )
