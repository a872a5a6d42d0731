"""Programs with many states or cells: a barrier method that uses the form of the inequalities.

A general solver sees the n (n + 1) / 2 entries of each inequality as so many rows, O(l n⁶) in all. Here Newton's
method minimises −log det of all slacks S_i plus a growing multiple of the objective (Boyd and Vandenberghe,
Convex Optimization, 2004, chapter 11). With Z_i = S_i⁻¹, X_i = R_i Z_i L_i, V_i = R_i Z_i R_iᵀ, W_i = L_iᵀ Z_i L_i the
second derivative along U and U' is

    2 Σ_i tr(U X_i U' X_i) + tr(U V_i U' W_i),

one product of an n² × 2l by a 2l × n² matrix for all cells together, O(l n⁴). The terms with Y are alike.
"""

from contextlib import suppress
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import brentq
from threadpoolctl import ThreadpoolController

from pwatrack.arrays import Array, symmetric_part
from pwatrack.lmi.inequality import Inequality
from pwatrack.lmi.program import Candidate, Program, norm_of_Y, of_P

_GROWTH = 30.0  # of the weight of the objective from one centre to the next
_LEAST_GAP = 1e-13  # duality gap at which it ends where the objective is near 0
_CENTRED = 0.1  # Newton decrement, squared, at which the weight grows
_FAR = 1e4  # times the size of the start that P and Y may have
_POLISHED = 1e-14  # the same at the last centre, or what rounding allows: the multipliers are as exact as its root
_FLAT = 1e-200  # of the largest curvature: what has less is left as it is
_MOST = 200  # Newton steps
_RIDGES = (1e-13, 1e-10, 1e-7)  # of the diagonal, the first that will do; for m ≥ 2 the Hessian is singular along
# P = 0, Y = Ω Bᵀ, Ω skew, and elsewhere it may be so to working precision


def solve(program: Program) -> Candidate | None:
    """Minimise from the strictly feasible start of a program.

    Returns:
        The minimiser, or what was reached when rounding allowed no more; None without a feasible start.
    """
    if program.start is None:
        return None
    with _threads().limit(limits=1, user_api="blas"):
        return _solve(program, *program.start)


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()


def _solve(program: Program, P: Array, Y: Array, t: float) -> Candidate | None:
    if not all(np.isfinite(part).all() for part in (P, Y, t)):
        return None
    space = _Space(replace(program, constraints=(*program.constraints, *_bounds(program, P, Y))))
    v = space.vector(P, Y, t)
    factors = space.slack_factors(v)
    if factors is None:
        return None
    order = sum(e * c.constant.size / c.N.shape[2] for c, e in zip(space.constraints, space.emphasis, strict=True))
    weight = order / max(abs(space.objective(v)), _LEAST_GAP)  # the gap is order / weight at a centre
    last = np.inf
    for _ in range(_MOST):
        gradient, hessian = space.derivatives(v, factors, weight)
        step = _newton(hessian, gradient, None if program.trace is None else space.trace)
        decrement = -float(gradient @ step)
        if not decrement > 0:
            break
        near = order / weight <= max(program.gap * abs(space.objective(v)), _LEAST_GAP)
        if near and (decrement <= _POLISHED or (last <= _CENTRED and decrement > last / 2)):
            break
        if decrement <= _CENTRED and not near:
            weight, last = weight * _GROWTH, np.inf
            continue
        last = decrement
        length = _exact_step(space, v, factors, step, weight)
        if length <= 1e-10:
            break
        following = space.slack_factors(v + length * step)
        if following is None:
            break
        v, factors = v + length * step, following
    P, Y, _ = space.parts(v)
    return Candidate(P=P, Y=Y, multipliers=_inverse(factors[0]) / weight)


def _bounds(program: Program, P: Array, Y: Array) -> list[Inequality]:
    """Return bounds of the norms of P and Y far from the start: without them the barrier may fall without end.

    Along Y = −c Bᵀ it does, and where a gain of 0 will do, along any P.
    """
    like = program.constraints[0]
    bounds = [of_P(like, 1.0, np.eye(program.n), constant=-_FAR * np.linalg.norm(P, 2) * np.eye(program.n))]
    if program.m:
        bounds.append(norm_of_Y(like, _FAR * max(1.0, float(np.linalg.norm(Y, 2)))))
    return bounds


class _Space:
    """The coordinates (lower triangle of P, Y, t) of a program and its barrier there."""

    def __init__(self, program: Program) -> None:
        self.constraints, self.n, self.m = program.constraints, program.n, program.m
        cells = len(program.constraints[0].constant)
        self.emphasis = [cells / len(c.constant) if program.even else 1.0 for c in program.constraints]
        self.rows, self.columns = np.tril_indices(self.n)
        self.size = len(self.rows) + self.m * self.n + 1
        self.trace = self._of_trace(np.eye(self.n))
        self.V = program.weight
        traced = self.trace if program.cost is None else self._of_trace(program.cost)
        self.linear = program.price * np.eye(self.size)[-1] if program.price else traced * (self.V is None)

    def objective(self, v: Array) -> float:
        """Return what is to be small."""
        value = float(self.linear @ v)
        return value if self.V is None else value + float((self.V @ np.linalg.inv(self.parts(v)[0]) * self.V).sum())

    def vector(self, P: Array, Y: Array, t: float) -> Array:
        return np.concatenate([P[self.rows, self.columns], Y.ravel(), [t]])

    def parts(self, v: Array) -> tuple[Array, Array, float]:
        P, k = np.zeros((self.n, self.n)), len(self.rows)
        P[self.rows, self.columns] = P[self.columns, self.rows] = v[:k]
        return P, v[k:-1].reshape(self.m, self.n), float(v[-1])

    def left_sides(self, v: Array, *, linear: bool = False) -> list[Array]:
        """Return the left-hand sides of all constraints, with or without their constants."""
        P, Y, t = self.parts(v)
        sides = []
        for c in self.constraints:
            side = symmetric_part(c.L @ P @ c.R)
            side = side + symmetric_part(c.M @ Y @ c.N) if self.m else side
            side = side if c.T is None else side + t * c.T
            sides.append(side if linear else side + c.constant)
        return sides

    def slack_factors(self, v: Array) -> list[Array] | None:
        """Return the Cholesky factors of all slacks, or None if one is not positive definite."""
        try:
            return [np.asarray(np.linalg.cholesky(-side), dtype=np.float64) for side in self.left_sides(v)]
        except np.linalg.LinAlgError:
            return None

    def derivatives(self, v: Array, factors: list[Array], weight: float) -> tuple[Array, Array]:
        """Return gradient and Hessian of barrier + weight · objective; the factors are those of the slacks."""
        n, m, k = self.n, self.m, len(self.rows)
        gradient, hessian = weight * self.linear, np.zeros((self.size, self.size))
        stacks: dict[str, list[Array]] = {name: [] for name in "XVWabceghk"}
        for c, factor, emphasis in zip(self.constraints, factors, self.emphasis, strict=True):
            root = np.sqrt(emphasis)
            Z = root * _inverse(factor)  # the second derivatives are products of two of it, the first ones are of one
            ZL, RZ = Z @ c.L, c.R @ Z
            X = RZ @ c.L
            gradient[:k] += root * self._lower(X.sum(axis=0))
            stacks["X"].append(X)
            stacks["V"].append(RZ @ np.swapaxes(c.R, 1, 2))
            stacks["W"].append(np.swapaxes(c.L, 1, 2) @ ZL)
            if m and c.M.any():
                NZ, Mt, Nt = c.N @ Z, np.swapaxes(c.M, 1, 2), np.swapaxes(c.N, 1, 2)
                g = NZ @ c.M
                gradient[k:-1] += root * 2 * g.sum(axis=0).T.ravel()
                for name, stack in zip(
                    "abceghk", (RZ @ c.M, c.N @ ZL, RZ @ Nt, Mt @ ZL, g, NZ @ Nt, Mt @ Z @ c.M), strict=True
                ):
                    stacks[name].append(stack)
            if c.T is not None:
                ZT = Z @ c.T
                ZTZ = ZT @ Z
                gradient[-1] += root * np.trace(ZT, axis1=1, axis2=2).sum()
                hessian[-1, -1] += np.einsum("kij,kji->", ZT, ZT)
                hessian[:k, -1] += self._lower((c.R @ ZTZ @ c.L).sum(axis=0))
                if m:
                    hessian[k:-1, -1] += 2 * (c.N @ ZTZ @ c.M).sum(axis=0).T.ravel()
        if self.V is not None:  # tr V P⁻¹ Vᵀ: its second derivative is 2 tr(U P⁻¹ U' G)
            inverse = np.linalg.inv(self.parts(v)[0])
            G = inverse @ self.V.T @ self.V @ inverse
            gradient[:k] -= weight / 2 * self._lower(G)
            stacks["V"].append(np.asarray(weight * inverse[None]))
            stacks["W"].append(G[None])
        hessian[-1, :-1] = hessian[:-1, -1]
        one = {name: np.concatenate(stack) for name, stack in stacks.items() if stack}
        PP = _paired(one["X"], one["X"]).transpose(3, 0, 1, 2) + _paired(one["V"], one["W"]).transpose(3, 0, 1, 2)
        hessian[:k, :k] = 2 * self._lower_rows(self._lower_rows(PP.reshape(n * n, n * n)).T).T
        if m:
            PY = _paired(one["a"], one["b"]).transpose(3, 0, 1, 2) + _paired(one["c"], one["e"]).transpose(3, 0, 2, 1)
            YY = _paired(one["g"], one["g"]).transpose(3, 0, 1, 2) + _paired(one["h"], one["k"]).transpose(3, 0, 2, 1)
            hessian[:k, k:-1] = 2 * self._lower_rows(PY.reshape(n * n, m * n))
            hessian[k:-1, :k] = hessian[:k, k:-1].T
            hessian[k:-1, k:-1] = 2 * YY.reshape(m * n, m * n)
        return gradient, hessian

    def _of_trace(self, W: Array) -> Array:
        """Return tr W P as a row on all coordinates."""
        return np.append(self._lower(W) / 2, np.zeros(self.m * self.n + 1))

    def _lower(self, X: Array) -> Array:
        """Return 2 tr(U X) as a row on the lower triangle of U."""
        total = X + X.T
        return np.where(self.rows == self.columns, 1.0, 2.0) * total[self.rows, self.columns]

    def _lower_rows(self, H: Array) -> Array:
        """Return the rows of H (n², ·) for the lower triangle: those of both triangles are added up."""
        off = (self.rows != self.columns)[:, None]
        lower: Array = H[self.rows * self.n + self.columns] + off * H[self.columns * self.n + self.rows]
        return lower


def _inverse(factor: Array) -> Array:
    """Return S⁻¹ from the Cholesky factors of S, (l, k, k)."""
    upper = np.linalg.inv(np.swapaxes(factor, 1, 2))  # its pivots are its diagonal, so it is never called singular
    return np.asarray(upper @ np.swapaxes(upper, 1, 2))


def _paired(first: Array, second: Array) -> Array:
    """Return Σ_k first_k[a, b] second_k[c, d] as (a, b, c, d): one matrix product."""
    return np.asarray(np.tensordot(first, second, axes=([0], [0])))


def _newton(hessian: Array, gradient: Array, fixed: Array | None) -> Array:
    """Return the Newton step, not a number if none goes down; `fixed` · step = 0 where that is asked."""
    curvature = np.maximum(np.diag(hessian), 0.0)
    if not np.isfinite(curvature).all():
        return np.full(len(gradient), np.nan)
    d = 1 / np.sqrt(np.where(curvature > _FLAT * curvature.max(), curvature, np.inf))  # 0 where nothing changes
    scaled = hessian * d[:, None] * d
    diagonal = np.diag(scaled).copy()
    for ridge in _RIDGES:
        np.fill_diagonal(scaled, diagonal + ridge)
        with suppress(np.linalg.LinAlgError):
            factor = cho_factor(scaled, check_finite=False)
            step = d * _refined(factor, scaled, -gradient * d)
            if fixed is not None:
                away = d * _refined(factor, scaled, fixed * d)
                step = step - away * (fixed @ step) / (fixed @ away)
            if gradient @ step < 0:
                return np.asarray(step)
    return np.full(len(gradient), np.nan)


def _refined(factor: tuple[Array, bool], matrix: Array, right: Array) -> Array:
    """Return the solution of matrix · x = right, with one step of iterative refinement."""
    found = cho_solve(factor, right, check_finite=False)
    return np.asarray(found + cho_solve(factor, right - matrix @ found, check_finite=False))


def _exact_step(space: _Space, v: Array, factors: list[Array], step: Array, weight: float) -> float:
    """Return the length that minimises the sum along a step; given the eigenvalues of the change that is scalar."""
    values, emphases = [], []
    for factor, change, emphasis in zip(factors, space.left_sides(step, linear=True), space.emphasis, strict=True):
        upper = np.linalg.inv(np.swapaxes(factor, 1, 2))
        values.append(np.linalg.eigvalsh(np.swapaxes(upper, 1, 2) @ -change @ upper).ravel())
        emphases.append(np.full(len(values[-1]), emphasis))
    e, counts, slope = np.concatenate(values), np.concatenate(emphases), weight * float(space.linear @ step)
    cost, falls = np.zeros(0), np.zeros(0)
    if space.V is not None:
        L = np.linalg.cholesky(space.parts(v)[0])
        half = solve_triangular(L, space.parts(step)[0], lower=True, check_finite=False)
        falls, vectors = np.linalg.eigh(symmetric_part(solve_triangular(L, half.T, lower=True)) / 2)
        cost = weight * ((space.V @ solve_triangular(L.T, vectors, lower=False)) ** 2).sum(axis=0)

    def derivative(length: float) -> float:
        barrier = float((counts * e / (1 + length * e)).sum())
        return slope - barrier - float((cost * falls / (1 + length * falls) ** 2).sum())

    end = 1e3 if e.min() >= 0 else min(1e3, (1 - 1e-9) / -e.min())
    if derivative(end) <= 0:
        return 0.99 * end
    return float(brentq(derivative, 0.0, end, xtol=1e-4, rtol=1e-4)) if derivative(0.0) < 0 else 0.0
