"""Time batches: against a process for each spec, as it was before; small specs on one core and two; nothing changed.

    python -m benchmarks.batch [FOLDER]

Prints seconds of wall time: run it on an idle machine.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from statistics import median

from pwatrack.batch.find import find_specs

SMALL = 500


def timed(what: str, call: Callable[[], object]) -> float:
    """Print how long a call took, and what the command itself took of it without its workers; return the first."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    call()
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    own = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    sys.stdout.write(f"{what:48} {wall:7.1f} s   CPU of the command {own:5.1f} s\n")
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
        short = text.replace("duration: 20", "duration: 1").replace("\nrequire:", "\n#")  # too short for it
        for k in range(SMALL):
            (small / f"{k}.yaml").write_text(short)
        options = ("--plots", "none", "--out")
        one = timed(f"{SMALL} small specs, one core", lambda: pwatrack("batch", small, *options, out / "3"))
        two = timed(f"{SMALL} small specs, two", lambda: pwatrack("batch", small, "--jobs", 2, *options, out / "4"))
        sys.stdout.write(f"  {one / two:.2f} times as fast\n")
        timed("again, nothing changed", lambda: pwatrack("batch", small, "--resume", *options, out / "4"))
        overhead(small, out / "5")


def overhead(small: Path, out: Path) -> None:
    """Print what a spec of a batch costs beyond its own design, with what the certificate proves, and simulation."""
    import pwatrack.batch.warm  # noqa: F401
    from pwatrack.batch.elsewhere import done
    from pwatrack.batch.job import Job
    from pwatrack.batch.work import simulate
    from pwatrack.spec.load import load_spec
    from pwatrack.study import pipeline

    own, whole = list[float](), list[float]()
    for k, spec in enumerate(sorted(small.iterdir())[:40]):
        read, start = load_spec(spec), time.process_time()
        controller = pipeline.design(read, growing=True)
        pipeline.simulate(read, controller)
        _ = controller.bounds, controller.starts
        own.append(time.process_time() - start)
        start = time.process_time()
        done(simulate, Job(spec=spec, out=out / str(k), plots="none"))
        whole.append(time.process_time() - start)
    beyond = median(w - o for w, o in zip(whole[1:], own[1:], strict=True))
    sys.stdout.write(f"CPU of a small spec: {1e3 * median(own):.0f} ms, and {1e3 * beyond:.1f} ms beyond that\n")


def _again(folder: Path, out: Path) -> None:
    pwatrack("batch", folder, "--jobs", 2, "--resume", "--out", out)


if __name__ == "__main__":
    for thread in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(thread, "1")
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "specs"))
