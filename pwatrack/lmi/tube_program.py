"""Tubes looked for in floating point: what they have to satisfy is in `clocked_tubes`, and proved there.

In coordinates in which a form that is proved to fall is I, and in which what drives is of size 1. Of many vertices few
decide: those that the tubes found so far do not satisfy are added, until all are satisfied.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pwatrack.arrays import Array
from pwatrack.lmi.chain_map import Bound, ChainMap
from pwatrack.lmi.clocked import Clocked, looked_for
from pwatrack.lmi.clocked_forms import ClockedForms, Segment
from pwatrack.lmi.primal_dual import least

_GAP = 1e-3  # share of the cost that may be missed
_WORST = 8  # vertices that are added at each end of a segment where some are not satisfied
_FADING = 1e-9  # of the weight: of all of z, so that what is minimised is definite


@dataclass(frozen=True, kw_only=True)
class TubeProgram:
    """Looks for tubes of one system; what the search for one finds out about vertices serves the next."""

    system: Clocked  # what z obeys
    near: Array  # a form P_0 that is proved to fall, (n, n)
    knots: int  # segments of each part

    def smallest(
        self,
        g: Array,
        kicks: Array,
        rows: Array,
        weights: Array,
        *,
        a: float,
        b: float,
        slack: float,
        summed: bool = False,
    ) -> list[Array] | None:
        """Return Q at the knots, (n, n) each, with the least sum of weight c Q cᵀ; None where none is found.

        Args:
            g: What drives z' at each vertex, (v, n).
            kicks: Γ_j, (w, n).
            rows, weights: c, (s, n), and of each, (s,).
            a, b: As in `clocked_tubes`.
            slack: Share of the size of what drives by which inequalities are to hold.
            summed: As in `clocked_tubes`.
        """
        L = np.linalg.cholesky(self.near).T
        back = np.linalg.inv(L)
        F, J = (np.array([L @ X.floats @ back for X in some]) for some in (self.system.F, self.system.J))
        driving, kicking = g @ L.T / np.sqrt(1.0 if summed else a or np.inf), kicks @ L.T / np.sqrt(b or np.inf)
        size = max(float((driving**2).max()), float((kicking**2).max()))
        if not 0 < size < np.inf:
            return None
        W = (rows @ back).T * weights @ (rows @ back)
        W = W + _FADING * np.eye(len(L))
        rest = slack * np.eye(len(L))
        squares = rest + driving[:, :, None] * driving[:, None, :] / size
        pushed, holding = (np.tile(a * rest, (len(F), 1, 1)), squares) if summed else (squares, squares[:0])
        between = self.system.between
        R = np.eye(len(L)) if between is None else L @ between.floats @ back
        each = zip(J, kicking, strict=True)
        jumps = [(J_j / np.sqrt(1 - b), rest + np.outer(kick, kick) / size) for J_j, kick in each]
        holds = [
            Bound({k: (-np.eye(len(L)) / 2, np.eye(len(L)))}, X) for X in _unlike(holding) for k in range(self.count)
        ]
        found = self._solved(F + a / 2 * np.eye(len(L)), pushed, jumps, (R, rest), W, holds)
        return None if found is None else [size * back @ Q @ back.T for Q in found]

    @cached_property
    def clock(self) -> ClockedForms:
        """Knots and segments, and which vertices matter, as far as that is known."""
        return looked_for(self.system, self.knots)

    @property
    def most(self) -> float:
        """No z falls faster for all vertices, in 1/s: what one does by itself."""
        return self.clock.most

    @property
    def count(self) -> int:
        """How many knots there are."""
        return self.clock.count

    def _solved(
        self,
        F: Array,
        pushed: Array,
        jumps: Sequence[tuple[Array, Array]],
        reset: tuple[Array, Array],
        W: Array,
        holds: Sequence[Bound],
    ) -> Array | None:
        """Return Q at the knots that satisfy all inequalities, (knots, n, n), or None."""
        size, fixed, (R, rest) = self.knots + 1, list(holds), reset
        ends = range(size, self.count, size)
        fixed += [self._kept(j - 1, j, R, np.eye(len(W)), rest) for j in ends]
        fixed += [self._kept(self.count - 1, 0, J, self._seen(J), above) for J, above in jumps]

        def solved() -> Array | None:
            asked = self.clock.asked.items()
            bounds = fixed + [self._bound(s, F[i], pushed[i]) for s, some in asked for i in some]
            chain = ChainMap(bounds, self.count, W / self.count)
            found = least(chain, gap=_GAP)
            return None if found is None else chain.matrices(found)

        def lowest(Q: Array, segment: Segment) -> Array:
            k, after, e = segment
            product = F @ Q[e]
            left = Q[after] - Q[k] - self.clock.step * (product + product.transpose(0, 2, 1) + pushed)
            return np.asarray(np.linalg.eigvalsh(left)[:, 0])

        return self.clock.of_few(solved, lowest, _WORST)

    def _bound(self, segment: Segment, F: Array, pushed: Array) -> Bound:
        """Return −(Q_{k+1} − Q_k) + step (F Q_e + Q_e Fᵀ + pushed) ⪯ 0."""
        (k, after, e), eye = segment, np.eye(len(F))
        terms = {k: eye / 2, after: -eye / 2}
        terms[e] = terms[e] + self.clock.step * F
        return Bound({j: (L, eye) for j, L in terms.items()}, self.clock.step * pushed)

    @staticmethod
    def _kept(before: int, after: int, J: Array, T: Array, above: Array) -> Bound:
        """Return T (J Q_before Jᵀ + above − Q_after) Tᵀ ⪯ 0."""
        return Bound({before: (T @ J / 2, (T @ J).T), after: (-T / 2, T.T)}, T @ above @ T.T)

    def _seen(self, J: Array) -> Array:
        """Return T for which T (Q − J Q Jᵀ) Tᵀ is of one size: most of z is hardly changed by a tick."""
        U, s, _ = np.linalg.svd(np.eye(len(J)) - J)
        return np.asarray(U.T / np.sqrt(np.clip(s, self.most * self.clock.period, 1.0))[:, None])


def _unlike(matrices: Array) -> Array:
    """Return the matrices without repetitions."""
    return np.asarray(np.unique(matrices, axis=0)) if len(matrices) else matrices
