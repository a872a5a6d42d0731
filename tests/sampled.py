"""Gains for a program that predicts and corrects, and the program itself beside the plant, for tests of its proof."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from pwatrack import Spec
from pwatrack.arrays import Array
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import TubeBounds
from pwatrack.control.bounds import Channel
from pwatrack.control.controller import Asked, ProvedController
from pwatrack.control.sampled_disturbances import Acting, driven
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.lmi.clocked import ClockedProof
from pwatrack.lmi.clocked_tubes import Tube
from pwatrack.model.pwa import PWASystem
from pwatrack.workflow.pipeline import asked_of


def all_of_size_one(controller: ProvedController, _: object) -> Acting:
    """1 of each disturbance and of each noise acts, and nothing else."""
    plant = controller.plant
    found: dict[Channel, Array] = {("disturbance", k): np.ones(1) for k in range(len(plant.B))}
    found |= {("noise", k): np.ones(1) for k in range(len(plant.C))}
    H = plant.partition.H
    near, loads = np.zeros((1, len(H))), np.zeros(0 if plant.loads is None else len(plant.loads.S.floats))
    return Acting(squares=found, means={}, beside={}, planes=H, near=near, apart=near, changes=np.zeros(1), loads=loads)


def kalman(plant: PWASystem, h: float, *, q: float = 1.0, r: float = 1.0) -> Array:
    """Return M of the sampled Kalman filter of the mean cell: densities q of all states and r of all outputs."""
    A, C = np.mean([X.floats for X in plant.observed.A], axis=0), plant.observed.C.floats
    N = len(A)
    both = expm(np.block([[-A, q * np.eye(N)], [np.zeros((N, N)), A.T]]) * h)
    turned = both[N:, N:].T
    noise, R = turned @ both[:N, N:], r / h * np.eye(len(C))
    P = solve_discrete_are(turned.T, C.T, (noise + noise.T) / 2, R)
    return np.asarray(-P @ C.T @ np.linalg.inv(C @ P @ C.T + R)).round(6)


def regulator(plant: PWASystem, h: float, *, r: float = 1.0) -> Array:
    """Return K of the sampled regulator of the mean cell."""
    n, m = plant.B.shape
    whole = expm(np.block([[plant.A.mean(axis=0), plant.B], [np.zeros((m, n + m))]]) * h)
    A, B = whole[:n, :n], whole[:n, n:]
    P = solve_discrete_are(A, B, np.eye(n) * h, r * np.eye(m) * h)
    return np.asarray(-np.linalg.solve(r * h * np.eye(m) + B.T @ P @ B, B.T @ P @ A)).round(6)


def asking(spec: Spec, controller: ProvedController, gains: SampledGains) -> Asked:
    """Return what a spec asks, and the sampled loop with these gains."""
    return replace(asked_of(spec, None, controller), sampled=gains)


def tubes_alone(claim: TubeBounds) -> dict[Channel, tuple[Tube, ...]]:
    """Return the tubes of channels that have them alone."""
    return {channel: tubes for of, tubes in claim.tubes for channel in of if len(of) == 1}


def with_sampled(spec: Spec, controller: ProvedController, gains: SampledGains) -> ProvedController:
    """Return a controller with the claim of its sampled loop."""
    found = SampledLoop.prove(controller, asking(spec, controller, gains))
    return replace(controller, claims=(*controller.claims, *found))


def running(
    errors: SampledErrors, start: Array, estimate: Array, ticks: int, fine: int
) -> Iterator[tuple[int, int, Array]]:
    """Yield z of a loop whose reference rests at 0, in each substep many times, with the number of both.

    The plant is integrated by Runge and Kutta, for as long as ticks happen to be apart, and its prediction by
    exponentials in the cell of each substep's begin. Nothing is yielded while inputs act that were there before.

    Args:
        errors: What they are of; the plant rests at 0 without inputs and loads.
        start: x and s, (N,).
        estimate: x̂ and ŝ before the first tick.
        ticks: How many.
        fine: Steps in each substep.
    """
    plant, gains = errors.plant, errors.gains
    (n, m), r, late = plant.B.shape, errors.parts, gains.delay
    K, M, C, R = gains.K, gains.M, plant.observed.C.floats, errors.R.floats
    E = np.zeros((n, 0)) if plant.loads is None else plant.loads.E.floats
    U, random = np.linalg.pinv(plant.B) @ E, np.random.default_rng(7)
    step = gains.sample_time / r / fine
    x, s, waiting = start[:n], start[n:], [np.ones(m)] * late
    seen = [estimate] * errors.predicted  # from the last tick, from the one before …
    for tick in range(-late, ticks):
        now = seen[0] + M @ (C @ seen[0] - C[:, :n] @ x)
        seen, ahead = [now, *seen[:-1]], now
        for u in waiting:
            for _ in range(r):
                ahead = predicted(plant, ahead, u, step * fine)
        u, *waiting = [*waiting, K @ ahead[:n] - U @ ahead[n:]]
        pace = 1 + random.uniform(-1, 1) * gains.jitter / gains.sample_time
        for part in range(r):
            begin = seen
            for k in range(fine + 1):
                if k:
                    x = integrated(plant, x, plant.B @ u + E @ s, pace * step)
                seen = [predicted(plant, one, u, k * step) for one in begin]
                Delta, moved = np.hstack(seen) - np.tile(np.append(x, s), len(seen)), np.subtract(seen, begin)[:, :n]
                if tick >= 0:
                    nu = u + U @ (s if late else seen[0][n:])  # of loads what e' does not have
                    yield part, k, np.concatenate([x, nu, Delta, (moved @ R.T).ravel()])


def predicted(plant: PWASystem, seen: Array, u: Array, time: float) -> Array:
    """Return x̂ and ŝ some time later by the law of the cell of x̂."""
    (n, _), N = plant.B.shape, len(seen)
    i, F = plant.partition.locate(seen[:n]), np.zeros((N + 1, N + 1))
    F[:n, :n], F[:n, -1] = plant.A[i], plant.b[i] + plant.B @ u
    if plant.loads is not None:
        F[:n, n:-1], F[n:-1, n:-1] = plant.loads.E.floats, plant.loads.S.floats
    return np.asarray(expm(F * time) @ np.append(seen, 1.0))[:-1]


def integrated(plant: PWASystem, x: Array, push: Array, step: float) -> Array:
    """Return x one step later."""

    def rate(at: Array) -> Array:
        i = plant.partition.locate(at)
        return np.asarray(plant.A[i] @ at + plant.b[i] + push)

    one = rate(x)
    two = rate(x + step / 2 * one)
    three = rate(x + step / 2 * two)
    four = rate(x + step * three)
    return np.asarray(x + step / 6 * (one + 2 * two + 2 * three + four))


def form_at(proof: ClockedProof, parts: int, part: int, share: float) -> Array:
    """Return P(τ) after a share of a part of the period."""
    P = np.array([P_k.P.tolist() for P_k in proof.P], dtype=float)
    size = len(P) // parts
    place = share * (size - 1)
    k = min(int(place), size - 2)
    one, other = P[part * size + k], P[part * size + k + 1]
    return np.asarray(one + (place - k) * (other - one))


def worst_found(claim: TubeBounds, channel: Channel, c: Array, seed: int, *, summed: bool = False) -> float:
    """Return |c z| for a switching at random with what acts at its worst: known from what each stretch adds to c z.

    What is summed acts in one stretch, in which its integral is 1, or at one tick.
    """
    errors, random = claim.errors, np.random.default_rng(seed)
    system, drive = errors.clocked, driven(errors, channel)
    F = np.array([X.floats for X in system.vertices])
    parts, fine, n = system.parts, 4, F.shape[1]
    R = np.eye(n) if system.between is None else system.between.floats
    dt = float(system.period) / parts / fine
    held, between = drive.held.floats, drive.between.floats
    mean = random.dirichlet(np.full(len(system.J), 0.1)) if len(system.J) > 1 else np.ones(1)
    J = np.tensordot(mean, np.array([X.floats for X in system.J]), 1)
    kick = None if drive.ticks is None else np.tensordot(mean, np.array([X.floats for X in drive.ticks]), 1)
    shares = random.dirichlet(np.full(len(F), 0.1), size=parts * fine)
    stretches = list[tuple[Array, Array]]()  # of a period, what each turns z by and adds to it
    for A in np.tensordot(shares, F, 1):
        whole = expm(np.block([[A, A @ held + between], [np.zeros((1, n + 1))]]) * dt)
        stretches.append((whole[:n, :n], whole[:n, n]))
    last, total, most = c[0].copy(), 0.0, 0.0
    for _ in range(150):  # periods, backwards from the end
        for k in reversed(range(parts * fine)):
            turn, added = stretches[k]
            size = abs(float(last @ added))
            total, most = total + size, max(most, size / dt)
            last = last @ turn
            if k % fine == 0 and k:
                last = last @ R
        size = 0.0 if kick is None else abs(float(last @ kick[:, 0]))
        total, most = total + size, max(most, size)
        last = last @ J
    return most if summed else total
