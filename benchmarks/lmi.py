"""Our solver of matrix inequalities beside others: the same program, to the same gap, modelling time included.

    make lmi-bench

Random plants: (8) with a margin, as large as it can be, and where there is none, the least violation; and how long it
takes to know that there is none, where Clarabel is asked for any solution and ends with its proof. Then a whole default
design, K and L with all proofs, beside what the fastest other solver needs for one such margin. Each solver
runs alone in a process of its own on one thread, which is ended after --limit seconds; times are processor times, the
smallest of --repeat for us and one for the others. One that has been ended once is not asked for more of its kind, and
one that is not installed is left out. SDPA and CSDP are programs that read files: writing these is not counted.
"""

import argparse
import json
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
from rich.console import Console
from scipy import sparse

from benchmarks.corpus import feasible, infeasible, observed
from benchmarks.measured import dual_off, violation
from pwatrack.arrays import Array, symmetric_part
from pwatrack.ball_matrix import different
from pwatrack.control.proof import prove_inequality
from pwatrack.control.synthesis import gain
from pwatrack.control.task import Task
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER, state_feedback
from pwatrack.lmi.program import SemidefiniteProgram, largest_margin, least_violation
from pwatrack.lmi.solve import solve

GAP = 1e-6
CSDP_PARAMETERS = """axtol=1.0e-8
atytol=1.0e-8
objtol=1.0e-6
pinftol=1.0e8
dinftol=1.0e8
maxiter=100
minstepfrac=0.90
maxstepfrac=0.97
minstepp=1.0e-8
minstepd=1.0e-8
usexzgap=1
tweakgap=0
affine=0
printlevel=1
perturbobj=1
fastmode=0
"""  # its own, but for the gap
SDPA_PARAMETERS = """100 unsigned int maxIteration;
1.0E-6 double 0.0 < epsilonStar;
1.0E2 double 0.0 < lambdaStar;
2.0 double 1.0 < omegaStar;
-1.0E5 double lowerBound;
1.0E5 double upperBound;
0.1 double 0.0 <= betaStar < 1.0;
0.3 double 0.0 <= betaBar < 1.0, betaStar <= betaBar;
0.9 double 0.0 < gammaStar < 1.0;
1.0E-6 double 0.0 < epsilonDash;
"""  # likewise
_KNOWN = 0.9  # gap at which the least violation is known to be above 0
BOUND_OF_Y = 10.0  # relative to ‖A‖ / ‖B‖
CELLS, STATES = (8, 16, 32, 64, 128), (8, 12, 20, 30, 50)
LARGEST = 50, 128
DESIGNS = (4, 3), (20, 64), (30, 64)


def program_of(kind: str, n: int, cells: int) -> SemidefiniteProgram:
    """Return the largest margin of a plant that has one, or the least violation of one that has none, about 1."""
    m = max(1, n // 4)
    A, B = (feasible if kind == "feasible" else infeasible)(1, n, m, cells, 1e-2)
    A, B = A / np.linalg.norm(A, 2, axis=(1, 2)).max(), B / np.linalg.norm(B, 2)
    if kind == "feasible":
        program = largest_margin(state_feedback(A, B), BOUND_OF_Y)
    else:  # in coordinates with B = [0; I], where Z_i B = 0
        reached, Q = np.split(np.linalg.qr(B, mode="complete")[0], [m], axis=1)
        like = state_feedback(Q.T @ A @ Q, np.zeros((n - m, m)))
        program = least_violation([replace(like, M=Q.T @ A @ reached)])
    rough = solve(program, gap=0.1)
    unit = 1.0 if rough is None else 2.0 ** round(np.log2(abs(rough.t)))  # of t: most solvers mean an absolute gap
    return replace(
        program, constraints=tuple(c if c.T is None else replace(c, T=unit * c.T) for c in program.constraints)
    )


def ours(program: SemidefiniteProgram) -> float:
    """Return the objective that we find, of a point that satisfies all constraints."""
    found = solve(program, gap=GAP)
    return np.nan if found is None or violation(found) > 0 else found.objective


def certain(program: SemidefiniteProgram) -> float:
    """Return how far our objective may be from the least one, as a share: what the multipliers say."""
    found = solve(program, gap=GAP)
    return np.nan if found is None else (found.gap + dual_off(found)) / abs(found.objective)


def cvxpy(solver: str, **options: Any) -> Callable[[SemidefiniteProgram], float]:
    """Return a solver that takes the program in CVXPY's notation."""

    def objective(program: SemidefiniteProgram) -> float:
        import cvxpy as cp

        n, m = program.n, program.m
        P, Y, t = cp.Variable((n, n), symmetric=True), cp.Variable((m, n)), cp.Variable()
        held = [cp.trace(E @ P) == value for E, value in program.equalities]
        for c in program.constraints:
            for i in range(len(c.constant)):
                half = c.L[i] @ P @ c.R[i] + c.M[i] @ Y @ c.N[i]
                side = half + half.T + c.constant[i]
                held.append(0 >> (side if c.T is None else side + t * c.T[i]))
        problem = cp.Problem(cp.Minimize(program.price * t), held)
        problem.solve(solver=solver, **options)
        return program.price * float(t.value)

    return objective


def picos(program: SemidefiniteProgram) -> float:
    """Return the objective that PICOS with CVXOPT finds."""
    import picos as pic

    n, m = program.n, program.m
    P, Y, t = pic.SymmetricVariable("P", n), pic.RealVariable("Y", (m, n)), pic.RealVariable("t")
    problem = pic.Problem()
    problem.add_list_of_constraints([pic.trace(E * P) == value for E, value in program.equalities])
    for c in program.constraints:
        for i in range(len(c.constant)):
            half = c.L[i] * P * c.R[i] + c.M[i] * Y * c.N[i]
            side = half + half.T + c.constant[i]
            problem.add_constraint((side if c.T is None else side + t * c.T[i]) << 0)
    problem.set_objective("min", program.price * t)
    problem.solve(solver="cvxopt", primals=None, rel_ipm_opt_tol=GAP, abs_ipm_opt_tol=GAP * 1e-3)
    return program.price * float(t.value)


def clarabel(program: SemidefiniteProgram) -> float:
    """Return the objective that Clarabel finds; its matrices are made without a modelling language."""
    return float(_clarabel(program).obj_val)


def clarabel_refutes(program: SemidefiniteProgram) -> float:
    """Return 1 if Clarabel proves that all constraints without t have no solution."""
    rest = replace(program, constraints=tuple(replace(c, T=None) for c in program.constraints), price=0.0)
    return float(str(_clarabel(rest).status) == "PrimalInfeasible")


def refuted(program: SemidefiniteProgram) -> float:
    """Return 1 if our multipliers bound the least violation away from 0."""
    found = solve(program, gap=_KNOWN, against=0.0)
    return np.nan if found is None else float(found.bound > dual_off(found))


def _clarabel(program: SemidefiniteProgram) -> Any:
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
    below, right = np.tril_indices(program.n)
    for E, value in program.equalities:
        entries = np.append(np.where(below == right, 1.0, 2.0) * E[below, right], np.zeros(size - len(below)))
        rows.append(sparse.csc_matrix(entries[None]))
        sides.append(np.array([value]))
        cones.append(cl.ZeroConeT(1))
    settings = cl.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_rel, settings.tol_gap_abs = GAP, GAP * 1e-3
    cost = program.price * np.eye(size)[-1]  # none where t is in no constraint: any solution will do
    nothing = sparse.csc_matrix((size, size))
    G = sparse.vstack(rows, format="csc")
    return cl.DefaultSolver(nothing, cost, G, np.concatenate(sides), cones, settings).solve()


def _images(program: SemidefiniteProgram, c: Any) -> Array:
    """Return the left-hand sides of the unit vectors, (l, p, N, N)."""
    n, m, parts = program.n, program.m, []
    for j, k in zip(*np.tril_indices(n), strict=True):
        half = c.L[:, :, [j]] @ c.R[:, [k]] + (c.L[:, :, [k]] @ c.R[:, [j]] if j != k else 0)
        parts.append(symmetric_part(half))
    parts += [symmetric_part(c.M[:, :, [j]] @ c.N[:, [k]]) for j in range(m) for k in range(n)]
    parts.append(np.zeros_like(c.constant) if c.T is None else np.asarray(c.T))
    return np.stack(parts, axis=1)


def from_file(command: str) -> Callable[[SemidefiniteProgram], float]:
    """Return a solver that is a program of its own, and reads the program from a file in SDPA's sparse format.

    That has no equalities: one variable makes up for each.
    """

    def objective(program: SemidefiniteProgram) -> float:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            constant = _write_sparse(program, folder / "program.dat-s")
            (folder / "param.csdp").write_text(CSDP_PARAMETERS, encoding="ascii")
            (folder / "param.sdpa").write_text(SDPA_PARAMETERS, encoding="ascii")
            asked = ["program.dat-s", "program.out"]
            if command == "sdpa":
                asked = ["-ds", asked[0], "-o", asked[1], "-p", "param.sdpa", "-numThreads", "1"]
            run = subprocess.run([command, *asked], cwd=folder, capture_output=True, text=True, check=False)
            if run.returncode < 0:  # it was ended, and so is this
                signal.raise_signal(-run.returncode)
            said = run.stdout + ((folder / "program.out").read_text() if command == "sdpa" else "")
        values = re.findall(r"(?:objValPrimal\s*=|Primal objective value:)\s*(\S+)", said)
        return float(values[-1]) + constant

    return objective


def _write_sparse(program: SemidefiniteProgram, path: Path) -> float:
    """Write min c·x, Σ x_k F_k − F_0 ⪰ 0, and return what is to be added to the objective."""
    images, constants = [_images(program, c) for c in program.constraints], [c.constant for c in program.constraints]
    size = images[0].shape[1]
    cost, offset, kept = program.price * np.eye(size)[-1], 0.0, np.arange(size)
    below, right = np.tril_indices(program.n)
    for E, value in program.equalities:
        row = np.append(np.where(below == right, 1.0, 2.0) * E[below, right], np.zeros(size - len(below)))
        k = int(np.argmax(np.abs(row)))
        images, constants = (
            [image - (row / row[k])[:, None, None] * image[:, [k]] for image in images],
            [constant + value / row[k] * image[:, k] for image, constant in zip(images, constants, strict=True)],
        )
        cost, offset, kept = cost - cost[k] / row[k] * row, offset + cost[k] * value / row[k], kept[kept != k]
    blocks = [(image[i], constant[i]) for image, constant in zip(images, constants, strict=True)
              for i in range(len(constant))]  # fmt: skip
    lines = [str(len(kept)), str(len(blocks)), " ".join(str(len(constant)) for _, constant in blocks)]
    lines.append(" ".join(map(repr, cost[kept].tolist())))
    for b, (image, constant) in enumerate(blocks, 1):
        for number, matrix in enumerate([constant, *(-image[kept])]):
            for i, j in np.argwhere(np.triu(matrix)).tolist():
                lines.append(f"{number} {b} {i + 1} {j + 1} {float(matrix[i, j])!r}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return offset


REFUTERS = {"ours": refuted, "Clarabel": clarabel_refutes}
SOLVERS: dict[str, tuple[Callable[[SemidefiniteProgram], float], tuple[str, ...]]] = {
    "ours": (ours, ()),
    "Clarabel": (clarabel, ("clarabel",)),
    "CVXPY + Clarabel": (
        cvxpy("CLARABEL", tol_gap_rel=GAP, tol_gap_abs=GAP * 1e-3, max_threads=1),
        ("cvxpy", "clarabel"),
    ),
    "CVXPY + SDPA": (cvxpy("SDPA", epsilonStar=GAP, epsilonDash=GAP, numThreads=1), ("cvxpy", "sdpap")),
    "PICOS + CVXOPT": (picos, ("picos", "cvxopt")),
    "SDPA": (from_file("sdpa"), ("/sdpa",)),
    "CSDP": (from_file("csdp"), ("/csdp",)),
}


def design(n: int, cells: int) -> float:
    """Return the rate of the controller of a default design, found and proved with the observer and both overshoots."""
    A, B, C = observed(1, n, max(1, n // 4), cells, 1e-2)
    names, rates = [str(i) for i in range(cells)], []
    for role, of, to in ((CONTROLLER, A, B), (OBSERVER, A.transpose(0, 2, 1), C.T)):
        task = Task(A=of, B=to, role=role, cells=names)
        K, certificate = gain(task)
        proofs = prove_inequality(role, different(task.exactly_closed(K)), certificate)
        rates.append(proofs[0].rate)
    return rates[0]


def timed(call: str, limit: float) -> tuple[float, float, float]:
    """Return the processor time in s, the objective and what it may be off, from a process of its own.

    Infinity: it was ended; not a number: it failed.
    """
    code = f"from benchmarks import lmi; lmi.{call}"
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (round(limit), round(limit) + 5)),
    )
    if run.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return np.inf, np.nan, np.nan
    try:
        seconds, objective, off = json.loads(run.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        return np.nan, np.nan, np.nan
    return seconds, objective, off


def alone(name: str, kind: str, n: int, cells: int, repeat: int) -> None:
    """Print what `timed` reads. The first run of each solver, on a small plant, is not counted: it imports."""
    objective_by = SOLVERS[name][0]
    objective_by(program_of(kind, 3, 2))
    program = program_of(kind, n, cells)
    clock = _of_others if SOLVERS[name][1][:1] in (("/sdpa",), ("/csdp",)) else time.process_time
    _report(lambda: objective_by(program), repeat, certain(program) if objective_by is ours else np.nan, clock)


def decided(by: str, n: int, cells: int, repeat: int) -> None:
    """Print what `timed` reads, of a program without solutions."""
    run = REFUTERS[by]
    run(program_of("infeasible", 3, 2))
    program = program_of("infeasible", n, cells)
    _report(lambda: run(program), repeat)


def designed(n: int, cells: int, repeat: int) -> None:
    """Print what `timed` reads, for a whole design."""
    design(3, 2)
    _report(lambda: design(n, cells), repeat)


def _report(
    run: Callable[[], float], repeat: int, off: float = np.nan, clock: Callable[[], float] = time.process_time
) -> None:
    least, value = np.inf, np.nan
    for _ in range(repeat):
        start = clock()
        value = run()
        least = min(least, clock() - start)
    sys.stdout.write("\n" + json.dumps([least, value, off]) + "\n")


def _is_there(need: str) -> bool:
    """Whether a module is installed, or behind a slash a program."""
    return bool(which(need[1:]) if need[0] == "/" else find_spec(need))


def _of_others() -> float:
    """Return the processor time of the processes that this one has waited for: it writes their files for nothing."""
    return sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def exponent(sizes: list[int], times: list[float]) -> str:
    """Return the slope of log time over log size, by least squares, of the three largest sizes that were solved."""
    pairs = [(s, t) for s, t in zip(sizes, times, strict=True) if np.isfinite(t)][-3:]
    if len(pairs) < 2:
        return "–"
    size, took = np.log(np.array(pairs, dtype=float).T)
    return f"{np.polyfit(size, took, 1)[0]:.1f}"


class Measured:
    """Times and objectives of one kind of program, each measured once.

    Attributes:
        names: Of the solvers, ours first.
    """

    def __init__(self, console: Console, kind: str, options: argparse.Namespace) -> None:
        self._console, self._kind, self._options = console, kind, options
        self.names = [
            name
            for name, (_, needs) in SOLVERS.items()
            if (not needs or name in options.peers) and all(map(_is_there, needs))
        ]
        self._found = dict[tuple[str, int, int], tuple[float, float, float]]()

    def of(self, name: str, n: int, cells: int) -> tuple[float, float, float]:
        """Return the time of a solver and its objective; infinity where a smaller program took too long."""
        key = name, n, cells
        if key not in self._found:
            ended = any(
                np.isinf(seconds) and by == name and states <= n and count <= cells
                for (by, states, count), (seconds, *_) in self._found.items()
            )
            repeat = self._options.repeat if name == self.names[0] else 1
            call = f"alone({name!r}, {self._kind!r}, {n}, {cells}, {repeat})"
            self._found[key] = (np.inf, np.nan, np.nan) if ended else timed(call, self._options.limit)
        return self._found[key]

    def row(self, n: int, cells: int) -> None:
        """Print all solvers at one size."""
        at = f"  n = {n:3} l = {cells:3}  "
        objective = self.of(self.names[0], n, cells)[1]
        for name in self.names:
            seconds, other, off = self.of(name, n, cells)
            far = f"{abs(other - objective) / max(abs(objective), 1e-300):.0e} from ours"
            far = far if name != self.names[0] else f"certain to {off:.0e}"
            text = f"{seconds:9.3f} s  {other:+.8f}  {far}"
            too_long = f"more than {self._options.limit:g} s" if np.isinf(seconds) else "no answer"
            self._console.print(f"{at}{name:17} {text if np.isfinite(seconds) else too_long:>14}")
        seconds = self.of(self.names[0], n, cells)[0]
        name, fastest = self.fastest_peer(n, cells)
        self._console.print(f"{at}{fastest / seconds:.1f} times as fast as {name}" if name else f"{at}no peer ended")

    def fastest_peer(self, n: int, cells: int) -> tuple[str, float]:
        """Return the name and the time of the fastest other solver, an empty name if none ended."""
        times = {name: self.of(name, n, cells)[0] for name in self.names[1:]}
        ended = {name: seconds for name, seconds in times.items() if np.isfinite(seconds)}
        return min(ended.items(), key=lambda pair: pair[1]) if ended else ("", np.inf)

    def table(self, along: str, sizes: list[tuple[int, int]]) -> None:
        """Print all sizes, and how the times grow along n or l."""
        for n, cells in sizes:
            self.row(n, cells)
        which = 0 if along == "n" else 1
        grows = (
            f"{name} {exponent([s[which] for s in sizes], [self.of(name, *s)[0] for s in sizes])}"
            for name in self.names
        )
        self._console.print(f"  exponents in {along}: " + ", ".join(grows))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, nargs="*", default=STATES)
    parser.add_argument("--cells", type=int, nargs="*", default=CELLS)
    parser.add_argument("--kinds", nargs="*", default=["feasible", "infeasible"])
    parser.add_argument("--peers", nargs="*", default=[name for name, (_, needs) in SOLVERS.items() if needs])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--limit", type=float, default=300.0, help="seconds that one solver may take")
    options, console = parser.parse_args(), Console(highlight=False, width=120)
    for kind in options.kinds:
        measured = Measured(console, kind, options)
        console.print(f"\n{kind}: processor time, objective")
        measured.table("n", [(n, 64) for n in options.states])
        measured.table("l", [(12, cells) for cells in options.cells])
        if max(options.states) >= LARGEST[0]:
            measured.row(*LARGEST)
        if kind != "feasible":
            console.print("\nto know that there is no solution")
            for n in options.states:
                times = [timed(f"decided({by!r}, {n}, 64, {options.repeat})", options.limit) for by in REFUTERS]
                (ours_, yes, _), (peer, also, _) = times
                said = f"ours {ours_:.3f} s, Clarabel {peer:.3f} s" if yes == also == 1 else "not known by both"
                console.print(f"  n = {n:3} l =  64  {said}: {peer / ours_:.1f} times as fast")
            continue
        console.print("\na whole default design, K and L with proofs, beside one margin program")
        for n, cells in (size for size in DESIGNS if size[0] <= max(options.states)):
            seconds, rate, _ = timed(f"designed({n}, {cells}, {options.repeat})", options.limit)
            name, fastest = measured.fastest_peer(n, cells)
            console.print(
                f"  n = {n:3} l = {cells:3}  {seconds:7.3f} s (rate {rate:.4g}); one margin: {name} {fastest:.3f} s"
            )


if __name__ == "__main__":
    main()
