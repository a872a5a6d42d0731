"""Our solver of matrix inequalities beside others: the same program, to the same gap, modelling time included.

    make lmi-bench

Random plants: (8) with a margin, as large as it can be, and where there is none, the least violation. Each solver
runs alone in a process of its own on one thread, which is ended after --limit seconds; times are processor times, the
smallest of --repeat. A solver that is not installed is left out.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from rich.console import Console
from scipy import sparse

from benchmarks.corpus import feasible, infeasible
from pwatrack.arrays import Array, symmetric_part
from pwatrack.lmi.inequality import state_feedback
from pwatrack.lmi.primal_dual import solve
from pwatrack.lmi.program import Program, largest_margin, least_violation

GAP = 1e-6
BOUND_OF_Y = 10.0  # relative to ‖A‖ / ‖B‖
CELLS, STATES = (8, 16, 32, 64, 128), (8, 12, 20, 30, 50)


def program_of(kind: str, n: int, cells: int) -> Program:
    """Return the largest margin of a plant that has one, or the least violation of one that has none, about 1."""
    m = max(1, n // 4)
    A, B = (feasible if kind == "feasible" else infeasible)(1, n, m, cells, 1e-2)
    A, B = A / np.linalg.norm(A, 2, axis=(1, 2)).max(), B / np.linalg.norm(B, 2)
    if kind == "feasible":
        program = largest_margin(state_feedback(A, B), BOUND_OF_Y)
    else:  # in coordinates with B = [0; I], where Z_i B = 0
        reached, Q = np.split(np.linalg.qr(B, mode="complete")[0], [m], axis=1)
        like = state_feedback(Q.T @ A @ Q, np.zeros((n - m, m)))
        program = least_violation(replace(like, M=Q.T @ A @ reached))
    rough = solve(program, gap=0.1)
    unit = 1.0 if rough is None else 2.0 ** round(np.log2(abs(rough.t)))  # of t: most solvers mean an absolute gap
    return replace(
        program, constraints=tuple(c if c.T is None else replace(c, T=unit * c.T) for c in program.constraints)
    )


def ours(program: Program) -> float:
    """Return the objective that `primal_dual` finds."""
    found = solve(program, gap=GAP)
    return np.nan if found is None else found.objective


def cvxpy(solver: str, **options: Any) -> Callable[[Program], float]:
    """Return a solver that takes the program in CVXPY's notation."""

    def objective(program: Program) -> float:
        import cvxpy as cp

        n, m = program.n, program.m
        P, Y, t = cp.Variable((n, n), symmetric=True), cp.Variable((m, n)), cp.Variable()
        held = [] if program.trace is None else [cp.trace(P) == program.trace]
        for c in program.constraints:
            for i in range(len(c.constant)):
                half = c.L[i] @ P @ c.R[i] + c.M[i] @ Y @ c.N[i]
                side = half + half.T + c.constant[i]
                held.append(0 >> (side if c.T is None else side + t * c.T[i]))
        problem = cp.Problem(cp.Minimize(program.price * t), held)
        problem.solve(solver=solver, **options)
        return program.price * float(t.value)

    return objective


def picos(program: Program) -> float:
    """Return the objective that PICOS with CVXOPT finds."""
    import picos as pic

    n, m = program.n, program.m
    P, Y, t = pic.SymmetricVariable("P", n), pic.RealVariable("Y", (m, n)), pic.RealVariable("t")
    problem = pic.Problem()
    if program.trace is not None:
        problem.add_constraint(pic.trace(P) == program.trace)
    for c in program.constraints:
        for i in range(len(c.constant)):
            half = c.L[i] * P * c.R[i] + c.M[i] * Y * c.N[i]
            side = half + half.T + c.constant[i]
            problem.add_constraint((side if c.T is None else side + t * c.T[i]) << 0)
    problem.set_objective("min", program.price * t)
    problem.solve(solver="cvxopt", primals=None, rel_ipm_opt_tol=GAP, abs_ipm_opt_tol=GAP * 1e-3)
    return program.price * float(t.value)


def clarabel(program: Program) -> float:
    """Return the objective that Clarabel finds; its matrices are made without a modelling language."""
    import clarabel as cl

    rows, sides, cones = [], [], []
    for c in program.constraints:
        N = c.constant.shape[1]
        column, row = np.tril_indices(N)
        weight = np.where(row == column, 1.0, np.sqrt(2.0))
        image = _images(program, c)
        for i in range(len(c.constant)):
            rows.append(sparse.csc_matrix(image[i][:, row, column].T * weight[:, None]))
            sides.append(-weight * c.constant[i][row, column])
            cones.append(cl.PSDTriangleConeT(N))
    size = rows[0].shape[1]
    if program.trace is not None:
        below, right = np.tril_indices(program.n)
        trace = np.append((below == right).astype(float), np.zeros(size - len(below)))
        rows.append(sparse.csc_matrix(trace[None]))
        sides.append(np.array([program.trace]))
        cones.append(cl.ZeroConeT(1))
    settings = cl.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_rel, settings.tol_gap_abs = GAP, GAP * 1e-3
    cost = program.price * np.eye(size)[-1]
    nothing = sparse.csc_matrix((size, size))
    G = sparse.vstack(rows, format="csc")
    answer = cl.DefaultSolver(nothing, cost, G, np.concatenate(sides), cones, settings).solve()
    return float(answer.obj_val)


def _images(program: Program, c: Any) -> Array:
    """Return the left-hand sides of the unit vectors, (l, p, N, N)."""
    n, m, parts = program.n, program.m, []
    for j, k in zip(*np.tril_indices(n), strict=True):
        half = c.L[:, :, [j]] @ c.R[:, [k]] + (c.L[:, :, [k]] @ c.R[:, [j]] if j != k else 0)
        parts.append(symmetric_part(half))
    parts += [symmetric_part(c.M[:, :, [j]] @ c.N[:, [k]]) for j in range(m) for k in range(n)]
    parts.append(np.zeros_like(c.constant) if c.T is None else np.asarray(c.T))
    return np.stack(parts, axis=1)


SOLVERS: dict[str, tuple[Callable[[Program], float], tuple[str, ...]]] = {
    "ours": (ours, ()),
    "Clarabel": (clarabel, ("clarabel",)),
    "CVXPY + Clarabel": (
        cvxpy("CLARABEL", tol_gap_rel=GAP, tol_gap_abs=GAP * 1e-3, max_threads=1),
        ("cvxpy", "clarabel"),
    ),
    "CVXPY + SDPA": (cvxpy("SDPA", epsilonStar=GAP, epsilonDash=GAP, numThreads=1), ("cvxpy", "sdpap")),
    "PICOS + CVXOPT": (picos, ("picos", "cvxopt")),
}


def timed(name: str, kind: str, n: int, cells: int, repeat: int, limit: float) -> tuple[float, float]:
    """Return the smallest processor time in s and the objective, from a process of its own; infinity: ended."""
    code = f"from benchmarks.lmi import alone; alone({name!r}, {kind!r}, {n}, {cells}, {repeat})"
    try:
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=limit)
        return tuple(json.loads(run.stdout.splitlines()[-1]))
    except subprocess.TimeoutExpired:
        return np.inf, np.nan
    except (IndexError, ValueError):
        return np.nan, np.nan


def alone(name: str, kind: str, n: int, cells: int, repeat: int) -> None:
    """Print what `timed` reads. The first run of each solver, on a small plant, is not counted: it imports."""
    objective_by, least, objective = SOLVERS[name][0], np.inf, np.nan
    objective_by(program_of(kind, 3, 2))
    program = program_of(kind, n, cells)
    for _ in range(repeat):
        start = time.process_time()
        objective = objective_by(program)
        least = min(least, time.process_time() - start)
    sys.stdout.write("\n" + json.dumps([least, objective]) + "\n")


def exponent(sizes: list[int], times: list[float]) -> str:
    """Return the slope of log time over log size, by least squares, of the three largest sizes that were solved."""
    pairs = [(s, t) for s, t in zip(sizes, times, strict=True) if np.isfinite(t)][-3:]
    return f"{np.polyfit(*np.log(np.array(pairs).T), 1)[0]:.1f}" if len(pairs) > 1 else "–"


def table(console: Console, kind: str, sizes: list[tuple[int, int]], options: argparse.Namespace) -> None:
    """Print times and objectives, and how the time grows."""
    names = [name for name, (_, needs) in SOLVERS.items() if all(find_spec(module) for module in needs)]
    times: dict[str, list[float]] = {name: [] for name in names}
    console.print(f"\n{kind}: time in s, objective")
    for n, cells in sizes:
        for name in names:
            before = times[name][-1] if times[name] else 0.0
            spent = np.inf if np.isinf(before) else np.nan
            seconds, objective = (
                (spent, np.nan)
                if np.isinf(before)
                else timed(name, kind, n, cells, options.repeat if name == "ours" else 1, options.limit)
            )
            times[name].append(seconds)
            text = f"{seconds:9.3f}  {objective:+.8f}" if np.isfinite(seconds) else f"    more than {options.limit:g}"
            console.print(f"  n = {n:3} l = {cells:3}  {name:17} {text}")
        peers = [times[name][-1] for name in names[1:] if np.isfinite(times[name][-1])]
        if peers:
            console.print(f"  n = {n:3} l = {cells:3}  {min(peers) / times['ours'][-1]:.1f} times the fastest peer")
    along = [s[0] if sizes[0][0] != sizes[-1][0] else s[1] for s in sizes]
    console.print("  exponents: " + ", ".join(f"{name} {exponent(along, times[name])}" for name in names))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, nargs="*", default=STATES)
    parser.add_argument("--cells", type=int, nargs="*", default=CELLS)
    parser.add_argument("--kinds", nargs="*", default=["feasible", "infeasible"])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--limit", type=float, default=300.0, help="seconds that one solver may take")
    options, console = parser.parse_args(), Console(highlight=False)
    for kind in options.kinds:
        table(console, kind, [(n, 64) for n in options.states], options)
        table(console, kind, [(12, cells) for cells in options.cells], options)


if __name__ == "__main__":
    main()
