"""The normal form (11) of a plant, and what estimated loads shift."""

from collections.abc import Callable
from fractions import Fraction
from functools import reduce
from typing import Any

from .balls import Ball, frozen, stacked, unlike, zero
from .matrices import AuditFault, Matrix, added, definite, identity, inverted, product, symmetric_part, times
from .plant import AuditedPlant
from .reading import matrix, number, place


def normal_form(plant: AuditedPlant, generator: Any, resting: Any = None) -> tuple[list[Ball], Ball | None]:
    """Return A_eta of (17), and by what loads shift x_d, after checking that the plant has the form that is claimed.

    With H = resting, eta + H s is played back: then no load may act on this eta in any cell.
    """
    degrees = generator["relative_degrees"]
    (T, _), r, n, found = coordinates(plant, generator), sum(degrees), len(plant.B[0]), list[Ball]()
    backs = once(Ball.inverse, T)
    if plant.elements is not None and len(unlike(T)) > 1:
        raise AuditFault("the last derivative of an output differs between cells, which are not listed")
    for T_i, A_i, back in zip(T, plant.A, backs, strict=True):
        found.append((T_i @ A_i @ back).rows(r, n).T.rows(r, n).T)
    if ("A_eta" in generator) != (plant.elements is None):
        raise AuditFault("A_eta is there where all cells are listed, and only there")
    if plant.elements is None and [matrix(X) for X in generator["A_eta"]] != [X for X, _ in found]:
        raise AuditFault("A_eta is not that of the plant")
    if [matrix(X) for X in generator["T"]] != [X for X, _ in (T if plant.elements is None else T[:1])]:
        raise AuditFault("T is not that of the plant")
    return found, shift(plant, degrees, T, backs, [] if resting is None else matrix(resting))


def coordinates(plant: AuditedPlant, generator: Any) -> tuple[list[Ball], list[Ball]]:
    """Return the change of state T of each cell, and its rows of the last derivatives, after checking that they fit."""
    n, degrees = len(plant.B[0]), generator["relative_degrees"]
    r, p, m = sum(degrees), len(degrees), len(plant.B[0][0])
    internal, Z = [place(j, n) for j in generator["internal"]], matrix(generator["directions"])
    fits = len(internal) == len(generator["eta"]) == n - r and p == len(plant.tracked[0]) == len(generator["scales"])
    if not fits or min(degrees) < 1 or [len(row) for row in Z] != [p] * m:
        raise AuditFault("the form (11) does not fit the plant")
    outputs = [tracked_derivatives(plant, j, degree) for j, degree in enumerate(degrees)]
    C = [stacked(*(rows.row(-1) for rows in cell)) for cell in zip(*outputs, strict=True)]
    BZ = plant.B @ Ball(Z)
    one_to_one([C_i @ BZ for _, C_i in unlike(C)], [number(v) for v in generator["scales"]])
    share, eye = BZ @ (C[0] @ BZ).inverse(), Ball(identity(n, 1))
    N = [eye.row(j) - share.row(j) @ C[0] for j in internal]
    return [stacked(*cell, *N) for cell in zip(*outputs, strict=True)], C


def tracked_derivatives(plant: AuditedPlant, j: int, degree: int) -> list[Ball]:
    """Return in each cell the rows c_k of the derivatives of a tracked output, k < degree.

    B reaches none but the last of them, which alone may differ between cells.
    """
    row = rows = plant.tracked.row(j)
    for k in range(degree - 1):
        if any(product(row[0], plant.B[0])[0]):
            raise AuditFault(f"the relative degree is not {degree}")
        if k == degree - 2:
            break
        following = row @ plant.A[0]
        for (A, _), (b, _) in zip(plant.A, plant.b, strict=True):
            if product(row[0], A) != following[0] or product(row[0], b) != product(row[0], plant.b[0][0]):
                raise AuditFault("the derivatives of the output differ between cells before the input enters")
        row = following
        rows = stacked(rows, row)
    return [rows] * len(plant.A) if degree == 1 else once(lambda A: stacked(rows, row @ A), plant.A)


def one_to_one(D: list[Ball], scales: list[Fraction]) -> None:
    """Check sym(S D_i M S^-1) > 0 for M the inverse of the mean of these D_i and S the diagonal of the scales.

    Then no matrix in the hull of the D_i is singular: along the directions of the inputs, last derivatives that differ
    between cells are one-to-one all the same, and they are a change of state with the other coordinates.
    """
    if any(v <= 0 for v in scales):
        raise AuditFault("a scale is not positive")
    total = reduce(added, (X for X, _ in D))
    mean = inverted(times(total, Fraction(1, len(D))))
    for X, _ in D:
        ratios = [[a / b for b in scales] for a in scales]
        Q = [[v * w for v, w in zip(*rows, strict=True)] for rows in zip(product(X, mean), ratios, strict=True)]
        if not definite(symmetric_part(Q)):
            raise AuditFault("the last derivatives of the outputs are not moved the same way in all cells")


def shift(plant: AuditedPlant, degrees: list[int], T: list[Ball], backs: list[Ball], H: Matrix) -> Ball | None:
    """Return X = -T_i^-1 G, by which estimated loads shift x_d: g_0 = 0, g_k+1 = c_k E + g_k S, G = [g; -H]."""
    if plant.loads is None:
        return None
    E, S = plant.loads
    nothing, G = zero(1, len(E[0][0])), list[Ball]()
    for degree in degrees:
        G.append(nothing)
        for _ in range(degree - 1):
            G.append(T[0].row(len(G) - 1) @ E + G[-1] @ S)
    r, n = len(G), len(E[0])
    if H and (len(H) != n - r or any(len(row) != len(S[0]) for row in H)):
        raise AuditFault("what loads add to eta does not fit the plant")
    whole = stacked(*G, -Ball(H) if H else zero(n - r, len(E[0][0])))
    shifts = unlike(once(lambda back: -(back @ whole), backs))
    if len(shifts) > 1:
        raise AuditFault("loads move a derivative that differs between cells")
    X = shifts[0][1]
    for T_i, A_i in zip(T, plant.A, strict=True) if H else ():
        W, open_ = T_i @ (A_i @ X + E) + whole @ S
        if open_ or any(any(row) for row in W[r:]):
            raise AuditFault("a load acts on an eta that is played back")
    return X


def once(function: Callable[[Ball], Ball], balls: list[Ball]) -> list[Ball]:
    """Apply a function to each, to those that are equal once."""
    keys = [frozen(ball) for ball in balls]
    found = {key: function(ball) for key, ball in dict(zip(keys, balls, strict=True)).items()}
    return [found[key] for key in keys]
