"""A proved bound of the quadratic cost of a gain, or of what white noise does to the observer, for any switching."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import Array, readonly, up
from pwatrack.ball_matrix import BallMatrix, different
from pwatrack.claims.exact_text import decimal_texts, doubles
from pwatrack.claims.stable_inversion import StableInversion
from pwatrack.control.controller import Asked, Claim, ProvedController, Told
from pwatrack.control.goal import LeastCost
from pwatrack.control.task import Task
from pwatrack.control.words import Words
from pwatrack.errors import ProblemPart, Undecided
from pwatrack.lmi.audit.shape import kind
from pwatrack.lmi.exact import unsure
from pwatrack.lmi.inequality import CONTROLLER, Role, weighted
from pwatrack.lmi.presolve import Coordinates, extreme
from pwatrack.lmi.program import least_sizes
from pwatrack.lmi.solve import solve
from pwatrack.rational import decimals, fraction_of, is_positive_definite, scalar

_SLACK = 1e-9  # of the mean weight, beside weights that may be 0: what is minimised is then definite
_ROOM = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # by so much X is enlarged, until it is proved


@dataclass(frozen=True, kw_only=True)
class Costs(Claim):
    """Bounds of the costs that were asked for."""

    goals: Mapping[Role, LeastCost]  # what was asked, by the role of the gain
    X: Mapping[Role, Array]  # the proved bounds, (n, n) each: see `cost_bound`

    statement: ClassVar[str] = "X bounds a cost: X > 0 and X M_i + M_i^T X + Q + K^T R K < 0."

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["Costs"]:
        goals = {role: goal for role, goal in asked.words.goals.items() if isinstance(goal, LeastCost)}
        known, X = None if told is None else read_costs(told), dict[Role, Array]()
        for role, goal in goals.items():
            if known is None:
                task = Task.of(asked.words.plant, role, sizes=controller.sizes)
                gain = controller.K if role is CONTROLLER else controller.L
                X[role] = cost_bound(task, role.oriented(gain), goal.Q, goal.R)
            elif role.name in known:
                X[role] = known[role.name]
        if X:
            yield cls(goals=goals, X=X)

    def data(self, controller: ProvedController) -> dict[str, Any]:
        matrices = {role: {"X": X, "Q": self.goals[role].Q, "R": self.goals[role].R} for role, X in self.X.items()}
        texts = {role: {name: decimal_texts(Y) for name, Y in found.items()} for role, found in matrices.items()}
        return {"proofs": [{"of": role.name, **found} for role, found in texts.items()]}

    def texts(self, role: Role, words: Words, controller: ProvedController) -> Iterator[str]:
        """Yield what the bound of the cost of one gain means."""
        played = role is CONTROLLER and controller.claims_of(StableInversion)  # what that leaves drives e for ever
        if role not in self.X or played:
            return
        X, goal = self.X[role], self.goals[role]
        if role is CONTROLLER:
            known = "x̂(0) = x(0)" + ", ŝ(0) = s(0)" * (words.plant.loads is not None)
            yield (
                f"∫(eᵀQe + vᵀRv) dt ≤ e(0)ᵀ X e(0) from {known}, for any switching; e = x − x_d, v = u − u_ff, "
                "X in gains.json"
            )
        elif len(different(words.plant.exact.A)) == 1:
            yield "covariance of Δ = x̂ − x ⪯ X under the white noise given, from x̂(0) = x(0); X in gains.json"
        else:
            level = noise_level(X, controller.design.L, goal.Q, goal.R)
            yield (
                f"E[Δᵀ X⁻¹ W X⁻¹ Δ] ≤ {up(level)} 1/s under the white noise given, averaged over a long time, for any "
                "switching; Δ = x̂ − x, W = Q + L R Lᵀ, X in gains.json"
            )


def read_costs(content: Mapping[str, Any]) -> dict[str, Array]:
    """Return the bounds of costs that a certificate holds, by what they are of."""
    return {proof["of"]: doubles(proof["X"]) for proof in content["proofs"] if kind(proof) == "cost"}


def cost_bound(task: Task, K: Array, Q: Array, R: Array) -> Array:
    """Return X (n, n) with X M_i + M_iᵀ X + Q + KᵀRK ≺ 0 for M_i = A_i + B K, proved exactly, of small trace.

    For K it bounds ∫(eᵀQe + vᵀRv) dt by e(0)ᵀ X e(0), e = x − x_d and v = u − u_ff, where nothing but e drives e: from
    x̂(0) = x(0), of loads that are estimated ŝ(0) = s(0), and where x_d is not played back. For the observer, with A_iᵀ,
    Cᵀ and Lᵀ, W = Q + L R Lᵀ and white noise of density Q on ẋ and R on y, the average of E[Δᵀ X⁻¹ W X⁻¹ Δ] over a long
    time is at most tr(X⁻¹W); the covariance of Δ = x̂ − x is at most X only where all M_i are the same. Both
    are proved in `docs/theory/beyond.md`, *Costs*. Raises Undecided if no X could be proved.

    Example:
        >>> task = Task(A=np.array([[[0.0]]]), B=np.eye(1), cells=["all"])
        >>> cost_bound(task, -np.eye(1), np.eye(1), np.eye(1)).round(4).tolist()
        [[1.0]]
    """
    weight, exact = Q + K.T @ R @ K, task.exactly_closed(K)
    matrices = np.swapaxes(extreme(task.closed(K)), 1, 2)
    slack = _SLACK * float(np.trace(weight)) / len(Q) * np.eye(len(Q))
    at = Coordinates.balanced(matrices)
    at = at.of_mean(at.system(matrices), at.driven(weight + slack))
    inside = at.driven(weight + slack)
    size = float(np.linalg.norm(inside, 2))
    candidate = solve(least_sizes(weighted(at.system(matrices), inside / size), np.eye(len(Q)), above=0 * slack))
    if candidate is not None:
        X = at.matrix(candidate.P) * size / at.speed
        for room in _ROOM:
            trial = (X + X.T) / 2 * (1 + room)
            if np.isfinite(trial).all() and _proved(exact, K, Q, R, trial):
                return readonly(trial)
    raise Undecided(
        f"{task.role.claim}: the gain of least cost was found, but no bound of its cost could be proved",
        subject=(task.role.part, ProblemPart.COST),
        hint="weights that differ less in size may help",
    )


def noise_level(X: Array, L: Array, Q: Array, R: Array) -> float:
    """Return tr(X⁻¹ W), W = Q + L R Lᵀ, rounded up: the bound of E[Δᵀ X⁻¹ W X⁻¹ Δ], see `cost_bound`.

    Example:
        >>> one = np.eye(1)
        >>> 8.0 <= noise_level(one / 4, one, one, one) < 8.0 + 1e-12
        True
    """
    exact = decimals(L)
    W = decimals(Q) + exact * decimals(R) * exact.transpose()
    level = decimals(X).inv() * W
    value = fraction_of(sum((level[k, k] for k in range(len(X))), scalar(0.0)))
    near = float(value)
    return near if Fraction(near) >= value else float(np.nextafter(near, np.inf))


def _proved(M: Sequence[BallMatrix], K: Array, Q: Array, R: Array, X: Array) -> bool:
    exact, gain = decimals(X), decimals(K)
    unit = [Fraction(v) for v in np.sqrt(np.maximum(np.diag(X), 1e-300)).tolist()]
    weight = decimals(Q) + gain.transpose() * decimals(R) * gain
    if not is_positive_definite(exact):
        return False
    for M_i in different(M):
        XM = exact * M_i.centre
        radius = None if M_i.radius is None else M_i.radius.transpose()
        if not is_positive_definite(-(XM + XM.transpose()) - unsure(radius, exact, unit) - weight):
            return False
    return True
