"""Multipliers that speak against all gains: found in floating point, rounded to rational ones, and proved.

Z_i ⪰ 0, not all 0, with Σ Z_i B = 0 and Σ (Z_i A_i + A_iᵀ Z_i) ⪰ 0 leave no P ≻ 0 and Y for (8) (the theorem of
alternatives, proved in `docs/theory/proofs.md`; for given gains B is empty). Where only one Z_i is not 0 it need not be
⪰ 0, it is enough that it is not ⪯ 0. With Σ (Z_i A_i + A_iᵀ Z_i) = 0 no P = Pᵀ of any sign does either.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import lcm
from typing import Any

import flint
import numpy as np
from scipy.linalg import qr

from pwatrack.arrays import Array
from pwatrack.lmi.inequality import Inequality
from pwatrack.lmi.presolve import Coordinates
from pwatrack.lmi.program import least_violation
from pwatrack.lmi.solve import solve
from pwatrack.rational import (
    Rational,
    column_space,
    decimals,
    floats,
    identity,
    is_positive_semidefinite,
    left_null_space,
    rational,
    stacked,
)

INSIDE = 0.3  # gap of the least violation at which multipliers are taken to be rounded: they are well inside
_NEAR = 1e-4  # the same where their faces are to be seen
_ROUNDING = 1e-13  # of the largest entry: what is smaller is none
_LIGHT = 1e-3  # a cell with less than this share of the weight is tried without
_BITS = 48  # of the entries of a rounded multiplier
_INDEPENDENT = 1e-10  # of the largest pivot: equations with smaller ones follow from the others
_SINGULAR = 1e-5  # eigenvalues below this share of the largest are taken for 0 when faces are guessed
_SIMPLE = 1000  # denominators of guessed directions


def refutes(
    A: Sequence[Rational], B: Rational | None, Z: Mapping[int, Rational], *, kernel: Rational | None = None
) -> bool:
    """Check exactly that multipliers, by cell, 0 for the others, prove that there is no solution.

    B is None where it is to be proved of a P of any sign. The kernel has columns that all Z_i may be 0 on, by default
    those of B: to be fast, whatever they are.
    """
    half, each = _total([Z_i * A[i] for i, Z_i in Z.items()]), list(Z.values())
    total = half + half.transpose()
    if any(Z_i != Z_i.transpose() for Z_i in each):
        return False
    if B is None:
        return not any(total.entries()) and _weigh(each, None)
    kernel = column_space(B) if kernel is None else kernel
    if not is_positive_semidefinite(total, kernel) or any((_total(each) * B).entries()):
        return False
    return not is_positive_semidefinite(-each[0]) if len(each) == 1 else _weigh(each, kernel)


def _weigh(Z: Sequence[Rational], kernel: Rational | None) -> bool:
    """Say whether all multipliers are ⪰ 0, and some are not 0."""
    return any(any(Z_i.entries()) for Z_i in Z) and all(is_positive_semidefinite(Z_i, kernel) for Z_i in Z)


def rounded(X: Array) -> Rational:
    """Return a symmetric matrix rounded to a grid finer than its largest entry by 2^-48."""
    grid = Fraction(2) ** (int(np.ceil(np.log2(np.abs(X).max(initial=1e-300)))) - _BITS)
    return rational([[round(Fraction(v) / grid) * grid for v in row] for row in ((X + X.T) / 2).tolist()], X.shape)


def whole(Z: Mapping[int, Rational]) -> dict[int, tuple[tuple[int, ...], ...]]:
    """Return the multipliers times one number that makes all entries whole."""
    scale = _denominator(Z.values())
    return {i: tuple(tuple(int((v * scale).p) for v in row) for row in Z_i.tolist()) for i, Z_i in Z.items()}


@dataclass(frozen=True, kw_only=True)
class _Faces:
    """Where multipliers are looked for: Z_i = N_iᵀ V_i N_i with Z_i R = 0."""

    A: Array  # the matrices A_i in floating point, (l, n, n)
    exact_A: Sequence[Rational]  # the same exactly
    B: Rational | None  # that of `refutes`
    R: Rational  # (n, ρ)
    N: Sequence[Rational]  # N_i (k_i, n)

    @cached_property
    def bases(self) -> list[Array]:
        """Orthonormal columns of the same spans, (n, k_i)."""
        return [np.linalg.qr(floats(N_i).T)[0] for N_i in self.N]

    def turn(self, i: int) -> Array:
        """Return T with N_iᵀ T the basis, (k_i, k_i)."""
        return np.asarray(np.linalg.lstsq(floats(self.N[i]).T, self.bases[i], rcond=None)[0], dtype=np.float64)

    def sought(self, cells: Sequence[int], gap: float) -> list[Array] | None:
        return sought(self.A[cells], [self.bases[i] for i in cells], floats(self.R), gap=gap)

    def proved(self, cells: Sequence[int]) -> dict[int, Rational] | None:
        """Return multipliers for some cells, rounded to Σ (Z_i A_i + A_iᵀ Z_i) R = 0, if they are proved, by cell."""
        U = self.sought(cells, INSIDE)
        if U is None:
            return None
        A, N = [self.exact_A[i] for i in cells], [self.N[i] for i in cells]
        V = [rounded(T @ U_i @ T.T) for T, U_i in zip(map(self.turn, cells), U, strict=True)]
        if self.R.ncols() and not _mended(V, A, N, self.R):
            return None
        scale = _denominator(V)  # whole numbers are multiplied much faster
        Z = {i: N_i.transpose() * (V_i * scale) * N_i for i, N_i, V_i in zip(cells, N, V, strict=True)}
        return Z if refutes(self.exact_A, self.B, Z, kernel=self.R) else None

    def smaller(self, U: Mapping[int, Array]) -> "_Faces":
        """Return smaller faces, and more of R, read off a marginal solution; whether they are right shows later.

        Where the best margin is exactly 0 the multipliers are singular, often in rational directions.
        """
        smaller, S = list(self.N), np.zeros(self.A.shape[1:])
        for i, U_i in U.items():
            values, vectors = np.linalg.eigh(U_i)
            seen = vectors[:, values > _SINGULAR * values[-1]]
            smaller[i] = _simple_span(self.turn(i) @ seen).transpose() * self.N[i]
            ZA = self.bases[i] @ U_i @ self.bases[i].T @ self.A[i]
            S += ZA + ZA.T
        values, vectors = np.linalg.eigh(S)
        blind = _simple_span(vectors[:, np.abs(values) <= _SINGULAR * np.abs(values).max()])
        return replace(self, R=self.R if self.B is None else blind, N=smaller)


def conflict(
    A: Array, B: Array | None, exact_A: Sequence[Rational], exact_B: Rational | None
) -> dict[int, Rational] | None:
    """Return proved multipliers for several cells, none of which has a mode of its own that no gain moves; or None.

    Where those cells that bear nearly all of the weight prove it alone, they do. Where multipliers are singular, they
    are looked for once more in the faces that they seem to lie in. B is None where it is to be proved of a P of any
    sign.
    """
    at = Coordinates.balanced(A, B)
    D = decimals(at.T)
    inverse = D.inv()
    exact_A, exact_B = [inverse * A_i * D for A_i in exact_A], None if exact_B is None else inverse * exact_B
    eye = identity(A.shape[1])
    R, N = (eye, [eye] * len(A)) if exact_B is None else _faces(exact_A, exact_B)
    found = _found(_Faces(A=at.system(A), exact_A=exact_A, B=exact_B, R=R, N=N))
    return None if found is None else {i: inverse * Z_i * inverse for i, Z_i in found.items()}


def _found(inside: _Faces) -> dict[int, Rational] | None:
    """Return proved multipliers by cell: of all that have a face, of the heavy ones alone, then in smaller faces."""
    cells = [i for i, N_i in enumerate(inside.N) if N_i.nrows()]
    for _ in range(2):
        if not cells or not all(inside.N[i].nrows() for i in cells):
            return None
        U = inside.sought(cells, _NEAR)
        weight = np.array([np.trace(U_i) for U_i in U or ()])
        if U is None or not weight.max() > 0:  # or not a number
            return None
        heavy = [i for i, w in zip(cells, weight, strict=True) if w > _LIGHT * weight.max()]
        for some in (heavy, cells) if len(heavy) < len(cells) else (cells,):
            Z = inside.proved(some)
            if Z is not None:
                return Z
        inside, cells = inside.smaller(dict(zip(cells, U, strict=True))), heavy
    return None


def sought(A: Array, bases: Sequence[Array], blind: Array, *, gap: float) -> list[Array] | None:
    """Look for Z_i = Q_i U_i Q_iᵀ ⪰ 0 with S R = 0 and S ⪰ t I on the complement of R, S = Σ (Z_i A_i + A_iᵀ Z_i).

    They are the multipliers of Q_iᵀ (A_i P + P A_iᵀ) Q_i ⪯ t I with the least t, where P ⪰ 0 is asked on that
    complement alone: what P may be elsewhere makes S R = 0. The U_i are returned, or None where P shows that there are
    none, or nothing was found. With a large gap of t they are well inside, and can be rounded; with a small one as
    singular as at the least t.

    A is (l, n, n), the bases Q_i (n, k_i) are orthonormal, and `blind` is R (n, ρ).
    """
    n, rank = A.shape[1], blind.shape[1]
    T = np.roll(np.linalg.qr(np.hstack([blind, np.eye(n)]))[0], -rank, axis=1)  # the complement of R, then R
    cells = {order: [i for i, Q in enumerate(bases) if Q.shape[1] == order] for order in {Q.shape[1] for Q in bases}}
    inequalities = []
    for order, some in cells.items():
        Q = np.array([T.T @ bases[i] for i in some])
        L = Q.transpose(0, 2, 1) @ (T.T @ A[some] @ T)
        L, Q = (np.where(np.abs(X) > _ROUNDING * np.abs(X).max(initial=0.0), X, 0.0) for X in (L, Q))
        nothing = np.zeros((len(some), order, order))
        inequalities.append(
            Inequality(L=L, R=Q, M=nothing[:, :, :0], N=np.zeros((len(some), n, order)), constant=nothing)
        )
    found = solve(least_violation(inequalities, n - rank), gap=gap, against=0.0)
    if found is None or found.multipliers is None or found.objective < 0:
        return None
    places = [i for some in cells.values() for i in some]
    U = [U_i for part in found.multipliers[: len(cells)] for U_i in part]
    return [U[k] for k in np.argsort(places)]


def _faces(A: Sequence[Rational], B: Rational) -> tuple[Rational, list[Rational]]:
    """Return R (n, ρ) and N_i (k_i, n): every solution has Z_i R = 0 and Z_i = N_iᵀ U_i N_i with some U_i ⪰ 0.

    Σ Z_i B = 0 with Z_i ⪰ 0 makes Z_i B = 0. Where Z_i r = 0 for all i, rᵀ S r = 0 for
    S = Σ (Z_i A_i + A_iᵀ Z_i), so S ⪰ 0 needs S r = Σ Z_i A_i r = 0. If every Z_i A_i r is Z_i w
    times a number c_i ≥ 0, then wᵀ S r = 0 makes Z_i w = 0 wherever c_i > 0.
    """
    R, N = column_space(B), [left_null_space(B) for _ in A]
    while True:
        for r in _candidates(A, R, N):
            images = [A_i * r for A_i in A]
            seen = [N_i * x for N_i, x in zip(N, images, strict=True)]
            w = next((x for x, y in zip(images, seen, strict=True) if any(y.entries())), None)
            if w is None:
                continue
            factors = [_factor(y, N_i * w) for N_i, y in zip(N, seen, strict=True)]
            if any(c is None or c < 0 for c in factors):
                continue
            N = [left_null_space(N_i * w) * N_i if c > 0 else N_i for N_i, c in zip(N, factors, strict=True)]
            if not any(any((N_i * w).entries()) for N_i in N):
                R = stacked([R.transpose(), w.transpose()]).transpose()
            break
        else:
            return R, N


def _candidates(A: Sequence[Rational], R: Rational, N: Sequence[Rational]) -> list[Rational]:
    """Return vectors in the range of R: those that all cells map alike, then the columns."""
    if not R.ncols():
        return []
    differences = [N[0] * (A_i - A[0]) * R for A_i in A[1:] if N[0].nrows()]
    alike = left_null_space(stacked(differences).transpose()) if differences else identity(R.ncols())
    return [_column(row) for row in stacked([alike * R.transpose(), R.transpose()]).tolist()]


def _factor(y: Rational, x: Rational) -> Any:
    if not any(y.entries()):
        return flint.fmpq(0)
    at = next((k for k, v in enumerate(x.entries()) if v != 0), None)
    if at is None:
        return None
    c = y[at, 0] / x[at, 0]
    return c if y == x * c else None


def _simple_span(columns: Array) -> Rational:
    """Return columns of the same span, a unit matrix in some rows and simple fractions in the others."""
    rank = columns.shape[1]
    if not rank:
        return rational([], columns.shape)
    rows = qr(columns.T, pivoting=True)[2][:rank]
    basis = columns @ np.linalg.inv(columns[rows])
    fractions = [[Fraction(v).limit_denominator(_SIMPLE) for v in row] for row in basis.tolist()]
    return rational(fractions, columns.shape)


def _mended(V: Sequence[Rational], A: Sequence[Rational], N: Sequence[Rational], R: Rational) -> bool:
    """Change as few entries of the V_i as it takes that Σ (Z_i A_i + A_iᵀ Z_i) R = 0, and say whether that worked."""
    ends = [(N_i * A_i, N_i * A_i * R, N_i * R) for N_i, A_i in zip(N, A, strict=True)]
    unknowns = [(i, j, k) for i, V_i in enumerate(V) for j in range(V_i.nrows()) for k in range(j, V_i.nrows())]
    each = zip(N, V, ends, strict=True)
    parts = [N_i.transpose() * V_i * NAR + NA.transpose() * V_i * NR for N_i, V_i, (NA, NAR, NR) in each]
    residual = _total(parts).entries()
    chosen, rows = _pivots(np.vstack([_equations(N_i, *end) for N_i, end in zip(N, ends, strict=True)]))
    lists = [[X.tolist() for X in (N_i, *end)] for N_i, end in zip(N, ends, strict=True)]
    columns = []
    for i, j, k in (unknowns[c] for c in chosen):
        N_i, NA, NAR, NR = lists[i]
        pairs = [(N_i[j], NAR[k]), (NA[j], NR[k])] + ([(N_i[k], NAR[j]), (NA[k], NR[j])] if j != k else [])
        columns.append(_total([_column(x) * _column(y).transpose() for x, y in pairs]).entries())
    square = flint.fmpq_mat(len(rows), len(chosen), [entries[r] for r in rows for entries in columns])
    try:
        step = square.solve(_column([-residual[r] for r in rows])).entries() if rows else []
    except ZeroDivisionError:
        return False
    for c, dx in zip(chosen, step, strict=True):
        i, j, k = unknowns[c]
        V[i][j, k] += dx
        if j != k:
            V[i][k, j] += dx
    return True


def _equations(N: Rational, NA: Rational, NAR: Rational, NR: Rational) -> Array:
    """Return in doubles what each entry V_jk with j ≤ k adds to Σ (Z_i A_i + A_iᵀ Z_i) R, a row each."""
    left, left_A, right_A, right = (floats(X) for X in (N, NA, NAR, NR))
    each = np.einsum("ja,kb->jkab", left, right_A) + np.einsum("ja,kb->jkab", left_A, right)
    both = each + each.swapaxes(0, 1)
    j, k = np.triu_indices(len(left))
    return np.asarray(np.where((j == k)[:, None, None], each[j, k], both[j, k]).reshape(len(j), -1))


def _pivots(G: Array) -> tuple[list[int], list[int]]:
    """Return as many independent rows and columns as G has rank."""
    _, triangle, order = qr(G.T, pivoting=True, mode="economic")
    diagonal = np.abs(np.diag(triangle))
    rank = int((diagonal > _INDEPENDENT * diagonal.max(initial=0.0)).sum())
    rows = order[:rank]
    return rows.tolist(), qr(G[rows], pivoting=True, mode="economic")[2][:rank].tolist()


def _denominator(matrices: Iterable[Rational]) -> int:
    return lcm(*(int(v.q) for X in matrices for v in X.entries()))


def _total(terms: Sequence[Rational]) -> Rational:
    return sum(terms[1:], terms[0])


def _column(entries: Sequence[Any]) -> Rational:
    return flint.fmpq_mat(len(entries), 1, list(entries))
