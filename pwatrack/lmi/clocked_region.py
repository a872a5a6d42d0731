"""Inputs of a loop that is sampled, cut off at limits: from which starts z goes to 0 all the same, proved exactly.

Let z be as in `clocked`, with z⁺ = J z + T (v − D z) at ticks, T a column for each input with limits, E in it where
x̂ is moved by E (v − D z), and v_j what limits make of D_j z: D_j z where |D_j z| ≤ ū_j, and else between D_j z and 0
and no smaller than ū_j in size.
As in `saturated`, where |H_j z| ≤ ū_j each v_j is a mean of D_j z and H_j z. So with forms P_0 … P_N that satisfy the
inequalities of `clocked` with all

    J_S = J + T_S (H_S − D_S)    for every set S of inputs in place of J,    and H_jᵀ H_j ⪯ ū_j² P_N,

V = zᵀ P(τ) z falls from every z with V ≤ 1 just before a tick, with limits active (proved in `docs/theory/beyond.md`).
Starts G ζ, |ζ_k| ≤ 1, are among these where Gᵀ P_N G ⪯ diag(w), Σ w ≤ 1. With H = 0 V falls from every z, for any ū.

Where an input may change by so much at a tick only, it is first a mean of D_j z and b_j z + H_r z, for a row with
|H_r z| ≤ that, b_j z what it was before; then limits make a mean of that and H_j z of it: one more J for each.

Of a loop on which something acts, the same is true of what is left of z once the response to that is taken off, the one
of the loop without limits along the same switching from 0 on: where that takes β_j of ū_j at most, ū_j − β_j is left.

H is given here: then all is linear in P. It is looked for as if samples were short, see `saturated`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product

import numpy as np

from pwatrack.arrays import Array, root_of
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.chain_map import Bound, shrinks, square
from pwatrack.lmi.clocked import Clocked, clocked_proof, in_short_numbers, looked_for, proves, short_diagonals
from pwatrack.lmi.ellipsoid import reach_of, short_weights
from pwatrack.lmi.exact import Packed, short
from pwatrack.lmi.frame import Frame
from pwatrack.lmi.norm import square_above
from pwatrack.rational import diagonal, floats, is_positive_definite

_DECAYS = (0.02, 0.1)  # of the rate without limits: what V falls with at least, until that is enough to be proved
_LEAST = 1e-4  # of P at all knots, in coordinates in which the starts have size 1
_SEEN = 1e-3  # share of what rows are of z that is as large as starts: less that starts make of them counts as that
_GAP = 1e-3  # share of the scale that may be missed
_INSIDE = 1e-5  # by which P is made smaller, so that the starts are inside
_ABOVE = 1e-6  # by which a size is more than floating point says


@dataclass(frozen=True, kw_only=True)
class ClockedRegion:
    """What is proved above, exactly; no weights where it is from every start."""

    P: tuple[Packed, ...]  # at the knots, those of the first part first
    T: tuple[tuple[float, ...], ...]  # the diagonals there, as in `clocked`
    H: Array  # (m, n), decimals
    weights: tuple[float, ...]  # w_k, short decimals; one for each column of G
    sizes: tuple[float, ...]  # of H_j z where V ≤ 1 before a tick; all 0 where H = 0

    @property
    def form(self) -> Array:
        """P_N of the last part, (n, n)."""
        return floats(self.P[-1].P)

    def reach(self, rays: Array) -> Array:
        """Return how far the region reaches along rays (s, n), before a tick."""
        return reach_of(self.form, rays)


@dataclass(frozen=True, kw_only=True)
class SaturatedTicks:
    """A loop with limits of what a tick puts out."""

    system: Clocked  # without limits
    places: tuple[int, ...]  # in z of the input that each limit is of, (m,)
    T: BallMatrix  # what moves for what is cut off, (n, m): 1 there, where nothing is done against windup
    D: BallMatrix  # (m, n)
    before: BallMatrix  # rows that read on z what a limit of changes counts from; 0 of another, (m, n)
    near: Array  # a form P_0 that falls where no limit is reached, (n, n): it decides the coordinates
    rate: float  # with which it does, in 1/s
    knots: int  # segments of each part

    def limited(self, H: BallMatrix) -> Clocked:
        """Return the system with the ticks of all sets S: of the limits of an input there is one in it at most."""
        (m, n), ticks = H.shape, list[BallMatrix]()
        rest = H + self.before - self.D
        of_inputs = [[None, *(j for j in range(m) if self.places[j] == at)] for at in dict.fromkeys(self.places)]
        for chosen in product(*of_inputs):
            S = [j for j in chosen if j is not None]
            more = self.T.part(range(n), S) @ rest.part(S, range(n)) if S else None
            ticks += [J if more is None else J + more for J in self.system.J]
        return replace(self.system, J=ticks, blocks=())

    def everywhere(self) -> ClockedRegion | None:
        """Return P with H = 0, if they are proved: then z goes to 0 from every start, whatever the limits.

        Example: z' = −z with an input that a tick makes −z or less in size; and z' = z with −2 z: 0 does not hold it.

            >>> stable, unstable = ticking(-1.0, -1.0), ticking(1.0, -2.0)
            >>> stable.everywhere() is not None, unstable.everywhere() is not None
            (True, False)
        """
        H, sizes = np.zeros(self.D.shape), (0.0,) * self.D.shape[0]
        proof = clocked_proof(self.limited(BallMatrix.of(H, H.shape)), knots=self.knots)
        return None if proof is None else ClockedRegion(P=proof.P, T=proof.T, H=H, weights=(), sizes=sizes)

    def around(self, G: Array, room: Array, H: Array, weights: Array) -> ClockedRegion | None:
        """Return a region of a large multiple of starts G ζ, |ζ_k| ≤ 1, if one is proved; its sizes say of which.

        Args:
            G: (n, k), z just before the first tick; counts as the decimals that it prints as.
            room: ū in proportion, (m,); H_j = 0 where it is 0.
            H: (m, n), which is made short.
            weights: Of the columns of G that are not 0.

        Example: z' = z + v, v = −3 z cut off at ±1 and held for 0.1 s, goes to 0 from |z| < 1.

            >>> G, H = np.array([[0.5], [0.0]]), np.array([[-1.05, 0.0]])
            >>> found = ticking(1.0, -3.0).around(G, np.ones(1), H, np.ones(1))
            >>> bool(1.8 < 1 / found.sizes[0] < 2 / 1.05)
            True
        """
        H, few = short(H), short_weights(G, weights)
        system = self.limited(BallMatrix.of(H, H.shape))
        for decay in _DECAYS:
            found = self._sought(system, G / np.sqrt(few), H / np.where(room > 0, room, np.inf)[:, None], decay)
            if found is None:
                break  # nothing falls faster either
            T = short_diagonals(found[1] * (1 - _INSIDE))
            for P in in_short_numbers([P_k * (1 - _INSIDE) for P_k in found[0]]):
                if _starts_inside(P[-1], G, few) and proves(system, P, T, 0.0):
                    sizes = _sizes(P[-1], H)
                    if sizes is not None:
                        return ClockedRegion(P=P, T=T, H=H, weights=few, sizes=sizes)
        return None

    def _sought(self, system: Clocked, G: Array, rows: Array, decay: float) -> tuple[list[Array], Array] | None:
        """Return P and T at the knots, in floating point: with Gᵀ P_N G ⪯ I, rowsᵀ rows ⪯ P_N / t for the largest t.

        In coordinates in which the loop without limits, starts and rows are of size 1; t ≤ 1 where rows see starts.
        """
        clock, rate = looked_for(system, self.knots), decay * self.rate
        L = np.asarray(np.linalg.cholesky(self.near)).T
        L = L / np.linalg.norm(L @ G, 2)
        rows = rows / max(_longest(rows @ G), _SEEN * _longest(rows @ np.linalg.inv(L)))
        L = np.asarray(np.linalg.cholesky(L.T @ L + rows.T @ rows)).T
        inside, rows = clock.inside(Frame(L), rate), rows @ np.linalg.inv(L)
        starts, eye, last = root_of(L @ G @ G.T @ L.T).T, np.eye(len(L)), clock.count - 1
        less, nothing, idle = square(eye, -1.0), np.zeros_like(eye), np.zeros((sum(clock.U.shape[1:]),) * 2)
        fixed = [Bound({k: less}, nothing, _LEAST * eye) for k in range(clock.count)]
        fixed.append(Bound({last: square(starts)}, nothing, -eye))
        fixed += [Bound({last: less}, np.outer(row, row)) for row in rows[rows.any(axis=1)]]
        jumps = inside.jumps(inside.J * np.exp(rate * clock.period / 4), inside.R)
        fixed += [shrinks(before, after, X, nothing) for before, after, X, _ in jumps]
        found = inside.solved(fixed, lambda segment, i: inside.falls(segment, i, idle), inside.left, _GAP)
        return None if found is None else ([L.T @ P @ L for P in found[0]], found[1] * clock.longer(L) ** 2)


def _longest(rows: Array) -> float:
    return float(np.linalg.norm(rows, axis=1).max())


def _starts_inside(P: Packed, G: Array, weights: Sequence[float]) -> bool:
    """Say whether Gᵀ P G ≺ diag(w), decided in fractions."""
    on = BallMatrix.of(G, G.shape)
    inside = (on.transpose() @ BallMatrix(P.P) @ on).centre
    return is_positive_definite(diagonal([Fraction(repr(w)) for w in weights]) - inside)


def _sizes(P: Packed, H: Array) -> tuple[float, ...] | None:
    """Return short numbers with |H_j z| ≤ size where zᵀ P z ≤ 1, if that is so, decided in fractions."""
    found = []
    for row in H:
        size = float(np.sqrt(row @ np.linalg.solve(floats(P.P), row))) * (1 + _ABOVE)
        found.append(float(f"{size:.9e}"))
        inside = [1 / Fraction(repr(found[-1])) ** 2] if row.any() else [Fraction(0)]
        if not is_positive_definite(P.P - square_above(BallMatrix.of(row[:, None]), inside, P.scale)):
            return None
    return tuple(found)


def ticking(a: float, gain: float) -> SaturatedTicks:
    """Return the loop x' = a x + v with v = gain x, held for 0.1 s, as an example: z = (x, v)."""
    F, J = [BallMatrix.of([[a, 1], [0, 0]])], [BallMatrix.of([[1, 0], [gain, 0]])]
    system = Clocked(F=F, J=J, period=Fraction(1, 10))
    forms = looked_for(system, 1).at(0.0)
    assert forms is not None
    return SaturatedTicks(
        system=system,
        places=(1,),
        T=BallMatrix.of([[0], [1]]),
        D=BallMatrix.of([[gain, 0]]),
        before=BallMatrix.of([[0, 0]]),
        near=forms.P[0],
        rate=forms.rate,
        knots=4,
    )
