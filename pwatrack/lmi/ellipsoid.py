"""What a bounded scalar can do to a switched system: an ellipsoid that it cannot leave, proved exactly.

Let z' = M(t) z + g d with M(t) in the convex hull of the M_p, and Q ≻ 0, a > 0 with

    M_p Q + Q M_pᵀ + a Q + g gᵀ / a ≺ 0   for every p.

It is affine in M_p, so it holds for M(t). With V = zᵀ Q⁻¹ z, q = Q⁻¹ z and s = gᵀ q that gives

    V' = qᵀ (M Q + Q Mᵀ) q + 2 s d ≤ −a V − s² / a + 2 s d ≤ −a V + a d²,

so from z = 0 always V ≤ sup d², and |c z| ≤ √(c Q cᵀ) √V ≤ √(c Q cᵀ) sup |d| for every row c (Boyd et al., Linear
Matrix Inequalities in System and Control Theory, 1994, section 6.1.3).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from pwatrack.arrays import Array, symmetric_part
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.exact import BITS, unpacked, unsure
from pwatrack.lmi.inequality import weighted
from pwatrack.lmi.norm import root_above, square_above
from pwatrack.lmi.program import least_sizes
from pwatrack.lmi.solve import solve
from pwatrack.rational import Rational, is_positive_definite, scalar

_FIRST, _STEP, _FURTHEST = -0.2, 1.5, 4.0  # log(a / (most − a)): where it starts, how far it goes
_CLOSE = 0.2  # what it may change by from one try to the last: a hundredth of the cost
_NEAR = 0.01  # what the cost may be off: Q is that far inside
_FLAT = 1e-24  # of the largest square: what is smaller does not count
_SHARES = (0.0, 1e-6, 1e-3, 0.1, 0.5)  # of a Q far inside that is mixed in, until the inequality is proved


@dataclass(frozen=True, kw_only=True)
class Ellipsoid:
    """Q ≻ 0 and −(M_p Q + Q M_pᵀ) − a Q − g gᵀ / a ≻ 0 for every p, proved exactly; and c Q cᵀ ≤ size² for rows c.

    Where M_p, g or c have irrational entries, for everything in their balls.

    Attributes:
        integers, exponents: Q_jk = integers_jk · 2^(exponents_j + exponents_k).
        a: In 1/s, a short decimal.
        sizes: One for each c, rounded up: |c z| ≤ size · sup |d| from z = 0.
    """

    integers: tuple[tuple[int, ...], ...]
    exponents: tuple[int, ...]
    a: float
    sizes: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Inner:
    """Q (N, N) with M_p Q + Q M_pᵀ + a Q ≺ 0 for all p and all a up to `most`."""

    Q: Array
    most: float


def ellipsoid(
    M: Sequence[BallMatrix], g: BallMatrix, forms: BallMatrix, inners: Sequence[Inner], *, tries: int = 3
) -> Ellipsoid | None:
    """Return an ellipsoid in which all of c z are small at once: the sum of c Q cᵀ, each over its usual size.

    Args:
        M: The matrices M_p (N, N).
        g: (N, 1), not 0.
        forms: The rows c, (s, N).
        inners: What to start from; of those that will do the last is taken, which should be the better conditioned.
        tries: Of a.

    Returns:
        The ellipsoid, or None if none could be proved.

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
        if weights is None:
            weights = 1 / np.maximum(squares, _FLAT * squares.max(initial=1e-300))
        cost = float(weights @ squares)
        if cost < least:
            best, least = (Q, far, a), cost
        steps.append((where, slope * a * (1 - a / most)))
        where = _next(steps)
        if abs(where - steps[-1][0]) <= _CLOSE:
            break
    return None if best is None else _proved(M, g, forms, *best)


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
    N, speed = len(g), inner.most / 2
    try:
        V = np.linalg.cholesky(inner.Q)
    except np.linalg.LinAlgError:
        return np.full_like(inner.Q, np.inf), inner.Q, 1 / a
    inside = solve_triangular(V, np.swapaxes(M @ V, 0, 1).reshape(N, -1), lower=True).reshape(N, -1, N)
    scaled, column = np.swapaxes(inside, 0, 1) / speed, solve_triangular(V, g, lower=True) / speed
    short = a / speed
    slack = -float(np.linalg.eigvalsh(symmetric_part(scaled) + short * np.eye(N)).max())
    forms = rows @ V
    squares = (forms**2).sum(axis=1)
    if weights is None:
        weights = 1 / np.maximum(squares, _FLAT * squares.max(initial=1e-300))
    if not slack > 0:
        return np.full_like(inner.Q, np.inf), inner.Q, 1 / a
    size = 2 * float(column @ column) / short / slack  # for size · I there is room
    far = size * V @ V.T
    W = (forms.T * weights) @ forms * size
    total = float(np.trace(W))
    if not total > 0:
        return far, far, 0.0
    drive = np.outer(column, column) / (short * size)
    W = W / total + 1e-9 * np.eye(N) / N
    program = least_sizes(weighted(scaled + short / 2 * np.eye(N), drive), W)
    found = solve(program, gap=_NEAR)
    if found is None or found.multipliers is None:
        return far, far, 0.0
    slope = float(np.einsum("pjk,kj->", found.multipliers[0], found.P - drive / short))
    return size * V @ found.P @ V.T, far, slope / float((W * found.P).sum()) / speed


def _proved(
    M: Sequence[BallMatrix], g: BallMatrix, forms: BallMatrix, Q: Array, far: Array, a: float
) -> Ellipsoid | None:
    """Round Q to short numbers and prove the inequality, or return None."""
    for share in _SHARES:
        mixed = (1 - share) * Q + share * far
        if not np.isfinite(mixed).all():
            continue
        integers, exponents = rounded(mixed)
        exact, unit = unpacked(integers, exponents), [Fraction(2) ** e for e in exponents]
        rest = scalar(a) * exact + square_above(g, [1 / Fraction(repr(a))], unit)
        if is_positive_definite(exact) and all(is_positive_definite(-change(X, exact, unit) - rest) for X in M):
            sizes = tuple(root_above(square) for square in squares(forms, exact))
            return Ellipsoid(integers=integers, exponents=exponents, a=a, sizes=sizes)
    return None


def change(M: BallMatrix, Q: Rational, unit: Sequence[Fraction]) -> Rational:
    """Return M Q + Q Mᵀ, or what is above it for every M in the ball."""
    MQ = M.centre * Q
    return MQ + MQ.transpose() + unsure(M.radius, Q, unit)


def squares(forms: BallMatrix, Q: Rational) -> list[Any]:
    """Return c Q cᵀ for each row c, or the most that it is in the ball."""
    squares = forms @ BallMatrix(Q) @ forms.transpose()
    return [
        squares.centre[k, k] + (0 if squares.radius is None else squares.radius[k, k]) for k in range(forms.shape[0])
    ]


def rounded(Q: Array) -> tuple[tuple[tuple[int, ...], ...], tuple[int, ...]]:
    """Return integers and exponents with Q_jk near integers_jk · 2^(exponents_j + exponents_k)."""
    exponents = np.round(np.log2(np.maximum(np.diag(Q), 1e-300)) / 2).astype(int) - BITS // 2
    unit = [Fraction(2) ** int(e) for e in exponents]
    rows = (symmetric_part(Q) / 2).tolist()
    integers = (
        tuple(round(Fraction(v) / (a * b)) for v, b in zip(row, unit, strict=True))
        for row, a in zip(rows, unit, strict=True)
    )
    return tuple(integers), tuple(int(e) for e in exponents)


def _short(value: float) -> float:
    """Return a number of three digits."""
    return float(f"{value:.2e}")
