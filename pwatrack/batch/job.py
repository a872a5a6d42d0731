"""What a batch asks of a worker, and what comes back; both are whole, wherever the worker is."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pwatrack.errors import Place
from pwatrack.report.run_folder import Left, Plots


@dataclass(frozen=True, kw_only=True)
class Job:
    """One spec and what is to be done with it.

    Attributes:
        spec: The file.
        out: Its run folder.
        parameters: Replacements as NAME=VALUE.
        plots: Of which runs pictures are drawn.
        outside: Whether the spec may refer to files outside of its folder.
    """

    spec: Path
    out: Path
    parameters: tuple[str, ...] = ()
    plots: Plots = "all"
    outside: bool = False


@dataclass(frozen=True, kw_only=True)
class JobFault:
    """One thing that is wrong: what, its code, what helps, and where it stands if that is known."""

    message: str
    code: str = ""
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
    faults: tuple[JobFault, ...] = ()
    index: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Done:
    """A job that has ended by itself.

    Attributes:
        ended: How.
        key, inputs: What it depended on when it began, as a digest, and the files that the spec refers to.
        seconds: How long it took.
        left: What it left, if that is not in its folder yet.
    """

    ended: Ended
    key: str
    inputs: tuple[str, ...]
    seconds: float
    left: Left | None = None
