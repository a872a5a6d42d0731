"""Many specs, each designed and simulated in a process of its own: one that crashes stops no other."""

import json
import os
import subprocess
import sys
import threading
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

_LARGEST = 1e300  # of a figure that is shown
_GRACE = 5.0  # seconds that a process has to clean up


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How the run of one spec ended.

    Attributes:
        spec: The file.
        exit: Exit code of its process; negative if a signal ended it, None if it ran out of time.
        expected: Exit code that the spec expects.
        figures: From its run.json, empty if this run left none.
        notes: The remarks of the run, and what its simulation came to if that is not that it tracks.
        required: Each requirement with what came out, and whether it is met.
        messages: What it said on stderr.
        seconds: How long it took.
    """

    spec: Path
    exit: int | None
    expected: int
    figures: Mapping[str, float]
    notes: tuple[str, ...]
    required: tuple[tuple[str, bool], ...]
    messages: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether it ended as expected."""
        return self.exit == self.expected

    @property
    def missed(self) -> tuple[str, ...]:
        """The requirements that are not met, with what came out."""
        return tuple(text for text, met in self.required if not met)

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
        if self.exit < 0:
            return f"killed by signal {-self.exit}"
        return ExitCode(self.exit).verdict if self.exit in list(ExitCode) else "crashed"


def find_specs(folder: Path) -> list[Path]:
    """Return the specs below a folder in order.

    Raises:
        InvalidSpec: If there are none.
    """
    if not folder.is_dir():
        raise InvalidSpec(f"{folder} is no folder", hint="for one spec there is 'pwatrack simulate'")
    found = sorted(path for path in _named_like_specs(folder) if path.is_file())
    if not found:
        raise InvalidSpec(f"no .yaml file in {folder}", hint="name a folder that holds specs")
    return found


def left_out(folder: Path) -> list[tuple[Path, str]]:
    """Return what is named like a spec below a folder and is none, in order, with the reason."""
    return [
        (path, "no file of this name is where the link leads" if path.is_symlink() and not path.exists() else "no file")
        for path in sorted(_named_like_specs(folder))
        if not path.is_file() and not path.is_dir()
    ]


def run_name(spec: Path) -> str:
    """Return the name of a spec's run folder: that of the file without its ending, unless only dots are left.

    Example:
        >>> run_name(Path("specs/cart.yaml")), run_name(Path("..yaml"))
        ('cart', '..yaml')
    """
    return spec.stem if spec.stem.strip(".") else spec.name


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
            alone = sum(other.with_name(run_name(other)) == spec.with_name(run_name(spec)) for other in specs) == 1
            folder_of = spec.relative_to(folder).with_name(run_name(spec) if alone else spec.name)
            outcome = _run(spec, out / folder_of, timeout)
            progress.advance(task)
            return outcome

        with ThreadPoolExecutor(jobs) as pool:
            return list(pool.map(one, specs))


def _run(spec: Path, out: Path, timeout: float) -> Outcome:
    start = time.perf_counter()
    command = [sys.executable, "-m", "pwatrack", "simulate", "--out", str(out), "--", str(spec)]
    code, messages = called(command, timeout)
    index = _index(out, code)
    return Outcome(
        spec=spec,
        exit=code,
        expected=expected_exit(spec),
        figures=_figures(index),
        notes=_notes(index),
        required=_required(index),
        messages=messages,
        seconds=time.perf_counter() - start,
    )


def called(command: Sequence[str], timeout: float) -> tuple[int | None, str]:
    """Return the exit code of a command, None if it took longer than `timeout` (s), and what it said on stderr."""
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, **one_thread},
    )
    try:
        _, messages = process.communicate(timeout=timeout if timeout < threading.TIMEOUT_MAX else None)
    except subprocess.TimeoutExpired:
        process.terminate()  # it removes what it has half-written
        try:
            process.communicate(timeout=_GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        return None, f"given up after {timeout:g} s"
    return process.returncode, messages.decode("utf-8", "replace").strip()


def _named_like_specs(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.suffix.lower() in (".yaml", ".yml")]


def _index(out: Path, code: int | None) -> dict[str, Any]:
    """Return the run.json of a run that ended with this code; nothing if what is there is of another run."""
    try:
        content: Any = json.loads((out / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) and code is not None and content.get("exit") == code else {}


def _figures(index: Mapping[str, Any]) -> dict[str, float]:
    figures = index.get("figures")
    return {
        name: value
        for name, value in (figures.items() if isinstance(figures, dict) else ())
        if isinstance(value, float | int) and not isinstance(value, bool) and abs(value) < _LARGEST
    }


def _required(index: Mapping[str, Any]) -> tuple[tuple[str, bool], ...]:
    found = index.get("requirements")
    entries = [entry for entry in (found if isinstance(found, list) else []) if isinstance(entry, dict)]
    return tuple((entry["said"], entry.get("met") is True) for entry in entries if isinstance(entry.get("said"), str))


def _notes(index: Mapping[str, Any]) -> tuple[str, ...]:
    simulation, remarks = index.get("simulation"), index.get("remarks")
    ended = isinstance(simulation, dict) and simulation.get("outcome") != "tracks"
    said = [simulation.get("said")] if isinstance(simulation, dict) and ended else []
    return tuple(note for note in said + (remarks if isinstance(remarks, list) else []) if isinstance(note, str))
