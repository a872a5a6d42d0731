"""Exact proof that no gain exists: multipliers Z_i, found in floating point, rounded, and checked exactly.

If Z_i ⪰ 0, not all 0, Σ Z_i B = 0 and Σ (Z_i A_i + A_iᵀ Z_i) ⪰ 0, then no P ≻ 0 and Y have
A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ ≺ 0 for all i: multiplied by Z_i and summed, the traces would be
both negative and not (the theorem of alternatives for (8); for given gains B is empty). Where only one Z_i
is not 0 it need not be ⪰ 0, it is enough that it is not ⪯ 0: A + BK with Z (A + BK) + (·)ᵀ ⪰ 0 is
then not Hurwitz, since for a Hurwitz matrix Lyapunov's equation would make Z ⪯ 0.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm
from typing import Any

import numpy as np
from scipy.linalg import null_space, orth, qr, solve_continuous_lyapunov

from pwatrack.arrays import Array
from pwatrack.lmi.coordinates import Coordinates
from pwatrack.lmi.inequality import Inequality, Solver
from pwatrack.lmi.presolve import corners
from pwatrack.lmi.program import least_violation
from pwatrack.lmi.role import Role
from pwatrack.lmi.solve import solve
from pwatrack.rational import (
    Rational,
    column_space,
    decimals,
    floats,
    identity,
    is_hurwitz,
    is_positive_definite,
    is_positive_semidefinite,
    left_null_space,
    on_rows,
    rational,
    stacked,
    unreachable,
)

_BITS = 48  # of the entries of a rounded multiplier
_SINGULAR = 1e-5  # eigenvalues below this share of the largest are taken for 0 when faces are guessed
_SIMPLE = 1000  # denominators of guessed directions

_INSIDE = 0.3  # gap of the least violation at which multipliers are taken to be rounded: they are well inside
_NEAR = 1e-4  # the same where their faces are to be seen
_ROUNDING = 1e-13  # of the largest entry: what is smaller is none
_LIGHT = 1e-3  # a cell with less than this share of the weight is tried without


@dataclass(frozen=True, kw_only=True)
class Refutation:
    """Proof that an inequality has no solution.

    Attributes:
        Z: Whole-number multipliers by cell; cells that are not named have Z_i = 0.
        eigenvalues: Of each cell that no gain stabilises by itself, the eigenvalue that stays; empty where
            only the cells together have no solution.
    """

    Z: Mapping[int, tuple[tuple[int, ...], ...]]
    eigenvalues: Mapping[int, complex]


@dataclass(frozen=True, kw_only=True)
class Impossibility:
    """What a refusal proves: the evidence of `Infeasible`.

    Attributes:
        role: Which inequality has no solution.
        rate: Decay rate that is out of reach, in 1/s.
        refutation: The proof.
    """

    role: Role
    rate: float
    refutation: Refutation


def refute(
    A: Array,
    B: Array,
    *,
    rate: float = 0.0,
    solver: Solver = "clarabel",
    exact: tuple[Sequence[Rational], Rational] | None = None,
) -> Refutation | None:
    """Prove that no P ≻ 0, Y have A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ + 2 rate P ≺ 0 for all cells, or return None.

    Args:
        A: (l, n, n).
        B: (n, m); m = 0 where the gain is given.
        rate: In 1/s, exactly as printed.
        solver: Which interior-point solver to ask for multipliers.
        exact: The matrices A_i and B that the proof is about, where they are not the decimals that A and B print as.

    Example: an integrator cannot be stabilised from nowhere.

        >>> found = refute(np.array([[[0.0]]]), np.zeros((1, 0)))
        >>> found.Z[0], found.eigenvalues
        (((1,),), {0: 0j})
    """
    shift = decimals(np.array([[rate]]))[0, 0] * identity(A.shape[1])
    numbers, exact_B = ([decimals(A_i) for A_i in A], decimals(B)) if exact is None else exact
    exact_A = [A_i + shift for A_i in numbers]
    found = _stuck_modes(exact_A, exact_B)
    if found is not None:
        return found
    at = corners(A).tolist()
    conflict = _conflict(A[at] + rate * np.eye(A.shape[1]), B, [exact_A[i] for i in at], exact_B, solver)
    if conflict is None:
        return None
    return Refutation(Z=_whole({at[i]: Z_i for i, Z_i in conflict.items()}), eigenvalues={})


def seems_impossible(A: Array, B: Array, *, rate: float = 0.0, solver: Solver = "clarabel") -> bool:
    """Say whether floating-point multipliers speak against a solution: a hint that takes few steps of a solver.

    Args:
        A, B, rate, solver: As for `refute`.

    Example:
        >>> unstable = np.array([[[0.1]]])
        >>> seems_impossible(unstable, np.zeros((1, 0))), seems_impossible(-unstable, np.zeros((1, 0)))
        (True, False)
    """
    at = Coordinates.balanced(A, B)
    seen = null_space(at.input(B).T)
    if not seen.shape[1]:
        return False
    scaled = at.system(A + rate * np.eye(A.shape[1]))
    return _multipliers(scaled, [seen] * len(A), orth(at.input(B)), solver, gap=_INSIDE) is not None


def refutes(A: Sequence[Rational], B: Rational, Z: Mapping[int, Rational], *, kernel: Rational | None = None) -> bool:
    """Check exactly that multipliers prove that there is no solution.

    Args:
        A: The matrices A_i, exact.
        B: Exact.
        Z: Multipliers by cell; 0 for the others.
        kernel: Columns that all Z_i may be 0 on, by default those of B: to be fast, whatever they are.
    """
    total, n = _sum([Z_i * A[i] for i, Z_i in Z.items()]), B.nrows()
    zero, kernel = decimals(np.zeros((n, n))), column_space(B) if kernel is None else kernel
    if any(Z_i != Z_i.transpose() for Z_i in Z.values()):
        return False
    if not is_positive_semidefinite(total + total.transpose(), kernel):
        return False
    if _sum(list(Z.values())) * B != decimals(np.zeros((n, B.ncols()))):
        return False
    if len(Z) == 1:
        (single,) = Z.values()
        return not is_positive_semidefinite(-single)
    return all(is_positive_semidefinite(Z_i, kernel) for Z_i in Z.values()) and any(Z_i != zero for Z_i in Z.values())


def _stuck_modes(A: Sequence[Rational], B: Rational) -> Refutation | None:
    """Refute by a cell with a mode that does not decay and that B does not reach."""
    eigenvalues, first = {}, None
    for i, A_i in enumerate(A):
        N, A_u = unreachable(A_i, B)
        if is_hurwitz(A_u):
            continue
        values = np.linalg.eigvals(floats(A_u))
        eigenvalues[i] = complex(values[np.argmax(values.real)])
        if first is None:
            Z = N.transpose() * _instability(A_u) * N
            if refutes(A, B, {i: Z}):
                first = _whole({i: Z})
    return None if first is None else Refutation(Z=first, eigenvalues=eigenvalues)


def _instability(M: Rational) -> Rational:
    """Return a symmetric Z, not ⪯ 0, with Z M + Mᵀ Z ⪰ 0, for a matrix that is not Hurwitz.

    If no two eigenvalues (or one twice) add up to 0, Z M + Mᵀ Z = I has a solution, and by the inertia
    theorem it has a positive eigenvalue for each one of M in the right half plane. If two do,
    Z M + Mᵀ Z = 0 has solutions that are not 0, on the invariant subspace of those
    eigenvalues; Z or −Z is then not ⪯ 0.
    """
    n = M.nrows()
    N = _symmetric_part_of_spectrum(M)
    if N.nrows():
        M = on_rows(M, N)
        kernel = left_null_space(_lyapunov_map(M).transpose())
        Z = _symmetric(kernel.tolist()[0], M.nrows())
        Z = N.transpose() * Z * N
        return -Z if is_positive_semidefinite(-Z) else Z
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nearly singular: then the exact solution decides
        close = solve_continuous_lyapunov(floats(M).T, np.eye(n)).astype(np.float64)
    if np.isfinite(close).all():
        Z = _rounded(close)
        if is_positive_definite(Z * M + (Z * M).transpose()):
            return Z
    rows, columns = np.triu_indices(n)
    right = decimals((rows == columns).astype(float)[:, None])
    return _symmetric(_lyapunov_map(M).solve(right).entries(), n)


def _symmetric_part_of_spectrum(M: Rational) -> Rational:
    """Return rows that span the left invariant subspace of the eigenvalues λ of M for which −λ is one too."""
    import flint

    falling = M.charpoly()
    mirrored = flint.fmpq_poly([c * (-1) ** k for k, c in enumerate(falling.coeffs())])
    common = falling.gcd(mirrored)
    if common.degree() < 1:
        return decimals(np.zeros((0, M.nrows())))
    power = decimals(np.zeros((M.nrows(), M.nrows())))
    for c in reversed(common.coeffs()):
        power = power * M + c * identity(M.nrows())
    return left_null_space(power)


def _lyapunov_map(M: Rational) -> Rational:
    """Return the matrix of Z ↦ Z M + Mᵀ Z on the upper triangles of symmetric matrices."""
    import flint

    n = M.nrows()
    pairs = [(j, k) for j in range(n) for k in range(j, n)]
    place = {pair: at for at, pair in enumerate(pairs)}
    X = flint.fmpq_mat(len(pairs), len(pairs))
    for at, (j, k) in enumerate(pairs):
        for s in range(n):  # (Z M)_jk + (Z M)_kj
            X[at, place[min(j, s), max(j, s)]] += M[s, k]
            X[at, place[min(k, s), max(k, s)]] += M[s, j]
    return X


def _conflict(
    A: Array, B: Array, exact_A: list[Rational], exact_B: Rational, solver: Solver
) -> dict[int, Rational] | None:
    """Return multipliers for several cells, none of which is stuck alone."""
    at = Coordinates.balanced(A, B)
    D = decimals(at.T)
    scaled, exact_A, exact_B = at.system(A), [D.inv() * A_i * D for A_i in exact_A], D.inv() * exact_B
    R, N = _faces(exact_A, exact_B)
    cells = [i for i, N_i in enumerate(N) if N_i.nrows()]
    for _ in range(2):
        if not cells or not all(N[i].nrows() for i in cells):
            return None
        bases = [np.linalg.qr(floats(N_i).T)[0] for N_i in N]
        U = _multipliers(scaled[cells], [bases[i] for i in cells], floats(R), solver, gap=_NEAR)
        weight = np.array([np.trace(U_i) for U_i in U or ()])
        if U is None or not weight.max() > 0:  # or not a number
            return None
        heavy = [i for i, w in zip(cells, weight, strict=True) if w > _LIGHT * weight.max()]
        for some in (heavy, cells) if len(heavy) < len(cells) else (cells,):
            part = [exact_A[i] for i in some], [N[i] for i in some], [bases[i] for i in some]
            inside = _multipliers(scaled[some], part[2], floats(R), solver, gap=_INSIDE)
            Z = None if inside is None else _exact_multipliers(*part, R, inside)
            if Z is not None and refutes(part[0], exact_B, dict(enumerate(Z)), kernel=R):
                return {i: D.inv() * Z_i * D.inv() for i, Z_i in zip(some, Z, strict=True)}
        R, N = _guessed_faces(scaled, N, bases, dict(zip(cells, U, strict=True)))
        cells = heavy
    return None


def _multipliers(A: Array, bases: Sequence[Array], blind: Array, solver: Solver, *, gap: float) -> list[Array] | None:
    """Look for Z_i = Q_i U_i Q_iᵀ ⪰ 0 with S R = 0 and S ⪰ t I on the complement of R, S = Σ (Z_i A_i + A_iᵀ Z_i).

    They are the multipliers of Q_iᵀ (A_i P + P A_iᵀ) Q_i ⪯ t I with the least t, where P ⪰ 0 is asked on that
    complement alone: what P may be elsewhere makes S R = 0.

    Args:
        A: (l, n, n).
        bases: Q_i (n, k_i), orthonormal.
        blind: R (n, ρ).
        solver: Which interior-point solver to ask.
        gap: Of t: with a large one the U_i are well inside, and can be rounded; with a small one as singular as at the
            least t.

    Returns:
        The U_i, or None where P shows that there are none, or nothing was found.
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
    found = solve(least_violation(inequalities, n - rank), solver, gap=gap, against=0.0)
    if found is None or found.multipliers is None or found.objective < 0:
        return None
    places = [i for some in cells.values() for i in some]
    U = [U_i for part in found.multipliers[: len(cells)] for U_i in part]
    return [U[k] for k in np.argsort(places)]


def _guessed_faces(
    A: Array, N: Sequence[Rational], bases: Sequence[Array], U: Mapping[int, Array]
) -> tuple[Rational, list[Rational]]:
    """Return smaller faces and more blind directions, read off a marginal solution; whether they are right shows later.

    Where the best margin is exactly 0 the multipliers are singular, often in rational directions.
    """
    smaller, S = list(N), np.zeros(A.shape[1:])
    for i, U_i in U.items():
        values, vectors = np.linalg.eigh(U_i)
        T = np.linalg.lstsq(floats(N[i]).T, bases[i], rcond=None)[0]
        smaller[i] = _simple_span(T @ vectors[:, values > _SINGULAR * values[-1]]).transpose() * N[i]
        ZA = bases[i] @ U_i @ bases[i].T @ A[i]
        S += ZA + ZA.T
    values, vectors = np.linalg.eigh(S)
    blind = _simple_span(vectors[:, np.abs(values) <= _SINGULAR * np.abs(values).max()])
    return blind, smaller


def _simple_span(columns: Array) -> Rational:
    """Return columns of the same span, a unit matrix in some rows and simple fractions in the others."""
    rank = columns.shape[1]
    if not rank:
        return rational([], columns.shape)
    rows = qr(columns.T, pivoting=True)[2][:rank]
    basis = columns @ np.linalg.inv(columns[rows])
    fractions = [[Fraction(v).limit_denominator(_SIMPLE) for v in row] for row in basis.tolist()]
    return rational(fractions, columns.shape)


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
    rows = stacked([alike * R.transpose(), R.transpose()]).tolist()
    return [_column(row) for row in rows]


def _factor(y: Rational, x: Rational) -> Any:
    """Return c with y = c x, or None."""
    import flint

    if not any(y.entries()):
        return flint.fmpq(0)
    at = next((k for k, v in enumerate(x.entries()) if v != 0), None)
    if at is None:
        return None
    c = y[at, 0] / x[at, 0]
    return c if y == x * c else None


def _exact_multipliers(
    A: Sequence[Rational], N: Sequence[Rational], bases: Sequence[Array], R: Rational, U: Sequence[Array]
) -> list[Rational] | None:
    """Round Z_i = Q_i U_i Q_iᵀ to rationals N_iᵀ V_i N_i that fulfil Σ (Z_i A_i + A_iᵀ Z_i) R = 0 exactly."""
    import flint

    V = []
    for N_i, Q, U_i in zip(N, bases, U, strict=True):
        T = np.linalg.lstsq(floats(N_i).T, Q, rcond=None)[0]
        V.append(_rounded(T @ U_i @ T.T))
    if R.ncols():
        ends = [(N_i * A_i, N_i * A_i * R, N_i * R) for N_i, A_i in zip(N, A, strict=True)]
        lists = [[X.tolist() for X in (N_i, *end)] for N_i, end in zip(N, ends, strict=True)]
        unknowns = [(i, j, k) for i, V_i in enumerate(V) for j in range(V_i.nrows()) for k in range(j, V_i.nrows())]
        columns = []
        for i, j, k in unknowns:
            N_i, NA, NAR, NR = lists[i]
            pairs = [(N_i[j], NAR[k]), (NA[j], NR[k])] + ([(N_i[k], NAR[j]), (NA[k], NR[j])] if j != k else [])
            columns.append(_outer(pairs).entries())
        residual = _sum(
            [
                N_i.transpose() * V_i * NAR + NA.transpose() * V_i * NR
                for N_i, V_i, (NA, NAR, NR) in zip(N, V, ends, strict=True)
            ]
        )
        G = flint.fmpq_mat(len(columns), residual.nrows() * residual.ncols(), [v for c in columns for v in c])
        chosen, rows = _pivots(floats(G))
        square = flint.fmpq_mat(len(rows), len(chosen), [G[c, r] for r in rows for c in chosen])
        try:
            step = square.solve(_column([-residual.entries()[r] for r in rows])).entries() if rows else []
        except ZeroDivisionError:
            return None
        for c, dx in zip(chosen, step, strict=True):
            i, j, k = unknowns[c]
            V[i][j, k] += dx
            if j != k:
                V[i][k, j] += dx
    whole = lcm(*(int(v.q) for V_i in V for v in V_i.entries()))  # whole numbers are multiplied much faster
    return [N_i.transpose() * (V_i * whole) * N_i for N_i, V_i in zip(N, V, strict=True)]


def _pivots(G: Array) -> tuple[list[int], list[int]]:
    """Return as many independent rows and columns as G has rank."""
    _, triangle, order = qr(G.T, pivoting=True, mode="economic")
    diagonal = np.abs(np.diag(triangle))
    rank = int((diagonal > 1e-10 * diagonal.max(initial=0.0)).sum())
    rows = order[:rank]
    columns = qr(G[rows], pivoting=True, mode="economic")[2][:rank]
    return rows.tolist(), columns.tolist()


def _rounded(X: Array) -> Rational:
    """Return a symmetric matrix rounded to a grid finer than its largest entry by 2^-48."""
    grid = Fraction(2) ** (int(np.ceil(np.log2(np.abs(X).max(initial=1e-300)))) - _BITS)
    return rational([[round(Fraction(v) / grid) * grid for v in row] for row in ((X + X.T) / 2).tolist()], X.shape)


def _whole(Z: Mapping[int, Rational]) -> dict[int, tuple[tuple[int, ...], ...]]:
    """Return the multipliers times one number that makes all entries whole."""
    scale = lcm(*(int(v.q) for Z_i in Z.values() for v in Z_i.entries()))
    return {i: tuple(tuple(int((v * scale).p) for v in row) for row in Z_i.tolist()) for i, Z_i in Z.items()}


def _symmetric(upper: Sequence[Any], n: int) -> Rational:
    """Return the symmetric matrix with this upper triangle, row by row."""
    import flint

    X, entries = flint.fmpq_mat(n, n), iter(upper)
    for j in range(n):
        for k in range(j, n):
            X[j, k] = X[k, j] = next(entries)
    return X


def _sum(terms: Sequence[Rational]) -> Rational:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def _column(entries: Sequence[Any]) -> Rational:
    import flint

    return flint.fmpq_mat(len(entries), 1, list(entries))


def _outer(pairs: Sequence[tuple[Sequence[Any], Sequence[Any]]]) -> Rational:
    """Return the sum of x yᵀ."""
    return _sum([_column(x) * _column(y).transpose() for x, y in pairs])
