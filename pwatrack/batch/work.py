"""What a batch asks of a worker, what comes back, and what is done with a spec, in whatever process, on any machine."""

import contextlib
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pwatrack.errors import ExitCode, PwatrackError
from pwatrack.report.run_folder import Left, Plots, read_index, stamp
from pwatrack.report.terminal import JobFault, faults, told


@dataclass(frozen=True, kw_only=True)
class Job:
    """One spec, its run folder, and what is to be done with it, as in `Options`."""

    spec: Path
    out: Path
    parameters: tuple[str, ...] = ()
    plots: Plots = "all"
    outside: bool = False


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How the run of a job ended by itself: its exit code, the one that the spec expects, and how long it took."""

    exit: int
    expected: int = 0
    messages: str = ""  # what the command line would say on stderr
    faults: tuple[JobFault, ...] = ()  # the same, one by one
    index: Mapping[str, Any] = field(default_factory=dict)  # its run.json; empty if it left none
    key: str = ""  # a digest of all that it depended on when it began
    inputs: tuple[str, ...] = ()  # the files that the spec refers to
    seconds: float = 0.0
    left: Left | None = None  # what it left, if that is not in its folder yet


Work = Callable[[Job], Ended]  # what is done with a job, in whatever process


def simulate(job: Job) -> Ended:
    """Design and simulate a spec and write its run folder; nothing is printed."""
    from pwatrack.commands.run import run
    from pwatrack.spec.load import expected_exit

    said = io.StringIO()
    code, lines, wrong = int(ExitCode.DONE), list[str](), tuple[JobFault, ...]()
    before = stamp(job.out)
    with contextlib.redirect_stderr(said):
        try:
            run(
                job.spec,
                job.out,
                job.parameters,
                None,
                simulated=True,
                plots=job.plots,
                shown="nothing",
                outside=job.outside,
            )
        except MemoryError:
            raise
        except Exception as error:
            code, lines, wrong = refused(error)
    index = (read_index(job.out) if stamp(job.out) != before else None) or {}
    return Ended(
        exit=code,
        expected=expected_exit(job.spec),
        messages="\n".join([*said.getvalue().splitlines(), *lines]),
        faults=wrong,
        index=index if index.get("exit") == code else {},
    )


def refused(error: Exception) -> tuple[int, list[str], tuple[JobFault, ...]]:
    """Return how a run ends with an exception: its exit code, what the command line says, and what is wrong."""
    code, lines = told(error)
    return int(code), lines, faults(error) if isinstance(error, PwatrackError) else ()
