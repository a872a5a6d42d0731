"""How far an answer to a program is off: what it violates, and how far its multipliers are from what they should be."""

import numpy as np

from pwatrack.lmi.program import Solution


def violation(found: Solution) -> float:
    """Return the largest eigenvalue of a left-hand side: negative where all constraints hold strictly."""
    sides = [c.evaluate(found.P, found.Y) for c in found.program.constraints]
    pairs = zip(found.program.constraints, sides, strict=True)
    return max(float(np.linalg.eigvalsh(X if c.T is None else X + found.t * c.T).max()) for c, X in pairs)


def off(found: Solution) -> float:
    """Return how far the equalities are from being one, at most."""
    return max((abs(float((E * found.P).sum()) - value) for E, value in found.program.equalities), default=0.0)


def dual_off(found: Solution) -> float:
    """Return how far the multipliers are off: the largest entry of the gradient of what they make of the objective.

    Where that is tr V P⁻¹ Vᵀ + tr G P, how far G is from G ⪰ 0. Those of the equalities are the best there are.
    """
    program = found.program
    if found.multipliers is None:
        return np.inf
    pairs = zip(found.multipliers, program.constraints, strict=True)
    of_P, of_Y, of_t = zip(*(c.adjoint(Z) for Z, c in pairs), strict=True)
    columns = np.array([E.ravel() for E, _ in program.equalities]).reshape(-1, program.n**2).T
    rest = np.sum(of_P, axis=0) + program.slope
    rest = rest - (columns @ np.linalg.lstsq(columns, rest.ravel())[0]).reshape(rest.shape)
    if program.weight is not None:
        rest = np.minimum(np.linalg.eigvalsh(rest), 0.0)
    H, h = np.sum(of_Y, axis=0), float(sum(of_t)) + program.price
    return max(float(np.abs(rest).max()), float(np.abs(H).max(initial=0.0)), abs(h))
