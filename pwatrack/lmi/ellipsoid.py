"""What a bounded scalar, or a start, can do to a switched system: an ellipsoid that it cannot leave, proved exactly.

Let z' = M(t) z + g d with M(t) in the convex hull of the M_p, Q ≻ 0, a > 0, for every p and every row c:

    M_p Q + Q M_pᵀ + a Q + g gᵀ / a ≺ 0:                |c z| ≤ √(c Q cᵀ) sup |d| from z = 0,
    M_p Q + Q M_pᵀ + a Q ≺ 0, Q ≻ G Gᵀ:                 |c z| ≤ √(c Q cᵀ) e^(−a t / 2) from z = G v, |v| ≤ 1,
    M_p Q + Q M_pᵀ ≺ 0, Q ⪰ G diag(1 / w) Gᵀ, Σ w ≤ 1:  |c z| ≤ √(c Q cᵀ) from z = G ζ, |ζ_k| ≤ 1.

They are proved in `docs/theory/beyond.md`, *Bounds, one signal at a time* and *Limits of the inputs*.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from pwatrack.arrays import Array, symmetric_part
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.chain_map import Bound, ChainMap, square
from pwatrack.lmi.exact import Packed, left_side
from pwatrack.lmi.inequality import lyapunov, weighted
from pwatrack.lmi.norm import sizes_in, square_above
from pwatrack.lmi.program import least_sizes
from pwatrack.lmi.solve import least, solve
from pwatrack.rational import floats, is_positive_definite, scalar

_FIRST, _STEP, _FURTHEST = -0.2, 1.5, 4.0  # log(a / (most − a)): where it starts, how far it goes
_CLOSE = 0.2  # what it may change by from one try to the last: a hundredth of the cost
_KEPT = 0.97  # of a proved rate: with the rest an ellipsoid is strictly inside
_NEAR = 0.002  # what the cost may be off: Q is that far inside
_SLACK = 1e-9  # of the mean weight, beside forms that do not see all of z: what is minimised is then definite
_FLAT = 1e-24  # of the largest square: what is smaller does not count
_LASTING = 0.02  # of the fastest decay: what an ellipsoid of a start may decay with, so that it is small
_SHARES = (0.0, 1e-6, 1e-3, 0.1, 0.5)  # of a Q far inside that is mixed in, until the inequality is proved
_DECAY = 0.02  # of the rate of the Q that is started from: what Q gives up so that the inequality is strict
_LEAST_WEIGHT = 1e-4  # of a direction
_SCALE_NEAR = 1e-6  # what the square of the scale of one around a box may be off
_ROOM = (1e-9, 1e-7, 1e-5, 1e-3)  # by which Q is enlarged, until it is proved
_BOX_SHARES = (0.0, 1e-3, 0.1)  # of the Q to start from that are mixed in there, until it is proved

Columns = tuple[BallMatrix, Sequence[Fraction]]  # g_k (N, k), and the weight w_k of each


@dataclass(frozen=True, kw_only=True)
class InvariantEllipsoid(Packed):
    """Q ≻ 0 and −(M_p Q + Q M_pᵀ) − a Q − g gᵀ / a ≻ 0 for every p, proved exactly; and c Q cᵀ ≤ size² for rows c.

    Of a start there is no g, and Q − G Gᵀ ≻ 0. Where M_p, g or c are irrational, for everything in their balls. So
    |c z| ≤ size · sup |d| from z = 0, or at all times from a start.
    """

    a: float  # in 1/s, a short decimal
    sizes: tuple[float, ...]  # one for each c, rounded up


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
        """Return V with Q = V Vᵀ and V⁻¹ M V, (p, N, N): with z = V w the Q is I; None where it is singular."""
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

    M_p is (N, N), g (N, 1) not 0, and the rows c are `forms`, (s, N). Of the `inners` that will do to start from the
    last is taken, which should be the better conditioned; so many a are tried.

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
    return None if proved is None else InvariantEllipsoid(a=a, **proved)


def from_start(
    M: Sequence[BallMatrix], G: BallMatrix, forms: BallMatrix, inners: Sequence[Inner]
) -> InvariantEllipsoid | None:
    """Return an ellipsoid that holds all starts G v, |v| ≤ 1, G (N, k), and in which all of c z are small at once.

    Example: from z = 3 on, |z| ≤ 3 for z' = −2 z.

        >>> M, G, c = (BallMatrix.of([[v]]) for v in (-2, 3, 1))
        >>> found = from_start([M], G, c, [Inner(Q=np.eye(1), most=3.9)])
        >>> 3.0 < found.sizes[0] < 3.1
        True
    """
    start, rows = G.floats, forms.floats
    near = inners[-1].near(np.array([M_p.floats for M_p in M])) if inners and start.any() else None
    if near is None:
        return None
    a, (V, inside) = _short(_LASTING * inners[-1].most), near
    within = solve_triangular(V, start, lower=True)
    size, seen = float(np.linalg.norm(within, 2)) ** 2, rows @ V
    W = _weight(seen.T / _sizes((seen**2).sum(axis=1)), seen)[0]
    found = solve(least_sizes(lyapunov(inside / a, 0.5), W, above=within @ within.T / size), gap=_NEAR)
    far = 2 * size * inners[-1].Q
    Q = far if found is None else size * V @ found.P @ V.T
    proved = enclosure(M, forms, _mixed(Q, far), a=a, around=(G, [Fraction(1)] * G.shape[1]))
    return None if proved is None else InvariantEllipsoid(a=a, **proved)


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
) -> dict[str, Any] | None:
    """Return the parts of the first Q for which the inequalities are proved, with a size for each c; or None.

    They are −(M_p Q + Q M_pᵀ) − a Q − Σ w_k g_k g_kᵀ ≻ 0 for every p, with g_k that drive, and Q − Σ w_k g_k g_kᵀ ≻ 0,
    with those that Q is to be around. a counts as printed.
    """
    for trial in trials:
        if not np.isfinite(trial).all():
            continue
        Q = Packed.of(trial)
        inside = Q.P if around is None else Q.P - square_above(*around, Q.scale)
        rest = scalar(a) * Q.P if driven is None else scalar(a) * Q.P + square_above(*driven, Q.scale)
        if is_positive_definite(inside) and all(is_positive_definite(left_side(X, Q) - rest) for X in M):
            return Q.parts | {"sizes": sizes_in(Q.P, forms)}
    return None


def _short(value: float) -> float:
    return float(f"{value:.2e}")


@dataclass(frozen=True, kw_only=True)
class StartEllipsoid(Packed):
    """Q ≻ 0 with Q − G diag(1 / w) Gᵀ ≻ 0 and −(M_p Q + Q M_pᵀ) ≻ 0 for every p, proved exactly; c Q cᵀ ≤ size².

    Where M_p or c have irrational entries, for everything in their balls. So |c z| ≤ size at all times.
    """

    weights: tuple[float, ...]  # w_k, short decimals; one for each column of G
    sizes: tuple[float, ...]  # one for each c, rounded up

    def reach(self, rays: Array) -> Array:
        """Return how far the ellipsoid reaches along rays (s, N)."""
        return reach_of(np.asarray(np.linalg.inv(floats(self.P)), dtype=np.float64), rays)


def reach_of(form: Array, rays: Array) -> Array:
    """Return how far {z: zᵀ form z ≤ 1} reaches along rays (s, N)."""
    return np.asarray(np.einsum("sj,jk,sk->s", rays, form, rays) ** -0.5)


def held(M: Sequence[BallMatrix], G: Array, forms: BallMatrix, most: Array, inner: Inner) -> StartEllipsoid | None:
    """Return an ellipsoid around starts, if one is proved, in which the largest |c z| / most is as small as can be.

    G (N, k) counts as the decimals that it prints as; columns of 0 do nothing. Each form is held against an entry of
    `most`, (s,), positive; infinite for what does not count.

    Example: z' = −z from |z(0)| ≤ 3, seen as 2 z.

        >>> M, c = BallMatrix.of([[-1]]), BallMatrix.of([[2]])
        >>> found = held([M], np.array([[3.0]]), c, np.ones(1), Inner(Q=np.eye(1), most=1.9))
        >>> 6.0 <= found.sizes[0] < 6.001
        True
    """
    acts, rows = np.flatnonzero(G.any(axis=0)), forms.floats / most[:, None]
    near = inner.near(np.array([M_p.floats for M_p in M])) if len(acts) and rows.any() else None
    if near is None:
        return None
    (V, inside), speed = near, inner.most / 2
    starts = solve_triangular(V, G[:, acts], lower=True)
    size = float(np.linalg.norm(starts, 2))
    found = _inverse_around(inside / speed + _DECAY * np.eye(len(V)), starts / size, rows @ V)
    if found is None:
        return None
    P, weights = found
    Q = size**2 * V @ np.linalg.inv(P) @ V.T
    proved = around_starts(M, G, forms, weights, _enlarged(Q, inner.Q))
    return None if proved is None else StartEllipsoid(**proved)


def _inverse_around(M: Array, G: Array, rows: Array) -> tuple[Array, Array] | None:
    """Return P and weights w, Gᵀ P G ⪯ diag(w), Σ w ≤ 1, with the least of the largest c P⁻¹ cᵀ, in floating point.

    All numbers are about 1: maximise t subject to M_pᵀ P + P M_p ⪯ 0 for all cells, P ⪰ t cᵀ c, 1e-6 I ⪯ P ⪯ 1e6 I.
    """
    eye, k = np.eye(M.shape[1]), G.shape[1]
    nothing, unit = np.zeros_like(eye), np.eye(k)
    rows = rows[rows.any(axis=1)] / float(np.linalg.norm(rows, axis=1).max())
    bounds = [Bound({0: (M_p.T, eye)}, nothing) for M_p in M]
    bounds += [Bound({0: square(eye, -1.0)}, np.outer(row, row)) for row in rows]
    bounds += [Bound({0: square(1e-3 * eye)}, nothing, -eye), Bound({0: square(eye, -1.0)}, nothing, 1e-6 * eye)]
    bounds.append(Bound({0: square(G)}, 0 * unit, None, range(k), -unit[:, :, None] * unit[:, None]))
    bounds.append(Bound({}, np.zeros((1, 1)), -np.eye(1), range(k), np.ones((k, 1, 1))))
    chain = ChainMap(bounds, 1, None, k)
    v = least(chain, gap=_SCALE_NEAR)
    if v is None or not v[-1] > 0 or not np.linalg.eigvalsh(chain.matrices(v)[0])[0] > 0:
        return None
    return chain.matrices(v)[0], np.maximum(chain.scalars(v), 0.0)


def around_starts(
    M: Sequence[BallMatrix], G: Array, forms: BallMatrix, weights: Array, trials: Iterable[Array]
) -> dict[str, Any] | None:
    """Return what `enclosure` does around starts, with weights of the columns of G that are not 0 made short."""
    few, decimal = short_weights(G, weights), BallMatrix.of(G, G.shape)
    proved = enclosure(M, forms, trials, around=(decimal, [1 / Fraction(repr(w)) for w in few]))
    return None if proved is None else {"weights": few, **proved}


def short_weights(G: Array, weights: Array) -> tuple[float, ...]:
    """Return short weights of all columns of G, of sum 1 at most, from those of the columns that are not 0."""
    acts = G.any(axis=0)
    all_weights = np.full(G.shape[1], _LEAST_WEIGHT / G.shape[1])
    all_weights[acts] = np.maximum(weights, _LEAST_WEIGHT * weights.max())
    rounded = np.floor(all_weights / all_weights.sum() * 1e7 - 1)
    return tuple((np.maximum(rounded, 1.0) / 1e7).tolist())


def _enlarged(Q: Array, far: Array) -> Iterator[Array]:
    """Yield what is a little larger than Q, then with more and more of another one mixed in."""
    for share, room in product(_BOX_SHARES, _ROOM):
        shape = (1 - share) * Q + share * float(np.trace(Q) / np.trace(far)) * far
        yield (shape + shape.T) / 2 * float(1 + 1e-5 + room + 2 * share)
