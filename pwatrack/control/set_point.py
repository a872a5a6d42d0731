"""Where a plant can rest with wanted outputs: linear equations and a cell's inequalities, solved in exact fractions."""

from dataclasses import dataclass
from typing import Any

import flint
import numpy as np
import scipy

from pwatrack.arrays import Array, readonly
from pwatrack.causes import Subject
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import OutsideTheory, Problem
from pwatrack.model.pwa import PWASystem, linear_form_text
from pwatrack.model.reference import exosystem
from pwatrack.rational import Rational, beside, decimals, floats, stacked

_ROUNDING = 1e-12  # of its terms: an equation or inequality that is missed by less holds
_MOST_SAID = 6  # cells in a refusal


def set_point(plant: PWASystem, y: Array, *, subject: Subject = ()) -> DesiredTrajectory:
    """Return the constant trajectory with c x_d = y for the tracked rows c: A_i x_d + b_i + B u_ff = 0, x_d in cell i.

    Raises:
        OutsideTheory: If no cell holds such an equilibrium.
    """
    misses = []
    for i in range(len(plant.A)):
        try:
            point = _equilibrium(plant, y, i)
        except OverflowError:  # beyond what a double holds
            point = f"that of cell '{plant.cell_names[i]}' is out of range"
        if not isinstance(point, str):
            return _constant(plant, *point)
        misses.append(point)
    more = [f"and none in {len(misses) - _MOST_SAID} more cells"] if len(misses) > _MOST_SAID else []
    raise OutsideTheory(
        Problem(
            message="no equilibrium has the wanted outputs: " + "; ".join(misses[:_MOST_SAID] + more),
            subject=subject,
            hint="choose a set-point that the plant can rest at",
        )
    )


@dataclass(frozen=True)
class _Solutions:
    """All z = start + directions s of some linear equations, in fractions: (k, 1) and (k, free)."""

    start: Rational
    directions: Rational


def _equilibrium(plant: PWASystem, y: Array, i: int) -> tuple[Array, Array] | str:
    """Return (x_d, u_ff) with A_i x_d + b_i + B u_ff = 0 and c x_d = y in cell i, or why there is none."""
    (n, m), q = plant.B.shape, len(plant.tracked)
    E = np.block([[plant.A[i], plant.B], [plant.tracked, np.zeros((q, m))]])
    exact = plant.exact
    rows = [exact.A[i].centre, exact.B.centre], [exact.tracked.centre, decimals(np.zeros((q, m)))]
    equations = stacked([beside(row) for row in rows]), stacked([-exact.b[i].centre, decimals(y[:, None])])
    found, name = _solved(*equations), plant.cell_names[i]
    if found is None:
        return f"none at all in cell '{name}'"
    bounding = np.flatnonzero(plant.partition.signs[i])
    side = plant.partition.signs[i][bounding, None]
    H = np.column_stack([side * plant.partition.H[bounding], np.zeros((len(bounding), m))])
    h = side * plant.partition.h[bounding, None]
    sides, offsets = decimals(H), decimals(h)
    z = found.start
    free = found.directions.ncols()
    if free:
        units = _units(E)
        z = _moved(found, _least(found, units))
        if not _inside(sides, offsets, z):
            z = _moved(found, _deepest(found, units, sides, offsets))
    if not _inside(sides, offsets, z):
        if free:
            return f"those of cell '{name}' lie outside it"
        depth = floats(sides * z + offsets)[:, 0]
        k = int(np.argmin(depth / np.linalg.norm(H, axis=1)))
        form = linear_form_text(H[k, :n] * side[k], plant.states)
        return f"that of cell '{name}' lies outside it, by {-depth[k]:.4g} in {form}"
    solution = floats(z)[:, 0]
    return solution[:n], solution[n:]


def _solved(E: Rational, r: Rational) -> _Solutions | None:
    """Return all solutions of E z = r; equations that follow from the others need to agree to rounding only."""
    count, k = E.nrows(), E.ncols()
    kept = _pivots(E.transpose())
    rows, right = E.tolist(), r.tolist()
    joint, rank = flint.fmpq_mat(len(kept), k + 1, [v for j in kept for v in [*rows[j], *right[j]]]).rref()
    table = joint.tolist()
    pivots = [next(c for c, v in enumerate(row) if v != 0) for row in table[:rank]]
    free = [c for c in range(k) if c not in pivots]
    start, directions = [flint.fmpq(0)] * k, [[flint.fmpq(int(c == f)) for f in free] for c in range(k)]
    for row, pivot in zip(table, pivots, strict=False):
        start[pivot], directions[pivot] = row[k], [-row[f] for f in free]
    z = flint.fmpq_mat(k, 1, start)
    rest = (E * z).tolist()
    for j in range(count):
        terms = sum((abs(a * b) for a, b in zip(rows[j], start, strict=True)), abs(right[j][0]))
        if abs(rest[j][0] - right[j][0]) > terms * flint.fmpq(1, round(1 / _ROUNDING)):
            return None
    return _Solutions(z, flint.fmpq_mat(k, len(free), [v for row in directions for v in row]))


def _pivots(X: Rational) -> list[int]:
    """Return which columns do not depend on those before them."""
    reduced, rank = X.rref()
    return [next(c for c, v in enumerate(row) if v != 0) for row in reduced.tolist()[:rank]]


def _inside(rows: Rational, offsets: Rational, z: Rational) -> bool:
    """Decide rows z + offsets ≥ 0, to rounding."""
    entries, point = rows.tolist(), z.entries()
    tolerance = flint.fmpq(1, round(1 / _ROUNDING))
    for row, offset in zip(entries, offsets.entries(), strict=True):
        parts = [a * b for a, b in zip(row, point, strict=True)]
        if sum(parts, offset) < -tolerance * sum(map(abs, parts), abs(offset)):
            return False
    return True


def _units(E: Array) -> Array:
    """Return powers of two d such that the entries of D_r E diag(d) are of size 1."""
    scaled, d = np.abs(E), np.ones(E.shape[1])
    for _ in range(8):
        size = scaled.max(axis=1, initial=0.0)
        scaled = np.ldexp(scaled, -np.where(size > 0, np.frexp(size)[1], 0)[:, None])
        size = scaled.max(axis=0, initial=0.0)
        exponents = np.where(size > 0, np.frexp(size)[1], 0)
        scaled, d = np.ldexp(scaled, -exponents), np.ldexp(d, -exponents)
    return d


def _least(found: _Solutions, d: Array) -> Array:
    """Return s where z is least in units d."""
    directions, start = floats(found.directions) / d[:, None], floats(found.start)[:, 0] / d
    size = np.maximum(np.linalg.norm(directions, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(directions / size, -start, rcond=None)[0] / size)


def _deepest(found: _Solutions, d: Array, rows: Rational, offsets: Rational) -> Array:
    """Return s where z is deepest inside a cell, in units d, up to the size of the solution; 0 if none is found."""
    start = floats(found.start)[:, 0] / d
    directions = floats(found.directions) / d[:, None]
    size = np.maximum(np.linalg.norm(directions, axis=0), 1e-300)
    sides = floats(rows) * d
    length = np.linalg.norm(sides, axis=1)
    value = (floats(rows * found.start + offsets)[:, 0]) / length
    unit = max(float(np.abs(value).max(initial=0.0)), float(np.abs(start).max(initial=0.0)), 1e-300)
    slopes = floats(rows * found.directions) / length[:, None] / size
    solution: Any = scipy.optimize.linprog(
        np.append(np.zeros(len(size)), -1.0),
        A_ub=np.column_stack([-slopes, np.ones(len(slopes))]),
        b_ub=value / unit,
        bounds=[(None, None)] * len(size) + [(None, 1.0)],
        method="highs",
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    return np.zeros(len(size)) if solution.x is None else np.asarray(solution.x[:-1] * unit / size)


def _moved(found: _Solutions, s: Array) -> Rational:
    """Return start + directions s: a solution for every s, so that s may be rounded."""
    return found.start + found.directions * decimals(s[:, None])


def _constant(plant: PWASystem, x_d: Array, u_ff: Array) -> DesiredTrajectory:
    cells, n = plant.A.shape[:2]
    return DesiredTrajectory.linear(
        plant,
        exosystem=exosystem([]),
        names=(),
        to_eta=np.zeros((0, n)),
        eta_offset=np.zeros(0),
        rate=np.zeros((cells, 0, 1)),
        x_d=readonly(x_d[:, None]),
        u_ff=np.broadcast_to(u_ff[:, None], (cells, len(u_ff), 1)),
    )
