"""Clarabel, asked directly: min cᵀx s.t. G x + s = h, s ∈ cones."""

from collections.abc import Sequence
from typing import Any

import clarabel
import numpy as np
from scipy import sparse

from pwatrack.arrays import Array


def positive(order: int) -> Any:
    """Return the cone of X ⪰ 0 of an order: its upper triangle by columns, what is off the diagonal times √2."""
    return clarabel.PSDTriangleConeT(order)


def minimise(cost: Array, G: Any, h: Array, cones: Sequence[Any]) -> Any:
    """Return Clarabel's answer, whatever its status.

    Args:
        cost: c (n,).
        G: Sparse, by columns, (m, n).
        h: (m,).
        cones: Clarabel's, m rows together.

    Raises:
        ArithmeticError: If a number is not finite, or the library fails.

    Example: the least x with x ≥ 2.

        >>> at_least = sparse.csc_matrix([[-1.0]]), np.array([-2.0]), [clarabel.NonnegativeConeT(1)]
        >>> round(minimise(np.ones(1), *at_least).x[0], 6)
        2.0
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
