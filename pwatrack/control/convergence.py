"""Theorem 1: convergence from the common Lyapunov inequality (7), with the best decay rate."""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, different, stack
from pwatrack.control.refusal import conflict_text, eigenvalue_text, joined
from pwatrack.errors import Infeasible, Problem, Remedy, Subject, Undecided, listed
from pwatrack.lmi.exact import Certificate, of_proof, prove, prove_exactly
from pwatrack.lmi.inequality import PLANT, Role, lyapunov
from pwatrack.lmi.infeasibility import Impossibility, Refutation, refute
from pwatrack.lmi.pair import MANY_STATES, Pair
from pwatrack.lmi.polynomial import Found, PolynomialLyapunov, best_polynomial, degrees, prove_polynomial
from pwatrack.lmi.presolve import Coordinates, Precise, distinct, extreme, square
from pwatrack.lmi.program import Solution, largest_margin, least_condition
from pwatrack.lmi.solve import solve
from pwatrack.rational import decimals, is_hurwitz

_DOUBTFUL = 1e-3  # of the size of a matrix: cells that decay no faster are looked at for a proof that there is no P
_STEPS = 14  # at most so many rates are tried
_CONVERGED = 1e-4  # relative distance to the next rate to try at which the search ends
_NEAR = 1e-2  # gap of the margins: the next one can begin where such a one ended, and P is well inside
_ENCLOSED = 1e-3  # of a rate that is out of reach: where the best one is that near, the search ends
_CLOSE = 1e-4  # gap of the least condition number, whose root is the overshoot
FEW_ROWS = 250  # of a program for a polynomial, up to which one more costs next to nothing
_WORTH_IT = 1.1  # times the rate of a polynomial, for which one of a higher degree is taken
_RECENTRED = 4  # so often the coordinates are improved while no P is found
_SOON = 1  # the same for one gain of many


def best_certificate(
    M: Array, *, start: Array | None = None, sizes: Array | None = None, soon: bool = False
) -> Certificate | None:
    """Return the proof of M_i P + P M_iᵀ ≺ 0 for all cells with the largest rate that is found, or None.

    The largest margin of M_i P + P M_iᵀ + 2αP is a convex function of the rate α and falls, so the line through
    its values at two rates meets 0 below the largest rate: the secant method gets there from below. Where a
    rate is too fast, the interval between it and the best one is halved.

    M (l, n, n) has all eigenvalues in the open left half plane; `start` is a P (n, n) that may prove something. Numbers
    are counted in sizes of the states, (n,), by default those that balance M. Of many states, where the corners are a
    `Pair`, Riccati equations give P.
    """
    for P in () if M.shape[1] < MANY_STATES else pair_certificates(M, start=start, sizes=sizes):
        proof = prove(M, P)
        if proof is not None:
            return proof
    search, points = _Rates(M, start, sizes), list[tuple[float, float]]()
    trial, ceiling = 0.0 if search.best is None else search.best.rate, -float(np.linalg.eigvals(M).real.max())
    for step in range(_STEPS):
        margin, best = search.margin(trial), search.best
        if best is None:  # in better coordinates there may be one
            if soon and step == _SOON:
                return None
            if step == _RECENTRED:  # sizes may differ by more than doubles can count with
                return None if sizes is None else best_certificate(M, start=start)
            continue
        if margin is None:
            points, ceiling = [], min(ceiling, trial)
        else:
            points, root = [*points, (trial, margin)][-2:], -np.inf
            if len(points) == 2 and points[0][1] > points[1][1]:
                (a, high), (b, low) = points
                root = b + low * (b - a) / (high - low)
            trial = max(root, best.rate)
            if len(points) == 2 and trial - best.rate <= _CONVERGED * best.rate:
                break
        if ceiling - best.rate <= _ENCLOSED * ceiling:
            break
        if trial >= ceiling:
            trial = (best.rate + ceiling) / 2
    return search.best


def pair_certificates(
    M: Array, *, moved: Array | None = None, start: Array | None = None, sizes: Array | None = None
) -> Iterator[Array]:
    """Yield P (n, n) that may prove nearly the largest rate, where the corners of these M (l, n, n) are a `Pair`.

    With `moved` (n, n), a product with a gain, it is about M + moved.
    """
    corners, by = extreme(M), np.zeros(M.shape[1:]) if moved is None else moved
    for at in (_near(M + by, start, sizes), _near(M + by, None, None)):  # where one is ill-conditioned, the other
        pair = Pair.of(at.system(corners), at.system(by))
        yield from () if pair is None else (at.matrix(P) for P in pair.certificates())


def first_certificate(M: Array) -> Certificate | None:
    """Return the first proof of M_i P + P M_iᵀ ≺ 0 for all cells that is found, of any rate, or None."""
    if not (np.isfinite(M).all() and np.linalg.eigvals(M).real.max(initial=-1.0) < 0):
        return None
    corners, at = extreme(M), _near(M, None, None)
    for _ in range(_RECENTRED + 1):
        found = solve(largest_margin(lyapunov(at.system(corners))), gap=_NEAR, against=0.0)
        if found is None or not found.objective < 0:  # the sign of the largest margin is the same in all coordinates
            return None
        proof = prove(M, at.matrix(found.P))
        if proof is not None:
            return proof
        at = at.centred(found.P)
    return None


def precise_certificate(at: Precise, role: Role, M: Sequence[BallMatrix], start: Array) -> Certificate | None:
    """Return what `best_certificate` finds in coordinates to hundreds of bits, proved in exact numbers.

    The M_i are each different; `start` is a P (n, n) in these coordinates that may prove something.
    """
    inside = at.system([M_i.centre for M_i in M])
    if not (np.isfinite(inside).all() and np.linalg.eigvals(inside).real.max() < 0):
        return None
    found = best_certificate(inside, start=start, soon=True)
    proof = None if found is None else prove_exactly(role, M, at.matrix(found.P / np.linalg.norm(found.P)), found.rate)
    return None if proof is None else of_proof(stack(M), proof)


class _Rates:
    """Rates that are tried one after the other; `best` is the best proof so far."""

    def __init__(self, M: Array, start: Array | None, sizes: Array | None) -> None:
        self.best = None if start is None else prove(M, start)
        self._M, self._corners, self._at = M, extreme(M), _near(M, start, sizes)
        self._last: Solution | None = None

    def margin(self, rate: float) -> float | None:
        """Return about the largest margin at a rate in 1/s; None, and better coordinates, if no proof is found."""
        at = self._at
        inequality = lyapunov(at.system(self._corners), rate / at.speed)
        self._last = found = solve(largest_margin(inequality), gap=_NEAR, after=self._last)
        if found is None:
            return None
        proof = prove(self._M, at.matrix(found.P))
        if proof is not None and (self.best is None or proof.rate > self.best.rate):
            self.best = proof
        if proof is not None and proof.rate >= rate:
            return inequality.margin(found.P)
        self._at, self._last = at.centred(found.P), None
        return None


def least_overshoot_certificate(
    M: Array, rate: float, *, sizes: Array | None = None, start: Array | None = None
) -> Certificate | None:
    """Return a proof of M_i P + P M_iᵀ + 2 rate P ⪯ 0 for all cells with the smallest λmax(P) / λmin(P), P in sizes.

    Its root is the overshoot: how many times its first size an error can reach on its way to 0. None if none is found.
    The rate (1/s) is one below the best; sizes are 1 by default; `start` is a P (n, n) to begin near.

    Example: by itself each of the two turns any error towards 0 at once.

        >>> M = np.array([[[-1.0, 5.0], [-5.0, -1.0]], [[-1.0, 0.0], [0.0, -2.0]]])
        >>> float(np.linalg.cond(least_overshoot_certificate(M, 0.9).P).round(3))
        1.0
    """
    unit = np.eye(M.shape[1]) if sizes is None else np.diag(sizes**2)
    at = _near(M, start, sizes)
    inequality = lyapunov(at.system(extreme(M)), rate / at.speed)
    try:
        candidate = solve(least_condition(inequality, at.driven(unit)), gap=_CLOSE)
    except np.linalg.LinAlgError:  # coordinates that are singular to working precision
        return None
    return None if candidate is None else prove(M, at.matrix(candidate.P))


def well_conditioned(M: Array, rate: float, *, apart: Array, sizes: Array | None = None) -> Array | None:
    """Return a P (n, n) for M_i P + P M_iᵀ + 2 rate P ⪯ 0 of small condition in sizes, where M (l, n, n) is a `Pair`.

    What the M_i differ by, (n, n), is given apart.
    """
    at = Coordinates.sized(M, np.ones(M.shape[1]) if sizes is None else sizes)
    pair = Pair.of(at.system(np.stack([-apart / 2, apart / 2])), at.system(M.mean(axis=0)))
    P = None if pair is None else pair.well_conditioned(rate / at.speed)
    return None if P is None else at.matrix(P)


def _near(M: Array, start: Array | None, sizes: Array | None) -> Coordinates:
    """Return coordinates in which a P near `start`, or without one the P of the mean cell, is near I."""
    at = Coordinates.balanced(M) if sizes is None else Coordinates.sized(M, sizes)
    return at.of_mean(at.system(M)) if start is None else at.centred(at.driven(start))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # entries may be 1e300: what overflows proves nothing
def prove_convergence(
    M: Array,
    *,
    claim: str,
    cells: Sequence[str],
    exact: Sequence[BallMatrix] | None = None,
    role: Role = PLANT,
    sizes: Array | None = None,
    subject: Subject = (),
    hint: str = "every cell needs all its eigenvalues in the open left half plane",
    remedy: Remedy | None = None,
) -> Found:
    """Prove M_i P + P M_iᵀ ≺ 0 for all cells, or say why not. With M_i = A_iᵀ this is (7).

    Where there is no such P, a polynomial that decays may take its place: see `lmi.polynomial`. M is (l, n, n), and the
    claim is what messages say, `"(17)"`. A proof is about the exact matrices M_i, or about the decimals that M prints
    as. Hint and remedy are what to do where a cell is unstable by itself. Raises Infeasible if it is proved that no P
    exists, and no polynomial is found; Undecided if neither is proved.
    """
    if not M.shape[1]:
        return Certificate(M=M, P=np.zeros((0, 0)), rate=np.inf, margin=np.inf)
    abscissa = np.linalg.eigvals(M).real.max(axis=1)
    doubtful = (abscissa > -_DOUBTFUL * np.linalg.norm(M, axis=(1, 2))).any()
    no_input = np.zeros((M.shape[1], 0))
    centres = None if exact is None else ([M_i.centre for M_i in exact], decimals(no_input))
    refuted = partial(refute, M, no_input, exact=centres)
    refutation, tried = refuted() if doubtful else None, tuple[int, ...]()
    if refutation is None or not refutation.eigenvalues:
        best = best_certificate(M, sizes=sizes)
        if best is not None:
            return best
        numbers = different([BallMatrix.of(M_i) for M_i in distinct(M)[0]] if exact is None else exact)
        best = _precisely(role, numbers, np.ones(len(M[0])) if sizes is None else sizes)
        if best is not None:
            return best
        instead, tried = _polynomial(M, role, numbers, sizes)
        if instead is not None:
            return instead
        refutation = refutation or refuted()
    tell = partial(_conflict_text, claim, refutation, abscissa, cells, tried)
    if refutation is None:
        marginal = "the case is marginal or badly scaled: change the data a little to see which way it goes"
        raise Undecided(Problem.of_many(tell, subject=subject, hint=marginal))
    if not refutation.eigenvalues:
        hint = "they differ too much for one Lyapunov function: bring them closer, or damp them more"
        remedy = None
    problem = Problem.of_many(tell, subject=subject, hint=hint, remedy=remedy)
    raise Infeasible(problem, evidence=Impossibility(role=role, rate=0.0, refutation=refutation))


def _precisely(role: Role, numbers: Sequence[BallMatrix], sizes: Array) -> Certificate | None:
    """Look for a P of all cells where that of the mean is so ill-conditioned that doubles do not hold it."""
    mean = sum((M_i.centre for M_i in numbers[1:]), numbers[0].centre) / len(numbers)
    if not is_hurwitz(mean):
        return None
    at = Precise.of_stable(mean, square(sizes))
    return None if at is None else precise_certificate(at, role, numbers, np.eye(len(sizes)))


def _polynomial(
    M: Array, role: Role, numbers: Sequence[BallMatrix], sizes: Array | None
) -> tuple[PolynomialLyapunov | None, tuple[int, ...]]:
    """Return the polynomial of the lowest degree that is proved for all cells, and the degrees that were tried.

    Where programs are small higher degrees are tried too, for a rate that is clearly larger: near the end of what one
    degree can prove its rate is next to 0.
    """
    A = distinct(role.oriented(M))[0]
    if not np.linalg.eigvals(A).real.max() < 0:
        return None, ()
    near, tried = near_polynomial(A, sizes if sizes is None or role.transposed else 1 / sizes), list[int]()
    best, small = None, degrees(A.shape[1], len(A), FEW_ROWS)
    for degree in degrees(A.shape[1], len(A)):
        if best is not None and degree not in small:
            break
        found = best_polynomial(A, degree, near)
        tried.append(degree)
        faster = found is not None and (best is None or found.rate > _WORTH_IT * best.rate)
        if found is not None and faster and prove_polynomial(role, numbers, found) is not None:
            best = found
    return best, tuple(tried)


def near_polynomial(A: Array, sizes: Array | None = None) -> Coordinates:
    """Return the coordinates in which `best_polynomial` looks, for A (l, n, n) by which errors change.

    Sizes (n,) are those of the states of M_i = A_iᵀ, by default those that balance it.
    """
    return _near(A.swapaxes(1, 2), None, sizes)


def _conflict_text(
    claim: str, proof: Refutation | None, abscissa: Array, cells: Sequence[str], tried: Sequence[int], most: int | None
) -> str:
    vain = (
        f", and no polynomial of degree {joined([*map(str, tried)], 'or')} was found to take its place" if tried else ""
    )
    if proof is None:
        said = f"undecided: found neither a common P nor a proof that none exists{vain}"
    elif proof.eigenvalues:
        names = [f"'{cells[i]}'" for i in sorted(proof.eigenvalues, key=lambda i: -abscissa[i])]
        said = f"infeasible: {listed(names, most)} not stable"
    else:
        conflict = conflict_text(proof, cells, most)
        said = f"infeasible: {conflict}, no common P exists for them, though each is stable by itself{vain}"
    return f"{claim} is {said}; {eigenvalue_text(abscissa, cells, most)}"
