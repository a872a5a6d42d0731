"""The normal form (11)–(12): relative degree, the coordinates ξ and η, the change of state."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array, balancing, readonly
from pwatrack.errors import OutsideTheory, Problem
from pwatrack.model.pwa import PWASystem, linear_form_text

_STATE_TRACKING = "state tracking (Theorem 2, 'tracking: state') needs no form (11), only (8) and (9)"
_ZERO = 0.25  # of the worst rounding error, below which δ counts as 0
_FRESH = 0.3  # part of a state that the rows chosen so far must leave over for it to be taken as an η
_ROUNDING = 1e-10  # relative size below which an entry computed from the data counts as zero


@dataclass(frozen=True, kw_only=True)
class NormalForm:
    """A SISO system in the coordinates [ξ; η] = T x + offset of eq. (11).

    In cell i, with relative degree r:

        ξ̇_j = ξ_{j+1} for j < r,   ξ̇_r = α_iᵀ ξ + β_iᵀ η + γ_i + δ u,
        η̇ = χ_i ξ + Ψ_i η + σ_i,   y = ξ_1.

    η is chosen so that u does not enter its equation (ν = 0).

    Attributes:
        plant: The system this is the normal form of.
        r: Relative degree, 1 … n.
        T, offset: Change of state, (n, n) and (n,).
        T_inverse: Its inverse, x = T_inverse ([ξ; η] − offset).
        alpha, beta, gamma: (l, r), (l, n − r), (l,).
        delta: The scalar δ ≠ 0.
        chi, Psi, sigma: (l, n − r, r), (l, n − r, n − r), (l, n − r).
        eta_names: What each η is, in the names of the states.
    """

    plant: PWASystem
    r: int
    T: Array
    offset: Array
    T_inverse: Array
    alpha: Array
    beta: Array
    gamma: Array
    delta: float
    chi: Array
    Psi: Array
    sigma: Array
    eta_names: tuple[str, ...]


def normal_form(plant: PWASystem) -> NormalForm:
    """Bring a SISO system to the form (11) by a linear change of state.

    Raises:
        OutsideTheory: If the plant is not SISO, or y, ẏ, … depend on the cell
            before the input appears, or the input never appears.
    """
    if plant.B.shape[1] != 1 or plant.C.shape[0] != 1:
        raise OutsideTheory(
            Problem(
                message=f"output tracking (Theorem 3) needs one input and one output, the plant has "
                f"{plant.B.shape[1]} and {plant.C.shape[0]}",
                subject=("system",),
                hint=_STATE_TRACKING,
            )
        )
    rows, offsets, delta = _output_derivatives(plant)
    r, n = len(rows), plant.A.shape[1]
    N = _complement(plant, rows, delta)
    T = np.vstack([rows, N]) if len(N) else rows
    offset = np.concatenate([offsets, np.zeros(n - r)])
    T_inverse = np.linalg.inv(T)
    A = T @ plant.A @ T_inverse
    b = plant.b @ T.T - A @ offset
    return NormalForm(
        plant=plant,
        r=r,
        T=readonly(T),
        offset=readonly(offset),
        T_inverse=readonly(T_inverse),
        alpha=readonly(A[:, r - 1, :r]),
        beta=readonly(A[:, r - 1, r:]),
        gamma=readonly(b[:, r - 1]),
        delta=delta,
        chi=readonly(A[:, r:, :r]),
        Psi=readonly(A[:, r:, r:]),
        sigma=readonly(b[:, r:]),
        eta_names=tuple(linear_form_text(row, plant.states) for row in N),
    )


def _output_derivatives(plant: PWASystem) -> tuple[Array, Array, float]:
    """Return rows c_k and offsets o_k with y⁽ᵏ⁾ = c_k x + o_k for k < r, and δ = c_{r−1} B."""
    c, o = plant.C[0], 0.0
    rows, offsets = [c], [o]
    size_A, n = np.abs(plant.A).max(axis=0), plant.A.shape[1]
    rounding = 4 * n * np.finfo(np.float64).eps
    error = np.zeros(n)  # bounds how far rounding may have moved the entries of c
    for _ in range(n):
        B = plant.B[:, 0]
        delta = float(c @ B)
        doubt = float((error + rounding * np.abs(c)) @ np.abs(B))
        if abs(delta) > doubt:
            return np.array(rows), np.array(offsets), delta
        if abs(delta) > _ZERO * doubt:
            raise OutsideTheory(
                Problem(
                    message=f"the relative degree is not sure: C A^{len(rows) - 1} B = {delta:.3g} may be rounding, "
                    f"which can reach {doubt:.3g}",
                    subject=("system", "B"),
                    hint="write the plant in states of similar size that act on each other directly",
                )
            )
        following, constants = c @ plant.A, plant.b @ c
        error = error @ size_A + rounding * (np.abs(c) @ size_A)
        if not B.any():
            break
        differs = np.abs(following - following[0]) > np.maximum(_ROUNDING * (np.abs(c) @ size_A), 2 * error)
        if differs.any():
            cell, column = np.argwhere(differs)[0]
            one, other = plant.cell_names[0], plant.cell_names[cell]
            raise OutsideTheory(
                Problem(
                    message=f"not of form (11): row C A^{len(rows)} differs between cells '{one}' and '{other}' "
                    f"before the input enters: entry '{plant.states[column]}' is "
                    f"{following[0, column]:.6g} and {following[cell, column]:.6g}",
                    subject=("system", "C"),
                    hint=f"another output may have the same derivatives in every cell; {_STATE_TRACKING}",
                )
            )
        c, o = following[0], float(constants[0])
        if not (np.abs(c) > 2 * error).any():
            break
        rows.append(c)
        offsets.append(o)
    raise OutsideTheory(
        Problem(
            message=f"no relative degree in cell '{plant.cell_names[0]}': the input never reaches the output "
            f"'{plant.outputs[0]}'",
            subject=("system", "B"),
            hint=f"measure another output or add an actuator; {_STATE_TRACKING}",
        )
    )


def _complement(plant: PWASystem, rows: Array, delta: float) -> Array:
    """Return N (n − r, n) with N B = 0 and [rows; N] invertible, made of original states where possible.

    State j itself qualifies if B_j = 0; otherwise x_j − (B_j / δ) c_{r−1} x does.
    """
    n, B = rows.shape[1], plant.B[:, 0]
    if len(rows) == n:
        return np.zeros((0, n))
    d = balancing(plant.A)
    unit = np.eye(n)
    candidates = [unit[j] for j in range(n) if B[j] == 0]
    candidates += [unit[j] - B[j] / delta * rows[-1] for j in range(n) if B[j] != 0]
    candidates = [v for v in candidates if v.any()]
    directions = np.array(candidates) * d
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scaled = rows * d
    basis, _ = np.linalg.qr((scaled / np.linalg.norm(scaled, axis=1, keepdims=True)).T)
    chosen: list[Array] = []
    while len(rows) + len(chosen) < n:
        rest = directions
        for _ in range(2):  # the second pass removes what rounding left
            rest = rest - (rest @ basis) @ basis.T
        fresh = np.linalg.norm(rest, axis=1)
        good = np.flatnonzero(fresh > _FRESH)
        best = int(good[0]) if len(good) else int(np.argmax(fresh))
        chosen.append(candidates[best])
        basis = np.column_stack([basis, rest[best] / fresh[best]])
    return np.array(chosen).reshape(n - len(rows), n)
