"""Multipliers in exact numbers: what they prove, and how those of floating point are rounded.

If Z_i ⪰ 0, not all 0, Σ Z_i B = 0 and Σ (Z_i A_i + A_iᵀ Z_i) ⪰ 0, then no P ≻ 0 and Y have
A_i P + P A_iᵀ + B Y + Yᵀ Bᵀ ≺ 0 for all i: multiplied by Z_i and summed, the traces would be
both negative and not (the theorem of alternatives for (8); for given gains B is empty). Where only one Z_i
is not 0 it need not be ⪰ 0, it is enough that it is not ⪯ 0: A + BK with Z (A + BK) + (·)ᵀ ⪰ 0 is
then not Hurwitz, since for a Hurwitz matrix Lyapunov's equation would make Z ⪯ 0.
"""

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from math import lcm
from typing import Any

import flint
import numpy as np

from pwatrack.arrays import Array
from pwatrack.rational import Rational, column_space, decimals, is_positive_semidefinite, rational

_BITS = 48  # of the entries of a rounded multiplier


def refutes(A: Sequence[Rational], B: Rational, Z: Mapping[int, Rational], *, kernel: Rational | None = None) -> bool:
    """Check exactly that multipliers prove that there is no solution.

    Args:
        A: The matrices A_i, exact.
        B: Exact.
        Z: Multipliers by cell; 0 for the others.
        kernel: Columns that all Z_i may be 0 on, by default those of B: to be fast, whatever they are.
    """
    total, n = total_of([Z_i * A[i] for i, Z_i in Z.items()]), B.nrows()
    zero, kernel = decimals(np.zeros((n, n))), column_space(B) if kernel is None else kernel
    if any(Z_i != Z_i.transpose() for Z_i in Z.values()):
        return False
    if not is_positive_semidefinite(total + total.transpose(), kernel):
        return False
    if total_of(list(Z.values())) * B != decimals(np.zeros((n, B.ncols()))):
        return False
    if len(Z) == 1:
        (single,) = Z.values()
        return not is_positive_semidefinite(-single)
    return all(is_positive_semidefinite(Z_i, kernel) for Z_i in Z.values()) and any(Z_i != zero for Z_i in Z.values())


def refutes_any_sign(A: Sequence[Rational], Z: Mapping[int, Rational]) -> bool:
    """Check exactly that multipliers prove that no P = Pᵀ of any sign has A_i P + P A_iᵀ ≺ 0: all traces add up to 0.

    Args:
        A: The matrices A_i, exact.
        Z: Multipliers by cell, ⪰ 0; 0 for the others.
    """
    total = total_of([Z_i * A[i] for i, Z_i in Z.items()])
    if any((total + total.transpose()).entries()) or any(Z_i != Z_i.transpose() for Z_i in Z.values()):
        return False
    return any(any(Z_i.entries()) for Z_i in Z.values()) and all(is_positive_semidefinite(Z_i) for Z_i in Z.values())


def rounded(X: Array) -> Rational:
    """Return a symmetric matrix rounded to a grid finer than its largest entry by 2^-48."""
    grid = Fraction(2) ** (int(np.ceil(np.log2(np.abs(X).max(initial=1e-300)))) - _BITS)
    return rational([[round(Fraction(v) / grid) * grid for v in row] for row in ((X + X.T) / 2).tolist()], X.shape)


def whole(Z: Mapping[int, Rational]) -> dict[int, tuple[tuple[int, ...], ...]]:
    """Return the multipliers times one number that makes all entries whole."""
    scale = denominator(Z.values())
    return {i: tuple(tuple(int((v * scale).p) for v in row) for row in Z_i.tolist()) for i, Z_i in Z.items()}


def denominator(matrices: Iterable[Rational]) -> int:
    """Return the smallest number that makes all entries of some matrices whole."""
    return lcm(*(int(v.q) for X in matrices for v in X.entries()))


def symmetric(upper: Sequence[Any], n: int) -> Rational:
    """Return the symmetric matrix with this upper triangle, row by row."""
    X, entries = flint.fmpq_mat(n, n), iter(upper)
    for j in range(n):
        for k in range(j, n):
            X[j, k] = X[k, j] = next(entries)
    return X


def total_of(terms: Sequence[Rational]) -> Rational:
    """Return the sum of at least one matrix."""
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def column(entries: Sequence[Any]) -> Rational:
    """Return entries as a column."""
    return flint.fmpq_mat(len(entries), 1, list(entries))
