"""Programs over cones, asked directly: min cᵀx s.t. G x + s = h, s ∈ cones."""

from collections.abc import Sequence
from typing import Any

import clarabel
import numpy as np
from scipy import sparse

from pwatrack.arrays import Array
from pwatrack.lmi.inequality import Solver


def semidefinite(cost: Array, rows: Array, sides: Array, order: int, solver: Solver) -> Array | None:
    """Return x that minimises cᵀx where each block h_k − G_k x, a symmetric matrix, is positive semidefinite, or None.

    `rows` are G_k (k, N (N + 1) / 2, n) and `sides` h_k (k, N (N + 1) / 2) for the order N: upper triangles by columns,
    what is off the diagonal times √2.
    """
    try:
        if solver == "cvxopt":
            return _by_cvxopt(cost, rows, sides, order)
        G = sparse.csc_matrix(rows.reshape(-1, len(cost)))
        return np.array(minimise(cost, G, sides.ravel(), [clarabel.PSDTriangleConeT(order)] * len(rows)).x)
    except ArithmeticError:
        return None


def _by_cvxopt(cost: Array, rows: Array, sides: Array, order: int) -> Array | None:
    """Return what CVXOPT finds, of whole matrices in place of triangles."""
    import cvxopt

    column, row = np.tril_indices(order)
    places = np.zeros((order, order), dtype=np.int64)
    places[row, column] = places[column, row] = np.arange(len(row))
    taken, weight = places.ravel(), np.where(np.eye(order, dtype=bool), 1.0, np.sqrt(0.5)).ravel()
    G, h = rows[:, taken] * weight[:, None], sides[:, taken] * weight
    if not (np.isfinite(G).all() and np.isfinite(h).all() and np.isfinite(cost).all()):
        return None
    dims, quiet = {"l": 0, "q": [], "s": [order] * len(rows)}, {"show_progress": False}
    try:
        found = cvxopt.solvers.conelp(
            cvxopt.matrix(cost), cvxopt.matrix(G.reshape(-1, len(cost))), cvxopt.matrix(h.ravel()), dims, options=quiet
        )
    except ValueError:  # a rank that is too small
        return None
    return None if found["x"] is None else np.array(found["x"]).ravel()


def minimise(cost: Array, G: Any, h: Array, cones: Sequence[Any], gap: float = 1e-8) -> Any:
    """Return Clarabel's answer, whatever its status; G is sparse, by columns, and the cones are Clarabel's.

    The gap is the share of the objective that may be missed. Raises ArithmeticError if a number is not finite, or the
    library fails.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_rel = gap
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
