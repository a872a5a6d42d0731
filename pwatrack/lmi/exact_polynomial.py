"""Exact proof by a polynomial: whole-number P and N_i, decimals as printed, definiteness decided by balls."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.exact import (
    BITS,
    Certificate,
    Packed,
    Proof,
    Whole,
    left_side,
    prove_exactly,
    proved_rate,
    unpacked,
    whole,
)
from pwatrack.lmi.polynomial import Exponents, Monomials, PolynomialLyapunov
from pwatrack.lmi.role import Role
from pwatrack.rational import Rational, is_positive_definite


@dataclass(frozen=True, kw_only=True)
class PolynomialProof(Packed):
    """P ≻ 0 and −sym(P 𝒜_i) − N_i − 2 d rate P ≻ 0 for every i, proved exactly: see `polynomial`.

    𝒜_i is the lift of T A_i T⁻¹ on the monomials of degree d, A_i the matrix by which errors change. Where it has
    irrational entries, for every matrix in its ball.

    Attributes:
        role: Which inequality it takes the place of.
        degree: 2 d.
        T: (n, n): the decimals that it prints as.
        N: The integers of N_i, one for each different A_i, with
        N_exponents: their exponents.
        rate: Certified decay rate of errors in 1/s, a short decimal.
    """

    role: Role
    degree: int
    T: Array
    N: tuple[Whole, ...]
    N_exponents: tuple[int, ...]
    rate: float

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
    """Prove for rounded numbers what was found in floating point, or return None.

    Args:
        M: The matrices M_i of it, each different.
    """
    if isinstance(found, PolynomialLyapunov):
        return prove_polynomial(role, M, found)
    return prove_exactly(role, M, found.P if found.precise is None else found.precise, found.rate)


def prove_polynomial(role: Role, M: Sequence[BallMatrix], found: PolynomialLyapunov) -> PolynomialProof | None:
    """Round P, N_i and the rate to short numbers and prove the inequality for them, or return None.

    Args:
        M: The matrices M_i of it, each different.
        found: What shows it in floating point, for the matrices nearest to these.

    Example:
        >>> from pwatrack.lmi.presolve import Coordinates
        >>> from pwatrack.lmi.polynomial import best_polynomial
        >>> from pwatrack.lmi.role import CONTROLLER
        >>> A = np.array([[[0.0, 1.0], [-1.0, -0.3]], [[0.0, 1.0], [-2.0, -0.3]]])
        >>> found = best_polynomial(A, 4, Coordinates.balanced(A.swapaxes(1, 2)))
        >>> proof = prove_polynomial(CONTROLLER, [BallMatrix.of(A_i) for A_i in A], found)
        >>> proof.degree, 0 < proof.rate <= found.rate
        (4, True)
    """
    monomials, T = found.monomials, BallMatrix.of(found.T)
    weights = monomials.weights
    short = Packed.of(found.P * weights[:, None] * weights)
    numbers = _numbers(found, [role.oriented(M_i.floats) for M_i in M])
    if numbers is None or not is_positive_definite(short.P):
        return None
    N, N_exponents = _rounded(numbers * weights[:, None] * weights, short.exponents, monomials)
    left = list[Rational]()
    for M_i, N_i in zip(M, N, strict=True):
        lift = monomials.exactly(T @ role.exact(M_i) @ T.inverse())
        left.append(left_side(lift.transpose(), short) - unpacked(N_i, N_exponents))
    rate = proved_rate(left, short.P, found.degree, found.rate)
    if rate is None:
        return None
    return PolynomialProof(
        role=role, degree=found.degree, T=found.T, N=N, N_exponents=N_exponents, rate=rate, **short.parts
    )


def _numbers(found: PolynomialLyapunov, A: Sequence[Array]) -> Array | None:
    """Return the N_i of these matrices, (l, N, N); None where one has none."""
    at = {A_i.tobytes(): k for k, A_i in enumerate(found.A + 0.0)}
    places = [at.get((A_i + 0.0).tobytes(), -1) for A_i in A]
    return None if -1 in places else np.asarray(found.N[places])


def _rounded(N: Array, exponents: Sequence[int], monomials: Monomials) -> tuple[tuple[Whole, ...], tuple[int, ...]]:
    """Return whole numbers near N_i (l, N, N), scaled by powers of two, with mᵀ N_i m = 0 exactly.

    Of the entries that are to add up to 0 the finest one is what the others leave. Entries on the diagonal are even,
    as those beside it count twice.
    """
    scale = np.exp2(-np.asarray(exponents, dtype=np.float64))
    size = float(np.abs(N * scale[:, None] * scale).max(initial=0.0))
    shift = round(np.log2(size) / 2) - BITS // 2 if size else 0
    powers = tuple(e + shift for e in exponents)
    finest = {
        product: min(pairs, key=lambda p: powers[p[0]] + powers[p[1]]) for product, pairs in monomials.products.items()
    }
    return tuple(_vanishing(whole(N_i, powers), powers, monomials.products, finest) for N_i in N), powers


def _vanishing(
    rows: Whole,
    powers: Sequence[int],
    products: Mapping[Exponents, Sequence[tuple[int, int]]],
    finest: Mapping[Exponents, tuple[int, int]],
) -> Whole:
    """Return whole numbers changed as little as it takes that mᵀ N m = 0."""
    N = [list(row) for row in rows]
    for product, pairs in products.items():
        j, k = finest[product]
        rest = 0
        for a, b in pairs:
            if a == b:
                N[a][a] = 2 * round(N[a][a] / 2)
            if (a, b) != (j, k):
                rest += (1 + (a != b)) * N[a][b] << (powers[a] + powers[b] - powers[j] - powers[k])
        N[j][k] = N[k][j] = -rest if j == k else -rest // 2
    return tuple(tuple(row) for row in N)
