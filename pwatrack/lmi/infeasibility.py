"""Exact proof that no gain exists: of a cell, or mean of cells, whose mode no gain moves, or of cells that conflict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space, orth

from pwatrack.arrays import Array
from pwatrack.lmi.between import Between, seems_stuck_between, stuck_between
from pwatrack.lmi.conflict import conflict, sought
from pwatrack.lmi.coordinates import Coordinates
from pwatrack.lmi.multipliers import whole
from pwatrack.lmi.no_dichotomy import NoDichotomy
from pwatrack.lmi.presolve import corners
from pwatrack.lmi.role import Role
from pwatrack.lmi.stuck import stuck_modes
from pwatrack.rational import (
    Rational,
    decimals,
    identity,
)

_HINT = 0.9  # gap at which the least violation is known to be above 0


@dataclass(frozen=True, kw_only=True)
class Refutation:
    """Proof that an inequality has no solution.

    Attributes:
        Z: Whole-number multipliers by cell; cells that are not named have Z_i = 0. Empty where there is another proof:
        between: a mean of cells whose mode no gain moves.
        eigenvalues: Of each cell that no gain stabilises by itself, the eigenvalue that stays; empty where
            only the cells together have no solution.
    """

    Z: Mapping[int, tuple[tuple[int, ...], ...]]
    eigenvalues: Mapping[int, complex]
    between: Between | None = None


@dataclass(frozen=True, kw_only=True)
class Impossibility:
    """What a refusal proves: the evidence of `Infeasible`.

    Attributes:
        role: Which inequality has no solution.
        rate: Decay rate that is out of reach, in 1/s.
        refutation: The proof; that no P of any sign does either, where that was asked.
    """

    role: Role
    rate: float
    refutation: Refutation | NoDichotomy

    @property
    def claim(self) -> str:
        """The inequality, `"(8)"`."""
        return "(17±)" if isinstance(self.refutation, NoDichotomy) else self.role.claim


def refute(
    A: Array,
    B: Array,
    *,
    rate: float = 0.0,
    exact: tuple[Sequence[Rational], Rational] | None = None,
) -> Refutation | None:
    """Prove that no P ≻ 0, Y have A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ + 2 rate P ≺ 0 for all cells, or return None.

    Args:
        A: (l, n, n).
        B: (n, m); m = 0 where the gain is given.
        rate: In 1/s, exactly as printed.
        exact: The matrices A_i and B that the proof is about, where they are not the decimals that A and B print as.

    Example: an integrator cannot be stabilised from nowhere.

        >>> found = refute(np.array([[[0.0]]]), np.zeros((1, 0)))
        >>> found.Z[0], found.eigenvalues
        (((1,),), {0: 0j})
    """
    shift = decimals(np.array([[rate]]))[0, 0] * identity(A.shape[1])
    numbers, exact_B = ([decimals(A_i) for A_i in A], decimals(B)) if exact is None else exact
    exact_A = [A_i + shift for A_i in numbers]
    Z, eigenvalues = stuck_modes(exact_A, exact_B)
    if Z:
        return Refutation(Z=whole(Z), eigenvalues=eigenvalues)
    at = corners(A).tolist()
    mean = stuck_between(A[at] + rate * np.eye(A.shape[1]), B, [exact_A[i] for i in at], exact_B)
    if mean is not None:
        return Refutation(Z={}, eigenvalues={}, between=mean.of(at))
    found = conflict(A[at] + rate * np.eye(A.shape[1]), B, [exact_A[i] for i in at], exact_B)
    if found is None:
        return None
    return Refutation(Z=whole({at[i]: Z_i for i, Z_i in found.items()}), eigenvalues={})


def seems_impossible(A: Array, B: Array, *, rate: float = 0.0) -> bool:
    """Say whether a mean of cells, or floating-point multipliers, speak against a solution: a hint, and a quick one.

    Args:
        A, B, rate: As for `refute`.

    Example:
        >>> unstable = np.array([[[0.1]]])
        >>> seems_impossible(unstable, np.zeros((1, 0))), seems_impossible(-unstable, np.zeros((1, 0)))
        (True, False)
    """
    at = Coordinates.balanced(A, B)
    seen = null_space(at.input(B).T)
    if not seen.shape[1]:
        return False
    if seems_stuck_between(A + rate * np.eye(A.shape[1]), B):
        return True
    scaled = at.system(A + rate * np.eye(A.shape[1]))
    return sought(scaled, [seen] * len(A), orth(at.input(B)), gap=_HINT) is not None
