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
    held = []
    for constraint in program.constraints:
        sides = [None if side.constant else side << 0 for side in _left_sides(constraint, P, Y, t)]
        problem.add_list_of_constraints([side for side in sides if side is not None])
        held.append(sides)
    for E, value in program.equalities:
        problem.add_constraint(value == (E | P))
    traced = P if program.cost is None else program.cost * P
    problem.set_objective("min", program.price * t if program.price else picos.trace(traced))
    if program.weight is not None:  # tr V P⁻¹ Vᵀ ≤ tr W
        V, W = program.weight, picos.SymmetricVariable("W", len(program.weight))
        problem.add_constraint(((W & V) // (V.T & P)) >> 0)
        problem.set_objective("min", picos.trace(W))
    if not _run(problem, solver):
        return None
    n = program.n
    return Solution(
        program=program,
        P=_value(P, (n, n)),
        Y=np.zeros((0, n)) if Y is None else _value(Y, (program.m, n)),
        t=float(t.value) if t.valued else 0.0,
        multipliers=_duals(program, held),
    )


def _duals(program: Program, held: Sequence[Sequence[Any]]) -> tuple[Array, ...] | None:
    """Return the multipliers of constraints, 0 where no unknown stands in one; None where the solver gave none."""
    if any(side is not None and side.dual is None for sides in held for side in sides):
        return None
    return tuple(
        np.array(
            [
                np.zeros(C.shape) if side is None else np.reshape(side.dual, C.shape)
                for side, C in zip(sides, c.constant, strict=True)
            ]
        )
        for sides, c in zip(held, program.constraints, strict=True)
    )


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
        problem.solve(primals=None, duals=None, max_iterations=200, **choice)
    except (ArithmeticError, ValueError, picos.SolutionFailure):
        return False
    return all(v.valued for v in problem.variables.values())


def _value(variable: Any, shape: tuple[int, int]) -> Array:
    """Return what a variable has become; 0 where it stands in no constraint, as Y does where B = 0."""
    return np.array(variable.value, dtype=np.float64).reshape(shape) if variable.valued else np.zeros(shape)
