"""The derivatives of what is tracked, up to the ones that inputs reach: the vector relative degree, and refusals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import EPS, Array, number_text
from pwatrack.ball_matrix import BallMatrix
from pwatrack.errors import OutsideTheory, ProblemPart, Remedy, Way
from pwatrack.model.pwa import Matrices, PWASystem

_ZERO = 0.5  # of the worst rounding error, below which an entry of c B counts as 0
_ROUNDING = 1e-10  # relative size below which an entry computed from the data counts as zero


@dataclass(frozen=True, kw_only=True)
class Derivatives:
    """Rows with y⁽ᵏ⁾ = c_k x + o_k for k < r, the first of which that an input reaches is the last."""

    rows: Array  # c_0 … c_{r−1}, (r, n); the last that of the first cell
    piecewise: bool  # whether c_{r−1} is another one in other cells
    last: Array  # c_{r−1} in each cell, (l, n)
    doubt: Array  # by how much rounding may have moved the entries of c_{r−1} B, (m,)

    @property
    def degree(self) -> int:
        """Relative degree r."""
        return len(self.rows)


def output_derivatives(plant: PWASystem, j: int) -> Derivatives:
    """Return the derivatives of tracked output j.

    Refuses one that depends on the cell before an input reaches it in each, or that no input ever reaches, or where
    rounding leaves that open.
    """
    c, A, B = plant.tracked[j], plant.A, plant.B
    name, rows = plant.tracked_names[j], [c]
    size_A, n = np.abs(A).max(axis=0), A.shape[1]
    rounding = 4 * n * EPS
    error = np.zeros(n)  # bounds how far rounding may have moved the entries of c
    for _ in range(n):
        doubt = (error + rounding * np.abs(c)) @ np.abs(B)
        delta = c @ B
        open_ = np.flatnonzero(np.abs(delta) > _ZERO * doubt)
        if (np.abs(delta) > doubt).any():
            return Derivatives(rows=np.array(rows), piecewise=False, last=np.broadcast_to(c, (len(A), n)), doubt=doubt)
        if len(open_):
            raise unsure(f"C A^{len(rows) - 1} B of '{name}' has {delta[open_[0]]:.3g}, which", float(doubt[open_[0]]))
        following = c @ A
        error = error @ size_A + rounding * (np.abs(c) @ size_A)
        if not B.any():
            break
        size = np.maximum(_ROUNDING * (np.abs(c) @ size_A), 2 * error)
        if (np.abs(following - following[0]) > size).any():
            _check_reached(plant, name, len(rows), following, error, size)
            doubt = (error + rounding * np.abs(following).max(axis=0)) @ np.abs(B)
            return Derivatives(rows=np.array([*rows, following[0]]), piecewise=True, last=following, doubt=doubt)
        c = following[0]
        if not (np.abs(c) > 2 * error).any():
            break
        rows.append(c)
    raise OutsideTheory(
        f"no relative degree in cell '{plant.cell_names[0]}': no input ever reaches the output '{name}'",
        subject=(ProblemPart.B,),
        hint="track another output or add an actuator",
        remedy=Remedy(Way.STATE_TRACKING),
    )


def _check_reached(plant: PWASystem, name: str, order: int, rows: Array, error: Array, size: Array) -> None:
    """Refuse a derivative that differs between cells, (l, n), unless an input reaches it in each of them."""
    delta, doubt = rows @ plant.B, (error + 4 * len(error) * EPS * np.abs(rows)) @ np.abs(plant.B)
    missed = np.asarray((np.abs(delta) <= doubt).all(axis=1))
    if not missed.any():
        return  # else the next one jumps at facets, by γ Hᵀ f(x) where rows differ by γ Hᵀ
    facets = plant.partition.facets
    bent = [f for f in facets if (np.abs(rows[f.i] - rows[f.j]) > size).any()]
    facet = next(f for f in bent if missed[f.i] or missed[f.j])  # cells are connected through facets
    one, other = (facet.i, facet.j) if missed[facet.i] else (facet.j, facet.i)
    column = int(np.argmax(np.abs(rows[one] - rows[other]) / np.maximum(size, EPS * size.max())))
    entries = " and ".join(number_text(rows[i, column], ".6g") for i in (one, other))
    names = plant.cell_names
    reach = "before an input enters" if missed.all() else f"and no input enters it in '{names[one]}'"
    raise OutsideTheory(
        f"not of form (11): row C A^{order} differs between cells '{names[one]}' and "
        f"'{names[other]}' {reach}: entry '{plant.states[column]}' is {entries}, so derivative "
        f"{order + 1} of '{name}' jumps on {plant.hyperplane_text(facet.k)}, whatever the input does",
        subject=(ProblemPart.C if plant.tracked_names == plant.outputs else ProblemPart.TRACKED,),
        hint="another output may have the same derivatives in every cell",
        remedy=Remedy(Way.STATE_TRACKING),
    )


def unsure(what: str, doubt: float) -> OutsideTheory:
    """Return the refusal of a relative degree that rounding leaves open."""
    return OutsideTheory(
        f"the relative degree is not sure: {what} may be rounding, which can reach {doubt:.3g}",
        subject=(ProblemPart.B,),
        hint="write the plant in states of similar size that act on each other directly",
    )


def last_rows(found: Sequence[Derivatives]) -> list[int]:
    """Return which rows, of those of all outputs after each other, are the last derivatives.

    Example:
        >>> one = Derivatives(rows=np.eye(2), piecewise=False, last=np.eye(2)[1:], doubt=np.zeros(1))
        >>> last_rows([one, one])
        [1, 3]
    """
    ends: list[int] = (np.cumsum([d.degree for d in found]) - 1).tolist()
    return ends


def exact_rows(exact: Matrices, found: Sequence[Derivatives]) -> tuple[list[BallMatrix], list[BallMatrix]]:
    """Return the rows c_k and offsets o_k of all outputs after each other, in the first cell, exactly."""
    n, rows, offsets = exact.A[0].shape[0], list[BallMatrix](), list[BallMatrix]()
    for j, d in enumerate(found):
        rows.append(exact.tracked.part([j], range(n)))
        offsets.append(BallMatrix.of([[0]]))
        for _ in range(d.degree - 1):
            offsets.append(rows[-1] @ exact.b[0])
            rows.append(rows[-1] @ exact.A[0])
    return rows, offsets
