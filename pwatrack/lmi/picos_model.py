"""The inequalities in PICOS notation, solved by Clarabel or CVXOPT.

What comes back is a candidate. It proves nothing before `certificate` has
looked at it, whatever the solver says of it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import picos

from pwatrack.arrays import Array
from pwatrack.lmi.clarabel_plugin import ClarabelSolver
from pwatrack.lmi.inequality import Inequality, Solver


@dataclass(frozen=True)
class Candidate:
    """Matrices that a solver returned for an inequality: P (n, n) and Y (m, n)."""

    P: Array
    Y: Array


def largest_margin(inequality: Inequality, solver: Solver = "clarabel") -> Candidate | None:
    """Maximise t subject to F_i(P, Y) ⪯ −t I for all cells and t I ⪯ P ⪯ I.

    Returns:
        The maximiser, or None if the solver gave nothing.
    """
    problem, P, Y = _problem(inequality)
    t = picos.RealVariable("t")
    eye = np.eye(inequality.n)
    problem.add_list_of_constraints([F << -t * np.eye(F.size[0]) for F in _left_sides(inequality, P, Y)])
    problem.add_list_of_constraints([P >> t * eye, P << eye, t <= 1])
    problem.set_objective("max", t)
    return _solve(problem, P, Y, solver)


def least_cost(inequality: Inequality, solver: Solver = "clarabel") -> Candidate | None:
    """Minimise tr P⁻¹ subject to F_i(P, Y) ⪯ 0 for all cells, as min tr W with [W I; I P] ⪰ 0.

    Returns:
        The minimiser, or None if the solver gave nothing.
    """
    problem, P, Y = _problem(inequality)
    eye = np.eye(inequality.n)
    W = picos.SymmetricVariable("W", inequality.n)
    problem.add_list_of_constraints([F << 0 for F in _left_sides(inequality, P, Y)])
    problem.add_constraint(((W & eye) // (eye & P)) >> 0)
    problem.set_objective("min", picos.trace(W))
    return _solve(problem, P, Y, solver)


def least_condition(inequality: Inequality, unit: Array, solver: Solver = "clarabel") -> Candidate | None:
    """Minimise κ subject to F_i(P, Y) ⪯ 0 for all cells and U ⪯ λP ⪯ κU for some λ > 0.

    Args:
        inequality: What P must satisfy.
        unit: U (n, n), positive definite: the P that would be the identity in the units that count.
        solver: Which interior-point solver to ask.

    Returns:
        The minimiser, or None if the solver gave nothing.
    """
    problem, P, Y = _problem(inequality)
    t = picos.RealVariable("t")
    values, vectors = np.linalg.eigh(unit)
    if not values[0] > 0:
        return None
    # κ may be 1e12: so P ⪰ t U / λmax(U) and P ⪯ U / λmin(U), the latter as a bound of I, where all numbers are about 1
    narrow = vectors / np.sqrt(values / values[0])
    problem.add_list_of_constraints([F << 0 for F in _left_sides(inequality, P, Y)])
    problem.add_list_of_constraints([P >> t * (unit / values[-1]), narrow.T * P * narrow << np.eye(len(unit))])
    problem.set_objective("max", t)
    return _solve(problem, P, Y, solver)


def alternative(M: Array, solver: Solver = "clarabel") -> Array | None:
    """Look for Z_i ⪰ 0, Σ tr Z_i = 1, that make the smallest eigenvalue of Σ sym(Z_i M_i) largest.

    If it is positive, no P ≻ 0 has M_i P + P M_iᵀ ≺ 0 for all i, because the
    sum over i of tr Z_i (M_i P + P M_iᵀ) would be both negative and tr P Σ sym(Z_i M_i) > 0.

    Args:
        M: (l, n, n).

    Returns:
        Z (l, n, n), or None if the solver gave nothing.
    """
    n = M.shape[1]
    problem = picos.Problem()
    Z = [picos.SymmetricVariable(f"Z{i}", n) for i in range(len(M))]
    t = picos.RealVariable("t")
    total = picos.sum([Z_i * M_i + M_i.T * Z_i for Z_i, M_i in zip(Z, M, strict=True)])
    problem.add_list_of_constraints([Z_i >> 0 for Z_i in Z])
    problem.add_list_of_constraints([total >> t * np.eye(n), picos.sum([picos.trace(Z_i) for Z_i in Z]) == 1])
    problem.set_objective("max", t)
    if not _run(problem, solver):
        return None
    return np.array([_value(Z_i, (n, n)) for Z_i in Z])


def _problem(inequality: Inequality) -> tuple[Any, Any, Any]:
    P = picos.SymmetricVariable("P", inequality.n)
    Y = picos.RealVariable("Y", (inequality.m, inequality.n)) if inequality.m else None
    return picos.Problem(), P, Y


def _left_sides(inequality: Inequality, P: Any, Y: Any) -> list[Any]:
    sides = []
    for L, R, M, N, constant in zip(
        inequality.L, inequality.R, inequality.M, inequality.N, inequality.constant, strict=True
    ):
        half = L * P * R if Y is None else L * P * R + M * Y * N
        sides.append(half + half.T + constant)
    return sides


def _solve(problem: Any, P: Any, Y: Any, solver: Solver) -> Candidate | None:
    if not _run(problem, solver):
        return None
    n = P.shape[0]
    return Candidate(P=_value(P, (n, n)), Y=np.zeros((0, n)) if Y is None else _value(Y, (Y.shape[0], n)))


def _run(problem: Any, solver: Solver) -> bool:
    """Solve; say whether there are values to look at. No status is believed, no failure is fatal."""
    choice = {"ad_hoc_solver": ClarabelSolver} if solver == "clarabel" else {"solver": solver}
    try:
        problem.solve(primals=None, duals=False, max_iterations=200, **choice)
    except (ArithmeticError, ValueError, picos.SolutionFailure):
        return False
    return all(v.valued for v in problem.variables.values())


def _value(variable: Any, shape: tuple[int, int]) -> Array:
    return np.array(variable.value, dtype=np.float64).reshape(shape)
