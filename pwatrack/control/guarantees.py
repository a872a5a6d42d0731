"""What the proofs promise: how fast errors go to 0, how large they get on the way, what disturbances can do.

The field is continuous and linear in each cell, so f(x̂) − f(x) = Â (x̂ − x) with Â in the convex hull of the A_i.
With a disturbance w added to ẋ and noise v added to y, (1), (18) and (19) therefore give for Δ = x̂ − x and e = x − x_d

    Δ' = (Â + L C) Δ − w − L v,        e' = (Â + B K) e + B K Δ + w,

whatever the switching. A proof is a norm with d‖Δ‖/dt ≤ −α ‖Δ‖ + ‖w + L v‖; likewise for e. Everything here follows
from these two lines, as in the proof of Theorem 2. (x_d is the one that the generator (15) makes: there C x_d = y_d.)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import exprel

from pwatrack.arrays import Array
from pwatrack.control.synthesis import Design
from pwatrack.lmi.exact import Proof
from pwatrack.lmi.norm import Norm, largest_gain
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import decimals, identity

_ABOVE = 1 + 1e-9  # more than the rounding of the few operations and exponentials of a bound


@dataclass(frozen=True, kw_only=True)
class Contraction:
    """One proof, read as a norm in which an error shrinks: d‖e‖/dt ≤ −rate ‖e‖ + ‖d‖ for e' = M̂ e + d.

    Attributes:
        rate: α in 1/s.
        radius: Closed-loop matrices that differ by less than this, in the spectral norm, are covered too.
        norm: ‖·‖, exact.
        to_norm, from_norm: ‖e‖ ≤ to_norm |e| and |e| ≤ from_norm ‖e‖, with |e| in the units given.
    """

    rate: float
    radius: float
    norm: Norm
    to_norm: float
    from_norm: float

    @property
    def overshoot(self) -> float:
        """√(λmax(P) / λmin(P)), rounded up: |e(t)| ≤ overshoot e^(−rate t) |e(0)|."""
        return self.to_norm * self.from_norm * _ABOVE


@dataclass(frozen=True, kw_only=True)
class Gains:
    """The most that an error can be in the long run, per size of what causes it; from error 0 it holds at all times.

    Sizes are the largest |w(t)| and |v(t)|. States in their units: the gains of w are in s, those of v in units of
    the states per unit of the outputs.

    Attributes:
        disturbance_to_observer: |x̂ − x| per |w|, w added to ẋ.
        noise_to_observer: |x̂ − x| per |v|, v added to the measured y.
        disturbance_to_tracking: |x − x_d| per |w|.
        noise_to_tracking: |x − x_d| per |v|.
    """

    disturbance_to_observer: float
    noise_to_observer: float
    disturbance_to_tracking: float
    noise_to_tracking: float


@dataclass(frozen=True, kw_only=True)
class Guarantees:
    """What the proofs of a design promise; where there are several proofs, each promise is that of the best.

    Attributes:
        controller, observer, generator: The proofs of (8), (9) and (17) as contractions.
        output: |C e| ≤ output_c ‖e‖_c for each proof c of (8).
        drive: ‖B K Δ‖_c ≤ drive_co ‖Δ‖_o for each proof c of (8) and o of (9).
        noise: ‖L v‖_o ≤ noise_o |v| for each proof o of (9).
    """

    controller: tuple[Contraction, ...]
    observer: tuple[Contraction, ...]
    generator: tuple[Contraction, ...]
    output: tuple[float, ...]
    drive: tuple[tuple[float, ...], ...]
    noise: tuple[float, ...]

    def observer_error(self, t: Array, start: Array) -> Array:
        """Return a bound of |x̂ − x| at the times t.

        Args:
            t: Times in s, (K,).
            start: x̂(0) − x(0), (n,).
        """
        bounds = [o.from_norm * o.norm(start) * np.exp(-o.rate * t) for o in self.observer]
        return np.asarray(np.min(bounds, axis=0) * _ABOVE)

    def tracking_error(self, t: Array, start: Array, observer_start: Array, *, output: bool) -> Array:
        """Return a bound of |x − x_d|, or of |y − y_d|, at the times t.

        ‖e(t)‖_c ≤ e^(−αt) ‖e(0)‖_c + drive ‖Δ(0)‖_o ∫ e^(−α(t−s)) e^(−βs) ds with the rates α of (8), β of (9).

        Args:
            t: Times in s, (K,).
            start: x(0) − x_d(0), (n,).
            observer_start: x̂(0) − x(0), (n,).
            output: Whether to bound y − y_d.
        """
        bounds = []
        for c, size, drives in zip(self.controller, self._sizes(output), self.drive, strict=True):
            own = c.norm(start) * np.exp(-c.rate * t)
            for o, drive in zip(self.observer, drives, strict=True):
                bounds.append(size * (own + drive * o.norm(observer_start) * _convolution(c.rate, o.rate, t)))
        return np.asarray(np.min(bounds, axis=0) * _ABOVE)

    @property
    def gains(self) -> Gains:
        """The input-to-state gains: ‖Δ‖_o ends below sup ‖w + L v‖_o / β, and ‖e‖_c below sup ‖B K Δ + w‖_c / α."""
        observer, tracking = [], []
        for j, (o, noise) in enumerate(zip(self.observer, self.noise, strict=True)):
            ends = np.array([o.to_norm, noise]) / o.rate  # of ‖Δ‖_o, per |w| and per |v|
            observer.append(o.from_norm * ends)
            for c, drives in zip(self.controller, self.drive, strict=True):
                tracking.append(c.from_norm * (drives[j] * ends + np.array([c.to_norm, 0.0])) / c.rate)
        (w_observer, v_observer), (w_tracking, v_tracking) = (
            (np.min(g, axis=0) * _ABOVE).tolist() for g in (observer, tracking)
        )
        return Gains(
            disturbance_to_observer=w_observer,
            noise_to_observer=v_observer,
            disturbance_to_tracking=w_tracking,
            noise_to_tracking=v_tracking,
        )

    @property
    def rate(self) -> float:
        """The rate in 1/s at which every solution approaches the desired one: that of the slower loop."""
        return min(max(part.rate for part in loop) for loop in (self.controller, self.observer))

    @property
    def robust(self) -> tuple[float, float]:
        """A rate (1/s) with the radius (1/s) of changes to A_i + B K and to A_i + L C that leave it proved.

        Changed gains are such changes, and so is a plant whose observer knows the change. A change E of the plant
        that the observer does not know is a disturbance w = E x: see `gains`.
        """
        loops = [max(loop, key=lambda part: part.radius) for loop in (self.controller, self.observer)]
        return min(part.rate for part in loops), min(part.radius for part in loops)

    def _sizes(self, output: bool) -> tuple[float, ...]:
        return self.output if output else tuple(c.from_norm for c in self.controller)


def guarantees(plant: PWASystem, design: Design, proofs: Sequence[Proof]) -> Guarantees:
    """Read off the exact proofs what they promise. Every number is rounded to the safe side.

    Args:
        plant: The system (1).
        design: Its gains K and L.
        proofs: What `prove_design` returned for them.

    Example: the paper's example. After t seconds the observer error is at most 1.42 e^(−0.0681 t) of its first size.

        >>> from pwatrack import design, load_spec
        >>> controller = design(load_spec("specs/two_mass_paper_gains.yaml"))
        >>> best, second = controller.guarantees.observer
        >>> round(second.overshoot, 2), round(second.rate, 4), round(best.rate, 3), best.overshoot > second.overshoot
        (1.42, 0.0681, 0.084, True)
    """
    parts: dict[str, list[Contraction]] = {"controller": [], "observer": [], "generator": []}
    for proof in proofs:
        n = len(proof.exponents)
        eye, norm, length = identity(n), Norm.of(proof), Norm.euclidean(n)
        parts[proof.of].append(
            Contraction(
                rate=proof.rate,
                radius=proof.radius,
                norm=norm,
                to_norm=largest_gain(eye, length, norm),
                from_norm=largest_gain(eye, norm, length),
            )
        )
    controller, observer, generator = (tuple(part) for part in parts.values())
    B, C, K, L = (decimals(X) for X in (plant.B, plant.C, design.K, design.L))
    BK, q = B * K, len(plant.C)
    return Guarantees(
        controller=controller,
        observer=observer,
        generator=generator,
        output=tuple(largest_gain(C, c.norm, Norm.euclidean(q)) for c in controller),
        drive=tuple(tuple(largest_gain(BK, o.norm, c.norm) for o in observer) for c in controller),
        noise=tuple(largest_gain(L, Norm.euclidean(q), o.norm) for o in observer),
    )


def _convolution(a: float, b: float, t: Array) -> Array:
    """Return ∫₀ᵗ e^(−a(t−s)) e^(−bs) ds = (e^(−at) − e^(−bt)) / (b − a), without cancellation where a is near b.

    Example:
        >>> float(_convolution(1.0, 1.0, np.array(1.0)) - np.exp(-1.0))
        0.0
    """
    return np.asarray(t * np.exp(-min(a, b) * t) * exprel(-abs(b - a) * t))
