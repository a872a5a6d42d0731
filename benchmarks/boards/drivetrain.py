"""The drivetrain of ARCH-COMP, DTN01 to DTN06 and smaller and larger ones, with its own controller and all transitions.

    python -m benchmarks.boards.drivetrain [--cases DTN01 …] [--members 100000] [--out runs/boards]

An engine drives a load through a chain of rotating masses, across a backlash of ± α: states x1 to x(7 + 2θ) for θ
masses between. The controller of the benchmark and its reference are part of the plant, as there; the acceleration u
is −5 rad/s² until t = 0.2 s and 5 rad/s² from there on. The numbers are those of the benchmark (Althoff and Krogh,
Avoiding geometric intersection operations in reachability analysis of hybrid systems, HSCC 2012; cases of 2023).
The torque of the shaft is k φ(x1), φ the dead zone on [−α, α], so that the loop is one continuous piecewise affine
plant: each way across a facet is a transition, also those that models for reachability leave out.

The initial set is a segment: centre ± share × delta. Members stand on it at equal distances, both ends among them, and
each is propagated exactly to rounding. Between them a quadratic form speaks: with A_iᵀ P + P A_i ⪯ 2 μ P in all cells,
two solutions under one input are at most e^(μ t) times as far apart in the norm of P as they began, so x1 at 2 s
differs from that of the nearest member by at most the printed bound. Where the least x1 of the members, less that, is
above α, every point of the set ends past the gap: proved, but for the rounding of the members' runs. Some members are
integrated again by DOP853 of SciPy, and the largest difference is printed.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.boards.limited import machine, table
from pwatrack import plant as plant_of
from pwatrack.arrays import Array
from pwatrack.lmi.exact import prove
from pwatrack.lmi.pair import Pair
from pwatrack.lmi.presolve import Coordinates, extreme
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import StateResets
from pwatrack.simulation.ensemble import Member, simulate_ensemble
from pwatrack.simulation.flow import Flow, SwitchedPart

ALPHA, RATIO, SHAFT, BETWEEN = 0.03, 12.0, 1e4, 1e5  # rad, 1, Nm/rad, Nm/rad
LOAD, ENGINE, INERTIAS = 140.0, 0.3, 0.01  # kg m²; of the masses between 1 / J is 0.01 in the benchmark's equations
FRICTION_LOAD, FRICTION_BETWEEN = 5.6, 1.0  # Nm s/rad
LAG, GAIN_P, GAIN_I, GAIN_D = 0.1, 0.5, 0.5, 0.5  # s, and the controller
TORQUE, SPEED, SPREAD = -300.0, 30.0, 10.0  # Nm, rad/s: of the initial set
SWITCH, END, BRAKE, DRIVE = 0.2, 2.0, -5.0, 5.0  # s, rad/s²
SPEEDS, STRICT = np.geomspace(1.0, 20.0, 12), 10.0 ** np.arange(-8, 1, 2)  # 1/s; of |f|²: what is tried for P
CHECKED = 8  # members that are integrated again
RTOL, ATOL = 1e-11, 1e-11


@dataclass(frozen=True)
class Case:
    """One case: its masses between, the share of the initial set, CORA's published time of the whole script in s."""

    masses: int
    share: float
    cora: float | None = None


CASES = {
    "DTN01": Case(2, 0.05, 30.96),
    "DTN02": Case(2, 0.3, 29.26),
    "DTN03": Case(2, 1.0, 29.63),
    "DTN04": Case(22, 0.05, 106.85),
    "DTN05": Case(22, 0.3, 208.04),
    "DTN06": Case(22, 1.0, 526.22),
    "7 states": Case(0, 1.0),
    "101 states": Case(47, 1.0),
}


def chain(masses: int) -> list[tuple[int, int]]:
    """Return the places of angle and speed of each mass from the backlash to the load, which stand at 4 and 5.

    Example:
        >>> chain(2)
        [(7, 8), (9, 10), (4, 5)]
    """
    return [*((7 + 2 * k, 8 + 2 * k) for k in range(masses)), (4, 5)]


def system(masses: int) -> dict[str, Any]:
    """Return the section `system` of a spec: the benchmark's closed loop, with the acceleration as its input."""
    n, bodies = 7 + 2 * masses, chain(masses)
    A, shaft, u = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    first_angle, first_speed = bodies[0]
    A[0, 6], A[0, first_speed] = 1 / RATIO, -1.0
    A[6, 1], shaft[6] = 1 / ENGINE, -1 / (ENGINE * RATIO)
    A[2, 3] = u[3] = 1.0
    v = np.zeros(n)
    v[[3, 6]] = GAIN_P * RATIO, -GAIN_P
    v[[2, 0, first_angle]] = GAIN_I * RATIO * np.array([1.0, -1.0, -1.0])
    A[1] = (v - GAIN_D * A[6]) / LAG
    A[1, 1] -= 1 / LAG
    shaft[1], u[1] = -GAIN_D * shaft[6] / LAG, GAIN_D * RATIO / LAG
    for place, (angle, speed) in enumerate(bodies):
        by, friction = (1 / LOAD, FRICTION_LOAD) if angle == 4 else (INERTIAS, FRICTION_BETWEEN)
        A[angle, speed] = 1.0
        A[speed, speed] -= by * friction
        if place == 0:
            shaft[speed] = by
        for other in [*bodies[max(place - 1, 0) : place], *bodies[place + 1 : place + 2]]:
            A[speed, angle] -= by * BETWEEN
            A[speed, other[0]] += by * BETWEEN
    states = [f"x{k + 1}" for k in range(n)]
    gap = {"name": "backlash", "kind": "dead_zone", "of": "x1", "lower": -ALPHA, "upper": ALPHA, "slope": SHAFT}
    return {
        "states": states,
        "inputs": ["u"],
        "outputs": ["twist"],
        "A": A.tolist(),
        "nonlinearities": [gap | {"into": {states[k]: float(shaft[k]) for k in np.flatnonzero(shaft)}}],
        "B": u[:, None].tolist(),
        "C": [np.eye(n)[0].tolist()],
    }


def start(masses: int) -> tuple[Array, Array]:
    """Return centre and half width of the initial set, (n,) each: at rest against the lower end, at many speeds."""
    push = np.array([FRICTION_LOAD * SPEED + TORQUE, FRICTION_LOAD * SPREAD])
    twist, between = push / SHAFT, push / BETWEEN
    centre = [twist[0] - ALPHA, push[0] / RATIO, 0.0, SPEED, 0.0, SPEED, RATIO * SPEED]
    delta = [twist[1], push[1] / RATIO, 0.0, SPREAD, 0.0, SPREAD, RATIO * SPREAD]
    more = [between[0], SPEED] * masses, [between[1], SPREAD] * masses
    return np.array(centre + more[0]), np.array(delta + more[1])


def flow_of(plant: PWASystem) -> Flow:
    """Return the flow of z = (x, u, 1) under a constant input."""
    cells, n = plant.A.shape[:2]
    F = np.zeros((cells, n + 2, n + 2))
    F[:, :n, :n], F[:, :n, n], F[:, :n, n + 1] = plant.A, plant.B[:, 0], plant.b
    part = SwitchedPart.of("drivetrain", plant, np.eye(n, n + 2), F)
    return Flow(F0=np.zeros((n + 2, n + 2)), parts=(part,))


def spread(plant: PWASystem, delta: Array) -> float:
    """Return c such that x1 at the end differs by at most c |λ − λ'| between starts centre + λ delta.

    |x1| ≤ √(P⁻¹)_11 |x|_P, and |x|_P at the end is at most e^(μ t) times that of the start.
    """
    M, best = extreme(plant.A.transpose(0, 2, 1)), np.inf
    at = Coordinates.balanced(M)
    for mu, strict in product(SPEEDS, STRICT):
        shifted = M - mu * np.eye(len(delta))
        pair = Pair.of(at.system(shifted))
        P = None if pair is None else pair.common(0.0, strict * float(pair.f @ pair.f))
        proof = None if P is None else prove(shifted, at.matrix(P))
        if proof is not None:
            unit = np.linalg.solve(proof.P, np.eye(len(delta))[0])[0]
            best = min(best, float(np.sqrt(delta @ proof.P @ delta * unit) * np.exp((mu - proof.rate) * END)))
    return best


def integrated(plant: PWASystem, x0: Array) -> float:
    """Return x1 at the end by an integrator of general systems, which knows nothing of cells."""
    from scipy.integrate import solve_ivp

    A, b = plant.A, plant.b

    def field(u: float) -> Any:
        return lambda t, x: A[cell(x[0])] @ x + b[cell(x[0])] + plant.B[:, 0] * u

    def cell(twist: float) -> int:
        return int(twist >= -ALPHA) + int(twist > ALPHA)

    x = x0
    for u, span in ((BRAKE, (0.0, SWITCH)), (DRIVE, (SWITCH, END))):
        x = solve_ivp(field(u), span, x, method="DOP853", rtol=RTOL, atol=ATOL).y[:, -1]
    return float(x[0])


def simulated(case: Case, members: int) -> list[str]:
    """Return the row of a case: how many members end past the gap, where, what is proved, and how long it took."""
    plant = plant_of(**system(case.masses)).system
    flow, (centre, delta) = flow_of(plant), start(case.masses)
    n, at = len(centre), np.linspace(-1.0, 1.0, members)
    delta = case.share * delta
    error = np.zeros((1, n + 2))
    error[0, [0, n + 1]] = 1.0  # x1 + 1 is positive: its norm is itself
    resets = (StateResets(t=np.array([SWITCH]), where=slice(n, n + 1), values=np.array([[DRIVE]])),)

    def member(k: int) -> Member:
        z0 = np.concatenate([centre + at[k] * delta, [BRAKE, 1.0]])
        return Member(flow=flow, z0=z0, error=error, resets=resets)

    clock = [time.process_time()]
    found = simulate_ensemble(member, members, duration=END, sample_time=SWITCH, workers=1)
    clock.append(time.process_time())
    between = spread(plant, delta) / (members - 1)  # half of the distance of neighbours
    clock.append(time.process_time())
    ends = found.error[:, -1] - 1
    some = np.linspace(0, members - 1, CHECKED).astype(int)
    off = max(abs(integrated(plant, centre + at[k] * delta) - ends[k]) for k in some)
    return [
        str(n),
        f"{case.share:g}",
        f"{int((ends > ALPHA).sum()):,} of {members:,}",
        f"{ends.min():.6f} to {ends.max():.6f}",
        f"{between:.1e}, {'all' if ends.min() - between > ALPHA else 'not all'} past",
        f"{found.mode_changes.min()} to {found.mode_changes.max()}",
        f"{off:.0e}",
        *(f"{after - before:.1f}" for before, after in pairwise(clock)),
        "–" if case.cora is None else f"{case.cora:.2f}",
    ]


def main() -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--members", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=Path("runs/boards"))
    given, found = parser.parse_args(), list[list[str]]()
    for name in given.cases:
        found.append([name, *simulated(CASES[name], given.members)])
        sys.stderr.write("  ".join(found[-1]) + "\n")
    columns = ["case", "n", "share", "past the gap", "x1 at 2 s, rad", "between members", "transitions", "off DOP853"]
    text = table(f"Drivetrain, {machine()}", [*columns, "members s", "form s", "CORA s"], found)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "drivetrain.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
