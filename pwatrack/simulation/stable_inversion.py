"""The bounded solution of internal dynamics with unstable modes: what a controller plays back that knows the reference.

η' = A_i η + B_i (w, 1) in the cell of x_d, driven by an exosystem, has exactly one bounded solution where (17±) holds:
see `docs/theory/beyond.md`, *Zero dynamics with unstable modes*. Here it is the solution of a two-point problem:
between the times at which x_d crosses a facet or the reference has a new piece, a stay, the stable part of η runs
forward from the left end and the unstable part backward from the right end,

    s(t) = E_s(t − a) s(a) + F_s(t − a) w(a),    u(t) = E_u(b − t) u(b) + F_u(b − t) w(b),

so that nothing grows, however fast a mode or long a stay is. What joins the stays is linear; their times follow by
Newton's method, whose derivative has no terms for them, as the field is continuous.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import factorial
from typing import Any

import numpy as np
import scipy  # whose parts are imported where they are used
from scipy.linalg import schur, solve_sylvester

from pwatrack.arrays import EPS, Array, balancing
from pwatrack.control.trajectory import DesiredTrajectory, NoncausalTrajectory
from pwatrack.errors import ProblemPart, Undecided
from pwatrack.model.reference import Exosystem, beside, exosystem, spectral_terms
from pwatrack.model.signal import Signal
from pwatrack.simulation.curve import DEGREE, POINTS, Looked, Pieces, fitted, is_of, joined, look, played, told_pieces

_SETTLED = 40.0  # time constants of the slowest mode after which nothing is left of an end: e^-40 = 4e-18
_MISSED = 1e-12  # of the largest rate: what a stay in the wrong cell may be off by
_MOST_STEPS = 30  # of Newton's method, from one guess
_FINEST = 2.0**-10  # part of the way from a linear system to what is asked, in which that must settle
FITTED, _NOISE = 1e-14, 1e-13  # of the largest value: how near they are, and what may be rounding
_LEFT = 1e-3  # of the way that an η goes: by more than that it has left its rest
_RESOLVED = 0.5  # of the fastest time constant: over so short a time such a polynomial is exact but for rounding
_SHORT = 2.0**-6  # of that time: over so short a one a Taylor polynomial is exact
_SEEN = 64  # points of each stay from which the size of η is taken
_MOST_PIECES = 200_000  # of what is played back
_TAYLOR = 14  # terms of e^{M t} for ‖M t‖ ≤ 1/2: the next is below 1e-16


def bounded_solution(
    trajectory: DesiredTrajectory, duration: float, told: Mapping[str, Any] | None = None
) -> tuple[tuple[Signal, ...], NoncausalTrajectory]:
    """Return the bounded solution of the internal dynamics from t = 0 on, in pieces that are polynomials.

    A reference with a period is taken to repeat, before and after; any other to go on as its last piece does. The
    stable part then starts as if the first piece had been there before. Returned are one signal per η, up to a time in
    s, and what is known of them. Raises Undecided if Newton's method does not settle. Where another one is told of this
    very reference, see `told_pieces`, that is nowhere far from it, what is known of that is found.
    """
    system = trajectory.exosystem
    poles = np.linalg.eigvals(trajectory.rate[:, :, : trajectory.rate.shape[1]])
    settled = _SETTLED / float(np.abs(poles.real).min())
    period = 1.0 / float(np.abs(poles).max()) if system.constant else system.period
    first, last, repeats = 0.0, period, period is not None and period <= duration + 2 * settled
    if not repeats and period is not None:  # all of it would be seen only in a longer run
        first, last, period = -settled, duration + settled, None
    elif last is None:
        last = duration + settled if system.end is None else min(duration + settled, max(duration, system.end))
    turns = 1 if period is None or system.constant else int(np.ceil(duration / period))
    assert last is not None
    problem = _Problem(trajectory, first, last, periodic=repeats)
    pieces = problem.solve().pieces(duration)
    with suppress(ValueError):  # of what is told and is no such curve
        if told is not None and is_of(told, system):
            other = told_pieces(told, len(system.w0), period, duration)
            pieces = other if pieces.is_near(other, problem.d) and not pieces.is_one_with(other) else pieces
    signals, preview = played(trajectory, pieces, turns, period or 0.0)
    return signals, replace(preview, lead=_lead(trajectory, signals, duration))


def _lead(trajectory: DesiredTrajectory, signals: Sequence[Signal], duration: float) -> float | None:
    """Return how long before a reference that begins at rest first moves η has left its rest."""
    system = trajectory.exosystem
    if system.constant or not system.resets or system.begins() != 0.0:
        return None
    moves = float(system.breaks[0])
    still = replace(trajectory, exosystem=replace(system, resets=()))
    rest = _Problem(still, 0.0, moves, periodic=True).solve().rest
    edges = np.append(signals[0].starts, duration)
    t = np.linspace(edges[:-1], edges[1:], 2 * DEGREE, endpoint=False).T.ravel()
    made = exosystem(signals)
    away = np.abs(made.states(t) @ made.Q.T - rest)
    left = t[(away > _LEFT * away.max(axis=0)).any(axis=1)]
    return float(max(0.0, moves - left.min(initial=moves)))


def played_back(
    trajectory: DesiredTrajectory, duration: float, told: Mapping[str, Any] | None = None
) -> DesiredTrajectory:
    """Return the trajectory with the bounded solution in place of the filter η̂: x_d and u_ff are signals then."""
    signals, preview = bounded_solution(trajectory, duration, told)
    p = trajectory.rate.shape[1]
    system = beside(trajectory.exosystem, exosystem(signals))
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


class SplitModes:
    """A_i split into its stable and its unstable part, A_i V = V diag(Λ_s, Λ_u), each driven by the reference."""

    def __init__(self, A: Array, B: Array, turns: "ReferenceTransition") -> None:
        T, Z, q = schur(A, sort="lhp")
        X = solve_sylvester(T[:q, :q], -T[q:, q:], -T[:q, q:]) if 0 < q < len(A) else np.zeros((q, len(A) - q))
        unit = np.eye(len(A))
        unit[:q, q:] = X
        self.stable, self.V = q, Z @ unit
        unit[:q, q:] = -X
        W = unit @ Z.T
        self.forward = Driven(T[:q, :q], (W @ B)[:q], turns, 1.0)
        self.backward = Driven(-T[q:, q:], -(W @ B)[q:], turns, -1.0)


class ReferenceTransition:
    """t ↦ e^{S t} of the reference and the constant 1, in closed form."""

    def __init__(self, system: Exosystem) -> None:
        self.S = np.zeros((len(system.w0) + 1,) * 2)
        self.S[:-1, :-1] = system.S
        self._terms = spectral_terms(system.S, system.rates)

    def __call__(self, t: Array) -> Array:
        """Return it at some times, (K, s + 1, s + 1)."""
        found = np.zeros((len(t), *self.S.shape))
        found[:, -1, -1] = 1.0
        for rate, chain in self._terms:
            for m, E in enumerate(chain):
                found[:, :-1, :-1] += (np.multiply.outer(np.exp(rate * t) * t**m / factorial(m), E)).real
        return found


class Driven:
    """v' = Λ v + B w with w' = ±S w and Λ stable: v(t) = E(t) v(0) + F(t) w(0), for many t ≥ 0.

    By doubling: E(2t) = E(t)², F(2t) = E(t) F(t) + F(t) e^{±S t}, from a t so short that a Taylor polynomial is exact.
    Of E what it adds to 1 is kept, or slow modes beside fast ones would lose their digits. What lasts, e^{±S t}, is in
    closed form, so that errors do not double with it.
    """

    def __init__(self, L: Array, B: Array, turns: ReferenceTransition, sign: float) -> None:
        self._q, self._turns, self._sign = len(L), turns, sign
        self._M = np.block([[L, B], [np.zeros((len(turns.S), len(L))), sign * turns.S]])
        self._d = balancing(self._M[None])
        self._M = self._M / self._d[:, None] * self._d
        self._norm = float(np.abs(self._M).sum(axis=1).max())

    def __call__(self, t: Array) -> tuple[Array, Array]:
        """Return E, (K, q, q), and F, (K, q, s + 1)."""
        q, d = self._q, self._d
        halvings = int(np.ceil(np.log2(max(1.0, 2 * self._norm * float(t.max(initial=0.0))))))
        first = t / 2.0**halvings
        step = np.multiply.outer(first, self._M)
        total = unit = np.broadcast_to(np.eye(len(self._M)), step.shape)
        for k in range(_TAYLOR, 1, -1):
            total = unit + step @ total / k
        total = step @ total * d[:, None] / d
        G, F = total[:, :q, :q], total[:, :q, q:]
        for k in range(halvings):
            G, F = 2 * G + G @ G, F + G @ F + F @ self._turns(self._sign * first * 2.0**k)
        return np.eye(q) + G, F


@dataclass(frozen=True)
class _Stay:
    """From `start` to `end`, in s, in one cell and one piece of the reference, which begins at `since`."""

    start: float
    end: float
    cell: int
    piece: int


class _Problem:
    """The two-point problem of a reference, from a start to an end in s."""

    def __init__(self, trajectory: DesiredTrajectory, start: float, end: float, *, periodic: bool) -> None:
        p, system = trajectory.rate.shape[1], trajectory.exosystem
        self.d = balancing(trajectory.rate[:, :, :p])
        self.rate = trajectory.rate / self.d[:, None]
        self.rate[:, :, :p] *= self.d
        guards = trajectory.guards.copy()
        guards[:, :p] *= self.d
        self.balanced = replace(trajectory, rate=self.rate, guards=guards)
        self.end, self.periodic, self.p = end, periodic, p
        self.turns = ReferenceTransition(system)
        breaks = dict.fromkeys([start, 0.0, *system.breaks.tolist()])
        self.breaks = [t for t in breaks if start <= t < end]
        starts = system.states(np.array(self.breaks, dtype=np.longdouble)).astype(np.float64)
        self.pieces = [replace(system, w0=w, resets=()) for w in starts]
        self.quick = float(np.abs(system.rates).max(initial=0.0))
        poles = np.linalg.eigvals(self.rate[:, :, :p])
        self.fastest, self.settled = float(np.abs(poles).max()), _SETTLED / float(np.abs(poles.real).min())
        self.turning = max(float(np.abs(poles.imag).max()), float(np.abs(system.rates.imag).max(initial=0.0)))
        self.constant = system.constant

    def solve(self) -> "_Solution":
        """Return the bounded solution: Newton's method, on the way from a linear system where it does not settle."""
        guess = [_Stay(a, b, 0, k) for k, (a, b) in enumerate(pairwise([*self.breaks, self.end]))]
        found, way, step = None, 0.0, 1.0
        while way < 1.0:
            trial, stays, modes = min(1.0, way + step), guess, dict[int, SplitModes]()
            rate = (1 - trial) * self.rate[0] + trial * self.rate
            for _ in range(_MOST_STEPS):
                solution = _Solution(self, rate, modes, stays)
                stays = solution.visited()
                if solution.missed <= _MISSED:
                    found, guess, way = solution, stays, trial
                    break
            else:
                step /= 2
                if step < _FINEST:
                    raise _unsettled("Newton's method does not settle")
        assert found is not None
        return found

    def w(self, piece: int, t: Array) -> Array:
        """Return (w, 1) of a piece at times in s, (K, s + 1)."""
        return np.column_stack([self.pieces[piece].states(t - self.breaks[piece]), np.ones(len(t))])


class _Solution:
    """η(t) for given stays: what joins them is linear."""

    def __init__(self, problem: _Problem, rate: Array, modes: dict[int, SplitModes], stays: Sequence[_Stay]) -> None:
        self.problem, self.rate, self.stays = problem, rate, list(stays)
        for i in {stay.cell for stay in stays} - set(modes):
            modes[i] = SplitModes(rate[i][:, : problem.p], rate[i][:, problem.p :], problem.turns)
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

    @property
    def rest(self) -> Array:
        """η at the start, (p,)."""
        return np.asarray(self.eta(0, np.array([self.stays[0].start]))[0] * self.problem.d)

    @cached_property
    def _looked(self) -> tuple[Pieces, Looked]:
        """Polynomials of all stays, and the cells that x_d visits on them, each `of` a stay."""
        problem = self.problem
        pieces = self._fitted(np.inf)
        cut = pieces.cut(problem.quick)
        piece = np.array([stay.piece for stay in self.stays])[pieces.of[cut.of]]
        w = np.zeros((len(piece), len(problem.turns.S) - 1))
        for k in range(len(problem.pieces)):
            w[piece == k] = problem.w(k, cut.start[piece == k])[:, :-1]
        looked = look(replace(problem.balanced, rate=self.rate), cut, w, 4 * EPS * np.abs(w), sharp=False)
        return cut, replace(looked, of=pieces.of[cut.of[looked.of]])

    @property
    def missed(self) -> float:
        """By how much η' is off where x_d is in another cell than was taken, relative to the largest rates."""
        pieces, looked = self._looked
        taken = np.array([stay.cell for stay in self.stays])[looked.of]
        cells, rows = looked.cells(), np.arange(len(looked.of))
        off = np.abs(looked.ends[rows, :, cells] - looked.ends[rows, :, taken]).max(axis=1).max(axis=0)
        size = np.abs(pieces.c[:, :, 1]).max(initial=0.0)
        return float(off.max() / size) if size else float(off.max() > 0)

    def visited(self) -> list[_Stay]:
        """Return the stays that this solution has, with the times at which its x_d crosses facets."""
        found, looked = list[_Stay](), self._looked[1]
        for start, k, cell in zip(looked.start.tolist(), looked.of.tolist(), looked.cells().tolist(), strict=True):
            stay = self.stays[k]
            if found and found[-1].piece == stay.piece:
                if found[-1].cell == cell:
                    continue
                found[-1] = replace(found[-1], end=start)
            elif found:
                found[-1] = replace(found[-1], end=stay.start)
            found.append(_Stay(start, self.problem.end, cell, stay.piece))
        return found

    def pieces(self, until: float) -> Pieces:
        """Return polynomials in units given, from t = 0 on and so many that they reach a time in s."""
        pieces = self._fitted(until)
        kept = pieces.start >= 0.0
        c = pieces.c[kept] * self.problem.d[:, None]
        return Pieces(start=pieces.start[kept], length=pieces.length[kept], c=c, of=pieces.of[kept])

    def _fitted(self, until: float) -> Pieces:
        """Return polynomials of the time since they start, in balanced units, up to a time in s."""
        if self.problem.constant:
            (stay, *_), c = self.stays, np.zeros((1, self.problem.p, DEGREE + 1))
            c[0, :, 0] = self.eta(0, np.array([stay.start]))[0]
            return Pieces(start=np.zeros(1), length=np.array([self.problem.end]), c=c, of=np.zeros(1, dtype=np.int64))
        seen = (self.eta(k, np.linspace(stay.start, stay.end, _SEEN)) for k, stay in enumerate(self.stays))
        size, found, total = max(float(np.abs(eta).max()) for eta in seen), list[Pieces](), 0
        for k, stay in enumerate(self.stays):
            if stay.start < until:
                found += self._fitted_to(k, size, until)
                total += sum(len(part.start) for part in found[-1:])
                if total > _MOST_PIECES:
                    raise _unsettled("the reference turns too fast for its length")
        return joined(found)

    def _fitted_to(self, k: int, size: float, until: float) -> list[Pieces]:
        """Return polynomials of a stay: halves, until they are near enough, all those of one length at once.

        What is stable is known at the left ends of halves and what is not at the right ones, so that nothing grows.
        """
        stay, end, problem = self.stays[k], self._ends[k], self.problem
        modes, span = self._modes[stay.cell], stay.end - stay.start
        q, start, length = modes.stable, np.array([stay.start]), span
        s, u, before, found = end[None, :q], end[None, q:], np.full(1, np.inf), list[Pieces]()
        resolved = _RESOLVED / max(problem.fastest, problem.turning)
        if span <= resolved * _SHORT:  # of which a difference of values has no slope
            return [Pieces(start=start, length=np.array([span]), c=self._taylor(k)[None], of=np.array([k]))]
        while len(start):
            E, E_w = modes.forward(length * np.append(POINTS, 0.5))
            G, G_w = modes.backward(length * np.append(1 - POINTS, 0.5))
            w, w_end = problem.w(stay.piece, start), problem.w(stay.piece, start + length)
            stable = np.einsum("tij,nj->nti", E, s) + np.einsum("tij,nj->nti", E_w, w)
            other = np.einsum("tij,nj->nti", G, u) + np.einsum("tij,nj->nti", G_w, w_end)
            c, off = fitted(np.concatenate([stable, other], axis=2)[:, :-1] @ modes.V.T, np.full(len(start), length))
            missed = off / size if size else np.zeros(len(start))  # nothing drives it: it is 0
            noise = (missed < _NOISE) & (missed > before / 8)  # halving would take it to 1/1000
            open_ = (missed > FITTED) & ~noise & (length > resolved)
            done = ~open_
            found.append(
                Pieces(start=start[done], length=np.full(done.sum(), length), c=c[done], of=np.full(done.sum(), k))
            )
            length /= 2
            start = np.concatenate([start[open_], start[open_] + length])
            s, u = (np.concatenate(pair) for pair in ((s[open_], stable[open_, -1]), (other[open_, -1], u[open_])))
            before, near = np.tile(missed[open_], 2), start < until
            start, s, u, before = start[near], s[near], u[near], before[near]
        return found

    def _taylor(self, k: int) -> Array:
        """Return the Taylor coefficients of η at the start of a stay, (p, degree + 1), in balanced units."""
        p, stay, turns = self.problem.p, self.stays[k], self.problem.turns.S
        t = np.array([stay.start])
        found = [np.concatenate([self.eta(k, t)[0], self.problem.w(stay.piece, t)[0]])]
        for j in range(1, DEGREE + 1):
            found.append(np.concatenate([self.rate[stay.cell] @ found[-1], turns @ found[-1][p:]]) / j)
        return np.array(found).T[:p]


def _unsettled(reason: str) -> Undecided:
    return Undecided(
        f"the bounded solution of the internal dynamics was not found: {reason}",
        subject=(ProblemPart.REFERENCE,),
        hint="a slower or smoother reference, or state tracking (Theorem 2)",
    )
