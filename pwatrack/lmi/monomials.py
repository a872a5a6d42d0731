"""The monomials of one degree, and what a linear system does to them.

For e ∈ ℝⁿ let m(e) hold the N = C(n + d − 1, d) monomials e^a of degree d. Along e' = A e they obey m' = 𝒜 m with
𝒜[a, a − ε_j + ε_k] = Σ a_j A_jk: the lift 𝒜 is linear in A, and its coefficients are whole numbers, none negative. A
polynomial of degree 2d is mᵀ X m for many X: mᵀ N m is 0 for all e where the entries N_ab with the same a + b add up to
0, and only there.

Counted in weights w_a = √(d! / a!) the monomials w_a e^a have |m|² = |e|^2d, and the lift of a rotation is one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from math import comb, factorial, prod

import flint
import numpy as np
from scipy import sparse

from pwatrack.arrays import Array, IntArray
from pwatrack.ball_matrix import BallMatrix
from pwatrack.rational import Rational

Exponents = tuple[int, ...]


@dataclass(frozen=True)
class Monomials:
    """Those of degree d in n variables, e_1^d first, in falling order of their exponents.

    Example: along e' = −e every product of two entries falls as e^(−2t).

        >>> two = Monomials.of(2, 2)
        >>> two.exponents, two.lift(-np.eye(2)[None]).tolist()
        (((2, 0), (1, 1), (0, 2)), [[[-2.0, 0.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, -2.0]]])
    """

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
        return tuple(_exponents(self.n, self.d))

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
        rows = [
            (at[a], at[_moved(a, j, k)], j, k, a[j])
            for a in self.exponents
            for j in range(self.n)
            for k in range(self.n)
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
        place, columns = upper_place(len(self)), list[tuple[Array, list[int]]]()
        for pairs in self.products.values():
            v = np.array([self.weights[j] * self.weights[k] * (1.0 if j == k else np.sqrt(2.0)) for j, k in pairs])
            basis = np.linalg.qr(np.column_stack([v, np.eye(len(pairs))[:, 1:]]))[0][:, 1:]
            columns += [(column, [place[pair] for pair in pairs]) for column in basis.T]
        entries = np.concatenate([np.zeros(0), *(column for column, _ in columns)])
        rows = [row for _, places in columns for row in places]
        ends = np.cumsum([0, *(len(places) for _, places in columns)])
        return sparse.csc_matrix((entries, rows, ends), shape=(len(place), len(columns)))


def upper(X: Array) -> Array:
    """Return the upper triangles of symmetric matrices (l, N, N), column by column, what is off the diagonal times √2.

    Example:
        >>> upper(np.array([[[1.0, 0.0], [0.0, 4.0]]])).tolist()
        [[1.0, 0.0, 4.0]]
    """
    column, row = np.tril_indices(X.shape[-1])
    return np.asarray(X[..., row, column] * np.where(row == column, 1.0, np.sqrt(2.0)))


def symmetric_of(x: Array, N: int) -> Array:
    """Return the symmetric matrices (l, N, N) with these upper triangles (l, N (N + 1) / 2)."""
    column, row = np.tril_indices(N)
    X = np.zeros((*x.shape[:-1], N, N))
    X[..., row, column] = X[..., column, row] = x / np.where(row == column, 1.0, np.sqrt(2.0))
    return X


def upper_place(N: int) -> dict[tuple[int, int], int]:
    """Return where `upper` has the entry (j, k), j ≤ k."""
    return {(j, k): k * (k + 1) // 2 + j for k in range(N) for j in range(k + 1)}


def _exponents(n: int, d: int) -> list[Exponents]:
    if n <= 1:
        return [(d,) * n]
    return [(k, *rest) for k in range(d, -1, -1) for rest in _exponents(n - 1, d - k)]


def _moved(a: Exponents, j: int, k: int) -> Exponents:
    """Return a − ε_j + ε_k."""
    moved = list(a)
    moved[j] -= 1
    moved[k] += 1
    return tuple(moved)
