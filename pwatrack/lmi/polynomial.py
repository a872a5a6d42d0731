"""Polynomials that decay along every switching: sought where no quadratic form does, and proved exactly.

V = mᵀ P m, with m the monomials of degree d of z = T e, takes the place of a common P: what that needs and proves is in
`docs/theory/beyond.md`, *Polynomials in place of a common P*. For d = 1 these are the inequalities of the paper.

Along e' = A e the monomials e^a obey m' = 𝒜 m with 𝒜[a, a − ε_j + ε_k] = Σ a_j A_jk: the lift 𝒜 is linear in A, and
its coefficients are whole numbers, none negative. mᵀ N m is 0 for all e where the entries N_ab with the same a + b add
up to 0, and only there. Counted in weights w_a = √(d! / a!) the monomials w_a e^a have |m|² = |e|^2d, and the lift of a
rotation is one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations_with_replacement
from math import comb, factorial, prod
from typing import Any

import flint
import numpy as np
from scipy import sparse
from scipy.linalg import eigh

from pwatrack.arrays import Array, IntArray, symmetric_part
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.bisection import bisected
from pwatrack.lmi.cone_program import symmetric_of, upper
from pwatrack.lmi.exact import BITS, Certificate, Packed, Proof, Whole, left_side, prove_exactly, proved_rate, whole
from pwatrack.lmi.inequality import Role
from pwatrack.lmi.presolve import Coordinates
from pwatrack.lmi.solve import semidefinite
from pwatrack.rational import Rational, is_positive_definite

Exponents = tuple[int, ...]
DEGREES = (4, 6, 8, 10)  # that are tried
MOST_ROWS = 1200  # of a program: one takes half a second then, its time grows as their cube
TRIALS = 8  # rates that are tried
_ENCLOSED = 1 / 99  # of the best rate: where one that is out of reach is that near, the search ends
_DIGITS = 12  # binary, of the coordinates


@dataclass(frozen=True)
class Monomials:
    """Those of degree d in n variables, e_1^d first, in falling order of their exponents."""

    n: int
    d: int

    @staticmethod
    @cache
    def of(n: int, d: int) -> "Monomials":
        """Return them; equal ones are one object."""
        return Monomials(n, d)

    def __len__(self) -> int:
        """Return N."""
        return comb(self.n + self.d - 1, self.d)

    @cached_property
    def exponents(self) -> tuple[Exponents, ...]:
        """Those of each monomial."""
        chosen = combinations_with_replacement(range(self.n), self.d)
        return tuple(tuple(some.count(j) for j in range(self.n)) for some in chosen)

    @cached_property
    def squares(self) -> tuple[int, ...]:
        """The squares of the weights, d! / a!: Σ w_a² e^2a = |e|^2d."""
        return tuple(factorial(self.d) // prod(map(factorial, a)) for a in self.exponents)

    @cached_property
    def weights(self) -> Array:
        """The weights, (N,)."""
        return np.sqrt(np.array(self.squares, dtype=np.float64))

    @cached_property
    def _moves(self) -> IntArray:
        """Rows (a, b, j, k, a_j): the lift has a_j A_jk in its entry (a, b), beside what else is there."""
        at = {a: place for place, a in enumerate(self.exponents)}
        unit = np.eye(self.n, dtype=np.int64)
        rows = [
            (at[a], at[tuple((a - unit[j] + unit[k]).tolist())], j, k, a[j])
            for a in self.exponents
            for j, k in np.ndindex(self.n, self.n)
            if a[j]
        ]
        return np.array(rows, dtype=np.int64).reshape(-1, 5)

    def lift(self, A: Array) -> Array:
        """Return the lifts of A (l, n, n) for the monomials in weights, (l, N, N)."""
        rows, columns, j, k, times = self._moves.T
        lifts = np.zeros((len(self), len(self), len(A)))
        np.add.at(lifts, (rows, columns), times[:, None] * A[:, j, k].T)
        return np.asarray(lifts.transpose(2, 0, 1) * self.weights[:, None] / self.weights)

    def exactly(self, A: BallMatrix) -> BallMatrix:
        """Return the lift of an exact matrix for the monomials e^a, with all lifts of what is in its ball."""
        return BallMatrix(self._lifted(A.centre), None if A.radius is None else self._lifted(A.radius))

    def _lifted(self, A: Rational) -> Rational:
        found = flint.fmpq_mat(len(self), len(self))
        for row, column, j, k, times in self._moves.tolist():
            found[row, column] += times * A[j, k]
        return found

    def of_points(self, z: Array) -> Array:
        """Return the monomials in weights at points (s, n), (s, N); those of h, z are such that (h z)^d = h_m z_m."""
        return np.asarray(np.prod(z[:, None, :] ** np.array(self.exponents), axis=2) * self.weights)

    def power(self, h: Sequence[Any]) -> list[Any]:
        """Return the coefficients of (h z)^d, of the monomials z^a, for a row of numbers of any kind."""
        return [
            times * prod(v**k for v, k in zip(h, a, strict=True))
            for times, a in zip(self.squares, self.exponents, strict=True)
        ]

    def substituted(self, X: Sequence[Sequence[Any]]) -> list[list[Any]]:
        """Return S with m(X v) = S m(v), of the monomials z^a and v^b, for X (n, k) of numbers of any kind."""
        others = Monomials.of(len(X[0]), self.d)
        found = []
        for a in self.exponents:
            product: dict[Exponents, Any] = {(0,) * others.n: 1}
            for row in [row for row, times in zip(X, a, strict=True) for _ in range(times)]:
                product = _times(product, row)
            found.append([product.get(b, 0) for b in others.exponents])
        return found

    @cached_property
    def products(self) -> Mapping[Exponents, tuple[tuple[int, int], ...]]:
        """The pairs (a, b), a ≤ b, of monomials with each product."""
        found: dict[Exponents, list[tuple[int, int]]] = {}
        for j, a in enumerate(self.exponents):
            for k, b in enumerate(self.exponents[j:], j):
                found.setdefault(tuple(s + t for s, t in zip(a, b, strict=True)), []).append((j, k))
        return {product: tuple(pairs) for product, pairs in found.items()}

    @cached_property
    def nothing(self) -> sparse.csc_matrix:
        """Orthonormal columns that span all N with mᵀ N m = 0, m in weights, each as `upper` has it."""
        columns = list[tuple[Array, list[int]]]()
        for pairs in self.products.values():
            v = np.array([self.weights[j] * self.weights[k] * (1.0 if j == k else np.sqrt(2.0)) for j, k in pairs])
            basis = np.linalg.qr(np.column_stack([v, np.eye(len(pairs))[:, 1:]]))[0][:, 1:]
            columns += [(column, [k * (k + 1) // 2 + j for j, k in pairs]) for column in basis.T]
        entries = np.concatenate([np.zeros(0), *(column for column, _ in columns)])
        rows = [row for _, places in columns for row in places]
        ends = np.cumsum([0, *(len(places) for _, places in columns)])
        return sparse.csc_matrix((entries, rows, ends), shape=(len(self) * (len(self) + 1) // 2, len(columns)))


def _times(polynomial: Mapping[Exponents, Any], row: Sequence[Any]) -> dict[Exponents, Any]:
    found: dict[Exponents, Any] = {}
    for a, value in polynomial.items():
        for k, factor in enumerate(row):
            b = (*a[:k], a[k] + 1, *a[k + 1 :])
            found[b] = found.get(b, 0) + value * factor
    return found


@dataclass(frozen=True, kw_only=True)
class PolynomialLyapunov:
    """P and N_i in floating point, for the monomials in weights of z = T e."""

    A: Array  # the matrices by which errors change, (l, n, n)
    degree: int  # 2 d
    T: Array  # (n, n), of short binary numbers
    P: Array  # (N, N)
    N: Array  # one for each matrix, (l, N, N)
    rate: float  # α in 1/s that they show, positive

    @property
    def monomials(self) -> Monomials:
        """Those of half the degree."""
        return Monomials.of(len(self.T), self.degree // 2)


def degrees(n: int, cells: int, most_rows: int = MOST_ROWS) -> tuple[int, ...]:
    """Return the degrees that are tried for so many different matrices of order n: those of programs small enough."""
    orders = {degree: len(Monomials.of(n, degree // 2)) for degree in DEGREES if n > 1}
    return tuple(degree for degree, N in orders.items() if (cells + 2) * N * (N + 1) // 2 <= most_rows)


def best_polynomial(A: Array, degree: int, near: Coordinates, *, trials: int = TRIALS) -> PolynomialLyapunov | None:
    """Look for a polynomial of one degree with the largest rate.

    The matrices A (l, n, n), by which errors change, are each different and each stable by itself. In the coordinates
    `near` the P of M_i P + P M_iᵀ ≺ 0 for M_i = A_iᵀ is near I. So many rates are tried; the first of them is 0.
    """
    T = short(near.T.T)
    with np.errstate(all="ignore"):
        G = T @ A @ np.linalg.inv(T)
    speed = float(np.linalg.norm(G, 2, axis=(1, 2)).max()) if np.isfinite(G).all() else 0.0
    if not 0 < speed < np.inf:
        return None
    sought = _Sought(G / speed, Monomials.of(A.shape[1], degree // 2))
    fast, first = -float(np.linalg.eigvals(A).real.max()) / speed, sought.at(0.0)
    if first is None:
        return None
    rate, (P, N), _ = bisected(first, fast, sought.at, near=_ENCLOSED, most=trials - 1)
    return PolynomialLyapunov(A=A, degree=degree, T=T, P=P, N=N * speed, rate=rate * speed)


def short(X: Array) -> Array:
    """Return a matrix with entries of few binary digits."""
    fraction, exponent = np.frexp(X)
    return np.asarray(np.ldexp(np.round(np.ldexp(fraction, _DIGITS)), exponent - _DIGITS))


class _Sought:
    """The programs of one degree: the largest t with −sym(P 𝒜_i) − N_i − 2 d α P ⪰ t I, t I ⪯ P ⪯ I, for rates α."""

    def __init__(self, A: Array, monomials: Monomials) -> None:
        self.d, self.order = monomials.d, len(monomials)
        self.lifts = monomials.lift(A)
        self.nothing = monomials.nothing.toarray()
        self.size = self.order * (self.order + 1) // 2
        self.one = upper(np.eye(self.order)[None])[0]
        basis = symmetric_of(np.eye(self.size), self.order)
        self.maps = [upper(symmetric_part(basis @ lift)).T for lift in self.lifts]
        self.of_P = upper(symmetric_part(basis)).T  # of sym(P), 2 P

    def at(self, rate: float) -> tuple[float, tuple[Array, Array]] | None:
        """Return the rate that is shown, at least this one, with P and N_i that do; None if none is found."""
        cells, free = np.eye(len(self.lifts)), self.nothing.shape[1]
        one, eye, none = self.one[:, None], np.eye(self.size), np.zeros((self.size, len(cells) * free))
        blocks = [(np.hstack([one, -eye, none]), 0 * self.one), (np.hstack([0 * one, eye, none]), self.one)]
        for of_P, unit in zip(self.maps, cells, strict=True):
            falls = np.hstack([one, of_P + self.d * rate * self.of_P, np.kron(unit, self.nothing)])
            blocks.append((falls, 0 * self.one))
        x = semidefinite(-np.eye(1, 1 + self.size + len(cells) * free)[0], blocks)
        if x is None:
            return None
        P = symmetric_of(x[1 : 1 + self.size], self.order)
        y = x[1 + self.size :].reshape(len(cells), free)
        N = symmetric_of((self.nothing @ y.T).T, self.order)
        return self._shown(P, N, rate)

    def _shown(self, P: Array, N: Array, rate: float) -> tuple[float, tuple[Array, Array]] | None:
        """Return them with the largest rate for which all slacks are definite, if it is above the one given."""
        left = symmetric_part(P @ self.lifts) + N
        if not np.isfinite(left).all():
            return None
        try:
            shown = min(-float(eigh(side, P, eigvals_only=True)[-1]) for side in left) / (2 * self.d)
        except np.linalg.LinAlgError:  # P is not positive definite to working precision
            return None
        return (shown, (P, N)) if shown > rate else None


@dataclass(frozen=True, kw_only=True)
class PolynomialProof(Packed):
    """P ≻ 0 and −sym(P 𝒜_i) − N_i − 2 d rate P ≻ 0 for every i, proved exactly: see `polynomial`.

    𝒜_i is the lift of T A_i T⁻¹ on the monomials of degree d, A_i the matrix by which errors change. Where it has
    irrational entries, for every matrix in its ball.
    """

    role: Role  # which inequality it takes the place of
    degree: int  # 2 d
    T: Array  # (n, n): the decimals that it prints as
    N: tuple[Whole, ...]  # the integers of N_i, one for each different A_i
    N_exponents: tuple[int, ...]  # those of N_i
    rate: float  # certified decay rate of errors in 1/s, a short decimal

    @property
    def order(self) -> int:
        """That of the matrices it speaks of."""
        return len(self.T)

    @property
    def monomials(self) -> Monomials:
        """Those of half the degree."""
        return Monomials.of(len(self.T), self.degree // 2)


AnyProof = Proof | PolynomialProof
Found = Certificate | PolynomialLyapunov


def exactly(role: Role, M: Sequence[BallMatrix], found: Found) -> AnyProof | None:
    """Prove for rounded numbers what was found in floating point of these M_i, each different; or return None."""
    if isinstance(found, PolynomialLyapunov):
        return prove_polynomial(role, M, found)
    return prove_exactly(role, M, found.P if found.precise is None else found.precise, found.rate)


def prove_polynomial(role: Role, M: Sequence[BallMatrix], found: PolynomialLyapunov) -> PolynomialProof | None:
    """Round P, N_i and the rate to short numbers and prove the inequality of these M_i for them, or return None.

    What was found is of the matrices nearest to these, each different.
    """
    monomials, T = found.monomials, BallMatrix.of(found.T)
    weights = monomials.weights
    short = Packed.of(found.P * weights[:, None] * weights)
    at = {A_i.tobytes(): k for k, A_i in enumerate(found.A + 0.0)}
    places = [at.get((role.oriented(M_i.floats) + 0.0).tobytes(), -1) for M_i in M]
    if -1 in places or not is_positive_definite(short.P):
        return None
    N, N_exponents = _rounded(found.N[places] * weights[:, None] * weights, short.exponents, monomials)
    left = list[Rational]()
    for M_i, N_i in zip(M, N, strict=True):
        lift = monomials.exactly(T @ role.exact(M_i) @ T.inverse())
        left.append(left_side(lift.transpose(), short) - Packed(integers=N_i, exponents=N_exponents).P)
    rate = proved_rate(left, short.P, found.degree, found.rate)
    if rate is None:
        return None
    return PolynomialProof(
        role=role, degree=found.degree, T=found.T, N=N, N_exponents=N_exponents, rate=rate, **short.parts
    )


def _rounded(N: Array, exponents: Sequence[int], monomials: Monomials) -> tuple[tuple[Whole, ...], tuple[int, ...]]:
    """Return whole numbers near N_i (l, N, N), scaled by powers of two, with mᵀ N_i m = 0 exactly.

    Of the entries that are to add up to 0 the finest one is what the others leave. Entries on the diagonal are even,
    as those beside it count twice.
    """
    scale = np.exp2(-np.asarray(exponents, dtype=np.float64))
    size = float(np.abs(N * scale[:, None] * scale).max(initial=0.0))
    shift = round(np.log2(size) / 2) - BITS // 2 if size else 0
    powers = tuple(e + shift for e in exponents)
    return tuple(_vanishing(whole(N_i, powers), powers, monomials) for N_i in N), powers


def _vanishing(rows: Whole, powers: Sequence[int], monomials: Monomials) -> Whole:
    """Return whole numbers changed as little as it takes that mᵀ N m = 0."""
    N = [list(row) for row in rows]
    for pairs in monomials.products.values():
        j, k = min(pairs, key=lambda p: powers[p[0]] + powers[p[1]])
        rest = 0
        for a, b in pairs:
            if a == b:
                N[a][a] = 2 * round(N[a][a] / 2)
            if (a, b) != (j, k):
                rest += (1 + (a != b)) * N[a][b] << (powers[a] + powers[b] - powers[j] - powers[k])
        N[j][k] = N[k][j] = -rest if j == k else -rest // 2
    return tuple(tuple(row) for row in N)
