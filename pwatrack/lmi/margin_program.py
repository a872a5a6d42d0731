"""The largest margin of inequalities that are linear in some symmetric matrices, each in few of them."""

import clarabel
import numpy as np
from scipy import sparse

from pwatrack.arrays import Array, IntArray
from pwatrack.lmi.cone_program import minimise
from pwatrack.lmi.dense_map import StackMap
from pwatrack.lmi.primal_dual import least

_GAP = 1e-2  # share of the margin that may be missed
DENSE = (
    2e6,
    3e8,
    2e9,
)  # products in a step of the method that sees one matrix: between the first two it is quicker than
# Clarabel, up to the last it is asked where Clarabel is not sure


class MarginProgram:
    """max t with side_j − Σ A_jk (P_k) − t W_j ⪰ 0, in Clarabel's form: svec of P_0, P_1, …, then t."""

    def __init__(self, n: int, count: int) -> None:
        column, row = np.tril_indices(n)
        self.n, self.count, self.size = n, count, len(row)
        self.places, self.scale = (column, row), np.where(row == column, 1.0, np.sqrt(2.0))
        self.basis = np.zeros((self.size, n, n))  # of size 1 each
        at = np.arange(self.size)
        self.basis[at, row, column] = self.basis[at, column, row] = 1 / self.scale
        self.eye = np.eye(self.size)
        unit = self.svec(np.eye(n))
        self.trace = np.outer(unit, unit) / n  # of P ↦ tr(P) / n I
        self.blocks: list[tuple[dict[int, Array], Array, Array]] = []

    def svec(self, X: Array) -> Array:
        """Return upper triangles by columns, what is off the diagonal times √2, (…, size)."""
        return np.asarray(X[..., self.places[0], self.places[1]] * self.scale)

    def congruence(self, J: Array) -> Array:
        """Return the matrix of P ↦ Jᵀ P J."""
        return self.svec(J.T @ self.basis @ J).T

    def lyapunov(self, F: Array) -> Array:
        """Return the matrix of P ↦ Fᵀ P + P F."""
        product = self.basis @ F
        return self.svec(product + product.transpose(0, 2, 1)).T

    def add(self, terms: dict[int, Array], margin: Array, side: Array | None = None) -> None:
        """Ask for side − Σ terms_k P_k − t margin ⪰ 0."""
        self.blocks.append((terms, self.svec(margin), self.svec(np.zeros((self.n, self.n)) if side is None else side)))

    def solved(self) -> tuple[Array, float] | None:
        """Return P and t > 0, or None."""
        work = (self.count * self.size + 1) ** 2 * len(self.blocks) * self.n**2
        x, sure = (None, False) if DENSE[0] < work <= DENSE[1] else self._sparse()
        if not sure and work <= DENSE[2]:
            x = self._dense()
        if x is None or not (np.isfinite(x).all() and x[-1] > 0):
            return None
        return np.tensordot(x[:-1].reshape(self.count, self.size), self.basis, 1), float(x[-1])

    @property
    def cost(self) -> Array:
        """Its product with (P_0, P_1, …, t) is to be small."""
        return np.append(np.zeros(self.count * self.size), -1.0)

    def _dense(self) -> Array | None:
        """Ask the method of the package, with the left-hand sides of all unit vectors."""
        images = np.zeros((self.count, self.size, len(self.blocks), self.n, self.n))
        for at, (terms, _, _) in enumerate(self.blocks):
            for k, X in terms.items():
                images[k, :, at] = np.tensordot(X.T, self.basis, 1)
        margins, sides = (np.array([block[k] for block in self.blocks]) @ self._flat for k in (1, 2))
        shape = len(self.blocks), self.n, self.n
        whole = np.concatenate([images.reshape(-1, *shape), margins.reshape(1, *shape)])
        return least(StackMap(whole, -sides.reshape(shape), self.cost), gap=_GAP)

    @property
    def _flat(self) -> Array:
        return self.basis.reshape(self.size, -1)

    def _sparse(self) -> tuple[Array | None, bool]:
        """Ask Clarabel, which sees which P_k are in an inequality, and say whether it is sure."""
        size, width = self.size, self.count * self.size
        rows, columns, values = list[IntArray](), list[IntArray](), list[Array]()
        for at, (terms, margin, _) in enumerate(self.blocks):
            for k, X in [*terms.items(), (self.count, margin[:, None])]:
                row, column = np.nonzero(X)
                rows.append(np.asarray(row + at * size, dtype=np.int64))
                columns.append(np.asarray(column + k * size, dtype=np.int64))
                values.append(X[row, column])
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        G = sparse.coo_matrix(entries, shape=(len(self.blocks) * size, width + 1)).tocsc()
        sides = np.concatenate([side for *_, side in self.blocks])
        cones = [clarabel.PSDTriangleConeT(self.n)] * len(self.blocks)
        try:
            answer = minimise(self.cost, G, sides, cones, _GAP)
        except ArithmeticError:
            return None, False
        return np.array(answer.x), answer.status == clarabel.SolverStatus.Solved
