"""How many verdicts are proved: random systems that have gains, and random ones that have none.

    make corpus

Each system is made so that the answer is known beforehand. Feasible: A_i = P½ (G_i − G_iᵀ − R_i) P⁻½ − B K with
R_i ≻ 0, so that K and P solve (8). Infeasible: multipliers Z_i are drawn first, and the A_i are then moved so
that Σ (Z_i A_i + A_iᵀ Z_i) ≻ 0 where Σ Z_i B = 0. Everything is printed that is not proved. With --gains each
default gain is compared with the smallest one that is found for the same rate.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
from rich.console import Console

from pwatrack.arrays import Array
from pwatrack.control.convergence import prove_convergence
from pwatrack.control.goal import DEFAULT
from pwatrack.control.synthesis import Search, gain
from pwatrack.control.task import Task
from pwatrack.errors import Infeasible, PwatrackError


def feasible(seed: int, n: int, m: int, cells: int, margin: float) -> tuple[Array, Array]:
    """Return A (l, n, n) and B (n, m) for which (8) has a solution with this margin, relative to ‖A‖."""
    return observed(seed, n, m, cells, margin)[:2]


def observed(seed: int, n: int, m: int, cells: int, margin: float) -> tuple[Array, Array, Array]:
    """Return A, B and C (m, n) for which (8) and (9) have one: with K = C for the one, and L = B for the other."""
    random = np.random.default_rng(seed)
    orthogonal = np.linalg.qr(random.normal(size=(n, n)))[0]
    root = (orthogonal * 10.0 ** random.uniform(-0.5, 0.5, size=n)) @ orthogonal.T
    B, K = random.normal(size=(n, m)), random.normal(size=(m, n))
    A = np.empty((cells, n, n))
    for i in range(cells):
        G, F = random.normal(size=(n, n)), random.normal(size=(n, max(1, n // 2)))
        stable = G - G.T - F @ F.T / n
        size = np.linalg.norm(stable, 2)
        A[i] = root @ (stable - margin * size * np.eye(n)) @ np.linalg.inv(root) - B @ K
    return A, B, K


def infeasible(seed: int, n: int, m: int, cells: int, margin: float) -> tuple[Array, Array]:
    """Return A and B for which multipliers refute (8) with this margin, relative to ‖A‖.

    In coordinates with B = [0; I] the multipliers are Z_i = [W_i 0; 0 0]. The upper right blocks of A_i are
    moved to make Σ W_i A_i^12 = 0, the upper left ones to make Σ sym(W_i A_i^11) = 2 margin I.
    """
    random = np.random.default_rng(seed)
    k = n - m
    T = random.normal(size=(n, n))
    roots = random.normal(size=(cells, k, k))
    W = roots @ np.swapaxes(roots, 1, 2) / k + 0.1 * np.eye(k)
    A = random.normal(size=(cells, n, n)) / np.sqrt(n)
    excess = (W @ A[:, :k, k:]).sum(axis=0)
    A[:, :k, k:] -= np.linalg.solve(W.sum(axis=0), excess)
    S = (W @ A[:, :k, :k]).sum(axis=0)
    S = S + S.T - 2 * margin * np.linalg.norm(A, 2, axis=(1, 2)).max() * W.sum(axis=0)
    A[:, :k, :k] -= np.linalg.solve(W.sum(axis=0), S / 2)
    B = np.vstack([np.zeros((k, m)), np.eye(m)])
    return T @ A @ np.linalg.inv(T), T @ B


def sizes(count: int, largest: int, most_cells: int) -> Iterator[tuple[int, int, int, int, float]]:
    """Yield seed, n, m, l and margin; n, l and the margin uniform in their logarithms."""
    random = np.random.default_rng(2026)
    for seed in range(count):
        n = round(2 * (largest / 2) ** random.uniform())
        m = int(random.integers(1, max(2, n // 3 + 1)))
        cells = round(2 * (most_cells / 2) ** random.uniform())
        yield seed, n, min(m, n - 1), cells, float(10 ** random.uniform(-6, -1))


def excess(A: Array, B: Array) -> float:
    """Return the norm of the default gain, relative to the smallest known of its rate (the rate is exact to 0.3 %)."""
    task = Task(A=A, B=B, cells=[str(i) for i in range(len(A))])
    K, certificate = gain(task)
    small = Search(task).smallest(certificate.rate * (1 - 3e-3))
    known = [K] if small is None else [K, small[0]]
    norms = [float(np.linalg.norm(k, 2)) for k in known]
    return norms[0] / max(min(norms), 1e-12)


def verdict(A: Array, B: Array) -> str:
    """Return "proved", "proved impossible" or "undecided"; without inputs the A_i are closed loops with given gains."""
    cells = [str(i) for i in range(len(A))]
    try:
        if B.shape[1]:
            gain(Task(A=A, B=B, cells=cells), DEFAULT)
        else:
            prove_convergence(A, claim="(8)", cells=cells)
    except Infeasible:
        return "proved impossible"
    except PwatrackError:
        return "undecided"
    return "proved"


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--largest", type=int, default=30, help="largest number of states")
    parser.add_argument("--cells", type=int, default=16, help="largest number of cells")
    parser.add_argument("--kinds", nargs="*", default=["feasible", "infeasible", "given"])
    parser.add_argument("--gains", action="store_true", help="measure the default gains instead")
    options, console = parser.parse_args(), Console(highlight=False)
    if options.gains:
        ratios = []
        for seed, n, m, cells, margin in sizes(options.count, options.largest, options.cells):
            ratios.append(excess(*feasible(seed, n, m, cells, margin)))
            if ratios[-1] > 5:
                console.print(f"  feasible {seed}: n={n} m={m} l={cells} margin={margin:.1e}: {ratios[-1]:.2f}")
        middle, most = np.median(ratios), max(ratios)
        console.print(f"default gains over the smallest of their rates: median {middle:.2f}, largest {most:.2f}")
        return
    for kind, wanted in (("feasible", "proved"), ("infeasible", "proved impossible"), ("given", "proved impossible")):
        if kind not in options.kinds:
            continue
        start, right = time.perf_counter(), 0
        for seed, n, m, cells, margin in sizes(options.count, options.largest, options.cells):
            if kind == "feasible":
                A, B = feasible(seed, n, m, cells, margin)
            else:
                A, B = infeasible(seed, n, m if kind == "infeasible" else 0, cells, margin)
            begin = time.perf_counter()
            answer = verdict(A, B)
            right += answer == wanted
            if answer != wanted:
                console.print(f"  {kind} {seed}: n={n} m={m} l={cells} margin={margin:.1e}: {answer}")
            if time.perf_counter() - begin > 60:
                console.print(f"  {kind} {seed}: n={n} l={cells} took {time.perf_counter() - begin:.0f} s")
        console.print(f"{kind}: {right} of {options.count} {wanted}, {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
