"""The largest margin of inequalities that are linear in some symmetric matrices, each in few of them."""

from collections.abc import Mapping

import clarabel
import numpy as np

from pwatrack.arrays import Array
from pwatrack.lmi.chain_map import Bound, ChainMap, Term
from pwatrack.lmi.cone_program import minimise, sparsely, symmetric_of, upper
from pwatrack.lmi.primal_dual import least

_GAP = 1e-2  # share of the margin that may be missed
SMALL = 5  # order up to which Clarabel is quicker than our own method


class MarginProgram:
    """max t with Σ_k (L_jk P_k R_jk + R_jkᵀ P_k L_jkᵀ) + t T_j ⪯ 0 for all j, P_0 of mean eigenvalue 1.

    Example: −P_0 + t I ⪯ 0.

        >>> program = MarginProgram(2, 1)
        >>> program.add({0: program.less}, np.eye(2))
        >>> _, t = program.solved()
        >>> 0.98 < t < 1.01
        True
    """

    def __init__(self, n: int, count: int) -> None:
        self.n, self.count, self.size = n, count, n * (n + 1) // 2
        self.basis = symmetric_of(np.eye(self.size), n)  # of size 1 each
        self.less, self.more = (-np.eye(n) / 2, np.eye(n)), (np.eye(n) / 2, np.eye(n))  # −P and P
        self.bounds: list[Bound] = []

    def image(self, L: Array, R: Array) -> Array:
        """Return the matrix of P ↦ L P R + Rᵀ P Lᵀ."""
        half = L @ self.basis @ R
        return upper(half + half.transpose(0, 2, 1)).T

    def add(self, terms: Mapping[int, Term], T: Array) -> None:
        """Ask for Σ (L_k P_k R_k + R_kᵀ P_k L_kᵀ) + t T ⪯ 0, with L and R of each k."""
        self.bounds.append(Bound(terms, T))

    def solved(self) -> tuple[Array, float] | None:
        """Return P, (count, n, n), and t > 0, or None."""
        found = self._by_cones() if self.n <= SMALL else self._by_form()
        return None if found is None or not found[1] > 0 or not np.isfinite(found[0]).all() else found

    def _by_form(self) -> tuple[Array, float] | None:
        chain = ChainMap(self.bounds, self.count)
        v = least(chain, gap=_GAP)
        return None if v is None else (chain.matrices(v), float(v[-1]))

    def _by_cones(self) -> tuple[Array, float] | None:
        """Ask Clarabel, in its form: P_0, P_1, … as `upper` has them, then t."""
        size, width = self.size, self.count * self.size
        unit = upper(np.eye(self.n))
        images = [
            {k: self.image(*term) for k, term in bound.terms.items()} | {self.count: upper(bound.T)[:, None]}
            for bound in self.bounds
        ]
        images.append({0: np.outer(unit, unit) / self.n})  # the mean eigenvalue of P_0, at most 1
        G = sparsely(images, size, width + 1)
        cones = [clarabel.PSDTriangleConeT(self.n)] * len(images)
        cost, sides = np.append(np.zeros(width), -1.0), np.append(np.zeros(len(self.bounds) * size), unit)
        try:
            x = np.array(minimise(cost, G, sides, cones, _GAP).x)
        except ArithmeticError:
            return None
        return np.tensordot(x[:-1].reshape(self.count, size), self.basis, 1), float(x[-1])
