"""Theorem 1: convergence from the common Lyapunov inequality (7), with the best decay rate."""

from collections.abc import Sequence

import numpy as np

from pwatrack.arrays import Array
from pwatrack.errors import Infeasible, Problem, Subject, Undecided
from pwatrack.lmi.certificate import Certificate, prove, refutes
from pwatrack.lmi.inequality import Solver, lyapunov
from pwatrack.lmi.presolve import Scaling, distinct

_STEPS = 12  # at most so many bisections of the rate


def prove_convergence(
    M: Array, *, claim: str, cells: Sequence[str], subject: Subject = (), solver: Solver = "clarabel"
) -> Certificate:
    """Prove M_i P + P M_iᵀ ≺ 0 for all cells, with the largest decay rate that bisection finds.

    With M_i = A_iᵀ this is (7).

    Args:
        M: (l, n, n).
        claim: What is to be proved, for messages: `"(17)"`.
        cells: Names of the l cells.
        subject: What in the description a refusal is about.
        solver: Which interior-point solver to ask.

    Raises:
        Infeasible: If it is proved that no P exists.
        Undecided: If neither is proved.

    Example:
        >>> M = np.array([[[-1.0, 0.0], [1.0, -2.0]], [[-1.0, 0.0], [0.5, -2.0]]])
        >>> 0.9 < prove_convergence(M, claim="(7)", cells=("a", "b")).rate < 1.0
        True
    """
    if not M.shape[1]:
        return Certificate(M=M, P=np.zeros((0, 0)), rate=np.inf, margin=np.inf)
    from pwatrack.lmi.picos_model import alternative, largest_margin

    abscissa = np.linalg.eigvals(M).real.max(axis=1)
    refuse_unstable(M, abscissa, claim, cells, subject)
    scaling = Scaling.of(M, np.zeros((M.shape[1], 0)))
    matrices, place = distinct(scaling.system(M))
    best, trial, ceiling = None, 0.0, -float(abscissa.max())
    for _ in range(_STEPS):
        candidate = largest_margin(lyapunov(matrices, trial / scaling.speed), solver)
        found = None if candidate is None else prove(M, scaling.matrix(candidate.P))
        if found is None or found.rate < trial:
            ceiling = min(ceiling, trial)
        if found is not None and (best is None or found.rate > best.rate):
            best = found
        if best is None or ceiling - best.rate <= 1e-3 * ceiling:
            break
        trial = (best.rate + ceiling) / 2
    if best is not None:
        return best
    Z = alternative(matrices, solver)
    weight = None if Z is None else refutes(matrices, Z)
    figures = eigenvalue_text(abscissa, cells)
    if weight is None:
        raise Undecided(
            Problem(
                message=f"{claim} is undecided: found neither a common P nor a proof that none exists; {figures}",
                subject=subject,
                hint="the case is marginal or badly scaled: change the data a little to see which way it goes",
            )
        )
    guilty = ", ".join(f"'{name}'" for name, k in zip(cells, place, strict=True) if weight[k] > 0.01)
    raise Infeasible(
        Problem(
            message=f"{claim} is infeasible: no common P exists for cells {guilty}, "
            f"though each is stable by itself; {figures}",
            subject=subject,
            hint="the cells differ too much for one quadratic Lyapunov function; more damping would help",
        )
    )


def refuse_unstable(M: Array, abscissa: Array, claim: str, cells: Sequence[str], subject: Subject) -> None:
    """Refuse matrices that surely have an eigenvalue in the right half plane.

    Raises:
        Infeasible: With the figure for each cell.
    """
    error = 1e3 * np.finfo(np.float64).eps * np.linalg.norm(M, axis=(1, 2))
    if (abscissa > error).any():
        raise Infeasible(
            Problem(
                message=f"{claim} is infeasible: {eigenvalue_text(abscissa, cells)}",
                subject=subject,
                hint="every cell needs all its eigenvalues in the open left half plane",
            )
        )


def eigenvalue_text(abscissa: Array, cells: Sequence[str]) -> str:
    """Say the largest real part of the eigenvalues of each cell.

    Example:
        >>> eigenvalue_text(np.array([1.752]), ["gap"])
        "largest real part of the eigenvalues: +1.752 in cell 'gap'"
    """
    parts = [f"{value:+.4g} in cell '{name}'" for name, value in zip(cells, abscissa, strict=True)]
    return "largest real part of the eigenvalues: " + ", ".join(parts)
