"""Forms that depend on a clock: switched linear systems that jump at the ticks of it (Allerhand and Shaked 2011).

Between ticks z' = F(t) z with F(t) in the hull of boxes F_i + U_i diag(ε) V_i, |ε_k| ≤ 1, at a tick z⁺ = J z with J in
the hull of J_j; the period may have r parts, at whose ends but the last z⁺ = R z. With P(τ) and T(τ), diagonal, linear
between P_0 … P_N and T_0 … T_N at knots δ apart in each part,

    (P_{k+1} − P_k) / δ + F_iᵀ P_e + P_e F_i + 2 α P_e + V_iᵀ T_e V_i + P_e U_i T_e⁻¹ U_iᵀ P_e ≺ 0
        for e = k and e = k + 1, all k, all i
    Rᵀ P_0 R ≺ P_N of the part before,    J_jᵀ P_0 J_j ≺ P_N   from the first part to the last, for all j

make zᵀ P(τ) z fall as e^(−2 α t), whatever the switching: P U ε V + Vᵀ ε Uᵀ P ⪯ Vᵀ T V + P U T⁻¹ Uᵀ P for every such ε,
and with that as a Schur complement the first is affine in P and T, so the ends of a segment speak for all of it;
J ↦ Jᵀ P_0 J is convex, so the vertices do. Of a box without edges there is no T.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise, product

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, absolute, zero
from pwatrack.lmi.clocked_forms import ClockedForms, Forms
from pwatrack.lmi.exact import Packed, left_side, rounded_down, unsure
from pwatrack.lmi.norm import square_above
from pwatrack.rational import Rational, beside, diagonal, identity, is_positive_definite, number, scalar, stacked

_TRIED = (1.0, 0.99, 0.9, 0.5)  # shares of the rate that is looked for, until one is proved
_BITS = (40, 80)  # of the entries of P_k
_DIGITS = 6  # of the diagonals of T_k
_LOOKS = 5  # at a rate, at most, once one is proved
_SHARES = (0.9, 0.75, 0.5)  # of what parts by themselves reach: what is asked of the whole
_MANY = 16, 700  # boxes, or unknowns, from which on each look takes seconds
_OF_MANY = (0.5,)  # what is asked then

Knot = tuple[Packed, Sequence[float]]  # P_k and the diagonal of T_k
Scaled = tuple[Rational, Sequence[Fraction]]  # a form, and about the roots of its diagonal


@dataclass(frozen=True, kw_only=True)
class Clocked:
    """A switched system with a clock, exact."""

    F: Sequence[BallMatrix]  # what z obeys between ticks: middles of boxes, (n, n) each, in 1/s
    J: Sequence[BallMatrix]  # what a tick makes of z, (n, n) each
    period: Fraction  # h in s
    parts: int = 1  # r, of equal length
    # R, what the end of each part but the last makes of z; None where there is one part
    between: BallMatrix | None = None
    # sizes of parts of z that hardly act on each other in a circle, one after the other; () if not known
    blocks: tuple[int, ...] = ()
    sizes: tuple[float, ...] = ()  # of z, in which a search counts it; () if not known
    # of each box its edges, of as many: U_i, (n, p), and V_i, (p, n), exact; () if none has any
    U: Sequence[BallMatrix] = ()
    V: Sequence[BallMatrix] = ()

    @property
    def boxes(self) -> Iterator[tuple[BallMatrix, BallMatrix, BallMatrix]]:
        """F_i, U_i and V_i."""
        n = self.J[0].shape[0]
        return zip(self.F, self.U or [zero(n, 0)] * len(self.F), self.V or [zero(0, n)] * len(self.F), strict=True)

    @property
    def backward(self) -> "Clocked":
        """What is transposed, in backward time: of a form of it the inverse is one of this."""
        F, U, V, J = ([X.transpose() for X in each] for each in (self.F, self.V, self.U, self.J))
        R = None if self.between is None else self.between.transpose()
        return Clocked(F=F, J=J, period=self.period, parts=self.parts, between=R, U=U, V=V)

    @property
    def vertices(self) -> Iterator[BallMatrix]:
        """F_i + U_i diag(ε) V_i with all ε_k at 1 or −1: 2^p of each box."""
        for F, U, V in self.boxes:
            for signs in product((1, -1), repeat=V.shape[0]):
                yield F + U @ BallMatrix(diagonal([Fraction(v) for v in signs])) @ V if signs else F


@dataclass(frozen=True, kw_only=True)
class ClockedProof:
    """P_0 … P_N ≻ 0 of each part that satisfy the inequalities above, proved exactly."""

    P: tuple[Packed, ...]  # at the knots, those of the first part first
    rate: float  # α, a short decimal in 1/s
    T: tuple[tuple[float, ...], ...]  # the diagonals at the knots, short decimals


def clocked_proof(system: Clocked, *, knots: int, rate: float = 0.0) -> ClockedProof | None:
    """Return forms at N + 1 knots that prove a rate, or a little less; None where none are found.

    Args:
        knots: N, at least 1.
        rate: α in 1/s, at least 0.

    Example: z' = −z with a tick that doubles z falls where ticks are more than log 2 apart.

        >>> F, J = [BallMatrix.of([[-1]])], [BallMatrix.of([[2]])]
        >>> often, seldom = (Clocked(F=F, J=J, period=Fraction(h)) for h in ("0.69", "0.71"))
        >>> clocked_proof(often, knots=40) is None, clocked_proof(seldom, knots=40) is None
        (True, False)
    """
    found = looked_for(system, knots).at(rate, any_margin=True)
    return None if found is None else proved_forms(system, found, rate)


def fastest(system: Clocked, *, knots: int, shares: Sequence[float] = ()) -> ClockedProof | None:
    """Return forms that prove nearly the largest rate that forms at so many knots can, or None.

    Of parts that act on each other the whole is asked for these shares of what they reach by themselves.

    Example: z' = −z with a tick that halves z, every second: it falls as e^(−(1 + log 2) t).

        >>> half = Clocked(F=[BallMatrix.of([[-1]])], J=[BallMatrix.of([["1/2"]])], period=Fraction(1))
        >>> 1.5 < fastest(half, knots=8).rate < 1.7
        True
    """
    program = looked_for(system, knots)
    if not program.most > 0:
        return None
    if len(system.blocks) < 2:
        alone = program.fastest(program.most, _LOOKS)
        return None if alone is None else proved_forms(system, alone, alone.rate)
    best = program.at(0.0, any_margin=True)
    if best is None or not best.rate > 0:
        return None
    most = program.most_of_parts(system.blocks, _LOOKS) or 0.0
    many = len(system.F) > _MANY[0] or program.unknowns > _MANY[1]
    best = _faster(program, best, [share * most for share in shares or (_OF_MANY if many else _SHARES)])
    return proved_forms(system, best, best.rate)


def _faster(program: ClockedForms, best: Forms, rates: Sequence[float]) -> Forms:
    """Return forms that have about the first of falling rates that any have, or a larger one."""
    for rate in rates:
        if best.rate >= rate:
            break
        for one in program.around(rate):
            found = one.at(rate)
            if found is None:
                break  # in other coordinates there is none either
            best = best.or_faster(found)
            if best.rate >= rate:
                break
        else:
            best = program.again(best, rate)
            if best.rate >= rate:
                return best
    return program.again(best)


def proved_forms(system: Clocked, found: Forms, rate: float) -> ClockedProof | None:
    """Return forms in short numbers that prove a rate, or a little less, or None."""
    T = short_diagonals(found.T)
    for P in in_short_numbers(found.P):
        for share in _TRIED if rate else (1.0,):
            shown = rounded_down(rate * share, 6) if rate else 0.0
            if proves(system, P, T, shown):
                return ClockedProof(P=P, T=T, rate=shown)
    return None


def in_short_numbers(P: Sequence[Array | Rational]) -> Iterator[tuple[Packed, ...]]:
    """Yield forms in short numbers, then in longer ones."""
    return (tuple(Packed.of(P_k, bits=bits) for P_k in P) for bits in _BITS)


def short_diagonals(T: Array) -> tuple[tuple[float, ...], ...]:
    """Return numbers (knots, p) as short decimals."""
    return tuple(tuple(float(f"{v:.{_DIGITS}g}") for v in row) for row in T.tolist())


def knots_of(system: Clocked, P: Sequence[Packed], T: Sequence[Sequence[float]]) -> list[list[Knot]] | None:
    """Return what stands at the knots of each part, all P ≻ 0 and T > 0; None where it is not so, or does not fit."""
    N, p = len(P) // system.parts - 1, system.V[0].shape[0] if system.V else 0
    fits = N >= 1 and len(P) == system.parts * (N + 1) == len(T) and all(len(row) == p for row in T)
    if not (fits and all(v > 0 for row in T for v in row) and all(is_positive_definite(P_k.P) for P_k in P)):
        return None
    knots = list(zip(P, T, strict=True))
    return [knots[j : j + N + 1] for j in range(0, len(P), N + 1)]


def proves(system: Clocked, P: Sequence[Packed], T: Sequence[Sequence[float]], rate: float) -> bool:
    """Say whether forms satisfy the inequalities, decided in fractions, for everything in the balls of F and J."""
    parts = knots_of(system, P, T)
    if rate < 0 or parts is None:
        return False
    ends = (shrunk(J, (after.P, after.scale), (before.P, before.scale)) for J, after, before in jumps(system, parts))
    each = (slack for slack, *_ in slacks(system, parts, 2 * rate))
    return all(map(is_positive_definite, ends)) and all(map(is_positive_definite, each))


def jumps(system: Clocked, parts: Sequence[Sequence[Knot]]) -> Iterator[tuple[BallMatrix, Packed, Packed]]:
    """Yield what jumps make of z, those of ticks first, with the forms after and before each."""
    yield from ((J, parts[0][0][0], parts[-1][-1][0]) for J in system.J)
    for (*_, (before, _)), ((after, _), *_) in pairwise(parts):
        assert system.between is not None
        yield system.between, after, before


def slacks(
    system: Clocked, parts: Sequence[Sequence[Knot]], fall: float
) -> Iterator[tuple[Rational, Packed, Sequence[float], int]]:
    """Yield what is positive definite where V falls so fast, with what stands at an end of a segment, and its box."""
    slope = number(Fraction((len(parts[0]) - 1) * system.parts) / system.period)
    boxes = [(F.transpose(), U, V.transpose()) for F, U, V in system.boxes]
    for one, other in (pair for part in parts for pair in pairwise(part)):
        rise = (other[0].P - one[0].P) * slope
        for P, T in (one, other):
            more = rise + scalar(fall) * P.P
            for i, (F, U, V) in enumerate(boxes):
                yield left_side(F, P) - more - edges(BallMatrix(P.P) @ U, V, T, P.scale), P, T, i


def edges(U: BallMatrix, V: BallMatrix, T: Sequence[float], unit: Sequence[Fraction]) -> Rational:
    """Return V T Vᵀ + U T⁻¹ Uᵀ, which is above U ε Vᵀ + V ε Uᵀ for all diagonal ε between −I and I."""
    if not T:
        return identity(len(unit)) * 0
    exact = [Fraction(repr(v)) for v in T]
    return square_above(V, exact, unit) + square_above(U, [1 / v for v in exact], unit)


def shrunk(J: BallMatrix, after: Scaled, before: Scaled) -> Rational:
    """Return what is positive definite where Jᵀ P J ≺ Q, with P after a jump and Q before it, for all in the ball of J.

    That is Q − Jᵀ P J; where there is a ball [Q, Jᵀ P; P J, P], or what is below it.
    """
    (P, unit), (Q, other) = after, before
    lower = P * J.centre
    if J.radius is None:
        return Q - J.centre.transpose() * lower
    whole = stacked([beside([Q, lower.transpose()]), beside([lower, P])])
    zero = J.radius * 0
    radius = stacked([beside([zero, zero]), beside([absolute(P) * J.radius, zero])])
    both = [*other, *unit]
    return whole - unsure(radius, identity(2 * J.radius.nrows()), both)  # ⪰ ±(E + Eᵀ) for every |E_jk| ≤ radius_jk


def looked_for(system: Clocked, knots: int) -> ClockedForms:
    """Return the program that looks for forms in floating point."""
    F, J = (np.array([X.floats for X in matrices]) for matrices in (system.F, system.J))
    each = [(U.floats.reshape(len(F[0]), -1), V.floats.reshape(-1, len(F[0]))) for _, U, V in system.boxes]
    U, V = (np.array(some) for some in zip(*each, strict=True))
    R = np.eye(F.shape[1]) if system.between is None else system.between.floats
    sizes, period = np.array(system.sizes or [1.0] * len(R)), float(system.period)
    return ClockedForms(F=F, U=U, V=V, J=J, R=R, parts=system.parts, knots=knots, period=period, sizes=sizes)
