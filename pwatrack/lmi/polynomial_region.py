"""Polynomials in place of the ellipsoids of `saturated`: they hold more of what goes to 0 with inputs at their limits.

With the vertices X = M_p + B_S (H_S − D_S) of `saturated` and m(e) the monomials of degree d of z = T e, as in
`polynomial`, V = mᵀ P m falls from every start G ζ, |ζ_k| ≤ 1, with inputs cut off anywhere beyond s, if P ≻ 0 and

    sym(P 𝒳) + N_X ≺ 0  for every vertex X,      |H_j e|^2d ≤ s_j^2d V,      V(G ζ) ≤ Σ w_a ζ^2a,  Σ w_a ≤ 1.

It is proved in `docs/theory/beyond.md`, *Limits of the inputs*. P and H are sought in turn: with H given all is linear
in P, N and w, and so is what a small change of H adds to it. The freedom that is left makes the region large.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import product

import flint
import numpy as np

from pwatrack.arrays import Array, symmetric_part
from pwatrack.ball_matrix import BallMatrix, places
from pwatrack.lmi.cone_program import symmetric_of
from pwatrack.lmi.ellipsoid import StartEllipsoid
from pwatrack.lmi.exact import short as short_decimals
from pwatrack.lmi.inequality import CONTROLLER
from pwatrack.lmi.polynomial import (
    MOST_ROWS,
    Monomials,
    PolynomialLyapunov,
    PolynomialProof,
    prove_polynomial,
    short,
)
from pwatrack.lmi.saturated import Region, SaturatedLoop
from pwatrack.lmi.solve import Unknowns, minimised
from pwatrack.rational import decimals, diagonal, floats, is_positive_definite, scalar

DEGREES = (6, 4)  # that are tried, the first whose program is small enough
_DECAYS = (1e-4, 1e-6)  # of the speed of the loop: what V falls with at least, so that there is a margin
_LEAST = 1e-5  # of P, where the region is of size 1
_STEPS, _TRUST, _LITTLE = 8, 0.3, 0.02  # changes of H: how many, and how large the first and the last may be
_GAIN = 1.01  # of Σ w, which is scale^−2d: where a change of H gains or promises less, no further one is tried
_WORTH = 1.05  # times as much of the starts: with less another H is not worth what the region loses by it
_WIDER, _GIVEN = 2, 1.002  # times that the region is made larger, for so much of Σ w
_SEEN = 60  # directions for each state, in which it is looked at
_NEARLY = 0.999  # times as much of the starts is as much: a polynomial then holds more besides
_LEAST_WEIGHT = 1e-6  # of the largest one
_ROOM = (1e-6, 1e-4, 1e-2)  # by which the starts are enlarged, until they are proved to be inside
_ABOVE = (1e-9, 1e-6, 1e-3)  # by which sizes are enlarged, likewise


@dataclass(frozen=True, kw_only=True)
class PolynomialRegion:
    """V with what is proved above, and the rows H."""

    proof: PolynomialProof  # that V falls along all vertices; its rate is one of e
    H: Array  # (m, n), decimals
    weights: tuple[float, ...]  # w_a, short decimals, of the monomials of degree d of ζ
    sizes: tuple[float, ...]  # s_j; 0 where H_j = 0

    def reach(self, rays: Array) -> Array:
        """Return how far the region reaches along rays (s, n)."""
        P, monomials = floats(self.proof.P), self.proof.monomials
        seen = monomials.of_points(rays @ self.proof.T.T) / monomials.weights
        V = np.einsum("sj,jk,sk->s", seen, P, seen)
        return np.asarray(np.maximum(V, 1e-300) ** (-1 / self.proof.degree))


AnyRegion = Region | PolynomialRegion


def region_around(loop: SaturatedLoop, G: Array, room: Array, *, enough: float = np.inf) -> AnyRegion | None:
    """Return the region of the largest multiple of starts G ζ, |ζ_k| ≤ 1, that is proved.

    Args:
        loop: What is limited.
        G: (n, k), which counts as the decimals that it prints as.
        room: ū in proportion, (m,); H_j = 0 where it is 0.
        enough: How many times the starts, for ū: an ellipsoid that holds them is taken as it is.

    Example: z_1' = z_2, z_2' = z_1 + v with v = −2 (z_1 + z_2) cut off at ±1.

        >>> from pwatrack.lmi.ellipsoid import Inner
        >>> M, B, D = (BallMatrix.of(X) for X in ([[0, 1], [-1, -2]], [[0], [1]], [[-2, -2]]))
        >>> loop = SaturatedLoop(M=[M], B=B, D=D, inners=[Inner(Q=np.array([[3.0, -1], [-1, 1]]), most=0.5)])
        >>> found, ellipse = region_around(loop, np.eye(2), np.ones(1)), loop.around(np.eye(2), np.ones(1))
        >>> [round(scale_of(one, np.ones(1)), 2) for one in (found, ellipse)]
        [0.5, 0.5]
        >>> ray = np.array([[1.0, -1.0]])
        >>> bool(found.reach(ray) > 2 * ellipse.reach(ray))
        True
    """
    ellipsoid = loop.around(G, room)
    if ellipsoid is None or scale_of(ellipsoid, room) >= enough:
        return ellipsoid
    search = _Search.of(loop, ellipsoid, G, room)
    for tried in () if search is None else (replace(search, d=degree // 2) for degree in DEGREES):
        found = (tried.found(decay) for decay in _DECAYS if tried.rows <= MOST_ROWS)
        best = next((one for one in found if one is not None), None)
        if best is not None and (proved := tried.proved(best)) is not None:
            return proved if scale_of(proved, room) >= _NEARLY * scale_of(ellipsoid, room) else ellipsoid
    return ellipsoid


def scale_of(region: StartEllipsoid | PolynomialRegion, room: Array) -> float:
    """Return how many times the starts are inside, for this ū; infinite where no input is moved."""
    return min((float(most / size) for most, size in zip(room, region.sizes, strict=True) if size), default=np.inf)


@dataclass(frozen=True, kw_only=True)
class _Found:
    """An answer, in coordinates in which the ellipsoid is the unit ball and its rows are of size 1."""

    H: Array
    P: Array
    N: Array
    w: Array
    decay: float

    @property
    def total(self) -> float:
        """Σ w: c^−2d of the multiple c of the starts that is inside."""
        return float(self.w.sum())


@dataclass(frozen=True, kw_only=True)
class _Search:
    """The programs of one degree; M, B and D in these coordinates, over the speed of the loop."""

    loop: SaturatedLoop
    G: Array  # starts as they are given
    free: tuple[int, ...]  # inputs that are left some room
    T: Array  # z = T e
    M: Array
    B: Array
    D: Array
    H: Array
    unit: Array  # rows H of size 1 are these times as large, (m,)
    speed: float
    d: int = 1

    @classmethod
    def of(cls, loop: SaturatedLoop, ellipsoid: Region, G: Array, room: Array) -> "_Search | None":
        some = np.flatnonzero(room > 0)
        sizes = np.array(ellipsoid.sizes)
        if len(loop.B.floats) < 2 or not len(some) or not (sizes[some] > 0).any():
            return None
        try:
            T = short(np.linalg.inv(np.linalg.cholesky(floats(ellipsoid.P))))
            back = np.linalg.inv(T)
        except np.linalg.LinAlgError:  # it is singular to working precision
            return None
        unit = np.where(room > 0, room * float((sizes[some] / room[some]).max()), 1.0)
        M = np.array([T @ X.floats @ back for X in loop.M])
        speed = float(np.abs(M).max())
        return cls(
            loop=loop,
            G=G,
            free=tuple(some.tolist()),
            T=T,
            M=M / speed,
            B=T @ loop.B.floats * unit / speed,
            D=loop.D.floats @ back / unit[:, None],
            H=ellipsoid.H @ back / unit[:, None],
            unit=unit,
            speed=speed,
        )

    @property
    def monomials(self) -> Monomials:
        return Monomials.of(len(self.T), self.d)

    @property
    def of_starts(self) -> Monomials:
        """Of ζ."""
        return Monomials.of(self.G.shape[1], self.d)

    @property
    def rows(self) -> int:
        N, K = len(self.monomials), len(self.of_starts)
        blocks = len(self.M) * 2 ** len(self.D) + 1 + len(self.free)
        return int(blocks * N * (N + 1) // 2 + K * (K + 1) // 2)

    @cached_property
    def nothing(self) -> Array:
        """The symmetric matrices that span all N with mᵀ N m = 0, (f, N, N)."""
        return symmetric_of(self.monomials.nothing.toarray().T, len(self.monomials))

    @cached_property
    def starts(self) -> Array:
        """S with m(T G ζ) = S m(ζ), both in weights."""
        S = np.array(self.monomials.substituted((self.T @ self.G).tolist()), dtype=np.float64)
        return np.asarray(S * self.monomials.weights[:, None] / self.of_starts.weights)

    @cached_property
    def turns(self) -> Array:
        """The lifts of what each entry of H adds to a vertex, (m, n, N, N)."""
        eye = np.eye(len(self.T))
        return np.array([self.monomials.lift(np.array([np.outer(b, e) for e in eye])) for b in self.B.T])

    def found(self, decay: float) -> _Found | None:
        """Return the region of the largest multiple of the starts that is found, in floating point."""
        first, trust = self._solved(self.H, decay), _TRUST
        if first is None:
            return None
        best = first
        for _ in range(_STEPS):
            changed = self._solved(best.H, decay, about=best.P, trust=trust)
            if changed is not None and best.total <= _GAIN * changed.total:
                break
            tried = None if changed is None else self._solved(changed.H, decay)
            if tried is None or not tried.total < best.total:
                trust /= 4
            elif best.total > _GAIN * tried.total:
                best, trust = tried, min(1.5 * trust, 1.0)
            else:
                best, trust = tried, 0.0
            if trust < _LITTLE:
                break
        best = best if best.total * _WORTH ** (2 * self.d) < first.total else first
        for _ in range(_WIDER):
            best = self._solved(best.H, decay, wider=best) or best
        return best

    def _solved(
        self, H: Array, decay: float, *, about: Array | None = None, trust: float = 0.0, wider: _Found | None = None
    ) -> _Found | None:
        """Return P, N and w of the least Σ w for these H; or with a small change of H, beside P as it is `about`.

        Where there is one that is to be `wider`, P is that of the largest region for about its Σ w.
        """
        sets, N = list(product((0, 1), repeat=len(H))), len(self.monomials)
        vertices = np.array([M + (self.B * np.array(S)) @ (H - self.D) for S in sets for M in self.M])
        lifts, squares = self.monomials.lift(vertices), np.array(self.of_starts.squares)
        rows = self.monomials.of_points(H)
        slopes = [self._slope(row, h) for row, h in zip(rows, H, strict=True)]

        def blocks(x: Unknowns) -> Iterator[Array]:
            P, one, total = x["Q"], x["1"][:, None, None], x["w"].sum(axis=1)
            changed = x["dH"] if about is not None else np.zeros((len(one), *H.shape))
            for k, lift in enumerate(lifts):
                left = -symmetric_part(P @ lift) - 2 * self.d * decay * P
                for j in self.free if about is not None else ():
                    added = np.einsum("ck,kab->cab", changed[:, j], self.turns[j])
                    left = left - sets[k // len(self.M)][j] * symmetric_part(about @ added)
                yield left - np.einsum("cf,fab->cab", x["N"][:, k], self.nothing)
            for j in self.free:
                yield _bordered(P, one[:, 0] * rows[j] + changed[:, j] @ slopes[j], one)
                if about is not None:
                    yield _bordered(trust * one * np.eye(H.shape[1]), changed[:, j], trust * one)
            yield P - _LEAST * one * np.eye(N)
            yield (x["w"] / squares)[:, :, None] * np.eye(len(squares)) - self.starts.T @ P @ self.starts
            if wider is None:
                yield (x["t"] - total)[:, None, None]
            else:
                yield (x["1"] * _GIVEN * wider.total - total)[:, None, None]
                yield (x["t"] - np.einsum("cab,ab->c", P, self._seen(wider.P)))[:, None, None]

        shapes = {"Q": (N, N), "N": (len(lifts), len(self.nothing)), "w": (len(squares),), "t": ()}
        x = minimised(shapes | ({} if about is None else {"dH": H.shape}), blocks)
        if x is None or not x["w"].sum() > 0:
            return None
        numbers = np.einsum("kf,fab->kab", x["N"], self.nothing)
        if about is None and not np.linalg.eigvalsh(-symmetric_part(x["Q"] @ lifts) - numbers).min() > 0:
            return None
        H = H if about is None else H + x["dH"]
        return _Found(H=H, P=x["Q"], N=numbers, w=np.maximum(x["w"], 0.0), decay=decay)

    def _slope(self, row: Array, h: Array) -> Array:
        """Return by what (h z)^d changes with the entries of h, (n, N): it is d/dt along z' = h e_kᵀ / |h|² z."""
        if not h.any():
            return np.zeros((len(h), len(row)))
        return np.array([row @ lift for lift in self.monomials.lift(h[:, None] * np.eye(len(h))[:, None] / (h @ h))])

    def _seen(self, P: Array) -> Array:
        """Return W with tr W P the mean of V, in which directions count as what the region gains by them."""
        z = np.random.default_rng(0).normal(size=(_SEEN * len(self.T), len(self.T)))
        points = self.monomials.of_points(z / np.linalg.norm(z, axis=1)[:, None])
        V = np.maximum(np.einsum("sa,ab,sb->s", points, P, points), 1e-9)
        weights = V ** (-len(self.T) / (2 * self.d) - 1)
        W = (points * weights[:, None]).T @ points
        return np.asarray(W / np.trace(W))

    def proved(self, found: _Found) -> PolynomialRegion | None:
        """Return what is found in short numbers, if it is proved for them."""
        H = short_decimals(found.H * self.unit[:, None] @ self.T)
        vertices = self.loop.vertices(BallMatrix.of(H, H.shape))
        kept = places(vertices)
        X = [vertices[k] for k in kept]
        weights = _short(found.w / found.total)
        for more in _ROOM:
            near = PolynomialLyapunov(
                A=np.array([X_k.floats for X_k in X]),
                degree=2 * self.d,
                T=self.T,
                P=found.P / (found.total * (1 + more)),
                N=found.N[kept] * self.speed / (found.total * (1 + more)),
                rate=found.decay * self.speed,
            )
            proof = prove_polynomial(CONTROLLER, X, near)
            if proof is not None and _inside(proof, self.G, weights):
                sizes = [_size(proof, h) if h.any() else 0.0 for h in H]
                if np.isfinite(sizes).all():
                    return PolynomialRegion(proof=proof, H=H, weights=weights, sizes=tuple(sizes))
        return None


def _bordered(X: Array, row: Array, corner: Array) -> Array:
    return np.block([[X, row[:, :, None]], [row[:, None], corner]])


def _short(weights: Array) -> tuple[float, ...]:
    """Return short weights, positive and of sum 1 at most."""
    some = np.maximum(weights, _LEAST_WEIGHT * weights.max())
    return tuple((np.maximum(np.floor(some / some.sum() * 1e9 - 1), 1.0) / 1e9).tolist())


def _inside(proof: PolynomialProof, G: Array, weights: Sequence[float]) -> bool:
    """Say whether V(G ζ) < Σ w_a ζ^2a, decided in fractions."""
    monomials, TG = proof.monomials, decimals(proof.T) * decimals(G)
    S = monomials.substituted([[TG[j, k] for k in range(TG.ncols())] for j in range(TG.nrows())])
    on = flint.fmpq_mat(len(S), len(S[0]), [v for row in S for v in row])
    return is_positive_definite(diagonal([Fraction(repr(w)) for w in weights]) - on.transpose() * proof.P * on)


def _size(proof: PolynomialProof, h: Array) -> float:
    """Return a short s with |h e| ≤ s where V ≤ 1, proved in fractions; infinite where none is."""
    row = proof.monomials.power((decimals(h[None]) * decimals(proof.T).inv()).entries())
    column = flint.fmpq_mat(len(row), 1, row)
    P, near = floats(proof.P), floats(column)[:, 0]
    about = float(near @ np.linalg.solve(P, near)) ** (1 / proof.degree)
    tries = (float(f"{about * (1 + above):.12e}") for above in _ABOVE if np.isfinite(about))
    square = column * column.transpose()
    return next((s for s in tries if is_positive_definite(proof.P * scalar(s) ** proof.degree - square)), np.inf)
