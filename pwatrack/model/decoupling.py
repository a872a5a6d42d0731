"""How inputs act on the last derivatives of what is tracked: the decoupling matrix D, and refusals of it."""

from collections.abc import Sequence
from functools import reduce
from operator import add

import numpy as np

from pwatrack.arrays import TINY, Array, balancing, number_text
from pwatrack.ball_matrix import BallMatrix, different, each, stack
from pwatrack.errors import OutsideTheory, ProblemPart, Remedy, Way
from pwatrack.model.derivatives import Derivatives, exact_rows, last_rows, unsure
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import is_positive_definite, stacked

_DIGITS = 6  # of the directions of the inputs: nothing but the size of u_ff depends on more


def input_directions(plant: PWASystem, found: Sequence[Derivatives], sizes: Array | None) -> BallMatrix:
    """Return Z: all inputs where there are as many as outputs, else the least ones in sizes (m,) that move one each."""
    m, p = plant.B.shape[1], len(found)
    if m == p:
        return BallMatrix.of(np.eye(m))
    size = np.ones(m) if sizes is None else sizes
    D = np.array([d.last[0] for d in found]) @ plant.B * size
    weight = np.linalg.norm(D, axis=1)
    Z = np.linalg.pinv(D / weight[:, None])
    Z[np.abs(Z) < 10.0**-_DIGITS * np.abs(Z).max(axis=0)] = 0.0
    Z = size[:, None] * Z / weight
    return BallMatrix.of([[float(f"{v:.{_DIGITS - 1}e}") for v in row] for row in Z])


def check_independent(plant: PWASystem, found: Sequence[Derivatives], Z: BallMatrix) -> None:
    """Refuse inputs with a D_i Z that is singular, in fractions, or where rounding leaves open whether it is."""
    doubt = np.array([d.doubt for d in found]) @ np.abs(Z.floats)
    C = np.array([d.last for d in found]).transpose(1, 0, 2)  # (l, p, n)
    bent, (rows, _) = any(d.piecewise for d in found), exact_rows(plant.exact, found)
    for i, C_i in enumerate(C if bent else C[:1]):
        D = C_i @ plant.B @ Z.floats
        try:
            off = np.abs(np.linalg.inv(D)) @ doubt
        except np.linalg.LinAlgError:
            off = np.array([[np.inf]])
        if np.isfinite(off).all() and np.abs(np.linalg.eigvals(off)).max() < 1:
            continue
        exactly = [
            rows[k - 1] @ plant.exact.A[i] if d.piecewise else rows[k]
            for k, d in zip(last_rows(found), found, strict=True)
        ]
        if not stacked([(row @ plant.exact.B @ Z).centre for row in exactly]).det():
            raise _dependent(plant, found, Z, i)
        raise unsure(f"C A^(r - 1) B of {_listed(plant.tracked_names)}", float(doubt.max()))


def one_to_one(plant: PWASystem, found: Sequence[Derivatives], D: Sequence[BallMatrix]) -> tuple[float, ...]:
    """Return the diagonal of S with sym(S D_i D⁻¹ S⁻¹) ≻ 0 in all cells, D the mean of all D_i (p, p), or refuse."""
    if not any(d.piecewise for d in found):
        return (1.0,) * len(found)
    try:
        mean = (reduce(add, (D_i.centre for D_i in D)) / len(D)).inv()
    except ZeroDivisionError:
        raise _folded(plant, found, D) from None
    Q = each(lambda D_i: BallMatrix(D_i.centre * mean), D)
    scales = 1 / balancing(stack(Q))
    S = BallMatrix.of(np.diag(scales))
    turned = each(lambda Q_i: S @ Q_i @ S.inverse(), Q)
    if not all(is_positive_definite(X.centre + X.centre.transpose()) for X in different(turned)):
        raise _folded(plant, found, D)
    return tuple(scales.tolist())


def too_few_inputs(plant: PWASystem) -> OutsideTheory:
    """Return the refusal of more tracked outputs than inputs."""
    m, p = plant.B.shape[1], len(plant.tracked)
    return OutsideTheory(
        f"output tracking (Theorem 3) needs as many inputs as tracked outputs, the plant has {m} and {p}",
        subject=(ProblemPart.PLANT,),
        hint="say which of them follow the reference",
        remedy=Remedy(Way.TRACKED, (", ".join(plant.tracked_names[:m]),)),
    )


def _dependent(plant: PWASystem, found: Sequence[Derivatives], Z: BallMatrix, cell: int) -> OutsideTheory:
    """Return the refusal of inputs that do not act on the last derivatives independently in a cell."""
    D = np.array([d.last[cell] for d in found]) @ plant.B
    size = np.maximum(np.linalg.norm(D, axis=1, keepdims=True), TINY)
    weights = np.abs(np.linalg.svd(D / size @ Z.floats).U[:, -1])
    names = [name for name, w in zip(plant.tracked_names, weights, strict=True) if w > 1e-6 * weights.max()]
    rows = "; ".join(
        f"{name}: row C A^{d.degree - 1} B = ({', '.join(number_text(v, '.4g') for v in row)})"
        for name, d, row in zip(plant.tracked_names, found, D, strict=True)
        if name in names
    )
    where = f" in cell '{plant.cell_names[cell]}'" if any(d.piecewise for d in found) else ""
    return OutsideTheory(
        f"not of form (11): the inputs do not act on {_listed(names)} independently{where}: {rows}, so the "
        "decoupling matrix is singular",
        subject=(ProblemPart.B,),
        hint="track another output or add an actuator",
        remedy=Remedy(Way.STATE_TRACKING),
    )


def _folded(plant: PWASystem, found: Sequence[Derivatives], D: Sequence[BallMatrix]) -> OutsideTheory:
    """Return the refusal of last derivatives that inputs do not move the same way in all cells."""
    sizes = [np.linalg.det(D_i.floats) for D_i in D]
    low, high = int(np.argmin(sizes)), int(np.argmax(sizes))
    names = _listed([n for n, d in zip(plant.tracked_names, found, strict=True) if d.piecewise])
    figures = [number_text(sizes[i], ".4g") for i in (low, high)]
    what = "C A^(r - 1) B" if len(found) == 1 else "the determinant of the decoupling matrix"
    turned = "so it has not one sign" if sizes[low] * sizes[high] <= 0 else "and between them it may be 0"
    return OutsideTheory(
        f"not of form (11): the last derivative of {names} depends on the cell, and inputs do not move it "
        f"the same way in all: {what} is {figures[0]} in cell '{plant.cell_names[low]}' and {figures[1]} in "
        f"'{plant.cell_names[high]}', {turned}",
        subject=(ProblemPart.B,),
        hint="track another output",
        remedy=Remedy(Way.STATE_TRACKING),
    )


def _listed(names: Sequence[str]) -> str:
    quoted = [f"'{name}'" for name in names]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} and {quoted[-1]}"
