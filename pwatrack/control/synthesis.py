"""Theorem 2: controller gain K from (8), observer gain L from (9), each with its proof."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array, readonly
from pwatrack.control.convergence import best_certificate, prove_convergence
from pwatrack.errors import Problem, Subject, Undecided
from pwatrack.lmi.certificate import Certificate
from pwatrack.lmi.inequality import Solver, quadratic_cost
from pwatrack.lmi.presolve import Scaling, distinct
from pwatrack.model.pwa import PWASystem

_STATE_WEIGHTS = (1.0, 1e-2, 1e-4, 1e-6)


@dataclass(frozen=True, kw_only=True)
class Design:
    """The gains of Theorem 2.

    Attributes:
        K: Controller gain (m, n): u = K (x̂ − x_d) + u_ff.
        L: Observer gain (n, q): + L (ŷ − y).
        controller: Proof that sym((A_i + B K) P_c) ≺ 0 for all cells: (8).
        observer: Proof that sym((A_i + L C)ᵀ P_o) ≺ 0 for all cells: (9).
    """

    K: Array
    L: Array
    controller: Certificate
    observer: Certificate


def synthesize(
    plant: PWASystem, *, K: Array | None = None, L: Array | None = None, solver: Solver = "clarabel"
) -> Design:
    """Find K and L by Theorem 2, or prove the ones that are given.

    Args:
        plant: The system (1).
        K, L: Given gains, (m, n) and (n, q), in the sign convention of (10).
        solver: Which interior-point solver to ask.

    Raises:
        Infeasible: If (8) or (9) is proved to have no solution, or a given gain to be none.
        Undecided: If neither is proved.
    """
    A_transposed = np.swapaxes(plant.A, 1, 2)
    K, controller = _gain(plant, plant.A, plant.B, K, ("(8)", "controller", "K", "B"), solver)
    L_transposed, observer = _gain(
        plant, A_transposed, plant.C.T, None if L is None else L.T, ("(9)", "observer", "L", "C"), solver
    )
    return Design(K=readonly(K), L=readonly(L_transposed.T), controller=controller, observer=observer)


def _gain(
    plant: PWASystem, A: Array, B: Array, given: Array | None, words: tuple[str, str, str, str], solver: Solver
) -> tuple[Array, Certificate]:
    """Return a gain for (8), found or given, with its proof; (9) is (8) transposed."""
    claim, part, letter, matrix = words
    if given is None:
        return stabilising_gain(A, B, claim=claim, cells=plant.cell_names, subject=("system", matrix), solver=solver)
    certificate = prove_convergence(
        A + B @ given,
        claim=f"{claim} for the given gain {letter}",
        cells=plant.cell_names,
        subject=("design", part, letter),
        solver=solver,
        hint=f"mind the signs: u = K (x̂ − x_d) + u_ff, + L (ŷ − y); or leave {letter} out to have it designed",
    )
    return given, certificate


def stabilising_gain(
    A: Array,
    B: Array,
    *,
    claim: str,
    cells: Sequence[str],
    subject: Subject = (),
    solver: Solver = "clarabel",
) -> tuple[Array, Certificate]:
    """Return the gain K = Y P⁻¹ of (8) that minimises a quadratic cost, with the proof of its best rate.

    The weights are those of balanced units: states scaled to balance A, inputs
    and time scaled so that A and B have size 1. There the weights on states and
    inputs are one; if no proof is found for that gain, cheaper states are tried,
    which make a gentler gain. So no weight has to be chosen.

    Args:
        A: (l, n, n).
        B: (n, m).
        claim: What is to be solved, for messages: `"(8)"`.
        cells: Names of the l cells.
        subject: What in the description a refusal is about.
        solver: Which interior-point solver to ask.

    Returns:
        K (m, n) and its certificate.

    Raises:
        Undecided: If no gain with a proof is found.

    Example: a double integrator.

        >>> A, B = np.array([[[0.0, 1.0], [0.0, 0.0]]]), np.array([[0.0], [1.0]])
        >>> K, certificate = stabilising_gain(A, B, claim="(8)", cells=["all"])
        >>> K.round(4).tolist(), certificate.rate > 0.8
        ([[-1.0, -1.7321]], True)
    """
    from pwatrack.lmi.picos_model import least_cost

    scaling = Scaling.of(A, B)
    matrices, _ = distinct(scaling.system(A))
    B_scaled = scaling.input(B)
    for weight in _STATE_WEIGHTS:
        Q_root, R_root = np.sqrt(weight) * np.eye(A.shape[1]), np.eye(B.shape[1])
        candidate = least_cost(quadratic_cost(matrices, B_scaled, Q_root, R_root), solver)
        if candidate is None or np.linalg.cond(candidate.P) > 1 / np.finfo(np.float64).eps:
            continue
        K = scaling.gain(np.linalg.solve(candidate.P, candidate.Y.T).T.astype(np.float64))
        closed = A + B @ K
        stable = np.isfinite(closed).all() and np.linalg.eigvals(closed).real.max() < 0
        certificate = best_certificate(closed, solver=solver) if stable else None
        if certificate is not None:
            return K, certificate
    raise Undecided(
        Problem(
            message=f"{claim} is undecided: no gain with a proof was found{_uncontrollable(A, B, cells)}",
            subject=subject,
            hint="the plant may need another actuator, or another measured output",
        )
    )


def _uncontrollable(A: Array, B: Array, cells: Sequence[str]) -> str:
    """Name the modes that B cannot reach and that do not decay: the rank test of Popov, Belevitch, Hautus."""
    found = []
    for name, A_i in zip(cells, A, strict=True):
        size = np.linalg.norm(A_i, 2)
        for value in np.linalg.eigvals(A_i):
            pencil = np.hstack([A_i - value * np.eye(len(A_i)), B])
            if value.imag >= 0 and value.real > -1e-9 * size and np.linalg.svd(pencil)[1][-1] < 1e-9 * size:
                found.append(f"{value:.4g} in cell '{name}'")
    return "; out of its reach, within rounding: eigenvalue " + ", ".join(found) if found else ""
