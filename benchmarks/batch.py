"""Time batches: against a process for each spec, as it was before; small specs on one core and two; nothing changed.

    python -m benchmarks.batch [FOLDER]
    python -m benchmarks.batch --against PWATRACK [--rounds N] [FOLDER]

The second runs the batch of another version beside this one, on the specs that end alike in both. That version is an
executable: such as `bin/pwatrack` of a virtual environment in which an older commit is installed.

Prints seconds of wall time: run it on an idle machine.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from statistics import median

from pwatrack.batch.find import find_specs

SMALL = 500
OURS = (sys.executable, "-m", "pwatrack")


def timed(what: str, call: Callable[[], object]) -> float:
    """Print how long a call took, and what the command itself took of it without its workers; return the first."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    call()
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    own = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    sys.stdout.write(f"{what:48} {wall:7.1f} s   CPU of the command {own:5.1f} s\n")
    sys.stdout.flush()
    return wall


def pwatrack(*arguments: object, program: Sequence[str] = OURS) -> None:
    """Run the command line; that of another version where it finds nothing of this one."""
    command, here = [*program, *map(str, arguments)], Path.cwd()
    environment = {**os.environ, "PYTHONPATH": str(here)}
    if program is not OURS:
        here = Path(program[0]).parent
        del environment["PYTHONPATH"]
    subprocess.run(
        command, cwd=here, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False
    )


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
    import pwatrack.commands.run
    import pwatrack.report.plots.pictures
    import pwatrack.simulation.kernel  # noqa: F401
    from pwatrack.batch.cluster import done
    from pwatrack.batch.work import Job, simulate
    from pwatrack.claims.bounds import SignalBounds
    from pwatrack.spec.load import load_spec
    from pwatrack.workflow import pipeline

    own, whole = list[float](), list[float]()
    for k, spec in enumerate(sorted(small.iterdir())[:40]):
        read, start = load_spec(spec), time.process_time()
        controller = pipeline.design(read, growing=True)
        pipeline.simulate(read, controller)
        _ = controller.claim(SignalBounds).both
        own.append(time.process_time() - start)
        start = time.process_time()
        done(simulate, Job(spec=spec, out=out / str(k), plots="none"))
        whole.append(time.process_time() - start)
    beyond = median(w - o for w, o in zip(whole[1:], own[1:], strict=True))
    sys.stdout.write(f"CPU of a small spec: {1e3 * median(own):.0f} ms, and {1e3 * beyond:.1f} ms beyond that\n")


def against(other: str, folder: Path, rounds: int) -> None:
    """Print how long the batches of another version and of this one take, in turn, where both come to the same."""
    programs: dict[str, Sequence[str]] = {"the other version": (str(Path(other).resolve()),), "this version": OURS}
    with tempfile.TemporaryDirectory() as name:
        specs = Path(shutil.copytree(folder, Path(name) / "specs"))

        def ends(program: Sequence[str], out: Path) -> dict[str, str]:
            """Run a batch, and return how each spec ended."""
            pwatrack("batch", specs, "--jobs", 2, "--out", out, program=program)
            runs = [json.loads(file.read_text(encoding="utf-8")) for file in out.rglob("run.json")]
            return {str(Path(run["spec"]).relative_to(specs)): f"{run['verdict']}, exit {run['exit']}" for run in runs}

        theirs, ours = (ends(program, Path(name) / f"first {k}") for k, program in enumerate(programs.values()))
        for path in find_specs([specs]):
            spec = str(path.relative_to(specs))
            if theirs.get(spec) != ours.get(spec):
                said = f"{theirs.get(spec, 'nothing')}; here: {ours.get(spec, 'nothing')}"
                sys.stdout.write(f"left out: {spec}: {said}\n")
                path.unlink()
        both = {spec: end for spec, end in ours.items() if theirs.get(spec) == end}
        sys.stdout.write(f"{len(both)} specs that end alike\n")
        walls = dict[str, list[float]]()
        for k in range(rounds):
            for version, program in programs.items():
                out = Path(name) / f"{k} {version}"
                found = dict[str, str]()
                wall = timed(f"batch --jobs 2, {version}", lambda p=program, o=out, f=found: f.update(ends(p, o)))  # type: ignore[misc]
                walls.setdefault(version, []).append(wall)
                if found != both:
                    raise SystemExit(f"{version} came to something else: {found.items() ^ both.items()}")
        before, now = map(median, walls.values())
        sys.stdout.write(f"  {before / now:.2f} times as fast, in the median of {rounds}\n")


def _again(folder: Path, out: Path) -> None:
    pwatrack("batch", folder, "--jobs", 2, "--resume", "--out", out)


if __name__ == "__main__":
    for thread in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(thread, "1")
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", nargs="?", default="specs", type=Path)
    parser.add_argument("--against", metavar="PWATRACK", help="an executable of another version")
    parser.add_argument("--rounds", default=3, type=int, help="how often each of the two runs")
    given = parser.parse_args()
    if given.against:
        against(given.against, given.folder, given.rounds)
    else:
        main(given.folder)
