"""Gains that may do, in the order in which they are tried. None of them is believed before it is proved."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from pwatrack.arrays import EPS, Array, root_of
from pwatrack.control.headroom import InputConstraint
from pwatrack.control.task import Task
from pwatrack.lmi.exact import short
from pwatrack.lmi.inequality import quadratic_cost, state_feedback
from pwatrack.lmi.pair import MANY_STATES, Pair
from pwatrack.lmi.presolve import Coordinates, extreme
from pwatrack.lmi.program import Solution, largest_margin, least_cost, smaller_gain, smallest_gain
from pwatrack.lmi.saturated import LimitedGain
from pwatrack.lmi.solve import solve

FASTER = 2e-3  # than asked, as a share, so that a margin is left for the exact proof
_HARDLY_FASTER = 5e-4  # the same where that much is out of reach
_STATE_WEIGHTS = (1.0, 1e-2, 1e-4, 1e-6)  # of the states against the inputs, in costs whose gains are tried
_BOUNDS_OF_Y = (10.0, 1e3, 1e5)  # of (8) with P ⪯ I, relative to ‖A‖ / ‖B‖: without one Y may be large for nothing
_RECENTRED = 6  # times at most that the largest margin is looked for in the coordinates of its last answer
_CLOSER = 3  # times that the bound of the norm is drawn closer
_NEAR = 1e-3  # gap of each of them: a part of that is lost of the norm, and the next one can begin where it ended
_SPARED = 1e-3  # of the bounds of inputs, for the exact proof
_WORTH_IT = 0.95  # of the norm: while a closer bound makes it smaller than that share, another one follows


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A gain to prove."""

    K: Array  # (m, n), as it will be printed: `short`
    P: Array | None = None  # (n, n), which may prove it; None where there is no guess
    margin: float = np.nan  # of the inequality that it is from, where A and P have size 1


class Candidates:
    """Ways to look for a gain."""

    def __init__(self, task: Task) -> None:
        self.task, self.A = task, extreme(task.A)  # the corners of the convex hull of its cells, (l, n, n)
        # sizes, in which the weights of a cost are one
        self.at = Coordinates.sized(task.A, task.scale.state, task.scale.input, tempo=task.scale.speed)

    def regulator(self, rate: float) -> Iterator[Candidate]:
        """Yield the gain of the least cost with unit weights in sizes, then those of lighter ones."""
        A, B = self.at.system(self.A) + self._shift(rate, FASTER), self.at.input(self.task.B)
        for root in _state_weights(A.mean(axis=0), B):
            rows, R = root @ self.at.inverse, np.eye(B.shape[1])
            yield from self._least_cost(rows, R, self._shift(rate, FASTER))

    def least_cost(self, Q: Array, R: Array) -> Iterator[Candidate]:
        """Yield the gain of the least sum of the costs from all states off by one size; Q, R in the units given."""
        rows, e = root_of(self.at.weights(Q)) @ self.at.inverse, self.at.e
        yield from self._least_cost(rows, e[:, None] * R * e, np.zeros_like(Q))

    def least_worst_cost(self, within: InputConstraint, rate: float) -> Iterator[Candidate]:
        """Yield the gain of the least worst cost from starts, among those with which limits do no harm, if any.

        The weights of the cost are those of `regulator`; the rate is in 1/s.
        """
        shift, rows, R = self._shift(rate, FASTER), self.at.inverse, np.eye(len(within.left))
        A, B = self.at.system(self.A) + shift, self.at.input(self.task.B)
        root = self.at.rows(rows)
        at = self.at.of_regulator(A, B, root.T @ root, R)
        found = self._limited(at, within, shift).cheapest(at.rows(rows))
        if found is not None:
            yield self._candidate(at, *found)

    def farthest(self, within: InputConstraint, rate: float) -> tuple[Candidate, float] | None:
        """Return the gain of a rate (1/s) with which limits do no harm from most of some starts, and the multiple."""
        shift = self._shift(rate, _HARDLY_FASTER)
        at = self._regulated(shift)
        found = self._limited(at, within, shift).farthest()
        return None if found is None else (self._candidate(at, *found[:2]), found[2])

    def farthest_held(self, within: InputConstraint, h: float) -> Candidate | None:
        """Return the same gain for inputs that are held for h (s), as if each sample began and ended in one cell."""
        at, (n, m) = self._regulated(self._shift(0.0, 0.0)), self.task.B.shape
        program = self._limited(at, within, np.zeros((n, n)))
        whole = np.zeros((len(program.A), n + m, n + m))
        whole[:, :n, :n], whole[:, :n, n:] = program.A, program.B
        over = expm(whole * (h * at.speed))
        found = replace(program, A=over[:, :n, :n], B=over[:, :n, n:], held=True).farthest()
        return None if found is None else self._candidate(at, *found[:2])

    def _limited(self, at: Coordinates, within: InputConstraint, shift: Array) -> LimitedGain:
        """Return the program in coordinates in which the starts have size 1; P and Y are in proportion."""
        boxes = [at.inverse @ box for box in within.starts]
        size = max(float(np.linalg.norm(box, 2)) for box in boxes)
        return LimitedGain(
            A=at.system(self.A),
            B=np.array([at.input(self.task.B)] * len(self.A)),
            shift=shift,
            starts=[box / size for box in boxes],
            room=(1 - _SPARED) * within.left / at.e / size,
            over=within.over,
        )

    def largest_margins(self, rate: float) -> Iterator[Candidate]:
        """Yield gains of the largest margin, while it is positive each in better coordinates than the last one."""
        shift = self._shift(rate, FASTER / 2)
        for factor in _BOUNDS_OF_Y:
            at = self._regulated(shift)
            for _ in range(_RECENTRED):
                inequality = state_feedback(at.system(self.A) + shift, at.input(self.task.B))
                size = float(np.linalg.norm(inequality.L, 2, axis=(1, 2)).max(initial=0.0))
                most = factor * size / max(float(np.linalg.norm(inequality.M[0], 2)), 1e-300)
                solution = solve(largest_margin(inequality, most))
                if solution is None:
                    return
                candidate = self._candidate(at, solution.P, solution.Y, inequality.margin(solution.P, solution.Y))
                yield candidate
                if candidate.margin < 0:
                    break
                at = at.centred(solution.P)

    def smallest(self, rate: float, *, soon: bool = False) -> Iterator[Iterator[Candidate]]:
        """Yield sequences of gains for a rate (1/s), each smaller than the one before; the last of one may fail."""
        for faster in (FASTER,) if soon else (FASTER, _HARDLY_FASTER):
            shift = self._shift(rate, faster)
            at = self._regulated(shift)
            for _ in range(_RECENTRED // 2 - soon):
                seen: list[Solution] = []
                yield self._smaller_and_smaller(at, shift, seen)
                if not seen:
                    break
                at = at.centred(seen[-1].P)

    def _smaller_and_smaller(self, at: Coordinates, shift: Array, seen: list[Solution]) -> Iterator[Candidate]:
        """Minimise a bound of the norm of the gain, then the closer bounds that each answer allows."""
        inequality = state_feedback(at.system(self.A) + shift, at.input(self.task.B))
        metric_root, input_root = at.inverse @ self.at.T, np.eye(len(at.e))
        program, before = smallest_gain(inequality, metric_root, input_root), np.inf
        first, last = None, None
        for _ in range(_CLOSER + 1):
            solution = solve(program, gap=_NEAR, after=last)
            if solution is None or not _definite(solution.P):
                return
            seen.append(solution)
            candidate = self._candidate(at, solution.P, solution.Y)
            yield candidate
            norm = self.task.norm(candidate.K)
            if norm > _WORTH_IT * before:
                return
            before = norm
            last = None if first is None else solution
            program = smaller_gain(inequality, metric_root, input_root, (solution.P, solution.Y), first)
            first = first or (solution.P, solution.Y)

    def _least_cost(self, rows: Array, R: Array, shift: Array) -> Iterator[Candidate]:
        """Yield the gain that minimises the cost of the rows (k, n) of x, summed over all states off by one size."""
        A, B = self.at.system(self.A) + shift, self.at.input(self.task.B)
        root = self.at.rows(rows)
        pair = Pair.of(A) if len(B) >= MANY_STATES else None
        if pair is not None:
            X = pair.regulator(B, root.T @ root, R, self.at.states(self.at.T))
            if X is not None:
                K = self.at.gain(-np.asarray(np.linalg.solve(R, B.T @ X), dtype=np.float64))
                yield Candidate(K=short(K), P=self.at.matrix(np.asarray(np.linalg.inv(X), dtype=np.float64)))
            return
        at = self.at.of_regulator(A, B, root.T @ root, R)
        B = at.input(self.task.B)
        inequality = quadratic_cost(at.system(self.A) + shift, B, at.rows(rows), R)
        solution = solve(least_cost(inequality, at.states(self.at.T)))
        if solution is not None:
            yield self._candidate(at, solution.P, -np.asarray(np.linalg.solve(R, B.T)))

    def _candidate(self, at: Coordinates, P: Array, Y: Array, margin: float = np.nan) -> Candidate:
        """Return K = Y P⁻¹; not a number where P is not positive definite to working precision."""
        K = np.full((self.task.B.shape[1], self.A.shape[1]), np.nan)
        if _definite(P):
            K = at.gain(np.asarray(np.linalg.solve(P, Y.T).T))
        return Candidate(K=short(K), P=at.matrix(P), margin=margin)

    def _shift(self, rate: float, faster: float) -> Array:
        """Return what a rate adds to A in sizes, a little more than asked."""
        return rate * (1 + faster) / self.at.speed * np.eye(self.A.shape[1])

    def _regulated(self, shift: Array) -> Coordinates:
        return self.at.of_regulator(self.at.system(self.A) + shift, self.at.input(self.task.B))


def _state_weights(A: Array, B: Array) -> Iterator[Array]:
    """Yield roots of the weights Q of the quadratic cost, in the order in which they are tried.

    First multiples of I. Then of the inverse of the controllability Gramian of the damped mean cell: x' Q x is the
    effort it takes to get to x, whatever the choice of states.
    """
    eye = np.eye(len(A))
    yield from (np.sqrt(weight) * eye for weight in _STATE_WEIGHTS)
    damping = 2.0 * max(float(np.abs(np.linalg.eigvals(A)).max()), 1e-2)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it is only a weight
            gramian = solve_continuous_lyapunov(A - damping * eye, -B @ B.T)
        values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    except (np.linalg.LinAlgError, ValueError):  # an entry is not finite
        return
    if values[-1] > 0:
        root = vectors.T / np.sqrt(np.maximum(values, 1e-12 * values[-1]))[:, None]
        yield from (np.sqrt(weight * damping) * root for weight in _STATE_WEIGHTS)


def _definite(P: Array) -> bool:
    values = np.linalg.eigvalsh(P)
    return bool(values[0] > EPS * values[-1])
