"""Time against true error, and events missed or invented: ours and its peers, in one run.

    make bench

Plants: the paper's example, three of the gallery, a beam of ten states with a one-sided spring, a network
of five springs with 32 cells. All are sampled at the same times. Peers: scipy's solve_ivp, python-control's
input_output_response, and SUNDIALS' CVODE by scikit-sundae; with and without events where they find events. Those
that are not installed are left out (`pip install -e .[bench]`). Their right-hand side is compiled by numba, outside the
clock, the fastest form there is in Python; for the paper's example it is written by hand. Ours is timed with all it
builds up, but not its first call, which loads the compiled kernel (0.4 s; in a fresh checkout it compiles for 4 s).

The truth is the same trajectory in 50-digit arithmetic (`tests/precise.py`). Ours must meet it to 1e-11 before
anything is timed. A peer's event is right if a true one is within a millisecond and a tenth of
the sample time.

After the paper's example comes an ensemble of it: a thousand initial states, beside the peers in a loop and beside the
floor of floating-point work, one matrix product for each member and sample. A peer is measured on three members, its
largest difference from ours is shown, and its time is scaled.

The last part sends trajectories past a guard by 1e-11 to 1e-2 of their size (`tests/grazing.py`) and
counts the crossings missed and invented. The peers may take a pass in one step and so see no change of sign; that is
what they do with the defaults of their users.
"""

import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp
from scipy.linalg import expm

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from pwatrack import load_spec, simulate  # noqa: E402
from pwatrack.arrays import Array  # noqa: E402
from pwatrack.simulation.ensemble import Member, simulate_ensemble  # noqa: E402
from pwatrack.simulation.flow import Flow, SwitchedPart  # noqa: E402
from pwatrack.simulation.propagate import simulate_flow  # noqa: E402
from pwatrack.workflow.variation import other_starts  # noqa: E402
from tests.grazing import near_grazing  # noqa: E402
from tests.precise import precise  # noqa: E402

REPEATS = 5
PASSES = 10_000
CONSOLE = Console(width=120, highlight=False)
MEMBERS, MEMBERS_OF_PEERS = 1_000, 3


@dataclass(frozen=True)
class Case:
    """What to simulate."""

    name: str
    flow: Flow
    z0: Array
    duration: float
    sample_time: float
    by_hand: "ByHand | None" = None


@dataclass(frozen=True)
class ByHand:
    """The same for the peers: compiled (t, s, result), start, guards as rows with an offset, and s from (t, z)."""

    rhs: Callable[..., None]
    start: Array
    guards: Array
    view: Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Answer:
    """What a method gives: samples (K, N), and event times if it finds any."""

    z: Array
    events: Sequence[float] | None


Method = Callable[[Case], Answer]


def from_spec(name: str) -> Case:
    """Return the closed loop of a spec."""
    spec = load_spec(ROOT / "specs" / f"{name}.yaml")
    result = simulate(spec)
    flow, scenario = result.loop.flow, spec.scenario
    start = flow.relative(result.response.trace.z[0])
    return Case(name, replace(flow, counted=None), start, scenario.duration, scenario.sample_time)


@njit
def spring(gap: float) -> float:
    """Return the force of the one-sided springs of the paper's example."""
    return 0.4 * (gap - 0.05) if gap > 0.05 else 0.4 * (gap + 0.1) if gap < -0.1 else 0.0


@njit
def section_v(t: float, s: Array, result: Array) -> None:
    """Write the closed loop of Section V in (x, x̂, η̄), with their misprints mended."""
    z1, v1, z2, v2, p1, w1, p2, w2, e, de = s
    omega = 2 * math.pi
    z_d, v_d = 0.15 * math.sin(omega * t), 0.15 * omega * math.cos(omega * t)
    u_ff = -omega * omega * z_d - 0.1 * (de - v_d) - spring(e)
    u = -1.6088 * (p1 - z_d) - 1.1260 * (w1 - v_d) + 0.2282 * (p2 - e - z_d) - 0.1182 * (w2 - de) + u_ff
    force, force_hat, off = spring(z2 - z1) + 0.1 * (v2 - v1), spring(p2 - p1) + 0.1 * (w2 - w1), p1 - z1
    result[0], result[1], result[2], result[3] = v1, force + u, v2, -force - z2 - 0.2 * v2
    result[4], result[5] = w1 - 1.1056 * off, force_hat + u - 1.5348 * off
    result[6], result[7] = w2 - 0.1027 * off, -force_hat - p2 - 0.2 * w2 + 0.1653 * off
    result[8], result[9] = de - v_d, -spring(e) - (e + z_d) - 0.3 * de + 0.1 * v_d


def paper_example() -> Case:
    """Return the paper's example; the peers get its equations written by hand, with y_d a sine and no states for it."""
    spec = load_spec(ROOT / "specs" / "two_mass_paper_gains.yaml")
    result = simulate(spec)
    start = np.array([0.25, 0, 0, 0, 0, 0, 0, 0, 0.2, 0])
    gaps = np.zeros((6, 11))
    for row, (plus, minus, edge) in zip(
        gaps, [(i, j, c) for i, j in ((2, 0), (6, 4), (8, None)) for c in (0.05, -0.1)], strict=True
    ):
        row[plus], row[-1] = 1.0, -edge
        if minus is not None:
            row[minus] = -1.0

    flow = result.loop.flow

    def view(t: Array, zeta: Array) -> Array:
        z = flow.absolute(zeta)
        s = z[:, :10].copy()
        s[:, 8] -= z @ result.loop.x_d[0, 0]  # η̄_1 = η̂_1 − z_d
        return s

    by_hand = ByHand(section_v, start, gaps, view)
    at_start = flow.relative(result.response.trace.z[0])
    return Case("the paper's example", replace(flow, counted=None), at_start, 60.0, 0.01, by_hand)


def driven(name: str, A: Array, b: Array, guards: Array, g: Array, omega: float, duration: float, dt: float) -> Case:
    """Return ẋ = A x + b sin(ωt) + Σ g_j max(0, guard_j (x, 1)) from rest; a cell for each set of springs that push."""
    n, k = len(A), len(guards)
    F0 = np.zeros((n + 3, n + 3))
    F0[:n, :n], F0[:n, n], F0[n, n + 1], F0[n + 1, n] = A, b, omega, -omega
    rows = np.zeros((k, n + 3))
    rows[:, :n], rows[:, -1] = guards[:, :n], guards[:, n]
    signs = np.array([[1 if cell >> j & 1 else -1 for j in range(k)] for cell in range(2**k)])
    F = np.zeros((2**k, n + 3, n + 3))
    for cell, side in enumerate(signs):
        for j in np.flatnonzero(side > 0):
            F[cell, :n] += np.outer(g[j], rows[j])
    part = SwitchedPart(name=name, cells=tuple(map(str, range(2**k))), guards=rows, signs=signs, F=F)
    z0 = np.zeros(n + 3)
    z0[n + 1 :] = 1.0
    return Case(name, Flow(F0=F0, parts=(part,)), z0, duration, dt)


def beam() -> Case:
    """Return five modes up to 4,000 rad/s on two pins, a one-sided spring in the middle, driven at 15 Hz."""
    A, b, at = np.zeros((10, 10)), np.zeros(10), np.zeros(10)
    for k in range(1, 6):
        i, w = 2 * k - 2, 160.0 * k**2
        A[i, i + 1], A[i + 1, i], A[i + 1, i + 1] = 1.0, -w * w, -0.04 * w
        b[i + 1], at[i] = 2000.0 * math.sin(0.3 * math.pi * k), math.sin(0.5 * math.pi * k)
    push = np.zeros(10)
    push[1::2] = 4e4 * at[::2]
    return driven("beam, 10 states", A, b, np.append(-at, 0.0)[None], push[None], 2 * math.pi * 15, 10.0, 0.001)


def network() -> Case:
    """Return five states and five one-sided springs in general position: 32 cells."""
    random = np.random.default_rng(5)
    A = random.normal(size=(5, 5)) * 2
    A = A - A.T - np.eye(5)
    h = random.normal(size=(5, 5))
    guards = np.column_stack([h, 0.1 * random.normal(size=5)])
    return driven("network, 32 cells", A, 3 * random.normal(size=5), guards, -0.5 * h, 2.0, 60.0, 0.01)


def problem(case: Case) -> ByHand:
    """Return what the peers integrate."""
    if case.by_hand:
        return case.by_hand
    guards = np.column_stack([case.flow.guards(), np.zeros(len(case.flow.guards()))])
    return ByHand(compiled(case.flow), case.z0, guards, lambda t, z: z)


def compiled(flow: Flow) -> Callable[..., None]:
    """Return the right-hand side as a compiled function (t, z, result)."""
    F0 = np.ascontiguousarray(flow.F0)
    F, guards = np.vstack([p.F for p in flow.parts]), flow.guards()
    first_cell = np.cumsum([0, *(len(p.cells) for p in flow.parts)])
    first_guard = np.cumsum([0, *(len(p.guards) for p in flow.parts)])
    width = max(len(p.guards) for p in flow.parts)
    signs = np.vstack([np.pad(p.signs, ((0, 0), (0, width - p.signs.shape[1]))) for p in flow.parts])

    @njit
    def rhs(t: float, z: Array, result: Array) -> None:
        n = len(z)
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += F0[i, j] * z[j]
            result[i] = total
        for p in range(len(first_cell) - 1):
            for cell in range(first_cell[p], first_cell[p + 1]):
                inside = True
                for k in range(first_guard[p], first_guard[p + 1]):
                    value = 0.0
                    for j in range(n):
                        value += guards[k, j] * z[j]
                    if value * signs[cell, k - first_guard[p]] < 0:
                        inside = False
                        break
                if inside:
                    for i in range(n):
                        for j in range(n):
                            result[i] += F[cell, i, j] * z[j]
                    break

    return rhs


@njit
def roots_of(guards: Array, z: Array, result: Array) -> None:
    """Write the values of guards (K, N + 1) at z (N,)."""
    for k in range(len(guards)):
        total = guards[k, -1]
        for j in range(len(z)):
            total += guards[k, j] * z[j]
        result[k] = total


def times_of(case: Case) -> Array:
    """Return the sample times."""
    return case.sample_time * np.arange(int(case.duration / case.sample_time * (1 + 1e-12)) + 1)


def ours(case: Case) -> Answer:
    """Simulate with pwatrack."""
    trace = simulate_flow(case.flow, case.z0, duration=case.duration, sample_time=case.sample_time)
    return Answer(trace.z, [event.t for event in trace.events])


def scipy_method(method: str, rtol: float, events: bool) -> Method:
    """Return solve_ivp with a method."""

    def run(case: Case) -> Answer:
        p = prepared(case)
        t, out = times_of(case), np.empty(len(p.start))

        def f(t: float, z: Array) -> Array:
            p.rhs(t, z, out)
            return out.copy()

        guards = [lambda t, z, row=row[:-1], c=row[-1]: row.dot(z) + c for row in p.guards] if events else None
        s = solve_ivp(f, (0, t[-1]), p.start, method=method, rtol=rtol, atol=rtol / 100, t_eval=t, events=guards)
        return Answer(s.y.T, np.sort(np.concatenate(s.t_events)).tolist() if events else None)

    return run


def control_method(method: str, rtol: float) -> Method:
    """Return python-control's simulation, which finds no events."""
    import control

    def run(case: Case) -> Answer:
        p = prepared(case)
        out = np.empty(len(p.start))

        def f(t: float, z: Array, u: Array, params: Any) -> Array:
            p.rhs(t, z, out)
            return out.copy()

        limits = {"rtol": rtol, "atol": rtol / 100}
        system = control.NonlinearIOSystem(f, None, inputs=0, states=len(p.start), outputs=len(p.start), name="loop")
        r = control.input_output_response(
            system, times_of(case), 0, p.start, solve_ivp_method=method, solve_ivp_kwargs=limits
        )
        return Answer(r.states.T, None)

    return run


def cvode_method(method: str, rtol: float, events: bool) -> Method:
    """Return CVODE."""
    from sksundae.cvode import CVODE

    def run(case: Case) -> Answer:
        p = prepared(case)
        options: dict[str, Any] = {}
        if events:
            count = len(p.guards)

            def find(t: float, z: Array, result: Array) -> None:
                roots_of(p.guards, z, result)

            find.terminal, find.direction = [False] * count, [0] * count  # type: ignore[attr-defined]
            options = {"eventsfn": find, "num_events": count}

        def f(t: float, z: Array, result: Array) -> None:
            p.rhs(t, z, result)

        solver = CVODE(f, method=method, rtol=rtol, atol=rtol / 100, max_num_steps=10**7, **options)
        t = times_of(case)
        s = solver.solve(t, p.start)
        on_grid = np.isin(s.t, t)
        found = None if not events else np.sort(np.ravel(s.t_events)).tolist() if s.t_events is not None else []
        return Answer(s.y[on_grid][: len(t)], found)

    return run


def prepared(case: Case) -> ByHand:
    """Return what the peers integrate, compiled once for each case."""
    if case.name not in _PREPARED:
        p = _PREPARED[case.name] = problem(case)
        p.rhs(0.0, p.start, np.empty(len(p.start)))
        roots_of(p.guards, p.start, np.empty(len(p.guards)))
    return _PREPARED[case.name]


_PREPARED: dict[str, ByHand] = {}


def peers(quick: bool) -> list[tuple[str, float, bool, Method]]:
    """Return (name, rtol, with events, method) of the peers that are installed; fewer where each takes long."""
    rows: list[tuple[str, float, bool, Method]] = []
    tolerances = (1e-6,) if quick else (1e-6, 1e-9, 1e-12)
    finer = tolerances if quick else (*tolerances, 2e-13)
    for rtol in tolerances:
        method = "RK45" if rtol > 1e-8 else "DOP853"
        rows += [(f"scipy {method}", rtol, events, scipy_method(method, rtol, events)) for events in (False, True)]
    if not quick:
        rows += [(f"scipy {name}", 1e-6, False, scipy_method(name, 1e-6, False)) for name in ("LSODA", "Radau")]
    for package, make in (("control RK45", control_method), ("CVODE Adams", cvode_method)):
        try:
            for rtol in tolerances if make is control_method else finer:
                if make is control_method:
                    rows.append((package, rtol, False, control_method("RK45" if rtol > 1e-8 else "DOP853", rtol)))
                else:
                    rows += [(package, rtol, e, cvode_method("Adams", rtol, e)) for e in (False, True)]
        except ImportError:
            CONSOLE.print(f"{package} is not installed, and left out")
    return rows


def timed(method: Method, case: Case, repeats: int) -> tuple[float, Answer]:
    """Return the least time of a few runs in s after a first one that counts for nothing, and the answer."""
    best = math.inf
    for _ in range(repeats):
        start = time.perf_counter()
        answer = method(case)
        best = min(best, time.perf_counter() - start)
        if best > 2.0:
            break
    return best, answer


def matched(found: Array, truth: Array, within: float) -> tuple[int, int]:
    """Return how many true events nothing found is near to, and how many found ones no true one is near to.

    Several guards may be crossed in one event, so one true event may answer for several found.
    """

    def lonely(ones: Array, others: Array) -> int:
        if not len(others):
            return len(ones)
        return int((np.abs(ones[:, None] - others).min(axis=1, initial=math.inf) > within).sum())

    return lonely(truth, found), lonely(found, truth)


def compare(case: Case, quick: bool = False) -> None:
    """Print the table of one case."""
    trace = simulate_flow(case.flow, case.z0, duration=case.duration, sample_time=case.sample_time)
    z, events = precise(case.flow, case.z0, trace)
    t = times_of(case)
    theirs = problem(case).view(t, z) if case.by_hand else z
    size = f"{len(case.z0)} states, {case.duration:g} s, {len(z)} samples, {len(events)} events"

    def error(answer: Answer) -> float:
        """Return the largest error, each state by its largest size."""
        truth = z if answer.z.shape == z.shape else theirs
        if answer.z.shape != truth.shape or not np.isfinite(answer.z).all():
            return math.inf
        scale = np.abs(truth).max(axis=0)
        return float((np.abs(answer.z - truth) / np.where(scale > 0, scale, 1.0)).max())

    def missed(answer: Answer) -> str:
        if answer.events is None:
            return "-"
        return "{} / {}".format(*matched(np.array(answer.events), events, min(1e-3, case.sample_time / 10)))

    our_time, answer = timed(ours, case, REPEATS)
    if error(answer) > 1e-11:
        raise SystemExit(f"{case.name}: ours and the truth differ by {error(answer):.2g}: nothing is timed")
    table = Table("method", "rtol", "seconds", "true error", "events missed / extra", "times ours", title=None)
    table.add_row("pwatrack", "", f"{our_time:.4f}", f"{error(answer):.1e}", missed(answer), "1")
    results = []
    for name, rtol, with_events, method in peers(quick):
        try:
            timed(method, case, 1) if not quick else None
            seconds, answer = timed(method, case, 3)
        except Exception as failure:  # a peer that gives up is a result
            table.add_row(name, f"{rtol:g}", "-", type(failure).__name__, "", "")
            continue
        results.append((seconds, error(answer), name, rtol))
        label = f"{name}, events" if with_events else name
        table.add_row(
            label, f"{rtol:g}", f"{seconds:.3f}", f"{error(answer):.1e}", missed(answer), f"{seconds / our_time:.1f}"
        )
    CONSOLE.print(f"\n{case.name}: {size}")
    CONSOLE.print(table)
    fastest(results, our_time)


def fastest(results: list[tuple[float, float, str, float]], our_time: float) -> None:
    """Print which (seconds, error, name, rtol) is the fastest of those that are accurate enough."""
    for target in (1e-6, 1e-9):
        good = [r for r in results if r[1] <= target]
        best = min(good) if good else None
        told = f"{best[0] / our_time:.0f} times slower ({best[2]}, rtol {best[3]:g})" if best else "none reaches it"
        CONSOLE.print(f"fastest peer with a true error of {target:g}: {told}")


@contextmanager
def silent() -> Iterator[None]:
    """Drop what a library in C writes to stderr."""
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def graze() -> None:
    """Print how many crossings each method misses or invents near a guard."""
    table = Table("method", "passes", "crossings", "missed", "invented", "unresolved", "seconds")
    methods: list[tuple[str, Method | None]] = [("pwatrack", None)]
    methods += [
        (f"{name}, rtol {rtol:g}", method)
        for name, rtol, events, method in peers(quick=False)
        if events and rtol < 1e-6
    ]
    for name, method in methods:
        lost = extra = open_ = there = 0
        spent = 0.0
        for seed in range(PASSES):
            p = near_grazing(seed)
            case = Case("pass", p.flow, p.z0, p.duration, p.duration / 3)
            if method is None:
                start = time.perf_counter()
                trace = simulate_flow(case.flow, case.z0, duration=case.duration, sample_time=case.sample_time)
                found, near = len(trace.events), len(trace.unresolved)
            else:
                rows = np.column_stack([p.flow.guards(), [0.0]])
                _PREPARED["pass"] = ByHand(_linear(p.flow.F0), p.z0, rows, lambda t, z: z)
                start = time.perf_counter()
                with silent():
                    found, near = len(method(case).events or ()), 0
            spent += time.perf_counter() - start
            lost, extra = lost + max(0, p.crossings - found), extra + max(0, found - p.crossings)
            open_, there = open_ + near, there + p.crossings
        table.add_row(name, f"{PASSES:,}", f"{there:,}", f"{lost:,}", f"{extra:,}", f"{open_:,}", f"{spent:.1f}")
    CONSOLE.print("\npasses within 1e-11 … 1e-2 of a guard; half of them cross it twice")
    CONSOLE.print(table)


def _linear(F: Array) -> Callable[..., None]:
    """Return the right-hand side of a pass, not compiled: each pass is another flow."""

    def rhs(t: float, z: Array, result: Array) -> None:
        np.dot(F, z, out=result)

    return rhs


def many() -> None:
    """Print how long the paper's example takes from a thousand initial states, beside peers and bare products."""
    result = simulate(load_spec(ROOT / "specs" / "two_mass_paper_gains.yaml"))
    spec, t = result.spec, result.response.t
    variation = other_starts(result, MEMBERS, seed=1)
    members = [variation.member(number) for number in range(MEMBERS)]

    def run(workers: int) -> float:
        start = time.perf_counter()
        simulate_ensemble(
            members.__getitem__,
            len(members),
            duration=spec.scenario.duration,
            sample_time=spec.scenario.sample_time,
            workers=workers,
        )
        return time.perf_counter() - start

    cores = len(os.sched_getaffinity(0))
    on_all, on_one = min(run(cores) for _ in range(3)), run(1)
    floor = min(_products(members, len(t), cores) for _ in range(3))
    nominal, some = paper_example(), members[:MEMBERS_OF_PEERS]
    assert nominal.by_hand is not None
    cases = []
    for k, member in enumerate(some, 1):
        start = nominal.by_hand.view(np.zeros(1), member.z0[None])[0]
        name = f"member {k}"
        case = replace(nominal, name=name, z0=member.z0, by_hand=replace(nominal.by_hand, start=start))
        cases.append((case, nominal.by_hand.view(t, ours(case).z)))
    table = Table(
        "method", "rtol", "largest difference", "seconds per member", f"seconds for {MEMBERS:,}", "times ours"
    )
    for label, seconds in ((f"pwatrack, {cores} cores", on_all), ("pwatrack, one core", on_one)):
        table.add_row(label, "", "", f"{seconds / MEMBERS:.4f}", f"{seconds:.2f}", f"{seconds / on_all:.2f}")
    table.add_row(
        f"one {len(members[0].z0)} × {len(members[0].z0)} product per sample, {cores} cores",
        "",
        "",
        f"{floor / MEMBERS:.6f}",
        f"{floor:.3f}",
        f"{floor / on_all:.4f}",
    )
    results = []
    for name, rtol, with_events, method in peers(quick=False):
        spent, difference = 0.0, 0.0
        for case, truth in cases:
            prepared(case)
            seconds, answer = timed(method, case, 2)
            spent += seconds / len(cases)
            scale = np.abs(truth).max(axis=0)
            difference = max(difference, float((np.abs(answer.z - truth) / scale).max()))
        label = f"{name}, events" if with_events else name
        results.append((spent * MEMBERS, difference, label, rtol))
        table.add_row(
            f"{label}, looped",
            f"{rtol:g}",
            f"{difference:.1e}",
            f"{spent:.4f}",
            f"{spent * MEMBERS:.0f}",
            f"{spent * MEMBERS / on_all:.0f}",
        )
    CONSOLE.print(
        f"\nthe paper's example from {MEMBERS:,} initial states; peers one after the other on one core, "
        f"measured on {MEMBERS_OF_PEERS} members and scaled",
    )
    CONSOLE.print(table)
    fastest(results, on_all)
    fastest([r for r in results if r[2].endswith("events")], on_all)


def _products(members: Sequence[Member], samples: int, cores: int) -> float:
    """Return the time in s that one matrix product per member and sample takes, the members shared among the cores."""
    step = np.ascontiguousarray(expm(members[0].flow.F0 * 0.01).T)
    shares = np.array_split(np.array([member.z0 for member in members]), cores)

    def run(Z: Array) -> None:
        other = np.empty_like(Z)
        for _ in range(samples - 1):
            np.matmul(Z, step, out=other)
            Z, other = other, Z

    start = time.perf_counter()
    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(run, shares))
    return time.perf_counter() - start


def main() -> None:
    """Print all tables."""
    compare(paper_example())
    many()
    for name in ("drive_with_end_stop", "quarter_car_bump_stop", "train_slack_couplings"):
        compare(from_spec(f"gallery/{name}"))
    compare(network())
    compare(beam(), quick=True)
    graze()


if __name__ == "__main__":
    main()
