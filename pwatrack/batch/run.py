"""Many specs, each designed and simulated in a process of its own: one that crashes stops no other."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from pwatrack.errors import ExitCode, InvalidSpec
from pwatrack.spec.load import expected_exit

_GRACE = 5.0  # seconds that a process has to clean up


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How the run of one spec ended.

    Attributes:
        spec: The file.
        exit: Exit code of its process; negative if a signal ended it, None if it ran out of time.
        expected: Exit code that the spec expects.
        figures: From its run.json, empty if there is none.
        messages: What it said on stderr.
        seconds: How long it took.
    """

    spec: Path
    exit: int | None
    expected: int
    figures: Mapping[str, float]
    messages: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether it ended as expected."""
        return self.exit == self.expected

    @property
    def code(self) -> int:
        """What it contributes to the exit code of the batch."""
        if self.passed:
            return int(ExitCode.DONE)
        if self.exit is None:
            return int(ExitCode.CHECK_FAILED)
        if self.exit < 0:
            return int(ExitCode.BUG)
        return self.exit or int(ExitCode.CHECK_FAILED)

    @property
    def verdict(self) -> str:
        """The exit code in words."""
        if self.exit is None:
            return "out of time"
        return _VERDICTS.get(self.exit, f"killed by signal {-self.exit}" if self.exit < 0 else "crashed")


_VERDICTS = {
    0: "proved",
    1: "crashed",
    2: "invalid spec",
    3: "outside the theory",
    4: "proved infeasible",
    5: "undecided",
    6: "check failed",
}


def find_specs(folder: Path) -> list[Path]:
    """Return the specs below a folder in order.

    Raises:
        InvalidSpec: If there are none.
    """
    if not folder.is_dir():
        raise InvalidSpec(f"{folder} is no folder", hint="for one spec there is 'pwatrack simulate'")
    found = sorted(p for p in folder.rglob("*") if p.suffix in (".yaml", ".yml") and p.is_file())
    if not found:
        raise InvalidSpec(f"no .yaml file in {folder}", hint="name a folder that holds specs")
    return found


def run_batch(folder: Path, out: Path, *, jobs: int = 1, timeout: float = 600.0) -> list[Outcome]:
    """Design and simulate every spec below a folder.

    Args:
        folder: Where the specs are.
        out: Each spec gets a run folder in here, under its own path.
        jobs: How many run at a time.
        timeout: Seconds after which one is given up.

    Returns:
        One outcome per spec, in order of the paths.

    Raises:
        InvalidSpec: If the folder holds no spec.
    """
    specs = find_specs(folder)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("specs", total=len(specs))

        def one(spec: Path) -> Outcome:
            name = spec.relative_to(folder)
            alone = sum(other.with_suffix("") == spec.with_suffix("") for other in specs) == 1
            outcome = _run(spec, out / (name.with_suffix("") if alone else name), timeout)
            progress.advance(task)
            return outcome

        with ThreadPoolExecutor(jobs) as pool:
            return list(pool.map(one, specs))


def _run(spec: Path, out: Path, timeout: float) -> Outcome:
    start = time.perf_counter()
    command = [sys.executable, "-m", "pwatrack", "simulate", "--out", str(out), "--", str(spec)]
    code, messages = _call(command, timeout)
    return Outcome(
        spec=spec,
        exit=code,
        expected=expected_exit(spec),
        figures=_figures(out) if code == 0 else {},
        messages=messages,
        seconds=time.perf_counter() - start,
    )


def _call(command: Sequence[str], timeout: float) -> tuple[int | None, str]:
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, **one_thread},
    )
    try:
        _, messages = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.terminate()  # it removes what it has half-written
        try:
            process.communicate(timeout=_GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        return None, f"given up after {timeout:g} s"
    return process.returncode, messages.decode("utf-8", "replace").strip()


def _figures(out: Path) -> dict[str, float]:
    try:
        content: Any = json.loads((out / "run.json").read_text(encoding="utf-8"))
        return dict(content["figures"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
