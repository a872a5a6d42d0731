"""The normal form (11) of a plant, and what estimated loads shift."""

from fractions import Fraction
from typing import Any

from .balls import Ball, inverse, less, negative, part, plus, stacked, times
from .matrices import Fault, Matrix, product
from .plant import Plant
from .reading import matrix


def normal_form(plant: Plant, generator: Any) -> tuple[list[Ball], Ball | None]:
    """Return A_eta of (17), and by what loads shift x_d, after checking that the plant has the form that is claimed."""
    n, r = len(plant.B[0]), int(generator["relative_degree"])
    internal = [int(j) for j in generator["internal"]]
    if len(plant.tracked[0]) != 1 or len(plant.B[0][0]) != 1 or not 1 <= r <= n or len(internal) != n - r:
        raise Fault("the form (11) does not fit the plant")
    derivatives = tracked_derivatives(plant, r)
    last = part(derivatives, r - 1)
    delta, T = times(last, plant.B), derivatives
    for j in internal:
        share = times(part(plant.B, j), inverse(delta))
        own = [[Fraction(int(j == k)) for k in range(n)]]
        T = stacked(T, less((own, []), times(share, last)))
    back, found = inverse(T), list[Ball]()
    for cell in plant.A:
        X, R = times(times(T, cell), back)
        found.append(([line[r:] for line in X[r:]], [line[r:] for line in R[r:]] if R else []))
    if [matrix(X) for X in generator["A_eta"]] != [X for X, _ in found] or matrix(generator["T"]) != T[0]:
        raise Fault("A_eta or T is not that of the plant")
    return found, shift(plant, derivatives, back)


def tracked_derivatives(plant: Plant, r: int) -> Ball:
    """Return the rows c_k of the derivatives of what is tracked, k < r, of which B reaches the last one alone."""
    row, rows = plant.tracked, plant.tracked
    for k in range(r):
        following, reached = times(row, plant.A[0]), product(row[0], plant.B[0])[0][0]
        if (reached == 0) != (k < r - 1):
            raise Fault(f"the relative degree is not {r}")
        for (A, _), (b, _) in zip(plant.A, plant.b, strict=True):
            if k < r - 1 and (
                product(row[0], A) != following[0] or product(row[0], b) != product(row[0], plant.b[0][0])
            ):
                raise Fault("the derivatives of the output differ between cells before the input enters")
        if k < r - 1:
            row = following
            rows = stacked(rows, row)
    return rows


def shift(plant: Plant, rows: Ball, back: Ball) -> Ball | None:
    """Return X = -T^-1 G, by which estimated loads shift x_d: g_0 = 0, g_k+1 = c_k E + g_k S, G = [g; 0]."""
    if plant.loads is None:
        return None
    E, S = plant.loads
    p = len(E[0][0])
    g: Ball = [[Fraction(0)] * p], []
    G = g
    for k in range(len(rows[0]) - 1):
        g = plus(times(part(rows, k), E), times(g, S))
        G = stacked(G, g)
    below: Matrix = [[Fraction(0)] * p for _ in range(len(E[0]) - len(G[0]))]
    return negative(times(back, stacked(G, (below, []))))
