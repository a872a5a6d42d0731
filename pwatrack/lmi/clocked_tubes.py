"""What a bounded scalar can do to a switched system with a clock: tubes that depend on the time since a tick.

Let z be as in `clocked`, and driven by a scalar |d| ≤ 1, z' = F(t) (z + E d) + G d between ticks, or z⁺ = J z + Γ d at
them, (J, Γ) in the hull of (J_j, Γ_j). With Q(τ) linear between Q_0 … Q_N ≻ 0 at knots δ apart in each part of the
period, and g_i = F_i E + G,

    −(Q_{k+1} − Q_k) / δ + F_i Q_e + Q_e F_iᵀ + a Q_e + g_i g_iᵀ / a ≺ 0    for e = k and e = k + 1, all k, all i
    R Q_N Rᵀ ≺ Q_0 of the next part,    J_j Q_N J_jᵀ / (1 − b) + Γ_j Γ_jᵀ / b ≺ Q_0 of the first, for all j

V = zᵀ Q(τ)⁻¹ z has V' ≤ −a V + a d² between ticks, and V⁺ ≤ (1 − b) V + b d² at them; what acts only at one of both has
a = 0 or b = 0 at the other, without the last term. So from z = 0 always V ≤ 1, from everywhere V ends below 1, and
|c z| ≤ max_k (c Q_k cᵀ)^½ for every row c: c Q(τ) cᵀ is linear between knots (proved in `docs/theory/beyond.md`).

A tube of what is summed, for a d that is seldom anything but 0, has in place of the last term between ticks

    g_i g_iᵀ ≺ Q_e    for all knots e, all i

and V^½' ≤ −(a / 2) V^½ + |d|: V^½ ends below the integral of |d| with weights that fall as e^(−a t / 2).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import pairwise

import numpy as np

from pwatrack.arrays import OVER_POWERS, Array
from pwatrack.ball_matrix import BallMatrix, different
from pwatrack.lmi.chain_map import Bound
from pwatrack.lmi.clocked import Clocked, looked_for, shrunk
from pwatrack.lmi.clocked_forms import ClockedForms, Segment
from pwatrack.lmi.exact import Packed, left_side, rounded_down
from pwatrack.lmi.norm import sizes_in, square_above
from pwatrack.rational import Rational, floats, is_positive_definite, number, scalar

_BITS = (40, 80)  # of the entries of Q_k
_GAP = 1e-3  # share of the cost that may be missed
_WORST = 8  # vertices that are added at each end of a segment where some are not satisfied
_FADING = 1e-9  # of the weight: of all of z, so that what is minimised is definite
_SLACKS = (1e-6, 3e-5, 1e-3)  # of the square of what drives, by which inequalities are to hold, until they are proved


@dataclass(frozen=True, kw_only=True)
class TubeProgram:
    """Looks for tubes of one system in floating point; what one search finds out about vertices serves the next.

    In coordinates in which a form that is proved to fall is I, and in which what drives is of size 1. Of many vertices
    few decide: those that the tubes found so far do not satisfy are added, until all are satisfied.
    """

    system: Clocked  # what z obeys
    near: Array  # a form P_0 that is proved to fall, (n, n)
    knots: int  # segments of each part

    def smallest(
        self, g: Array, kicks: Array, rows: Array, weights: Array, *, a: float, b: float, slack: float, summed: bool
    ) -> list[Array] | None:
        """Return Q at the knots, (n, n) each, with the least sum of weight c Q cᵀ; None where none is found.

        Args:
            g: What drives z' at each vertex, (v, n).
            kicks: Γ_j, (w, n).
            rows, weights: c, (s, n), and of each, (s,).
            a, b: As above.
            slack: Share of the size of what drives by which inequalities are to hold.
            summed: Whether d is.
        """
        L = np.linalg.cholesky(self.near).T
        back, eye = np.linalg.inv(L), np.eye(len(L))
        F, J = (np.array([L @ X.floats @ back for X in some]) for some in (self.system.F, self.system.J))
        driving, kicking = g @ L.T / np.sqrt(1.0 if summed else a or np.inf), kicks @ L.T / np.sqrt(b or np.inf)
        size = max(float((driving**2).max()), float((kicking**2).max()))
        if not 0 < size < np.inf:
            return None
        W = (rows @ back).T * weights @ (rows @ back) + _FADING * eye
        rest = slack * eye
        squares = rest + driving[:, :, None] * driving[:, None, :] / size
        pushed = np.tile(a * rest, (len(F), 1, 1)) if summed else squares
        holding = np.unique(squares, axis=0) if summed else squares[:0]
        between, count = self.system.between, self.clock.count
        R = eye if between is None else L @ between.floats @ back
        fixed = [Bound({k: (-eye / 2, eye)}, X) for X in holding for k in range(count)]
        fixed += [_kept(j - 1, j, R, eye, rest) for j in range(self.knots + 1, count, self.knots + 1)]
        for J_j, kick in zip(J, kicking, strict=True):
            left = J_j / np.sqrt(1 - b)
            fixed.append(_kept(count - 1, 0, left, self._seen(left), rest + np.outer(kick, kick) / size))
        F, step = F + a / 2 * eye, self.clock.step

        def solved() -> Array | None:
            return self.clock.solved(fixed, lambda s, i: _left(s, step * F[i], step * pushed[i]), _GAP, W / count)

        def lowest(Q: Array, segment: Segment) -> Array:
            k, after, e = segment
            product = F @ Q[e]
            left = Q[after] - Q[k] - step * (product + product.transpose(0, 2, 1) + pushed)
            return np.asarray(np.linalg.eigvalsh(left)[:, 0])

        found = self.clock.of_few(solved, lowest, _WORST)
        return None if found is None else [size * back @ Q @ back.T for Q in found]

    @cached_property
    def clock(self) -> ClockedForms:
        """Knots and segments, and which vertices matter, as far as that is known."""
        return looked_for(self.system, self.knots)

    @property
    def most(self) -> float:
        """No z falls faster for all vertices, in 1/s: what one does by itself."""
        return self.clock.most

    def _seen(self, J: Array) -> Array:
        """Return T for which T (Q − J Q Jᵀ) Tᵀ is of one size: most of z is hardly changed by a tick."""
        U, s, _ = np.linalg.svd(np.eye(len(J)) - J)
        return np.asarray(U.T / np.sqrt(np.clip(s, self.most * self.clock.period, 1.0))[:, None])


def _left(segment: Segment, F: Array, pushed: Array) -> Bound:
    """Return −(Q_{k+1} − Q_k) + F Q_e + Q_e Fᵀ + pushed ⪯ 0."""
    (k, after, e), eye = segment, np.eye(len(F))
    terms = {k: eye / 2, after: -eye / 2}
    terms[e] = terms[e] + F
    return Bound({j: (L, eye) for j, L in terms.items()}, pushed)


def _kept(before: int, after: int, J: Array, T: Array, above: Array) -> Bound:
    """Return T (J Q_before Jᵀ + above − Q_after) Tᵀ ⪯ 0."""
    return Bound({before: (T @ J / 2, (T @ J).T), after: (-T / 2, T.T)}, T @ above @ T.T)


@dataclass(frozen=True, kw_only=True)
class Drive:
    """How a scalar acts: between ticks or at them."""

    held: BallMatrix  # E, (n, 1): beside what of z
    between: BallMatrix  # G, (n, 1)
    ticks: Sequence[BallMatrix] | None = None  # Γ_j, (n, 1), one for each J_j; None where it acts between ticks


@dataclass(frozen=True, kw_only=True)
class Tube:
    """Q_0 … Q_N ≻ 0 of each part that satisfy the inequalities above, proved exactly; c Q_k cᵀ ≤ size² for rows c."""

    Q: tuple[Packed, ...]  # at the knots, those of the first part first
    a: float  # in 1/s, a short decimal; 0 where d acts at ticks
    b: float  # a short decimal; 0 where d acts between ticks
    sizes: tuple[float, ...]  # one for each c, rounded up
    summed: bool = False  # whether it is one of what is summed

    def spread(self, rows: Array) -> Array:
        """Return max_k (c Q_k cᵀ)^½ for other rows c, (s, n), in floating point, a little more."""
        Q = np.array([floats(Q_k.P) for Q_k in self.Q])
        return np.asarray(np.sqrt(np.einsum("si,kij,sj->ks", rows, Q, rows).max(axis=0)) * OVER_POWERS)


def tube(
    program: TubeProgram, driven: Drive, rows: BallMatrix, weights: Array, decay: float, *, summed: bool = False
) -> Tube | None:
    """Return a tube in which Σ weight c Q cᵀ is small, or None where none is proved.

    Args:
        program: Of the system.
        driven: How d acts.
        rows: c, (s, n).
        weights: Of each, (s,).
        decay: a in 1/s, or what b makes up for in a period: less than twice the rate with which z falls.
        summed: Whether d is summed; it acts between ticks then.

    Example: z' = −2 z + 3 d, and ticks that change nothing: |z| ≤ 3/2.

        >>> one, nothing = BallMatrix.of([[1]]), BallMatrix.of([[0]])
        >>> system = Clocked(F=[BallMatrix.of([[-2]])], J=[one], period=Fraction(1, 10))
        >>> program = TubeProgram(system=system, near=np.eye(1), knots=1)
        >>> found = tube(program, Drive(held=nothing, between=BallMatrix.of([[3]])), one, np.ones(1), 2.0)
        >>> 1.5 < found.sizes[0] < 1.51
        True
    """
    system, ticks = program.system, driven.ticks
    a, b = decay, 0.0
    if ticks is not None:
        a, b = 0.0, rounded_down(-float(np.expm1(-decay * float(system.period))), 3)
    g = np.array([(F @ driven.held + driven.between).floats[:, 0] for F in system.F])
    kicks = np.array([np.zeros(g.shape[1])] * len(system.J) if ticks is None else [X.floats[:, 0] for X in ticks])
    for slack in _SLACKS:
        found = program.smallest(g, kicks, rows.floats, weights, a=a, b=b, slack=slack, summed=summed)
        if found is None:
            return None
        for bits in _BITS:
            Q = tuple(Packed.of(Q_k, bits=bits) for Q_k in found)
            if contains(system, driven, Q, a, b, summed=summed):
                sizes = zip(*(sizes_in(Q_k.P, rows) for Q_k in Q), strict=True)
                return Tube(Q=Q, a=a, b=b, sizes=tuple(map(max, sizes)), summed=summed)
    return None


def contains(system: Clocked, driven: Drive, Q: Sequence[Packed], a: float, b: float, *, summed: bool = False) -> bool:
    """Say whether Q satisfy the inequalities, decided in fractions, for everything in the balls; a, b as they print."""
    N = len(Q) // system.parts - 1
    if N < 1 or len(Q) != system.parts * (N + 1) or not all(is_positive_definite(Q_k.P) for Q_k in Q):
        return False
    parts = [Q[j : j + N + 1] for j in range(0, len(Q), N + 1)]
    if not all(map(is_positive_definite, _jumps(system, driven, parts, Fraction(repr(b))))):
        return False
    slope = number(Fraction(N * system.parts) / system.period)
    columns = [F @ driven.held + driven.between for F in system.F]
    holding = different(columns) if summed else []
    left = (Q_k.P - square_above(column, [Fraction(1)], Q_k.scale) for column in holding for Q_k in Q)
    if not all(map(is_positive_definite, left)):
        return False
    for part in parts:
        for one, other in pairwise(part):
            for Q_e in (one, other):
                rest = scalar(a) * Q_e.P - (other.P - one.P) * slope
                for F, column in zip(system.F, columns, strict=True):
                    push = a and not summed
                    pushed = rest + square_above(column, [1 / Fraction(repr(a))], Q_e.scale) if push else rest
                    if not is_positive_definite(left_side(F, Q_e) - pushed):
                        return False
    return True


def _jumps(system: Clocked, driven: Drive, parts: Sequence[Sequence[Packed]], b: Fraction) -> Iterator[Rational]:
    """Yield what is to be positive definite at ticks and at the ends of parts."""
    first, last = parts[0][0], parts[-1][-1]
    kicks: Sequence[BallMatrix | None] = driven.ticks or [None] * len(system.J)
    for J, kick in zip(system.J, kicks, strict=True):
        kicked = first.P if kick is None else first.P - square_above(kick, [1 / b], first.scale)
        yield shrunk(J.transpose(), (last.P * number(1 / (1 - b)), last.scale), (kicked, first.scale))
    for before, after in pairwise(parts):
        assert system.between is not None
        yield shrunk(system.between.transpose(), (before[-1].P, before[-1].scale), (after[0].P, after[0].scale))
