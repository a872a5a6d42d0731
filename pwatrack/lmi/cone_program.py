"""Programs over cones, asked directly: min cᵀx s.t. G x + s = h, s ∈ cones."""

from collections.abc import Sequence
from typing import Any

import clarabel
import numpy as np
from scipy import sparse

from pwatrack.arrays import Array
from pwatrack.lmi.inequality import Solver

Block = tuple[Array, Array]  # G (N (N + 1) / 2, n) and h (N (N + 1) / 2,), as `upper` has symmetric matrices


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
        G = sparse.csc_matrix(np.concatenate([G for G, _ in blocks]))
        cones = [clarabel.PSDTriangleConeT(_order(h)) for _, h in blocks]
        return np.array(minimise(cost, G, np.concatenate([h for _, h in blocks]), cones).x)
    except ArithmeticError:
        return None


def _order(h: Array) -> int:
    return int(np.sqrt(2 * len(h)))


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
    """Return what CVXOPT finds, of whole matrices in place of triangles."""
    import cvxopt

    orders = [_order(h) for _, h in blocks]
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


def minimise(cost: Array, G: Any, h: Array, cones: Sequence[Any]) -> Any:
    """Return Clarabel's answer, whatever its status; G is sparse, by columns, and the cones are Clarabel's.

    Raises ArithmeticError if a number is not finite, or the library fails.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    if not (np.isfinite(cost).all() and np.isfinite(G.data).all() and np.isfinite(h).all()):
        raise ArithmeticError("a coefficient is not finite")
    nothing, answer = sparse.csc_matrix((len(cost), len(cost))), None
    try:
        for method in ("faer", "qdldl"):  # the second is slower, and sometimes starts where the first does not
            settings.direct_solve_method = method
            answer = clarabel.DefaultSolver(nothing, cost, G, h, list(cones), settings).solve()
            if answer.iterations > 2:
                break
    except BaseException as error:  # a panic of the Rust library is no Exception
        if type(error).__name__ == "PanicException":
            raise ArithmeticError(f"Clarabel failed: {error}") from None
        raise
    return answer
