"""From which starts a switched system keeps some linear forms small for good: an ellipsoid around them, proved exactly.

Let z' = M(t) z with M(t) in the convex hull of the M_p, and z(0) = G ζ with |ζ_k| ≤ 1, a box seen through G = [g_1 …].
For weights w_k > 0 with Σ w_k ≤ 1 this has z(0) z(0)ᵀ ⪯ G diag(1 / w) Gᵀ (proved in `docs/theory/beyond.md`). With
Q ⪰ G diag(1 / w) Gᵀ, Q ≻ 0, that is z(0)ᵀ Q⁻¹ z(0) ≤ 1. With M_p Q + Q M_pᵀ ≺ 0 for every p it stays so, and
|c z| ≤ √(c Q cᵀ) at all times for every row c (Boyd et al., Linear Matrix Inequalities in System and Control Theory,
1994, section 5.2). What holds from z(0) holds in proportion from multiples of it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product

import numpy as np
from scipy.linalg import eigh, solve_triangular

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.ellipsoid import Inner, enclosure
from pwatrack.lmi.exact import Packed
from pwatrack.lmi.inequality import Inequality, lyapunov
from pwatrack.lmi.program import SemidefiniteProgram, of_P
from pwatrack.lmi.solve import solve

_DECAY = 0.02  # of the rate of the Q that is started from: what Q gives up so that the inequality is strict
WEIGHINGS = 3  # times that the weights of the directions are chosen anew
_LEAST = 1e-4  # of a weight
_NEAR = 1e-3  # what the scale may be off
_ROOM = (1e-9, 1e-7, 1e-5, 1e-3)  # by which Q is enlarged, until it is proved
_SHARES = (0.0, 1e-3, 0.1)  # of the Q to start from that are mixed in, until it is proved


@dataclass(frozen=True, kw_only=True)
class StartEllipsoid(Packed):
    """Q ≻ 0 with Q − G diag(1 / w) Gᵀ ≻ 0 and −(M_p Q + Q M_pᵀ) ≻ 0 for every p, proved exactly; c Q cᵀ ≤ size².

    Where M_p or c have irrational entries, for everything in their balls. So |c z| ≤ size at all times.

    Attributes:
        weights: w_k, short decimals; one for each column of G.
        sizes: One for each c, rounded up.
    """

    weights: tuple[float, ...]
    sizes: tuple[float, ...]


def held(M: Sequence[BallMatrix], G: Array, forms: BallMatrix, most: Array, inner: Inner) -> StartEllipsoid | None:
    """Return an ellipsoid around starts, if one is proved, in which the largest |c z| / most is as small as can be.

    Args:
        M: The matrices M_p (N, N).
        G: (N, k); it counts as the decimals that it prints as. Columns of 0 do nothing.
        forms: The rows c, (s, N).
        most: What each of them is held against, (s,), positive; infinite for what does not count.
        inner: What to start from.

    Example: z' = −z from |z(0)| ≤ 3, seen as 2 z.

        >>> M, c = BallMatrix.of([[-1]]), BallMatrix.of([[2]])
        >>> found = held([M], np.array([[3.0]]), c, np.ones(1), Inner(Q=np.eye(1), most=1.9))
        >>> 6.0 <= found.sizes[0] < 6.001
        True
    """
    acts = np.flatnonzero(G.any(axis=0))
    rows = forms.floats / most[:, None]
    if not len(acts) or not rows.any():
        return None
    matrices, best, least = np.array([M_p.floats for M_p in M]), None, np.inf
    weights = np.full(len(acts), 1 / len(acts))
    for _ in range(WEIGHINGS):
        Q = _smallest(matrices, G[:, acts], rows, inner, weights)
        if Q is None:
            break
        largest = float(np.einsum("sj,jk,sk->s", rows, Q, rows).max())
        if not largest < least:
            break
        best, least = (Q, weights), largest
        weights = weighed(G[:, acts], Q)
    if best is None:
        return None
    all_weights = np.full(G.shape[1], _LEAST / G.shape[1])
    all_weights[acts] = best[1]
    weights = np.floor(all_weights / all_weights.sum() * 1e7 - 1)
    short, decimal = tuple((np.maximum(weights, 1.0) / 1e7).tolist()), BallMatrix.of(G, G.shape)
    proved = enclosure(M, forms, _mixed(best[0], inner.Q), around=(decimal, [1 / Fraction(repr(w)) for w in short]))
    return None if proved is None else StartEllipsoid(weights=short, sizes=proved[1], **proved[0].parts)


def _mixed(Q: Array, far: Array) -> Iterator[Array]:
    """Yield what is a little larger than Q, then with more and more of another one mixed in."""
    for share, room in product(_SHARES, _ROOM):
        shape = (1 - share) * Q + share * float(np.trace(Q) / np.trace(far)) * far
        yield (shape + shape.T) / 2 * float(1 + 1e-5 + room + 2 * share)


def weighed(G: Array, Q: Array) -> Array:
    """Return the weights (k,) with which G diag(1 / w) Gᵀ is more like Q: by what each direction needs of it.

    Example: along the longer axis of Q there is more room.

        >>> weighed(np.eye(2), np.diag([1.0, 3.0])).tolist()
        [0.75, 0.25]
    """
    needed = np.abs(G.T @ np.linalg.solve(Q, G)).sum(axis=1)
    weights = np.maximum(needed / needed.sum(), _LEAST)
    return np.asarray(weights / weights.sum())


def _smallest(M: Array, G: Array, rows: Array, inner: Inner, weights: Array) -> Array | None:
    """Return Q ⪰ G diag(1 / w) Gᵀ with the least of the largest c Q cᵀ, in floating point.

    In coordinates where the Q to start from is I, and in the unit of time most / 2, so that numbers are about 1.
    """
    near = inner.near(M)
    if near is None:
        return None
    V, scaled, forms = near[0], near[1] / (inner.most / 2), rows @ near[0]
    directions = solve_triangular(V, G, lower=True) / np.sqrt(weights)
    starts = directions @ directions.T
    starts = starts / float(np.linalg.norm(starts, 2))
    forms = forms / float(np.linalg.norm(forms, axis=1).max())
    solution = solve(_farthest_starts(lyapunov(scaled, _DECAY), forms[forms.any(axis=1)], starts), gap=_NEAR)
    if solution is None or not solution.t > 0:
        return None
    Q, needed = V @ solution.P @ V.T, G / np.sqrt(weights)
    try:
        share = float(eigh(needed @ needed.T, Q, eigvals_only=True)[-1])
    except (np.linalg.LinAlgError, ValueError):
        return None
    return Q * share


def _farthest_starts(inequality: Inequality, rows: Array, starts: Array) -> SemidefiniteProgram:
    """Maximise t subject to F_i(P) ⪯ 0 for all cells, P ⪰ t Σ, P ⪯ 1e6 I and c P cᵀ ≤ 1 for some rows c.

    What starts in √t times an ellipsoid, {z: z zᵀ ⪯ Σ}, then has |c z| ≤ 1.

    Args:
        inequality: From `lyapunov`.
        rows: c, (s, n), of size 1 at most.
        starts: Σ (n, n), positive semidefinite, of size 1.
    """
    eye = np.eye(inequality.n)
    return SemidefiniteProgram(
        constraints=(
            inequality,
            of_P(inequality, -1.0, eye, T=starts),
            of_P(inequality, 1.0, 1e-3 * eye, constant=-eye),
            *(of_P(inequality, 1.0, row[None], constant=-np.eye(1)) for row in rows),
        ),
        price=-1.0,
    )
