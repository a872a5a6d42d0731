"""Cells that no gain stabilises together: multipliers found in floating point, rounded, and proved."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pwatrack.arrays import Array
from pwatrack.lmi.coordinates import Coordinates
from pwatrack.lmi.faces import faces, guessed_faces
from pwatrack.lmi.inequality import Inequality
from pwatrack.lmi.multipliers import refutes, refutes_any_sign
from pwatrack.lmi.program import least_violation
from pwatrack.lmi.rounding import exact_multipliers
from pwatrack.lmi.solve import solve
from pwatrack.rational import Rational, decimals, floats, identity

INSIDE = 0.3  # gap of the least violation at which multipliers are taken to be rounded: they are well inside
_NEAR = 1e-4  # the same where their faces are to be seen
_ROUNDING = 1e-13  # of the largest entry: what is smaller is none
_LIGHT = 1e-3  # a cell with less than this share of the weight is tried without


@dataclass(frozen=True, kw_only=True)
class _Faces:
    """Where multipliers are looked for: Z_i = N_iᵀ V_i N_i with Z_i R = 0.

    Attributes:
        A: The matrices A_i in floating point, (l, n, n), and
        exact_A: the same exactly.
        R: (n, ρ).
        N: N_i (k_i, n).
        bases: Orthonormal columns of the same spans, (n, k_i).
        proves: Whether multipliers by place prove something of matrices.
    """

    A: Array
    exact_A: Sequence[Rational]
    R: Rational
    N: Sequence[Rational]
    proves: Callable[[Sequence[Rational], Mapping[int, Rational], Rational], bool]

    @cached_property
    def bases(self) -> list[Array]:
        return [np.linalg.qr(floats(N_i).T)[0] for N_i in self.N]

    def sought(self, cells: Sequence[int], gap: float) -> list[Array] | None:
        """Return what `sought` does for some cells."""
        return sought(self.A[cells], [self.bases[i] for i in cells], floats(self.R), gap=gap)

    def proved(self, cells: Sequence[int]) -> dict[int, Rational] | None:
        """Return multipliers for some cells that are proved, by cell, or None."""
        inside = self.sought(cells, INSIDE)
        if inside is None:
            return None
        A, N, bases = ([of[i] for i in cells] for of in (self.exact_A, self.N, self.bases))
        Z = exact_multipliers(A, N, bases, self.R, inside)
        if Z is None or not self.proves(A, dict(enumerate(Z)), self.R):
            return None
        return dict(zip(cells, Z, strict=True))


def conflict(A: Array, B: Array, exact_A: Sequence[Rational], exact_B: Rational) -> dict[int, Rational] | None:
    """Return proved multipliers for several cells, none of which is stuck alone, by cell, or None.

    Where those cells that bear nearly all of the weight prove it alone, they do. Where multipliers are singular, they
    are looked for once more in the faces that they seem to lie in.

    Args:
        A, B: (l, n, n) and (n, m), and
        exact_A, exact_B: the same exactly.
    """
    at = Coordinates.balanced(A, B)
    D = decimals(at.T)
    scaled, exact_A, exact_B = at.system(A), [D.inv() * A_i * D for A_i in exact_A], D.inv() * exact_B
    R, N = faces(exact_A, exact_B)

    def proves(A: Sequence[Rational], Z: Mapping[int, Rational], kernel: Rational) -> bool:
        return refutes(A, exact_B, Z, kernel=kernel)

    found = _found(_Faces(A=scaled, exact_A=exact_A, R=R, N=N, proves=proves))
    return None if found is None else {i: D.inv() * Z_i * D.inv() for i, Z_i in found.items()}


def alike(A: Array, exact_A: Sequence[Rational]) -> dict[int, Rational] | None:
    """Return proved multipliers against a P of any sign, by cell, or None: Σ (Z_i A_i + A_iᵀ Z_i) = 0 then.

    Args:
        A, exact_A: As for `conflict`.

    Example: what turns without growing has no P.

        >>> A = np.array([[0.0, 1.0], [-4.0, 0.0]])
        >>> alike(A[None], [decimals(A)])[0].tolist() != [[0, 0], [0, 0]]
        True
    """
    at = Coordinates.balanced(A, np.zeros((A.shape[1], 0)))
    D, unit = decimals(at.T), identity(A.shape[1])
    exact_A = [D.inv() * A_i * D for A_i in exact_A]

    def proves(A: Sequence[Rational], Z: Mapping[int, Rational], _: Rational) -> bool:
        return refutes_any_sign(A, Z)

    found = _found(_Faces(A=at.system(A), exact_A=exact_A, R=unit, N=[unit] * len(A), proves=proves))
    return None if found is None else {i: D.inv() * Z_i * D.inv() for i, Z_i in found.items()}


def _found(inside: _Faces) -> dict[int, Rational] | None:
    """Return proved multipliers by cell: of all that have a face, of the heavy ones alone, then in smaller faces."""
    cells, everywhere = [i for i, N_i in enumerate(inside.N) if N_i.nrows()], inside.R.ncols() == inside.R.nrows()
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
        R, N = guessed_faces(inside.A, inside.N, inside.bases, dict(zip(cells, U, strict=True)))
        inside, cells = replace(inside, R=inside.R if everywhere else R, N=N), heavy
    return None


def sought(A: Array, bases: Sequence[Array], blind: Array, *, gap: float) -> list[Array] | None:
    """Look for Z_i = Q_i U_i Q_iᵀ ⪰ 0 with S R = 0 and S ⪰ t I on the complement of R, S = Σ (Z_i A_i + A_iᵀ Z_i).

    They are the multipliers of Q_iᵀ (A_i P + P A_iᵀ) Q_i ⪯ t I with the least t, where P ⪰ 0 is asked on that
    complement alone: what P may be elsewhere makes S R = 0.

    Args:
        A: (l, n, n).
        bases: Q_i (n, k_i), orthonormal.
        blind: R (n, ρ).
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
    found = solve(least_violation(inequalities, n - rank), gap=gap, against=0.0)
    if found is None or found.multipliers is None or found.objective < 0:
        return None
    places = [i for some in cells.values() for i in some]
    U = [U_i for part in found.multipliers[: len(cells)] for U_i in part]
    return [U[k] for k in np.argsort(places)]
