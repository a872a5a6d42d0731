"""The inequalities in PICOS notation, solved by Clarabel, which PICOS does not know, or CVXOPT."""

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import clarabel
import cvxopt
import numpy as np
import picos
from picos.constraints import LMIConstraint
from scipy import sparse

from pwatrack.arrays import Array
from pwatrack.lmi.cone_program import minimise, symmetric_of
from pwatrack.lmi.inequality import Inequality, Solver
from pwatrack.lmi.program import SemidefiniteProgram, Solution


def solve(program: SemidefiniteProgram, solver: Solver = "clarabel") -> Solution | None:
    """Return the minimiser of a program, or None if the solver gave nothing."""
    problem, P = picos.Problem(), picos.SymmetricVariable("P", program.n)
    Y = picos.RealVariable("Y", (program.m, program.n)) if program.m else None
    t = picos.RealVariable("t")
    held = []
    for constraint in program.constraints:
        sides = [None if side.constant else side << 0 for side in _left_sides(constraint, P, Y, t)]
        problem.add_list_of_constraints([side for side in sides if side is not None])
        held.append(sides)
    for E, value in program.equalities:
        problem.add_constraint(value == (E | P))
    problem.set_objective("min", program.price * t if program.cost is None else (program.cost | P))
    if program.weight is not None:  # tr V P⁻¹ Vᵀ ≤ tr W
        V, W = program.weight, picos.SymmetricVariable("W", len(program.weight))
        problem.add_constraint(((W & V) // (V.T & P)) >> 0)
        problem.set_objective("min", picos.trace(W))
    if not run(problem, solver):
        return None
    n = program.n
    return Solution(
        program=program,
        P=_value(P, (n, n)),
        Y=np.zeros((0, n)) if Y is None else _value(Y, (program.m, n)),
        t=float(t.value) if t.valued else 0.0,
        multipliers=_duals(program, held),
    )


def _duals(program: SemidefiniteProgram, held: Sequence[Sequence[Any]]) -> tuple[Array, ...] | None:
    """Return the multipliers of constraints, 0 where no unknown stands in one; None where the solver gave none."""
    if any(side is not None and side.dual is None for sides in held for side in sides):
        return None
    found = []
    for sides, c in zip(held, program.constraints, strict=True):
        shape = c.constant.shape[1:]
        each = [np.zeros(shape) if side is None else np.reshape(side.dual, shape) for side in sides]
        found.append(np.array(each))
    return tuple(found)


def _left_sides(c: Inequality, P: Any, Y: Any, t: Any) -> list[Any]:
    """Return the left-hand sides; those in which no unknown is left are constants."""
    sides = []
    for i, (L, R, M, N, constant) in enumerate(zip(c.L, c.R, c.M, c.N, c.constant, strict=True)):
        halves = ([L * P * R] if L.any() else []) + ([M * Y * N] if Y is not None and M.any() else [])
        side = picos.sum([picos.Constant(constant), *(half + half.T for half in halves)])
        sides.append(side if c.T is None else side + t * c.T[i])
    return sides


def run(problem: Any, solver: Solver) -> bool:
    """Solve; say whether there are values to look at. No status is believed, no failure is fatal."""
    try:
        if solver == "clarabel":
            _by_clarabel(problem)
        else:
            problem.solve(primals=None, duals=None, max_iterations=200, solver=solver)
    except (ArithmeticError, ValueError, picos.SolutionFailure):
        return False
    return all(v.valued for v in problem.variables.values())


def _by_clarabel(problem: Any) -> None:
    """Give variables and constraints, affine and semidefinite ones, the values that Clarabel finds."""
    variables = list(problem.variables.values())
    ends = list(accumulate(v.dim for v in variables))
    offsets = {v: end - v.dim for v, end in zip(variables, ends, strict=True)}

    def affine(expression: Any) -> tuple[Any, Any]:
        """Return G (csr) and h with vec(expression) = G x + h."""
        G, h = expression.sparse_matrix_form(varOffsetMap=offsets, dense_b=True)
        entries = np.array(G.V).ravel(), (np.array(G.I).ravel(), np.array(G.J).ravel())
        return sparse.csr_matrix(entries, shape=(G.size[0], ends[-1])), np.array(h).ravel()

    rows, sides, cones = [], [], []
    for constraint in problem.constraints.values():
        G, h = affine(constraint.smaller - constraint.greater)
        if isinstance(constraint, LMIConstraint):
            order = constraint.size[0]
            column, row = np.tril_indices(order)
            take, weight = column * order + row, np.where(row == column, 1.0, np.sqrt(2.0))  # as `upper` has it
            G, h = sparse.diags(weight) @ G[take], weight * h[take]
            cones.append(clarabel.PSDTriangleConeT(order))
        else:
            cones.append((clarabel.ZeroConeT if constraint.is_equality() else clarabel.NonnegativeConeT)(len(h)))
        rows.append(G)
        sides.append(-h)
    direction, objective = problem.objective.normalized
    cost = affine(objective)[0].toarray().ravel() * (-1.0 if direction == "max" else 1.0)
    answer = minimise(cost, sparse.vstack(rows, format="csc"), np.concatenate(sides), cones)
    x, z = np.array(answer.x), np.split(np.array(answer.z), np.cumsum([len(h) for h in sides])[:-1])
    for v, k in offsets.items():
        v.internal_value = x[k : k + v.dim].tolist()
    for constraint, dual in zip(problem.constraints.values(), z, strict=True):
        lmi, sign = isinstance(constraint, LMIConstraint), -1.0 if constraint.is_equality() else 1.0
        constraint.dual = cvxopt.matrix(symmetric_of(dual, constraint.size[0]) if lmi else sign * dual)


def _value(variable: Any, shape: tuple[int, int]) -> Array:
    """Return what a variable has become; 0 where it stands in no constraint, as Y does where B = 0."""
    return np.array(variable.value, dtype=np.float64).reshape(shape) if variable.valued else np.zeros(shape)
