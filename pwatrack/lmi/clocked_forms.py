"""Clock-dependent forms looked for in floating point: what they have to satisfy is in `clocked`, and proved there.

In coordinates in which Σ |z_k|² over the ticks of the mean of the vertices is I, which makes P of size 1; margins count
in what a form loses in a period at the largest rate. Of many vertices few decide: those that the forms found so far do
not satisfy are added, until all are satisfied.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import TypeVar

import clarabel
import numpy as np
from scipy import sparse
from scipy.linalg import expm, solve_discrete_lyapunov

from pwatrack.arrays import Array, balancing, symmetric_part
from pwatrack.lmi.bisection import bisected
from pwatrack.lmi.chain_map import Bound, ChainMap, Term
from pwatrack.lmi.cone_program import minimise, symmetric_of, upper
from pwatrack.lmi.primal_dual import least

_FIRST = 8  # vertices that are asked for at first, at each end of a segment; of fewer all
_WORST = 4  # vertices that are added for each end of a segment where some are not satisfied
_ROUNDS = 12  # in which vertices are added
_HELD = 0.02  # of the margin that was found: what every other vertex is to keep
_STEEP = 100.0  # for what a tick leaves of the form, beside rates: it need not lose, if it does not grow
_AGAIN = 2  # times that forms are looked for in coordinates of those that were found, before a larger rate is
_AROUND = (1.0, 0.9)  # of a rate: what coordinates are of, in which forms for it are looked for too
_NEAR = 0.05  # share of the largest rate up to which it is looked for
_GROWS = 1e12  # what a period makes of z, from which on no forms are looked for
_GAP = 1e-2  # share of the margin that may be missed
SMALL = 5  # order up to which Clarabel is quicker than our own method
_OF_P = 0.01  # share of the margin that P_k ⪰ 0 is to keep

Found = TypeVar("Found")
Segment = tuple[int, int, int]  # the knots that it joins, and the one of them that is looked at


@dataclass(frozen=True)
class Forms:
    """What was found."""

    P: list[Array]  # at the knots, (n, n) each
    rate: float  # that they seem to prove, in 1/s


@dataclass(frozen=True, kw_only=True)
class ClockedForms:
    """The program for one system."""

    F: Array  # vertices of what z obeys between ticks, (v, n, n)
    J: Array  # those of what a tick makes of it, (w, n, n)
    R: Array  # what the end of a part of the period makes of it, (n, n)
    parts: int  # as in `clocked`, as the next two
    knots: int
    period: float
    sizes: Array  # of z, (n,)
    near: Array | None = None  # a form P_0 that is known to do for smaller rates, (n, n): it decides the coordinates
    asked: dict[Segment, list[int]] = field(default_factory=dict)  # vertices, as far as it is known which matter

    def part(self, where: slice) -> "ClockedForms":
        """Return the program for some entries of z, as if there were no others."""
        F, J = (np.unique(X[:, where, where], axis=0) for X in (self.F, self.J))
        return replace(self, F=F, J=J, R=self.R[where, where], sizes=self.sizes[where], near=None, asked={})

    @cached_property
    def over(self) -> Array:
        """What a period makes of z for each vertex, and for the mean of them, (v + 1, n, n)."""
        F = np.append(self.F, [self.F.mean(axis=0)], axis=0)
        flows = np.asarray(expm(F * (self.period / self.parts)))
        return np.asarray(flows @ np.linalg.matrix_power(self.R @ flows, self.parts - 1))

    @cached_property
    def most(self) -> float:
        """No larger rate can be proved: what a vertex does by itself, in 1/s; −∞ where that is out of range."""
        with np.errstate(all="ignore"):
            if not np.abs(self.over).max() < _GROWS:
                return -np.inf
        return min(self._own(J @ self.over) for J in self.J)

    def _own(self, turns: Array) -> float:
        """Return the least rate that maps of a period, (…, n, n), have each by itself, in 1/s."""
        radius = float(np.abs(np.linalg.eigvals(turns)).max())
        return -float(np.log(max(radius, 1e-300))) / self.period

    @cached_property
    def coordinates(self) -> Array:
        """L, for which L z is of size 1 in the form of the mean, or in one that is known."""
        return np.asarray(np.linalg.cholesky(self._mean(0.0) if self.near is None else self.near)).T

    def _mean(self, rate: float) -> Array:
        """Return a form with which the mean of the vertices falls at a rate that each of them has by itself."""
        over = self.J.mean(axis=0) @ self.over
        d = self.sizes * balancing((np.abs(over) / self.sizes[:, None] * self.sizes).max(axis=0)[None])
        turn = over[-1] / d[:, None] * d * np.exp(rate * self.period)
        return np.asarray(symmetric_part(solve_discrete_lyapunov(turn.T, np.eye(len(d)))) / d[:, None] / d)

    def around(self, rate: float) -> Iterator["ClockedForms"]:
        """Yield the program as it is, and in coordinates that do for the mean at about this rate."""
        yield self
        own = self._own(self.J.mean(axis=0) @ self.over[-1])
        for share in _AROUND:
            if share * rate < own:
                with suppress(np.linalg.LinAlgError):
                    yield replace(self, near=self._mean(share * rate))

    @property
    def count(self) -> int:
        """How many knots there are."""
        return self.parts * (self.knots + 1)

    def rises(self, segment: Segment, F: Array) -> dict[int, Term]:
        """Return the terms of P_{k+1} − P_k + step (Fᵀ P_e + P_e F)."""
        (k, after, e), eye = segment, np.eye(len(F))
        terms = {k: (-eye / 2, eye), after: (eye / 2, eye)}
        terms[e] = terms[e][0] + self.step * F.T, eye
        return terms

    @property
    def step(self) -> float:
        """Time between knots."""
        return self.period / (self.parts * self.knots)

    @cached_property
    def segments(self) -> list[Segment]:
        """Both ends of all segments."""
        starts = [j * (self.knots + 1) + k for j in range(self.parts) for k in range(self.knots)]
        return [(k, k + 1, e) for k in starts for e in (k, k + 1)]

    def jumps(self, J: Array, R: Array) -> Iterator[tuple[int, int, Array, float]]:
        """What jumps make, from the last knot of a part to the first of the next; shares of the margin."""
        size = self.knots + 1
        for j in range(1, self.parts):
            yield j * size - 1, j * size, R, 0.25 / self.parts
        for J_j in J:
            yield self.parts * size - 1, 0, J_j, 0.25

    def at(self, rate: float) -> Forms | None:
        """Return forms that satisfy all inequalities at a rate with the largest margin, or None."""
        if rate >= self.most:
            return None
        L = self.coordinates
        back, weight = np.linalg.inv(L), np.eye(len(L)) * min(1.0, 2 * self.most * self.period)
        F, J, R = (L @ X @ back for X in (self.F + rate * np.eye(len(L)), self.J, self.R))
        found = self.of_few(
            lambda: self._solved(F, J, R, weight),
            lambda found, s: _least(self.left(found[0], s, F) - _HELD * found[1] * self.share * weight),
            _WORST,
        )
        if found is None:
            return None
        forms = [L.T @ P_k @ L for P_k in found[0]]
        return Forms(forms, self.rate(forms))

    def of_few(
        self, solved: Callable[[], Found | None], least: Callable[[Found, Segment], Array], worst: int
    ) -> Found | None:
        """Return what is found for the vertices that are asked for and does for all, or None.

        Those that it does for the least, so many at each end of a segment, are asked for, too: `least` is what is left
        of the inequality of each vertex there.
        """
        first = np.unique(np.linspace(0, len(self.F) - 1, _FIRST).astype(int)).tolist()
        for segment in self.segments:
            self.asked.setdefault(segment, list(first))
        for _ in range(_ROUNDS):
            found, added = solved(), 0
            if found is None:
                return None
            for segment, asked in self.asked.items():
                left = least(found, segment)
                new = [i for i in np.argsort(left)[:worst].tolist() if left[i] < 0 and i not in asked]
                asked += new
                added += len(new)
            if not added:
                return found
        return None

    def solved(
        self, fixed: Sequence[Bound], bound: Callable[[Segment, int], Bound], gap: float, weight: Array | None = None
    ) -> Array | None:
        """Return P, (knots, n, n), with some bounds and those of the vertices that are asked for; see `ChainMap`."""
        bounds = [*fixed, *(bound(segment, i) for segment, some in self.asked.items() for i in some)]
        chain = ChainMap(bounds, self.count, weight)
        v = least(chain, gap=gap)
        return None if v is None else chain.matrices(v)

    def fastest(self, most: float, looks: int) -> Forms | None:
        """Return forms that prove nearly the largest rate, below one that none can."""
        program, first = self, self.at(0.0)
        if first is None or not first.rate > 0:
            return None
        for _ in range(_AGAIN):
            again = replace(self, near=first.P[0]).at(first.rate)
            first = again if again is not None and again.rate > first.rate else first

        def at(rate: float) -> tuple[float, Forms] | None:
            nonlocal program
            each = (one.at(rate) for one in program.around(rate))
            found = next((forms for forms in each if forms is not None and forms.rate >= rate), None)
            if found is None:
                return None
            program = replace(program, near=found.P[0])
            return found.rate, found

        program = replace(self, near=first.P[0])
        return bisected((first.rate, first), most, at, near=_NEAR, most=looks)[1]

    def most_of_parts(self, blocks: Sequence[int], looks: int) -> float | None:
        """Return the largest rate that parts of z have as if each were by itself; None where one has none."""
        most = self.most
        for edge in pairwise([0, *accumulate(blocks)]):
            part = self.part(slice(*edge))
            if edge[1] - edge[0] > 1:
                found = part.fastest(min(most, part.most), looks)
                if found is None:
                    return None
                most = min(most, found.rate)
        return most

    @property
    def share(self) -> float:
        """Of the margin, of one segment."""
        return 0.5 / (self.parts * self.knots)

    def left(self, P: Sequence[Array] | Array, segment: Segment, F: Array) -> Array:
        """Return −(P_{k+1} − P_k) − step (Fᵀ P_e + P_e F), (v, n, n)."""
        k, after, e = segment
        product = P[e] @ F
        return np.asarray(P[k] - P[after] - self.step * (product + product.transpose(0, 2, 1)))

    def rate(self, P: Sequence[Array]) -> float:
        """Return the rate that forms prove, as far as floating point can tell; none is proved where it is negative."""
        try:
            back = [np.linalg.inv(np.linalg.cholesky(P_k)) for P_k in P]
        except np.linalg.LinAlgError:
            return -np.inf
        sides = (back[s[2]] @ self.left(P, s, self.F) @ back[s[2]].T for s in self.segments)
        flows = min(float(_least(X).min()) for X in sides) / (2 * self.step)
        turned = (back[k] @ (P[k] - J.T @ P[after] @ J) @ back[k].T for k, after, J, _ in self.jumps(self.J, self.R))
        return min(flows, float(_least(self.counted(np.array(list(turned)))).min()))

    def counted(self, turned: Array) -> Array:
        """Return what ticks leave of the form beside rates: it need not lose there, if it does not grow."""
        return turned * (_STEEP / self.period)

    def _solved(self, F: Array, J: Array, R: Array, weight: Array) -> tuple[Array, float] | None:
        """Return P, (knots, n, n), with the largest margin for the vertices that are asked for; None without one."""
        eye = np.eye(F.shape[1])
        less = -eye / 2, eye
        bounds = [Bound({k: less}, _OF_P * weight) for k in range(self.count)]
        jumps = self.jumps(J, R)
        bounds += [Bound({before: less, after: (X.T / 2, X)}, share * weight) for before, after, X, share in jumps]
        asked = self.asked.items()
        bounds += [Bound(self.rises(segment, F[i]), self.share * weight) for segment, some in asked for i in some]
        return best_margin(bounds, self.count)


def _least(X: Array) -> Array:
    """Return the least eigenvalue of each of some symmetric matrices."""
    return np.asarray(np.linalg.eigvalsh((X + X.transpose(0, 2, 1)) / 2)[:, 0])


def best_margin(bounds: Sequence[Bound], count: int) -> tuple[Array, float] | None:
    """Return P, (count, n, n), and the largest t > 0 that all bounds allow, P_0 of mean eigenvalue 1; or None.

    Example: −P_0 + t I ⪯ 0.

        >>> _, t = best_margin([Bound({0: (-np.eye(2) / 2, np.eye(2))}, np.eye(2))], 1)
        >>> 0.98 < t < 1.01
        True
    """
    found = _by_cones(bounds, count) if len(bounds[0].T) <= SMALL else _by_form(bounds, count)
    return None if found is None or not found[1] > 0 or not np.isfinite(found[0]).all() else found


def _by_form(bounds: Sequence[Bound], count: int) -> tuple[Array, float] | None:
    """Ask our own method, with a T whose largest entry is 1: else multipliers are as large as a T is small."""
    unit = max(float(np.abs(bound.T).max()) for bound in bounds)
    chain = ChainMap([replace(bound, T=bound.T / unit) for bound in bounds], count)
    v = least(chain, gap=_GAP)
    return None if v is None else (chain.matrices(v), float(v[-1]) / unit)


def _by_cones(bounds: Sequence[Bound], count: int) -> tuple[Array, float] | None:
    """Ask Clarabel, in its form: P_0, P_1, … as `upper` has them, then t."""
    n = len(bounds[0].T)
    unit = upper(np.eye(n))
    size = len(unit)
    basis = symmetric_of(np.eye(size), n)  # of size 1 each
    images = list[dict[int, Array]]()
    for bound in bounds:
        halves = {k: L @ basis @ R for k, (L, R) in bound.terms.items()}
        images.append({k: upper(symmetric_part(X)).T for k, X in halves.items()} | {count: upper(bound.T)[:, None]})
    images.append({0: np.outer(unit, unit) / n})  # the mean eigenvalue of P_0, at most 1
    blocks = [[sparse.coo_matrix(parts[k]) if k in parts else None for k in range(count + 1)] for parts in images]
    G = sparse.bmat(blocks, format="csc")
    cones = [clarabel.PSDTriangleConeT(n)] * len(images)
    cost, sides = np.append(np.zeros(count * size), -1.0), np.append(np.zeros(len(bounds) * size), unit)
    try:
        x = np.array(minimise(cost, G, sides, cones, _GAP).x)
    except ArithmeticError:
        return None
    return np.tensordot(x[:-1].reshape(count, size), basis, 1), float(x[-1])
