"""Exact linear algebra on rational matrices, by python-flint: definiteness, stability, what an input reaches.

A `Rational` is a `flint.fmpq_mat`; python-flint is loaded when the first one is made.
"""

import copyreg
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any

import flint
import numpy as np

from pwatrack.arrays import Array
from pwatrack.real import dyadic as dyadic

Rational = Any  # flint.fmpq_mat, which comes without types

_CLEARLY = 1e-12  # least eigenvalue, where the diagonal is 1, at which few bits will do
_MOST_BITS = 8192  # precision at which the balls give up
_NEARLY = 2.0**-60  # of a number: what a ball around it may have for its middle to be as good as the number
_QUOTIENT_BITS = 512  # of quotients that only hint at a number: a condition of 1e40 leaves most of them


def decimals(X: Array) -> Rational:
    """Return a matrix (j, k) as the decimals that its entries are printed as."""
    return rational([[Fraction(repr(float(v))) for v in row] for row in X], X.shape)


def doubles(X: Array) -> Rational:
    """Return a matrix (j, k) as the numbers that its entries are."""
    return rational([[Fraction(v) for v in row] for row in X.tolist()], (X.shape[0], X.shape[1]))


def rational(rows: Sequence[Sequence[Fraction | int]], shape: tuple[int, int]) -> Rational:
    """Return a matrix with these entries."""
    return flint.fmpq_mat(*shape, [number(v) for row in rows for v in row])


# and with it a plant, and all that is made from one
copyreg.pickle(flint.fmpq_mat, lambda X: (flint.fmpq_mat, (X.nrows(), X.ncols(), X.entries())))


def number(value: Fraction | int) -> Any:
    """Return a fraction as an entry of a rational matrix, and a factor of one."""
    return flint.fmpq(value.numerator, value.denominator)


def scalar(value: float) -> Any:
    """Return a number as the decimal that it is printed as."""
    return number(Fraction(repr(float(value))))


def fraction_of(value: Any) -> Fraction:
    """Return an entry of a rational matrix as a fraction."""
    return Fraction(int(value.p), int(value.q))


def middle(X: Any) -> Rational:
    """Return the middle of a matrix of balls."""
    return flint.fmpq_mat(X.nrows(), X.ncols(), [number(dyadic(v.mid())) for v in X.entries()])


def identity(n: int) -> Rational:
    """Return I of order n."""
    return flint.fmpq_mat(n, n, [int(j == k) for j in range(n) for k in range(n)])


def diagonal(values: Sequence[Fraction]) -> Rational:
    """Return a diagonal matrix with these entries."""
    n = len(values)
    return flint.fmpq_mat(n, n, [number(values[k]) if j == k else 0 for j in range(n) for k in range(n)])


def floats(X: Rational) -> Array:
    """Return the nearest doubles."""
    entries = [int(v.p) / int(v.q) if v else 0.0 for v in X.entries()]  # whole numbers divide correctly rounded
    return np.array(entries, dtype=np.float64).reshape(X.nrows(), X.ncols())


def solved(A: Rational, B: Rational) -> Any:
    """Return about A⁻¹ B: in balls, as exact quotients of many rows would take minutes; exact where balls do not do.

    Example:
        >>> near(solved(decimals(np.array([[3.0]])), decimals(np.array([[1.0]])))).tolist()
        [[0.3333333333333333]]
    """
    try:
        with flint.ctx.workprec(_QUOTIENT_BITS):
            return flint.arb_mat(A).solve(flint.arb_mat(B))
    except ZeroDivisionError:
        return A.inv() * B


def squares_in(Q: Rational, columns: Array) -> Array:
    """Return cᵀ Q⁻¹ c of columns c, (n, k), rounded up but for a rounding of doubles.

    Example:
        >>> squares_in(decimals(np.array([[0.25, 0.0], [0.0, 1.0]])), np.eye(2)).tolist()
        [4.0, 1.0]
    """
    C = doubles(columns)
    with flint.ctx.workprec(_QUOTIENT_BITS):
        product = flint.arb_mat(C.transpose()) * flint.arb_mat(solved(Q, C))
    return np.array([float(product[k, k].upper()) for k in range(C.ncols())])


def near(X: Any) -> Array:
    """Return about the middle of a matrix of balls, or of rationals, as doubles."""
    if isinstance(X, flint.fmpq_mat):
        return floats(X)
    return np.array([float(v.mid()) for v in X.entries()]).reshape(X.nrows(), X.ncols())


def stacked(blocks: Sequence[Rational]) -> Rational:
    """Return matrices with the same number of columns, one below the other."""
    return flint.fmpq_mat(sum(X.nrows() for X in blocks), blocks[0].ncols(), [v for X in blocks for v in X.entries()])


def on_entries(X: Rational, rows: Sequence[int], columns: Sequence[int]) -> Rational:
    """Return the entries of some rows and columns."""
    return flint.fmpq_mat(len(rows), len(columns), [X[j, k] for j in rows for k in columns])


def beside(blocks: Sequence[Rational]) -> Rational:
    """Return matrices with the same number of rows, one beside the other."""
    return stacked([X.transpose() for X in blocks]).transpose()


def _reduced(X: Rational) -> list[list[Any]]:
    """Return the rows of the reduced echelon form that are not 0."""
    form, rank = X.rref()
    return list(form.tolist()[:rank])


def pivots(X: Rational) -> list[int]:
    """Return which columns do not depend on those before them."""
    return [next(k for k, v in enumerate(row) if v != 0) for row in _reduced(X)]


def column_space(X: Rational) -> Rational:
    """Return independent columns of the same span.

    Example:
        >>> column_space(decimals(np.array([[2.0, 0.0, 4.0], [0.0, 0.0, 0.0]]))).tolist()
        [[1], [0]]
    """
    rows = _reduced(X.transpose())
    return flint.fmpq_mat(len(rows), X.nrows(), [v for row in rows for v in row]).transpose()


def left_null_space(X: Rational) -> Rational:
    """Return N (k, n), of full row rank, whose rows are all v with v X = 0.

    Example:
        >>> left_null_space(decimals(np.array([[1.0], [2.0]]))).tolist()
        [[-2, 1]]
    """
    n, rows = X.nrows(), _reduced(X.transpose())
    tied = [next(j for j, v in enumerate(row) if v != 0) for row in rows]
    free = [j for j in range(n) if j not in tied]
    entries = [[flint.fmpq(int(j == k)) for j in range(n)] for k in free]
    for v, k in zip(entries, free, strict=True):
        for row, pivot in zip(rows, tied, strict=True):
            v[pivot] = -row[k]
    return flint.fmpq_mat(len(free), n, [v for row in entries for v in row])


def is_hurwitz(M: Rational) -> bool:
    """Decide whether all eigenvalues have negative real parts: Routh's array of the characteristic polynomial.

    Where it is false, no P ≻ 0 has M P + P Mᵀ ≺ 0 (Lyapunov).
    """
    polynomial = M.charpoly()
    falling = [polynomial[k] for k in range(M.nrows(), -1, -1)]
    above, here = falling[0::2], falling[1::2]
    while here:
        if not here[0] > 0:
            return False
        ratio = above[0] / here[0]
        padded = here[1:] + [flint.fmpq(0)] * (len(above) - len(here))
        above, here = here, [a - ratio * b for a, b in zip(above[1:], padded, strict=True)]
    return True


def unreachable(A: Rational, B: Rational) -> tuple[Rational, Rational]:
    """Return N (k, n) and A_u (k, k) with N A = A_u N and N B = 0, k as large as it can be.

    The rows of N span what B never reaches (the left null space of [B, AB, …, Aⁿ⁻¹B]): no
    gain changes A_u. k = 0 if (A, B) is controllable.
    """
    columns = [B.transpose()]
    for _ in range(A.nrows() - 1):
        columns.append(columns[-1] * A.transpose())
    N = left_null_space(stacked(columns).transpose())
    return N, on_rows(A, N)


def on_rows(A: Rational, N: Rational) -> Rational:
    """Return A_u with N A = A_u N, for rows N (k, n) of full rank that span a left invariant subspace of A."""
    return N * A * N.transpose() * (N * N.transpose()).inv()


def symmetric(upper: Sequence[Any], n: int) -> Rational:
    """Return the symmetric matrix with this upper triangle, row by row."""
    X, entries = flint.fmpq_mat(n, n), iter(upper)
    for j in range(n):
        for k in range(j, n):
            X[j, k] = X[k, j] = next(entries)
    return X


def lyapunov_map(M: Rational) -> Rational:
    """Return the matrix of Z ↦ Z M + Mᵀ Z on the upper triangles of symmetric matrices."""
    n = M.nrows()
    pairs = [(j, k) for j in range(n) for k in range(j, n)]
    place = {pair: at for at, pair in enumerate(pairs)}
    X = flint.fmpq_mat(len(pairs), len(pairs))
    for at, (j, k) in enumerate(pairs):
        for s in range(n):  # (Z M)_jk + (Z M)_kj
            X[at, place[min(j, s), max(j, s)]] += M[s, k]
            X[at, place[min(k, s), max(k, s)]] += M[s, j]
    return X


def is_positive_definite(X: Rational) -> bool:
    """Decide X ≻ 0 by the pivots of LDLᵀ in ball arithmetic, with ever more bits until every sign is sure."""
    n, bits = X.nrows(), 128
    while bits <= _MOST_BITS:
        with flint.ctx.workprec(bits):
            sign = _pivots([[flint.arb(X[j, k]) for k in range(j + 1)] for j in range(n)])
        if sign is not None:
            return sign
        bits *= 2
    return False


def root(X: Rational) -> Array:
    """Return a lower triangular G, X = G Gᵀ, of X ≻ 0, each entry to 2⁻⁵³ of its row's size: the root of X's diagonal.

    Example:
        >>> root(decimals(np.array([[1e-30, 0.0], [0.0, 4.0]]))).tolist()
        [[1e-15, 0.0], [0.0, 2.0]]
    """
    n, bits = X.nrows(), 128
    while bits <= _MOST_BITS:
        with flint.ctx.workprec(bits):
            rows = [[flint.arb(X[j, k]) for k in range(j + 1)] for j in range(n)]
            if _pivots(rows):
                pivots = [rows[k][k].sqrt() for k in range(n)]
                G = [[rows[j][k] / pivots[k] for k in range(j + 1)] for j in range(n)]
                sizes = [flint.arb(X[j, j]).sqrt().lower() * _NEARLY for j in range(n)]
                if all(v.rad() < size for row, size in zip(G, sizes, strict=True) for v in row):
                    return np.array([[float(v.mid()) for v in row] + [0.0] * (n - len(row)) for row in G])
        bits *= 2
    raise ValueError("a matrix is not positive definite, as far as can be told")


def positive_eigenvalues(X: Rational) -> int:
    """Return how many eigenvalues of a symmetric matrix are positive: all are real, so Descartes' rule counts them.

    Example:
        >>> positive_eigenvalues(decimals(np.array([[0.0, 1.0], [1.0, 0.0]])))
        1
    """
    signs = [c > 0 for c in X.charpoly().coeffs() if c != 0]
    return sum(a != b for a, b in pairwise(signs))


def is_positive_semidefinite(X: Rational, kernel: Rational | None = None) -> bool:
    """Decide X ⪰ 0 for a symmetric X: it is 0 on its null space, and definite on a complement of it.

    Where the columns of `kernel` are all of the null space, no elimination in exact numbers is needed.

    Example:
        >>> X, ones = decimals(np.array([[1.0, -1.0], [-1.0, 1.0]])), decimals(np.ones((2, 1)))
        >>> is_positive_semidefinite(X), is_positive_semidefinite(X, ones), is_positive_semidefinite(-X, ones)
        (True, True, False)
    """
    if kernel is not None and not any((X * kernel).entries()):
        tied = pivots(kernel.transpose())
        rest = [j for j in range(X.nrows()) if j not in tied]
        part = on_entries(X, rest, rest)
        if _looks_definite(part) and is_positive_definite(part):
            return True
    basis = pivots(X)  # of unit rows that, with the null space, span everything
    return is_positive_definite(on_entries(X, basis, basis))


def _looks_definite(X: Rational) -> bool:
    """Say whether ball arithmetic will show soon that X ≻ 0, whose entries may be too large for floats."""
    size = max((abs(v) for v in X.entries()), default=flint.fmpq(1))
    if not size > 0:
        return False
    near = floats(X * (flint.fmpq(2) ** (int(size.q).bit_length() - int(size.p).bit_length())))
    diagonal = np.diag(near)
    if not (diagonal > 0).all():
        return False
    d = 1 / np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(near * d[:, None] * d).min(initial=1.0) > _CLEARLY)


def _pivots(rows: list[list[Any]]) -> bool | None:
    """Return whether all pivots of a lower triangle are positive; None if a ball holds 0."""
    for k in range(len(rows)):
        pivot = rows[k][k]
        if not pivot > 0:
            return False if pivot < 0 else None
        for row in rows[k + 1 :]:
            factor = row[k] / pivot
            for j in range(k + 1, len(row)):
                row[j] -= factor * rows[j][k]
    return True
