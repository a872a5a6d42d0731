"""Theorem 2: controller gain K from (8), observer gain L from (9), each with its proof."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_continuous_are, solve_continuous_lyapunov

from pwatrack.arrays import Array, complex_text, readonly
from pwatrack.ball_matrix import BallMatrix
from pwatrack.control.convergence import Impossibility, best_certificate, conflict_text, prove_convergence
from pwatrack.control.goal import DEFAULT, Goal
from pwatrack.errors import Infeasible, InvalidSpec, Problem, PwatrackError, Subject, Undecided, listed
from pwatrack.lmi.certificate import Certificate, prove
from pwatrack.lmi.exact import RATE_GIVEN
from pwatrack.lmi.inequality import Inequality, Solver, quadratic_cost, state_feedback
from pwatrack.lmi.infeasibility import Refutation, refute
from pwatrack.lmi.presolve import Scaling, centre, distinct
from pwatrack.lmi.program import (
    Solution,
    largest_margin,
    least_cost,
    smaller_gain,
    smallest_gain,
)
from pwatrack.lmi.solve import LARGE, solve
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import Rational

_STATE_WEIGHTS = (1.0, 1e-2, 1e-4, 1e-6)
_RECENTRED = 3  # so often a problem is solved in the coordinates of its last answer
_BOUNDS_OF_Y = (10.0, 1e3, 1e5)  # of (8) with P ⪯ I, relative to ‖A‖ / ‖B‖, for large plants: tried in turn
_CLOSER = 3  # times the bound of the norm is drawn closer; the first brings most, so that large plants have only that
_FASTER = (2e-3, 5e-4)  # than asked, as a share, so that a margin is left for the exact proof
_RATES = 16  # at most so many rates are tried for the fastest one
_SLOWER = 6  # so often it is divided by 4 where the bound is too small for it
_ENDED = 2e-3  # relative distance of the rates that are known to be in and out of reach at which that search ends


@dataclass(frozen=True, kw_only=True)
class Design:
    """The gains of Theorem 2.

    Attributes:
        K: Controller gain (m, n): u = K (x̂ − x_d) + u_ff.
        L: Observer gain (n, q): + L (ŷ − y).
        controller: Proof that sym((A_i + B K) P_c) ≺ 0 for all cells: (8).
        observer: Proof that sym((A_i + L C)ᵀ P_o) ≺ 0 for all cells: (9).
    """

    K: Array
    L: Array
    controller: Certificate
    observer: Certificate


def synthesize(
    plant: PWASystem, *, controller: Goal = DEFAULT, observer: Goal = DEFAULT, solver: Solver = "clarabel"
) -> Design:
    """Find K and L by Theorem 2, or prove the ones that are given.

    Args:
        plant: The system (1).
        controller: What K is to achieve, in the sign convention of (10).
        observer: What Lᵀ is to achieve.
        solver: Which interior-point solver to ask.

    Raises:
        Infeasible: If (8) or (9) is proved to have no solution, or a given gain to be none.
        Undecided: If neither is proved, or no gain within the bound was found.

    Example:
        >>> from pwatrack import load_spec
        >>> plant = load_spec("specs/two_mass_backlash.yaml").problem.plant
        >>> design = synthesize(plant, controller=Goal(rate=0.1, gain="smallest"))
        >>> design.controller.rate >= 0.1, bool(np.linalg.norm(design.K, 2) < 0.86)
        (True, True)
    """
    K, P_c = _gain(controller_task(plant, solver), controller)
    L_transposed, P_o = _gain(observer_task(plant, solver), observer)
    return Design(K=readonly(K), L=readonly(L_transposed.T), controller=P_c, observer=P_o)


@dataclass(frozen=True, kw_only=True)
class Task:
    """Find K with sym((A_i + B K) P) ≺ 0 in every cell: (8), or (9) transposed.

    Attributes:
        A: (l, n, n).
        B: (n, m).
        exact: A_i and B in the numbers that proofs are about; None for the decimals that A and B print as.
        of: "controller" or "observer".
        claim: For messages: `"(8)"`.
        cells: Names of the l cells.
        subject: What in the description a refusal is about.
        solver: Which interior-point solver to ask.
    """

    A: Array
    B: Array
    exact: tuple[Sequence[BallMatrix], BallMatrix] | None = None
    of: str = "controller"
    claim: str = "(8)"
    cells: Sequence[str]
    subject: Subject = ()
    solver: Solver = "clarabel"


def controller_task(plant: PWASystem, solver: Solver = "clarabel") -> Task:
    """Return the inequality (8)."""
    return Task(
        A=plant.A,
        B=plant.B,
        exact=(plant.exact.A, plant.exact.B),
        cells=plant.cell_names,
        subject=("system", "B"),
        solver=solver,
    )


def observer_task(plant: PWASystem, solver: Solver = "clarabel") -> Task:
    """Return the inequality (9), as (8) for the transposed plant: K there is Lᵀ here."""
    return Task(
        A=np.swapaxes(plant.A, 1, 2),
        B=plant.C.T,
        exact=([A_i.transpose() for A_i in plant.exact.A], plant.exact.C.transpose()),
        of="observer",
        claim="(9)",
        cells=plant.cell_names,
        subject=("system", "C"),
        solver=solver,
    )


def _centres(task: Task) -> tuple[list[Rational], Rational] | None:
    return None if task.exact is None else ([A_i.centre for A_i in task.exact[0]], task.exact[1].centre)


def _gain(task: Task, goal: Goal) -> tuple[Array, Certificate]:
    """Return a gain for (8), found or given, with its proof; (9) is (8) transposed."""
    if goal.given is None:
        return stabilising_gain(task, goal)
    letter = "K" if task.of == "controller" else "L"
    A, B = task.exact or ([BallMatrix.of(A_i) for A_i in task.A], BallMatrix.of(task.B))
    certificate = prove_convergence(
        task.A + task.B @ goal.given,
        exact=[A_i + B @ BallMatrix.of(goal.given) for A_i in A],
        claim=f"{task.claim} for the given gain {letter}",
        cells=task.cells,
        of=task.of,
        subject=("design", task.of, letter),
        solver=task.solver,
        hint=f"mind the signs: u = K (x̂ − x_d) + u_ff, + L (ŷ − y); or leave {letter} out to have it designed",
    )
    return goal.given, certificate


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # entries may be 1e300: what overflows proves nothing
def stabilising_gain(task: Task, goal: Goal = DEFAULT) -> tuple[Array, Certificate]:
    """Return the gain K = Y P⁻¹ of (8) that meets a goal, with the proof of its best rate.

    Where only a rate is asked, or nothing, the gain minimises a quadratic cost (of the system with the rate
    added to A). The weights are those of balanced units: states scaled to balance A, inputs
    and time scaled so that A and B have size 1. There the weights on states and
    inputs are one, so no weight has to be chosen. (States that do not act on
    each other both ways, as in a chain of integrators, have no balanced units: there the
    weights are one in the units given.) Such a gain is 0 only where the input does nothing. Where the solver
    finds no proof for it, lighter weights on the states are tried, and then the gain of the largest margin.

    Args:
        task: The inequality.
        goal: What is asked; `goal.given` is not looked at.

    Returns:
        K (m, n) and its certificate.

    Raises:
        Infeasible: If no gain exists, proved.
        InvalidSpec: If the largest rate is asked where every rate can be reached.
        Undecided: If no gain with a proof is found otherwise.

    Example: a double integrator.

        >>> A, B = np.array([[[0.0, 1.0], [0.0, 0.0]]]), np.array([[0.0], [1.0]])
        >>> K, certificate = stabilising_gain(Task(A=A, B=B, cells=["all"]))
        >>> K.round(3).tolist(), certificate.rate > 0.8
        ([[-1.0, -1.732]], True)
    """
    search = Search(task)
    if goal.Q is not None and goal.R is not None:
        found = search.least_cost(goal.Q, goal.R)
    elif goal.fastest:
        found = search.largest_rate(goal.bound)
    elif goal.gain == "smallest":
        found = search.gentlest(goal.least_rate)
    else:
        found = search.balanced(goal.least_rate)
        if found is not None and _norm(found[0]) > goal.bound:
            found = search.gentlest(goal.least_rate)
    if found is None:
        raise _refusal(task, goal.least_rate, search.refuted(goal.least_rate), search.best_margin)
    if _norm(found[0]) > goal.bound:
        raise _too_large(task, goal, _norm(found[0]))
    return found


class Search:
    """Ways to look for a gain, in balanced units; each returns it with its proof, or None."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.scaling = Scaling.of(task.A, task.B)
        self.A, _ = distinct(self.scaling.system(task.A))
        self.B = self.scaling.input(task.B)
        self.mean = self.A.mean(axis=0)
        self.best_margin = -np.inf  # found for (8), where A and P have size 1
        self._refuted = dict[float, Refutation | None]()

    def refuted(self, rate: float) -> Refutation | None:
        """Return a proof that no gain reaches a rate (1/s), if one is found."""
        if rate not in self._refuted:
            self._refuted[rate] = refute(
                self.task.A, self.task.B, rate=rate, solver=self.task.solver, exact=_centres(self.task)
            )
        return self._refuted[rate]

    def balanced(self, rate: float) -> tuple[Array, Certificate] | None:
        """Minimise the cost with unit weights; where that gives no proof, return the gain of the largest margin."""
        margin = self._largest_margin(rate)
        if margin is None and self.refuted(rate) is not None:
            return None
        shift = rate * (1 + _FASTER[0]) / self.scaling.speed * np.eye(len(self.mean))
        for Q in _state_weights(self.mean + shift, self.B):
            found = self._cost_gain(shift, Q, np.eye(self.B.shape[1]), np.eye(len(Q)), rate)
            if found is not None:
                return found
            if margin is not None:
                break  # a lighter weight would only help where the solver is at its limits
        return None if margin is None else self._proved(margin[0], rate, margin[1].P)

    def least_cost(self, Q: Array, R: Array) -> tuple[Array, Certificate] | None:
        """Minimise tr P⁻¹, a bound on the cost from any unit vector."""
        d, e = self.scaling.d, self.scaling.e
        return self._cost_gain(np.zeros_like(self.mean), d[:, None] * Q * d, e[:, None] * R * e, np.diag(1 / d), 0.0)

    def gentlest(self, rate: float) -> tuple[Array, Certificate] | None:
        """Return the smallest gain that is found in any way: in units that differ a lot that of `balanced` may be."""
        found = [way for way in (self.smallest_gain(rate), self.balanced(rate)) if way is not None]
        return min(found, key=lambda way: _norm(way[0]), default=None)

    def smallest_gain(self, rate: float) -> tuple[Array, Certificate] | None:
        """Minimise a bound on the norm of the gain, in the units given."""
        found = self._within(rate)
        return None if found is None else self._proved(found[0], rate, found[1].P)

    def largest_rate(self, bound: float) -> tuple[Array, Certificate] | None:
        """Bisect the rate, in its logarithm, for the fastest decay that a gain within the bound gives.

        All eigenvalues of A_i + B K are left of minus the rate, so n times the rate is at most −tr(A_i + B K), and
        |tr(B K)| ≤ ‖K‖ ‖B‖⁎, the sum of the singular values of B.

        Raises:
            InvalidSpec: If there is no bound, and no largest rate.
        """
        best = self.balanced(0.0)
        if best is None or _norm(best[0]) > bound:
            best = self._slowly(self.scaling.speed if best is None else best[1].rate, bound) or best
        if best is None or _norm(best[0]) > bound:
            return best
        slow, fast = best[1].rate, 8 * self.scaling.speed
        if np.isinf(bound):
            if slow >= fast or self._within(fast, bound) is not None:
                raise _no_largest_rate(self.task, max(slow, fast))
        else:
            traces = np.trace(self.task.A, axis1=1, axis2=2)
            fast = float(bound * np.linalg.norm(self.task.B, "nuc") - traces.max()) / len(self.mean)
        for _ in range(_RATES):
            if not fast > slow * (1 + _ENDED):
                break
            trial = float(np.sqrt(slow) * np.sqrt(fast))
            found = self._within(trial, bound)
            if found is None:
                fast = trial
            else:
                best, slow = found, max(found[1].rate, trial)
        small = self._within(slow * (1 - _ENDED)) if np.isinf(bound) else None
        best = small or best
        return self._proved(best[0], 0.0, best[1].P)

    def _slowly(self, rate: float, bound: float) -> tuple[Array, Certificate] | None:
        """Return a gain within a bound at a rate below this one; the smallest that is found where none is.

        Not at a rate of 0: there the smallest gain is the limit of those that decay, and has no proof itself.
        """
        for _ in range(_SLOWER):
            rate /= 4
            found = self._within(rate, bound)
            if found is not None:
                return found
        return self._within(rate)

    def _within(self, rate: float, bound: float | None = None) -> tuple[Array, Certificate] | None:
        """Return the smallest gain that is found for a rate; with a bound, soon, the first that keeps it.

        A candidate counts only if its own P proves it: so each call solves a few programs, and a search
        that makes many of them ends.
        """
        found = self._proved(np.zeros((self.B.shape[1], len(self.mean))), rate)
        if found is not None:
            return found
        eye = np.eye(len(self.mean))
        for faster in _FASTER if bound is None else _FASTER[:1]:
            trial = rate * (1 + faster) / self.scaling.speed
            W, W_inverse = _riccati_coordinates(self.mean + trial * eye, self.B, eye)
            for _ in range(_RECENTRED if bound is None else _RECENTRED - 1):
                found, last = self._smallest(trial, W, W_inverse, rate, bound)
                if found is not None:
                    return found if bound is None or _norm(found[0]) <= bound else None
                if last is None:
                    break
                W, W_inverse = _recentred(W, W_inverse, last.P)
        return None

    def _smallest(
        self, trial: float, W: Array, W_inverse: Array, rate: float, bound: float | None
    ) -> tuple[tuple[Array, Certificate] | None, Solution | None]:
        """Minimise the norm of the gain at a trial rate, in scaled time and z = W x, until it keeps a bound.

        Returns:
            The smallest gain that its own P proves, and the candidate that was looked at last.
        """
        best, last = None, None
        inequality = state_feedback(W @ self.A @ W_inverse, W @ self.B, trial)
        for last in self._least_norms(inequality, W / self.scaling.d, np.diag(self.scaling.e)):
            K = _short(self._gain_of(last, W))
            P = self.scaling.matrix(W_inverse @ last.P @ W_inverse.T)
            certificate = prove(self.task.A + self.task.B @ K, P) if np.isfinite(K).all() else None
            if certificate is None or not _reaches(certificate, rate):
                break
            best = K, certificate
            if bound is not None and _norm(K) <= bound:
                break
        return best, last

    def _least_norms(self, inequality: Inequality, metric_root: Array, input_root: Array) -> Iterator[Solution]:
        """Minimise first a bound of the norm, then the closer bounds that each answer allows; the last is the best."""
        large = inequality.n >= LARGE
        last = solve(smallest_gain(inequality, metric_root, input_root), self.task.solver)
        for closer in range(_CLOSER + 1):
            if last is None or not _definite(last.P):
                return
            yield last
            if closer == (1 if large else _CLOSER):
                return
            last = solve(smaller_gain(inequality, metric_root, input_root, (last.P, last.Y)), self.task.solver)

    def _largest_margin(self, rate: float) -> tuple[Array, Certificate] | None:
        """Maximise the margin; the proof is the first that comes, its rate not the best one."""
        eye, trial = np.eye(len(self.mean)), rate * (1 + 1e-3) / self.scaling.speed
        large = len(eye) >= LARGE
        for factor in _BOUNDS_OF_Y if large else (np.inf,):
            W, W_inverse = _riccati_coordinates(self.mean + trial * eye, self.B, eye) if large else (eye, eye)
            for _ in range(2 * _RECENTRED):
                inequality = state_feedback(W @ self.A @ W_inverse, W @ self.B, trial)
                most = _most(inequality, factor) if large else None
                candidate = solve(largest_margin(inequality, most), self.task.solver)
                if candidate is None:
                    return None
                K = _short(self._gain_of(candidate, W))
                P = self.scaling.matrix(W_inverse @ candidate.P @ W_inverse.T)
                certificate = prove(self.task.A + self.task.B @ K, P) if np.isfinite(K).all() else None
                if certificate is not None and _reaches(certificate, rate):
                    return K, certificate
                margin = inequality.margin(candidate.P, candidate.Y)
                self.best_margin = max(self.best_margin, margin)
                if margin < 0:
                    if self.refuted(rate) is not None:
                        return None
                    if factor < _BOUNDS_OF_Y[-1]:
                        break
                W, W_inverse = _recentred(W, W_inverse, candidate.P)
        return None

    def _cost_gain(
        self, shift: Array, Q: Array, R: Array, weight: Array, rate: float
    ) -> tuple[Array, Certificate] | None:
        W, W_inverse = _riccati_coordinates(self.mean + shift, self.B, Q, R)
        inequality = quadratic_cost(W @ (self.A + shift) @ W_inverse, W @ self.B, _root(Q) @ W_inverse, R)
        candidate = solve(least_cost(inequality, weight @ W.T), self.task.solver)
        if candidate is not None:
            candidate = replace(candidate, Y=-np.linalg.solve(R, (W @ self.B).T).astype(np.float64))
        return self._candidate(candidate, W, W_inverse, rate)

    def _candidate(
        self, candidate: Solution | None, W: Array, W_inverse: Array, rate: float
    ) -> tuple[Array, Certificate] | None:
        """Prove the gain Y P⁻¹ of a solution in z = W x."""
        if candidate is None:
            return None
        return self._proved(
            self._gain_of(candidate, W), rate, self.scaling.matrix(W_inverse @ candidate.P @ W_inverse.T)
        )

    def _gain_of(self, candidate: Solution, W: Array) -> Array:
        """Return Y P⁻¹ in the units given; not a number where P is not positive definite to working precision."""
        if not _definite(candidate.P):
            return np.full((self.B.shape[1], len(W)), np.nan)
        return self.scaling.gain(np.linalg.solve(candidate.P, candidate.Y.T).T.astype(np.float64) @ W)

    def _proved(self, K: Array, rate: float, P: Array | None = None) -> tuple[Array, Certificate] | None:
        """Prove a gain as it will be printed, if it reaches the rate; P may help."""
        K = _short(K)
        closed = self.task.A + self.task.B @ K
        if not np.isfinite(closed).all() or not np.linalg.eigvals(closed).real.max() < -rate:
            return None
        certificate = best_certificate(closed, start=P, solver=self.task.solver)
        return (K, certificate) if certificate is not None and _reaches(certificate, rate) else None


def _reaches(certificate: Certificate, rate: float) -> bool:
    """Say whether the exact proof, which gives up a little, will still show the rate."""
    return certificate.rate * (1 - 2 * RATE_GIVEN) >= rate


def _recentred(W: Array, W_inverse: Array, P: Array) -> tuple[Array, Array]:
    """Return z = W x in which P is I; as they are where P is not definite."""
    try:
        V, inverse = centre(P)
    except np.linalg.LinAlgError:
        return W, W_inverse
    return inverse @ W, W_inverse @ V


def _refusal(task: Task, rate: float, refutation: Refutation | None, margin: float) -> PwatrackError:
    """Return the refusal with the proof that no gain reaches the rate, or say that there is neither gain nor proof."""
    goal, subject = (f" at a rate of {rate:g} 1/s", ("design", task.of, "rate")) if rate else ("", task.subject)
    if refutation is None:
        message = f"{task.claim}{goal} is undecided: no gain with a proof was found, and no proof that there is none"
        if np.isfinite(margin):
            message += f"; the best margin found is {margin:.2g}, relative to the largest entries"
        hint = "another actuator or measured output may help, or the other solver: --solver cvxopt"
        return Undecided(Problem(message=message, subject=subject, hint=hint))
    slower = ", or a slower rate" if rate else ""
    if refutation.eigenvalues:
        worst = sorted(refutation.eigenvalues.items(), key=lambda item: -item[1].real)
        modes = [f"{complex_text(v - rate)} in cell '{task.cells[i]}'" for i, v in worst]
        hint = f"another actuator, or another measured output, must reach this mode{slower}"
    else:
        hint = f"another actuator or another measured output may help, cells that differ less{slower}"

    def tell(most: int | None) -> str:
        if refutation.eigenvalues:
            return f"{task.claim}{goal} is infeasible: no gain moves the eigenvalue {listed(modes, most)}"
        return (
            f"{task.claim}{goal} is infeasible: {conflict_text(refutation, task.cells, most)}, no gain with a common P "
            f"exists for them, though each {'reaches that rate' if rate else 'can be stabilised'} by itself"
        )

    return Infeasible(
        Problem.of_many(tell, subject=subject, hint=hint),
        evidence=Impossibility(of=task.of, rate=rate, refutation=refutation),
    )


def _too_large(task: Task, goal: Goal, norm: float) -> Undecided:
    goal_text = f" at a rate of {goal.least_rate:g} 1/s" if goal.least_rate else ""
    return Undecided(
        Problem(
            message=f"{task.claim}{goal_text}: no gain with a norm of at most {goal.bound:g} was found; "
            f"the smallest that was found has {norm:.4g}",
            subject=("design", task.of, "gain"),
            hint="allow a larger gain or a slower rate",
        )
    )


def _no_largest_rate(task: Task, rate: float) -> InvalidSpec:
    return InvalidSpec(
        Problem(
            message=f"{task.claim} has no largest rate: even {rate:.4g} 1/s can be reached, with ever larger gains",
            subject=("design", task.of, "rate"),
            hint="give a bound beside it, for example gain: 100, or the rate that is wanted",
        )
    )


def _state_weights(A: Array, B: Array) -> Iterator[Array]:
    """Yield the weights Q of the quadratic cost, in the order in which they are tried.

    First multiples of I. Then multiples of the inverse of the controllability
    Gramian of the damped mean cell, which do not depend on the choice of states:
    x' Q x is the effort it takes to get to x.
    """
    eye = np.eye(len(A))
    yield from (weight * eye for weight in _STATE_WEIGHTS)
    damping = 2.0 * max(float(np.abs(np.linalg.eigvals(A)).max()), 1e-2)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it is only a weight
            gramian = solve_continuous_lyapunov(A - damping * eye, -B @ B.T)
        values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    except (np.linalg.LinAlgError, ValueError):  # an entry is not finite
        return
    if values[-1] > 0:
        inverse = (vectors / np.maximum(values, 1e-12 * values[-1])) @ vectors.T
        yield from (weight * damping * (inverse + inverse.T) / 2 for weight in _STATE_WEIGHTS)


def _riccati_coordinates(A: Array, B: Array, Q: Array, R: Array | None = None) -> tuple[Array, Array]:
    """Return W (n, n) and its inverse such that in z = W x the cost of the mean cell's LQR is |z|².

    There the optimal P of (8) is near I, which is where a solver is most exact.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # coordinates that are not exact are still coordinates
            X = solve_continuous_are(A, B, Q, np.eye(B.shape[1]) if R is None else R)
        W = cholesky((X + X.T) / 2)
        return W, np.asarray(np.linalg.inv(W), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError):
        return np.eye(len(A)), np.eye(len(A))


def _most(inequality: Inequality, factor: float = 10.0) -> float:
    """Return a bound of Y in (8) for P ⪯ I: a multiple of ‖A‖ / ‖B‖."""
    size = np.linalg.norm(inequality.L, 2, axis=(1, 2)).max(initial=0.0)
    return factor * float(size) / max(float(np.linalg.norm(inequality.M[0], 2)), 1e-300)


def _root(Q: Array) -> Array:
    """Return X with Xᵀ X = Q ⪰ 0."""
    values, vectors = np.linalg.eigh((Q + Q.T) / 2)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T, dtype=np.float64)


def _definite(P: Array) -> bool:
    values = np.linalg.eigvalsh(P)
    return bool(values[0] > np.finfo(np.float64).eps * values[-1])


def _norm(K: Array) -> float:
    return float(np.linalg.norm(K, 2))


def _short(K: Array) -> Array:
    """Return the gain with nine significant digits, none of them −0: what is printed is what is proved and used."""
    return np.array([[float(f"{v:.8e}") + 0.0 for v in row] for row in K]).reshape(K.shape)
