"""Theorem 1: convergence from the common Lyapunov inequality (7), with the best decay rate."""

import warnings
from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from pwatrack.arrays import Array
from pwatrack.errors import Infeasible, Problem, Subject, Undecided
from pwatrack.lmi.certificate import Certificate, prove, refutes
from pwatrack.lmi.exact import decimals, is_hurwitz
from pwatrack.lmi.inequality import Solver, lyapunov
from pwatrack.lmi.presolve import Scaling, distinct

_STEPS = 12  # at most so many bisections of the rate


def best_certificate(M: Array, *, solver: Solver = "clarabel") -> Certificate | None:
    """Return a proof of M_i P + P M_iᵀ ≺ 0 for all cells with the largest rate that bisection finds.

    Args:
        M: (l, n, n), with all eigenvalues in the open left half plane.
        solver: Which interior-point solver to ask.

    Returns:
        The certificate, or None if no P was found that proves anything.
    """
    from pwatrack.lmi.picos_model import largest_margin

    matrices, T, speed = _good_coordinates(M)
    best, trial, ceiling = None, 0.0, -float(np.linalg.eigvals(M).real.max())
    for _ in range(_STEPS):
        candidate = largest_margin(lyapunov(matrices, trial / speed), solver)
        found = None if candidate is None else prove(M, T @ candidate.P @ T.T)
        if found is None or found.rate < trial:
            ceiling = min(ceiling, trial)
        if found is not None and (best is None or found.rate > best.rate):
            best = found
        if best is None or ceiling - best.rate <= 1e-3 * ceiling:
            break
        trial = (best.rate + ceiling) / 2
    return best


def least_overshoot_certificate(M: Array, rate: float, *, solver: Solver = "clarabel") -> Certificate | None:
    """Return a proof of M_i P + P M_iᵀ + 2 rate P ⪯ 0 for all cells with the smallest λmax(P) / λmin(P).

    Its root is the overshoot: how many times its first size an error can reach on its way to 0.

    Args:
        M: (l, n, n), in the units in which errors are to be small.
        rate: In 1/s, below the best one.
        solver: Which interior-point solver to ask.

    Returns:
        The certificate, or None if no P was found that proves anything.

    Example: by itself each of the two turns any error towards 0 at once.

        >>> M = np.array([[[-1.0, 5.0], [-5.0, -1.0]], [[-1.0, 0.0], [0.0, -2.0]]])
        >>> float(np.linalg.cond(least_overshoot_certificate(M, 0.9).P).round(3))
        1.0
    """
    from pwatrack.lmi.picos_model import least_condition

    matrices, T, speed = _good_coordinates(M)
    inverse = np.linalg.inv(T)
    candidate = least_condition(lyapunov(matrices, rate / speed), inverse @ inverse.T, solver)
    return None if candidate is None else prove(M, T @ candidate.P @ T.T)


def _good_coordinates(M: Array) -> tuple[Array, Array, float]:
    """Return the different cells of M in z with x = T z and in the time t · speed, T (n, n), and the speed in 1/s."""
    scaling = Scaling.of(M, np.zeros((M.shape[1], 0)))
    matrices, _ = distinct(scaling.system(M))
    V = _lyapunov_coordinates(matrices.mean(axis=0))
    return np.linalg.solve(V, matrices @ V).astype(np.float64), scaling.d[:, None] * V, scaling.speed


def _lyapunov_coordinates(M: Array) -> Array:
    """Return V (n, n) such that in x = V z the mean cell has a Lyapunov matrix near I; I where it is not stable.

    A solver is most exact where its answer is near I, and the answer then depends less on the states chosen.
    """
    eye = np.eye(len(M))
    if np.linalg.eigvals(M).real.max() >= 0:
        return eye
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nearly singular: refused below by its eigenvalues
        P = solve_continuous_lyapunov(M, -eye)
    if not np.isfinite(P).all():
        return eye
    values, vectors = np.linalg.eigh((P + P.T) / 2)
    if not values[0] > 1e-14 * values[-1]:
        return eye
    return np.asarray(vectors * np.sqrt(values / values[-1]), dtype=np.float64)


def prove_convergence(
    M: Array,
    *,
    claim: str,
    cells: Sequence[str],
    subject: Subject = (),
    solver: Solver = "clarabel",
    hint: str = "every cell needs all its eigenvalues in the open left half plane",
) -> Certificate:
    """Prove M_i P + P M_iᵀ ≺ 0 for all cells, or say why not. With M_i = A_iᵀ this is (7).

    Args:
        M: (l, n, n).
        claim: What is to be proved, for messages: `"(17)"`.
        cells: Names of the l cells.
        subject: What in the description a refusal is about.
        solver: Which interior-point solver to ask.
        hint: What to do where a cell is unstable by itself.

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
    abscissa = np.linalg.eigvals(M).real.max(axis=1)
    figures = eigenvalue_text(abscissa, cells)
    unstable = [name for name, M_i, a in zip(cells, M, abscissa, strict=True) if not _hurwitz(M_i, float(a))]
    if unstable:
        names = ", ".join(f"'{name}'" for name in unstable)
        message = f"{claim} is infeasible: {names} not stable; {figures}"
        raise Infeasible(Problem(message=message, subject=subject, hint=hint))
    best = best_certificate(M, solver=solver)
    if best is not None:
        return best
    weight = _conflict(M, solver)
    if weight is None:
        raise Undecided(
            Problem(
                message=f"{claim} is undecided: found neither a common P nor a proof that none exists; {figures}",
                subject=subject,
                hint="the case is marginal or badly scaled: change the data a little to see which way it goes",
            )
        )
    guilty = ", ".join(f"'{name}'" for name, share in zip(cells, weight, strict=True) if share > 0.01)
    raise Infeasible(
        Problem(
            message=f"{claim} is infeasible: no common P exists for cells {guilty}, "
            f"though each is stable by itself; {figures}",
            subject=subject,
            hint="the cells differ too much for one quadratic Lyapunov function: bring them closer, or damp them more",
        )
    )


def _hurwitz(M: Array, abscissa: float) -> bool:
    """Decide exactly whether a matrix is stable, where its computed eigenvalues leave a doubt."""
    if abscissa < -1e-3 * float(np.linalg.norm(M)):
        return True
    return is_hurwitz(decimals(M))


def _conflict(M: Array, solver: Solver) -> Array | None:
    """Return the weight of each cell in a proof that no common P exists, or None if no such proof is found."""
    from pwatrack.lmi.picos_model import alternative

    matrices, place = distinct(Scaling.of(M, np.zeros((M.shape[1], 0))).system(M))
    Z = alternative(matrices, solver)
    weight = None if Z is None else refutes(matrices, Z)
    return None if weight is None else weight[place]


def eigenvalue_text(abscissa: Array, cells: Sequence[str]) -> str:
    """Say the largest real part of the eigenvalues of each cell.

    Example:
        >>> eigenvalue_text(np.array([1.752]), ["gap"])
        "largest real part of the eigenvalues: +1.752 in cell 'gap'"
    """
    parts = [f"{value:+.4g} in cell '{name}'" for name, value in zip(cells, abscissa, strict=True)]
    return "largest real part of the eigenvalues: " + ", ".join(parts)
