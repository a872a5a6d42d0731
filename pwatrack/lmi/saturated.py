"""Inputs that are cut off at limits: from which starts z goes to 0 all the same, proved exactly.

Let z' = M(t) z + B (v − D z) with M(t) in the convex hull of the M_p, v_j what limits make of D_j z, and rows H. With

    sym((M_p + B_S (H_S − D_S)) Q) ≺ 0   for every p and every set S of inputs,      H_j Q H_jᵀ ≤ ū_j²

V = zᵀ Q⁻¹ z falls from every start with V ≤ 1, with limits active; with H = 0 from every start, whatever ū is. It is
proved in `docs/theory/beyond.md`, *Limits of the inputs*. Linear in Q and Z = H Q.

For D = K it is linear in Y = K Q too: so a gain may be sought together with the starts from which limits of its inputs
do no harm, or, with H = K, with those from which no limit is reached (Boyd et al., Linear Matrix Inequalities in System
and Control Theory, 1994, section 7.2.3). The worst cost from the starts is t if

    [sym(A_p Q + B Y), Q W^½, Yᵀ; ·, −t I, 0; ·, ·, −t I] ⪯ 0

as long as no limit is reached (Kothare, Balakrishnan and Morari, Robust constrained model predictive control using
linear matrix inequalities, Automatica, 1996).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from scipy.linalg import solve_triangular

from pwatrack.arrays import Array, symmetric_part
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.ellipsoid import Inner, StartEllipsoid, around_starts, enclosure
from pwatrack.lmi.exact import short
from pwatrack.lmi.inequality import lyapunov
from pwatrack.lmi.program import largest_margin
from pwatrack.lmi.solve import Unknowns, minimised, solve

MOST_WORK = 300_000  # matrices · order⁴: what a Newton step may cost
_DECAYS = (1e-3, 1e-5)  # of the speed of the loop: what V falls with at least, so that there is a margin
_DECAY = 1e-3  # of the speed of the plant, of a gain that is sought: what V falls with at a limit, at least
_LEAST, _LARGEST = 1e-4, 1e6  # Q, where starts have size 1
_ROOM = (1e-6, 1e-4, 1e-2)  # by which Q is enlarged, until it is proved
_MANY, _FIRST, _ROUNDS = 64, 16, 12  # inequalities up to which all are asked; else how many at first, and more so often
_MISSED = 1e-3  # of what V falls by at least: what any that is not asked may miss


@dataclass(frozen=True, kw_only=True)
class Region(StartEllipsoid):
    """Q with what is proved above, around G diag(1 / w) Gᵀ; no weights where it is from every start."""

    H: Array  # (m, N), decimals; the sizes are those of H_j z, and all are 0 where H = 0


@dataclass(frozen=True, kw_only=True)
class SaturatedLoop:
    """z' = M z + B (v − D z)."""

    M: Sequence[BallMatrix]  # the matrices M_p, (N, N)
    B: BallMatrix  # of the inputs that have limits, (N, m)
    D: BallMatrix  # likewise, (m, N)
    inners: Sequence[Inner]  # Q of the loop without limits: they say which coordinates are good ones
    # of so many inequalities those that are known to bind: what one search finds out serves the next
    known: dict[tuple[bool, int], set[int]] = field(default_factory=dict, compare=False, repr=False)

    @property
    def work(self) -> int:
        """What a Newton step costs."""
        N, m = self.B.shape
        return int(len(self.M) * 2**m * N**4)

    def vertices(self, H: BallMatrix) -> list[BallMatrix]:
        """Return M_p + B_S (H_S − D_S) for all p and S."""
        (N, m), rest = self.B.shape, H - self.D
        found = []
        for chosen in product((False, True), repeat=m):
            S = [j for j in range(m) if chosen[j]]
            change = self.B.part(range(N), S) @ rest.part(S, range(N)) if S else None
            found += [M_p if change is None else M_p + change for M_p in self.M]
        return found

    def everywhere(self) -> Region | None:
        """Return a Q with H = 0, if one is proved: then z goes to 0 from every start, whatever the limits.

        Example: of z' = −z + v with v = −z or less in size, and of z' = z + v with v = −2 z, which 0 does not hold.

            >>> one, two = BallMatrix.of([[1]]), BallMatrix.of([[-2]])
            >>> loops = (BallMatrix.of([[-2]]), one, BallMatrix.of([[-1]])), (BallMatrix.of([[-1]]), one, two)
            >>> inner = [Inner(Q=np.eye(1), most=1.0)]
            >>> loops = (SaturatedLoop(M=[M], B=B, D=D, inners=inner) for M, B, D in loops)
            >>> [loop.everywhere() is not None for loop in loops]
            [True, False]
        """
        m, N = self.D.shape
        nothing = BallMatrix.of(np.zeros((m, N)))
        vertices = self.vertices(nothing)
        M = np.array([X.floats for X in vertices])
        near = self.inners[-1].near(M) if self.inners else None
        if near is None or not np.linalg.eigvals(M).real.max() < 0:
            return None
        V, inside = near
        found = solve(largest_margin(lyapunov(inside / max(float(np.abs(inside).max()), 1e-300))))
        if found is None or not found.t > 0:
            return None
        proved = enclosure(vertices, nothing, [V @ found.P @ V.T])
        return None if proved is None else Region(weights=(), H=np.zeros((m, N)), **proved)

    def around(self, G: Array, room: Array) -> Region | None:
        """Return the region of the largest multiple of starts G ζ, |ζ_k| ≤ 1, if one is proved; its sizes say of which.

        Args:
            G: (N, k), which counts as the decimals that it prints as.
            room: ū in proportion, (m,); H_j = 0 where it is 0.

        Example: z' = z + v, v = −3 z cut off at ±1, goes to 0 from |z| < 1.

            >>> M, B, D = (BallMatrix.of([[v]]) for v in (-2, 1, -3))
            >>> loop = SaturatedLoop(M=[M], B=B, D=D, inners=[Inner(Q=np.eye(1), most=3.9)])
            >>> found = loop.around(np.array([[0.5]]), np.ones(1))
            >>> bool(1.98 < 1 / found.sizes[0] < 2)
            True
        """
        for Q, H, weights in self.sought(G, room):
            exactly = BallMatrix.of(H, H.shape)
            trials = (Q * (1 + more) for more in _ROOM)
            proved = around_starts(self.vertices(exactly), G, exactly, weights, trials)
            if proved is not None:
                return Region(H=H, **proved)
        return None

    def sought(self, G: Array, room: Array, rates: Sequence[float] = ()) -> Iterator[tuple[Array, Array, Array]]:
        """Yield Q, H and the weights of the columns of G that are not 0, in floating point.

        V falls at these rates at least, in 1/s; where none are given, at shares of the speed of the loop.
        """
        mask = (room > 0)[:, None]
        for size, V, _, units, found in self._asked_of(G, room, rates, np.zeros((len(G), 0))):
            H = np.linalg.solve(V.T, np.linalg.solve(found["Q"], (found["Z"] * mask).T)).T * units[:, None]
            yield size**2 * V @ found["Q"] @ V.T, short(H), found["w"]

    def against_windup(self, G: Array, room: Array, free: int, rate: float, faster: float) -> Array | None:
        """Return E (free, m) in the last rows of B, with which the largest multiple of starts G ζ is held, as `sought`.

        It is one program, linear in Q, Z, T and E T: see `docs/theory/beyond.md`, *Limits of the inputs*. V falls at a
        `rate`, in 1/s, and at most so many times `faster` than what falls fastest without limits, by the same
        multipliers: so that ticks do nearly what E does.

        Example: z₁' = z₁ + v with v = −3 (z₁ + z₂) cut off at ±1, z₂' = −z₂ + E (v + 3 (z₁ + z₂)).

            >>> M, B, D = (BallMatrix.of(v) for v in ([[-2, -3], [0, -1]], [[1], [0]], [[-3, -3]]))
            >>> loop = SaturatedLoop(M=[M], B=B, D=D, inners=[Inner(Q=np.diag([1, 0.2]), most=9.0)])
            >>> loop.against_windup(np.array([[0.5], [0.0]]), np.ones(1), 1, 1e-3, 5.0).shape
            (1, 1)
        """
        N, most = len(G), faster * max(-float(np.linalg.eigvals(X.floats).real.min()) for X in self.M)
        asked = next(self._asked_of(G, room, [rate], np.eye(N)[:, N - free :], most), None)
        if asked is None:
            return None
        _, _, speed, units, found = asked
        return np.asarray(found["X"] / found["T"]) * speed / units

    def _asked_of(
        self, G: Array, room: Array, rates: Sequence[float], free: Array, most: float = 0.0
    ) -> Iterator[tuple[float, Array, float, Array, dict[str, Array]]]:
        """Yield the size of the starts, coordinates V, speed, the units of D, and what is found in these of size 1."""
        acts = np.flatnonzero(G.any(axis=0))
        asked = self.inners and len(acts) and room.any()
        near = self.inners[-1].near(np.array([X.floats for X in self.M])) if asked else None
        if near is None:
            return
        V, inside = near
        B, D = solve_triangular(V, self.B.floats, lower=True), self.D.floats @ V
        units = np.linalg.norm(D, axis=1)  # in which D is 1
        room = np.where(units > 0, room, 0.0)  # H = 0 of an input that is not used
        units[units == 0] = 1.0
        if not room.any():
            return
        speed, G = max(float(np.abs(inside).max()), 1e-300), solve_triangular(V, G[:, acts], lower=True)
        size, room = float(np.linalg.norm(G, 2)), room / units / float((room / units).max())
        free = solve_triangular(V, free, lower=True)
        for decay in [2 * rate / speed for rate in rates] or _DECAYS:
            found = _largest(
                inside / speed,
                B * units / speed,
                D / units[:, None],
                G / size,
                room,
                decay,
                free,
                2 * most / speed,
                self.known,
            )
            if found is not None:
                yield size, V, speed, units, found


def _largest(
    M: Array,
    B: Array,
    D: Array,
    G: Array,
    room: Array,
    decay: float,
    free: Array,
    most: float,
    known: dict[tuple[bool, int], set[int]],
) -> dict[str, Array] | None:
    """Return Q, Z and weights w, Q ⪰ G diag(1 / w) Gᵀ, Σ w ≤ 1, of the least t with H_j Q H_jᵀ ≤ t room_j²; Z is H Q.

    With T and X too, B T + free X in place of B T, where a gain is `free`. In floating point, in coordinates in which
    ū_j and the loop are of size 1. Of many inequalities few bind: those that are `known` to, and what these leave.
    """
    (N, k), m, eye = G.shape, len(D), np.eye(len(D))
    mask = (room > 0).astype(float)[:, None]

    def falls(x: Unknowns) -> Iterator[Array]:
        Q, rest = x["Q"], x["Z"] * mask - D @ x["Q"]
        for chosen in product((0.0, 1.0), repeat=m):
            added = B @ (np.array(chosen)[:, None] * rest)
            for M_p in M:
                yield -symmetric_part(M_p @ Q + added) - decay * Q

    def falls_with(x: Unknowns) -> Iterator[Array]:
        Q, T, rest = x["Q"], x["T"][:, :, None] * eye, (x["Z"] * mask - D @ x["Q"]).transpose(0, 2, 1)
        moved = B @ T + free @ x["X"]
        for M_p in M:
            change = symmetric_part(M_p @ Q)
            for corner, side in ((-change - decay * Q, rest + moved), (change + most * Q, rest - moved)):
                yield np.block([[corner, side], [side.transpose(0, 2, 1), 2 * T]])

    falling, count = (falls_with, 2 * len(M)) if free.size else (falls, 2**m * len(M))
    first = np.linspace(0, count - 1, _FIRST if count > _MANY else count).astype(int).tolist()
    asked = known.setdefault((bool(free.size), count), set(first))

    def blocks(x: Unknowns) -> Iterator[Array]:
        yield from (X for j, X in enumerate(falling(x)) if j in asked)
        yield from _inside(x, {"w": G})
        for j in np.flatnonzero(mask).tolist():
            yield _bounded(x["Q"], (x["Z"] * mask)[:, j : j + 1] / room[j], x["t"])

    shapes: dict[str, tuple[int, ...]] = {"Q": (N, N), "Z": (m, N), "w": (k,), "t": ()}
    for _ in range(_ROUNDS):
        found = minimised({**shapes, "T": (m,), "X": (free.shape[1], m)} if free.size else shapes, blocks)
        if found is None or not (size := np.linalg.eigvalsh(found["Q"])[0]) > 0:
            return None
        least = [np.linalg.eigvalsh(X[0])[0] for X in falling({name: x[None] for name, x in found.items()})]
        missed = [
            j for j in np.argsort(least)[:_FIRST].tolist() if j not in asked and least[j] < -_MISSED * decay * size
        ]
        if not missed:
            return found
        asked.update(missed)
    return None


@dataclass(frozen=True, kw_only=True)
class LimitedGain:
    """What is asked: of z' = A_p z + B_p v, or of z⁺ = A_p z + B_p v of a sample where inputs are held."""

    A: Array  # (p, n, n)
    B: Array  # (p, n, m)
    shift: Array  # what a rate adds to A while no limit is reached, (n, n)
    starts: Sequence[Array]  # boxes G ζ, |ζ_k| ≤ 1, each (n, k)
    room: Array  # by how much each input may differ from its feedforward, (m,); infinite where it has no limit
    over: float  # of its room, what K may ask of an input from the starts: at 1 no limit is reached
    held: bool = False

    def cheapest(self, rows: Array) -> tuple[Array, Array] | None:
        """Return Q and Y of the least worst cost of rows (k, n) of z and of its inputs, with all starts inside."""
        m = self.B.shape[2]

        def blocks(x: Unknowns) -> Iterator[Array]:
            yield from self._common(x, x["1"])
            t = x["t"][:, None, None]
            for A_p, B_p in zip(self.A, self.B, strict=True):
                seen = np.concatenate([rows @ x["Q"], x["Y"]], axis=1)
                corner = -symmetric_part((A_p + self.shift) @ x["Q"] + B_p @ x["Y"])
                yield np.block([[corner, seen.transpose(0, 2, 1)], [seen, t * np.eye(len(rows) + m)]])

        found = minimised({**self._shapes, "t": ()}, blocks)
        return None if found is None else (found["Q"], found["Y"])

    def farthest(self) -> tuple[Array, Array, float] | None:
        """Return Q and Y for the largest multiple of the starts, and that multiple."""
        bounded = (self.room > 0) & np.isfinite(self.room)
        shapes = {**self._shapes, "t": ()}
        found = minimised(shapes, lambda x: self._common(x, x["t"])) if bounded.any() else None
        if found is None or not found["t"] > 0:
            return None
        return found["Q"], found["Y"], float(1 / np.sqrt(found["t"]))

    @property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        n, m = self.B.shape[1:]
        found: dict[str, tuple[int, ...]] = {f"w{k}": (G.shape[1],) for k, G in enumerate(self.starts)}
        found |= {"Q": (n, n), "Y": (m, n)}
        return found | {"Z": (m, n)} if self.over > 1 else found

    def _common(self, x: Unknowns, most: Array) -> Iterator[Array]:
        """Yield what holds with all starts inside, |H_j z|² ≤ most · room_j² there."""
        Q, limited = x["Q"], np.flatnonzero(np.isfinite(self.room))
        yield from _inside(x, {f"w{k}": G for k, G in enumerate(self.starts)})
        kept = x["Z"] * (self.room > 0)[:, None] if self.over > 1 else x["Y"]
        for A_p, B_p in zip(self.A, self.B, strict=True):
            yield self._falls(Q, (A_p + self.shift) @ Q + B_p @ x["Y"], 0.0)
            for chosen in product((0.0, 1.0), repeat=len(limited) if self.over > 1 else 0):
                S = limited[np.array(chosen, dtype=bool)]
                added = B_p[:, S] @ (kept - x["Y"])[:, S]
                yield self._falls(Q, A_p @ Q + B_p @ x["Y"] + added, _DECAY)
        for j in limited[self.room[limited] > 0].tolist():
            rows = [kept[:, j : j + 1] / self.room[j], x["Y"][:, j : j + 1] / (self.over * self.room[j])]
            for row in rows if 1 < self.over < np.inf else rows[:1]:
                yield _bounded(Q, row, most)

    def _falls(self, Q: Array, X: Array, decay: float) -> Array:
        """Return what says that V falls along z' = X Q⁻¹ z, or z⁺ = X Q⁻¹ z."""
        if self.held:
            return np.block([[(1 - decay) * Q, X.transpose(0, 2, 1)], [X, Q]])
        return -symmetric_part(X) - decay * Q


def _inside(x: Unknowns, starts: Mapping[str, Array]) -> Iterator[Array]:
    """Yield what bounds Q, and what has starts G ζ, |ζ_k| ≤ 1, in its ellipsoid, each G with weights of this name."""
    Q, one = x["Q"], x["1"][:, None, None]
    eye = np.eye(Q.shape[1])
    yield _LARGEST * one * eye - Q
    yield Q - _LEAST * one * eye
    for name, G in starts.items():
        w = x[name]
        yield np.block([[Q, one * G], [one * G.T, w[:, :, None] * np.eye(G.shape[1])]])
        yield one - w.sum(axis=1)[:, None, None]


def _bounded(Q: Array, row: Array, most: Array) -> Array:
    """Return what says that row Q⁻¹ rowᵀ ≤ most."""
    return np.block([[most[:, None, None], row], [row.transpose(0, 2, 1), Q]])
