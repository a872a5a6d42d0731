"""Clarabel as a solver for PICOS, through the `ad_hoc_solver` option that PICOS offers for this."""

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
from picos.solvers.solver import Solver
from scipy import sparse

from pwatrack.lmi.cone_program import minimise

_STATUS = {
    clarabel.SolverStatus.Solved: (SS_OPTIMAL, SS_OPTIMAL, PS_FEASIBLE),
    clarabel.SolverStatus.PrimalInfeasible: (SS_INFEASIBLE, SS_UNKNOWN, PS_INFEASIBLE),
    clarabel.SolverStatus.DualInfeasible: (SS_UNKNOWN, SS_INFEASIBLE, PS_UNBOUNDED),
}


class ClarabelSolver(Solver):  # type: ignore[misc]
    """Linear objectives over linear and semidefinite constraints, min cᵀx s.t. Gx + s = h, s ∈ cones."""

    SUPPORTED = Specification(
        objectives=[AffineExpression],
        variables=CONTINUOUS_VARTYPES,
        constraints=[AffineConstraint, LMIConstraint],
    )

    @classmethod
    def supports(cls, footprint: Any, explain: bool = False) -> Any:
        """Tell PICOS which problems need no reformulation."""
        supported, reason = Solver.supports(footprint, explain=True)
        if supported and footprint not in cls.SUPPORTED:
            supported, reason = False, cls.SUPPORTED.mismatch_reason(footprint)
        return (supported, reason) if explain else supported

    @classmethod
    def default_penalty(cls) -> float:
        """Rank among free solvers."""
        return 1.0

    @classmethod
    def test_availability(cls) -> None:
        """Clarabel is a dependency: always there."""

    @classmethod
    def names(cls) -> tuple[str, str, str, None]:
        """Names that PICOS shows."""
        return "clarabel", "Clarabel", "Clarabel interior-point solver", None

    @classmethod
    def is_free(cls) -> bool:
        """Apache-2.0."""
        return True

    def reset_problem(self) -> None:
        """Forget the problem."""
        self.int = None

    def _import_problem(self) -> None:
        offset, offsets = 0, {}
        for variable in self.ext.variables.values():
            offsets[variable] = offset
            offset += variable.dim
        self._offsets, self._size = offsets, offset
        rows, sides, cones, places = [], [], [], []
        for constraint in self._constraints():
            G, h = self._affine(constraint.smaller - constraint.greater)
            if isinstance(constraint, LMIConstraint):
                order = constraint.size[0]
                take, weight = _upper_triangle(order)
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

    def _constraints(self) -> list[Any]:
        bounds = [v.bound_constraint for v in self.ext.variables.values() if v.bound_constraint]
        return [*self.ext.constraints.values(), *bounds]

    def _affine(self, expression: Any) -> tuple[Any, Any]:
        """Return G (csr) and h with vec(expression) = G x + h."""
        G, h = expression.sparse_matrix_form(varOffsetMap=self._offsets, dense_b=True)
        entries = np.array(G.V).ravel(), (np.array(G.I).ravel(), np.array(G.J).ravel())
        return sparse.csr_matrix(entries, shape=(G.size[0], self._size)), np.array(h).ravel()


def _dual(constraint: Any, z: Any) -> Any:
    """Return what PICOS calls the dual: a matrix for a semidefinite constraint."""
    if not isinstance(constraint, LMIConstraint):
        return cvxopt.matrix(z if not constraint.is_equality() else -z)
    order = constraint.size[0]
    take, weight = _upper_triangle(order)
    Z = np.zeros(order * order)
    Z[take] = z / weight
    Z = Z.reshape(order, order)
    return cvxopt.matrix(Z + Z.T - np.diag(Z.diagonal()))


def _upper_triangle(order: int) -> tuple[Any, Any]:
    """Return the entries Clarabel wants of a symmetric matrix: column by column, off-diagonals times √2."""
    column, row = np.tril_indices(order)
    return column * order + row, np.where(row == column, 1.0, np.sqrt(2.0))
