"""Theorem 2: controller gain K from (8), observer gain L from (9), each with its proof."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np

from pwatrack.arrays import Array, readonly
from pwatrack.ball_matrix import BallMatrix, different, places
from pwatrack.control import refusal
from pwatrack.control.candidates import FASTER, Candidate, Candidates
from pwatrack.control.convergence import best_certificate, pair_certificates, precise_certificate, prove_convergence
from pwatrack.control.goal import DEFAULT, AtLeast, Fastest, Given, Goal, LeastCost, Smallest, demands
from pwatrack.control.headroom import InputConstraint
from pwatrack.control.task import Task, reaches
from pwatrack.errors import ProblemPart
from pwatrack.lmi.bisection import bisected
from pwatrack.lmi.exact import DIGITS, Certificate, prove, short
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER
from pwatrack.lmi.infeasibility import Refutation, refute, seems_impossible
from pwatrack.lmi.pair import MANY_STATES, Pair
from pwatrack.lmi.polynomial import Found
from pwatrack.lmi.presolve import Precise, corners, square
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.rational import Rational, decimals, identity, scalar

_RATES = 16  # at most so many rates are tried for the fastest one
_SLOWER = 6  # so often it is divided by 4 where the bound is too small for it
_ENDED = 2e-3  # relative distance of the rates that are known to be in and out of reach at which that search ends
_LOOSER = 4  # times at most that bounds of inputs are loosened
_OVER = (8.0, 4.0, 2.0, 1.0)  # times what is left of an input: what a gain with which limits do no harm may ask of it
_NEARLY = 0.97  # of the largest region: a gain that has all of it may be enormous
_WORTH_IT = 1.02  # what they are loosened by at least
_SLOW = 1e-3  # of the speed of the plant: from here on a fastest rate is sought where no gain of least cost will do
_DIGITS = 16  # of a gain that doubles hold
_ROUNDED = 0.1  # what these may change of a gain, in sizes: one of least cost with unit weights is proved up to 1
_FAST = 8.0  # times the speed of the plant: a rate that only a plant without a largest one reaches

Proved = tuple[Array, Certificate]  # K and the proof of its best rate


@dataclass(frozen=True, kw_only=True)
class Gains:
    """The gains of Theorem 2."""

    K: Array  # controller gain (m, n): u = K (x̂ − x_d) + u_ff
    L: Array  # observer gain (n, q): + L (ŷ − y)
    controller: Found  # P_c with sym((A_i + B K) P_c) ≺ 0 for all cells: (8); of a given gain it may be a polynomial
    observer: Found  # P_o with sym((A_i + L C)ᵀ P_o) ≺ 0 for all cells: (9); likewise
    cheaper: Array | None = None  # the gain of least cost, where it did not do for limits, (m, n)

    @property
    def exact(self) -> tuple[BallMatrix, BallMatrix]:
        """K and L, the decimals that they print as."""
        K, L = (BallMatrix.of(X, (X.shape[0], X.shape[1])) for X in (self.K, self.L))
        return K, L


def synthesize(
    plant: PWASystem,
    *,
    controller: Goal = DEFAULT,
    observer: Goal = DEFAULT,
    sizes: Sizes | None = None,
    within: InputConstraint | None = None,
) -> Gains:
    """Find K and L by Theorem 2, or prove the ones that are given.

    Raises Infeasible if (8) or (9) is proved to have no solution, or a given gain to be none; Undecided if neither is
    proved, or no gain within the bound was found.
    """
    sizes = sizes or Sizes.of(plant)
    K, P_c = gain(Task.of(plant, CONTROLLER, sizes=sizes), controller, within)
    L_transposed, P_o = gain(Task.of(plant, OBSERVER, sizes=sizes), observer)
    return Gains(K=readonly(K), L=readonly(L_transposed.T), controller=P_c, observer=P_o)


def with_starts_inside(plant: PWASystem, gains: Gains, goal: Goal, sizes: Sizes, within: InputConstraint) -> Gains:
    """Return gains with which limits do no harm from some starts: the same where they do, or where none is found.

    Only a K that was sought for a rate, or for nothing, is replaced: other goals say themselves what it is.
    """
    if not isinstance(goal, AtLeast) or not isinstance(gains.controller, Certificate):
        return gains
    task, found = Task.of(plant, CONTROLLER, sizes=sizes), (gains.K, gains.controller)
    search = Search(task)
    better = search.gentler_within(within, found, goal.rate, goal.bound)
    if better is None and goal.within == "region":
        most = search.candidates.farthest(replace(within, over=_OVER[0]), goal.rate)
        starts = [_NEARLY * most[1] * box for box in within.starts] if most else []
        better = search.gentler_within(replace(within, starts=starts), found, goal.rate, goal.bound) if most else None
    if better is None or better is found:
        return gains
    return replace(gains, K=readonly(better[0]), controller=better[1], cheaper=gains.K)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # entries may be 1e300: what overflows proves nothing
def gain(task: Task, goal: Goal = DEFAULT, within: InputConstraint | None = None) -> tuple[Array, Found]:
    """Return a gain K (m, n) for (8), or Lᵀ, that meets a goal, found or given, with the proof of its best rate.

    Where only a rate is asked, or nothing, the gain minimises a quadratic cost (of the system with the rate
    added to A). Its weights are one in sizes, Bryson's rule: Q = diag(1 / size²) for the states and R = diag(1 / size²)
    for the inputs; for the observer these are densities of noise on states and outputs, see `Sizes.dual`. Where inputs
    are to keep within bounds, and this gain does not, it is that of the least worst cost from these errors among those
    that do; where none is found, the one without bounds.

    Raises Infeasible if no gain exists, proved; InvalidSpec if the largest rate is asked where every rate can be
    reached; Undecided if no gain with a proof is found otherwise.
    """
    search = Search(task)
    match goal:
        case Given(gain=known):
            return given(task, task.role.oriented(known))
        case LeastCost(Q=Q, R=R):
            found = search.least_cost(Q, R)
        case Fastest(bound=bound):
            kept = None if within is None else search.fastest_within(within, bound)
            found = kept or search.fastest(bound)
        case Smallest(rate=rate):
            found = search.gentlest(rate)
        case AtLeast(rate=rate, bound=bound):
            found = search.regulator(rate)
            if found is not None and task.norm(found[0]) > bound:
                found = search.gentlest(rate)
            if within is not None and found is not None:
                found = search.cheapest_within(within, found, rate, bound) or found
    least, most = demands(goal)
    if found is None:
        raise refusal.no_gain(task, least, search.refuted(least), search.best_margin)
    if task.norm(found[0]) > most:
        raise refusal.too_large(task, least, most, task.norm(found[0]))
    return found


def given(task: Task, K: Array) -> tuple[Array, Found]:
    """Return a gain K (m, n), or Lᵀ, that is given, with what shows its best rate, or refuse it."""
    letter = task.role.letter
    certificate = prove_convergence(
        task.closed(K),
        sizes=task.scale.state,
        exact=task.exactly_closed(K),
        claim=f"{task.role.claim} for the given gain {letter}",
        cells=task.cells,
        role=task.role,
        subject=(task.role.part, ProblemPart[letter]),
        hint=f"mind the signs: u = K (x̂ − x_d) + u_ff, + L (ŷ − y); or leave {letter} out to have it designed",
    )
    return K, certificate


class Search:
    """The search for one gain. Each way returns a gain with its proof, or None."""

    def __init__(self, task: Task) -> None:
        self.task, self.candidates = task, Candidates(task)
        self.best_margin = -np.inf  # that was found for (8), where A and P have size 1
        self._refutations = dict[float, Refutation | None]()

    @cached_property
    def _idle(self) -> Proved | None:
        """The gain 0 with the proof of its best rate."""
        return self.proved(Candidate(K=np.zeros(self.task.B.T.shape)), 0.0)

    def refuted(self, rate: float) -> Refutation | None:
        """Return a proof that no gain reaches a rate (1/s), if one is found."""
        if rate not in self._refutations:
            self._refutations[rate] = refute(self.task.A, self.task.B, rate=rate, exact=self.task.centres)
        return self._refutations[rate]

    def _impossible(self, rate: float) -> bool:
        """Say whether a hint that no gain reaches a rate (1/s) leads to a proof."""
        hint = seems_impossible(self.candidates.A, self.task.B, rate=rate)
        return hint and self.refuted(rate) is not None

    def first(self, candidates: Iterable[Candidate], rate: float, *, soon: bool = False) -> Proved | None:
        """Return the first candidate that is proved to reach a rate, with the proof of the best one."""
        proofs = (self.proved(candidate, rate, soon=soon) for candidate in candidates)
        return next((found for found in proofs if found is not None), None)

    def proved(self, candidate: Candidate, rate: float, *, soon: bool = False) -> Proved | None:
        """Prove the best rate of a candidate, if it reaches the rate that is asked; soon, or not at all."""
        closed = self.task.unlike(candidate.K)
        if not np.isfinite(closed).all() or not np.linalg.eigvals(closed).real.max() < -rate:
            return None
        if self._as_pair:  # in exact numbers where doubles do not do
            K, open_loop = candidate.K, self.task.unlike(np.zeros_like(candidate.K))
            sizes = self.task.scale.state
            tried = pair_certificates(open_loop, moved=self.task.B @ K, start=candidate.P, sizes=sizes)
            proofs = (prove(closed, P) or self.task.reached_exactly(K, P) for P in tried)
            return next(((K, proof) for proof in proofs if proof is not None and reaches(proof, rate)), None)
        certificate = best_certificate(closed, start=candidate.P, sizes=self.task.scale.state, soon=soon)
        if certificate is None and candidate.P is not None:
            certificate = self.task.reached_exactly(candidate.K, candidate.P)
        return (candidate.K, certificate) if certificate is not None and reaches(certificate, rate) else None

    @cached_property
    def _as_pair(self) -> bool:
        """Whether there are many states, and corners that are a `Pair`: there no program has to be solved."""
        return len(self.task.B) >= MANY_STATES and Pair.of(self.candidates.A) is not None

    def regulator(self, rate: float) -> Proved | None:
        """Return the gain of the least cost, or of the largest margin where that has no proof."""
        if not self._as_pair and self._impossible(rate):
            return None
        costs = self.candidates.regulator(rate)
        found = self.first(islice(costs, 1), rate)
        if found is None and self._as_pair and self._impossible(rate):
            return None
        scale = self.task.scale
        precise = self._of_mean(found, rate, square(scale.state).inv(), square(scale.input).inv())
        if precise is not None:
            found = self._proved_precisely(*precise, rate) or found or self._turned(precise[0], rate)
        if found is not None or self._as_pair:
            return found or self.first(costs, rate)
        for candidate in self.candidates.largest_margins(rate):
            if candidate.P is not None and self.task.reached(candidate.K, candidate.P, rate):
                return self.proved(candidate, rate)
            self.best_margin = max(self.best_margin, candidate.margin)
            if candidate.margin < 0 and self.refuted(rate) is not None:
                return None
        return None if self.refuted(rate) is not None else self.first(costs, rate, soon=True)

    def least_cost(self, Q: Array, R: Array) -> Proved | None:
        """Return the gain of the least cost with weights Q (n, n) and R (m, m) in the units given."""
        found = self.first(self.candidates.least_cost(Q, R), 0.0)
        precise = self._of_mean(found, 0.0, decimals(Q), decimals(R)) if len(self.candidates.A) == 1 else None
        return found if precise is None else self._proved_precisely(*precise, 0.0) or found

    def _of_mean(self, found: Proved | None, rate: float, Q: Rational, R: Rational) -> tuple[Precise, Array] | None:
        """Return the gain of least cost of the mean of the cells, and its coordinates, where doubles do not hold it.

        Not where one is found already that is proved in doubles.
        """
        A, B = self.task.centres
        if not B.ncols() or (found is not None and found[1].precise is None):
            return None
        at = corners(self.task.A).tolist()
        mean = sum((A[i] for i in at[1:]), A[at[0]]) / len(at)
        return Precise.of_regulator(mean + scalar(rate * (1 + FASTER)) * identity(B.nrows()), B, Q, R)

    def _proved_precisely(self, at: Precise, K: Array, rate: float, start: Array | None = None) -> Proved | None:
        """Prove a gain in such coordinates, with as many digits as it needs, if it reaches a rate."""
        if not np.isfinite(self.task.closed(K)).all():
            return None
        enough = (k for k in range(DIGITS, _DIGITS) if self.task.norm(K) < _ROUNDED * 10.0**k)
        printed = short(K, next(enough, _DIGITS))
        closed = different(self.task.exactly_closed(printed))
        start = np.eye(len(K.T)) if start is None else start
        certificate = precise_certificate(at, self.task.role, closed, start)
        return (printed, certificate) if certificate is not None and reaches(certificate, rate) else None

    def _turned(self, at: Precise, rate: float) -> Proved | None:
        """Look for a gain of several cells in such coordinates."""
        A, B = self.task.centres
        chosen = places(self.task.balls[0])
        cells = [self.task.cells[i] for i in chosen]
        inside = Task(A=at.system([A[i] for i in chosen]), B=at.input(B), cells=cells)
        finite = np.isfinite(inside.A).all() and np.isfinite(inside.B).all()
        found = Search(inside).regulator(rate) if len(chosen) > 1 and finite else None
        return None if found is None else self._proved_precisely(at, at.gain(found[0]), rate, found[1].P)

    def gentlest(self, rate: float) -> Proved | None:
        """Return the smallest gain that is found in any way: in sizes that differ a lot that of a cost may be."""
        found = [way for way in (self.smallest(rate), self.regulator(rate)) if way is not None]
        return min(found, key=lambda way: self.task.norm(way[0]), default=None)

    def smallest(self, rate: float) -> Proved | None:
        """Return the smallest gain that a bound of its norm leads to, in sizes."""
        found = self._within(rate)
        return None if found is None else self.proved(Candidate(K=found[0], P=found[1].P), rate)

    def fastest(self, bound: float) -> Proved | None:
        """Bisect the rate, in its logarithm, for the fastest decay that a gain within the bound gives.

        All eigenvalues of A_i + B K are left of minus the rate, so n times the rate is at most −tr(A_i + B K), and
        |tr(B K)| ≤ ‖K‖ ‖B‖⁎, the sum of the singular values of B, both in sizes. Without a bound and without a largest
        rate it is refused.
        """
        speed, best = self.candidates.at.speed, self.regulator(0.0)
        if best is None or self.task.norm(best[0]) > bound:
            best = self._slowly(speed if best is None else best[1].rate, bound) or best
        if best is None or self.task.norm(best[0]) > bound:
            return best
        slow, fast = best[1].rate, _FAST * speed
        if np.isinf(bound):
            if slow >= fast or self._within(fast, bound) is not None:
                raise refusal.no_largest_rate(self.task, max(slow, fast))
        else:
            traces = np.trace(self.task.A, axis1=1, axis2=2)
            at = self.candidates.at
            act = float(np.linalg.norm(at.input(self.task.B), "nuc")) * at.speed / self.task.gain_unit
            fast = float(bound * act - traces.max()) / self.task.A.shape[1]
        best, slow = _fastest(best, slow, fast, lambda rate: self._within(rate, bound))
        best = (self._within(slow * (1 - _ENDED)) if np.isinf(bound) else None) or best
        return self.proved(Candidate(K=best[0], P=best[1].P), 0.0)

    def cheapest_within(
        self, within: InputConstraint, found: Proved, rate: float, bound: float = np.inf
    ) -> Proved | None:
        """Return a gain of least cost if it keeps bounds of the inputs, else one of least worst cost that does.

        The ellipsoid by which it is found is more careful than the proof: so bounds are loosened by what that leaves.
        """
        if within.share(self.task, *found) >= 1:
            return found
        best, factor, good = None, 1.0, 1.0
        for _ in range(_LOOSER):
            left = within.left * factor
            loosened = replace(within, left=left)
            ways = (self.proved(c, rate) for c in self.candidates.least_worst_cost(loosened, rate))
            fitting = ((way, within.share(self.task, *way)) for way in ways if way and self.task.norm(way[0]) <= bound)
            kept, share = next((found for found in fitting if found[1] >= 1), (None, 0.0))
            if best is None and kept is None:
                break
            if kept is not None:
                best, good, factor = kept, factor, factor * share
            else:
                factor = (good + factor) / 2
            if factor < good * _WORTH_IT:
                break
        return best

    def fastest_within(self, within: InputConstraint, bound: float = np.inf) -> Proved | None:
        """Bisect the rate for the fastest decay of a gain that keeps bounds of the inputs; None if none is found.

        With P ⪰ Σ and K_j P K_jᵀ ≤ ū_j² the trace of B K, see `fastest`, is at most Σ ū_j √(B_jᵀ Σ⁻¹ B_j).
        """
        best = self.regulator(0.0)
        best = None if best is None else self.cheapest_within(within, best, 0.0, bound)
        if best is None or self.task.norm(best[0]) > bound:
            best = self._kept(within, _SLOW * self.candidates.at.speed, bound)
        if best is None:
            return None
        B, n = self.task.B, self.task.A.shape[1]
        around = within.starts[0] @ within.starts[0].T * within.starts[0].shape[1]
        act = np.sqrt(np.maximum(np.einsum("nm,nm->m", B, np.linalg.solve(around, B)), 0.0))
        fast = float(within.left[act > 0] @ act[act > 0] - np.trace(self.task.A, axis1=1, axis2=2).max()) / n
        slow = best[1].rate
        if not np.isfinite(fast):
            fast = _FAST * max(self.candidates.at.speed, slow)
        best, _ = _fastest(best, slow, fast, lambda rate: self._kept(within, rate, bound))
        return self.proved(Candidate(K=best[0], P=best[1].P), 0.0)

    def gentler_within(self, within: InputConstraint, found: Proved, rate: float, bound: float) -> Proved | None:
        """Return the gain that was found if limits do no harm with it from starts, else a smaller one of least cost.

        What such a gain may ask of its inputs is less and less, until it is smaller.
        """
        if within.share(self.task, *found) >= 1:
            return found
        most = min(bound, self.task.norm(found[0]))
        for over in _OVER:
            limited = replace(within, over=over)
            for candidate in self.candidates.least_worst_cost(limited, rate):
                way = self.proved(candidate, rate)
                if way is not None and self.task.norm(way[0]) <= most and within.share(self.task, *way) >= 1:
                    return way
        return None

    def _kept(self, within: InputConstraint, rate: float, bound: float) -> Proved | None:
        """Return a gain that keeps bounds of the inputs at a rate, if one is found whose own P proves it."""
        found = self.candidates.farthest(within, rate)
        if found is None or not found[1] >= 1 or found[0].P is None or self.task.norm(found[0].K) > bound:
            return None
        certificate = self.task.reached(found[0].K, found[0].P, rate)
        return None if certificate is None else (found[0].K, certificate)

    def _slowly(self, rate: float, bound: float) -> Proved | None:
        """Return a gain within a bound at a rate below this one; the smallest that is found where none is.

        Not at a rate of 0: there the smallest gain is the limit of those that decay, and has no proof itself.
        """
        for _ in range(_SLOWER):
            rate /= 4
            found = self._within(rate, bound)
            if found is not None:
                return found
        return self._within(rate)

    def _within(self, rate: float, bound: float | None = None) -> Proved | None:
        """Return the smallest gain that is found for a rate; with a bound, soon, the first that keeps it.

        A candidate counts only if its own P proves it: so each call solves a few programs, and a search
        that makes many of them ends.
        """
        if self._idle is not None and reaches(self._idle[1], rate):
            return self._idle
        for sequence in self.candidates.smallest(rate, soon=bound is not None):
            best = None
            for candidate in sequence:
                certificate = None if candidate.P is None else self.task.reached(candidate.K, candidate.P, rate)
                if certificate is None:
                    break
                best = candidate.K, certificate
                if bound is not None and self.task.norm(candidate.K) <= bound:
                    return best
            if best is not None:
                return best if bound is None else None
        return None


def _fastest(best: Proved, slow: float, fast: float, at: Callable[[float], Proved | None]) -> tuple[Proved, float]:
    """Return the fastest gain that is found between a rate that `best` reaches and one out of reach, and its rate."""

    def reached(rate: float) -> tuple[float, Proved] | None:
        found = at(rate)
        return None if found is None else (max(found[1].rate, rate), found)

    def mean(one: float, other: float) -> float:
        return float(np.sqrt(one) * np.sqrt(other))

    rate, found, _ = bisected((slow, best), max(slow, fast), reached, near=_ENDED, most=_RATES, middle=mean)
    return found, rate
