"""Programs over cones, asked of Clarabel or CVXOPT: min cᵀx s.t. G x + s = h, s ∈ cones."""

from collections.abc import Sequence
from contextlib import suppress
from itertools import compress
from math import isqrt
from typing import Any

import clarabel
import numpy as np
from scipy import sparse

from pwatrack.arrays import Array, symmetric_part
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.program import SemidefiniteProgram, Solution

Block = tuple[Array, Array]  # G (N (N + 1) / 2, n) and h (N (N + 1) / 2,), as `upper` has symmetric matrices
_Block = tuple[Any, Array]  # the same of triangles or whole matrices, G sparse
_TIGHT = {"feastol": 1e-8, "abstol": 1e-8, "reltol": 1e-8, "maxiters": 200, "kktreg": 1e-9}  # of CVXOPT, for P, Y


def solve(program: SemidefiniteProgram, solver: Solver = "clarabel") -> Solution | None:
    """Return what a solver makes of a program, whatever it says of it; None if it gives nothing.

    Left-hand sides are written down for each unknown alone, an entry of P, of Y, t, or of the W of tr V P⁻¹ Vᵀ ≤ tr W,
    without `linear_map`. What stands in none of them is 0.
    """
    n, m, V = program.n, program.m, np.zeros((0, program.n)) if program.weight is None else program.weight
    moved, timed = any(c.M.any() for c in program.constraints), any(c.T is not None for c in program.constraints)
    k = len(V)
    ends = np.cumsum([n * (n + 1) // 2, m * n * moved, timed, k * (k + 1) // 2])

    def flat(X: Array) -> Array:
        return X.reshape(*X.shape[:-2], -1) if solver == "cvxopt" else upper(X)

    P, Y, t, W = np.split(np.eye(ends[-1]), ends[:-1], axis=1)
    Y = Y.reshape(-1, n, m).transpose(0, 2, 1) if moved else np.zeros((len(P), m, n))
    P, t, W = symmetric_of(P, n), t.sum(axis=1), symmetric_of(W, k)
    small = W if k else P if program.cost is None else program.cost @ P
    cost = program.price * t if program.price else np.trace(small, axis1=1, axis2=2)
    blocks = []
    for c in program.constraints:
        for i, constant in enumerate(c.constant):
            side = symmetric_part(c.L[i] @ P @ c.R[i]) + symmetric_part(c.M[i] @ Y @ c.N[i])
            side = side if c.T is None else side + t[:, None, None] * c.T[i]
            blocks.append((sparse.csc_matrix(flat(side).T), -flat(constant)))
    if k:
        corner = np.zeros((len(P), k, n))
        both = flat(np.block([[W, corner], [corner.transpose(0, 2, 1), P]]))
        h = flat(np.block([[np.zeros((k, k)), V], [V.T, np.zeros((n, n))]]))
        blocks.append((sparse.csc_matrix(-both.T), h))
    held = [bool(G.nnz) for G, _ in blocks]  # where an unknown stands: else the multiplier is 0
    rows = np.array([(E * P).sum(axis=(1, 2)) for E, _ in program.equalities]).reshape(-1, len(P))
    equal = sparse.csc_matrix(rows), np.array([value for _, value in program.equalities], dtype=np.float64)
    try:
        x, Z = (_of_cvxopt if solver == "cvxopt" else _of_clarabel)(cost, [*compress(blocks, held)], *equal)
    except (ArithmeticError, ValueError):
        return None
    if x is None:
        return None
    P, Y, t = (np.tensordot(x, X, 1) for X in (P, Y, t))
    multipliers = None
    if Z is not None:
        each, acts = iter(Z), iter(held)
        multipliers = tuple(
            np.array([next(each) if next(acts) else 0 * C for C in c.constant]) for c in program.constraints
        )
    return Solution(program=program, P=P, Y=Y, t=float(t), multipliers=multipliers)


def _of_clarabel(cost: Array, blocks: Sequence[_Block], rows: Any, values: Array) -> tuple[Array, list[Array]]:
    """Return x, and the multipliers of blocks of triangles, whatever the status.

    Raises ArithmeticError if a number is not finite, or the library fails.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    orders = [int(np.sqrt(2 * len(h))) for _, h in blocks]
    cones = [*map(clarabel.PSDTriangleConeT, orders), clarabel.ZeroConeT(len(values))]
    G = sparse.vstack([*(G for G, _ in blocks), rows], format="csc")
    h = np.concatenate([*(h for _, h in blocks), values])
    if not (np.isfinite(cost).all() and np.isfinite(G.data).all() and np.isfinite(h).all()):
        raise ArithmeticError("a coefficient is not finite")
    nothing = sparse.csc_matrix((len(cost), len(cost)))
    try:
        for method in ("faer", "qdldl"):  # the second is slower, and sometimes starts where the first does not
            settings.direct_solve_method = method
            answer = clarabel.DefaultSolver(nothing, cost, G, h, cones, settings).solve()
            if answer.iterations > 2:
                break
    except BaseException as error:  # a panic of the Rust library is no Exception
        if type(error).__name__ == "PanicException":
            raise ArithmeticError(f"Clarabel failed: {error}") from None
        raise
    each = np.split(np.array(answer.z), np.cumsum([len(h) for _, h in blocks]))
    return np.array(answer.x), [symmetric_of(z, N) for z, N in zip(each, orders, strict=False)]


def _of_cvxopt(
    cost: Array, blocks: Sequence[_Block], rows: Any, values: Array
) -> tuple[Array | None, list[Array] | None]:
    """Return x, and the multipliers of blocks of whole matrices, by a slower way where the first one gives nothing."""
    import cvxopt

    def sparse_matrix(X: Any) -> Any:
        entries = X.tocoo()
        return cvxopt.spmatrix(entries.data.tolist(), entries.row.tolist(), entries.col.tolist(), X.shape, "d")

    orders, h = [isqrt(len(h)) for _, h in blocks], np.concatenate([h for _, h in blocks])
    G, A = sparse_matrix(sparse.vstack([G for G, _ in blocks])), sparse_matrix(rows)
    data = cvxopt.matrix(cost), G, cvxopt.matrix(h), {"l": 0, "q": [], "s": orders}, A, cvxopt.matrix(values[:, None])
    found, quiet = None, {"show_progress": False, **_TIGHT}
    with suppress(ValueError):  # a rank that is too small
        found = cvxopt.solvers.conelp(*data, kktsolver="chol", options=quiet)
    if found is None or found["status"] == "unknown":
        found = cvxopt.solvers.conelp(*data, kktsolver="ldl", options=quiet)
    x, z = (None if found[name] is None else np.array(found[name]).ravel() for name in "xz")
    each = None if z is None else np.split(z, np.cumsum([N * N for N in orders])[:-1])
    return x, None if each is None else [part.reshape(N, N) for part, N in zip(each, orders, strict=True)]


def semidefinite(cost: Array, blocks: Sequence[Block], solver: Solver) -> Array | None:
    """Return x that minimises cᵀx where each block h − G x, a symmetric matrix, is positive semidefinite, or None.

    Example: the least t with t I ⪰ diag(1, 2).

        >>> block = np.array([[-1.0], [0.0], [-1.0]]), np.array([-1.0, 0.0, -2.0])
        >>> [semidefinite(np.ones(1), [block], solver).round(6).tolist() for solver in ("clarabel", "cvxopt")]
        [[2.0], [2.0]]
    """
    try:
        if solver == "cvxopt":
            return _by_cvxopt(cost, blocks)
        none = sparse.csc_matrix((0, len(cost))), np.zeros(0)
        return _of_clarabel(cost, [(sparse.csc_matrix(G), h) for G, h in blocks], *none)[0]
    except ArithmeticError:
        return None


def upper(X: Array) -> Array:
    """Return upper triangles of symmetric matrices (l, N, N), column by column, what is off the diagonal times √2."""
    column, row = np.tril_indices(X.shape[-1])
    return np.asarray(X[..., row, column] * np.where(row == column, 1.0, np.sqrt(2.0)))


def symmetric_of(x: Array, N: int) -> Array:
    """Return the symmetric matrices (l, N, N) with these upper triangles (l, N (N + 1) / 2)."""
    column, row = np.tril_indices(N)
    X = np.zeros((*x.shape[:-1], N, N))
    X[..., row, column] = X[..., column, row] = x / np.where(row == column, 1.0, np.sqrt(2.0))
    return X


def _by_cvxopt(cost: Array, blocks: Sequence[Block]) -> Array | None:
    import cvxopt

    orders = [int(np.sqrt(2 * len(h))) for _, h in blocks]
    G = np.concatenate([symmetric_of(G.T, N).reshape(-1, N * N).T for (G, _), N in zip(blocks, orders, strict=True)])
    h = np.concatenate([symmetric_of(h, N).ravel() for (_, h), N in zip(blocks, orders, strict=True)])
    if not (np.isfinite(G).all() and np.isfinite(h).all() and np.isfinite(cost).all()):
        return None
    dims, quiet = {"l": 0, "q": [], "s": orders}, {"show_progress": False}
    try:
        found = cvxopt.solvers.conelp(cvxopt.matrix(cost), cvxopt.matrix(G), cvxopt.matrix(h), dims, options=quiet)
    except ValueError:  # a rank that is too small
        return None
    return None if found["x"] is None else np.array(found["x"]).ravel()
