"""Modes that no gain moves and that do not decay: of one cell, with a multiplier, or of a mean of cells.

Why each of these speaks against all gains is in `docs/theory/proofs.md`, *Where there is no solution*. A mode of one
cell is refuted in exact numbers. Of a mean of cells v, μ ≥ 0 and w_i ≥ 0 with vᵀ B = 0, vᵀ Σ w_i A_i = μ vᵀ and
Σ w_i = 1 are hardly ever fractions: that there are some is proved by Newton's method in fractions.

They are the root of n equations in n unknowns where there is one more cell than B has independent columns: with the
rows of N all that are 0 on B, v = Nᵀ z, one entry of z 1 and x the others, μ and all w but the last, it is

    F(x) = (Σ w_i A_i − μ I)ᵀ Nᵀ z = 0,      F(x + d) = F(x) + J d + Q(d),

Q of second order, |Q(d)| ≤ q r² where |d_k| ≤ r. So with any C the map d ↦ d − C F(x + d) takes |d_k| ≤ r into itself
where |C F(x)| + |I − C J| r + |C| q r² ≤ r in every row: there it has a fixed point (Brouwer), C F(x + d) = 0. With
‖I − C J‖ < 1, C is invertible: there is a root within r of x, and that μ ≥ 0 and w ≥ 0 there is seen from x and r.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations, islice
from typing import Any

import flint
import numpy as np
from scipy.linalg import eig, orth, solve_continuous_lyapunov

from pwatrack.arrays import Array
from pwatrack.ball_matrix import absolute, text, texts
from pwatrack.lmi.multipliers import refutes, rounded
from pwatrack.lmi.presolve import Coordinates
from pwatrack.rational import (
    Rational,
    beside,
    decimals,
    floats,
    fraction_of,
    identity,
    is_hurwitz,
    is_positive_definite,
    is_positive_semidefinite,
    left_null_space,
    lyapunov_map,
    on_rows,
    symmetric,
    unreachable,
)

_MOST = 400  # sets of neighbours that are looked at
_RANK_ONE = 1e-9  # of the largest entry: two cells that differ by more than a product g hᵀ by this are no neighbours
_REAL = 1e-6  # of an eigenvalue: an imaginary part that rounding may make of a double one
_STEPS = 12  # of Newton's method at most
_BITS = 160  # behind the point


def uncontrollable_modes(A: Sequence[Rational], B: Rational) -> tuple[dict[int, Rational], dict[int, complex]]:
    """Return a multiplier for a cell with a mode that does not decay and B does not reach, and all such eigenvalues."""
    eigenvalues, found = dict[int, complex](), dict[int, Rational]()
    for i, A_i in enumerate(A):
        N, A_u = unreachable(A_i, B)
        if is_hurwitz(A_u):
            continue
        values = np.linalg.eigvals(floats(A_u))
        eigenvalues[i] = complex(values[np.argmax(values.real)])
        if not found:
            Z = {i: N.transpose() * _instability(A_u) * N}
            found = Z if refutes(A, B, Z) else {}
    return found, eigenvalues


def _instability(M: Rational) -> Rational:
    """Return a symmetric Z, not ⪯ 0, with Z M + Mᵀ Z ⪰ 0, for a matrix that is not Hurwitz.

    If no two eigenvalues (or one twice) add up to 0, Z M + Mᵀ Z = I has a solution, and by the inertia
    theorem it has a positive eigenvalue for each one of M in the right half plane. If two do,
    Z M + Mᵀ Z = 0 has solutions that are not 0, on the invariant subspace of those
    eigenvalues; Z or −Z is then not ⪯ 0.
    """
    n = M.nrows()
    N = symmetric_part_of_spectrum(M)
    if N.nrows():
        M = on_rows(M, N)
        kernel = left_null_space(lyapunov_map(M).transpose())
        Z = symmetric(kernel.tolist()[0], M.nrows())
        Z = N.transpose() * Z * N
        return -Z if is_positive_semidefinite(-Z) else Z
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nearly singular: then the exact solution decides
        close = solve_continuous_lyapunov(floats(M).T, np.eye(n)).astype(np.float64)
    if np.isfinite(close).all():
        Z = rounded(close)
        if is_positive_definite(Z * M + (Z * M).transpose()):
            return Z
    rows, columns = np.triu_indices(n)
    right = decimals((rows == columns).astype(float)[:, None])
    return symmetric(lyapunov_map(M).solve(right).entries(), n)


def symmetric_part_of_spectrum(M: Rational) -> Rational:
    """Return rows that span the left invariant subspace of the eigenvalues λ of M for which −λ is one too."""
    falling = M.charpoly()
    mirrored = flint.fmpq_poly([c * (-1) ** k for k, c in enumerate(falling.coeffs())])
    common = falling.gcd(mirrored)
    if common.degree() < 1:
        return decimals(np.zeros((0, M.nrows())))
    power = decimals(np.zeros((M.nrows(), M.nrows())))
    for c in reversed(common.coeffs()):
        power = power * M + c * identity(M.nrows())
    return left_null_space(power)


@dataclass(frozen=True, kw_only=True)
class Between:
    """Proof that a mean of cells has a mode that no gain moves and that does not decay."""

    weights: Mapping[int, Fraction]  # w_i by cell, to within (k − 1) times the radius for k cells; they add up to 1
    rows: tuple[tuple[Fraction, ...], ...]  # N (k, n), of full rank, N B = 0
    mode: tuple[Fraction, ...]  # z, its entries to within the radius but for one that is 1
    eigenvalue: Fraction  # μ, likewise; with the rate that was asked added to A
    inverse: Array  # C (n, n)
    radius: Fraction  # r

    @property
    def content(self) -> dict[str, Any]:
        """The proof as it stands in a file."""
        return {
            "between": {str(i): text(share) for i, share in self.weights.items()},
            "rows": [list(map(text, row)) for row in self.rows],
            "mode": list(map(text, self.mode)),
            "eigenvalue": text(self.eigenvalue),
            "inverse": texts(decimals(self.inverse)),
            "radius": text(self.radius),
        }

    @property
    def v(self) -> Array:
        """The mode as a row (n,) of floats: v = Nᵀ z."""
        rows = np.array([[float(a) for a in row] for row in self.rows])
        return np.asarray(np.array([float(a) for a in self.mode]) @ rows)


def uncontrollable_mean(A: Array, B: Array, exact_A: Sequence[Rational], exact_B: Rational) -> Between | None:
    """Return a mean of cells with a mode that does not decay and that B does not reach, if there is one.

    It is looked for among cells each of which differs from a first one by a product g hᵀ, as those on both sides of a
    facet do: as many as B has independent columns.
    """
    proofs = (_proved(guess, exact_A, exact_B) for guess in _guesses(A, B))
    return next((found for found in proofs if found is not None), None)


def seems_uncontrollable(A: Array, B: Array) -> bool:
    """Say whether floating point sees such a mean of cells."""
    return next(_guesses(A, B), None) is not None


_Guess = tuple[list[int], Array, float, Array, Coordinates]  # cells, w, μ, and v (n,) where A and B have size 1


def _guesses(A: Array, B: Array) -> Iterator[_Guess]:
    """Yield what floating point sees.

    With A_j = A_i + g_j h_jᵀ, j = 1, …, the w_j v with vᵀ (A_i + Σ w_j g_j h_jᵀ) = μ vᵀ, vᵀ B = 0 are the left null
    vectors (v, c), c_j = w_j vᵀ g_j, of [A_i − μ I, B; H, 0]: μ is a zero of what the input does to the forms h_jᵀ x.
    """
    at = Coordinates.balanced(A, B)
    M, E, n = at.system(A), orth(at.input(B)), A.shape[1]
    rank = E.shape[1]
    if not 0 < rank < min(len(M), n):
        return
    mass = np.diag(np.repeat([1.0, 0.0], [n, rank]))
    sets = ((i, some) for i in range(len(M)) for some in combinations(_neighbours(M, i, everywhere=rank > 1), rank))
    for i, some in islice(sets, _MOST):
        G, H = np.array([g for _, g, _ in some]).T, np.array([h for *_, h in some])
        values, left = eig(np.block([[M[i], E], [H, np.zeros((rank, rank))]]), mass, left=True, right=False)
        with np.errstate(all="ignore"):
            grows = np.isfinite(values) & (values.real >= 0) & (np.abs(values.imag) <= _REAL * np.abs(values))
        for mu, y in zip(values.real[grows], left.real[:, grows].T, strict=True):
            with np.errstate(all="ignore"):
                w = y[n:] / (y[:n] @ G)
            if (w > 0).all() and w.sum() < 1:
                weights = np.array([1 - w.sum(), *w])
                yield [i, *(j for j, _, _ in some)], weights, float(mu) * at.speed, y[:n], at


def _neighbours(M: Array, i: int, *, everywhere: bool) -> Iterator[tuple[int, Array, Array]]:
    """Yield cells j with M_j = M_i + g hᵀ, after cell i or everywhere, with g and h."""
    first, n = 0 if everywhere else i + 1, M.shape[1]
    D = M[first:] - M[i]
    entry = np.abs(D).reshape(len(D), n * n).argmax(axis=1)
    p, q, each = entry // n, entry % n, np.arange(len(D))
    pivot = D[each, p, q]
    g, h = D[each, :, q], D[each, p] / np.where(pivot, pivot, 1.0)[:, None]
    off = np.abs(D - g[:, :, None] * h[:, None]).max(axis=(1, 2), initial=0.0)
    for k in np.flatnonzero((pivot != 0) & (off <= _RANK_ONE * np.abs(pivot))):
        yield first + int(k), g[k], h[k]


def _proved(guess: _Guess, exact_A: Sequence[Rational], exact_B: Rational) -> Between | None:
    cells, w, mu, v, at = guess
    A, last, inverse_T = [exact_A[i] for i in cells], len(cells) - 1, decimals(at.inverse)
    N = left_null_space(inverse_T * exact_B)
    z, N, rows = np.linalg.lstsq(floats(N).T, v, rcond=None)[0], N * inverse_T, np.diag(at.T) / at.speed
    one = int(np.abs(z).argmax())
    z, rest = z / z[one], [s for s in range(len(z)) if s != one]
    changes = [(A_i - A[last]).transpose() * N.transpose() for A_i in A[:last]]
    grown = [sum((abs(X[j, s]) for X in (N.transpose(), *changes) for s in rest), flint.fmpq(0)) for j in range(len(v))]
    q = flint.fmpq_mat(len(v), 1, grown)
    x = decimals(np.array([*z[rest], mu, *w[:last]])[:, None])
    for _ in range(_STEPS):
        entries = x.entries()
        z_x = flint.fmpq_mat(len(z), 1, [*entries[:one], flint.fmpq(1), *entries[one : len(rest)]])
        mean = sum((X * share for X, share in zip(changes, entries[len(rest) + 1 :], strict=True)), 0 * changes[0])
        M = mean + A[last].transpose() * N.transpose() - N.transpose() * entries[len(rest)]
        free = [flint.fmpq_mat(len(v), 1, [M[j, s] for j in range(len(v))]) for s in rest]
        J = beside([*free, -N.transpose() * z_x, *(X * z_x for X in changes)])
        try:
            inverse = np.asarray(np.linalg.inv(floats(J) * rows[:, None]) * rows, dtype=np.float64)
        except (np.linalg.LinAlgError, OverflowError):
            return None
        if not np.isfinite(inverse).all():
            return None
        C = decimals(inverse)
        step = C * M * z_x
        r = _radius(step)
        weights = [*entries[len(rest) + 1 :], 1 - sum(entries[len(rest) + 1 :], flint.fmpq(0))]
        if entries[len(rest)] >= r and min(weights) >= last * r and _stays(C, J, q, step, r):
            return Between(
                weights={i: fraction_of(share) for i, share in zip(cells, weights, strict=True)},
                rows=tuple(tuple(map(fraction_of, row)) for row in N.tolist()),
                mode=tuple(map(fraction_of, z_x.entries())),
                eigenvalue=fraction_of(entries[len(rest)]),
                inverse=inverse,
                radius=fraction_of(r),
            )
        short = [flint.fmpq(round(fraction_of(e) * 2**_BITS), 2**_BITS) for e in (x - step).entries()]
        x = flint.fmpq_mat(len(v), 1, short)
    return None


def _stays(C: Rational, J: Rational, q: Rational, step: Rational, r: Rational) -> bool:
    """Say whether |C F| + |I − C J| r + |C| q r² ≤ r in every row, and ‖I − C J‖ < 1."""
    n = C.nrows()
    off, curved = absolute(identity(n) - C * J), absolute(C) * q
    sums = [sum((off[j, k] for k in range(n)), flint.fmpq(0)) for j in range(n)]
    return all(sums[j] < 1 and abs(step[j, 0]) + sums[j] * r + curved[j, 0] * r * r <= r for j in range(n))


def _radius(step: Rational) -> Rational:
    """Return a power of two that is at least twice as large as a step, and not smaller than what is rounded."""
    largest = 2 * max(abs(v) for v in step.entries())
    exponent = int(largest.p).bit_length() - int(largest.q).bit_length() + 1
    return flint.fmpq(2) ** (max(exponent, -_BITS) if largest else -_BITS)
