"""The inequalities in PICOS notation, solved by Clarabel or CVXOPT.

PICOS does not know Clarabel: it takes it through the `ad_hoc_solver` option that it offers for this.
"""

from collections.abc import Sequence
from typing import Any

import clarabel
import cvxopt
import numpy as np
import picos
from picos.constraints import AffineConstraint, LMIConstraint
from picos.expressions import CONTINUOUS_VARTYPES, AffineExpression
from picos.modeling.footprint import Specification
from picos.modeling.solution import (
    PS_FEASIBLE,
    PS_INFEASIBLE,
    PS_UNBOUNDED,
    PS_UNKNOWN,
    SS_INFEASIBLE,
    SS_OPTIMAL,
    SS_UNKNOWN,
)
from picos.solvers.solver import Solver as PicosSolver
from scipy import sparse

from pwatrack.arrays import Array
from pwatrack.lmi.cone_program import minimise, symmetric_of
from pwatrack.lmi.inequality import Inequality, Solver
from pwatrack.lmi.program import SemidefiniteProgram, Solution

_STATUS = {
    clarabel.SolverStatus.Solved: (SS_OPTIMAL, SS_OPTIMAL, PS_FEASIBLE),
    clarabel.SolverStatus.PrimalInfeasible: (SS_INFEASIBLE, SS_UNKNOWN, PS_INFEASIBLE),
    clarabel.SolverStatus.DualInfeasible: (SS_UNKNOWN, SS_INFEASIBLE, PS_UNBOUNDED),
}


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
    cost = program.price * t if program.cost is None else picos.trace(program.cost * P)
    problem.set_objective("min", cost)
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


class ClarabelSolver(PicosSolver):  # type: ignore[misc]
    """Linear objectives over linear and semidefinite constraints, min cᵀx s.t. Gx + s = h, s ∈ cones."""

    SUPPORTED = Specification(
        objectives=[AffineExpression], variables=CONTINUOUS_VARTYPES, constraints=[AffineConstraint, LMIConstraint]
    )

    @classmethod
    def supports(cls, footprint: Any, explain: bool = False) -> Any:
        supported, reason = PicosSolver.supports(footprint, explain=True)
        if supported and footprint not in cls.SUPPORTED:
            supported, reason = False, cls.SUPPORTED.mismatch_reason(footprint)
        return (supported, reason) if explain else supported

    @classmethod
    def default_penalty(cls) -> float:
        return 1.0

    @classmethod
    def test_availability(cls) -> None:
        """Clarabel is a dependency: always there."""

    @classmethod
    def names(cls) -> tuple[str, str, str, None]:
        return "clarabel", "Clarabel", "Clarabel interior-point solver", None

    @classmethod
    def is_free(cls) -> bool:
        return True

    def reset_problem(self) -> None:
        self.int = None

    def _import_problem(self) -> None:
        offset, offsets = 0, {}
        for variable in self.ext.variables.values():
            offsets[variable] = offset
            offset += variable.dim
        self._offsets, self._size = offsets, offset
        rows, sides, cones, places = [], [], [], []
        bounds = [v.bound_constraint for v in self.ext.variables.values() if v.bound_constraint]
        for constraint in (*self.ext.constraints.values(), *bounds):
            G, h = self._affine(constraint.smaller - constraint.greater)
            if isinstance(constraint, LMIConstraint):
                order = constraint.size[0]
                column, row = np.tril_indices(order)
                take, weight = column * order + row, np.where(row == column, 1.0, np.sqrt(2.0))  # as `upper` has it
                G, h = sparse.diags(weight) @ G[take], weight * h[take]
                cones.append(clarabel.PSDTriangleConeT(order))
            elif constraint.is_equality():
                cones.append(clarabel.ZeroConeT(len(h)))
            else:
                cones.append(clarabel.NonnegativeConeT(len(h)))
            places.append((constraint, len(h)))
            rows.append(G)
            sides.append(-h)
        direction, objective = self.ext.no
        cost = self._affine(objective)[0].toarray().ravel() * (-1.0 if direction == "max" else 1.0)
        data: Any = (cost, sparse.vstack(rows, format="csc"), np.concatenate(sides), cones, places)
        self.int = data

    def _update_problem(self) -> None:
        raise NotImplementedError  # documented way to make PICOS import the problem again

    def _solve(self) -> Any:
        data: Any = self.int
        cost, G, h, cones, places = data
        with self._stopwatch():
            answer = minimise(cost, G, h, cones)
        primal, dual, problem = _STATUS.get(answer.status, (SS_UNKNOWN, SS_UNKNOWN, PS_UNKNOWN))
        x, z = np.array(answer.x), iter(np.split(np.array(answer.z), np.cumsum([size for _, size in places])[:-1]))
        return picos.Solution(
            primals={v: x[k : k + v.dim].tolist() for v, k in self._offsets.items()},
            duals={constraint: _dual(constraint, next(z)) for constraint, _ in places},
            problem=self.ext,
            solver="Clarabel",
            primalStatus=primal,
            dualStatus=dual,
            problemStatus=problem,
            searchTime=self.timer,
            info={"status": str(answer.status), "iterations": answer.iterations},
            vectorizedPrimals=True,
            reportedValue=answer.obj_val * (-1.0 if self.ext.no.direction == "max" else 1.0),
        )

    def _affine(self, expression: Any) -> tuple[Any, Any]:
        """Return G (csr) and h with vec(expression) = G x + h."""
        G, h = expression.sparse_matrix_form(varOffsetMap=self._offsets, dense_b=True)
        entries = np.array(G.V).ravel(), (np.array(G.I).ravel(), np.array(G.J).ravel())
        return sparse.csr_matrix(entries, shape=(G.size[0], self._size)), np.array(h).ravel()


def _dual(constraint: Any, z: Any) -> Any:
    """Return what PICOS calls the dual: a matrix for a semidefinite constraint."""
    if not isinstance(constraint, LMIConstraint):
        return cvxopt.matrix(z if not constraint.is_equality() else -z)
    return cvxopt.matrix(symmetric_of(z, constraint.size[0]))
