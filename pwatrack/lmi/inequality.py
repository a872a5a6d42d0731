"""The one kind of matrix inequality behind (7), (8), (9) and (17).

Find P = Pᵀ and Y such that for every cell i

    sym(L_i P R_i) + sym(M_i Y N_i) + C_i ⪯ 0,      sym(X) = X + Xᵀ.

An `Inequality` holds the coefficients and nothing else; solvers read it. All four of the paper are
M_i P + P M_iᵀ ≺ 0 in every cell, for M_i = A_i + B K in (8), and for the transposes of A_i in (7), of A_i + L C in (9)
and of A_ηi in (17): a `Role` says which of them something is about.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pwatrack.arrays import Array, symmetric_part
from pwatrack.ball_matrix import BallMatrix
from pwatrack.errors import ProblemPart

Solver = Literal["structured", "clarabel", "cvxopt"]


@dataclass(frozen=True, kw_only=True)
class Inequality:
    """Coefficients of sym(L_i P R_i) + sym(M_i Y N_i) + C_i ⪯ 0, one i per cell."""

    L: Array  # (l, N, n), for P (n, n)
    R: Array  # (l, n, N)
    M: Array  # (l, N, m), for Y (m, n); m = 0 where there is no Y
    N: Array  # (l, n, N)
    constant: Array  # C_i, (l, N, N), symmetric
    T: Array | None = None  # T_i, (l, N, N), symmetric, where a scalar t adds t T_i; see `program`

    @property
    def n(self) -> int:
        """Order of P."""
        return int(self.L.shape[2])

    @property
    def m(self) -> int:
        """Number of rows of Y."""
        return int(self.M.shape[2])

    def evaluate(self, P: Array, Y: Array) -> Array:
        """Return the left-hand sides, (l, N, N)."""
        return symmetric_part(self.L @ P @ self.R) + symmetric_part(self.M @ Y @ self.N) + self.constant

    def adjoint(self, Z: Array) -> tuple[Array, Array, float]:
        """Return G (n, n), H (m, n) and h with Σ tr Z_i F_i(P, Y, t) = tr G P + Σ H_jk Y_jk + h t + Σ tr Z_i C_i."""
        G = symmetric_part((self.R @ Z @ self.L).sum(axis=0))
        H = 2 * (self.N @ Z @ self.M).sum(axis=0).T
        return G, np.asarray(H), 0.0 if self.T is None else float((Z * self.T).sum())

    def margin(self, P: Array, Y: Array | None = None) -> float:
        """Return the largest t with left-hand sides ⪯ −t I and P ⪰ t I."""
        sides = self.evaluate(P, np.zeros((self.m, self.n)) if Y is None else Y)
        return float(min(-np.linalg.eigvalsh(sides).max(), np.linalg.eigvalsh(P)[0]))


def lyapunov(M: Array, rate: float = 0.0) -> Inequality:
    """M_i P + P M_iᵀ + 2 rate P ⪯ 0: (8) for given gains, and (7), (9), (17) with M_i transposed; rate in 1/s."""
    return state_feedback(M, np.zeros((M.shape[1], 0)), rate)


def state_feedback(A: Array, B: Array, rate: float = 0.0) -> Inequality:
    """A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ + 2 rate P ⪯ 0: eq. (8); eq. (9) is this for (A_iᵀ, Cᵀ), Y = 𝒳ᵀ; rate in 1/s."""
    cells, n = A.shape[:2]
    eye = np.broadcast_to(np.eye(n), (cells, n, n))
    return Inequality(
        L=A + rate * np.eye(n), R=eye, M=np.broadcast_to(B, (cells, *B.shape)), N=eye, constant=np.zeros((cells, n, n))
    )


def weighted(M: Array, W: Array) -> Inequality:
    """M_i P + P M_iᵀ + W ⪯ 0: P bounds the integral of a quadratic form (see `claims.cost`)."""
    return replace(lyapunov(M), constant=np.broadcast_to(W, M.shape))


def quadratic_cost(A: Array, B: Array, Q_root: Array, R: Array) -> Inequality:
    """Return (8) with a cost, [A_i P + P A_iᵀ − B R⁻¹ Bᵀ, P Q^½; ·, −I] ⪯ 0, for the gain K = −R⁻¹ Bᵀ P⁻¹.

    Under u = K x it bounds ∫(xᵀQx + uᵀRu) dt by x(0)ᵀ P⁻¹ x(0), whatever the switching (Boyd et al., Linear Matrix
    Inequalities in System and Control Theory, 1994, section 7.4). No other gain does better with this P: in
    the inequality K stands as (K + R⁻¹BᵀP⁻¹)ᵀ R (K + R⁻¹BᵀP⁻¹) ⪰ 0, the same for all cells.
    """
    cells, n = A.shape[:2]
    L, N, constant = np.zeros((cells, 2 * n, n)), np.zeros((cells, n, 2 * n)), np.zeros((cells, 2 * n, 2 * n))
    L[:, :n], L[:, n:] = A, Q_root
    N[:, :, :n] = np.eye(n)
    constant[:, :n, :n] = -B @ np.linalg.solve(R, B.T)
    constant[:, n:, n:] = -np.eye(n)
    return Inequality(L=L, R=N, M=np.zeros((cells, 2 * n, 0)), N=N, constant=constant)


@dataclass(frozen=True, kw_only=True)
class Role:
    """What is proved to converge."""

    name: str  # "controller", "observer", "generator" or "plant", as in the files that a run writes
    claim: str  # its inequality, `"(8)"`
    part: ProblemPart  # what a refusal of it is about
    letter: str = ""  # the gain that it has, "K" or "L"; empty where it has none
    transposed: bool = True  # whether M_i is the transpose of what changes errors: P, not P⁻¹, is their norm

    def oriented(self, X: Array) -> Array:
        """Return M_i of the matrix by which errors change, or the other way round; the gain of (8) of K or L too."""
        return X.swapaxes(-1, -2) if self.transposed else X

    def exact(self, X: BallMatrix) -> BallMatrix:
        """Do the same with an exact matrix."""
        return X.transpose() if self.transposed else X


PLANT = Role(name="plant", claim="(7)", part=ProblemPart.PLANT)
CONTROLLER = Role(name="controller", claim="(8)", part=ProblemPart.CONTROLLER, letter="K", transposed=False)
OBSERVER = Role(name="observer", claim="(9)", part=ProblemPart.OBSERVER, letter="L")
GENERATOR = Role(name="generator", claim="(17)", part=ProblemPart.CELLS)
