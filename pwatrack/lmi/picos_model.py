"""The inequalities in PICOS notation, solved by Clarabel or CVXOPT.

What comes back is a candidate. It proves nothing before `certificate` has
looked at it, whatever the solver says of it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import picos

from pwatrack.arrays import Array
from pwatrack.lmi.clarabel_plugin import ClarabelSolver
from pwatrack.lmi.inequality import Inequality, Solver
from pwatrack.lmi.program import Program, Solution


def solve(program: Program, solver: Solver = "clarabel") -> Solution | None:
    """Solve a program.

    Returns:
        The minimiser, or None if the solver gave nothing.
    """
    problem, P, Y = _problem(program)
    t = picos.RealVariable("t")
    for constraint in program.constraints:
        problem.add_list_of_constraints([side << 0 for side in _left_sides(constraint, P, Y, t) if not side.constant])
    if program.trace is not None:
        problem.add_constraint(picos.trace(P) == program.trace)
    traced = P if program.cost is None else program.cost * P
    problem.set_objective("min", program.price * t if program.price else picos.trace(traced))
    if program.weight is not None:  # tr V P⁻¹ Vᵀ ≤ tr W
        V, W = program.weight, picos.SymmetricVariable("W", len(program.weight))
        problem.add_constraint(((W & V) // (V.T & P)) >> 0)
        problem.set_objective("min", picos.trace(W))
    if not _run(problem, solver):
        return None
    n = program.n
    Y_found = np.zeros((0, n)) if Y is None else _value(Y, (program.m, n))
    return Solution(program=program, P=_value(P, (n, n)), Y=Y_found, t=float(t.value) if t.valued else 0.0)


def multipliers(
    A: Array,
    bases: Sequence[Array],
    blind: Array,
    *,
    interior: bool,
    solver: Solver = "clarabel",
) -> list[Array] | None:
    """Look for multipliers Z_i = Q_i U_i Q_iᵀ ⪰ 0 that refute (8): see `infeasibility`.

    With S = Σ (Z_i A_i + A_iᵀ Z_i), it makes the smallest eigenvalue of S on the complement of R largest,
    subject to S R = 0 and Σ tr U_i = 1.

    Args:
        A: (l, n, n).
        bases: Q_i (n, k_i), orthonormal.
        blind: R (n, ρ), directions that S must not see.
        interior: Keep every U_i away from singular too, so that it can be rounded.
        solver: Which interior-point solver to ask.

    Returns:
        The U_i, or None if the solver gave nothing.
    """
    problem = picos.Problem()
    U = [picos.SymmetricVariable(f"U{i}", Q.shape[1]) for i, Q in enumerate(bases)]
    t = picos.RealVariable("t")
    ZA = picos.sum([Q * U_i * (Q.T @ A_i) for Q, U_i, A_i in zip(bases, U, A, strict=True)])
    problem.add_list_of_constraints([U_i >> (t * np.eye(U_i.shape[0]) if interior else 0) for U_i in U])
    problem.add_constraint(picos.sum([picos.trace(U_i) for U_i in U]) == 1)
    S = ZA + ZA.T
    seen = _complement(blind)
    if seen.shape[1]:
        problem.add_constraint(seen.T * S * seen >> t * np.eye(seen.shape[1]))
    if blind.shape[1]:
        unit = blind / np.linalg.norm(blind, axis=0)
        nobody = np.max([np.abs(Q.T @ unit).max(axis=0) for Q in bases], axis=0) < 1e-9
        image = _complement(unit[:, nobody]).T * S * unit  # the rest of S R is 0 by itself, or said already
        if not image.constant:
            problem.add_constraint(image == 0)
    problem.add_constraint(t <= 1)
    problem.set_objective("max", t)
    if not _run(problem, solver):
        return None
    return [_value(U_i, U_i.shape) for U_i in U]


def _complement(columns: Array) -> Array:
    """Return orthonormal columns that, with these independent ones (n, k), span everything."""
    n, k = columns.shape
    complement: Array = np.linalg.qr(np.hstack([columns, np.eye(n)]))[0][:, k:]
    return complement


def _problem(unknowns: Program | Inequality) -> tuple[Any, Any, Any]:
    P = picos.SymmetricVariable("P", unknowns.n)
    Y = picos.RealVariable("Y", (unknowns.m, unknowns.n)) if unknowns.m else None
    return picos.Problem(), P, Y


def _left_sides(inequality: Inequality, P: Any, Y: Any, t: Any = None) -> list[Any]:
    """Return the left-hand sides; those in which no unknown is left are constants."""
    sides = []
    for i, (L, R, M, N, constant) in enumerate(
        zip(inequality.L, inequality.R, inequality.M, inequality.N, inequality.constant, strict=True)
    ):
        halves = ([L * P * R] if L.any() else []) + ([M * Y * N] if Y is not None and M.any() else [])
        side = picos.sum([picos.Constant(constant), *(half + half.T for half in halves)])
        sides.append(side if inequality.T is None else side + t * inequality.T[i])
    return sides


def _run(problem: Any, solver: Solver) -> bool:
    """Solve; say whether there are values to look at. No status is believed, no failure is fatal."""
    choice = {"ad_hoc_solver": ClarabelSolver} if solver == "clarabel" else {"solver": solver}
    try:
        problem.solve(primals=None, duals=False, max_iterations=200, **choice)
    except (ArithmeticError, ValueError, picos.SolutionFailure):
        return False
    return all(v.valued for v in problem.variables.values())


def _value(variable: Any, shape: tuple[int, int]) -> Array:
    """Return what a variable has become; 0 where it stands in no constraint, as Y does where B = 0."""
    return np.array(variable.value, dtype=np.float64).reshape(shape) if variable.valued else np.zeros(shape)
