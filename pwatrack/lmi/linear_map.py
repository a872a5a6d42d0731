"""The left-hand sides of a program as a linear map A of its unknowns, its adjoint, and Σ A_i* (W_i · W_i) A_i.

For X_i = R_i W_i L_i, V_i = R_i W_i R_iᵀ and U_i = L_iᵀ W_i L_i the part of that matrix for P and P' is

    2 Σ_i tr(P X_i P' X_i) + tr(P V_i P' U_i),

O(l n⁴) for all cells together, where a solver that sees n (n + 1) / 2 rows for each cell needs O(l n⁶). The terms with
Y are alike. Where tr V P⁻¹ Vᵀ is the objective, a matrix W with [W, V; Vᵀ, P] ⪰ 0 is one more unknown, and
tr W is to be small. It stands in that inequality alone, so it is eliminated by hand: see `without_W`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from pwatrack.arrays import Array, symmetric_part
from pwatrack.lmi.inequality import Inequality
from pwatrack.lmi.program import Program


@dataclass(frozen=True, kw_only=True)
class _Side:
    """An `Inequality` with None for what is 0 (L with R, M with N, T) or the identity (R or N alone)."""

    L: Array | None
    R: Array | None
    M: Array | None
    N: Array | None
    T: Array | None

    @classmethod
    def of(cls, c: Inequality) -> "_Side":
        eye = np.eye(c.n)
        return cls(
            L=c.L if c.L.any() else None,
            R=None if c.R.shape[1:] == eye.shape and (eye == c.R).all() else c.R,
            M=c.M if c.M.any() else None,
            N=None if c.N.shape[1:] == eye.shape and (eye == c.N).all() else c.N,
            T=c.T,
        )


class LinearMap:
    """A vector holds the lower triangle of P, then Y, t and, where there is one, all entries of W.

    Attributes:
        constants: C_i of each constraint, the one of W last.
        cost: Its product with a vector is to be small.
        fixed: (row, value): what its product with a vector must be; None where nothing is asked.
        size: Number of entries.
        sizes: Of the coefficients of P in each constraint.
    """

    def __init__(self, program: Program) -> None:
        self.n, self.m = program.n, program.m
        self._sides = [_Side.of(c) for c in program.constraints]
        self._rows, self._columns = np.tril_indices(self.n)
        self._k = len(self._rows)
        self._main = self._k + self.m * self.n + 1
        self._halves = np.where(self._rows == self._columns, 0.5, 1.0)
        self.constants = [c.constant for c in program.constraints]
        self.V = program.weight
        order = 0 if self.V is None else len(self.V)
        self.size = self._main + order**2
        self._order = order
        self.cost = np.zeros(self.size)
        if self.V is not None:
            nothing = np.zeros((order, order)), np.zeros((self.n, self.n))
            self.constants.append(-np.block([[nothing[0], self.V], [self.V.T, nothing[1]]])[None])
            self.cost[self._main :] = np.eye(order).ravel()
        elif program.price:
            self.cost[self._main - 1] = program.price
        else:
            self.cost[: self._k] = self._lower(np.eye(self.n) if program.cost is None else program.cost)
        self.sizes = [
            float(np.sqrt((c.L**2).sum(axis=(1, 2)) * (c.R**2).sum(axis=(1, 2))).max()) for c in program.constraints
        ]
        self.sizes += [] if self.V is None else [1.0]
        self.fixed: tuple[Array, float] | None = None
        if program.trace is not None:
            self.fixed = np.append(self._lower(np.eye(self.n)), np.zeros(self.size - self._k)), program.trace

    def parts(self, v: Array) -> tuple[Array, Array, float]:
        """Return P, Y and t."""
        P = np.empty((self.n, self.n))
        P[self._rows, self._columns] = P[self._columns, self._rows] = v[: self._k]
        return P, v[self._k : self._main - 1].reshape(self.m, self.n), float(v[self._main - 1])

    def apply(self, v: Array) -> list[Array]:
        """Return A(v): the left-hand sides without their constants."""
        P, Y, t = self.parts(v)
        results = []
        for side, constant in zip(self._sides, self.constants, strict=False):
            total = np.zeros(constant.shape)
            if side.L is not None:
                total += symmetric_part(_times(side.L @ P, side.R))
            if side.M is not None:
                total += symmetric_part(_times(side.M @ Y, side.N))
            if side.T is not None:
                total += t * side.T
            results.append(total)
        if self.V is not None:
            whole = np.zeros(self.constants[-1].shape)
            whole[0, : self._order, : self._order] = -v[self._main :].reshape(self._order, self._order)
            whole[0, self._order :, self._order :] = -P
            results.append(whole)
        return results

    def adjoint(self, Z: Sequence[Array]) -> Array:
        """Return A*(Z): its product with v is Σ tr Z_i A_i(v)."""
        result = np.zeros(self.size)
        for side, Z_c in zip(self._sides, Z, strict=False):
            self._add_adjoint(result, side, Z_c)
        if self.V is not None:
            corner = Z[-1][0]
            result[: self._k] -= self._lower(corner[self._order :, self._order :])
            result[self._main :] = -corner[: self._order, : self._order].ravel()
        return result

    def normal(self, W: Sequence[Array]) -> Array:
        """Return H with v'ᵀ H v = Σ tr A_i(v) W_i A_i(v') W_i, for all but W, which is eliminated."""
        k = self._k
        H = np.zeros((self._main, self._main))
        terms = {name: list[Array]() for name in ("X", "V", "U", "a", "b", "c", "e", "g", "h", "q")}
        for side, W_c in zip(self._sides, W, strict=False):
            if side.T is not None:
                row = np.zeros(self.size)
                self._add_adjoint(row, side, W_c @ side.T @ W_c)
                H[-1] += row[: self._main]
            _add_terms(terms, side, W_c)
        if self.V is not None:
            S, Q = self._split(W[-1][0])
            terms["V"].append((S / 2 + Q.T @ W[-1][0, : self._order, self._order :])[None])
            terms["U"].append(S[None])
        if terms["U"]:
            X = np.concatenate(terms["X"]) if terms["X"] else np.zeros((0, self.n, self.n))
            self._fill(H, X, np.concatenate(terms["V"]), np.concatenate(terms["U"]))
        if terms["g"]:
            YY = _paired(terms["g"], terms["g"]).transpose(3, 0, 1, 2)
            YY = YY + _paired(terms["h"], terms["q"]).transpose(3, 0, 2, 1)
            H[k:-1, k:-1] = 2 * YY.reshape(self.m * self.n, self.m * self.n)
        if terms["a"]:
            PY = _paired(terms["a"], terms["b"]).transpose(3, 0, 1, 2)
            PY = PY + _paired(terms["c"], terms["e"]).transpose(3, 0, 2, 1)
            PY = (PY + PY.transpose(1, 0, 2, 3))[self._rows, self._columns].reshape(k, self.m * self.n)
            H[k:-1, :k] = 2 * (self._halves[:, None] * PY).T
        below = np.tril(H, -1)
        below += below.T
        np.fill_diagonal(below, np.diag(H))
        return below

    def _fill(self, H: Array, X: Array, V: Array, U: Array) -> None:
        """Write the rows of P, those with first index a at once; of both orders of (b, c, d) one product has half."""
        n = self.n
        Xt = np.swapaxes(X, 1, 2)
        first, second = np.concatenate([X, Xt, V, U]), np.concatenate([Xt, X, U, V])
        first, second = (np.ascontiguousarray(stack.transpose(1, 2, 0)) for stack in (first, second))
        for a in range(n):
            count = (a + 1) * (a + 2) // 2
            rows, columns, halves = self._rows[:count], self._columns[:count], self._halves[:count]
            half = first[: a + 1, : a + 1] @ second[a, : a + 1].T
            both = half[:, rows, columns] + half[:, columns, rows]
            own = np.ones(a + 1)
            own[a] = 0.5
            both *= 2 * halves
            both *= own[:, None]
            H[count - a - 1 : count, :count] = both

    def _split(self, W: Array) -> tuple[Array, Array]:
        """Return S = W_22 − W_21 W_11⁻¹ W_12 and W_11⁻¹ W_12."""
        factor = np.linalg.cholesky(W)
        corner, low, last = (factor[rows, columns] for rows, columns in _blocks(self._order))
        return last @ last.T, solve_triangular(corner, low.T, lower=True, trans="T", check_finite=False)

    def without_W(self, right: Array, W: Sequence[Array]) -> Array:
        """Return the right-hand side that is left for P, Y and t when W is eliminated."""
        if self.V is None:
            return right
        _, Q = self._split(W[-1][0])
        main = right[: self._main].copy()
        main[: self._k] -= self._lower(Q.T @ self._tail(right) @ Q)
        return main

    def with_W(self, main: Array, right: Array, W: Sequence[Array]) -> Array:
        """Return the whole solution: W_11 ΔW W_11 + W_12 ΔP W_21 is what the right-hand side has there."""
        if self.V is None:
            return main
        _, Q = self._split(W[-1][0])
        corner = cho_factor(W[-1][0, : self._order, : self._order], check_finite=False)
        found = cho_solve(corner, cho_solve(corner, self._tail(right), check_finite=False).T, check_finite=False)
        P = self.parts(np.append(main, np.zeros(self.size - self._main)))[0]
        return np.append(main, (found - Q @ P @ Q.T).ravel())

    def _tail(self, v: Array) -> Array:
        return v[self._main :].reshape(self._order, self._order)

    def _add_adjoint(self, result: Array, side: _Side, Z: Array) -> None:
        if side.L is not None:
            result[: self._k] += 2 * self._lower(_summed(_front(side.R, Z), side.L))
        if side.M is not None:
            result[self._k : self._main - 1] += 2 * _summed(_front(side.N, Z), side.M).T.ravel()
        if side.T is not None:
            result[self._main - 1] += np.vdot(Z, side.T)

    def _lower(self, X: Array) -> Array:
        """Return the row whose product with the lower triangle of P is tr P X."""
        return np.asarray(self._halves * (X + X.T)[self._rows, self._columns])


def _add_terms(terms: dict[str, list[Array]], side: _Side, W: Array) -> None:
    """Append the factors of H that a constraint has."""
    RW, NW = _front(side.R, W), _front(side.N, W)
    if side.L is not None:
        WL = W @ side.L
        terms["X"].append(_front(side.R, WL))
        terms["V"].append(_back(RW, side.R))
        terms["U"].append(np.swapaxes(side.L, 1, 2) @ WL)
    if side.M is not None:
        WM = W @ side.M
        terms["g"].append(_front(side.N, WM))
        terms["h"].append(_back(NW, side.N))
        terms["q"].append(np.swapaxes(side.M, 1, 2) @ WM)
        if side.L is not None:
            terms["a"].append(_front(side.R, WM))
            terms["b"].append(_front(side.N, WL))
            terms["c"].append(_back(RW, side.N))
            terms["e"].append(np.swapaxes(side.M, 1, 2) @ WL)


def _blocks(order: int) -> tuple[tuple[slice, slice], ...]:
    """Return where the blocks 11, 21, 22 are."""
    first, rest = slice(order), slice(order, None)
    return (first, first), (rest, first), (rest, rest)


def _front(E: Array | None, X: Array) -> Array:
    return X if E is None else E @ X


def _times(X: Array, E: Array | None) -> Array:
    return X if E is None else X @ E


def _back(X: Array, E: Array | None) -> Array:
    return X if E is None else X @ np.swapaxes(E, 1, 2)


def _summed(first: Array, second: Array) -> Array:
    """Return Σ_k first_k second_k: one matrix product."""
    return np.asarray(np.tensordot(first, second, axes=([0, 2], [0, 1])))


def _paired(first: Sequence[Array], second: Sequence[Array]) -> Array:
    """Return Σ_k first_k[a, b] second_k[c, d] as (a, b, c, d): one matrix product."""
    return np.asarray(np.tensordot(np.concatenate(first), np.concatenate(second), axes=([0], [0])))
