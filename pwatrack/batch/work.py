"""What a batch does with one spec, in whatever process: design, simulate, write; nothing is printed."""

import contextlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pwatrack.errors import ExitCode, Place, PwatrackError
from pwatrack.report.files import Plots
from pwatrack.report.run_folder import read_index
from pwatrack.report.session import run
from pwatrack.report.terminal import told
from pwatrack.spec.load import expected_exit


@dataclass(frozen=True, kw_only=True)
class Job:
    """One spec and what is to be done with it.

    Attributes:
        spec: The file.
        out: Its run folder.
        parameters: Replacements as NAME=VALUE.
        plots: Of which runs pictures are drawn.
    """

    spec: Path
    out: Path
    parameters: tuple[str, ...] = ()
    plots: Plots = "all"


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One thing that is wrong: what, what helps, and where it stands if that is known."""

    message: str
    hint: str = ""
    place: Place | None = None


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How the run of a job ended.

    Attributes:
        exit: Its exit code.
        expected: The one that the spec expects.
        messages: What the command line would say on stderr.
        faults: The same, one by one.
        index: Its run.json; empty if it left none.
    """

    exit: int
    expected: int = 0
    messages: str = ""
    faults: tuple[Fault, ...] = ()
    index: Mapping[str, Any] = field(default_factory=dict)


def simulate(job: Job) -> Ended:
    """Design and simulate a spec and write its run folder."""
    said = io.StringIO()
    faults: tuple[Fault, ...] = ()
    code, lines = int(ExitCode.DONE), list[str]()
    with contextlib.redirect_stderr(said):
        try:
            run(job.spec, job.out, job.parameters, None, simulated=True, plots=job.plots, printed=False)
        except MemoryError:
            raise
        except Exception as error:
            code, lines = told(error)
            problems = error.problems if isinstance(error, PwatrackError) else ()
            faults = tuple(Fault(message=p.message, hint=p.hint, place=p.place) for p in problems)
    index = read_index(job.out) or {}
    return Ended(
        exit=code,
        expected=expected_exit(job.spec),
        messages="\n".join([*said.getvalue().splitlines(), *lines]),
        faults=faults,
        index=index if index.get("exit") == code else {},
    )
