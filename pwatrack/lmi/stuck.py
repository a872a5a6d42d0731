"""A cell that no gain stabilises by itself: its mode that does not decay, and a multiplier that proves it."""

import warnings
from collections.abc import Sequence

import flint
import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from pwatrack.lmi.multipliers import refutes, rounded, symmetric
from pwatrack.rational import (
    Rational,
    decimals,
    floats,
    identity,
    is_hurwitz,
    is_positive_definite,
    is_positive_semidefinite,
    left_null_space,
    on_rows,
    unreachable,
)


def stuck_modes(A: Sequence[Rational], B: Rational) -> tuple[dict[int, Rational], dict[int, complex]]:
    """Return a multiplier for one cell that has a mode which does not decay and B does not reach, if there is one.

    Args:
        A, B: As for `refutes`.

    Returns:
        The multiplier by its cell; and of each such cell the eigenvalue of that mode.
    """
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
        kernel = left_null_space(_lyapunov_map(M).transpose())
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
    return symmetric(_lyapunov_map(M).solve(right).entries(), n)


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


def _lyapunov_map(M: Rational) -> Rational:
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
