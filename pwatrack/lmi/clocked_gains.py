"""Gains of least cost of a loop that acts at ticks, for all cells: where those of a mean cell do not do.

Noise of density G Gᵀ drives Δ' = A_j Δ, with A_j any in a hull, and at ticks C Δ is measured with a variance R / h. The
inverse Σ⁻¹ of what is above the covariance of Δ before a tick is P_N of forms with

    (P_{k+1} − P_k) / δ + F_iᵀ P_e + P_e F_i + P_e G Gᵀ P_e ⪯ 0,    Nᵀ (P_0 − P_N − X) N ⪯ 0

for F = A, N = I and X = h Cᵀ R⁻¹ C; the one with the largest trace has M = −Σ Cᵀ (C Σ Cᵀ + R / h)⁻¹. Of inputs that are
held, z = (e, ν) with e' = A_i e + B ν, ν' = 0, and ∫ zᵀ G Gᵀ z dt is at most zᵀ Y⁻¹ z after a tick, with Y = P_N of
such forms for the transposed F, N = [I; 0] and X = 0, in backward time: the ν that makes it least is K e, K = V W⁻¹ for
W, V the blocks of Y that e has with e, and ν with e.
"""

from contextlib import suppress

import numpy as np
import scipy  # whose parts are imported where they are used

from pwatrack.arrays import Array, root_of
from pwatrack.lmi.chain_map import Bound, shrinks, square
from pwatrack.lmi.clocked_forms import ClockedForms, Segment
from pwatrack.lmi.frame import Frame

_KNOTS = (4, 16)  # segments of a sample: more where none are found
_MOST = 2_100  # unknowns: a step of the search takes a tenth of a second then
_GAP = 1e-3  # share of the trace that may be missed
_REST = 1e-4  # of what noise makes in a period: what flows are to leave beside
_LEAST = 1e-6  # of what is optimal for the mean, at all


def correction(A: Array, C: Array, Q: Array, R: Array, *, period: float, near: Array) -> Array | None:
    """Return M (n, q) of x̂⁺ = x̂ + M (C x̂ − y), predicted with any A_j in a hull (v, n, n); None where none is found.

    Args:
        A: In 1/s; a rate that is asked for is added to them.
        C: (q, n).
        Q: Density of noise on x', (n, n).
        R: The same on y, (q, q).
        period: h in s.
        near: The covariance before a tick in the mean cell, (n, n): the trace counts where it is I.

    Example: of one cell it is nearly the Kalman filter, for short samples; here P² = 1 in continuous time.

        >>> one = np.eye(1)
        >>> correction(np.zeros((1, 1, 1)), one, one, one, period=1e-3, near=one).round(5).tolist()
        [[-0.001]]
    """
    P = largest_form(A, root_of(Q).T, None, period * C.T @ np.linalg.solve(R, C), near, period)
    if P is None:
        return None
    across = np.linalg.solve(P, C.T)
    return np.asarray(-np.linalg.solve(C @ across + R / period, across.T).T)


def feedback(A: Array, B: Array, Q: Array, R: Array, *, period: float, near: Array) -> Array | None:
    """Return K (m, n) of u = K x, held for a period, with any A_i, and weights of x and u; see `correction`.

    `near` is the matrix of the cost after a tick in the mean cell, (n + m, n + m).

    Example:
        >>> one = np.eye(1)
        >>> feedback(np.zeros((1, 1, 1)), one, one, one, period=1e-3, near=np.diag([1, 1e-3])).round(1).tolist()
        [[-1.0]]
    """
    (n, m), cells = B.shape, len(A)
    F, weight = np.zeros((cells, n + m, n + m)), np.zeros((n + m, n + m))
    F[:, :n], weight[:n, :n], weight[n:, n:] = np.concatenate([A, [B] * cells], axis=2), Q, R
    N = np.eye(n + m, n)
    Y = largest_form(F.transpose(0, 2, 1), root_of(weight).T, N, np.zeros_like(weight), near, period)
    return None if Y is None else np.asarray(np.linalg.solve(Y[:n, :n], Y[:n, n:]).T)


def largest_form(F: Array, G: Array, N: Array | None, X: Array, near: Array, period: float) -> Array | None:
    """Return P_N of the forms with the largest trace where that of one cell, near⁻¹, is I; None where none is found.

    Args:
        F: (v, n, n), in 1/s.
        G: (n, p).
        N: (n, k); None for I.
        X, near: (n, n).
        period: h in s.
    """
    with suppress(np.linalg.LinAlgError):  # a form is not definite to working precision
        at = Frame(np.asarray(np.linalg.inv(np.linalg.cholesky(near))))
        X, eye = at.right(at.right(X[None])[0].T[None])[0], np.eye(len(near))
        F, G = at.inside(F) * period, at.left(G[None])[0] * np.sqrt(period)
        N = eye if N is None else np.linalg.qr(at.left(N[None])[0])[0]
        for knots in _KNOTS:
            if (P := _largest(F, G, N, X, knots)) is not None:
                return np.asarray(at.L.T @ P @ at.L)
    return None


def _largest(F: Array, G: Array, N: Array, X: Array, knots: int) -> Array | None:
    """Return P_N of so many segments, with ticks 1 apart; None where there is none, or it takes too long."""
    (v, n, _), p, eye = F.shape, G.shape[1], np.eye(len(G))
    U, V = np.zeros((v, n, 0)), np.zeros((v, 0, n))
    clock = ClockedForms(F=F, U=U, V=V, J=eye[None], R=eye, knots=knots, period=1.0, sizes=np.ones(n))
    if clock.unknowns > _MOST:
        return None
    rest = scipy.linalg.block_diag(clock.step * _REST * G @ G.T, -np.eye(p))

    def falls(segment: Segment, i: int) -> Bound:
        """Return the inequality of a cell at an end of a segment, with a little to spare."""
        return clock.falls(segment, i, rest, np.sqrt(clock.step) * G.T)

    def left(P: Array, T: Array, segment: Segment) -> Array:
        push = P[segment[2]] @ G
        return np.asarray(clock.left(P, T, segment) - clock.step * (push @ push.T - _LEAST * eye))

    fixed = [Bound({k: square(eye, -1.0)}, _LEAST * eye) for k in range(clock.count)]
    fixed.append(shrinks(knots, 0, eye, -X, N))
    found = clock.solved(fixed, falls, left, _GAP, -eye / n)
    return None if found is None else found[0][-1]
