"""Closed loops of random plants, and what their proofs promise, worked out a second time in plain floating point."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import sqrtm

from pwatrack import Controller, PWASystem
from pwatrack.arrays import Array
from pwatrack.control.generator import trajectory_generator
from pwatrack.control.goal import Goal
from pwatrack.control.proof import prove_design
from pwatrack.control.synthesis import synthesize
from pwatrack.control.trajectory import output_trajectory
from pwatrack.lmi.exact import Proof
from pwatrack.model.normal_form import normal_form
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.simulation.closed_loop import ClosedLoop, Response, closed_loop
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.spec.expression import formula
from tests.plants import random_plant

FLOOR = 1e-12  # of the largest state: rounding of a simulation


def track(plant: PWASystem, y_d: str, K: Array | None = None, L: Array | None = None) -> ClosedLoop:
    generator = trajectory_generator(normal_form(plant))
    trajectory = output_trajectory(generator, exosystem([Signal.of(formula(y_d, {}))]))
    gains = synthesize(plant, controller=Goal(given=K), observer=Goal(given=None if L is None else L.T))
    proofs = prove_design(plant, gains, generator)
    return closed_loop(Controller(plant=plant, design=gains, trajectory=trajectory, generator=generator, proofs=proofs))


def run(loop: ClosedLoop, x0: Array, duration: float, sample_time: float) -> Response:
    n, p = len(x0), loop.controller.trajectory.rate.shape[1]
    start = loop.start(plant=x0, observer=np.zeros(n), generator=np.zeros(p))
    return loop.response(simulate_flow(loop.flow, start, duration=duration, sample_time=sample_time))


def proofs_of(loop: ClosedLoop, of: str) -> list[Proof]:
    return [proof for proof in loop.controller.proofs if proof.of == of]


def root_of_norm(proof: Proof) -> Array:
    """R with ‖e‖ = |R e| the norm of a proof: √(eᵀ P⁻¹ e) for (8), √(eᵀ P e) for (9)."""
    e = np.array(proof.exponents, dtype=float)
    P = np.array(proof.integers, dtype=float) * 2.0 ** (e[:, None] + e)
    root: Array = np.real(sqrtm(P))
    return np.asarray(np.linalg.inv(root) if proof.of == "controller" else root)


class Bound:
    """|S (x − x_d)| from one proof of (8) and one of (9): the observer error drives the tracking error, both contract.

    With ‖e‖_c = √(eᵀ P_c⁻¹ e) and ‖ẽ‖_o = √(ẽᵀ P_o ẽ):  d‖ẽ‖_o/dt ≤ −α_o ‖ẽ‖_o and
    d‖e‖_c/dt ≤ −α_c ‖e‖_c + κ ‖ẽ‖_o, whatever the switching.
    """

    def __init__(self, loop: ClosedLoop, S: Array, c: Proof, o: Proof, e0: Array, e_hat0: Array) -> None:
        root_c, root_o = root_of_norm(c), root_of_norm(o)
        BK = loop.controller.plant.B @ loop.controller.design.K
        self.kappa = float(np.linalg.norm(root_c @ BK @ np.linalg.inv(root_o), 2))
        self.output = float(np.linalg.norm(S @ np.linalg.inv(root_c), 2))
        self.e0, self.e_hat0 = float(np.linalg.norm(root_c @ e0)), float(np.linalg.norm(root_o @ e_hat0))
        self.rates = c.rate, o.rate

    def __call__(self, t: Array) -> Array:
        slow, fast = min(self.rates), max(self.rates)
        gap = max(fast - slow, 1e-9 * slow)
        driven = np.exp(-slow * t) * -np.expm1(-gap * t) / gap
        result: Array = self.output * (np.exp(-self.rates[0] * t) * self.e0 + self.kappa * driven * self.e_hat0)
        return result


def gains_again(loop: ClosedLoop) -> list[float]:
    """The four input-to-state gains in the order of `Gains`: d‖·‖/dt ≤ −α ‖·‖ + ‖input‖ is at rest at ‖input‖ / α."""
    plant, design = loop.controller.plant, loop.controller.design

    def size(X: Array) -> float:
        return float(np.linalg.norm(X, 2))

    found = []
    for o in proofs_of(loop, "observer"):
        R = root_of_norm(o)
        rest = [size(R) / o.rate, size(R @ design.L) / o.rate]
        for c in proofs_of(loop, "controller"):
            R_c = root_of_norm(c)
            kappa, back = (
                size(R_c @ plant.B @ design.K @ np.linalg.inv(R)),
                size(np.asarray(np.linalg.inv(R_c), dtype=float)),
            )
            tracking = [back * (kappa * rest[0] + size(R_c)) / c.rate, back * kappa * rest[1] / c.rate]
            found.append([size(np.asarray(np.linalg.inv(R), dtype=float)) * r for r in rest] + tracking)
    return [float(v) for v in np.min(found, axis=0)]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Of one simulation: the largest error as a part of its bound, and the bounds as parts of the second opinion.

    Attributes:
        output, state, observer: |y − y_d|, |x − x_d| and |x̂ − x| over their bounds; the largest of all samples.
        later: The same for bounds that start in the middle of the simulation.
        decay: The fastest certified decay of ‖x̂ − x‖_o over a sample, over the one seen; above 1 it is slower.
        opinions: Our bound over `Bound`, smallest and largest.
    """

    output: float
    state: float
    observer: float
    later: float
    decay: float
    opinions: tuple[float, float]


def random_loop(seed: int) -> tuple[ClosedLoop, Array]:
    """A loop with n ≤ 8, r = 1 … 4, up to 16 cells, and x(0)."""
    random = np.random.default_rng(1000 + seed)
    r = 1 + seed % 4
    n = int(random.integers(r, 9))
    k = int(random.integers(1, 5))
    loop = track(random_plant(seed, n=n, k=k, r=r, strength=0.05), "0.2 + sin(2*t) + 0.5*cos(3*t)")
    return loop, random.normal(size=n)


def judge(loop: ClosedLoop, response: Response) -> Verdict:
    """Hold every sample of a simulation against what the proofs promise."""
    promised, t = loop.controller.guarantees, response.t
    e, delta = response.x - response.x_d, response.x_hat - response.x
    y, output = (response.y - response.y_d), loop.controller.generator is not None
    floor = FLOOR * max(1.0, float(np.abs(response.x).max()))

    def part(error: Array, bound: Array) -> float:
        return float((np.linalg.norm(error, axis=1) / (bound + floor)).max())

    half = len(t) // 2
    rest = t[half:] - t[half]
    seen = []
    for proof in proofs_of(loop, "observer"):
        size = np.linalg.norm(delta @ root_of_norm(proof).T, axis=1)
        big = size[:-1] > 1e3 * floor * np.linalg.norm(root_of_norm(proof), 2)
        seen.append((size[1:][big] / size[:-1][big] * np.exp(proof.rate * np.diff(t)[big])).max(initial=0.0))
    opinion = [
        np.min(
            [
                Bound(loop, S, c, o, e[0], delta[0])(t)
                for c in proofs_of(loop, "controller")
                for o in proofs_of(loop, "observer")
            ],
            axis=0,
        )
        for S in (np.eye(e.shape[1]), loop.controller.plant.C)
    ]
    ours = [promised.tracking_error(t, e[0], delta[0], output=which) for which in (False, True)]
    ratio = np.concatenate([a / b for a, b in zip(ours, opinion, strict=True)])
    return Verdict(
        output=part(y, ours[1]) if output else 0.0,
        state=part(e, ours[0]),
        observer=part(delta, promised.observer_error(t, delta[0])),
        later=max(
            part(e[half:], promised.tracking_error(rest, e[half], delta[half], output=False)),
            part(delta[half:], promised.observer_error(rest, delta[half])),
        ),
        decay=float(max(seen)),
        opinions=(float(ratio.min()), float(ratio.max())),
    )


def disturbed(loop: ClosedLoop, w_size: float, v_size: float, duration: float, step: float) -> tuple[Array, Array]:
    """Return |x̂ − x| and |x − x_d| from error 0 under the w and v that raise the observer error fastest.

    (1), (18), (19) are integrated by the classical Runge-Kutta method on x and x̂; x_d and u_ff are those of the loop.
    """
    plant, design = loop.controller.plant, loop.controller.design
    n = plant.A.shape[1]
    weights = 1 << np.arange(len(plant.partition.h))
    cell = {tuple(row): i for i, row in enumerate(plant.partition.signs > 0)}
    assert len(cell) == 1 << len(weights)
    root = root_of_norm(proofs_of(loop, "observer")[-1])
    Q = root.T @ root

    def field(x: Array) -> Array:
        i = cell[tuple(plant.partition.H @ x + plant.partition.h > 0)]
        result: Array = plant.A[i] @ x + plant.b[i]
        return result

    desired = run(loop, np.zeros(n), duration, step / 2)
    x_d, u_ff = desired.x_d, desired.u_ff
    z = np.concatenate([x_d[0], x_d[0]])
    observer, tracking = [], []
    for k in range((len(x_d) - 1) // 2):
        x, x_hat = z[:n], z[n:]
        pull = Q @ (x_hat - x) if k else np.ones(n)
        w = -w_size * pull / max(float(np.linalg.norm(pull)), 1e-300)
        at_y = design.L.T @ pull
        v = -v_size * at_y / max(float(np.linalg.norm(at_y)), 1e-300)

        def rate(z: Array, m: int, w: Array = w, v: Array = v) -> Array:
            x, x_hat = z[:n], z[n:]
            Bu = plant.B @ (design.K @ (x_hat - x_d[m]) + u_ff[m])
            correction = design.L @ (plant.C @ x_hat - (plant.C @ x + v))
            return np.concatenate([field(x) + Bu + w, field(x_hat) + Bu + correction])

        k1 = rate(z, 2 * k)
        k2 = rate(z + step / 2 * k1, 2 * k + 1)
        k3 = rate(z + step / 2 * k2, 2 * k + 1)
        z = z + step / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + step * k3, 2 * k + 2))
        observer.append(float(np.linalg.norm(z[n:] - z[:n])))
        tracking.append(float(np.linalg.norm(z[:n] - x_d[2 * k + 2])))
    return np.array(observer), np.array(tracking)
