"""(17±) refuted: exact proof that no P of any sign has M_i P + P M_iᵀ ≺ 0 in all cells.

Of two kinds.

- *Multipliers.* With Z_i ⪰ 0, not all 0, and Σ (Z_i M_i + M_iᵀ Z_i) = 0 the traces of Z_i (M_i P + P M_iᵀ) add up to 0,
  where a P would make the sum negative (the theorem of alternatives). One Z of one cell with a mode on the imaginary
  axis is such a proof.
- *Numbers.* Where M P + P Mᵀ ≺ 0, no eigenvalue of M is on the imaginary axis and as many are to the left of it as P
  has positive ones (Ostrowski and Schneider, 1962). So two cells with such a P each, but with different numbers of
  positive eigenvalues, have none in common.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.dichotomy import Dichotomy, prove_dichotomy
from pwatrack.lmi.multipliers import conflict, whole
from pwatrack.lmi.presolve import corners
from pwatrack.lmi.role import Role
from pwatrack.lmi.uncontrollable import symmetric_part_of_spectrum
from pwatrack.rational import floats, on_rows, positive_eigenvalues


@dataclass(frozen=True, kw_only=True)
class NoDichotomy:
    """Proof that no P = Pᵀ has M_i P + P M_iᵀ ≺ 0 in all cells, for the middles of balls.

    Attributes:
        Z: Whole-number multipliers by cell; cells that are not named have Z_i = 0. Empty where numbers differ.
        P: Of two cells with different numbers of unstable modes a P each; empty where there are multipliers.
        unstable: How many unstable modes these two have.
    """

    Z: Mapping[int, tuple[tuple[int, ...], ...]]
    P: Mapping[int, Dichotomy]
    unstable: Mapping[int, int]


def refute_dichotomy(role: Role, M: Sequence[BallMatrix]) -> NoDichotomy | None:
    """Prove that no P of any sign has M_i P + P M_iᵀ ≺ 0 for all cells, or return None.

    Args:
        M: The matrices M_i of it; those in the middle of their balls are what is proved of.

    Example: one cell has a mode that grows, the other has none.

        >>> from pwatrack.lmi.role import GENERATOR
        >>> found = refute_dichotomy(GENERATOR, [BallMatrix.of([[a]]) for a in (-1, 1)])
        >>> dict(found.unstable)
        {0: 0, 1: 1}
    """
    middles = [BallMatrix(M_i.centre) for M_i in M]
    near = np.array([M_i.floats for M_i in M])
    numbers = _numbers(role, middles, near)
    if numbers is not None:
        return numbers
    for i, M_i in enumerate(middles):
        N = symmetric_part_of_spectrum(M_i.centre)
        if N.nrows():
            rest = on_rows(M_i.centre, N)
            found = conflict(floats(rest)[None], None, [rest], None)
            if found is not None:
                return NoDichotomy(Z=whole({i: N.transpose() * found[0] * N}), P={}, unstable={})
    at = corners(near).tolist()
    found = conflict(near[at], None, [middles[i].centre for i in at], None) if len(at) > 1 else None
    return None if found is None else NoDichotomy(Z=whole({at[i]: Z for i, Z in found.items()}), P={}, unstable={})


def _numbers(role: Role, M: Sequence[BallMatrix], near: Array) -> NoDichotomy | None:
    """Return two cells with different numbers of unstable modes, those that differ most, with their proofs."""
    unstable = (np.linalg.eigvals(near).real > 0).sum(axis=1)
    few, many = int(unstable.argmin()), int(unstable.argmax())
    if unstable[few] == unstable[many]:
        return None
    P = {i: prove_dichotomy(role, [M[i]]) for i in (few, many)}
    proved = {i: proof for i, proof in P.items() if proof is not None}
    counts = {i: near.shape[1] - positive_eigenvalues(proof.P) for i, proof in proved.items()}
    if len(counts) < 2 or counts[few] == counts[many]:
        return None
    return NoDichotomy(Z={}, P=proved, unstable=counts)
