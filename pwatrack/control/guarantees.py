"""What the proofs promise: how fast errors go to 0, how large they get on the way, by how much the gains may change.

Everything here follows, as in the proof of Theorem 2 (see `docs/theory/paper.md`), from

    Δ' = (Â + L C) Δ,        e' = (Â + B K) e + B K Δ,

for Δ = x̂ − x and e = x − x_d, each Â in the convex hull of the A_i, and a proof, a norm with d‖Δ‖/dt ≤ −α ‖Δ‖; likewise
for e. (Where loads are estimated, Δ has the errors of the estimates too, and other columns stand for B K: see
`compensation`.) x_d is the one that the generator (15) makes, from its own start: there c x_d = y_d for the tracked row
c. It approaches the bounded one of (13) as fast as (17) says. What disturbances do is in `bounds`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import OVER_POWERS, Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.control.compensation import coupling
from pwatrack.control.synthesis import Gains
from pwatrack.control.trajectory import NoncausalTrajectory
from pwatrack.lmi.exact import Proof, left_side
from pwatrack.lmi.inequality import CONTROLLER, GENERATOR, OBSERVER
from pwatrack.lmi.norm import Gauge, Norm, largest_gain, largest_share
from pwatrack.lmi.polynomial import AnyProof
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.rational import Rational, floats, identity, scalar


@dataclass(frozen=True, kw_only=True)
class Contraction:
    """One proof, read as a measure ‖·‖ of an error that shrinks: d‖e‖/dt ≤ −rate ‖e‖ + ‖d‖ for e' = M̂ e + d."""

    degree: int  # of the proof: 2, or that of a polynomial that takes the place of a common P
    rate: float  # α in 1/s
    # every entry of the gain may differ from that printed by less than this share of it, and be another at every time:
    # the norm shrinks at this rate still. 0 for (17), which has no gain, and where nothing is proved of it, for a
    # polynomial.
    share: float
    gauge: Gauge  # the norms that ‖e‖ and ‖d‖ lie between, exact; of a quadratic form they are one
    from_norm: float  # |e| ≤ from_norm ‖e‖, with |e| in sizes; of the generator in the units given


@dataclass(frozen=True, kw_only=True)
class Guarantees:
    """What the proofs of a design promise; where there are several proofs, each promise is that of the best."""

    controller: tuple[Contraction, ...]  # the proofs of (8)
    observer: tuple[Contraction, ...]  # of (9)
    generator: tuple[Contraction, ...]  # of (17)
    output: tuple[float, ...]  # of the tracked rows c, |c e| ≤ output_c ‖e‖_c for each proof c of (8)
    drive: tuple[tuple[float, ...], ...]  # ‖B K Δ‖_c, or what stands for it, ≤ drive_co ‖Δ‖_o for c of (8), o of (9)
    loads: int = 0  # states of the observer that are those of loads, 0 in what is said over time

    def observer_error(self, t: Array, start: Array) -> Array:
        """Return a bound of |x̂ − x|, in sizes if there are several states, at times t (K,) from x̂(0) − x(0) (n,)."""
        start = np.pad(start, (0, self.loads))
        bounds = [o.from_norm * o.gauge.above(start) * np.exp(-o.rate * t) for o in self.observer]
        return np.asarray(np.min(bounds, axis=0) * OVER_POWERS)

    def tracking_error(self, t: Array, start: Array, observer_start: Array, *, output: bool) -> Array:
        """Return a bound of |x − x_d| or |y − y_d|, in sizes where there are several states or outputs, at the times t.

        ‖e(t)‖_c ≤ e^(−αt) ‖e(0)‖_c + drive ‖Δ(0)‖_o ∫ e^(−α(t−s)) e^(−βs) ds with the rates α of (8), β of (9), from
        x(0) − x_d(0) and x̂(0) − x(0), (n,) each.
        """
        bounds, observer_start = [], np.pad(observer_start, (0, self.loads))
        sizes = self.output if output else [c.from_norm for c in self.controller]
        for c, size, drives in zip(self.controller, sizes, self.drive, strict=True):
            own = c.gauge.above(start) * np.exp(-c.rate * t)
            for o, drive in zip(self.observer, drives, strict=True):
                bounds.append(size * (own + drive * o.gauge.above(observer_start) * _convolution(c.rate, o.rate, t)))
        return np.asarray(np.min(bounds, axis=0) * OVER_POWERS)

    def left(self, columns: Array, preview: NoncausalTrajectory) -> float:
        """Return a bound of ‖y − y_d‖ where η is off by what is played back, from error 0.

        Of e, 1 of each η makes `columns` in each cell, (l, n, p).
        """
        found = []
        for c, size in zip(self.controller, self.output, strict=True):
            each = np.array([[c.gauge.driven(column) for column in cell.T] for cell in columns])
            found.append(size * preview.measured(each, c.rate))
        return min(found) * OVER_POWERS

    @property
    def rate(self) -> float:
        """A rate in 1/s: from every start |y − y_d| and |x − x_d| are below c e^(−rate t), c from the start.

        It is that of the slower loop. Where both are the same, what is left of the strict inequalities makes up for
        the t in t e^(−rate t). For output tracking x_d itself comes from the generator: how fast that forgets
        its own start is the rate of (17).
        """
        return min(max(part.rate for part in loop) for loop in (self.controller, self.observer))

    @property
    def robust(self) -> tuple[float, float, float]:
        """A rate as `rate` that stays proved while every entry of K and of L changes by less than a share of itself.

        Returns:
            The rate in 1/s, the share of K's entries, that of L's. Nothing is said of a changed plant.
        """
        loops = [max(loop, key=lambda part: part.share) for loop in (self.controller, self.observer)]
        return min(part.rate for part in loops), loops[0].share, loops[1].share


def guarantees(plant: PWASystem, design: Gains, proofs: Sequence[AnyProof], sizes: Sizes, X: BallMatrix) -> Guarantees:
    """Read off the exact proofs what they promise; X is of the `Compensation`. All is rounded to the safe side."""
    exact, (K, L) = plant.exact, design.exact
    BK, q, A, seen = exact.B @ K, len(plant.tracked), [exact.A[i] for i in plant.hull], plant.observed
    drives = coupling(plant, K, L, X)
    parts: dict[str, list[Contraction]] = {"controller": [], "observer": [], "generator": []}
    for proof in proofs:
        gauge, share, n = Gauge.of(proof), 0.0, proof.order
        if isinstance(proof, Proof) and proof.role is CONTROLLER:
            share = largest_share([_slack(A_i + BK, proof) for A_i in A], exact.B, BallMatrix(proof.P), design.K)
        elif isinstance(proof, Proof) and proof.role is OBSERVER:
            slack = [_slack((A_i + L @ seen.C).transpose(), proof) for A_i in (seen.A[i] for i in plant.model.hull)]
            share = largest_share(slack, BallMatrix(proof.P), seen.C.transpose(), design.L)
        counted = np.append(sizes.state, sizes.load)[:n]  # the observer's errors are those of its loads too
        if len(sizes.state) == 1:  # a single state is counted in its unit
            counted = counted / counted[0]
        length = Norm.euclidean(n) if proof.role is GENERATOR else Norm.in_sizes(counted)
        from_norm = largest_gain(identity(n), gauge.below, length)
        parts[proof.role.name].append(
            Contraction(degree=proof.degree, rate=proof.rate, share=share, gauge=gauge, from_norm=from_norm)
        )
    controller, observer, generator = (tuple(part) for part in parts.values())
    length = Norm.in_sizes(sizes.tracked) if q > 1 else Norm.euclidean(q)
    return Guarantees(
        controller=controller,
        observer=observer,
        generator=generator,
        output=tuple(_size(exact.tracked, c.gauge.below, length) for c in controller),
        drive=tuple(tuple(_size(drives, o.gauge.below, c.gauge.driven) for o in observer) for c in controller),
        loads=seen.C.shape[1] - len(plant.B),
    )


def _slack(M: BallMatrix, proof: Proof) -> Rational:
    """Return −sym(M P) − 2 rate P, or what is below it for every M in the ball."""
    return left_side(M, proof) - scalar(2 * proof.rate) * proof.P


def _size(X: BallMatrix, of: Norm, to: Norm) -> float:
    """Return `largest_gain` of every X in the ball: its entries |E_jk| ≤ radius_jk add at most |E| in length."""
    gain = largest_gain(X.centre, of, to)
    if X.radius is None:
        return gain
    rows, n = X.shape
    away = float(np.linalg.norm(floats(X.radius)))
    lengths = largest_gain(identity(n), of, Norm.euclidean(n)) * largest_gain(identity(rows), Norm.euclidean(rows), to)
    return (gain + away * lengths) * OVER_POWERS


def _convolution(a: float, b: float, t: Array) -> Array:
    """Return ∫₀ᵗ e^(−a(t−s)) e^(−bs) ds = (e^(−at) − e^(−bt)) / (b − a), without cancellation where a is near b.

    Example:
        >>> float(_convolution(1.0, 1.0, np.array(1.0)) - np.exp(-1.0))
        0.0
    """
    apart = np.asarray(abs(b - a) * t)
    share = np.divide(-np.expm1(-apart), apart, out=np.ones_like(apart), where=apart > 0)
    return np.asarray(t * np.exp(-min(a, b) * t) * share)
