"""Time batches: against a process for each spec, as it was before; small specs on one core and two; nothing changed.

    python -m benchmarks.batch [FOLDER]

Prints seconds of wall time: run it on an idle machine.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path

from pwatrack.batch.find import find_specs

SMALL = 500


def timed(what: str, call: Callable[[], object]) -> float:
    """Print how long a call took, and return it."""
    start = time.perf_counter()
    call()
    wall = time.perf_counter() - start
    sys.stdout.write(f"{what:48} {wall:7.1f} s\n")
    sys.stdout.flush()
    return wall


def pwatrack(*arguments: object) -> None:
    """Run the command line."""
    command = [sys.executable, "-m", "pwatrack", *map(str, arguments)]
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)


def separately(specs: Path, out: Path) -> None:
    """Run each spec in a process of its own, two at a time."""
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda item: pwatrack("simulate", item[0], "--out", out / item[1]), find_specs([specs]).items()))


def main(folder: Path) -> None:
    """Print all times."""
    with tempfile.TemporaryDirectory() as name:
        out, small = Path(name) / "out", Path(name) / "small"
        once = timed("a process for each spec, two at a time", lambda: separately(folder, out / "1"))
        now = timed("batch --jobs 2", lambda: pwatrack("batch", folder, "--jobs", 2, "--out", out / "2"))
        timed("batch --jobs 2 --resume, nothing changed", lambda: _again(folder, out / "2"))
        sys.stdout.write(f"  {once / now:.1f} times as fast\n")
        small.mkdir()
        text = files("pwatrack.starters").joinpath("output.yaml").read_text(encoding="utf-8")
        for k in range(SMALL):
            (small / f"{k}.yaml").write_text(text.replace("duration: 20", "duration: 1"))
        options = ("--plots", "none", "--out")
        one = timed(f"{SMALL} small specs, one core", lambda: pwatrack("batch", small, *options, out / "3"))
        two = timed(f"{SMALL} small specs, two", lambda: pwatrack("batch", small, "--jobs", 2, *options, out / "4"))
        sys.stdout.write(f"  {one / two:.2f} times as fast\n")
        timed("again, nothing changed", lambda: pwatrack("batch", small, "--resume", *options, out / "4"))


def _again(folder: Path, out: Path) -> None:
    pwatrack("batch", folder, "--jobs", 2, "--resume", "--out", out)


if __name__ == "__main__":
    for thread in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(thread, "1")
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "specs"))
