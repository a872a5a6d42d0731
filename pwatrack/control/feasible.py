"""Whether an inequality has a solution, by the first proof that is found: for searches that ask this many times."""

from collections.abc import Sequence

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, different, stack
from pwatrack.control.candidates import Candidates
from pwatrack.control.convergence import first_certificate, near_polynomial
from pwatrack.control.task import Task
from pwatrack.lmi.exact import Proof, prove_exactly
from pwatrack.lmi.exact_polynomial import PolynomialProof, prove_polynomial
from pwatrack.lmi.infeasibility import seems_impossible
from pwatrack.lmi.polynomial import best_polynomial, degrees
from pwatrack.lmi.presolve import distinct
from pwatrack.lmi.role import Role


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # entries may be 1e300: what overflows proves nothing
def common_P(role: Role, M: Sequence[BallMatrix], *, sizes: Array | None = None) -> Proof | None:
    """Return an exact proof of M_i P + P M_iᵀ ≺ 0 for all cells, of any rate; None where none is found.

    Args:
        role: Which inequality it is.
        M: The matrices M_i.
        sizes: Of the states, as for `best_certificate`.

    Example:
        >>> from pwatrack.lmi.role import GENERATOR
        >>> M = BallMatrix.of([[-1.0, 1.0], [0.0, -2.0]])
        >>> common_P(GENERATOR, [M]).rate > 0, common_P(GENERATOR, [M, M - M])
        (True, None)
    """
    exact = different(M)
    found = first_certificate(stack(exact), sizes=sizes)
    return None if found is None else prove_exactly(role, exact, found.P, found.rate)


def polynomial(role: Role, M: Sequence[BallMatrix], *, most_rows: int) -> PolynomialProof | None:
    """Return an exact proof by a polynomial of the highest degree that is small enough; None where none is found.

    Args:
        role, M: As for `common_P`.
        most_rows: Of the program that is solved.

    Example: the zero dynamics of the example with k2 = 1.

        >>> from pwatrack.lmi.role import CONTROLLER
        >>> M = [BallMatrix.of([["0", "1"], [k, "-0.3"]]) for k in ("-1", "-2")]
        >>> polynomial(CONTROLLER, M, most_rows=250).degree
        10
    """
    exact = different(M)
    A = distinct(role.oriented(stack(exact)))[0]
    tried = degrees(A.shape[1], len(A), most_rows)
    if not tried or not np.linalg.eigvals(A).real.max() < 0:
        return None
    found = best_polynomial(A, tried[-1], near_polynomial(A), trials=1)
    return None if found is None else prove_polynomial(role, exact, found)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def some_gain(task: Task, rate: float) -> Array | None:
    """Return a gain K, or Lᵀ, that is proved exactly to reach a rate (1/s), of whatever size; None where none is found.

    Example: a double integrator has no largest rate, and one that is not controllable has.

        >>> A, B = np.array([[[0.0, 1.0], [0.0, 0.0]]]), np.array([[0.0], [1.0]])
        >>> some_gain(Task(A=A, B=B, cells=["all"]), 3.0).shape
        (1, 2)
        >>> some_gain(Task(A=-np.eye(2)[None], B=B, cells=["all"]), 3.0) is None
        True
    """
    candidates = Candidates.of(task)
    if seems_impossible(candidates.A, task.B, rate=rate):
        return None
    for candidate in candidates.largest_margins(rate):
        found = None if candidate.P is None else task.reached(candidate.K, candidate.P, rate)
        if found is not None:
            proof = prove_exactly(task.role, different(task.exactly_closed(candidate.K)), found.P, found.rate)
            if proof is not None and proof.rate >= rate:
                return candidate.K
    return None
