"""What bounded scalars can do to a switched system with a clock: tubes that depend on the time since a tick.

Let z be as in `clocked`, and driven by scalars d, ‖d‖ ≤ 1, z' = F(t) (z + E d) + G d between ticks, or z⁺ = J z + Γ d
at them, (J, Γ) in the hull of (J_j, Γ_j). With Q(τ) and T(τ), diagonal, linear between Q_0 … Q_N ≻ 0 and T_0 … T_N at
knots δ apart in each part of the period, and q_i = V_i E, g_i = F_i E + G + Q_e V_iᵀ T_e⁻¹ q_i,

    −(Q_{k+1} − Q_k) / δ + F_i Q_e + Q_e F_iᵀ + a Q_e + g_i (a I − q_iᵀ T_e⁻¹ q_i)⁻¹ g_iᵀ
        + U_i T_e U_iᵀ + Q_e V_iᵀ T_e⁻¹ V_i Q_e ≺ 0    for e = k and e = k + 1, all k, all boxes i
    R Q_N Rᵀ ≺ Q_0 of the next part,    J_j Q_N J_jᵀ / (1 − b) + Γ_j Γ_jᵀ / b ≺ Q_0 of the first, for all j

V = zᵀ Q(τ)⁻¹ z has V' ≤ −a V + a ‖d‖² between ticks, and V⁺ ≤ (1 − b) V + b ‖d‖² at them; what acts only at one of
both has a = 0 or b = 0 at the other, without the terms with g and q. So from z = 0 always V ≤ 1, from everywhere V ends
below 1, and |c z| ≤ max_k (c Q_k cᵀ)^½ for every row c: c Q(τ) cᵀ is linear between knots (proved in
`docs/theory/beyond.md`).

A tube of what is summed, for d that are seldom anything but 0, has in place of the terms with g and Γ

    g gᵀ ≺ Q_e    for all knots e, all g = (F_i + U_i diag(ε) V_i) E + G with ε_k at 1 or −1
    Γ_j Γ_jᵀ ≺ Q_0    for all j

and V^½' ≤ −(a / 2) V^½ + ‖d‖, or V^½⁺ ≤ (1 − b)^½ V^½ + ‖d‖: V^½ ends below the integral of ‖d‖ with weights that fall
as e^(−a t / 2), or the sum of ‖d‖ with weights that fall by (1 − b)^½.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
import scipy  # whose parts are imported where they are used

from pwatrack.arrays import OVER_POWERS, Array
from pwatrack.ball_matrix import BallMatrix, beside, different
from pwatrack.lmi.chain_map import Bound, shrinks, square
from pwatrack.lmi.clocked import (
    Clocked,
    in_short_numbers,
    jumps,
    knots_of,
    looked_for,
    short_diagonals,
    shrunk,
    slacks,
)
from pwatrack.lmi.clocked_forms import ClockedForms, Segment
from pwatrack.lmi.exact import Packed, rounded_down
from pwatrack.lmi.frame import Frame
from pwatrack.lmi.norm import form_above, sizes_in
from pwatrack.rational import Rational, diagonal, floats, identity, is_positive_definite, number, root, scalar

_GAP = 1e-3  # share of the cost that may be missed
_WORST = 8  # boxes that are added at each end of a segment where some are not satisfied: more than for other forms
_NOTHING = 1e-9  # of what would drive at the rate of z: what is taken for as good as nothing
_FADING = 1e-9  # of the weight: of all of z, so that what is minimised is definite
_THIN = 1e-12  # of the largest square of an axis of a tube: the least that coordinates make up for
_ROUNDING = 2.0**-51  # twice what an entry of a root, and a product with it, are off by, of its row's size
_MOST_OF_V = 0.99  # what b is at most
_DOUBLINGS = 40  # of a time in periods: after it nothing is left
_SLACKS = (1e-6, 3e-5, 1e-3)  # of the square of what drives, by which inequalities are to hold, until they are proved


@dataclass(frozen=True, kw_only=True)
class TubeProgram:
    """Looks for tubes of one system in floating point; what one search finds out about vertices serves the next.

    In coordinates in which a form that is proved to fall is I, or a tube that is known, and in which what drives is of
    size 1. Of many vertices few decide: those that the tubes found so far do not satisfy are added, until all are.
    """

    system: Clocked  # what z obeys
    near: Array  # a form P_0 that is proved to fall, (n, n)
    knots: int  # segments of each part

    def smallest(
        self, drive: "Drive", rows: Array, weights: Array, *, a: float, b: float, slack: float, summed: bool, at: Frame
    ) -> tuple[list[Rational], Array] | None:
        """Return Q at the knots, (n, n) each, with the least sum of weight c Q cᵀ, and T; None where none is found.

        Args:
            drive: How d acts.
            rows, weights: c, (s, n), and of each, (s,).
            a, b: As above.
            slack: Share of the size of what drives by which inequalities are to hold.
            summed: Whether d is.
            at: Coordinates that it is looked for in.
        """
        system = self.system
        added = np.array([g.floats for g in drive.held_by(system)])
        if drive.ticks is None and not added.any():  # balls alone drive, or nothing: a tube is sought for a little
            drive = drive.slowly(_NOTHING * self.clock.most)
            added = drive.between.floats[None]
        inside, eye = self.clock.inside(at, a / 2).backward, np.eye(len(at.L))
        ticks = np.array([X.floats for X in drive.ticks or [drive.held.times(Fraction(0))] * len(inside.J)])
        holding = at.left(added)
        kicking = at.left(ticks) / np.sqrt(1.0 if summed else b or np.inf)
        h, longer = self.clock.period, self.clock.longer(at.L)
        driving = holding if summed else holding * np.sqrt(h / (a or np.inf))
        size = max(float((driving**2).max()), float((kicking**2).max()))
        if not 0 < size < np.inf:
            return None
        seen, rest = at.right(rows[None])[0], slack * eye
        W = seen.T * weights @ seen + _FADING * eye
        fixed = [
            Bound({k: square(eye, -1.0)}, rest + g @ g.T / size)
            for g in (np.unique(holding, axis=0) if summed and drive.ticks is None else ())
            for k in range(inside.count)
        ]
        fixed += [shrinks(before, after, R, rest) for before, after, R, _ in inside.jumps(inside.J[:0], inside.R)]
        for J_j, kick in zip(inside.J / np.sqrt(1 - b), kicking, strict=True):
            kicked = rest + kick @ kick.T / size
            if summed:
                fixed.append(Bound({0: square(eye, -1.0)}, kicked))
            fixed.append(shrinks(0, inside.count - 1, J_j, rest if summed else kicked, self._seen(J_j)))
        acting = not (summed or drive.ticks is not None)
        push = _Push(
            clock=inside,
            g=at.left(drive.middles(system)) * (h / np.sqrt(size) * acting),
            q=self.clock.V @ drive.held.floats * (longer * np.sqrt(h / size) * acting)[:, None],
            a=a * h,
            rest=(a * h if summed and a else 1.0) * rest,
        )
        found = inside.solved(fixed, push.bound, push.left, _GAP, W / inside.count, _WORST)
        if found is None:
            return None
        Q, T = found
        return [at.outside(Q_k, size) for Q_k in Q], size * T / longer**2

    def frame(self, known: "Tube | None") -> Frame:
        """Return the coordinates in which the form is I, or the mean of Q_0 … Q_N of a tube."""
        L = np.asarray(np.linalg.cholesky(self.near).T, dtype=np.float64)
        if known is None:
            return Frame(L)
        squares, V = np.linalg.eigh(L @ np.mean([floats(Q.P) for Q in known.Q], axis=0) @ L.T)
        return Frame((V / np.sqrt(np.maximum(squares, _THIN * squares[-1]))).T @ L)

    @cached_property
    def clock(self) -> ClockedForms:
        """Knots and segments, and which vertices matter, as far as that is known."""
        return looked_for(self.system, self.knots)

    def alone(self, drive: "Drive", rows: Array, weights: Array, *, a: float, b: float) -> Array:
        """Return the root of about what each d costs by itself, in the loop of the mean of all vertices, (d,)."""
        system, n = self.system, len(self.near)
        F, J = (np.mean([X.floats for X in each], axis=0) for each in (system.F, system.J))
        R = np.eye(n) if system.between is None else system.between.floats
        rate, J = (F + a / 2 * np.eye(n)) * float(system.period) / system.parts, J / np.sqrt(1 - b)
        flow, half, after = scipy.linalg.expm(rate), scipy.linalg.expm(rate / 2), [J]
        for _ in range(system.parts - 1):
            after.append(after[-1] @ flow @ R)
        X, whole = rows.T * weights @ rows, after[-1] @ flow
        for _ in range(_DOUBLINGS):
            X, whole = X + whole.T @ X @ whole, whole @ whole
        if drive.ticks is not None:
            g = np.array([kick.floats for kick in drive.ticks])
            return np.asarray(np.sqrt(np.einsum("vnd,nk,vkd->vd", g, X, g).max(axis=0)))
        S = np.sum([half.T @ one.T @ X @ one @ half for one in after], axis=0)
        g, (U, V) = drive.middles(system), (np.array([each.floats for each in some]) for some in (system.U, system.V))
        most = np.sqrt(np.einsum("vnd,nk,vkd->vd", g, S, g))
        if len(U):
            of_edges = np.sqrt(np.einsum("vnp,nk,vkp->vp", U, S, U))
            most += np.einsum("vpd,vp->vd", np.abs(V @ drive.held.floats), of_edges)
        return np.asarray(most.max(axis=0))

    def _seen(self, J: Array) -> Array:
        """Return X for which Xᵀ (Q − Jᵀ Q J) X is of one size: most of z is hardly changed by a tick."""
        U, s, _ = np.linalg.svd(np.eye(len(J)) - J.T)
        return np.asarray(U / np.sqrt(np.clip(s, self.clock.most * self.clock.period, 1.0)))


@dataclass(frozen=True, kw_only=True)
class _Push:
    """What is asked of a tube between ticks, in floating point, in periods."""

    clock: ClockedForms  # in backward time, with a / 2 in F
    g: Array  # what drives z' at the middles, (v, n, d); 0 where nothing does
    q: Array  # what of d the edges see, (v, p, d)
    a: float
    rest: Array  # what is to be left, (n, n)

    def bound(self, segment: Segment, i: int) -> Bound:
        """Return [D Q + rest + U T Uᵀ, g, Q Vᵀ; ., −a, qᵀ; ., ., −T] ⪯ 0; without q g gᵀ / a stands in the first."""
        (n, p), seen = self.clock.U.shape[1:], self.q.any(axis=(0, 1))
        g, alone, more = self.g[i][:, seen], self.g[i][:, ~seen], n + int(seen.sum())
        T = np.zeros((more + p,) * 2)
        T[:n, :n] = self.rest + (alone @ alone.T / self.a if self.a else 0.0)
        T[:n, n:more], T[n:more, more:] = g, self.q[i][:, seen].T
        T[n:more, n:more] = -self.a * np.eye(more - n)
        return self.clock.falls(segment, i, self.clock.step * (np.triu(T) + np.triu(T, 1).T))

    def left(self, Q: Array, T: Array, segment: Segment) -> Array:
        """Return what is to be positive semidefinite of each box, (v, n, n)."""
        e, clock = segment[2], self.clock
        q = self.q / T[e][:, None]
        g, left = self.g + Q[e] @ clock.U @ q, self.a * np.eye(self.q.shape[2]) - self.q.transpose(0, 2, 1) @ q
        pushed = g @ _inverse(left) @ g.transpose(0, 2, 1) if self.a else 0.0
        return np.asarray(clock.left(Q, T, segment) - clock.step * (pushed + self.rest))


def _scaled(columns: Sequence[BallMatrix], sizes: Sequence[float]) -> BallMatrix:
    """Return columns side by side, each times a number as it prints."""
    return beside(*(column.times(Fraction(repr(size))) for column, size in zip(columns, sizes, strict=True)))


def _inverse(X: Array) -> Array:
    """Return inverses of symmetric matrices, very large ones of those that are not positive definite."""
    values, V = np.linalg.eigh(X)
    return np.asarray(V / np.maximum(values, 1e-300)[:, None, :] @ V.transpose(0, 2, 1))


@dataclass(frozen=True, kw_only=True)
class Drive:
    """How scalars act: all between ticks or all at them."""

    held: BallMatrix  # E, (n, d): beside what of z
    between: BallMatrix  # G, (n, d)
    ticks: Sequence[BallMatrix] | None = None  # Γ_j, (n, d), one for each J_j; None where they act between ticks

    @classmethod
    def together(cls, drives: Sequence["Drive"], sizes: Sequence[float]) -> "Drive":
        """Return how some act together, where 1 is so much of each."""
        ticks = [one.ticks for one in drives if one.ticks is not None]
        return cls(
            held=_scaled([one.held for one in drives], sizes),
            between=_scaled([one.between for one in drives], sizes),
            ticks=[_scaled(each, sizes) for each in zip(*ticks, strict=True)] if ticks else None,
        )

    def decay(self, rate: float, system: Clocked) -> tuple[float, float]:
        """Return a and b of a tube that makes up for a rate in 1/s where the scalars act."""
        if self.ticks is None:
            return rate, 0.0
        return 0.0, rounded_down(min(-float(np.expm1(-rate * float(system.period))), _MOST_OF_V), 3)

    def middles(self, system: Clocked) -> Array:
        """Return F_i E + G, (v, n, d)."""
        return np.array([(F @ self.held + self.between).floats for F in system.F])

    def slowly(self, rate: float) -> "Drive":
        """Return what drives at a rate, in 1/s, what this is beside."""
        return replace(self, held=self.held.times(Fraction(0)), between=BallMatrix.of(rate * self.held.floats))

    def corners(self, system: Clocked) -> int:
        """Return how many corners of boxes `held_by` looks at."""
        acting = (sum(map(any, (V @ self.held).centre.tolist())) for _, _, V in system.boxes)
        return sum(2**count for count in acting)

    def held_by(self, system: Clocked) -> list[BallMatrix]:
        """Return what d may add to z', at all corners of the boxes, (n, d) each."""
        found = list[BallMatrix]()
        for F, U, V in system.boxes:
            each, q = [F @ self.held + self.between], V @ self.held
            for k in range(q.shape[0]):
                row = q.part([k], range(q.shape[1]))
                if any(row.centre.entries()):
                    edge = U.part(range(U.shape[0]), [k]) @ BallMatrix(row.centre)
                    each = [g + side for g in each for side in (edge, edge.times(Fraction(-1)))]
            found += each
        return different(found)


@dataclass(frozen=True, kw_only=True)
class Tube:
    """Q_0 … Q_N ≻ 0 of each part that satisfy the inequalities above, proved exactly; c Q_k cᵀ ≤ size² for rows c."""

    Q: tuple[Packed, ...]  # at the knots, those of the first part first
    a: float  # in 1/s, a short decimal; 0 where d acts at ticks
    b: float  # a short decimal; 0 where d acts between ticks
    sizes: tuple[float, ...]  # one for each c, rounded up
    T: tuple[tuple[float, ...], ...]  # the diagonals at the knots, short decimals
    summed: bool = False  # whether it is one of what is summed

    def spread(self, rows: Array) -> Array:
        """Return max_k (c Q_k cᵀ)^½ for other rows c, (s, n), in floating point, with what that may be off by."""
        off = rows.shape[1] * _ROUNDING * (np.abs(rows) @ np.linalg.norm(self._roots, axis=2).T)
        each = np.linalg.norm(rows @ self._roots, axis=2)
        return np.asarray((each + off.T).max(axis=0) * OVER_POWERS)

    @cached_property
    def _roots(self) -> Array:
        return np.array([root(Q.P) for Q in self.Q])


def tube(
    program: TubeProgram,
    driven: Drive,
    rows: BallMatrix,
    weights: Array,
    decay: float,
    *,
    summed: bool = False,
    near: Tube | None = None,
) -> Tube | None:
    """Return a tube in which Σ weight c Q cᵀ is small, or None where none is proved.

    Args:
        program: Of the system.
        driven: How d acts.
        rows: c, (s, n).
        weights: Of each, (s,).
        decay: a in 1/s, or what b makes up for in a period: less than twice the rate with which z falls.
        summed: Whether d is summed.
        near: One that is known, in whose coordinates it is looked for.

    Example: z' = −2 z + 3 d, and ticks that change nothing: |z| ≤ 3/2.

        >>> one, nothing = BallMatrix.of([[1]]), BallMatrix.of([[0]])
        >>> system = Clocked(F=[BallMatrix.of([[-2]])], J=[one], period=Fraction(1, 10))
        >>> program = TubeProgram(system=system, near=np.eye(1), knots=1)
        >>> found = tube(program, Drive(held=nothing, between=BallMatrix.of([[3]])), one, np.ones(1), 2.0)
        >>> 1.5 < found.sizes[0] < 1.51
        True
    """
    system, (a, b), frame = program.system, driven.decay(decay, program.system), program.frame(near)
    for slack in _SLACKS:
        found = program.smallest(driven, rows.floats, weights, a=a, b=b, slack=slack, summed=summed, at=frame)
        if found is None:
            return None
        T = short_diagonals(found[1])
        for Q in in_short_numbers(found[0]):
            if contains(system, driven, Q, T, a, b, summed=summed):
                sizes = zip(*(sizes_in(Q_k.P, rows) for Q_k in Q), strict=True)
                return Tube(Q=Q, T=T, a=a, b=b, sizes=tuple(map(max, sizes)), summed=summed)
    return None


def contains(
    system: Clocked,
    driven: Drive,
    Q: Sequence[Packed],
    T: Sequence[Sequence[float]],
    a: float,
    b: float,
    *,
    summed: bool = False,
) -> bool:
    """Say whether Q satisfy the inequalities, decided in fractions, for everything in the balls; a, b as they print."""
    backward, ticks, share = system.backward, driven.ticks, Fraction(repr(b))
    parts = knots_of(backward, Q[::-1], T[::-1])
    if parts is None:
        return False
    ends, holding = list[Rational](), (ticks or driven.held_by(system)) if summed else []
    for j, (J, before, after) in enumerate(jumps(backward, parts)):  # of the tube, whose time is the other way
        left, grown = after.P, number(1 / (1 - share * (j < len(system.J))))
        if ticks is not None and not summed and j < len(ticks):
            left = left - form_above(ticks[j], identity(ticks[j].shape[1]) * number(1 / share), after.scale)
        ends.append(shrunk(J, (before.P * grown, before.scale), (left, after.scale)))
    inside = Q[:1] if ticks else Q
    rest = (Q_k.P - form_above(g, identity(g.shape[1]), Q_k.scale) for g in holding for Q_k in inside)
    if not (all(map(is_positive_definite, ends)) and all(map(is_positive_definite, rest))):
        return False
    boxes = () if summed or not a else system.boxes
    pushes = [(F @ driven.held + driven.between, V, V @ driven.held) for F, _, V in boxes]
    for slack, Q_e, T_e, i in slacks(backward, parts, a):
        pushed = _pushed(*pushes[i], Q_e, T_e, a) if pushes else slack * 0
        if pushed is None or not is_positive_definite(slack - pushed):
            return False
    return True


def _pushed(g: BallMatrix, V: BallMatrix, q: BallMatrix, Q: Packed, T: Sequence[float], a: float) -> Rational | None:
    """Return X (a I − qᵀ T⁻¹ q)⁻¹ Xᵀ, X = g + Q Vᵀ T⁻¹ q, or what is above; None where what is inverted is not ≻ 0."""
    back = diagonal([1 / Fraction(repr(t)) for t in T])
    left = identity(q.shape[1]) * scalar(a) - q.centre.transpose() * back * q.centre
    if not is_positive_definite(left):
        return None
    return form_above(g + BallMatrix(Q.P) @ V.transpose() @ BallMatrix(back * q.centre), left.inv(), Q.scale)
