"""What any reference that keeps its limits takes of the inputs: an interval that u_ff of (16) never leaves, proved.

v = (ξ_d, y_d⁽ʳ⁾) is in a box of centre v_c and half-widths w, whatever the set-points are, and z = η̂ − η_c − M (ξ_d −
ξ_c), any M, is driven by each of its entries, by as much more as other cells differ, and from a start. For each of
these an ellipsoid bounds rows of z (see `lmi.ellipsoid`); along one solution they add up. In a cell u_ff is c (v −
v_c, z) + γ, where rows have R (v − v_c, z) + ρ ≥ 0: it is at most |c + λ R| (w, most of z) + γ + λ ρ for every λ ≥ 0.
It is derived in `docs/theory/beyond.md`, *What they take of the inputs*.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
import scipy  # whose parts are imported where they are used

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, above, beside, different, text, zero
from pwatrack.control.demand import Demand, Kept, exact
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.lmi.ellipsoid import Inner, ellipsoid, from_start
from pwatrack.lmi.exact import Certificate
from pwatrack.model.normal_form import NormalForm
from pwatrack.rational import fraction_of

MOST_CELLS = 100  # each takes some linear programs, and is in the certificate with all its matrices
_LONG = 200  # bits of a number that is rather rounded
_DIGITS = 12  # of a multiplier that may be meant to be a short number
_FLAT = 1e-12  # of the largest multiplier: what is less is rounding
_MISSED = 1e-9  # of the terms of its rows: by how much a cell that is not reached is missed at least

Form = tuple[BallMatrix, BallMatrix, BallMatrix]


def demand(generator: TrajectoryGenerator, kept: Kept) -> Demand:
    """Return between what u_ff is for any reference that keeps its limits, proved; or why that is not known."""
    form, m, inner = generator.form, generator.form.D.shape[2], None
    missing = not_tried(generator, kept)
    if missing:
        return Demand.unknown(kept, m, missing)
    if form.eta_names:
        assert isinstance(generator.certificate, Certificate)
        inner = Inner.proved(np.asarray(np.linalg.inv(generator.certificate.P)), generator.rate)  # P of ΨᵀP + P Ψ ≺ 0
    rows = cell_rows(form)
    rest = _at_rest(rows, kept)
    tube = None if rest is None else _tube(rows, kept, *rest, inner)
    if tube is None:
        return Demand.unknown(kept, m, "no ellipsoid was found that the internal states stay in")
    return tube.demand(rows, kept)


def not_tried(generator: TrajectoryGenerator, kept: Kept) -> str:
    """Return why nothing is tried; "" where it is."""
    form = generator.form
    if len(form.plant.A) > MOST_CELLS:
        return f"there are {len(form.plant.A):,} cells, and up to {MOST_CELLS} are looked at"
    if form.eta_names and not isinstance(generator.certificate, Certificate):
        return "no common P proves (17), and by one internal states are bounded"
    open_ = unsaid(form, kept)
    return f"it depends on {' and '.join(open_)}, of which no range is given" if open_ else ""


def unsaid(form: NormalForm, kept: Kept) -> list[str]:
    """Return the outputs of which no range is given, where u_ff depends on them and not on their derivatives alone."""
    named = [(name, k) for name, k in zip(form.plant.tracked_names, kept.firsts, strict=True) if kept.box[k] is None]
    parts = [X for rows in cell_rows(form) for X in rows[: 2 if len(form.plant.A) == 1 else 3]] if named else []
    return [name for name, k in named if any(any(_sizes(X.part(range(X.shape[0]), [k]))) for X in parts)]


def cell_rows(form: NormalForm) -> list[Form]:
    """Return in each cell u_ff, η̇, and what is nowhere negative there, as rows on (ξ, η, y⁽ʳ⁾, 1), exactly."""
    exact, plant, partition = form.exact, form.plant.exact, form.plant.partition
    n, r, p, found = form.T.shape[1], form.r, len(form.degrees), list[Form]()
    last, order = [k - 1 for k in accumulate(form.degrees)], [*range(n), *range(n + 1, n + 1 + p), n]
    BZ = plant.B @ exact.directions
    for i, (T, o, back) in enumerate(zip(exact.T, exact.offset, exact.inverse, strict=True)):
        whole = T @ plant.A[i] @ back
        field = beside(whole, T @ plant.b[i] - whole @ o)  # of (ξ, η)' where u is 0, on (ξ, η, 1)
        X = exact.directions @ (T.part(last, range(n)) @ BZ).inverse()
        u_ff = beside((X @ field.part(last, range(n + 1))).times(Fraction(-1)), X)
        eta = beside(field.part(range(r, n), range(n + 1)), zero(n - r, p))
        sides = [(k, int(side)) for k, side in enumerate(partition.signs[i]) if side]
        H = BallMatrix.of([[side * v for v in partition.exact_H[k]] for k, side in sides], (len(sides), n))
        h = BallMatrix.of([[side * partition.exact_h[k]] for k, side in sides], (len(sides), 1))
        turned = H @ back
        inside = beside(turned, h - turned @ o, zero(len(sides), p))
        found.append((_ordered(u_ff, order), _ordered(eta, order), _ordered(inside, order)))
    return found


def _at_rest(rows: Sequence[Form], kept: Kept) -> tuple[int, list[Fraction]] | None:
    """Return a cell, and the η in it with which the generator rests, or nearly so, in the middle of the box."""
    p, r = len(kept.degrees), sum(kept.degrees)
    best, deepest = None, -np.inf
    for i, (_, rate, inside) in enumerate(rows):
        q = rate.shape[0]
        known = rate.part(range(q), [*range(r), r + q + p]) @ _column([*kept.centre[:r], 1])
        try:
            found = [
                -fraction_of(v) for v in (rate.part(range(q), range(r, r + q)).centre.inv() * known.centre).entries()
            ]
        except ZeroDivisionError:
            continue
        if any(v.numerator.bit_length() + v.denominator.bit_length() > _LONG for v in found):
            found = [exact(float(v)) for v in found]
        at = inside @ _column([*kept.centre[:r], *found, *[0] * p, 1])
        at = at.centre if at.radius is None else at.centre - at.radius
        depth = min((float(fraction_of(v)) for v in at.entries()), default=np.inf)
        if depth >= 0 and depth > deepest:
            best, deepest = (i, found), depth
    return best


def moved(M: BallMatrix, kept: Kept, eta: Sequence[Fraction]) -> BallMatrix:
    """Return S with (ξ, η, y⁽ʳ⁾, 1) = S (v − v_c, z, 1), η = η_c + z + M (ξ − ξ_c)."""
    q, p, r = len(eta), len(kept.degrees), sum(kept.degrees)
    unit, every = BallMatrix.of(np.eye(r + p + q + 1)), range(r + p + q + 1)
    middle = beside(M, zero(q, p), unit.part(range(q), range(q)), zero(q, 1)) if q else zero(0, len(every))
    turned = above(unit.part(range(r), every), middle, unit.part([*range(r, r + p), r + p + q], every))
    return turned + beside(zero(len(every), r + p + q), _column([*kept.centre[:r], *eta, *kept.centre[r:], 0]))


def driving(rate: BallMatrix, S: BallMatrix, M: BallMatrix, degrees: Sequence[int]) -> BallMatrix:
    """Return z' on (v − v_c, z, 1), from η̇ on (ξ, η, y⁽ʳ⁾, 1): in the middle of the box all derivatives are 0."""
    r, following, place = sum(degrees), list[int](), 0
    for j, degree in enumerate(degrees):
        following += [*range(place + 1, place + degree), r + j]
        place += degree
    N = BallMatrix.of([[int(k == to) for k in range(S.shape[1])] for to in following])
    return rate @ S - M @ N


def _shift(rows: Sequence[Form], kept: Kept, inner: Inner) -> Array:
    """Return the M (n − r, r) with which z is driven least: squares summed over cells, counted in the Q."""
    r, columns, q = sum(kept.degrees), len(kept.box), len(inner.Q)
    near = np.linalg.inv(np.linalg.cholesky(inner.Q))
    widths, rates = np.array([float(w) for w in kept.widths]), different([rate for _, rate, _ in rows])

    def driven(M: Array) -> Array:
        exact = BallMatrix.of(M, (q, r))
        S = moved(exact, kept, [Fraction(0)] * q)
        found = [driving(rate, S, exact, kept.degrees).floats[:, :columns] for rate in rates]
        return np.concatenate([(near @ X * widths).ravel() for X in found])

    start = driven(np.zeros((q, r)))
    units = np.eye(q * r).reshape(q * r, q, r)
    steps = np.array([driven(unit) - start for unit in units]).T
    found = np.linalg.lstsq(steps, -start, rcond=1e-12)[0].reshape(q, r)
    return np.asarray(np.round(found, 12) + 0.0)


def acting(
    rates: Sequence[BallMatrix], cell: int, kept: Kept, M: BallMatrix, eta: Sequence[Fraction]
) -> Iterator[tuple[str, int, BallMatrix, Fraction]]:
    """Yield what drives z, from z' on (v − v_c, z, 1) in each cell: a kind, which, its column, and how large it is."""
    own, q, widths, r = rates[cell], len(eta), kept.widths, M.shape[1]
    for k, width in enumerate(widths):
        column = own.part(range(q), [k])
        if width and any(_sizes(column)):
            yield "v", k, column, width
    ends, rest = [own.shape[1] - 1], list[Fraction]()
    for j in range(q):
        off = [_sizes((X - own).part([j], range(len(widths)))) for X in rates if X is not own]
        most = max((_total(row, widths) for row in off), default=Fraction(0))
        rest.append(most + _sizes(own.part([j], ends))[0])
    for j, size in enumerate(rest):
        if size:
            yield "rest", j, _column([int(j == k) for k in range(q)]), size
    off_xi = _column([a - b for a, b in zip(kept.start[:r], kept.centre[:r], strict=True)])
    z = _column([a - b for a, b in zip(kept.start[r:], eta, strict=True)]) - M @ off_xi
    if any(_sizes(z)):
        yield "start", 0, z, Fraction(1)


def _tube(rows: Sequence[Form], kept: Kept, cell: int, eta: list[Fraction], inner: Inner | None) -> "_Tube | None":
    """Return what z stays in; None where that is not found."""
    q, r, p = len(eta), sum(kept.degrees), len(kept.degrees)
    M = zero(0, r) if inner is None else BallMatrix.of(_shift(rows, kept, inner), (q, r))
    S = moved(M, kept, eta)
    forms = zero(0, 0) if inner is None else _forms(rows, S, slice(r + p, r + p + q))
    rates = [driving(rate, S, M, kept.degrees) for _, rate, _ in rows]
    matrices = different([X.part(range(q), range(r + p, r + p + q)) for X in rates])
    sizes, parts = [Fraction(0)] * forms.shape[0], list[dict[str, Any]]()
    for of, k, column, size in acting(rates, cell, kept, M, eta):
        found = (from_start if of == "start" else ellipsoid)(matrices, column, forms, [] if inner is None else [inner])
        if found is None:
            return None
        above_ = [exact(np.nextafter(each, np.inf)) for each in found.sizes]  # whose decimals are not below it
        sizes = [total + each * size for total, each in zip(sizes, above_, strict=True)]
        Q = {"integers": [list(row) for row in found.integers], "exponents": list(found.exponents)}
        parts.append({"of": of, "k": k, "sizes": [text(v) for v in above_], "a": text(exact(found.a)), "Q": Q})
    proof = {
        "box": kept.texts,
        "start": [text(v) for v in kept.start],
        "cell": cell,
        "centre": [text(v) for v in eta],
        "M": M.texts,
        "forms": forms.texts,
        "parts": parts,
    }
    return _Tube(S=S, widths=[*kept.widths, *sizes[:q]], forms=forms, sizes=sizes, proof=proof)


def _forms(rows: Sequence[Form], S: BallMatrix, z: slice) -> BallMatrix:
    """Return rows of z that are to be bounded: each entry, and what u_ff and the bounds of cells have of it."""
    q = z.stop - z.start
    found = {tuple(row): None for row in np.eye(q).tolist()}
    for row in (row for u_ff, _, inside in rows for X in (u_ff, inside) for row in (X @ S).floats[:, z].tolist()):
        if np.count_nonzero(row) > 1 and tuple(-v for v in row) not in found:
            found[tuple(v + 0.0 for v in row)] = None
    return BallMatrix.of([*found], (len(found), q))


@dataclass(frozen=True, kw_only=True)
class _Tube:
    """What (v − v_c, z) stays in: a box, and |forms z| ≤ sizes."""

    S: BallMatrix  # turns (v − v_c, z, 1) into (ξ, η, y⁽ʳ⁾, 1)
    widths: list[Fraction]  # of the box
    forms: BallMatrix  # (q, n − r): the first are the entries of z
    sizes: list[Fraction]
    proof: dict[str, Any]

    @cached_property
    def slabs(self) -> BallMatrix:
        """Rows that are nowhere negative in it: sizes ± forms z beyond the entries of z."""
        N, q = len(self.widths), self.forms.shape[1]
        more = range(q, self.forms.shape[0])
        if not more:
            return zero(0, N + 1)
        rows, sizes = self.forms.part(more, range(q)), _column([self.sizes[k] for k in more])
        return above(*(beside(zero(len(more), N - q), rows.times(Fraction(s)), sizes) for s in (1, -1)))

    def demand(self, rows: Sequence[Form], kept: Kept) -> Demand:
        """Return between what u_ff is in it, over all cells that it reaches."""
        m, cells = rows[0][0].shape[0], list[dict[str, Any]]()
        most = [[list[Fraction](), list[Fraction]()] for _ in range(m)]
        for u_ff, _, inside in rows:
            bounds = above(inside @ self.S, self.slabs)
            unmet = self._unmet(bounds)
            if unmet is not None:
                cells.append({"not_reached": _texts(unmet)})
                continue
            found: dict[str, list[list[str]]] = {"lowest": [], "highest": []}
            for k in range(m):
                for side, name in enumerate(found):
                    row = (u_ff.part([k], range(u_ff.shape[1])) @ self.S).times(Fraction(2 * side - 1))
                    far, weights = min((largest(row, w, bounds, self.widths), w) for w in self._weights(row, bounds))
                    most[k][side].append(far)
                    found[name].append(_texts(weights))
            cells.append(found)
        ends = [(-max(low), max(high)) for low, high in most]
        low, high = (np.array([_outward(pair[side], side) for pair in ends]) for side in (0, 1))
        u_ff_ends = [[text(exact(a)), text(exact(b))] for a, b in zip(low, high, strict=True)]
        return Demand(kept=kept, low=low, high=high, proof=self.proof | {"cells": cells, "u_ff": u_ff_ends})

    def _inequalities(self, bounds: BallMatrix) -> tuple[Array, Array, Array]:
        """Return the bounds as rows and right sides, for x in widths, each in its size; and these sizes."""
        active, scale = bounds.floats, np.array([float(w) for w in self.widths])
        size = np.abs(active) @ np.append(scale, 1.0)
        size[size == 0] = 1.0
        return -active[:, :-1] * scale / size[:, None], active[:, -1] / size, size

    def _weights(self, row: BallMatrix, bounds: BallMatrix) -> list[list[float]]:
        """Return λ for which the bound of a row in a cell is least, about, and the same in fewer digits; and 0."""
        rows, most, size = self._inequalities(bounds)
        if not len(rows):
            return [[]]
        c, nothing = row.floats[0, :-1] * np.array([float(w) for w in self.widths]), [0.0] * len(rows)
        unit = float(np.abs(c).sum()) or 1.0
        found = scipy.optimize.linprog(-c / unit, A_ub=rows, b_ub=most, bounds=(-1, 1))
        if found.status != 0:
            return [nothing]
        weights = _short(-found.ineqlin.marginals * unit / size)
        return [nothing, [float(f"{v:.{_DIGITS}g}") for v in weights], weights]

    def _unmet(self, bounds: BallMatrix) -> list[float] | None:
        """Return λ ≥ 0 that shows that not all rows are positive anywhere in the box; None where they may be."""
        rows, most, size = self._inequalities(bounds)
        if not len(rows):
            return None
        rows, ends = np.column_stack([rows, -np.ones(len(rows))]), [*[(-1.0, 1.0)] * len(self.widths), (0.0, None)]
        objective = np.eye(1, len(ends), len(ends) - 1)[0]
        least = scipy.optimize.linprog(objective, A_ub=rows, b_ub=most, bounds=ends)
        if least.status != 0 or not least.fun or least.fun < _MISSED:
            return None
        weights = _short(-least.ineqlin.marginals / size)
        nothing = zero(1, bounds.shape[1])
        return weights if largest(nothing, weights, bounds, self.widths) < 0 else None


def largest(row: BallMatrix, weights: Sequence[float], bounds: BallMatrix, widths: Sequence[Fraction]) -> Fraction:
    """Return what c x + γ is at most where all bounds R x + ρ ≥ 0 and |x| ≤ widths, by weights λ ≥ 0 of these."""
    total = row
    if weights:
        total = row + BallMatrix.of([[exact(v) for v in weights]]) @ bounds
    values = _sizes(total)
    constant = fraction_of(total.centre.entries()[-1])
    return constant + (values[-1] - abs(constant)) + _total(values[:-1], widths)


def _short(weights: Array) -> list[float]:
    """Return multipliers without what is rounding."""
    found: list[float] = np.where(weights > _FLAT * np.abs(weights).max(initial=0.0), weights, 0.0).tolist()
    return found


def _texts(weights: Sequence[float]) -> list[str]:
    return [text(exact(v)) for v in weights]


def _outward(value: Fraction, side: int) -> float:
    """Return a double that is not above (side 0) or not below a number."""
    near, to = float(value), (-np.inf, np.inf)[side]
    within = exact(near) <= value if side == 0 else exact(near) >= value
    return near + 0.0 if within else float(np.nextafter(near, to))


def _column(values: Sequence[Any]) -> BallMatrix:
    return BallMatrix.of([[v] for v in values], (len(values), 1))


def _ordered(X: BallMatrix, order: Sequence[int]) -> BallMatrix:
    return X.part(range(X.shape[0]), order)


def _total(sizes: Sequence[Fraction], widths: Sequence[Fraction]) -> Fraction:
    return sum((a * w for a, w in zip(sizes, widths, strict=True)), Fraction(0))


def _sizes(X: BallMatrix) -> list[Fraction]:
    """Return the largest size of each entry, row by row."""
    centre = [abs(fraction_of(v)) for v in X.centre.entries()]
    if X.radius is None:
        return centre
    return [size + fraction_of(r) for size, r in zip(centre, X.radius.entries(), strict=True)]
