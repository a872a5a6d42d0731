"""The normal form (11)–(12): relative degree, the coordinates ξ and η, the change of state."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import EPS, TINY, Array, balancing, number_text, readonly
from pwatrack.ball_matrix import BallMatrix, above, each, stack
from pwatrack.causes import Part, Remedy, Way
from pwatrack.errors import OutsideTheory, Problem
from pwatrack.model.continuity import Repair
from pwatrack.model.pwa import Matrices, PWASystem, linear_form_text
from pwatrack.rational import Rational, floats

_STATE_TRACKING = "state tracking (Theorem 2) needs no form (11), only (8) and (9)"
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
        plant: The system this is the normal form of, exactly: where c_k A_i differ between cells by rounding, or
            c_k B is rounding, the plant given is repaired.
        r: Relative degree, 1 … n.
        exact: T (n, n), the offset (n, 1), and A_ηi, N A_i restricted to η, exactly.
        T, offset: Change of state, (n, n) and (n,).
        T_inverse: Its inverse, x = T_inverse ([ξ; η] − offset).
        alpha, beta, gamma: (l, r), (l, n − r), (l,).
        delta: The scalar δ ≠ 0.
        chi, Psi, sigma: (l, n − r, r), (l, n − r, n − r), (l, n − r).
        eta_names: What each η is, in the names of the states.
    """

    plant: PWASystem
    r: int
    exact: "ExactForm"
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


@dataclass(frozen=True, kw_only=True)
class ExactForm:
    """What of a normal form proofs are about.

    Attributes:
        T, offset: [ξ; η] = T x + offset, (n, n) and (n, 1).
        A_eta: (n − r, n − r), one per cell.
        internal: The states j of the rows N = e_j − (B_j / δ) c_{r−1} of T, n − r of them.
    """

    T: BallMatrix
    offset: BallMatrix
    A_eta: tuple[BallMatrix, ...]
    internal: tuple[int, ...]


def normal_form(plant: PWASystem) -> NormalForm:
    """Bring a SISO system to the form (11) by a linear change of state.

    Raises:
        OutsideTheory: If the plant is not SISO, or y, ẏ, … depend on the cell
            before the input appears, or the input never appears.
    """
    if plant.B.shape[1] != 1 or len(plant.tracked) != 1:
        one_of_many = plant.B.shape[1] == 1 and len(plant.tracked) > 1
        raise OutsideTheory(
            Problem(
                message=f"output tracking (Theorem 3) needs one input and one tracked output, the plant has "
                f"{plant.B.shape[1]} and {len(plant.tracked)}",
                subject=(Part.PLANT,),
                hint="say which one follows the reference" if one_of_many else _STATE_TRACKING,
                remedy=Remedy(Way.TRACKED, (plant.tracked_names[0],)) if one_of_many else Remedy(Way.STATE_TRACKING),
            )
        )
    rows, delta = _output_derivatives(plant)
    r, n = len(rows), plant.A.shape[1]
    try:
        internal = _complement(plant, rows, delta)
        T, offset = _coordinates(plant.exact, r, internal)
        plant, inverse = _repaired(plant, T, offset, r), T.inverse()
    except ZeroDivisionError:
        raise _unsure(r, delta, abs(delta)) from None
    exact = plant.exact
    whole = each(lambda A_i: T @ A_i @ inverse, exact.A)
    A, o = stack(whole), offset.floats[:, 0]
    b = stack([T @ b_i - A_i @ offset for b_i, A_i in zip(exact.b, whole, strict=True)])[:, :, 0]
    etas = range(r, n)
    return NormalForm(
        plant=plant,
        r=r,
        exact=ExactForm(
            T=T, offset=offset, A_eta=tuple(each(lambda A_i: A_i.part(etas, etas), whole)), internal=tuple(internal)
        ),
        T=T.floats,
        offset=readonly(o),
        T_inverse=inverse.floats,
        alpha=readonly(A[:, r - 1, :r]),
        beta=readonly(A[:, r - 1, r:]),
        gamma=readonly(b[:, r - 1]),
        delta=float((T @ exact.B).floats[r - 1, 0]),
        chi=readonly(A[:, r:, :r]),
        Psi=readonly(A[:, r:, r:]),
        sigma=readonly(b[:, r:]),
        eta_names=tuple(linear_form_text(row, plant.states) for row in T.floats[r:]),
    )


def _coordinates(exact: Matrices, r: int, internal: Sequence[int]) -> tuple[BallMatrix, BallMatrix]:
    """Return T and the offset: the rows c_k of the first cell, then e_j − (B_j / δ) c_{r−1} for some states j."""
    n = exact.A[0].shape[0]
    row, T, offset = exact.tracked, exact.tracked, BallMatrix.of([[0]])
    for _ in range(r - 1):
        offset = above(offset, row @ exact.b[0])
        row = row @ exact.A[0]
        T = above(T, row)
    share = exact.B @ (row @ exact.B).inverse()  # B / δ
    for j in internal:
        unit = BallMatrix.of(np.eye(n)[[j]])
        T = above(T, unit - share.part([j], [0]) @ row)
        offset = above(offset, BallMatrix.of([[0]]))
    return T, offset


def _repaired(plant: PWASystem, T: BallMatrix, offset: BallMatrix, r: int) -> PWASystem:
    """Return the plant with c_k A_i = c_{k+1}, c_k b_i = o_{k+1} and c_k B = 0 for k < r − 1, exactly.

    With S the columns of T⁻¹ that belong to c_0 … c_{r−2}, Ã_i = A_i − S (c A_i − c₊) and so on. The difference of two
    cells is multiplied by I − S c then, so that what was continuous stays so.
    """
    n, first, following = plant.A.shape[1], range(r - 1), range(1, r)
    c = BallMatrix(T.part(first, range(n)).centre)
    c_next, o_next = T.part(following, range(n)).centre, offset.part(following, [0]).centre
    S = BallMatrix(T.centre.inv()).part(range(n), first)
    exact = plant.exact
    missed_A = [c.centre * A_i.centre - c_next for A_i in exact.A]
    missed_b = [c.centre * b_i.centre - o_next for b_i in exact.b]
    missed_B = c.centre * exact.B.centre
    if not any(any(X.entries()) for X in (*missed_A, *missed_b, missed_B)):
        return plant

    def mended(X: BallMatrix, missed: Rational) -> BallMatrix:
        return BallMatrix(X.centre - S.centre * missed, X.radius)

    new = Matrices(
        A=tuple(mended(X, missed) for X, missed in zip(exact.A, missed_A, strict=True)),
        b=tuple(mended(X, missed) for X, missed in zip(exact.b, missed_b, strict=True)),
        B=mended(exact.B, missed_B),
        C=exact.C,
        tracked=exact.tracked,
    )
    A, b = (np.abs([floats(S.centre * X) for X in missed]).max(axis=0) for missed in (missed_A, missed_b))
    B = np.abs(floats(S.centre * missed_B))
    d, size = balancing(plant.A), np.abs(plant.A).max(axis=0)
    shares = [np.where(A.any(axis=1), A @ d, 0.0) / np.maximum(size @ d, TINY)]
    for change, given in ((b, plant.b.T), (B, plant.B)):
        rates = np.abs(given) / d[:, None]
        shares.append(change / d[:, None] / max(rates.max(), TINY))
    relative = max(float(share.max()) for share in shares)
    repair = Repair(A=readonly(A), b=readonly(b[:, 0]), B=readonly(B), relative=relative)
    remark = (
        f"the form (11) holds but for rounding, {repair.size}: proofs and simulation are about the plant that has it"
    )
    whole = plant.with_matrices(new)
    return replace(whole, repair=repair.and_then(plant.repair), remarks=(*plant.remarks, remark))


def _output_derivatives(plant: PWASystem) -> tuple[Array, float]:
    """Return rows c_k with y⁽ᵏ⁾ = c_k x + o_k for k < r, and δ = c_{r−1} B, decided with a bound on rounding."""
    c = plant.tracked[0]
    where = Part.C if plant.tracked_names == plant.outputs else Part.TRACKED
    rows = [c]
    size_A, n = np.abs(plant.A).max(axis=0), plant.A.shape[1]
    rounding = 4 * n * EPS
    error = np.zeros(n)  # bounds how far rounding may have moved the entries of c
    for _ in range(n):
        B = plant.B[:, 0]
        delta = float(c @ B)
        doubt = float((error + rounding * np.abs(c)) @ np.abs(B))
        if abs(delta) > doubt:
            return np.array(rows), delta
        if abs(delta) > _ZERO * doubt:
            raise _unsure(len(rows), delta, doubt)
        following = c @ plant.A
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
                    f"{number_text(following[0, column], '.6g')} and {number_text(following[cell, column], '.6g')}",
                    subject=(where,),
                    hint=f"another output may have the same derivatives in every cell; {_STATE_TRACKING}",
                    remedy=Remedy(Way.STATE_TRACKING),
                )
            )
        c = following[0]
        if not (np.abs(c) > 2 * error).any():
            break
        rows.append(c)
    raise OutsideTheory(
        Problem(
            message=f"no relative degree in cell '{plant.cell_names[0]}': the input never reaches the output "
            f"'{plant.tracked_names[0]}'",
            subject=(Part.B,),
            hint=f"track another output or add an actuator; {_STATE_TRACKING}",
            remedy=Remedy(Way.STATE_TRACKING),
        )
    )


def _unsure(r: int, delta: float, doubt: float) -> OutsideTheory:
    return OutsideTheory(
        Problem(
            message=f"the relative degree is not sure: C A^{r - 1} B = {delta:.3g} may be rounding, "
            f"which can reach {doubt:.3g}",
            subject=(Part.B,),
            hint="write the plant in states of similar size that act on each other directly",
        )
    )


def _complement(plant: PWASystem, rows: Array, delta: float) -> list[int]:
    """Return n − r states j for the rows of N, with [rows; N] invertible; those that are η themselves come first.

    State j itself qualifies if B_j = 0; otherwise x_j − (B_j / δ) c_{r−1} x does.
    """
    n, B = rows.shape[1], plant.B[:, 0]
    if len(rows) == n:
        return []
    d = balancing(plant.A)
    unit = np.eye(n)
    states = [j for j in range(n) if B[j] == 0] + [j for j in range(n) if B[j] != 0]
    candidates = [(j, unit[j] - B[j] / delta * rows[-1]) for j in states]
    candidates = [(j, v) for j, v in candidates if v.any()]
    directions = np.array([v for _, v in candidates]) * d
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scaled = rows * d
    basis, _ = np.linalg.qr((scaled / np.linalg.norm(scaled, axis=1, keepdims=True)).T)
    chosen: list[int] = []
    while len(rows) + len(chosen) < n:
        rest = directions
        for _ in range(2):  # the second pass removes what rounding left
            rest = rest - (rest @ basis) @ basis.T
        fresh = np.linalg.norm(rest, axis=1)
        good = np.flatnonzero(fresh > _FRESH)
        best = int(good[0]) if len(good) else int(np.argmax(fresh))
        chosen.append(candidates[best][0])
        basis = np.column_stack([basis, rest[best] / fresh[best]])
    return chosen
