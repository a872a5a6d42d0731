"""The left-hand sides of a program as a linear map A of its unknowns, its adjoint, and Σ A_i* (W_i · W_i) A_i.

For X_i = R_i W_i L_i, V_i = R_i W_i R_iᵀ and U_i = L_iᵀ W_i L_i the part of that matrix for P and P' is

    2 Σ_i tr(P X_i P' X_i) + tr(P V_i P' U_i),

O(l n⁴) for all cells together, where a solver that sees n (n + 1) / 2 rows for each cell needs O(l n⁶). The terms with
Y are alike. Where tr V P⁻¹ Vᵀ is the objective, a matrix W with [W, V; Vᵀ, P] ⪰ 0 is one more unknown, and
tr W is to be small. It stands in that inequality alone, so it is eliminated by hand: see `Corner`.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from pwatrack.arrays import Array, symmetric_part
from pwatrack.lmi.blocks import Blocks, Scaling
from pwatrack.lmi.inequality import Inequality
from pwatrack.lmi.normal import ChainNormal, Normal
from pwatrack.lmi.program import SemidefiniteProgram


class Side:
    """An `Inequality` with None for what is 0 (L with R, M with N, T) or the identity (R or N alone).

    What all cells have in common is there once.
    """

    def __init__(self, c: Inequality) -> None:
        nothing: tuple[Array | None, Array | None] = None, None
        self.L, self.R = (_once(c.L), _unless_identity(c.R)) if c.L.any() else nothing
        self.M, self.N = (_once(c.M), _unless_identity(c.N)) if c.M.any() else nothing
        self.T = None if c.T is None else _once(c.T)


class Corner:
    """W_i of [W, V; Vᵀ, P] ⪰ 0, in blocks: W_11 with its factor, Q = W_11⁻¹ W_12, S = W_22 − W_21 Q.

    A right-hand side (F, f) of W and P leaves f − Qᵀ F Q for P, and then ΔW = W_11⁻¹ F W_11⁻¹ − Q ΔP Qᵀ.
    """

    def __init__(self, W: Array, order: int) -> None:
        """Split a matrix of which the first block has this order."""
        whole = np.linalg.cholesky(W)
        self.factor, low, last = whole[:order, :order], whole[order:, :order], whole[order:, order:]
        self.Q: Array = solve_triangular(self.factor, low.T, lower=True, trans="T", check_finite=False)
        self.S = last @ last.T

    def between(self, F: Array) -> Array:
        """Return W_11⁻¹ F W_11⁻¹."""
        pair = self.factor, True
        return np.asarray(cho_solve(pair, cho_solve(pair, F, check_finite=False).T, check_finite=False))


class Triangle:
    """A symmetric matrix X = T + Tᵀ as the vector of a lower triangle T: half of the diagonal, and what is below it."""

    def __init__(self, n: int) -> None:
        self.n, self.size = n, n * (n + 1) // 2
        self.rows, self.columns = np.tril_indices(n)

    def matrix(self, v: Array) -> Array:
        """Return the matrix of a vector, or of each of several."""
        T = np.zeros((*v.shape[:-1], self.n, self.n))
        T[..., self.rows, self.columns] = v
        return symmetric_part(T)

    def of(self, X: Array) -> Array:
        """Return the vector of a matrix."""
        return np.asarray(np.where(self.rows == self.columns, 0.5, 1.0) * X[self.rows, self.columns])

    def row(self, X: Array) -> Array:
        """Return the row whose product with the vector of P is tr P X."""
        return np.asarray((X + X.T)[self.rows, self.columns])

    def of_row(self, row: Array) -> Array:
        """Return the symmetric matrix of a row."""
        X = np.empty((self.n, self.n))
        X[self.rows, self.columns] = X[self.columns, self.rows] = row / 2
        return X

    def inside(self, X: Array, count: int) -> Array:
        """Return the first entries of the lower triangle of each of a stack of matrices."""
        places = self.rows[:count] * X.shape[2] + self.columns[:count]
        return np.asarray(np.take(X.reshape(len(X), -1), places, axis=1))


class LinearMap:
    """A vector holds the lower triangle of P, then Y, t and, where there is one, the lower triangle of W.

    Attributes:
        blocks: Where the left-hand sides stand in a vector, the one of W last.
        constant: The C_i.
        cost: Its product with a vector is to be small.
        rows, values: (k, size) and (k,): what their products with a vector must be.
        size: Number of entries.
    """

    def __init__(self, program: SemidefiniteProgram, *, padded: bool = False) -> None:
        """Read a program; padded, all matrices are filled up to the same order, by constraints 0 ≤ 1."""
        self.n, self.m, self.V = program.n, program.m, program.weight
        self.sides = [Side(c) for c in program.constraints]
        self.P = Triangle(self.n)
        self.W = Triangle(0 if self.V is None else len(self.V))
        self.main = self.P.size + self.m * self.n + 1
        self.size = self.main + self.W.size
        constants = [c.constant for c in program.constraints]
        self.cost = np.zeros(self.size)
        if self.V is not None:
            nothing = np.zeros((self.W.n, self.W.n)), np.zeros((self.n, self.n))
            constants.append(-np.block([[nothing[0], self.V], [self.V.T, nothing[1]]])[None])
            self.cost[self.main :] = self.W.row(np.eye(self.W.n))
        elif program.price:
            self.cost[self.main - 1] = program.price
        else:
            self.cost[: self.P.size] = self.P.row(program.slope)
        self.blocks = Blocks([(len(c), c.shape[1]) for c in constants], padded=padded)
        self.constant = self.blocks.of(constants, beside=-1.0 if padded else 0.0)
        self.rows = np.zeros((len(program.equalities), self.size))
        for row, (E, _) in zip(self.rows, program.equalities, strict=True):
            row[: self.P.size] = self.P.row(E)
        self.values = np.array([value for _, value in program.equalities])

    def parts(self, v: Array) -> tuple[Array, Array, float]:
        """Return P, Y and t."""
        return (
            self.P.matrix(v[: self.P.size]),
            v[self.P.size : self.main - 1].reshape(self.m, self.n),
            float(v[self.main - 1]),
        )

    def vector(self, P: Array, Y: Array, t: float) -> Array:
        """Return the vector of P, Y and t, with W = V P⁻¹ Vᵀ where there is one."""
        v = np.concatenate([self.P.of(P), Y.ravel(), [t]])
        return v if self.V is None else np.append(v, self.W.of(self.V @ np.linalg.solve(P, self.V.T)))

    def apply(self, v: Array) -> Array:
        """Return A(v): the left-hand sides without their constants."""
        return np.asarray(self.apply_all(v[None])[0])

    def apply_all(self, v: Array) -> Array:
        """Return A(v) of several, (u, size)."""
        P, t, x = self.P.matrix(v[:, : self.P.size]), v[:, self.main - 1], np.zeros((len(v), self.blocks.size))
        Y, places = v[:, self.P.size : self.main - 1].reshape(len(v), 1, self.m, self.n), self.blocks.parts(x)
        for side, out in zip(self.sides, places, strict=False):
            if side.L is not None:
                out += symmetric_part(self._half(side.L, P, side.R))
            if side.M is not None:
                out += symmetric_part(_times(side.M @ Y, side.N))
            if side.T is not None:
                out += t[:, None, None, None] * side.T
        if self.V is not None:
            places[-1][:, 0, : self.W.n, : self.W.n] = -self.W.matrix(v[:, self.main :])
            places[-1][:, 0, self.W.n :, self.W.n :] = -P
        return x

    def _half(self, L: Array, P: Array, R: Array | None) -> Array:
        """Return L_i P R_i of several P, (u, l, N, N)."""
        return _times((L.reshape(-1, self.n) @ P).reshape(len(P), *L.shape), R)

    def adjoint(self, z: Array) -> Array:
        """Return A*(Z): its product with v is Σ tr Z_i A_i(v)."""
        result, parts = np.zeros(self.size), self.blocks.parts(z)
        for side, Z in zip(self.sides, parts, strict=False):
            self._add_adjoint(result, side, Z)
        if self.V is not None:
            corner = parts[-1][0]
            result[: self.P.size] -= self.P.row(corner[self.W.n :, self.W.n :])
            result[self.main :] = -self.W.row(corner[: self.W.n, : self.W.n])
        return result

    def step(self, scalings: Sequence[Scaling]) -> "Equations":
        """Return the equations of a step, factorized."""
        return Equations(self, scalings)

    def _add_adjoint(self, result: Array, side: Side, Z: Array) -> None:
        if side.L is not None:
            if side.R is None and len(side.L) == len(Z):
                half = Z.reshape(-1, Z.shape[2]).T @ side.L.reshape(-1, self.n)
            else:
                half = _front(side.R, _both(Z, side.L, side.R)).sum(axis=0)
            result[: self.P.size] += 2 * self.P.row(half)
        if side.M is not None:
            half = _front(side.N, _both(Z, side.M, side.N)).sum(axis=0).T
            result[self.P.size : self.main - 1] += 2 * half.ravel()
        if side.T is not None:
            each = Z if len(side.T) == len(Z) else Z.sum(axis=0, keepdims=True)
            result[self.main - 1] += float(np.vdot(each, side.T))

    def normal(self, w: Array) -> tuple[Normal | ChainNormal, Corner | None]:
        """Return the H with v'ᵀ H v = Σ tr A_i(v) W_i A_i(v') W_i, factorized; W is eliminated from it."""
        k, parts, H = self.P.size, self.blocks.parts(w), np.zeros((self.main, self.main))
        terms = {name: list[Array]() for name in "XVUabceghq"}
        for side, W in zip(self.sides, parts, strict=False):
            if side.T is not None:
                row = np.zeros(self.size)
                self._add_adjoint(row, side, W @ side.T @ W)
                H[-1] += row[: self.main]
            _add_terms(terms, side, W)
        corner = None
        if self.V is not None:
            W = parts[-1][0]
            corner = Corner(W, self.W.n)
            terms["V"].append((corner.S / 2 + corner.Q.T @ W[: self.W.n, self.W.n :])[None])
            terms["U"].append(corner.S[None])
        if terms["U"]:
            self._fill_P(H, terms)
        if terms["g"]:
            g, h, q = (np.concatenate(terms[name]) for name in "ghq")
            Y = np.tensordot(g, g, (0, 0)).transpose(3, 0, 1, 2) + np.tensordot(h, q, (0, 0)).transpose(3, 0, 2, 1)
            H[k:-1, k:-1] = 2 * Y.reshape(self.m * self.n, self.m * self.n)
        if terms["a"]:
            self._fill_Y(H, terms)
        return Normal(H), corner

    def _fill_P(self, H: Array, terms: dict[str, list[Array]]) -> None:
        """Write the rows of P, those with first index a at once; of both orders of (b, c, d) one product has half."""
        V, U, n = np.concatenate(terms["V"]), np.concatenate(terms["U"]), self.n
        X = np.concatenate(terms["X"]) if terms["X"] else np.zeros((0, n, n))
        Xt = X.transpose(0, 2, 1)
        first, second = 2 * np.concatenate([X, Xt, V, U]).reshape(-1, n * n), np.concatenate([Xt, X, U, V])
        for a in range(n):
            count, some = (a + 1) * (a + 2) // 2, a + 1
            half = (first[:, : some * n].T @ second[:, a, :some]).reshape(some, n, some)[:, :some]
            H[count - some : count, :count] = self.P.inside(half + half.transpose(0, 2, 1), count)

    def _fill_Y(self, H: Array, terms: dict[str, list[Array]]) -> None:
        """Write where rows of Y, those of one input at once, meet columns of P."""
        a, b, c, e = (np.concatenate(terms[name]) for name in "abce")
        n, k = self.n, self.P.size
        left, right = 2 * np.concatenate([a.transpose(0, 2, 1), e]), np.concatenate([b, c.transpose(0, 2, 1)])
        for r in range(self.m):
            half = (left[:, r].T @ right.reshape(-1, n * n)).reshape(n, n, n)
            both = half.transpose(1, 0, 2) + half.transpose(1, 2, 0)
            H[k + r * n : k + (r + 1) * n, :k] = self.P.inside(both, k)


class Equations:
    """What is left of a step for the unknowns, in scaled coordinates: v ↦ E_i A_i(v) E_iᵀ and its normal equations."""

    def __init__(self, linear: LinearMap, scalings: Sequence[Scaling]) -> None:
        self._linear, self._scalings = linear, scalings
        w = np.empty(linear.blocks.size)
        for W, scaling in zip(linear.blocks.stacks(w), scalings, strict=True):
            np.matmul(scaling.E.transpose(0, 2, 1), scaling.E, out=W)
        self._normal, self._corner = linear.normal(w)

    def apply(self, v: Array) -> list[Array]:
        """Return the scaled left-hand sides, stack by stack."""
        stacks = self._linear.blocks.stacks(self._linear.apply(v))
        return [scaling.into(X) for X, scaling in zip(stacks, self._scalings, strict=True)]

    def adjoint(self, changes: Sequence[Array]) -> Array:
        """Return A*(Z) for scaled stacks of Z."""
        return self._linear.adjoint(self._linear.blocks.unscaled(changes, self._scalings))

    def solve(self, right: Array) -> Array:
        """Return v whose scaled left-hand sides have this adjoint."""
        if self._corner is None:
            return self._normal.solve(right)
        linear, corner = self._linear, self._corner
        F, main = linear.W.of_row(right[linear.main :]), right[: linear.main].copy()
        main[: linear.P.size] -= linear.P.row(corner.Q.T @ F @ corner.Q)
        found = self._normal.solve(main)
        return np.append(found, linear.W.of(corner.between(F) - corner.Q @ linear.parts(found)[0] @ corner.Q.T))


def _add_terms(terms: dict[str, list[Array]], side: Side, W: Array) -> None:
    if side.L is not None:
        WL = W @ side.L
        RW = _front(side.R, W)
        terms["X"].append(_front(side.R, WL))
        terms["V"].append(_back(RW, side.R))
        terms["U"].append(side.L.transpose(0, 2, 1) @ WL)
    if side.M is not None:
        WM = W @ side.M
        terms["g"].append(_front(side.N, WM))
        terms["h"].append(_back(_front(side.N, W), side.N))
        terms["q"].append(side.M.transpose(0, 2, 1) @ WM)
        if side.L is not None:
            terms["a"].append(_front(side.R, WM))
            terms["b"].append(_front(side.N, WL))
            terms["c"].append(_back(RW, side.N))
            terms["e"].append(side.M.transpose(0, 2, 1) @ WL)


def _once(X: Array) -> Array:
    return np.ascontiguousarray(X[:1] if len(X) > 1 and (X[1:] == X[0]).all() else X)


def _unless_identity(X: Array) -> Array | None:
    once = _once(X)
    return None if len(once) == 1 and np.array_equal(once[0], np.eye(X.shape[1])) else once


def _both(Z: Array, X: Array, front: Array | None) -> Array:
    """Return Z_i X_i, or their sum, (1, …), where what stands before and after them is the same for all cells."""
    alike = len(X) == 1 and (front is None or len(front) == 1)
    return np.asarray((Z.sum(axis=0, keepdims=True) if alike else Z) @ X)


def _front(E: Array | None, X: Array) -> Array:
    return X if E is None else np.asarray(E @ X)


def _times(X: Array, E: Array | None) -> Array:
    return X if E is None else np.asarray(X @ E)


def _back(X: Array, E: Array | None) -> Array:
    return X if E is None else np.asarray(X @ E.transpose(0, 2, 1))


class DenseMap(LinearMap):
    """A `LinearMap` that keeps the left-hand sides of all unit vectors, and has all constraints in one stack.

    Of small programs the products are so small that their number counts, not their size.
    """

    def __init__(self, program: SemidefiniteProgram) -> None:
        super().__init__(program, padded=True)
        self.images = self.apply_all(np.eye(self.size))

    def _half(self, L: Array, P: Array, R: Array | None) -> Array:
        rows = L @ P[:, None]
        return rows if R is None else np.einsum("ulij,ljk->ulik", rows, R)

    def apply(self, v: Array) -> Array:
        return np.asarray(v @ self.images)

    def adjoint(self, z: Array) -> Array:
        return np.asarray(self.images @ z)

    def step(self, scalings: Sequence[Scaling]) -> Equations:
        return DenseEquations(self, scalings[0])


class DenseEquations(Equations):
    """`Equations` with the left-hand sides of all unit vectors."""

    def __init__(self, linear: DenseMap, scaling: Scaling) -> None:
        self._shape = scaling.E.shape
        self._images = scaling.into(linear.images.reshape(-1, *self._shape)).reshape(linear.images.shape)
        self._normal, self._corner = Normal(self._images @ self._images.T), None

    def apply(self, v: Array) -> list[Array]:
        return [(v @ self._images).reshape(self._shape)]

    def adjoint(self, changes: Sequence[Array]) -> Array:
        return np.asarray(self._images @ changes[0].ravel())
