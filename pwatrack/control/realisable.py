"""Assumption 1: a desired state trajectory x_d(t) and a feedforward u_ff(t) that satisfy (3), and what is left over.

What no input can make up for in (3) is known exactly, as a linear condition on the exosystem.

Where a plant can rest with wanted outputs, linear equations and a cell's inequalities are solved in exact fractions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any

import flint
import numpy as np
import scipy
from scipy.linalg import block_diag

from pwatrack.arrays import Array, readonly
from pwatrack.ball_matrix import absolute
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import OutsideTheory, Subject
from pwatrack.model.pwa import PWASystem, linear_form_text
from pwatrack.model.reference import Exosystem, exosystem, spectral_terms
from pwatrack.rational import Rational, beside, decimals, floats, left_null_space, on_entries, pivots, stacked

ROUNDING = 1e-11  # of the largest terms of an equation of (3) over the run: what is left over is more
_LARGEST_EXPONENT = 600.0  # e^{λT} is not followed further
_LITTLE = flint.fmpq(1, 10**12)  # of its terms: an equation or inequality that is missed by less holds
_MOST_SAID = 6  # cells in a refusal
_MOST_LOOKED = 1000  # cells, for a better set-point than one that is known
_SPARE = 0.1  # of the width of limits of an input, to be left on both sides at a set-point
_NOWHERE = 1e-12  # what is left of least squares where nothing satisfies all inequalities


@dataclass(frozen=True, kw_only=True)
class LeftOver:
    """The part of ẋ_d − A_i x_d − b_i that no input makes up for: r_i(t) = rows_i (w(t), 1), in cell i.

    As e^{St} = Σ_λ e^{λt} Σ_m t^m/m! E_λm, r_i is 0 on a stretch of time, however short, exactly where every
    rows_i E_λm (w, 1) is 0: the same as N Sᵏ w = 0 for k < dim S, but without powers of S.
    """

    rows: Array  # (l, n, p + 1)
    terms: Array  # bounds of the terms that each row is the difference of, (l, n, p + 1)
    trajectory: DesiredTrajectory  # of x_d in closed form

    def sizes(self, starts: Array, lengths: Array) -> tuple[Array, Array]:
        """Return bounds of |r_i| on pieces of x_d and of their terms, both (l, pieces, n), from all coefficients."""
        system = self.trajectory.exosystem
        w = np.column_stack([system.states(starts), np.ones(len(starts))])
        S, rates = block_diag(system.S, np.zeros((1, 1))), np.append(system.rates, 0.0)
        left = np.zeros((len(self.rows), len(starts), self.rows.shape[1]))
        size = np.zeros_like(left)
        with np.errstate(over="ignore"):
            for rate, chain in spectral_terms(S, rates):
                grown = np.exp(np.minimum(max(rate.real, 0.0) * lengths, _LARGEST_EXPONENT))
                for m, E in enumerate(chain):
                    weight = np.minimum(grown * lengths**m / factorial(m), 1e300)[:, None]
                    coefficients = weight * (w @ E.T)
                    left += np.abs(np.einsum("ijp,kp->ikj", self.rows, coefficients))
                    size += np.einsum("ijp,kp->ikj", self.terms, np.abs(coefficients))
        return left, size

    def at(self, cell: int, times: Array) -> Array:
        """Return r_i at some times in s, (T, n)."""
        w = np.column_stack([self.trajectory.exosystem.states(times), np.ones(len(times))])
        return np.asarray(w @ self.rows[cell].T)


def left_over(plant: PWASystem, trajectory: DesiredTrajectory) -> LeftOver:
    """Return what u_ff of a trajectory in closed form leaves over of (3)."""
    Q, Q_rate = trajectory.exosystem.derivative_rows(1)
    needed = needed_inputs(plant, Q, Q_rate)
    terms = np.concatenate([np.abs(Q_rate) + np.abs(plant.A) @ np.abs(Q), np.abs(plant.b)[:, :, None]], axis=2)
    mixed = np.abs(plant.B) @ np.abs(pseudo_inverse(plant.B))  # u_ff carries the rounding of the other equations
    return LeftOver(rows=needed - plant.B @ trajectory.u_ff, terms=terms + mixed @ terms, trajectory=trajectory)


def needed_inputs(plant: PWASystem, Q: Array, Q_rate: Array) -> Array:
    """Return B u_ff = ẋ_d − A_i x_d − b_i of (3) as rows on (w, 1), (l, n, p + 1), for x_d = Q w and ẋ_d = Q_rate w."""
    return np.concatenate([Q_rate - plant.A @ Q, -plant.b[:, :, None]], axis=2)


def pseudo_inverse(B: Array) -> Array:
    """Return B⁺ (m, n) in units where rows and columns of B have size 1; 0 where an input does nothing."""
    rows, columns = _scales(B, 3)
    return np.asarray(columns[:, None] * np.linalg.pinv(rows[:, None] * B * columns) * rows)


def _scales(X: Array, times: int) -> tuple[Array, Array]:
    """Return powers of two for rows and columns that bring entries to size 1, rows and columns in turn."""
    rows, columns = np.ones(len(X)), np.ones(X.shape[1])
    for _ in range(times):
        rows = rows * _inverse(np.abs(rows[:, None] * X * columns).max(axis=1, initial=0.0))
        columns = columns * _inverse(np.abs(rows[:, None] * X * columns).max(axis=0, initial=0.0))
    return rows, columns


def _inverse(size: Array) -> Array:
    """Return powers of two that bring these sizes to about 1; 1 for 0."""
    return np.asarray(np.ldexp(1.0, np.where(size > 0, -np.frexp(size)[1], 0)))


def state_trajectory(plant: PWASystem, x_d: Exosystem) -> DesiredTrajectory:
    """Return the trajectory for x_d in closed form, with u_ff solved from (3): B u_ff = ẋ_d − A_i x_d − b_i.

    Where no u_ff solves it, something is left over: see `left_over` and `simulation.desired`.
    """
    Q, Q_rate = x_d.derivative_rows(1)
    return DesiredTrajectory.linear(
        plant,
        exosystem=x_d,
        x_d=np.hstack([Q, np.zeros((len(Q), 1))]),
        u_ff=pseudo_inverse(plant.B) @ needed_inputs(plant, Q, Q_rate),
    )


def input_trajectory(plant: PWASystem, u_ff: Exosystem, start: Array | None) -> DesiredTrajectory:
    """Return the trajectory for a given u_ff: x_d is the plant's own solution, from x_d(0) = start."""
    cells, n = plant.A.shape[:2]
    s = len(u_ff.w0)
    eye = np.hstack([np.eye(n), np.zeros((n, s + 1))])
    rate = np.zeros((cells, n, n + s + 1))
    rate[:, :, :n], rate[:, :, n : n + s], rate[:, :, -1] = plant.A, plant.B @ u_ff.Q, plant.b
    inputs = np.zeros((plant.B.shape[1], n + s + 1))
    inputs[:, n : n + s] = u_ff.Q
    return DesiredTrajectory.linear(
        plant,
        exosystem=u_ff,
        names=plant.states,
        to_eta=np.eye(n),
        eta_offset=np.zeros(n),
        rate=rate,
        x_d=eye,
        u_ff=np.broadcast_to(inputs, (cells, *inputs.shape)),
        eta0=start,
    )


def set_point(
    plant: PWASystem,
    y: Array,
    *,
    sizes: Array | None = None,
    limits: Array | None = None,
    subject: Subject = (),
) -> DesiredTrajectory:
    """Return the constant trajectory with c x_d = y for the tracked rows c: A_i x_d + b_i + B u_ff = 0, x_d in cell i.

    Of many it is the least in `sizes` of states and inputs, (n + m,), or in units that balance the equations: of those
    whose inputs have a tenth of their `limits` (m, 2) to spare on both sides, or else are within these, or else of all.
    If no cell holds such an equilibrium, it is refused.
    """
    best, misses, ranges = None, list[str](), [np.tile([-np.inf, np.inf], (plant.B.shape[1], 1))]
    if limits is not None:
        spare = _SPARE * np.where(np.isfinite(limits).all(axis=1), limits[:, 1] - limits[:, 0], 0.0)[:, None]
        ranges = [limits + spare * [1, -1], limits, *ranges]
    for i in range(len(plant.A)):
        try:
            point = _equilibrium(plant, y, i, sizes, ranges)
        except OverflowError:  # beyond what a double holds
            point = f"that of cell '{plant.cell_names[i]}' is out of range"
        if isinstance(point, str):
            misses.append(point)
        elif best is None or point.key < best.key:
            best = point
        if best is not None and (not (best.free or best.key[0]) or i > _MOST_LOOKED):
            break
    if best is not None:
        return DesiredTrajectory.linear(
            plant,
            exosystem=exosystem([]),
            x_d=readonly(best.x_d[:, None]),
            u_ff=np.broadcast_to(best.u_ff[:, None], (len(plant.A), len(best.u_ff), 1)),
        )
    more = [f"and none in {len(misses) - _MOST_SAID} more cells"] if len(misses) > _MOST_SAID else []
    raise OutsideTheory(
        "no equilibrium has the wanted outputs: " + "; ".join(misses[:_MOST_SAID] + more),
        subject=subject,
        hint="choose a set-point that the plant can rest at",
    )


@dataclass(frozen=True, kw_only=True)
class _Point:
    """An equilibrium."""

    x_d: Array
    u_ff: Array
    free: int  # how many directions it may be moved in
    # of how many ranges of inputs it is in none, and its size in units that are the same in all cells, but for rounding
    key: tuple[int, float]


_Solutions = tuple[Rational, Rational]  # all z = start + directions s of some linear equations: (k, 1) and (k, free)


def _equilibrium(plant: PWASystem, y: Array, i: int, sizes: Array | None, ranges: Sequence[Array]) -> _Point | str:
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
    sides, offsets, units = decimals(H), decimals(h), _scales(E, 8)[1] if sizes is None else sizes
    z, free, within = found[0], found[1].ncols(), [_within(sides, offsets, ends, n) for ends in ranges]
    if free:
        inside = (z for z in _chosen(found, units, within) if _inside(sides, offsets, z))
        if (z := next(inside, None)) is None:
            return f"those of cell '{name}' lie outside it"
    elif not _inside(sides, offsets, z):
        depth = floats(sides * z + offsets)[:, 0]
        k = int(np.argmin(depth / np.linalg.norm(H, axis=1)))
        form = linear_form_text(H[k, :n] * side[k], plant.states)
        return f"that of cell '{name}' lies outside it, by {-depth[k]:.4g} in {form}"
    solution = floats(z)[:, 0]
    beyond = sum(not _inside(*each, z) for each in within)
    size = 0.0 if sizes is None else float(np.linalg.norm(solution / sizes))
    return _Point(x_d=solution[:n], u_ff=solution[n:], free=free, key=(beyond, float(f"{size:.9g}")))


def _chosen(found: _Solutions, d: Array, within: Sequence[tuple[Rational, Rational]]) -> Iterator[Rational]:
    """Yield the least solutions in units d that satisfy some inequalities, then the one that the last hold deepest."""
    for rows, offsets in within:
        if (s := _nearest(found, d, rows, offsets)) is not None:
            yield _moved(found, s)
    yield _moved(found, _deepest(found, d, *within[-1]))


def _within(sides: Rational, offsets: Rational, ends: Array, n: int) -> tuple[Rational, Rational]:
    """Return rows and offsets of a cell, and of inputs within some ends, (m, 2), behind n states."""
    rows, more = [sides], [offsets]
    for k, (low, high) in enumerate(ends):
        for end, sign in ((low, 1.0), (high, -1.0)):
            if np.isfinite(end):
                row = np.zeros((1, n + len(ends)))
                row[0, n + k] = sign
                rows.append(decimals(row))
                more.append(decimals(np.array([[-sign * end]])))
    return stacked(rows), stacked(more)


def _solved(E: Rational, r: Rational) -> _Solutions | None:
    """Return all solutions of E z = r; equations that follow from the others need to agree to rounding only."""
    kept, tied = pivots(E.transpose()), pivots(E)
    z = flint.fmpq_mat(E.ncols(), 1)
    for place, value in zip(tied, on_entries(E, kept, tied).solve(on_entries(r, kept, [0])).entries(), strict=True):
        z[place, 0] = value
    left, terms = E * z - r, absolute(E) * absolute(z) + absolute(r)
    if any(abs(v) > size * _LITTLE for v, size in zip(left.entries(), terms.entries(), strict=True)):
        return None
    return z, left_null_space(E.transpose()).transpose()


def _inside(rows: Rational, offsets: Rational, z: Rational) -> bool:
    """Decide rows z + offsets ≥ 0, to rounding."""
    depth, terms = rows * z + offsets, absolute(rows) * absolute(z) + absolute(offsets)
    return all(v >= -size * _LITTLE for v, size in zip(depth.entries(), terms.entries(), strict=True))


def _nearest(found: _Solutions, d: Array, rows: Rational, offsets: Rational) -> Array | None:
    """Return s where z is least in units d with rows z + offsets ≥ 0; None where there is none.

    With z / d = z₀ + Q R s and w = R s + Qᵀ z₀ it is the least w with G w ≥ h: by non-negative least squares (Lawson
    and Hanson 1974, chapter 23).
    """
    start, directions = floats(found[0])[:, 0] / d, floats(found[1]) / d[:, None]
    size = np.maximum(np.linalg.norm(directions, axis=0), 1e-300)
    Q, R = np.linalg.qr(directions / size)
    first = Q.T @ start
    G = np.linalg.solve(R.T, (floats(rows * found[1]) / size).T).T
    h = G @ first - floats(rows * found[0] + offsets)[:, 0]
    length = np.maximum(np.linalg.norm(G, axis=1), 1e-300)
    h = np.asarray(h / length)
    if not (h > 0).any():
        return np.asarray(np.linalg.solve(R, -first) / size)
    unit = max(float(np.abs(h).max(initial=0.0)), 1e-300)
    E = np.vstack([(G / length[:, None]).T, h / unit])
    one = np.append(np.zeros(len(first)), 1.0)
    rest = E @ scipy.optimize.nnls(E, one)[0] - one
    if not -rest[-1] > _NOWHERE:
        return None
    return np.asarray(np.linalg.solve(R, -rest[:-1] / rest[-1] * unit - first) / size)


def _deepest(found: _Solutions, d: Array, rows: Rational, offsets: Rational) -> Array:
    """Return s where z is deepest inside a cell, in units d, up to the size of the solution; 0 if none is found."""
    start, directions = floats(found[0])[:, 0] / d, floats(found[1]) / d[:, None]
    size = np.maximum(np.linalg.norm(directions, axis=0), 1e-300)
    sides = floats(rows) * d
    length = np.linalg.norm(sides, axis=1)
    value = (floats(rows * found[0] + offsets)[:, 0]) / length
    unit = max(float(np.abs(value).max(initial=0.0)), float(np.abs(start).max(initial=0.0)), 1e-300)
    slopes = floats(rows * found[1]) / length[:, None] / size
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
    return found[0] + found[1] * decimals(s[:, None])
