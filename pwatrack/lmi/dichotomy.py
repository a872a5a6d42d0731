"""(17±): one P of any sign for all cells, so that there is exactly one bounded solution; or proof that there is none.

Why M_i P + P M_iᵀ ≺ 0 in all cells, M_i the transpose of A_i, makes η' = F(t, η) have one, and why no P does that where
Z_i ⪰ 0, not all 0, have Σ (Z_i M_i + M_iᵀ Z_i) = 0, or two cells a P each with different numbers of positive
eigenvalues, is in `docs/theory/beyond.md`, *Zero dynamics with unstable modes*. P ≻ 0 is (17). One Z of one cell with a
mode on the imaginary axis is such a proof.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import schur, solve_continuous_lyapunov, solve_sylvester

from pwatrack.arrays import Array, symmetric_part
from pwatrack.ball_matrix import BallMatrix, stack
from pwatrack.lmi.exact import Packed, left_side, margin_of
from pwatrack.lmi.inequality import Role, lyapunov
from pwatrack.lmi.multipliers import conflict, whole
from pwatrack.lmi.presolve import corners, extreme
from pwatrack.lmi.program import largest_margin
from pwatrack.lmi.solve import solve
from pwatrack.lmi.uncontrollable import symmetric_part_of_spectrum
from pwatrack.rational import floats, is_positive_definite, on_rows, positive_eigenvalues

_NEAR = 1e-3  # gap: any P with a margin does


@dataclass(frozen=True, kw_only=True)
class Dichotomy(Packed):
    """−(M_i P + P M_iᵀ) − margin I ≻ 0 for every i, with a P of any sign, proved exactly; P is invertible then.

    Where M_i has irrational entries, for every matrix in its ball.
    """

    role: Role  # which inequality it takes the place of
    margin: float  # μ > 0, a short decimal


def prove_dichotomy(role: Role, M: Sequence[BallMatrix]) -> Dichotomy | None:
    """Find such a P and prove it exactly, or return None."""
    proofs = (_exactly(role, M, P) for P in _candidates(stack(M)))
    return next((proof for proof in proofs if proof is not None), None)


def _candidates(M: Array) -> Iterator[Array]:
    """Yield matrices P: that of the mean of the cells, then one of a large margin where that one is diag(±1)."""
    starts = (_hyperbolic(X) for X in (M.mean(axis=0), M[0]))
    start = next((P for P in starts if P is not None), None)
    if start is None:
        return
    yield start
    values, vectors = np.linalg.eigh(start)
    if not np.isfinite(values).all() or not values.all():  # P is singular to rounding
        return
    T, inverse = vectors * np.sqrt(np.abs(values)), (vectors / np.sqrt(np.abs(values))).T
    at = inverse @ extreme(M) @ T
    speed = float(np.linalg.norm(at, 2, axis=(1, 2)).max())
    found = solve(largest_margin(lyapunov(at / speed), any_sign=True), gap=_NEAR)
    if found is not None:
        yield T @ found.P @ T.T


def _hyperbolic(M: Array) -> Array | None:
    """Return P with M P + P Mᵀ ≺ 0 for one matrix; None where an eigenvalue is on the imaginary axis."""
    T, Z, q = schur(M, sort="lhp")
    real = np.linalg.eigvals(M).real
    if not np.abs(real).min() > 0:
        return None
    n = len(M)
    unit = np.eye(n)
    if 0 < q < n:
        unit[:q, q:] = solve_sylvester(T[:q, :q], -T[q:, q:], -T[:q, q:])
    V, P = Z @ unit, np.zeros((n, n))
    for part, sign in ((slice(0, q), 1), (slice(q, n), -1)):
        block = T[part, part]
        if len(block):
            with warnings.catch_warnings():  # of a mode that rounding alone keeps off the axis; P is proved or dropped
                warnings.simplefilter("ignore", RuntimeWarning)
                P[part, part] = sign * solve_continuous_lyapunov(sign * block, -np.abs(np.diag(np.diag(block))))
    found = V @ P @ V.T
    return symmetric_part(found) / 2 if np.isfinite(found).all() else None


def _exactly(role: Role, M: Sequence[BallMatrix], P: Array) -> Dichotomy | None:
    values, vectors = np.linalg.eigh(P)
    size = (vectors * np.abs(values)) @ vectors.T  # |P|, of positive diagonal
    if not (np.isfinite(size).all() and (np.diag(size) > 0).all()):
        return None
    short = Packed.of(P, like=size)
    left = [left_side(M_i, short) for M_i in M]
    if not all(is_positive_definite(S) for S in left):
        return None
    return Dichotomy(role=role, margin=margin_of(left), **short.parts)


@dataclass(frozen=True, kw_only=True)
class NoDichotomy:
    """Proof that no P = Pᵀ has M_i P + P M_iᵀ ≺ 0 in all cells, for the middles of balls."""

    Z: Mapping[int, tuple[tuple[int, ...], ...]]  # whole-number multipliers by cell, else 0; or empty
    P: Mapping[int, Dichotomy]  # one for each of two cells with different numbers of unstable modes; or empty
    unstable: Mapping[int, int]  # how many unstable modes these two have


def refute_dichotomy(role: Role, M: Sequence[BallMatrix]) -> NoDichotomy | None:
    """Prove that no P of any sign has M_i P + P M_iᵀ ≺ 0 for all cells, the middles of balls; or return None."""
    middles = [BallMatrix(M_i.centre) for M_i in M]
    near = stack(M)
    numbers = _numbers(role, middles, near)
    if numbers is not None:
        return numbers
    for i, M_i in enumerate(middles):
        N = symmetric_part_of_spectrum(M_i.centre)
        if N.nrows():
            rest = on_rows(M_i.centre, N)
            found = conflict(floats(rest)[None], None, [rest], None)
            if found is not None:
                return NoDichotomy(Z=whole({i: N.transpose() * found[0] * N}), P={}, unstable={})
    at = corners(near).tolist()
    found = conflict(near[at], None, [middles[i].centre for i in at], None) if len(at) > 1 else None
    return None if found is None else NoDichotomy(Z=whole({at[i]: Z for i, Z in found.items()}), P={}, unstable={})


def _numbers(role: Role, M: Sequence[BallMatrix], near: Array) -> NoDichotomy | None:
    """Return two cells with different numbers of unstable modes, those that differ most, with their proofs."""
    unstable = (np.linalg.eigvals(near).real > 0).sum(axis=1)
    few, many = int(unstable.argmin()), int(unstable.argmax())
    if unstable[few] == unstable[many]:
        return None
    P = {i: prove_dichotomy(role, [M[i]]) for i in (few, many)}
    proved = {i: proof for i, proof in P.items() if proof is not None}
    counts = {i: near.shape[1] - positive_eigenvalues(proof.P) for i, proof in proved.items()}
    if len(counts) < 2 or counts[few] == counts[many]:
        return None
    return NoDichotomy(Z={}, P=proved, unstable=counts)
