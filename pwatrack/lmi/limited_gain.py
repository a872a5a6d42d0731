"""A gain that is sought together with the starts from which limits of its inputs do no harm.

For z' = A z + B v, v = K z cut off at limits, linear in Q, Y = K Q and Z = H Q: what `saturated` has for a given K, or
the same with H = K, so that no limit is reached (Boyd et al., Linear Matrix Inequalities in System and Control Theory,
1994, section 7.2.3). The worst cost from the starts is t if

    [sym(A_p Q + B Y), Q W^½, Yᵀ; ·, −t I, 0; ·, ·, −t I] ⪯ 0

as long as no limit is reached (Kothare, Balakrishnan and Morari, Robust constrained model predictive control using
linear matrix inequalities, Automatica, 1996).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from pwatrack.arrays import Array, symmetric_part
from pwatrack.lmi.matrix_program import Unknowns, minimised

_DECAY = 1e-3  # of the speed of the plant: what V falls with at a limit, at least
_LEAST, _LARGEST = 1e-4, 1e6  # Q, where starts have size 1


@dataclass(frozen=True)
class LimitedFound:
    """An answer: P = Q and Y, (n, n) and (m, n)."""

    P: Array
    Y: Array


@dataclass(frozen=True, kw_only=True)
class LimitedGain:
    """What is asked.

    Attributes:
        A, B: (p, n, n) and (n, m).
        shift: What a rate adds to A while no limit is reached, (n, n).
        starts: Boxes G ζ, |ζ_k| ≤ 1, each (n, k).
        room: By how much each input may differ from its feedforward, (m,); infinite where it has no limit.
        over: Of its room, what K may ask of an input from the starts: at 1 no limit is reached.
    """

    A: Array
    B: Array
    shift: Array
    starts: Sequence[Array]
    room: Array
    over: float

    def cheapest(self, rows: Array) -> LimitedFound | None:
        """Return the gain of the least worst cost of rows (k, n) of z and of its inputs, with all starts inside."""
        m = self.B.shape[1]

        def blocks(x: Unknowns) -> Iterator[Array]:
            yield from self._common(x, x["1"])
            t = x["t"][:, None, None]
            for A_p in self.A:
                seen = np.concatenate([rows @ x["Q"], x["Y"]], axis=1)
                corner = -symmetric_part((A_p + self.shift) @ x["Q"] + self.B @ x["Y"])
                yield np.block([[corner, seen.transpose(0, 2, 1)], [seen, t * np.eye(len(rows) + m)]])

        found = minimised("t", {**self._shapes, "t": ()}, blocks)
        return None if found is None else LimitedFound(found["Q"], found["Y"])

    def farthest(self) -> tuple[LimitedFound, float] | None:
        """Return a gain for the largest multiple of the starts, and that multiple."""
        bounded = (self.room > 0) & np.isfinite(self.room)
        shapes = {**self._shapes, "t": ()}
        found = minimised("t", shapes, lambda x: self._common(x, x["t"])) if bounded.any() else None
        if found is None or not found["t"] > 0:
            return None
        return LimitedFound(found["Q"], found["Y"]), float(1 / np.sqrt(found["t"]))

    @property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        n, m = self.B.shape
        found: dict[str, tuple[int, ...]] = {f"w{k}": (G.shape[1],) for k, G in enumerate(self.starts)}
        found |= {"Q": (n, n), "Y": (m, n)}
        return found | {"Z": (m, n)} if self.over > 1 else found

    def _common(self, x: Unknowns, most: Array) -> Iterator[Array]:
        """Yield what holds with all starts inside, |H_j z|² ≤ most · room_j² there."""
        n, limited = len(self.B), np.flatnonzero(np.isfinite(self.room))
        Q, one = x["Q"], x["1"][:, None, None]
        yield _LARGEST * one * np.eye(n) - Q
        yield Q - _LEAST * one * np.eye(n)
        for k, G in enumerate(self.starts):
            w = x[f"w{k}"]
            yield np.block([[Q, one * G], [one * G.T, w[:, :, None] * np.eye(G.shape[1])]])
            yield one - w.sum(axis=1)[:, None, None]
        kept = x["Z"] * (self.room > 0)[:, None] if self.over > 1 else x["Y"]
        for A_p in self.A:
            yield -symmetric_part((A_p + self.shift) @ Q + self.B @ x["Y"])
            for chosen in product((0.0, 1.0), repeat=len(limited) if self.over > 1 else 0):
                S = limited[np.array(chosen, dtype=bool)]
                added = self.B[:, S] @ (kept - x["Y"])[:, S]
                yield -symmetric_part(A_p @ Q + self.B @ x["Y"] + added) - _DECAY * Q
        for j in limited[self.room[limited] > 0].tolist():
            rows = [kept[:, j : j + 1] / self.room[j], x["Y"][:, j : j + 1] / (self.over * self.room[j])]
            for row in rows if 1 < self.over < np.inf else rows[:1]:
                yield np.block([[most[:, None, None], row], [row.transpose(0, 2, 1), Q]])
