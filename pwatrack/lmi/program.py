"""What is asked of P and Y beside the inequality. Each program is described once, as data; solvers read it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.lmi.inequality import Inequality

_LEAST_NORM = 1e-12  # of a gain, as a unit of its bound


@dataclass(frozen=True, kw_only=True)
class SemidefiniteProgram:
    """Minimise price · t, tr W P, or tr V P⁻¹ Vᵀ, subject to inequalities in P, Y and a scalar t, and equalities.

    Raises ValueError if shapes do not fit, or more than one objective is given.
    """

    constraints: tuple[Inequality, ...]  # the inequalities, at least one; all have the same P, Y and t
    price: float  # of t: −1 makes it large, 1 small; 0 where t is not what counts
    weight: Array | None = None  # V (k, n) where tr V P⁻¹ Vᵀ is to be small
    cost: Array | None = None  # W (n, n), symmetric, where tr W P is to be small
    equalities: tuple[tuple[Array, float], ...] = ()  # E (n, n), symmetric, and value of each tr E P = value

    def __post_init__(self) -> None:
        if not self.constraints or any((c.n, c.m) != (self.n, self.m) for c in self.constraints):
            raise ValueError("the constraints of a program have the same P and Y, and there is at least one")
        if bool(self.price) + (self.weight is not None) + (self.cost is not None) > 1:
            raise ValueError("a program has one objective: t, tr W P or tr V P⁻¹ Vᵀ")
        if self.price and all(c.T is None for c in self.constraints):
            raise ValueError("t is the objective and stands in no constraint")
        if self.weight is not None and self.weight.shape[1] != self.n:
            raise ValueError(f"V has {self.weight.shape[1]} columns, P has {self.n}")
        if self.cost is not None and self.cost.shape != (self.n, self.n):
            raise ValueError(f"W is {self.cost.shape[0]} × {self.cost.shape[1]}, P is {self.n} × {self.n}")
        if any(E.shape != (self.n, self.n) or (E.T != E).any() for E, _ in self.equalities):
            raise ValueError(f"the matrix of an equality is symmetric and {self.n} × {self.n}, as P is")

    @property
    def n(self) -> int:
        """Order of P."""
        return self.constraints[0].n

    @property
    def m(self) -> int:
        """Number of rows of Y."""
        return self.constraints[0].m

    @property
    def finite(self) -> bool:
        """Whether no entry is infinite or not a number: else no solver is asked."""
        parts = [X for c in self.constraints for X in (c.L, c.R, c.M, c.N, c.constant, c.T)]
        parts += [self.weight, self.cost, *(E for E, _ in self.equalities)]
        return all(X is None or bool(np.isfinite(X).all()) for X in parts)

    def objective(self, P: Array, t: float) -> float:
        """Return what is to be small."""
        if self.price:
            return self.price * t
        if self.weight is not None:
            return float((self.weight.T * np.linalg.solve(P, self.weight.T)).sum())
        return float((self.slope * P).sum())

    @property
    def slope(self) -> Array:
        """The gradient of the objective with respect to P, (n, n), where it is linear, else 0."""
        return np.zeros((self.n, self.n)) if self.cost is None else self.cost


@dataclass(frozen=True, kw_only=True)
class Solution:
    """What a solver returned for a program. It proves nothing before it is looked at, whatever the solver says."""

    program: SemidefiniteProgram  # what was asked
    P: Array  # (n, n)
    Y: Array  # (m, n)
    t: float
    multipliers: tuple[Array, ...] | None = None  # of each constraint, (l, N, N) each, where the solver gives them
    # whether the multipliers say that nothing satisfies all constraints: then Σ tr Z_i F_i(P, Y, t) is 1 for whatever
    # satisfies the equalities, up to rounding, and P, Y and t are the last that were tried
    impossible: bool = False
    iterations: int | None = None  # how many the solver made from where it last began, where it says so

    @property
    def objective(self) -> float:
        """What is to be small."""
        return self.program.objective(self.P, self.t)

    @property
    def bound(self) -> float:
        """Below which the objective cannot be, if the multipliers are what they should be.

        It is Σ tr Z_i C_i − Σ y_k value_k, and the least of tr V P⁻¹ Vᵀ + tr G P, which is 2 tr (V G Vᵀ)^½, where that
        is the objective.
        """
        if self.multipliers is None:
            return -np.inf
        pairs, equalities = [*zip(self.multipliers, self.program.constraints, strict=True)], self.program.equalities
        G = np.sum([c.adjoint(Z)[0] for Z, c in pairs], axis=0)
        columns = np.array([E.ravel() for E, _ in equalities]).reshape(-1, self.program.n**2).T
        prices = np.linalg.lstsq(columns, -(G + self.program.slope).ravel())[0]  # that leave the least of the gradient
        total = sum(float((Z * c.constant).sum()) for Z, c in pairs)
        total -= sum(float(y) * value for y, (_, value) in zip(prices, equalities, strict=True))
        if self.program.weight is not None:
            V = self.program.weight
            total += 2 * float(np.sqrt(np.maximum(np.linalg.eigvalsh(V @ G @ V.T), 0.0)).sum())
        return total

    @property
    def gap(self) -> float:
        """Between the objective and its bound; infinite where there is none."""
        return self.objective - self.bound


def largest_margin(inequality: Inequality, most: float | None = None, *, any_sign: bool = False) -> SemidefiniteProgram:
    """Maximise t subject to F_i(P, Y) ⪯ −t I for all cells and t I ⪯ P ⪯ I, t ≤ 1, and ‖Y‖ ≤ most where that is given.

    Without a bound Y may become large for a margin that is hardly better. For a P of any sign −I ⪯ P in place of t I.
    """
    n, N, eye = inequality.n, inequality.L.shape[1], np.eye(inequality.n)
    bounds_of_Y = []  # as [most I, Y; Yᵀ, most I] ⪰ 0
    if most is not None and inequality.m:
        square = bound_of_gain(
            inequality, np.eye(inequality.m), most=most, factors=(0 * eye, eye), constant=-most * eye
        )
        bounds_of_Y.append(square)
    return SemidefiniteProgram(
        constraints=(
            replace(inequality, T=np.broadcast_to(np.eye(N), inequality.constant.shape)),
            of_P(inequality, -1.0, constant=-eye) if any_sign else of_P(inequality, -1.0, T=eye),
            of_P(inequality, 1.0, constant=-eye),
            of_P(inequality, 1.0, np.zeros((1, n)), constant=-np.eye(1), T=np.eye(1)),
            *bounds_of_Y,
        ),
        price=-1.0,
    )


def least_violation(inequalities: Sequence[Inequality], definite: int | None = None) -> SemidefiniteProgram:
    """Minimise t subject to F_i(P, Y) ⪯ t I for all cells, P ⪰ 0 and tr P = 1.

    Where the least t is positive, the multipliers U_i have Σ tr U_i F_i(P, Y) ≥ t tr P for any P ⪰ 0 and Y. Each
    inequality has cells of one order. P ⪰ 0 and tr P = 1 may speak of the first diagonal block of P alone, of the order
    `definite`; the rest may be anything.
    """
    first = inequalities[0]
    order, eye = first.n if definite is None else definite, np.eye(first.n)
    violated = (replace(c, T=np.broadcast_to(-np.eye(c.L.shape[1]), c.constant.shape)) for c in inequalities)
    bounded = (of_P(first, -1.0, eye[:order]),) if order else ()
    equalities = ((np.diag((np.arange(first.n) < order).astype(float)), 1.0),) if order else ()
    return SemidefiniteProgram(constraints=(*violated, *bounded), price=1.0, equalities=equalities)


def least_condition(inequality: Inequality, unit: Array) -> SemidefiniteProgram:
    """Minimise κ subject to F_i(P) ⪯ 0 for all cells and U ⪯ λP ⪯ κU for some λ > 0.

    κ may be 1e12: so P ⪰ t U / λmax(U) and P ⪯ U / λmin(U), the latter as a bound of I, where all numbers are about 1.
    U (n, n), positive definite, is the P that would be the identity in the units that count. Raises LinAlgError if U is
    not positive definite.
    """
    values, vectors = np.linalg.eigh(unit)
    if not values[0] > 0:
        raise np.linalg.LinAlgError("U is not positive definite")
    narrow = vectors / np.sqrt(values / values[0])
    return SemidefiniteProgram(
        constraints=(
            inequality,
            of_P(inequality, -1.0, T=unit / values[-1]),
            of_P(inequality, 1.0, narrow.T, constant=-np.eye(len(unit))),
        ),
        price=-1.0,
    )


def least_sizes(inequality: Inequality, W: Array, above: Array | None = None) -> SemidefiniteProgram:
    """Minimise tr W P, W ⪰ 0, subject to F_i(P) ⪯ 0 for all cells and P ⪰ D; without D, F_i must make P ≻ 0."""
    more = () if above is None else (of_P(inequality, -1.0, constant=above),)
    return SemidefiniteProgram(constraints=(inequality, *more), price=0.0, cost=W)


def least_cost(inequality: Inequality, weight: Array) -> SemidefiniteProgram:
    """Minimise tr V P⁻¹ Vᵀ subject to a `quadratic_cost`, and P ⪰ 0: costs of initial states, rows of V, added up."""
    V = weight / np.linalg.norm(weight, 2)
    return SemidefiniteProgram(constraints=(inequality, of_P(inequality, -1.0)), price=0.0, weight=V)


def smallest_gain(inequality: Inequality, metric_root: Array, input_root: Array) -> SemidefiniteProgram:
    """Minimise κ² subject to F_i(P, Y) ⪯ 0 for all cells, P ⪰ G and [κ² I, E Y; Yᵀ Eᵀ, P] ⪰ 0.

    Then K = Y P⁻¹ has E K G Kᵀ Eᵀ ⪯ E Y P⁻¹ Yᵀ Eᵀ ⪯ κ² I, since P⁻¹ G P⁻¹ ⪯ P⁻¹: κ bounds its norm. H (n, n), the root
    of the metric, is invertible, and G = H Hᵀ scaled to a norm of 1.
    """
    above = of_P(inequality, -1.0, constant=metric_root @ metric_root.T / np.linalg.norm(metric_root, 2) ** 2)
    return SemidefiniteProgram(constraints=(inequality, above, bound_of_gain(inequality, input_root)), price=1.0)


def smaller_gain(
    inequality: Inequality,
    metric_root: Array,
    input_root: Array,
    last: tuple[Array, Array],
    first: tuple[Array, Array] | None = None,
) -> SemidefiniteProgram:
    """Minimise κ² as `smallest_gain` does, with a bound that is the norm itself at P = P₀.

    In place of P ⪰ G and P itself, [κ² I, E Y; Yᵀ Eᵀ, P G⁻¹ P₀ + P₀ G⁻¹ P − P₀ G⁻¹ P₀] ⪰ 0: the last block is at most
    P G⁻¹ P, and equal to it for P = P₀. So κ ≥ ‖E K H‖, and falls from one P₀ to the next (sequential convex
    programming; Boyd and Vandenberghe, Convex Optimization, 2004, section 3.1.3). The columns of that block are
    multiplied by P₁⁻¹ H and E is divided by the norm there, for the P₁ that a sequence begins with: so that at P₁ the
    last block is I and κ is 1, and all programs of the sequence are in the same numbers.

    H is not scaled here. `last` is P₀ ≻ 0 and a Y that satisfy the inequality strictly; `first` is P₁ and its Y, where
    P₀ is an answer to an earlier program of the sequence.
    """
    P, Y = last if first is None else first
    scale = 1 / float(np.linalg.eigvalsh(P)[0])
    columns = np.asarray(np.linalg.solve(scale * P, metric_root), dtype=np.float64)
    norm = max(float(np.linalg.norm(scale * input_root @ Y @ columns, 2)), _LEAST_NORM)
    P0 = scale * P if first is None else last[0]
    tangent = np.linalg.solve(metric_root, P0 @ columns)
    gain = bound_of_gain(
        inequality,
        input_root / norm,
        columns=columns,
        factors=(columns.T, np.asarray(np.linalg.solve(metric_root.T, tangent), dtype=np.float64)),
        constant=tangent.T @ tangent,
    )
    return SemidefiniteProgram(constraints=(inequality, of_P(inequality, -1.0), gain), price=1.0)


def bound_of_gain(
    like: Inequality,
    E: Array,
    *,
    most: float | None = None,
    columns: Array | None = None,
    factors: tuple[Array, Array] | None = None,
    constant: Array | None = None,
) -> Inequality:
    """Return [t I, E Y X; ·, sym(V P W) − C] ⪰ 0, or with a number for t; X = I, V = I / 2, W = I, C = 0 by default."""
    n, k = like.n, len(E)
    eye, low, right = np.eye(n), np.vstack([np.zeros((k, n)), np.eye(n)]), np.hstack([np.zeros((n, k)), np.eye(n)])
    V, W = (eye / 2, eye) if factors is None else factors
    corner = np.zeros((1, k + n, k + n))
    corner[0, :k, :k] = -np.eye(k)
    known = np.zeros_like(corner) if most is None else most * corner
    known[0, k:, k:] = 0.0 if constant is None else constant
    return Inequality(
        L=-(low @ V)[None],
        R=(W @ right)[None],
        M=-np.vstack([E, np.zeros((n, like.m))])[None],
        N=(right if columns is None else columns @ right)[None],
        constant=known,
        T=corner if most is None else None,
    )


def of_P(
    like: Inequality, sign: float, V: Array | None = None, *, constant: Array | None = None, T: Array | None = None
) -> Inequality:
    """Return sign · V P Vᵀ + constant + t T ⪯ 0 for the P of an inequality; V = I by default."""
    V = np.eye(like.n) if V is None else V
    N = len(V)
    return Inequality(
        L=sign / 2 * V[None],
        R=V.T[None],
        M=np.zeros((1, N, like.m)),
        N=np.zeros((1, like.n, N)),
        constant=np.zeros((1, N, N)) if constant is None else constant[None],
        T=None if T is None else T[None],
    )
