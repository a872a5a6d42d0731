"""What is asked of P and Y beside the inequality. Each program is described once, as data; solvers read it."""

from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.lmi.inequality import Inequality

_HALVINGS = 60
_LEAST_NORM = 1e-12  # of a gain, as a unit of its bound
_ROOM = 100.0  # of P in `bounded_gain`


@dataclass(frozen=True)
class Candidate:
    """Matrices that a solver returned for an inequality: P (n, n) and Y (m, n).

    `multipliers` are those of the inequality, (l, N, N), where the solver gives them.
    """

    P: Array
    Y: Array
    multipliers: Array | None = None


@dataclass(frozen=True, kw_only=True)
class Program:
    """Minimise price · t, tr W P, or tr V P⁻¹ Vᵀ, subject to inequalities in P, Y and a scalar t.

    Attributes:
        constraints: The inequalities; all have the same P, Y and t.
        price: Of t: −1 makes it large, 1 small; 0 where t is not what counts.
        weight: V (k, n) where tr V P⁻¹ Vᵀ is to be small.
        cost: W (n, n), symmetric, where tr W P is to be small and W is not I.
        start: P, Y, t that satisfy all of them strictly, where that is known.
        gap: Share of the objective that may be missed; P, Y and the multipliers are further inside where it is larger.
        trace: What the trace of P must be, where that is asked; the start has it.
        even: Whether a barrier method is to give each constraint the weight of the first, which has the most cells.
    """

    constraints: tuple[Inequality, ...]
    price: float
    weight: Array | None = None
    cost: Array | None = None
    start: tuple[Array, Array, float] | None = None
    gap: float = 1e-4
    trace: float | None = None
    even: bool = False

    @property
    def n(self) -> int:
        """Order of P."""
        return self.constraints[0].n

    @property
    def m(self) -> int:
        """Number of rows of Y."""
        return self.constraints[0].m


def largest_margin(inequality: Inequality, most: float | None = None) -> Program:
    """Maximise t subject to F_i(P, Y) ⪯ −t I for all cells and t I ⪯ P ⪯ I, t ≤ 1, and ‖Y‖ ≤ most where that is given.

    Without a bound Y may become large for a margin that is hardly better.
    """
    n, N = inequality.n, inequality.L.shape[1]
    P, Y = np.eye(n) / 2, np.zeros((inequality.m, n))
    below = -float(np.linalg.norm(inequality.evaluate(P, Y), axis=(1, 2)).max())
    return Program(
        constraints=(
            replace(inequality, T=np.broadcast_to(np.eye(N), inequality.constant.shape)),
            of_P(inequality, -1.0, np.eye(n), T=np.eye(n)),
            of_P(inequality, 1.0, np.eye(n), constant=-np.eye(n)),
            of_P(inequality, 1.0, np.zeros((1, n)), constant=-np.eye(1), T=np.eye(1)),
            *([] if most is None or not inequality.m else [norm_of_Y(inequality, most)]),
        ),
        price=-1.0,
        start=(P, Y, below - 1.0),
    )


def least_violation(inequality: Inequality) -> Program:
    """Minimise t subject to F_i(P, Y) ⪯ t I for all cells, P ⪰ 0 and tr P = 1.

    Where the least t is positive, the multipliers U_i have Σ tr U_i F_i(P, Y) ≥ t tr P for any P ⪰ 0 and Y.
    """
    n, N = inequality.n, inequality.L.shape[1]
    P, Y = np.eye(n) / n, np.zeros((inequality.m, n))
    above = float(np.linalg.norm(inequality.evaluate(P, Y), axis=(1, 2)).max())
    violated = replace(inequality, T=np.broadcast_to(-np.eye(N), inequality.constant.shape))
    return Program(
        constraints=(violated, of_P(inequality, -1.0, np.eye(n))),
        price=1.0,
        start=(P, Y, 2 * above + 1e-6),
        gap=0.3,
        trace=1.0,
    )


def least_condition(inequality: Inequality, unit: Array, start: Array | None = None) -> Program:
    """Minimise κ subject to F_i(P) ⪯ 0 for all cells and U ⪯ λP ⪯ κU for some λ > 0.

    κ may be 1e12: so P ⪰ t U / λmax(U) and P ⪯ U / λmin(U), the latter as a bound of I, where all numbers are about 1.

    Args:
        inequality: What P must satisfy.
        unit: U (n, n), positive definite: the P that would be the identity in the units that count.
        start: A P (n, n) that satisfies the inequality strictly.

    Raises:
        numpy.linalg.LinAlgError: If U is not positive definite.
    """
    values, vectors = np.linalg.eigh(unit)
    if not values[0] > 0:
        raise np.linalg.LinAlgError("U is not positive definite")
    narrow = vectors / np.sqrt(values / values[0])
    if start is not None:
        start = start / (2 * np.linalg.eigvalsh(narrow.T @ start @ narrow)[-1])
    least = 0.0 if start is None else float(np.linalg.eigvalsh(start)[0])
    return Program(
        constraints=(
            inequality,
            of_P(inequality, -1.0, np.eye(inequality.n), T=unit / values[-1]),
            of_P(inequality, 1.0, narrow.T, constant=-np.eye(len(unit))),
        ),
        price=-1.0,
        start=None if start is None else (start, np.zeros((0, len(unit))), least / 2),
    )


def least_trace(inequality: Inequality) -> Program:
    """Minimise tr P subject to F_i(P, Y) ⪯ 0 for all cells and P ⪰ 0."""
    return Program(constraints=(inequality, of_P(inequality, -1.0, np.eye(inequality.n))), price=0.0)


def least_sizes(inequality: Inequality, W: Array, start: Array) -> Program:
    """Minimise tr W P subject to F_i(P) ⪯ 0 for all cells, within a hundredth; F_i must make P ≻ 0.

    Args:
        inequality: From `weighted`, with stable matrices.
        W: (n, n), positive semidefinite.
        start: A P that satisfies the inequality strictly.
    """
    nothing = np.zeros((0, inequality.n))
    return Program(constraints=(inequality,), price=0.0, cost=W, start=(start, nothing, 0.0), gap=0.01)


def least_cost(inequality: Inequality, weight: Array, start: Array | None = None) -> Program:
    """Minimise tr V P⁻¹ Vᵀ subject to F_i(P) ⪯ 0 for all cells and P ⪰ 0.

    Args:
        inequality: From `quadratic_cost`.
        weight: V (n, n): its rows are the initial states whose costs are added up.
        start: A P that satisfies (8) strictly, with any Y.
    """
    point = None
    if start is not None:
        nothing, small = np.zeros((0, inequality.n)), start / np.linalg.norm(start, 2)
        for _ in range(_HALVINGS):  # where u can do nothing P is enough by itself; elsewhere B R⁻¹ Bᵀ rules in the end
            if np.linalg.eigvalsh(inequality.evaluate(small, nothing))[:, -1].max() < 0:
                point = small, nothing, 0.0
                break
            small = small / 2
    return Program(
        constraints=(inequality, of_P(inequality, -1.0, np.eye(inequality.n))),
        price=0.0,
        weight=weight / np.linalg.norm(weight, 2),
        start=point,
        gap=1e-7,
    )


def bounded_gain(inequality: Inequality, metric_root: Array, input_root: Array, most: float) -> Program:
    """Minimise t subject to F_i(P, Y) ⪯ t I for all cells, G ⪯ P ⪯ 100 I and [κ² I, E Y; Yᵀ Eᵀ, P] ⪰ 0 for a given κ.

    Where t < 0, P and Y are a start for `smallest_gain` with a gain of modest size.

    Args:
        inequality: From `state_feedback`.
        metric_root: H (n, n), invertible, with G = H Hᵀ; it is scaled to a norm of 1.
        input_root: E (m, m).
        most: κ.
    """
    n, N = inequality.n, inequality.L.shape[1]
    P, Y = _ROOM / 2 * np.eye(n), np.zeros((inequality.m, n))
    above = float(np.linalg.norm(inequality.evaluate(P, Y), axis=(1, 2)).max())
    return Program(
        constraints=(
            replace(inequality, T=np.broadcast_to(-np.eye(N), inequality.constant.shape)),
            of_P(inequality, -1.0, np.eye(n), constant=_metric(metric_root)),
            of_P(inequality, 1.0, np.eye(n), constant=-_ROOM * np.eye(n)),
            _bound_of_gain(inequality, input_root, most),
        ),
        price=1.0,
        start=(P, Y, 2 * above),
        gap=0.5,
    )


def smallest_gain(
    inequality: Inequality, metric_root: Array, input_root: Array, start: Candidate | None = None
) -> Program:
    """Minimise κ² subject to F_i(P, Y) ⪯ 0 for all cells, P ⪰ G and [κ² I, E Y; Yᵀ Eᵀ, P] ⪰ 0.

    Then K = Y P⁻¹ has E K G Kᵀ Eᵀ ⪯ E Y P⁻¹ Yᵀ Eᵀ ⪯ κ² I, since P⁻¹ G P⁻¹ ⪯ P⁻¹: κ bounds its norm.

    Args:
        inequality: From `state_feedback`.
        metric_root: H (n, n), invertible, with G = H Hᵀ; it is scaled to a norm of 1.
        input_root: E (m, m).
        start: P and Y that satisfy the inequality strictly.
    """
    n = inequality.n
    point = None
    if start is not None:
        scale = 2.0 / np.linalg.eigvalsh(start.P)[0]
        EY = input_root @ start.Y * scale
        bound = np.linalg.norm(EY @ np.linalg.solve(start.P * scale, EY.T), 2)
        point = start.P * scale, start.Y * scale, 2.0 * float(bound) + 1.0
    return Program(
        constraints=(
            inequality,
            of_P(inequality, -1.0, np.eye(n), constant=_metric(metric_root)),
            _bound_of_gain(inequality, input_root),
        ),
        price=1.0,
        start=point,
        gap=0.1,
        even=True,  # where that of the norm is one among many cells, the way along its curved boundary has many steps
    )


def smaller_gain(inequality: Inequality, metric_root: Array, input_root: Array, last: Candidate) -> Program:
    """Minimise κ² as `smallest_gain` does, with a bound that is the norm itself at P = P₀.

    In place of P ⪰ G and P itself, [κ² I, E Y; Yᵀ Eᵀ, P G⁻¹ P₀ + P₀ G⁻¹ P − P₀ G⁻¹ P₀] ⪰ 0: the last block is at most
    P G⁻¹ P, and equal to it for P = P₀. So κ ≥ ‖E K H‖, and falls from one P₀ to the next (sequential convex
    programming; Boyd and Vandenberghe, Convex Optimization, 2004, section 3.1.3). Its columns are multiplied by
    P₀⁻¹ H and E is divided by the last norm, so that at P₀ the last block is I and κ is 1.

    Args:
        inequality: From `state_feedback`.
        metric_root: H (n, n), invertible, with G = H Hᵀ.
        input_root: E (m, m).
        last: P₀ ≻ 0 and Y that satisfy the inequality strictly.
    """
    n = inequality.n
    scale = 1 / float(np.linalg.eigvalsh(last.P)[0])
    P, Y = last.P * scale, last.Y * scale
    columns = np.asarray(np.linalg.solve(P, metric_root), dtype=np.float64)
    norm = max(float(np.linalg.norm(input_root @ Y @ columns, 2)), _LEAST_NORM)
    gain = _bound_of_gain(
        inequality,
        input_root / norm,
        columns=columns,
        factors=(columns.T, np.asarray(np.linalg.inv(metric_root).T, dtype=np.float64)),
        constant=np.eye(n),
    )
    return Program(
        constraints=(inequality, of_P(inequality, -1.0, np.eye(n)), gain),
        price=1.0,
        start=(P, Y, 2.0),
        gap=1e-2,
        even=True,
    )


def _metric(root: Array) -> Array:
    """Return G = H Hᵀ with a norm of 1."""
    return np.asarray(root @ root.T / np.linalg.norm(root, 2) ** 2)


def _bound_of_gain(
    like: Inequality,
    input_root: Array,
    most: float | None = None,
    *,
    columns: Array | None = None,
    factors: tuple[Array, Array] | None = None,
    constant: Array | None = None,
) -> Inequality:
    """Return [κ² I, E Y X; ·, sym(V P W) − C] ⪰ 0, κ given or t for κ²; X = I, V = I / 2, W = I, C = 0 by default."""
    n, m = like.n, like.m
    eye, low, right = np.eye(n), np.vstack([np.zeros((m, n)), np.eye(n)]), np.hstack([np.zeros((n, m)), np.eye(n)])
    V, W = (eye / 2, eye) if factors is None else factors
    corner = np.zeros((1, m + n, m + n))
    corner[0, :m, :m] = -np.eye(m)
    known = np.zeros_like(corner) if most is None else most**2 * corner
    known[0, m:, m:] = 0.0 if constant is None else constant
    return Inequality(
        L=-(low @ V)[None],
        R=(W @ right)[None],
        M=-np.vstack([input_root, np.zeros((n, m))])[None],
        N=(right if columns is None else columns @ right)[None],
        constant=known,
        T=corner if most is None else None,
    )


def of_P(
    like: Inequality, sign: float, V: Array, *, constant: Array | None = None, T: Array | None = None
) -> Inequality:
    """Return sign · V P Vᵀ + constant + t T ⪯ 0 for the P of an inequality."""
    N = len(V)
    return Inequality(
        L=sign / 2 * V[None],
        R=V.T[None],
        M=np.zeros((1, N, like.m)),
        N=np.zeros((1, like.n, N)),
        constant=np.zeros((1, N, N)) if constant is None else constant[None],
        T=None if T is None else T[None],
    )


def norm_of_Y(like: Inequality, most: float) -> Inequality:
    """Return ‖Y‖ ≤ most for the Y of an inequality, as [most I, Y; Yᵀ, most I] ⪰ 0."""
    n, m = like.n, like.m
    return Inequality(
        L=np.zeros((1, m + n, n)),
        R=np.zeros((1, n, m + n)),
        M=-np.eye(m + n, m)[None],
        N=np.hstack([np.zeros((n, m)), np.eye(n)])[None],
        constant=-most * np.eye(m + n)[None],
    )
