"""What a bounded scalar, or a start, can do to a switched system: an ellipsoid that it cannot leave, proved exactly.

Let z' = M(t) z + g d with M(t) in the convex hull of the M_p, and Q ≻ 0, a > 0 with

    M_p Q + Q M_pᵀ + a Q + g gᵀ / a ≺ 0   for every p.

Then V = zᵀ Q⁻¹ z has V' ≤ −a V + a d² (proved in `docs/theory/beyond.md`): from z = 0 always V ≤ sup d², and
|c z| ≤ √(c Q cᵀ) √V ≤ √(c Q cᵀ) sup |d| for every row c (Boyd et al., Linear Matrix Inequalities in System and Control
Theory, 1994, section 6.1.3).

Of a start z(0) = G v with |v| ≤ 1 and d = 0 the same is said by

    M_p Q + Q M_pᵀ + a Q ≺ 0   for every p,   Q ≻ G Gᵀ:

V ≤ 1 at the start, V' ≤ −a V, and |c z(t)| ≤ √(c Q cᵀ) e^(−a t / 2) at all times.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from pwatrack.arrays import Array, symmetric_part
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.exact import Packed, left_side
from pwatrack.lmi.inequality import lyapunov, weighted
from pwatrack.lmi.norm import root_above, square_above
from pwatrack.lmi.program import least_sizes
from pwatrack.lmi.solve import solve
from pwatrack.rational import Rational, is_positive_definite, scalar

_FIRST, _STEP, _FURTHEST = -0.2, 1.5, 4.0  # log(a / (most − a)): where it starts, how far it goes
_CLOSE = 0.2  # what it may change by from one try to the last: a hundredth of the cost
_KEPT = 0.97  # of a proved rate: with the rest an ellipsoid is strictly inside
_NEAR = 0.002  # what the cost may be off: Q is that far inside
_SLACK = 1e-9  # of the mean weight, beside forms that do not see all of z: what is minimised is then definite
_FLAT = 1e-24  # of the largest square: what is smaller does not count
_LASTING = 0.02  # of the fastest decay: what an ellipsoid of a start may decay with, so that it is small
_SHARES = (0.0, 1e-6, 1e-3, 0.1, 0.5)  # of a Q far inside that is mixed in, until the inequality is proved


Columns = tuple[BallMatrix, Sequence[Fraction]]  # g_k (N, k), and the weight w_k of each


@dataclass(frozen=True, kw_only=True)
class InvariantEllipsoid(Packed):
    """Q ≻ 0 and −(M_p Q + Q M_pᵀ) − a Q − g gᵀ / a ≻ 0 for every p, proved exactly; and c Q cᵀ ≤ size² for rows c.

    Of a start there is no g, and Q − G Gᵀ ≻ 0. Where M_p, g or c are irrational, for everything in their balls. So
    |c z| ≤ size · sup |d| from z = 0, or at all times from a start.

    Attributes:
        a: In 1/s, a short decimal.
        sizes: One for each c, rounded up.
    """

    a: float
    sizes: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Inner:
    """Q (N, N) with M_p Q + Q M_pᵀ + a Q ≺ 0 for all p and all a up to `most`."""

    Q: Array
    most: float

    @classmethod
    def proved(cls, Q: Array, rate: float) -> "Inner":
        """Return a Q with which a rate (1/s) is proved, M_p Q + Q M_pᵀ + 2 rate Q ⪯ 0."""
        return cls(Q=Q, most=2 * _KEPT * rate)

    def near(self, M: Array) -> tuple[Array, Array] | None:
        """Return V with Q = V Vᵀ and V⁻¹ M V, (p, N, N): with z = V w the Q is I; None where it is singular.

        Example:
            >>> V, seen = Inner(Q=np.diag([4.0, 1.0]), most=1.0).near(np.array([[[0.0, 1.0], [-1.0, 0.0]]]))
            >>> V.tolist(), seen.tolist()
            ([[2.0, 0.0], [0.0, 1.0]], [[[0.0, 0.5], [-2.0, 0.0]]])
        """
        try:
            V = np.linalg.cholesky(self.Q)
        except np.linalg.LinAlgError:
            return None
        N = len(V)
        rows = solve_triangular(V, np.swapaxes(M @ V, 0, 1).reshape(N, -1), lower=True).reshape(N, -1, N)
        return np.asarray(V), np.asarray(np.swapaxes(rows, 0, 1))


def ellipsoid(
    M: Sequence[BallMatrix], g: BallMatrix, forms: BallMatrix, inners: Sequence[Inner], *, tries: int = 3
) -> InvariantEllipsoid | None:
    """Return an ellipsoid, if one is proved, in which all c z are small: the sum of c Q cᵀ, each over its usual size.

    Args:
        M: The matrices M_p (N, N).
        g: (N, 1), not 0.
        forms: The rows c, (s, N).
        inners: What to start from; of those that will do the last is taken, which should be the better conditioned.
        tries: Of a.

    Example: |z| ≤ |g| / λ · sup |d| for z' = −λ z + g d.

        >>> M, g, c = (BallMatrix.of([[v]]) for v in (-2, 3, 1))
        >>> found = ellipsoid([M], g, c, [Inner(Q=np.eye(1), most=3.9)])
        >>> 1.5 < found.sizes[0] < 1.53
        True
    """
    matrices, column, rows = np.array([M_p.floats for M_p in M]), g.floats[:, 0], forms.floats
    if not inners or not column.any():
        return None
    most = max(inner.most for inner in inners)
    weights, best, least = None, None, np.inf
    where, steps = _FIRST, list[tuple[float, float]]()
    for _ in range(tries):
        a = _short(most / (1 + np.exp(-where)))
        Q, far, slope = _smallest(matrices, column, rows, a, [i for i in inners if i.most > a][-1], weights)
        squares = np.einsum("sj,jk,sk->s", rows, Q, rows)
        weights = 1 / _sizes(squares) if weights is None else weights
        cost = float(weights @ squares)
        if cost < least:
            best, least = (Q, far, a), cost
        steps.append((where, slope * a * (1 - a / most)))
        where = _next(steps)
        if abs(where - steps[-1][0]) <= _CLOSE:
            break
    if best is None:
        return None
    Q, far, a = best
    proved = enclosure(M, forms, _mixed(Q, far), a=a, driven=(g, [1 / Fraction(repr(a))]))
    return None if proved is None else InvariantEllipsoid(a=a, sizes=proved[1], **proved[0].parts)


def from_start(
    M: Sequence[BallMatrix], G: BallMatrix, forms: BallMatrix, inners: Sequence[Inner]
) -> InvariantEllipsoid | None:
    """Return an ellipsoid that holds all starts G v, |v| ≤ 1, and in which all of c z are small at once.

    Args:
        M, forms, inners: As for `ellipsoid`.
        G: (N, k), exact, not 0.

    Example: from z = 3 on, |z| ≤ 3 for z' = −2 z.

        >>> M, G, c = (BallMatrix.of([[v]]) for v in (-2, 3, 1))
        >>> found = from_start([M], G, c, [Inner(Q=np.eye(1), most=3.9)])
        >>> 3.0 < found.sizes[0] < 3.1
        True
    """
    matrices, start, rows = np.array([M_p.floats for M_p in M]), G.floats, forms.floats
    if not inners or not start.any():
        return None
    inner = inners[-1]
    a = _short(_LASTING * inner.most)
    near = inner.near(matrices)
    if near is None:
        return None
    V, inside = near
    within = solve_triangular(V, start, lower=True)
    size, seen = float(np.linalg.norm(within, 2)) ** 2, rows @ V
    W = _weight(seen.T / _sizes((seen**2).sum(axis=1)), seen)[0]
    found = solve(least_sizes(lyapunov(inside / a, 0.5), W, above=within @ within.T / size), gap=_NEAR)
    far = 2 * size * inner.Q
    Q = far if found is None else size * V @ found.P @ V.T
    proved = enclosure(M, forms, _mixed(Q, far), a=a, around=(G, [Fraction(1)] * G.shape[1]))
    return None if proved is None else InvariantEllipsoid(a=a, sizes=proved[1], **proved[0].parts)


def _next(steps: Sequence[tuple[float, float]]) -> float:
    """Return the next σ = log(a / (most − a)), of (σ, d log cost / dσ) so far: Newton's step, then a secant.

    For one real eigenvalue cost · a · (most − a) is constant, and the curvature 1/2 at its least.
    """
    (x, slope), before = steps[-1], steps[:-1]
    if not np.isfinite(slope):
        return x
    curvature = 0.5
    if before and (slope - before[-1][1]) * (x - before[-1][0]) > 0:
        curvature = (slope - before[-1][1]) / (x - before[-1][0])
    return float(np.clip(x + np.clip(-slope / curvature, -_STEP, _STEP), -_FURTHEST, _FURTHEST))


def _smallest(
    M: Array, g: Array, rows: Array, a: float, inner: Inner, weights: Array | None
) -> tuple[Array, Array, float]:
    """Return Q, another far inside the inequality, and d log cost / da of the weighted cost.

    In coordinates where the Q to start from is I, and in the unit of time most / 2, so that numbers are about 1.
    """
    N, speed, near = len(g), inner.most / 2, inner.near(M)
    if near is None:
        return np.full_like(inner.Q, np.inf), inner.Q, 1 / a
    V, inside = near
    scaled, column = inside / speed, solve_triangular(V, g, lower=True) / speed
    short = a / speed
    slack = -float(np.linalg.eigvalsh(symmetric_part(scaled) + short * np.eye(N)).max())
    forms = rows @ V
    if not slack > 0:
        return np.full_like(inner.Q, np.inf), inner.Q, 1 / a
    size = 2 * float(column @ column) / short / slack  # for size · I there is room
    far = size * V @ V.T
    weights = 1 / _sizes((forms**2).sum(axis=1)) if weights is None else weights
    W, total = _weight(forms.T * weights, forms, size)
    if not total > 0:
        return far, far, 0.0
    drive = np.outer(column, column) / (short * size)
    program = least_sizes(weighted(scaled + short / 2 * np.eye(N), drive), W)
    found = solve(program, gap=_NEAR)
    if found is None or found.multipliers is None:
        return far, far, 0.0
    slope = float(np.einsum("pjk,kj->", found.multipliers[0], found.P - drive / short))
    return size * V @ found.P @ V.T, far, slope / float((W * found.P).sum()) / speed


def _sizes(squares: Array) -> Array:
    """Return squares by which forms are divided to count alike; those that are next to nothing count less."""
    return np.asarray(np.maximum(squares, _FLAT * squares.max(initial=1e-300)))


def _weight(weighed: Array, forms: Array, size: float = 1.0) -> tuple[Array, float]:
    """Return W of trace 1 with tr W P in proportion to the weighed sum of c P cᵀ, and that sum for P = size I."""
    W = weighed @ forms * size
    total = float(np.trace(W))
    return W / max(total, 1e-300) + _SLACK * np.eye(len(W)) / len(W), total


def _mixed(Q: Array, far: Array) -> Iterator[Array]:
    """Yield Q, then with more and more of another one mixed in that is far inside the inequality."""
    return ((1 - share) * Q + share * far for share in _SHARES)


def enclosure(
    M: Sequence[BallMatrix],
    forms: BallMatrix,
    trials: Iterable[Array],
    *,
    a: float = 0.0,
    around: Columns | None = None,
    driven: Columns | None = None,
) -> tuple[Packed, tuple[float, ...]] | None:
    """Return the first Q, in short numbers, for which the inequalities are proved, with a size for each c; or None.

    They are −(M_p Q + Q M_pᵀ) − a Q − Σ w_k g_k g_kᵀ ≻ 0 for every p, and Q − Σ w_k g_k g_kᵀ ≻ 0.

    Args:
        M: The matrices M_p (N, N).
        forms: The rows c, (s, N).
        trials: Q (N, N).
        a: In 1/s, as printed.
        around, driven: g_k of the second and of the first; None for none.
    """
    for trial in trials:
        if not np.isfinite(trial).all():
            continue
        Q = Packed.of(trial)
        inside = Q.P if around is None else Q.P - square_above(*around, Q.scale)
        rest = scalar(a) * Q.P if driven is None else scalar(a) * Q.P + square_above(*driven, Q.scale)
        if is_positive_definite(inside) and all(is_positive_definite(left_side(X, Q) - rest) for X in M):
            return Q, tuple(root_above(square) for square in _squares(forms, Q.P))
    return None


def _squares(forms: BallMatrix, Q: Rational) -> list[Any]:
    """Return c Q cᵀ for each row c, or the most that it is in the ball."""
    squares = forms @ BallMatrix(Q) @ forms.transpose()
    return [
        squares.centre[k, k] + (0 if squares.radius is None else squares.radius[k, k]) for k in range(forms.shape[0])
    ]


def _short(value: float) -> float:
    """Return a number of three digits."""
    return float(f"{value:.2e}")
