"""Clock-dependent forms looked for in floating point: what they have to satisfy is in `clocked`, and proved there.

In coordinates in which Σ |z_k|² over the ticks of the mean of the boxes is I, which makes P of size 1; margins count
in what a form loses in a period at the largest rate. Of many boxes few decide: those that the forms found so far do
not satisfy are added, until all are satisfied.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise, product
from typing import TypeVar

import numpy as np
import scipy  # whose parts are imported where they are used
from scipy.linalg import expm, solve_discrete_lyapunov

from pwatrack.arrays import Array, balancing, symmetric_part
from pwatrack.lmi.bisection import bisected
from pwatrack.lmi.chain_map import Bound, ChainMap, shrinks, square
from pwatrack.lmi.frame import Frame
from pwatrack.lmi.primal_dual import least

_FIRST = 8  # boxes that are asked for at first, at each end of a segment; of fewer all
_WORST = 4  # boxes that are added for each end of a segment where some are not satisfied
_ROUNDS = 12  # in which boxes are added
_HELD = 0.02  # of the margin that was found: what every other box is to keep
_CORNERS = 6  # edges of a box of which all corners are looked at, for what no forms can do; of more so many at random
_STEEP = 100.0  # for what a tick leaves of the form, beside rates: it need not lose, if it does not grow
_AGAIN, _FASTER = 4, 1.02  # times that forms are looked for in coordinates of those before, as long as it helps
_AROUND = (1.0, 0.9)  # of a rate: what coordinates are of, in which forms for it are looked for too
_NEAR = 0.05  # share of the largest rate up to which it is looked for
_JUST = 0.99  # of that: how much more than a rate is looked at, so that it is known if there is none
_GROWS = 1e12  # what a period makes of z, from which on no forms are looked for
_GAP = 0.1  # share of the margin that may be missed
_SIGN = 0.5  # the same where any will do, of what it is below 0 at least
_OF_P = 0.01  # share of the margin that P_k ⪰ 0 is to keep

Found = TypeVar("Found")
Margin = tuple[Array, Array, float]  # P, (knots, n, n), T and what all inequalities are satisfied by
Segment = tuple[int, int, int]  # the knots that it joins, and the one of them that is looked at


@dataclass(frozen=True)
class Forms:
    """What was found."""

    P: list[Array]  # at the knots, (n, n) each
    T: Array  # their diagonals, (knots, p)
    rate: float  # that they seem to prove, in 1/s

    def inside(self, L: Array, longer: Array) -> Margin:
        """Return them for L z, with u so much longer than v, tr P_0 = n; their margin there is not known."""
        back = np.linalg.inv(L)
        P, T = back.T @ np.array(self.P) @ back, self.T / longer**2
        unit = np.trace(P[0]) / len(L)
        return P / unit, T / unit, 0.0

    def or_faster(self, other: "Forms | None") -> "Forms":
        """Return the ones that prove a larger rate."""
        return self if other is None or other.rate <= self.rate else other


@dataclass(frozen=True, kw_only=True)
class ClockedForms:
    """The program for one system."""

    F: Array  # middles of boxes of what z obeys between ticks, (v, n, n)
    U: Array  # their edges, (v, n, p)
    V: Array  # (v, p, n)
    J: Array  # vertices of what a tick makes of it, (w, n, n)
    R: Array  # what the end of a part of the period makes of it, (n, n)
    parts: int = 1  # as in `clocked`, as the next two
    knots: int
    period: float
    sizes: Array  # of z, (n,)
    near: Array | None = None  # a form P_0 that is known to do for smaller rates, (n, n): it decides the coordinates
    begin: Forms | None = None  # forms that nearly do: a search begins there
    asked: dict[Segment, list[int]] = field(default_factory=dict)  # vertices, as far as it is known which matter
    turned: bool = False  # whether time goes from the last knot to the first

    def part(self, where: slice) -> "ClockedForms":
        """Return the program for some entries of z, as if there were no others."""
        F, U, V = self.F[:, where, where], self.U[:, where], self.V[:, :, where]
        acting = U.any(axis=(0, 1)) & V.any(axis=(0, 2))
        R, J = self.R[where, where], np.unique(self.J[:, where, where], axis=0)
        own = F if acting.any() else np.unique(F, axis=0)
        U, V = U[: len(own), :, acting], V[: len(own), acting]
        return replace(self, F=own, U=U, V=V, J=J, R=R, sizes=self.sizes[where], near=None, begin=None, asked={})

    def inside(self, frame: Frame, rate: float) -> "ClockedForms":
        """Return the program for L z, falling at a rate less, in periods, with edges of u and v of one length."""
        h = self.period
        longer = self.longer(frame.L) * np.sqrt(h)
        F, U, V = (
            (frame.inside(self.F) + rate * np.eye(len(frame.L))) * h,
            frame.left(self.U) * h / longer,
            frame.right(self.V) * longer[:, None],
        )
        return replace(self, F=F, U=U, V=V, J=frame.inside(self.J), R=frame.inside(self.R[None])[0], period=1.0)

    @property
    def backward(self) -> "ClockedForms":
        """The program for what is transposed, in backward time: of a form there the inverse is one here."""
        F, U, V, J = (X.transpose(0, 2, 1) for X in (self.F, self.V, self.U, self.J))
        return replace(self, F=F, U=U, V=V, J=J, R=self.R.T, turned=not self.turned)

    def longer(self, L: Array) -> Array:
        """Return by how much u is longer than v there, (p,)."""
        U, V = L @ self.U, self.V @ np.linalg.inv(L)
        return np.asarray(np.sqrt(np.linalg.norm(U, axis=1) / np.linalg.norm(V, axis=2)).mean(axis=0))

    @cached_property
    def over(self) -> Array:
        """What a period makes of z for corners of the boxes, and for the mean of these, (v + 1, n, n)."""
        p = self.U.shape[2]
        random = np.random.default_rng(0).choice([-1.0, 1.0], (2**_CORNERS, p))
        signs = np.array(list(product((-1.0, 1.0), repeat=p))) if p <= _CORNERS else random
        corners = (self.F[:, None] + (self.U[:, None] * signs[:, None]) @ self.V[:, None]).reshape(-1, *self.R.shape)
        F = np.append(corners, [self.F.mean(axis=0)], axis=0)
        flows = np.asarray(expm(F * (self.period / self.parts)))
        return np.asarray(flows @ np.linalg.matrix_power(self.R @ flows, self.parts - 1))

    @cached_property
    def most(self) -> float:
        """No larger rate can be proved: what a corner does by itself, in 1/s; −∞ where that is out of range."""
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

    @property
    def scalars(self) -> int:
        """How many entries all T have."""
        return self.count * len(self.V[0])

    def falls(self, segment: Segment, i: int, T: Array, push: Array | None = None) -> Bound:
        """Return P_{k+1} − P_k + step (F_iᵀ P_e + P_e F_i + V_iᵀ T_e V_i + P_e U_i T_e⁻¹ U_iᵀ P_e) + t T ⪯ 0.

        As a Schur complement it is [·, P_e U_i; ·, −T_e]; in between T may have more, `push` of it times P_e.
        """
        (k, after, e), (n, p), step, first = segment, self.U.shape[1:], self.step, np.eye(self.U.shape[1], len(T))
        L = {k: -first.T / 2, after: first.T / 2}
        L[e][:n] += step * self.F[i].T
        L[e][len(T) - p :] = step * self.U[i].T
        if push is not None:
            L[e][n : len(T) - p] = push
        V, own = self.V[i] @ first, np.eye(p, len(T), len(T) - p)
        S = step * (V[:, :, None] * V[:, None, :] - own[:, :, None] * own[:, None, :])
        return Bound({j: (X, first) for j, X in L.items()}, T, None, range(e * p, (e + 1) * p), S)

    @property
    def unknowns(self) -> int:
        """How many entries all P have."""
        return self.count * len(self.R) * (len(self.R) + 1) // 2

    @property
    def step(self) -> float:
        """Time between knots."""
        return self.period / (self.parts * self.knots)

    def _in_time(self, one: int, other: int) -> tuple[int, int]:
        """Return two knots, the earlier one first."""
        return (other, one) if self.turned else (one, other)

    @cached_property
    def segments(self) -> list[Segment]:
        """Both ends of all segments."""
        starts = [j * (self.knots + 1) + k for j in range(self.parts) for k in range(self.knots)]
        return [(*self._in_time(k, k + 1), e) for k in starts for e in (k, k + 1)]

    def jumps(self, J: Array, R: Array) -> Iterator[tuple[int, int, Array, float]]:
        """What jumps make, from the last knot of a part to the first of the next; shares of the margin."""
        size = self.knots + 1
        for j in range(1, self.parts):
            yield *self._in_time(j * size - 1, j * size), R, 0.25 / self.parts
        for J_j in J:
            yield *self._in_time(self.count - 1, 0), J_j, 0.25

    def at(self, rate: float, *, any_margin: bool = False) -> Forms | None:
        """Return forms that satisfy all inequalities at a rate with the largest margin, or with any, or None."""
        if rate >= self.most:
            return None
        L, longer = self.coordinates, self.longer(self.coordinates)
        weight, inside = np.eye(len(L)) * min(1.0, 2 * self.most * self.period), self.inside(Frame(L), rate)
        begin = None if self.begin is None else self.begin.inside(L, longer)

        found = self.of_few(
            lambda last: inside.largest_margin(weight, last or begin, any_margin=any_margin),
            lambda found, s: inside.left(*found[:2], s) - _HELD * found[2] * self.share * weight,
        )
        if found is None:
            return None
        forms, T = [L.T @ P_k @ L for P_k in found[0]], found[1] * longer**2
        return Forms(forms, T, self.rate(forms, T))

    def of_few(
        self,
        solved: Callable[[Found | None], Found | None],
        left: Callable[[Found, Segment], Array],
        worst: int = _WORST,
    ) -> Found | None:
        """Return what is found for the boxes that are asked for, after what is of fewer, and does for all, or None.

        Those that it does for the least, so many at each end of a segment, are asked for, too: `left` is what is left
        of the inequality of each box there, (v, n, n).
        """
        first = np.unique(np.linspace(0, len(self.F) - 1, _FIRST).astype(int)).tolist()
        for segment in self.segments:
            self.asked.setdefault(segment, list(first))
        found: Found | None = None
        for _ in range(_ROUNDS):
            found, added = solved(found), 0
            if found is None:
                return None
            for segment, asked in self.asked.items():
                lowest = _least(left(found, segment))
                new = [i for i in np.argsort(lowest)[:worst].tolist() if lowest[i] < 0 and i not in asked]
                asked += new
                added += len(new)
            if not added:
                return found
        return None

    def solved(
        self,
        fixed: Sequence[Bound],
        bound: Callable[[Segment, int], Bound],
        left: Callable[[Array, Array, Segment], Array],
        gap: float,
        weight: Array | None = None,
        worst: int = _WORST,
    ) -> tuple[Array, Array] | None:
        """Return P, (knots, n, n), and T with some bounds, and those of all boxes: see `ChainMap` and `of_few`."""

        def of_asked(_: tuple[Array, Array] | None) -> tuple[Array, Array] | None:
            bounds = [*fixed, *(bound(segment, i) for segment, some in self.asked.items() for i in some)]
            chain = ChainMap(bounds, self.count, weight, self.scalars)
            v = least(chain, gap=gap)
            return None if v is None else (chain.matrices(v), chain.scalars(v).reshape(self.count, -1))

        return self.of_few(of_asked, lambda found, segment: left(*found, segment), worst)

    def fastest(self, most: float, looks: int) -> Forms | None:
        """Return forms that prove nearly the largest rate, below one that none can; or one that is `most` or more."""
        program, first = self, self.at(0.0)
        if first is None or not first.rate > 0:
            return None
        first = self.again(first, most=most)
        if first.rate >= most:
            return first

        def at(rate: float) -> tuple[float, Forms] | None:
            nonlocal program
            found = program.at(rate)
            if found is None or found.rate < rate:
                return None
            program = program.from_here(found)
            return found.rate, found

        def a_little_more(rate: float, without: float) -> float:
            return min((rate + without) / 2, (1 + _JUST * _NEAR) * rate)

        program = self.from_here(first)
        return bisected((first.rate, first), most, at, near=_NEAR, most=looks, middle=a_little_more)[1]

    def from_here(self, found: Forms) -> "ClockedForms":
        """Return the program in coordinates of forms, where searches begin."""
        return replace(self, near=found.P[0], begin=found)

    def again(self, found: Forms, rate: float = 0.0, most: float = np.inf) -> Forms:
        """Return what is found in coordinates of forms, at their rate or a larger one that is asked, or these.

        It ends once there is one that is `most` or more.
        """
        for _ in range(_AGAIN if found.rate < most else 0):
            last, found = found.rate, found.or_faster(self.from_here(found).at(max(found.rate, rate)))
            if not most > found.rate > _FASTER * last:
                break
        return found

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

    def left(self, P: Sequence[Array] | Array, T: Array, segment: Segment) -> Array:
        """Return −(P_{k+1} − P_k) − step (F_iᵀ P_e + P_e F_i + V_iᵀ T_e V_i + P_e U_i T_e⁻¹ U_iᵀ P_e), (v, n, n)."""
        k, after, e = segment
        product, V, U = P[e] @ self.F, self.V.transpose(0, 2, 1), P[e] @ self.U
        edges = V * T[e] @ self.V + U / T[e] @ U.transpose(0, 2, 1)
        return np.asarray(P[k] - P[after] - self.step * (product + product.transpose(0, 2, 1) + edges))

    def rate(self, P: Sequence[Array], T: Array) -> float:
        """Return the rate that forms prove, as far as floating point can tell; none is proved where it is negative."""
        try:
            back = [np.linalg.inv(np.linalg.cholesky(P_k)) for P_k in P]
        except np.linalg.LinAlgError:
            return -np.inf
        sides = (back[s[2]] @ self.left(P, T, s) @ back[s[2]].T for s in self.segments)
        flows = min(float(_least(X).min()) for X in sides) / (2 * self.step)
        turned = (back[k] @ (P[k] - J.T @ P[after] @ J) @ back[k].T for k, after, J, _ in self.jumps(self.J, self.R))
        return min(flows, float(_least(np.array(list(turned)) * (_STEEP / self.period)).min()))

    def largest_margin(self, weight: Array, begin: Margin | None, *, any_margin: bool = False) -> Margin | None:
        """Return P, (knots, n, n), and T with the largest margin for the boxes that are asked for, or with any.

        It may begin at others, whose margin does not count; None where there is none.
        """
        bounds = [Bound({k: square(np.eye(len(weight)), -1.0)}, _OF_P * weight) for k in range(self.count)]
        jumps = self.jumps(self.J, self.R)
        bounds += [shrinks(before, after, X, share * weight) for before, after, X, share in jumps]
        asked = self.asked.items()
        margin = scipy.linalg.block_diag(self.share * weight, np.zeros((self.V.shape[1],) * 2))
        bounds += [self.falls(segment, i, margin) for segment, some in asked for i in some]
        found = best_margin(bounds, self.count, self.scalars, begin, any_margin=any_margin)
        return None if found is None else (found[0], found[1].reshape(self.count, -1), found[2])


def _least(X: Array) -> Array:
    return np.asarray(np.linalg.eigvalsh((X + X.transpose(0, 2, 1)) / 2)[:, 0])


def best_margin(
    bounds: Sequence[Bound], count: int, scalars: int = 0, begin: Margin | None = None, *, any_margin: bool = False
) -> Margin | None:
    """Return P, (count, n, n), τ and the largest t > 0 that all bounds allow, or any, tr P_0 = n; or None.

    Example: −P_0 + t I ⪯ 0.

        >>> _, _, t = best_margin([Bound({0: (-np.eye(2) / 2, np.eye(2))}, np.eye(2))], 1)
        >>> 0.9 < t < 1.01
        True
    """
    unit = max(float(np.abs(bound.T).max()) for bound in bounds)  # else multipliers are as large as a T is small
    chain = ChainMap([replace(bound, T=bound.T / unit) for bound in bounds], count, None, scalars)
    near = None if begin is None else chain.vector(*begin)
    v = least(chain, gap=_SIGN, against=0.0, near=near) if any_margin else least(chain, gap=_GAP, near=near)
    if v is None or not np.isfinite(v).all() or not v[-1] > 0:
        return None
    return chain.matrices(v), chain.scalars(v), float(v[-1]) / unit
