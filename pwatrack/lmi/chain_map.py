"""Inequalities in several symmetric matrices, each in few of them, as a linear map: by the form of their terms.

The left-hand side of inequality j is Σ_k (L_jk P_k R_jk + R_jkᵀ P_k L_jkᵀ) + Σ_l τ_jl S_jl + t T_j, τ_jl some of a few
numbers. With W_j of a step, the part of the normal equations for P_k and P_k' is that of `linear_map`: with
X = R W L', X' = R' W L, V = R W R'ᵀ and U = L'ᵀ W L

    2 Σ_j tr(P X P' X') + tr(P V P' U),

one product for all inequalities that have both, and nothing for matrices that no inequality has together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.lmi.blocks import Blocks
from pwatrack.lmi.linear_map import LinearMap, Triangle
from pwatrack.lmi.normal import ChainNormal, Normal

_CHAIN = 4, 360  # matrices, and entries of all, from which on it is quicker to eliminate one after the other

Term = tuple[Array, Array]  # L (N, n) and R (n, N)


@dataclass(frozen=True)
class Bound:
    """Σ_k (L_k P_k R_k + R_kᵀ P_k L_kᵀ) + Σ_l τ_l S_l + t T + C ⪯ 0, of order N."""

    terms: Mapping[int, Term]
    T: Array
    C: Array | None = None
    places: Sequence[int] = ()  # of the τ_l among all
    S: Array | None = None  # (l, N, N)


def square(X: Array, sign: float = 1.0) -> Term:
    """Return the term Xᵀ P X, with a sign."""
    return sign / 2 * X.T, X


def shrinks(before: int, after: int, J: Array, more: Array, on: Array | None = None) -> Bound:
    """Return Xᵀ (Jᵀ P_after J − P_before + t more) X ⪯ 0, with X what is looked at, all if that is not said."""
    X = np.eye(len(J)) if on is None else on
    left = X.T @ J.T
    return Bound({before: square(X, -1.0), after: (left / 2, left.T)}, X.T @ more @ X)


def _filled(parts: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Return arrays as parts of zeros of one shape."""
    found = np.zeros((len(parts), *shape))
    for whole, X in zip(found, parts, strict=True):
        whole[tuple(map(slice, X.shape))] = X
    return found


class ChainMap(LinearMap):
    """A `LinearMap` of which a vector holds the lower triangles of P_0, P_1, …, the τ, then t.

    Asked for is the largest t, where tr P_0 = n unless there is a C; or, with a weight, the least tr W Σ P_k, t = 1.
    """

    def __init__(self, bounds: Sequence[Bound], count: int, weight: Array | None = None, scalars: int = 0) -> None:
        n = next(R.shape[0] for _, R in bounds[0].terms.values())
        free, N = all(bound.C is None or not bound.C.any() for bound in bounds), max(len(bound.T) for bound in bounds)
        self.P, self.count, self.T = Triangle(n), count, _filled([bound.T for bound in bounds], (N, N))
        self.first = count * self.P.size
        self.size = self.main = self.first + scalars + 1
        self.blocks = Blocks([(1, len(bound.T)) for bound in bounds], padded=True)  # by constraints 0 ≤ 1
        constants = [0 * bound.T if bound.C is None else bound.C for bound in bounds]
        self.constant = self.blocks.of([C[None] for C in constants], beside=-1.0)
        self.rows = np.zeros((1, self.size))
        if weight is None:
            self.cost, self.values = np.append(np.zeros(self.size - 1), -1.0), np.array([float(n)])
            self.rows[0, : self.P.size] = self.P.row(np.eye(n))
            if not free:
                self.rows, self.values = self.rows[:0], self.values[:0]
        else:
            nothing = np.zeros(scalars + 1)
            self.cost, self.values = np.append(np.tile(self.P.row(weight), count), nothing), np.ones(1)
            self.rows[0, -1] = 1.0
        self.places = [slice(k * self.P.size, (k + 1) * self.P.size) for k in range(count)]
        self.of = list[tuple[IntArray, Array, Array]]()  # which inequalities have a matrix, L and R of each
        for k in range(count):
            at = [j for j, bound in enumerate(bounds) if k in bound.terms]
            L, R = (_filled([bounds[j].terms[k][side] for j in at], ((N, n), (n, N))[side]) for side in (0, 1))
            self.of.append((np.array(at), L, R))
        having = [(j, bound) for j, bound in enumerate(bounds) if bound.S is not None and len(bound.places)]
        some = len(having[0][1].places) if having else 0
        self.having = np.array([j for j, _ in having], dtype=np.int64)  # which have some of the τ: as many each
        places = np.array([bound.places for _, bound in having], dtype=np.int64).reshape(len(having), some)
        self.which = self.first + places
        self.S = _filled([bound.S for _, bound in having if bound.S is not None], (some, N, N))

    @cached_property
    def both(self) -> list[Array]:
        """L and Rᵀ of each matrix side by side."""
        return [np.concatenate([L, R.transpose(0, 2, 1)], axis=2) for _, L, R in self.of]

    @cached_property
    def pairs(self) -> list[tuple[int, int, IntArray, IntArray]]:
        """Matrices k ≥ k' that some inequalities have together, and where these stand in the parts of both."""
        found = []
        for k in range(self.count):
            for other in range(k + 1):
                _, one, two = np.intersect1d(self.of[k][0], self.of[other][0], return_indices=True)
                if len(one):
                    found.append((k, other, one, two))
        return found

    def matrices(self, v: Array) -> Array:
        """Return the P_k of a vector."""
        return np.array([self.P.matrix(v[place]) for place in self.places])

    def scalars(self, v: Array) -> Array:
        """Return the τ of a vector."""
        return v[self.first : -1]

    def vector(self, P: Array, T: Array, t: float) -> Array:
        """Return the vector of the P_k, the τ and t."""
        return np.concatenate([*map(self.P.of, P), T.ravel(), [t]])

    def apply(self, v: Array) -> Array:
        x = v[-1] * self.T
        for P, (at, L, R) in zip(self.matrices(v), self.of, strict=True):
            half = L @ P @ R
            x[at] += half + half.transpose(0, 2, 1)
        x[self.having] += np.einsum("bp,bpij->bij", v[self.which], self.S)
        return np.asarray(x.ravel())

    def adjoint(self, z: Array) -> Array:
        (Z,) = self.blocks.stacks(z)
        rows = [2 * self.P.row((R @ Z[at] @ L).sum(axis=0)) for at, L, R in self.of]
        found = np.concatenate([*rows, np.zeros(self.size - self.first)])
        np.add.at(found, self.which, np.einsum("bij,bpij->bp", Z[self.having], self.S))
        found[-1] = np.vdot(Z, self.T)
        return found

    @cached_property
    def _chained(self) -> bool:
        """Whether it is quicker to eliminate matrices one after the other: each is with the next alone."""
        ring = {(self.count - 1, 0), *((k, j) for k in range(self.count) for j in (k, k - 1))}
        long = self.count >= _CHAIN[0] and self.first >= _CHAIN[1]
        return long and {(k, j) for k, j, *_ in self.pairs} <= ring

    def normal(self, w: Array) -> tuple[Normal | ChainNormal, None]:
        (W,), H = self.blocks.stacks(w), np.zeros((self.size, self.size))
        H[-1] = self.adjoint((W @ self.T @ W).ravel())
        low, n = (self.P.rows, self.P.columns), self.P.n
        turned = [W[at] @ G for (at, _, _), G in zip(self.of, self.both, strict=True)]
        for k, other, one, two in self.pairs:
            X = self.both[k][one].transpose(0, 2, 1) @ turned[other][two]
            L, R = X[:, :n], X[:, n:]  # times W, and each times L_ and R_ᵀ
            first = np.concatenate([R[..., :n], R[..., n:]])
            second = np.concatenate([L[..., n:], L[..., :n]])  # transposed: (a, d)
            whole = np.tensordot(second, first, axes=([0], [0]))  # (a, d, b, c)
            half = whole.transpose(0, 2, 1, 3)[low] + whole.transpose(2, 0, 1, 3)[low]
            H[self.places[k], self.places[other]] = 2 * (half + half.transpose(0, 2, 1))[:, *low]
        if len(self.having):
            self._fill_scalars(W[self.having, None], H)
        return ChainNormal(H, self.places) if self._chained else Normal(H), None

    def _fill_scalars(self, W: Array, H: Array) -> None:
        """Write the rows of the τ but for what they have with t."""
        turned = W @ self.S @ W
        for place, (at, L, R) in zip(self.places, self.of, strict=True):
            _, one, two = np.intersect1d(self.having, at, return_indices=True)
            X = R[two, None] @ turned[one] @ L[two, None]
            rows = 2 * (X + X.transpose(0, 1, 3, 2))[..., self.P.rows, self.P.columns]
            np.add.at(H[:, place], self.which[one], rows)
        both = np.einsum("bpij,bqij->bpq", turned, self.S)
        np.add.at(H, (self.which[:, :, None], self.which[:, None, :]), both)
