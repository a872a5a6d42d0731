"""Exact proof that no gain exists: of a cell, or mean of cells, whose mode no gain moves, or of cells that conflict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space, orth

from pwatrack.arrays import Array
from pwatrack.lmi.dichotomy import NoDichotomy
from pwatrack.lmi.inequality import Role
from pwatrack.lmi.multipliers import conflict, sought, whole
from pwatrack.lmi.presolve import Coordinates, corners
from pwatrack.lmi.uncontrollable import Between, seems_uncontrollable, uncontrollable_mean, uncontrollable_modes
from pwatrack.rational import Rational, decimals, identity, scalar

_HINT = 0.9  # gap at which the least violation is known to be above 0


@dataclass(frozen=True, kw_only=True)
class Refutation:
    """Proof that an inequality has no solution."""

    Z: Mapping[int, tuple[tuple[int, ...], ...]]  # whole-number multipliers by cell, else 0; or empty
    eigenvalues: Mapping[int, complex]  # what stays in each cell that no gain stabilises by itself, if any
    between: Between | None = None  # such a one: a mean of cells whose mode no gain moves


@dataclass(frozen=True, kw_only=True)
class Impossibility:
    """What a refusal proves: the evidence of `Infeasible`."""

    role: Role  # which inequality has no solution
    rate: float  # decay rate that is out of reach, in 1/s
    refutation: Refutation | NoDichotomy  # the proof; that no P of any sign does either, where that was asked

    @property
    def claim(self) -> str:
        """The inequality, `"(8)"`."""
        return "(17±)" if isinstance(self.refutation, NoDichotomy) else self.role.claim


Exact = tuple[Sequence[Rational], Rational]  # A_i and B


def refute(A: Array, B: Array, *, rate: float = 0.0, exact: Exact | None = None) -> Refutation | None:
    """Prove that no P ≻ 0, Y have A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ + 2 rate P ≺ 0 for all cells, or return None.

    B (n, m) has m = 0 where the gain is given. The rate (1/s) counts exactly as printed, and so do A and B where the
    exact matrices that the proof is about are not given.
    """
    found = refute_by_modes(A, B, range(len(A)), rate=rate, exact=exact)
    if found is not None:
        return found
    at = corners(A).tolist()
    exact_A, exact_B = _shifted(A[at], B, rate, exact and ([exact[0][i] for i in at], exact[1]))
    Z = conflict(A[at] + rate * np.eye(A.shape[1]), B, exact_A, exact_B)
    return None if Z is None else Refutation(Z=whole({at[i]: Z_i for i, Z_i in Z.items()}), eigenvalues={})


def refute_by_modes(
    A: Array, B: Array, cells: Sequence[int], *, rate: float = 0.0, exact: Exact | None = None
) -> Refutation | None:
    """Prove the same by a mode of one of these cells, or of a mean of any, that no gain moves; or return None."""
    exact_A, exact_B = _shifted(A, B, rate, exact)
    Z, eigenvalues = uncontrollable_modes([exact_A[i] for i in cells], exact_B)
    if Z:
        named = {cells[i]: value for i, value in eigenvalues.items()}
        return Refutation(Z=whole({cells[i]: Z_i for i, Z_i in Z.items()}), eigenvalues=named)
    at = corners(A).tolist()
    mean = uncontrollable_mean(A[at] + rate * np.eye(A.shape[1]), B, [exact_A[i] for i in at], exact_B)
    if mean is None:
        return None
    between = replace(mean, weights={at[i]: share for i, share in mean.weights.items()})
    return Refutation(Z={}, eigenvalues={}, between=between)


def _shifted(A: Array, B: Array, rate: float, exact: Exact | None) -> tuple[list[Rational], Rational]:
    numbers, exact_B = exact or ([decimals(A_i) for A_i in A], decimals(B))
    return [A_i + scalar(rate) * identity(A.shape[1]) for A_i in numbers], exact_B


def seems_impossible(A: Array, B: Array, *, rate: float = 0.0) -> bool:
    """Say whether a mean of cells, or floating-point multipliers, speak against a solution: a hint, and a quick one."""
    at = Coordinates.balanced(A, B)
    seen = null_space(at.input(B).T)
    if not seen.shape[1]:
        return False
    shifted = A + rate * np.eye(A.shape[1])
    if seems_uncontrollable(shifted, B):
        return True
    return sought(at.system(shifted), [seen] * len(A), orth(at.input(B)), gap=_HINT) is not None
