"""A command in a process of its own, with limits on its time and memory; and tables of what came of many."""

import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_GIB = 2**30
_WAIT = 10  # times its time of processor that a command may take on a busy machine


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a command ended.

    Attributes:
        code: Its exit code, negative where a signal ended it.
        stopped: Whether it was ended because its time was over.
        seconds: Time of processor.
        mebibytes: The most memory that it held.
        text: What it printed.
    """

    code: int
    stopped: bool
    seconds: float
    mebibytes: float
    text: str


def run(command: Sequence[str], *, seconds: float, gibibytes: float) -> Ended:
    """Run a command for so many seconds of processor at most, within so much memory; it is ended beyond that.

    It is ended, too, where it takes many times as long because others have the processor.
    """
    held, most = round(gibibytes * _GIB), max(1, round(seconds))

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (held, held))
        resource.setrlimit(resource.RLIMIT_CPU, (most, most + 5))

    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdout=said, stderr=said, preexec_fn=limited)
        over = threading.Event()

        def end() -> None:
            over.set()
            process.kill()

        clock = threading.Timer(_WAIT * seconds, end)
        clock.start()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        clock.cancel()
        said.seek(0)
        text = said.read().decode(errors="replace")
    took = used.ru_utime + used.ru_stime
    code = process.returncode
    stopped = over.is_set() or code == -signal.SIGXCPU
    return Ended(code=code, stopped=stopped, seconds=took, mebibytes=used.ru_maxrss / 1024, text=text)


def pwatrack(*arguments: str) -> list[str]:
    """Return the command line of pwatrack with these arguments."""
    return [sys.executable, "-m", "pwatrack", *arguments]


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as Markdown has it, with columns of one width.

    Example:
        >>> print(table("Sizes", ["plant", "n"], [["a", "5"]]), end="")
        **Sizes**
        <BLANKLINE>
        | plant | n |
        |-------|---|
        | a     | 5 |
    """
    widths = [max(len(row[k]) for row in (columns, *rows)) for k in range(len(columns))]
    lines = ["| " + " | ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)) + " |" for row in rows]
    head = "| " + " | ".join(text.ljust(w) for text, w in zip(columns, widths, strict=True)) + " |"
    rule = "|" + "|".join("-" * (w + 2) for w in widths) + "|"
    return "\n".join([f"**{title}**", "", head, rule, *lines, ""])


def machine() -> str:
    """Return the kind of machine that this is: its processor and how many of its cores may be used."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text(encoding="utf-8").splitlines() if known.exists() else []
    model = next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "processor unknown"
    )
    return f"{model}, {os.cpu_count()} cores, one thread each"
