"""Closed loops of random plants, and what their proofs promise, worked out a second time in plain floating point."""

from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeVar

import numpy as np
from scipy.linalg import expm, sqrtm

from pwatrack.arrays import Array, IntArray
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.bounds import SignalBounds, loops_of
from pwatrack.claims.robust import Robust, prove_box
from pwatrack.control.bounds import Bounds, Form
from pwatrack.control.controller import Claim, ProvedController
from pwatrack.control.generator import trajectory_generator
from pwatrack.control.goal import DEFAULT, Given
from pwatrack.control.proof import prove_design
from pwatrack.control.synthesis import synthesize
from pwatrack.control.trajectory import output_trajectory
from pwatrack.errors import Infeasible, Undecided
from pwatrack.lmi.exact import Proof
from pwatrack.model.normal_form import normal_form
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.model.sizes import Sizes
from pwatrack.simulation.closed_loop import ClosedLoop, Response, closed_loop
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.spec.expression import formula
from tests.plants import random_plant

Made = TypeVar("Made", bound=ProvedController)

FLOOR = 1e-12  # of the largest state: rounding of a simulation


def track(plant: PWASystem, y_d: str, K: Array | None = None, L: Array | None = None) -> ClosedLoop:
    generator = trajectory_generator(normal_form(plant))
    trajectory = output_trajectory(generator, exosystem([Signal.of(formula(y_d, {}))]))
    goals = [DEFAULT if X is None else Given(gain=X) for X in (K, L)]
    gains = synthesize(plant, controller=goals[0], observer=goals[1])
    proofs = prove_design(plant, gains, generator)
    controller = ProvedController(
        plant=plant,
        running=plant,
        design=gains,
        trajectory=trajectory,
        proofs=proofs,
        sizes=Sizes.of(plant),
    )
    return closed_loop(replace(controller, claims=(SignalBounds(loops=loops_of(controller)),)))


def with_claim(controller: Made, claim: Claim) -> Made:
    """Return a controller with a claim in place of the one of its kind."""
    claims = tuple(claim if type(one) is type(claim) else one for one in controller.claims)
    return replace(controller, claims=claims)


def follow(plant: PWASystem, seed: int) -> float:
    """Design, run from a random start until the proofs promise errors of 1e-10 or so, and return the last error."""
    response = followed(plant, seed)[1]
    return float(np.abs(response.tracking_error[-10:]).max())


def followed(plant: PWASystem, seed: int, duration: float | None = None) -> tuple[ClosedLoop, Response]:
    """Return the loop with which each output of a plant follows sines, and its run from a random start."""
    form = normal_form(plant)
    generator = trajectory_generator(form)
    waves = [f"0.1 + sin({1 + 0.3 * j}*t + {j}) + 0.3*sin(2.5*t)" for j in range(len(plant.tracked))]
    trajectory = output_trajectory(generator, exosystem([Signal.of(formula(wave, {})) for wave in waves]))
    gains, sizes = synthesize(form.plant), Sizes.of(form.plant)
    proofs = prove_design(form.plant, gains, generator)
    loop = closed_loop(
        ProvedController(
            plant=form.plant,
            running=form.plant,
            design=gains,
            trajectory=trajectory,
            proofs=proofs,
            sizes=sizes,
        )
    )
    duration = duration or 26 / loop.controller.guarantees.rate
    return loop, run(loop, np.random.default_rng(seed).normal(size=len(plant.B)), duration, duration / 300)


def run(loop: ClosedLoop, x0: Array, duration: float, sample_time: float) -> Response:
    n, p = len(x0), loop.controller.trajectory.rate.shape[1]
    start = loop.start(plant=x0, observer=np.zeros(n), generator=np.zeros(p))
    return loop.response(simulate_flow(loop.flow, start, duration=duration, sample_time=sample_time))


def proofs_of(loop: ClosedLoop, of: str) -> list[Proof]:
    return [proof for proof in loop.controller.proofs if proof.role.name == of and isinstance(proof, Proof)]


def root_of_norm(proof: Proof) -> Array:
    """R with ‖e‖ = |R e| the norm of a proof: √(eᵀ P⁻¹ e) for (8), √(eᵀ P e) for (9)."""
    e = np.array(proof.exponents, dtype=float)
    P = np.array(proof.integers, dtype=float) * 2.0 ** (e[:, None] + e)
    root: Array = np.real(sqrtm(P))
    return np.asarray(np.linalg.inv(root) if proof.role.name == "controller" else root)


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


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Of one simulation: the largest error as a part of its bound, and the bounds as parts of the second opinion.

    Attributes:
        output, state, observer: |y − y_d|, and in sizes |x − x_d| and |x̂ − x|, over their bounds; the worst of all.
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
    sizes = loop.controller.sizes.state if e.shape[1] > 1 else np.ones(1)
    tracked = loop.controller.plant.tracked
    counted = loop.controller.sizes.tracked if len(tracked) > 1 else np.ones(1)
    floor = FLOOR * max(1.0, float(np.abs(response.x).max()), float(np.abs(response.x / sizes).max()))

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
        for S in (np.diag(1 / sizes), tracked / counted[:, None])
    ]
    ours = [promised.tracking_error(t, e[0], delta[0], output=which) for which in (False, True)]
    ratio = np.concatenate([a / b for a, b in zip(ours, opinion, strict=True)])
    return Verdict(
        output=part(y, ours[1]) if output else 0.0,
        state=part(e / sizes, ours[0]),
        observer=part(delta / sizes, promised.observer_error(t, delta[0])),
        later=max(
            part(e[half:] / sizes, promised.tracking_error(rest, e[half], delta[half], output=False)),
            part(delta[half:] / sizes, promised.observer_error(rest, delta[half])),
        ),
        decay=float(max(seen)),
        opinions=(float(ratio.min()), float(ratio.max())),
    )


def joint_system(controller: ProvedController, bounds: Bounds) -> tuple[Array, Array, dict[Form, Array]]:
    """M_ij of (e, Δ) for all pairs of cells, g of a channel or z(0), and the row of each signal that is bounded."""
    plant, K, L = controller.plant, controller.design.K, controller.design.L
    n = len(plant.B)
    M = np.array(
        [
            np.block([[A_i + plant.B @ K, plant.B @ K], [np.zeros((n, n)), A_j + L @ plant.C]])
            for A_i in plant.A
            for A_j in plant.A
        ]
    )
    kind, k = bounds.channel
    eye, nothing = np.eye(n), np.zeros(n)
    g = np.concatenate([eye[k], -eye[k]] if kind == "disturbance" else [nothing, -L[:, k % L.shape[1]]])
    g = np.eye(2 * n)[k] if kind == "start" else g
    halves = {"output": (plant.C, 0 * plant.C), "state": (eye, 0 * eye), "input": (K, K), "estimate": (0 * eye, eye)}
    return M, g, {signal: np.concatenate([X[signal[1]] for X in halves[signal[0]]]) for signal in bounds.sizes}


def worst(M: Array, g: Array, c: Array, *, duration: float, steps: int = 300, rounds: int = 8) -> float:
    """The largest |c z| at the end that is found for z' = M_p(t) z + g d from z = 0, |d| ≤ 1: a lower bound of all.

    By sweeps as in Pontryagin's principle: with p' = −Mᵀ p from p = c at the end, d = sign pᵀg, and in each step
    the M_p for which pᵀz is largest after it. Both are constant in each step, so the result is exact up to rounding.
    """
    h, N, distinct = duration / steps, len(g), np.unique(M, axis=0)
    flow = expm(
        h
        * np.concatenate(
            [
                np.concatenate([distinct, np.tile(g[:, None], (len(distinct), 1, 1))], axis=2),
                np.zeros((len(distinct), 1, N + 1)),
            ],
            axis=1,
        )
    )
    E, push = flow[:, :N, :N], flow[:, :N, N]

    def costate(cells: Array) -> tuple[Array, float]:
        p = np.empty((steps + 1, N))
        p[-1] = c
        for k in range(steps - 1, -1, -1):
            p[k] = E[cells[k]].T @ p[k + 1]
        return p, float(np.abs((p[1:] * push[cells]).sum(axis=1)).sum())

    best = 0.0
    for first in range(len(distinct)):
        cells = np.full(steps, first)
        p, value = costate(cells)
        for _ in range(rounds):
            d = np.sign((p[1:] * push[cells]).sum(axis=1))
            z, following = np.zeros(N), cells.copy()
            for k in range(steps):
                after = E @ z + push * d[k]
                following[k] = np.argmax(after @ p[k + 1])
                z = after[following[k]]
            next_p, next_value = costate(following)
            if next_value <= value * (1 + 1e-3):
                break
            cells, p, value = following, next_p, next_value
        best = max(best, value)
    return best


def worst_from(M: Array, g: Array, c: Array, *, duration: float, steps: int = 120, rounds: int = 4) -> float:
    """The largest |c z(t)| that is found for z' = M_p(t) z from z(0) = g, at any time: a lower bound of all.

    By the same sweeps as `worst`, for ends at times that grow geometrically.
    """
    distinct = np.unique(M, axis=0)
    E, best = expm(duration / steps * distinct), 0.0

    def costate(cells: IntArray) -> Array:
        p = np.empty((len(cells) + 1, len(c)))
        p[-1] = c
        for k in range(len(cells) - 1, -1, -1):
            p[k] = E[cells[k]].T @ p[k + 1]
        return p

    for first, end in product(range(len(distinct)), dict.fromkeys(np.geomspace(1, steps, 16).astype(int).tolist())):
        cells, value = np.full(end, first), 0.0
        for _ in range(rounds):
            p = costate(cells)
            reached = abs(float(p[0] @ g))
            if reached <= value * (1 + 1e-3):
                break
            value, z = reached, g * np.sign(p[0] @ g)
            for k in range(end):
                after = E @ z
                cells[k] = np.argmax(after @ p[k + 1])
                z = after[cells[k]]
        best = max(best, value)
    return max(best, abs(float(c @ g)))


def random_design(seed: int) -> ClosedLoop:
    """A loop with n = 2 … 4, r = 1 or 2 and, in turn, one cell, two or four, that differ as much as can be had."""
    cells = seed % 3
    for strength in (1.0, 0.5, 0.2, 0.1) if cells else (0.0,):
        plant = random_plant(seed, n=2 + seed // 3 % 3, k=max(cells, 1), r=1 + seed // 9 % 2, strength=strength)
        with suppress(Infeasible, Undecided):
            return track(plant, "sin(2*t)")
    raise AssertionError(f"there is no design for plant {seed}")


def random_box(loop: ClosedLoop, seed: int, share: float = 0.03) -> Robust | None:
    """What is proved of four plants whose A differs from that of the design in one entry each, and of their means."""
    random, plant = np.random.default_rng(seed), loop.controller.plant
    exact, n = plant.exact, len(plant.B)
    moved = []
    for j, k in random.integers(0, n, size=(2, 2)).tolist():
        change = np.zeros((n, n))
        change[j, k] = share * float(np.abs(plant.A[0]).max()) * random.uniform(0.3, 1)
        moved.append(BallMatrix.of(change))
    both = [(tuple(A_i + d for A_i in exact.A), tuple(A_i - d for A_i in exact.A)) for d in moved]
    corners = [replace(exact, A=A) for pair in both for A in pair]
    try:
        return prove_box(loop.controller, corners)
    except Undecided:
        return None


def box_system(loop: ClosedLoop, robust: Robust) -> Array:
    """M of (e, Δ) for all corners and pairs of cells, worked out in plain floating point."""
    plant, K, L = loop.controller.plant, loop.controller.design.K, loop.controller.design.L
    found = []
    for corner in robust.corners:
        B = corner.B.floats
        off = (plant.B - B) @ K
        for A_c, A_i in zip([X.floats for X in corner.A], plant.A, strict=True):
            found += [np.block([[A_c + B @ K, B @ K], [A_i - A_c + off, A_j + L @ plant.C + off]]) for A_j in plant.A]
    return np.array(found)


def disturbed(loop: ClosedLoop, bounds: Bounds, duration: float, step: float) -> dict[Form, float]:
    """The largest size of each signal from error 0 under a d that pushes the observer error outwards, |d| ≤ 1.

    (1), (18), (19) are integrated by the classical Runge-Kutta method on x and x̂; x_d and u_ff are those of the loop.
    """
    plant, design = loop.controller.plant, loop.controller.design
    n = plant.A.shape[1]
    weights = 1 << np.arange(len(plant.partition.h))
    cell = {tuple(row): i for i, row in enumerate(plant.partition.signs > 0)}
    assert len(cell) == 1 << len(weights)
    root = root_of_norm(proofs_of(loop, "observer")[-1])
    Q = root.T @ root
    kind, j = bounds.channel
    _, _, rows = joint_system(loop.controller, bounds)
    w = np.eye(n)[j] if kind == "disturbance" else np.zeros(n)
    v = np.eye(len(plant.C))[j] if kind == "noise" else np.zeros(len(plant.C))
    out = -w - design.L @ v

    def field(x: Array) -> Array:
        i = cell[tuple(plant.partition.H @ x + plant.partition.h > 0)]
        result: Array = plant.A[i] @ x + plant.b[i]
        return result

    desired = run(loop, np.zeros(n), duration, step / 2)
    x_d, u_ff = desired.x_d, desired.u_ff
    z = np.concatenate([x_d[0], x_d[0]])
    largest = dict.fromkeys(rows, 0.0)
    for k in range((len(x_d) - 1) // 2):
        d = 1.0 if float((z[n:] - z[:n]) @ Q @ out) >= 0 else -1.0

        def rate(z: Array, m: int, d: float = d) -> Array:
            x, x_hat = z[:n], z[n:]
            Bu = plant.B @ (design.K @ (x_hat - x_d[m]) + u_ff[m])
            correction = design.L @ (plant.C @ x_hat - (plant.C @ x + d * v))
            return np.concatenate([field(x) + Bu + d * w, field(x_hat) + Bu + correction])

        k1 = rate(z, 2 * k)
        k2 = rate(z + step / 2 * k1, 2 * k + 1)
        k3 = rate(z + step / 2 * k2, 2 * k + 1)
        z = z + step / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + step * k3, 2 * k + 2))
        errors = np.concatenate([z[:n] - x_d[2 * k + 2], z[n:] - z[:n]])
        largest = {signal: max(size, abs(float(rows[signal] @ errors))) for signal, size in largest.items()}
    return largest
