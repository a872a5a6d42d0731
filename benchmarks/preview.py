"""Random plants that are not minimum phase: is the bounded solution one, and does the closed loop follow it?

    python -m benchmarks.preview [plants]
    python -m benchmarks.preview grazing [plants]

Each has one to four unstable zeros between 0.1 and 2,000 rad/s, up to two stable ones, two cells, and a reference that
is periodic or goes from rest to rest. First the bounded solution of each is worked out: printed are the residual of
(15) that is told, and that of (3) at other times as this file works it out, both relative to the largest terms. Then
loops are designed and simulated until there are as many, one plant after the other; those for which (8) or (9) is
proved impossible, and those for which they are not decided, are counted apart. Printed is the largest |y − y_d| of the
last tenth of a run, relative to the reference, from x_d(0) and, where a run is long enough, from a start that is off by
a thousandth of x_d; what the residual and the jumps of what is played back leave there by another method,
e' = (A_i + B K) e + ρ with ρ from numbers of more digits; and what the rounding of x_d to doubles makes of y by itself,
which is much where u moves a mode hardly at all.

With `grazing`, the plants have a spring that x_d presses by 1e-9 to 1e-1 only, once in a period, at any phase. x_d,
u_ff and gains are those of the design, and the plant is integrated by SciPy at tight tolerance. Printed is in how many
|y − y_d| is above what is said.
"""

import sys
from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from pwatrack import design, load_spec, simulate
from pwatrack.arrays import EPS, Array
from pwatrack.claims.stable_inversion import StableInversion
from pwatrack.control.controller import ProvedController
from pwatrack.errors import Infeasible, PwatrackError
from pwatrack.spec.spec import Spec
from pwatrack.workflow.tracking import desired_trajectory
from tests.plants import saddle

INTEGRATED = 1e-7  # what the integrator of `integrated` itself is off by, at most
_LOOKS = 200  # times at which it is compared, and steps at least
_CONSTANTS = 30  # after so many time constants nothing is left of a start


def spec_text(seed: int) -> str:
    """Return a spec with states (y, η): η' = A_i η + g y, y' = a y + c η + u."""
    random = np.random.default_rng(seed)
    zeros, first, bend, h = saddle(random, 2)
    p = len(zeros)
    fast = float(np.abs(zeros).max())
    A = np.zeros((p + 1, p + 1))
    A[0], A[1:, 0], A[1:, 1:] = random.normal(size=p + 1) * fast, random.normal(size=p) * fast, first
    kink = np.concatenate([[0.0], bend])
    speed = 10 ** random.uniform(-0.5, 1.0)
    wave = f'"sin({speed:.6g}*t) + 0.3*cos({2 * speed:.6g}*t)"'
    rest = f"{{step: {{size: 1, at: {4 / speed:.6g}, smooth: {2 / speed:.6g}}}}}"
    names = ["y"] + [f"eta{k}" for k in range(p)]
    edge = " + ".join(f"({v:.17g})*{name}" for v, name in zip(h, names[1:], strict=True))
    into = ", ".join(f"{name}: {v:.17g}" for name, v in zip(names, kink, strict=True) if v)
    return f"""name: plant {seed}
system:
  states: [{", ".join(names)}]
  inputs: [u]
  outputs: [{", ".join(f"m_{name}" for name in names)}]
  track: [m_y]
  A: {rows(A)}
  B: [[1]{", [0]" * p}]
  C: {rows(np.eye(p + 1))}
  nonlinearities:
    - {{name: kink, kind: spring, of: "{edge}", start: {0.3 * abs(random.normal()):.6g}, slope: 1, into: {{{into}}}}}
reference: {{output: {wave if seed % 2 else rest}}}
simulation: {{duration: {15 / speed:.6g}, sample_time: {0.01 / speed:.6g}}}
"""


def rows(X: Array) -> str:
    """Return a matrix as YAML."""
    return "[" + ", ".join("[" + ", ".join(f"{v:.17g}" for v in row) + "]" for row in X) + "]"


def solved(path: Path) -> tuple[float, float]:
    """Return the residual of (15) that is told, and that of (3) at other times, relative to their largest terms."""
    spec = load_spec(path)
    trajectory = desired_trajectory(spec, True)
    preview = trajectory.preview
    assert preview is not None
    assert trajectory.generator is not None
    plant, system = trajectory.generator.form.plant, trajectory.exosystem
    t = np.random.default_rng(0).uniform(0, spec.scenario.duration, 500)
    w = system.states(t)
    s = np.hstack([w, np.ones((len(t), 1))])
    cell = (trajectory.signs * np.sign(s @ trajectory.guards.T)[:, None] >= 0).all(axis=2).argmax(axis=1)
    x, u = np.einsum("tns,ts->tn", trajectory.x_d[cell], s), np.einsum("tms,ts->tm", trajectory.u_ff[cell], s)
    slope = np.einsum("tns,ts->tn", trajectory.x_d[cell, :, :-1], w @ system.S.T)
    A, b = plant.A[cell], plant.b[cell]
    missed = slope - np.einsum("tij,tj->ti", A, x) - b - u @ plant.B.T
    terms = np.einsum("tij,tj->ti", np.abs(A), np.abs(x)) + np.abs(b) + np.abs(u) @ np.abs(plant.B).T
    told = float((preview.residual / preview.terms).max())
    return told, float((np.abs(missed).max(axis=0) / terms.max(axis=0)).max())


@dataclass(frozen=True, kw_only=True)
class Followed:
    """The largest |y − y_d| in the last tenth of two runs, and what rounding makes of it.

    Attributes:
        near: From x_d(0).
        off: From a start that is off; None where the run is too short for that.
        left: What is left by what is played back, without the simulation.
        bound: What is told of it.
        rounding: About what an error of one unit in the last place of each x_d makes of y, through K.
    """

    near: float
    off: float | None
    left: float
    bound: float
    rounding: float


def followed(path: Path) -> Followed:
    """Design for a plant and simulate."""
    spec = load_spec(path)
    controller = design(spec)
    plant, K, L = controller.plant, controller.design.K, controller.design.L
    x_d = controller.trajectory.state(np.append(controller.trajectory.exosystem.w0, 1.0))
    near, largest = last_tenth(spec, controller, x_d)
    loops = np.concatenate([plant.A + plant.B @ K, plant.A + L @ plant.C])
    off = None
    if _CONSTANTS / float(-np.linalg.eigvals(loops).real.max()) < 0.9 * spec.scenario.duration:
        start = x_d + 1e-3 * np.abs(x_d).max() * np.random.default_rng(0).normal(size=len(x_d))
        off = last_tenth(spec, controller, start)[0]
    gain = max(peak(A, plant.B[:, 0], plant.tracked[0]) for A in plant.A + plant.B @ K)
    left = left_by_pieces(controller, spec.scenario.duration)
    rounding = float(EPS * (np.abs(K[0]) @ largest) * gain)
    return Followed(near=near, off=off, left=left, bound=told_of(controller), rounding=rounding)


def last_tenth(spec: Spec, controller: ProvedController, start: Array) -> tuple[float, Array]:
    """Return the largest |y − y_d| in the last tenth of a run from a start, x̂ from x_d(0) on; and the largest |x_d|."""
    trajectory = controller.trajectory
    x_d = trajectory.state(np.append(trajectory.exosystem.w0, 1.0))
    initial = replace(spec.scenario.initial, plant=start, observer=x_d)
    response = simulate(replace(spec, scenario=replace(spec.scenario, initial=initial)), controller).response
    error = np.abs(response.tracking_error)
    return float(error[-(len(error) // 10) :].max()), np.abs(response.x_d).max(axis=0)


def told_of(controller: ProvedController) -> float:
    """Return what is told to be left of |y − y_d| by what is played back; 0 where nothing is."""
    return sum(played.error for played in controller.claims_of(StableInversion))


def left_by_pieces(controller: ProvedController, duration: float) -> float:
    """Return the largest |y − y_d| in the last tenth of a run that ρ = f(x_d) + B u_ff − x_d' and jumps of x_d leave.

    Plant and x_d are taken to be in the same cell, and ρ to be straight between 2,000 times and 16 in each piece.
    """
    plant, trajectory = controller.plant, controller.trajectory
    system, n = trajectory.exosystem, plant.A.shape[1]
    S, w, e, worst = system.S.astype(np.longdouble), system.w0.astype(np.longdouble), np.zeros(n), 0.0
    times = [0.0, *(t for t in system.breaks.tolist() if 0 < t < duration), duration]
    flows = dict[tuple[int, float], Array]()
    due = [(t, each.where, w) for each in system.resets for t, w in zip(each.t, each.values, strict=True)]
    due.sort(key=lambda reset: reset[0])

    def at(w: NDArray[np.longdouble]) -> tuple[int, NDArray[np.longdouble], NDArray[np.longdouble]]:
        s = np.append(w, np.longdouble(1))
        i = int((trajectory.signs * np.sign(trajectory.guards @ s) >= 0).all(axis=1).argmax())
        x, slope = trajectory.x_d[i] @ s, trajectory.x_d[i, :, :-1] @ (S @ w)
        return i, x, plant.A[i] @ x + plant.b[i] + plant.B @ (trajectory.u_ff[i] @ s) - slope

    for a, b in pairwise(times):
        before = at(w)[1]
        while due and due[0][0] <= a:
            _, where, values = due.pop(0)
            w[where] = values
        e += (before - at(w)[1]).astype(float)
        steps = max(16, int(np.ceil((b - a) / duration * 2000)))
        h = (b - a) / steps
        for k in range(steps):
            i, _, rho = at(w)
            term = w
            for j in range(1, 25):
                term = S @ term * (np.longdouble(h) / j)
                w = w + term
            j, _, after = at(w)
            if (i, h) not in flows:
                F = np.zeros((3 * n, 3 * n))
                F[:n, :n], F[: 2 * n, n:] = plant.A[i] + plant.B @ controller.K, np.eye(2 * n)
                flows[i, h] = expm(F * h)[:n]
            slope = (after - rho) / h if i == j else np.zeros(n)
            e = flows[i, h] @ np.concatenate([e, rho.astype(float), slope.astype(float)])
            if a + (k + 1) * h > 0.9 * duration:
                worst = max(worst, float(np.abs(plant.tracked @ e).max()))
    return worst


def peak(A: Array, b: Array, c: Array) -> float:
    """Return about ∫ |c e^(A t) b| dt, which is all that an input of size 1 can do to c x."""
    poles, V = np.linalg.eig(A)
    t = np.append(0.0, np.geomspace(1e-4 / np.abs(poles).max(), 40 / np.abs(poles.real).min(), 20_000))
    response = (np.exp(np.multiply.outer(t, poles)) @ ((c @ V) * np.linalg.solve(V, b.astype(complex)))).real
    return float(np.trapezoid(np.abs(response), t))


def grazing_text(seed: int) -> str:
    """Return a spec with x' = h + u, h' = p h − x − slope max(0, x − start), where x_d hardly comes to `start`."""
    random = np.random.default_rng(seed)
    depth, slope = 10 ** random.uniform(-9, -1), 10 ** random.uniform(-1, 2)
    speed, phase = 10 ** random.uniform(-0.3, 0.5), random.uniform(-np.pi, np.pi)
    pole, second = random.uniform(0.3, 2), random.uniform(0, 0.4) * (seed % 2)
    t = np.linspace(0, 2 * np.pi, 200_001)
    top = float((np.sin(t) + second * np.sin(2 * t)).max())
    wave = f"sin({speed:.12g}*t + {phase:.12g}) + {second:.12g}*sin({2 * speed:.12g}*t + {2 * phase:.12g})"
    return f"""name: grazing {seed}
system:
  states: [x, h]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [-1, {pole:.12g}]]
  B: [[1], [0]]
  C: [[1, 0]]
  nonlinearities:
    - {{name: stop, kind: spring, of: x, start: {top - depth:.17g}, slope: {slope:.12g}, into: {{h: -1}}}}
reference: {{output: "{wave}"}}
simulation: {{duration: {2 * 2 * np.pi / speed:.17g}, sample_time: {0.01 / speed:.6g}}}
"""


def integrated(controller: ProvedController, duration: float) -> float:
    """Return the largest |y − y_d| of the true plant from x = x̂ = x_d(0), with x_d and u_ff as they are played back.

    By an integrator that knows the plant as its cells, with short steps at facets.
    """
    plant, trajectory, n = controller.plant, controller.trajectory, controller.plant.A.shape[1]
    system, K, L = trajectory.exosystem, controller.K, controller.L
    breaks = sorted({0.0, *system.breaks.tolist()})
    parts = [replace(system, w0=w, resets=()) for w in system.states(np.array(breaks))]

    def field(x: Array) -> Array:
        sides = np.sign(plant.partition.H @ x + plant.partition.h)
        i = int((plant.partition.signs * sides >= 0).all(axis=1).argmax())
        return np.asarray(plant.A[i] @ x + plant.b[i])

    def desired(t: float) -> tuple[Array, Array]:
        k = bisect_right(breaks, t) - 1
        s = np.append(parts[k].states(np.array([t - breaks[k]]))[0], 1.0)
        i = int((trajectory.signs * np.sign(trajectory.guards @ s) >= 0).all(axis=1).argmax())
        return trajectory.x_d[i] @ s, trajectory.u_ff[i] @ s

    def slope(t: float, z: Array) -> Array:
        x, x_hat = z[:n], z[n:]
        x_d, u_ff = desired(t)
        driven = plant.B @ (K @ (x_hat - x_d) + u_ff)
        return np.concatenate([field(x) + driven, field(x_hat) + driven + L @ (plant.C @ (x_hat - x))])

    t = np.linspace(0.0, duration, _LOOKS)
    found = solve_ivp(
        slope,
        (0.0, duration),
        np.tile(desired(0.0)[0], 2),
        t_eval=t,
        method="DOP853",
        rtol=1e-9,
        atol=1e-10,
        max_step=duration / _LOOKS,
    )
    assert found.success
    x_d = np.array([desired(at)[0] for at in t])
    return float(np.abs((found.y[:n].T - x_d) @ plant.tracked.T).max())


def grazing(count: int) -> None:
    """Print how many of so many grazing plants are further off than is said."""
    console, ratios, refused, beyond = Console(width=140), list[float](), 0, 0
    with TemporaryDirectory() as folder:
        for seed in range(count):
            path = Path(folder) / "plant.yaml"
            path.write_text(grazing_text(seed), encoding="utf-8")
            spec = load_spec(path)
            try:
                controller = design(spec)
            except PwatrackError:
                refused += 1
                continue
            seen, told = integrated(controller, spec.scenario.duration), told_of(controller)
            start = controller.trajectory.state(np.append(controller.trajectory.exosystem.w0, 1.0))
            simulated, _ = last_tenth(spec, controller, start)
            ratios.append(seen / (told + INTEGRATED))
            beyond += max(seen - INTEGRATED, simulated) > told
            console.print(f"{seed:4d}  integrated {seen:.1e}, simulated {simulated:.1e}, told {told:.1e}")
    console.print(
        f"{len(ratios)} grazing plants, {refused} refused: more is off than is said in {beyond}, "
        f"largest ratio to what is said and {INTEGRATED:.0e} of the integrator {max(ratios, default=0.0):.2g}"
    )


def main(count: int) -> None:
    """Print the figures."""
    console, told, seen = Console(width=140), list[float](), list[float]()
    found, refused = dict[int, Followed](), dict[int, PwatrackError]()
    with TemporaryDirectory() as folder:
        path, seed = Path(folder) / "plant.yaml", 0
        while len(found) < count:
            path.write_text(spec_text(seed), encoding="utf-8")
            try:
                if seed < count:
                    residual, at_others = solved(path)
                    told.append(residual)
                    seen.append(at_others)
                one = found[seed] = followed(path)
                other = "" if one.off is None else f", from another start {one.off:.1e}"
                pieces = f"left by pieces {one.left:.1e}, rounding {one.rounding:.1e}"
                console.print(f"{seed:4d}  error in the end {one.near:.1e}{other}, {pieces}")
            except PwatrackError as refusal:
                refused[seed] = refusal
            seed += 1
    console.print(
        f"{len(told)} bounded solutions: residual of (15) as told at most {max(told):.1e} of its terms, median "
        f"{np.median(told):.1e}; of (3) at 500 other times {max(seen):.1e}, median {np.median(seen):.1e}"
    )
    for kind, which in (("periodic", 1), ("rest to rest", 0)):
        some = [one for at, one in found.items() if at % 2 == which]
        for start, errors in (
            ("x_d(0)", np.array([one.near for one in some])),
            ("another start", np.array([one.off for one in some if one.off is not None])),
        ):
            console.print(
                f"{kind}, from {start}: {len(errors)} loops, error in the end below 1e-8 in {(errors < 1e-8).sum()}, "
                f"at most {errors.max(initial=0.0):.1e}, median {np.median(errors):.1e}"
            )
    left, bounds = (np.array([getattr(one, name) for one in found.values()]) for name in ("left", "bound"))
    console.print(f"left by what is played back: below 1e-8 in {(left < 1e-8).sum()}, at most {left.max():.1e}")
    beyond = sum(one.left > one.bound for one in found.values())
    console.print(f"more is left than is told in {beyond}; median of what is told {np.median(bounds):.1e}")
    for verdict, proved in (("proved impossible", True), ("undecided, or refused otherwise", False)):
        lines = [f"{at}: {e.problems[0].message}" for at, e in refused.items() if isinstance(e, Infeasible) == proved]
        console.print(f"{len(lines)} of {seed} plants {verdict}", *lines, sep="\n")


if __name__ == "__main__":
    if "grazing" in sys.argv:
        grazing(int(sys.argv[2]) if len(sys.argv) > 2 else 20)
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
