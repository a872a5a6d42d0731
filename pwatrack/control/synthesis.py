"""Theorem 2: controller gain K from (8), observer gain L from (9), each with its proof."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_continuous_are, solve_continuous_lyapunov

from pwatrack.arrays import Array, complex_text, readonly
from pwatrack.control.convergence import best_certificate, prove_convergence
from pwatrack.errors import Infeasible, Problem, Subject, Undecided
from pwatrack.lmi.certificate import Certificate
from pwatrack.lmi.exact import decimals, is_hurwitz, unreachable_part
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
    which make a gentler gain. So no weight has to be chosen. (States that do not act on
    each other both ways, as in a chain of integrators, have no balanced units: there the
    weights are one in the units given.)

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
        Infeasible: If a mode that does not decay is out of reach.
        Undecided: If no gain with a proof is found otherwise.

    Example: a double integrator.

        >>> A, B = np.array([[[0.0, 1.0], [0.0, 0.0]]]), np.array([[0.0], [1.0]])
        >>> K, certificate = stabilising_gain(A, B, claim="(8)", cells=["all"])
        >>> K.round(3).tolist(), certificate.rate > 0.8
        ([[-1.0, -1.732]], True)
    """
    from pwatrack.lmi.picos_model import least_cost

    scaling = Scaling.of(A, B)
    matrices, _ = distinct(scaling.system(A))
    B_scaled = scaling.input(B)
    mean, R_root = matrices.mean(axis=0), np.eye(B.shape[1])
    for Q in _state_weights(mean, B_scaled):
        W, W_inverse = _riccati_coordinates(mean, B_scaled, Q)
        Q_root = cholesky(Q) @ W_inverse
        inequality = quadratic_cost(W @ matrices @ W_inverse, W @ B_scaled, Q_root, R_root)
        candidate = least_cost(inequality, solver)
        if candidate is None or np.linalg.cond(candidate.P) > 1 / np.finfo(np.float64).eps:
            continue
        K = _short(scaling.gain(np.linalg.solve(candidate.P, candidate.Y.T).T.astype(np.float64) @ W))
        closed = A + B @ K
        stable = np.isfinite(closed).all() and np.linalg.eigvals(closed).real.max() < 0
        certificate = best_certificate(closed, solver=solver) if stable else None
        if certificate is not None:
            return K, certificate
    _refuse_unreachable(A, B, claim, cells, subject)
    raise Undecided(
        Problem(
            message=f"{claim} is undecided: no gain with a proof was found, and no proof that there is none",
            subject=subject,
            hint="another actuator or measured output may help, or the other solver: --solver cvxopt",
        )
    )


def _state_weights(A: Array, B: Array) -> Iterator[Array]:
    """Yield the weights Q of the quadratic cost, in the order in which they are tried.

    First multiples of I. Then multiples of the inverse of the controllability
    Gramian of the damped mean cell, which do not depend on the choice of states:
    x' Q x is the effort it takes to get to x.
    """
    eye = np.eye(len(A))
    yield from (weight * eye for weight in _STATE_WEIGHTS)
    damping = 2.0 * max(float(np.abs(np.linalg.eigvals(A)).max()), 1e-2)
    gramian = solve_continuous_lyapunov(A - damping * eye, -B @ B.T)
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    if values[-1] > 0:
        inverse = (vectors / np.maximum(values, 1e-12 * values[-1])) @ vectors.T
        yield from (weight * damping * (inverse + inverse.T) / 2 for weight in _STATE_WEIGHTS)


def _riccati_coordinates(A: Array, B: Array, Q: Array) -> tuple[Array, Array]:
    """Return W (n, n) and its inverse such that in z = W x the cost of the mean cell's LQR is |z|².

    There the optimal P of (8) is near I, which is where a solver is most exact.
    """
    try:
        X = solve_continuous_are(A, B, Q, np.eye(B.shape[1]))
        W = cholesky((X + X.T) / 2)
        return W, np.asarray(np.linalg.inv(W), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError):
        return np.eye(len(A)), np.eye(len(A))


def _refuse_unreachable(A: Array, B: Array, claim: str, cells: Sequence[str], subject: Subject) -> None:
    """Refuse cells with a mode that does not decay and that B cannot reach, which is decided exactly."""
    found = []
    for name, A_i in zip(cells, A, strict=True):
        stuck = unreachable_part(decimals(A_i), decimals(B))
        if stuck and not is_hurwitz(stuck):
            values = np.linalg.eigvals(np.array([[float(v) for v in row] for row in stuck]))
            found.append(f"{complex_text(values[np.argmax(values.real)])} in cell '{name}'")
    if found:
        raise Infeasible(
            Problem(
                message=f"{claim} is infeasible: no gain moves the eigenvalue " + ", ".join(found),
                subject=subject,
                hint="another actuator, or another measured output, must reach this mode",
            )
        )


def _short(K: Array) -> Array:
    """Return the gain with nine significant digits: what is printed is what is proved and used."""
    return np.array([[float(f"{v:.8e}") for v in row] for row in K])
