"""Do verdicts hang on the last bits? BLAS kernels differ from processor to processor, and OPENBLAS_CORETYPE says which.

    .venv/bin/python -m benchmarks.processors [pairs]
    .venv/bin/python -m benchmarks.processors --tests [kinds] [--seed SEED]

By default random pairs (n, apart): one input moves n modes that grow nearly alike, 1, 1 + apart, 1 + 2 apart, …; a
verdict on each under every core type that this machine can run, in a process each, and those that differ. With --tests
the numerical part of the tests under further core types, all or so many of them, and for a generic processor as far as
Numba goes, in a random order each.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from pwatrack.control.synthesis import gain
from pwatrack.control.task import Task
from pwatrack.errors import PwatrackError
from tests.conftest import NUMERICAL

CORES = ("Haswell", "Zen", "SkylakeX", "Prescott", "Nehalem", "Sandybridge", "ARMV8", "NEOVERSEN1")
_SEED = 25  # of the pairs
_LONGEST = 900.0  # s that the verdicts of a core type may take
_ASKED = """
import json, numpy, scipy.linalg, threadpoolctl
A = numpy.random.default_rng(0).normal(size=(64, 64))
numpy.linalg.eigvals(A @ A), scipy.linalg.expm(A)
pools = threadpoolctl.threadpool_info()
print(json.dumps(sorted({str(pool.get("architecture", pool["internal_api"])) for pool in pools})))
"""


def environment(core: str | None) -> dict[str, str]:
    """Return that of a process with the kernels of a core type; None for those that this machine takes itself."""
    further = {} if core is None else {"OPENBLAS_CORETYPE": core, "NUMBA_CPU_NAME": "generic"}
    return {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **further}


def kernels(core: str | None) -> tuple[str, ...] | None:
    """Return what the libraries of linear algebra say that they run under a core type; None where they cannot."""
    command = [sys.executable, "-c", _ASKED]
    found = subprocess.run(command, env=environment(core), capture_output=True, text=True, check=False)
    return tuple(json.loads(found.stdout)) if found.returncode == 0 else None


def further(console: Console | None = None) -> list[str]:
    """Return core types that this machine can run, each with kernels of its own, and say why others are left out."""
    seen, taken = {kernels(None): "this machine's own"}, list[str]()
    for core in CORES:
        found = kernels(core)
        if found is None:
            reason = "this machine cannot run it"
        elif found in seen:
            reason = f"the same kernels as {seen[found]}"
        else:
            seen[found], reason = core, ""
            taken.append(core)
        if console is not None and reason:
            console.print(f"{core} is left out: {reason}")
    return taken


def drawn(count: int) -> list[tuple[int, float]]:
    """Return so many random pairs (n, apart)."""
    random = np.random.default_rng(_SEED)
    return [(int(random.integers(2, 9)), round(float(10.0 ** random.uniform(-2, 0.3)), 4)) for _ in range(count)]


def verdict(n: int, apart: float) -> str:
    """Return what is said of a pair."""
    task = Task(A=np.diag(1 + apart * np.arange(n))[None], B=np.ones((n, 1)), cells=["all"])
    try:
        gain(task)
    except PwatrackError as refusal:
        return type(refusal).__name__.lower()
    return "proved"


def verdicts(core: str | None, pairs: Sequence[tuple[int, float]]) -> list[str]:
    """Return what a process under a core type says of each pair; a word for those that it does not get to."""
    script = "import sys, json; from benchmarks.processors import verdict\n"
    script += "for n, apart in json.load(sys.stdin): print(verdict(n, apart), flush=True)"
    try:
        found = subprocess.run(
            [sys.executable, "-c", script],
            env=environment(core),
            input=json.dumps(pairs),
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            timeout=_LONGEST,
            cwd=Path(__file__).parent.parent,
        ).stdout
    except subprocess.TimeoutExpired as stopped:
        found = (stopped.stdout or b"").decode()
    said = found.split()
    return [*said, *["not reached"] * (len(pairs) - len(said))]


def compare(console: Console, count: int) -> int:
    """Print the verdicts on random pairs that differ from one core type to another; return how many there are."""
    pairs, found = drawn(count), dict[str, list[str]]()
    for core in (None, *further(console)):
        begun, name = time.perf_counter(), core or "this machine's own"
        found[name] = verdicts(core, pairs)
        counts = ", ".join(f"{found[name].count(word)} {word}" for word in sorted(set(found[name])))
        console.print(f"{name}: {counts}, {time.perf_counter() - begun:.0f} s")
    differing = 0
    for (n, apart), *said in zip(pairs, *found.values(), strict=True):
        if len(set(said) - {"not reached"}) > 1:  # out of time is no verdict
            differing += 1
            each = ", ".join(f"{name} {word}" for name, word in zip(found, said, strict=True))
            console.print(f"({n}, {apart:g}) differs: {each}")
    console.print(f"{count} pairs, {len(found)} kinds of kernels, {differing} verdicts that differ")
    return differing


def test(console: Console, most: int, seed: int) -> int:
    """Run the numerical part of the tests under further core types, and return how many of them fail."""
    chosen, failed = further(console)[: most or None], 0
    files = sorted(str(path) for path in Path("tests").glob("test_*.py") if NUMERICAL.fullmatch(path.name))
    for core in chosen:
        command = ["-m", "pytest", "-q", "-n", "auto", "--shuffle", str(seed), *files]
        console.print(f"{core}, for a generic processor, in the order of seed {seed}", highlight=False)
        failed += subprocess.run([sys.executable, *command], env=environment(core), check=False).returncode != 0
    console.print(f"ran under {', '.join(chosen) or 'no further core type'}; {failed} failed")
    return failed


def main() -> None:
    """Compare verdicts, or run tests."""
    parser = argparse.ArgumentParser()
    parser.add_argument("pairs", type=int, nargs="?", default=200)
    parser.add_argument("--tests", type=int, nargs="?", const=0, metavar="KINDS")
    parser.add_argument("--seed", type=int, default=_SEED)
    asked, console = parser.parse_args(), Console()
    failed = compare(console, asked.pairs) if asked.tests is None else test(console, asked.tests, asked.seed)
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
