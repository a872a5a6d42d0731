"""Sweep the example over k2 and d1, here and on two dask workers of which one is killed, and compare with a formula.

    python -m benchmarks.sweep [POINTS]

(17) of the example has a common P if and only if √(k1 + k2) − √k1 < d1 + d2 (k3 = k2, m2 = 1). So the places at which
a sweep finds the proofs by a common P to end are to be on that curve to the width that was asked for. Both sweeps are
to be the same to the last byte.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from math import sqrt
from pathlib import Path
from typing import Any

from pwatrack.batch.cluster import Cluster
from pwatrack.batch.pool import PRELOAD, Pool
from pwatrack.batch.sweep import PROVED, Edge, Point, draw_sweep, places, sweep, write_sweep
from pwatrack.spec.axis import Axis, axis

SPEC, WIDTH = Path("specs/two_mass_backlash.yaml"), 1e-3
FIXED = {"k3": "k2"}
K1, D2 = 1.0, 0.1


@contextmanager
def dask_workers(count: int) -> Iterator[tuple[str, list["subprocess.Popen[bytes]"]]]:
    """Start a scheduler and workers with one thread each on the loopback address; return its address, and them."""
    begun = list[subprocess.Popen[bytes]]()

    def start(kind: str, *options: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, "--no-dashboard"]
        begun.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        return begun[-1]

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
        try:
            while not file.exists() or not file.read_text():
                time.sleep(0.1)
            options = ("--scheduler-file", str(file), "--nthreads", "1", "--no-nanny")
            workers = [start("worker", *options) for _ in range(count)]
            address = file.read_text().partition('"address": "')[2].partition('"')[0]
            with Cluster(address) as cluster:
                while cluster.jobs < count:
                    time.sleep(0.1)
            yield address, workers
        finally:
            for process in reversed(begun):
                process.kill()
                process.wait()


def swept(executor: Executor, axes: list[Axis], out: Path, kill: Any = None) -> tuple[list[Point], list[Edge]]:
    """Sweep, write the files, and print how long it took; `kill` is killed when a third of the points is done."""
    at, start = places(axes), time.perf_counter()

    def progress(done: int, total: int) -> None:
        if kill is not None and done == total // 3:
            kill.kill()

    found = sweep(SPEC, axes, executor, at=at, fixed=FIXED, simulated=False, refine=WIDTH, progress=progress)
    wall = time.perf_counter() - start
    write_sweep(out, axes, *found)
    draw_sweep(out / "sweep.png", "example", axes, *found)
    sys.stdout.write(f"{len(at):,} points and {len(found[1])} ends of proofs: {wall:.0f} s\n")
    sys.stdout.flush()
    return found


def holds(k2: float, d1: float) -> bool:
    """Whether (17) has a common P, by the formula."""
    return sqrt(K1 + k2) - sqrt(K1) < d1 + D2


def distances(axes: list[Axis], edges: list[Edge]) -> list[float]:
    """Return how far the curve is outside of what each end of the proofs by a common P is known to lie between."""
    found = []
    for edge in edges:
        if edge.inside.proof != PROVED:
            continue
        k2, d1 = edge.inside.values["k2"], edge.inside.values["d1"]
        curve = (K1**0.5 + d1 + D2) ** 2 - K1 if edge.name == "k2" else sqrt(K1 + k2) - sqrt(K1) - D2
        low, high = sorted((edge.inside.values[edge.name], edge.beyond.values[edge.name]))
        width = WIDTH * next(one.width for one in axes if one.name == edge.name)
        found.append(max(low - curve, curve - high, 0.0) / width)
    return found


def main(points: int) -> None:
    """Print what came out."""
    side = round(sqrt(points / 0.4))
    axes = [axis(f"k2=0.1:0.9:{side}"), axis(f"d1=0.1:0.35:{-(-points // side)}")]
    with tempfile.TemporaryDirectory() as name:
        here, there = Path(name) / "here", Path(name) / "there"
        with Pool(2, preload=PRELOAD) as pool:
            points_here, edges = swept(pool, axes, here)
        with dask_workers(2) as (address, workers), Cluster(address) as cluster:
            swept(cluster, axes, there, kill=workers[1])
        same = all((there / f.name).read_bytes() == f.read_bytes() for f in here.iterdir())
    wrong = [point for point in points_here if (point.proof == PROVED) != holds(point.values["k2"], point.values["d1"])]
    off = distances(axes, edges)
    sys.stdout.write(f"{len(points_here):,} points, {len(wrong)} on the wrong side of the curve\n")
    sys.stdout.write(f"{len(off)} ends; the curve is at most {max(off):.3g} widths outside of where they are\n")
    sys.stdout.write(f"the same to the last byte with a worker killed: {same}\n")


if __name__ == "__main__":
    for thread in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(thread, "1")
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
