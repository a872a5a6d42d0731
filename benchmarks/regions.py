"""Regions of starts with inputs at their limits: how much of what runs show is proved, and whether any start leaves.

    python -m benchmarks.regions [--plants 50] [--starts 100000]

Random plants of two states with one unstable mode, one input that is limited and the gain of a regulator, two cells.
The proved region, and the proved ellipse, are set against the largest ellipse inside the simulated region, and against
that region itself: from its points the errors go to 0 in some orders of the cells: each by itself, at random, and those
that make a form large.
Then (e, Δ) from the edge of proved regions, and the errors of sampled loops of the gallery: cells at random, and those
that make the form largest.
"""

import argparse
from functools import partial
from statistics import median

import numpy as np
from rich.console import Console
from scipy.linalg import expm, solve_continuous_are
from scipy.optimize import minimize

from pwatrack import design
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_region import SampledRegion
from pwatrack.control.headroom import InputConstraint
from pwatrack.control.sampled_disturbances import cut_off, drives
from pwatrack.control.synthesis import Search
from pwatrack.control.task import Task
from pwatrack.lmi.clocked_region import ClockedRegion
from pwatrack.lmi.ellipsoid import Inner
from pwatrack.lmi.inequality import CONTROLLER
from pwatrack.lmi.polynomial_region import region_around
from pwatrack.lmi.saturated import Region, SaturatedLoop
from pwatrack.rational import floats
from pwatrack.spec.load import load_spec
from pwatrack.workflow.sizing import spec_sizes
from tests.test_limits_active import growth, random_loop

console = Console(highlight=False, width=200)
_RAYS = 90  # on which the edge of a region is looked for
_FINE = 10  # points of that edge from one to the next
_THIN = 100.0  # ratio of the axes of an ellipse from which on it may be between these points
_FAR = 100.0  # in coordinates in which P is I: further no region is looked at
_ORDERS = 10  # of the cells, by which each start is tried


def plant(random: np.random.Generator) -> tuple[list[Array], Array, Array, Array]:
    """Return A of two cells, B, K and the P of the regulator."""
    while True:
        A0, B = random.normal(size=(2, 2)), random.normal(size=(2, 1))
        if (np.linalg.eigvals(A0).real > 0.05).sum() != 1 or np.linalg.cond(np.hstack([B, A0 @ B])) > 20:
            continue
        X = solve_continuous_are(A0, B, np.eye(2), np.eye(1))
        A = [A0, A0 + 0.05 * random.normal(size=(2, 1)) @ random.normal(size=(1, 2))]
        if max(np.linalg.eigvalsh(X @ (M - B @ B.T @ X) + (M - B @ B.T @ X).T @ X).max() for M in A) < -0.05:
            return A, B, np.asarray(-B.T @ X), np.asarray(np.linalg.inv(X), dtype=np.float64)


def survives(A: list[Array], B: Array, K: Array, forms: list[Array], z: Array, random: np.random.Generator) -> Array:
    """Say from which starts (s, 2) the error goes to 0 in every order that is tried."""
    z, fixed = np.repeat(z, _ORDERS, axis=0), len(A) + len(forms)
    start, cells, order = np.linalg.norm(z, axis=1), np.array(A), np.arange(len(z)) % _ORDERS
    step = 0.05 / float(np.abs(np.linalg.eigvals([M + B @ K for M in A])).max())
    mode = np.minimum(order, len(A) - 1)

    def slope(mode: Array, z: Array) -> Array:
        return np.asarray(np.einsum("sij,sj->si", cells[mode], z) + np.clip(z @ K.T, -1, 1) @ B.T)

    for k in range(2000):
        if k % 20 == 0:
            mode = np.where(order >= fixed, random.integers(len(A), size=len(z)), mode)
        if k % 4 == 0:
            for at, form in enumerate(forms, len(A)):
                grows = np.array([np.einsum("si,ij,sj->s", z, form, z @ M.T) for M in A])
                mode = np.where(order == at, grows.argmax(axis=0), mode)
        half = z + step / 2 * slope(mode, z)
        z = np.clip(z + step * slope(mode, half), -1e9, 1e9)
    return np.asarray((np.linalg.norm(z, axis=1) < 0.05 * start).reshape(-1, _ORDERS).all(axis=1))


def _rays(P: Array) -> Array:
    """Return rays, of size 1 in coordinates in which P is I."""
    angles = np.arange(_RAYS) * np.pi / _RAYS
    return np.asarray(np.column_stack([np.cos(angles), np.sin(angles)]) @ np.linalg.cholesky(P).T)


def simulated(A: list[Array], B: Array, K: Array, P: Array, forms: list[Array], random: np.random.Generator) -> Array:
    """Return how far the region reaches on each ray, in coordinates in which P is I."""
    rays = _rays(P)
    low, high = np.zeros(_RAYS), np.full(_RAYS, _FAR)
    for _ in range(14):
        middle = np.where(low > 0, np.sqrt(np.maximum(low, 1e-9) * high), high / 16)
        kept = survives(A, B, K, forms, middle[:, None] * rays, random)
        low, high = np.where(kept, middle, low), np.where(kept, high, middle)
    return low


def largest_ellipse(reach: Array) -> float:
    """Return the largest area of an ellipse inside a symmetric region, from its reach on rays; thin ones are none.

    Between rays the region reaches as far as the straight line from one point to the next.
    """
    coarse = np.arange(_RAYS + 1) * np.pi / _RAYS
    x, y = np.append(reach, reach[0]) * np.array([np.cos(coarse), np.sin(coarse)])
    x[-1], y[-1] = -x[0], -y[0]
    share = np.tile(np.arange(_FINE) / _FINE, _RAYS)
    rays = np.column_stack([(1 - share) * np.repeat(v[:-1], _FINE) + share * np.repeat(v[1:], _FINE) for v in (x, y)])

    def area(entries: Array) -> float:
        C = np.array([[np.exp(entries[0]), 0], [entries[1], np.exp(entries[2])]])
        if not np.linalg.cond(C) < _THIN:
            return 1e-9
        return float(np.pi / (np.exp(entries[0] + entries[2])) * (np.linalg.norm(rays @ C, axis=1)).min() ** 2)

    best = 0.0
    for first in (0.0, 1.0, -1.0):
        start, most = np.array([0.0, first, 0.0]), {"maxiter": 4000}
        found = minimize(lambda e: -np.log(area(e)), start, method="Nelder-Mead", options=most)  # type: ignore[call-overload]
        best = max(best, float(np.exp(-found.fun)))
    return best


def areas(seed: int) -> tuple[float, ...]:
    """Return the proved area, and that of the proved ellipse, against the largest ellipse in the simulated region.

    Then both against that region.
    """
    random = np.random.default_rng(seed)
    A, B, K, P = plant(random)
    balls = [BallMatrix.of(X.round(9)) for X in (*[M + B @ K for M in A], B, K)]
    loop = SaturatedLoop(M=balls[:2], B=balls[2], D=balls[3], inners=[Inner(Q=P, most=0.1)])
    root, best, forms = np.linalg.cholesky(P), dict[bool, float](), [np.linalg.inv(P)]
    shapes = [np.array([angle, long]) for angle in np.arange(4) * np.pi / 4 for long in (0.0, 1.0, 2.0)]

    def area(shape: Array, ellipse: bool) -> float:
        turn = np.array([[np.cos(shape[0]), -np.sin(shape[0])], [np.sin(shape[0]), np.cos(shape[0])]])
        G = root @ turn @ np.diag([1.0, np.exp(shape[1])])
        found = loop.around(G, np.ones(1)) if ellipse else region_around(loop, G, np.ones(1))
        if found is None:
            return 0.0
        size = float((np.minimum(found.reach(_rays(P)) / found.sizes[0], _FAR) ** 2).sum() * np.pi / _RAYS)
        if size > best.get(ellipse, 0.0):
            best[ellipse] = size
            forms[1:] = [np.linalg.inv(floats(found.P))] if isinstance(found, Region) else forms[1:]
        return size

    for ellipse in (True, False):  # around boxes of some shapes: the program makes the box large, not the area
        first, most = max(shapes, key=partial(area, ellipse=ellipse)), {"maxfev": 60 if ellipse else 30}
        minimize(lambda *given: -area(*given), first, (ellipse,), method="Nelder-Mead", options=most)  # type: ignore[call-overload]
    reach = simulated(A, B, K, P, [np.asarray(X, dtype=np.float64) for X in forms], random)
    of = largest_ellipse(reach), float((reach**2).sum() * np.pi / _RAYS)
    return tuple(best[ellipse] / one for one in of for ellipse in (False, True))


def carts() -> None:
    """Print the shares of the box of sizes of carts with a pole, ±20 N: never reached, reached, K designed with it."""
    for name in ("cart_and_pole_on_the_move", "cart_and_pole"):
        spec = load_spec(f"specs/gallery/{name}.yaml")
        sizes = spec_sizes(spec)
        task = Task.of(spec.problem.plant, CONTROLLER, sizes=sizes)
        search, starts, left = Search(task), [np.diag(sizes.state)], np.array([20.0])
        K = search.regulator(0.0)
        assert K is not None
        never, reached = (InputConstraint(starts=starts, left=left, over=over) for over in (1.0, np.inf))
        farthest = search.candidates.farthest(reached, 0.0)
        said = f"never reached {never.share(task, *K):.3f}, reached {reached.share(task, *K):.3f}"
        console.print(f"{name}, ±20 N: {said}, K designed with it {farthest[1] if farthest else np.nan:.3f}")


def sampled(name: str, starts: int, random: np.random.Generator) -> tuple[int, int, float, float]:
    """Try starts on the edge of the regions of a sampled loop, 40 ticks each.

    Returned is how many there were, for how many V grew from one tick to the next, how often an input was at a limit,
    and how V ends at most.
    """
    controller = design(load_spec(f"specs/{name}.yaml"))
    claim, errors = controller.claim(SampledRegion), controller.claim(SampledBounds).errors
    system, inputs = errors.clocked, claim.room.inputs
    flows = np.array([expm(F.floats * float(system.period) / system.parts / 2) for F in system.vertices])
    J, R = system.J[0].floats, np.eye(errors.order) if system.between is None else system.between.floats
    D, T, tried, grown, cut, last = drives(errors, inputs) @ J, cut_off(errors).floats[:, inputs], 0, 0, 0, 0.0
    for one in claim.found:
        assert isinstance(one.held, ClockedRegion)
        P, most = one.held.form, np.array(one.held.sizes)
        z = random.normal(size=(starts // len(claim.found), errors.order))
        z /= np.sqrt(np.einsum("si,ij,sj->s", z, P, z))[:, None]
        before, worst = np.ones(len(z)), np.arange(len(z)) % 2 == 0
        grew = np.zeros(len(z), dtype=bool)
        for _ in range(40):
            w = z @ D.T
            off = np.clip(w, -most, most) - w
            cut += int((off != 0).any(axis=1).sum())
            z = z @ J.T + off @ T.T
            for half in range(2 * system.parts):
                mode = random.integers(len(flows), size=len(z))
                ends = np.einsum("fij,sj->fsi", flows, z[worst])
                mode[worst] = np.einsum("fsi,ij,fsj->fs", ends, P, ends).argmax(axis=0)
                z = np.einsum("sij,sj->si", flows[mode], z)
                z = z @ R.T if half % 2 and half < 2 * system.parts - 1 else z
            V = np.einsum("si,ij,sj->s", z, P, z)
            grew |= before * (1 + 1e-9) < V
            before = V
        tried, grown, last = tried + len(z), grown + int(grew.sum()), max(last, float(before.max()))
    return tried, grown, cut, last


def main() -> None:
    """Print the figures."""
    asked = argparse.ArgumentParser()
    asked.add_argument("--plants", type=int, default=50)
    asked.add_argument("--starts", type=int, default=100_000)
    given = asked.parse_args()
    carts()
    found = [areas(seed) for seed in range(given.plants)]
    pairs = [
        (f"proved {what}", of)
        for of in ("the largest ellipse in the simulated region", "the simulated region")
        for what in ("area", "ellipse")
    ]
    for k, (what, of) in enumerate(pairs):
        each = sorted(one[k] for one in found)
        console.print(f"{what} against {of}, {len(each)} plants: median {median(each):.2f}, least {each[0]:.2f}")
    for name in ("gallery/cart_and_pole", "two_mass_machine"):
        tried, grown, cut, last = sampled(name, given.starts, np.random.default_rng(1))
        said = f"{tried} starts on the edge of its regions, {cut} times at a limit: V of {grown} grew from tick to tick"
        console.print(f"{name}, sampled: {said}; after 40 it is {last:.2f} at most")
    random, left, tried, loops = np.random.default_rng(0), 0, 0, 0
    while tried < given.starts:
        loop = random_loop(random, int(random.integers(2, 4)), int(random.integers(1, 3)), 2)
        region = loop.around(np.eye(loop.B.shape[0]), np.ones(loop.B.shape[1]))
        if region is None:
            continue
        size = min(5000, given.starts - tried)
        left += growth(loop, region, 1 / max(region.sizes), random, size) > 1e-9
        tried, loops = tried + size, loops + 1
    console.print(
        f"{tried} starts on the edge of {loops} regions, cells at random, inputs at limits: {left} regions left"
    )


if __name__ == "__main__":
    main()
