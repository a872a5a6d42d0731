"""The terminal: consoles that print text as it is; refusals with exit codes, and as JSON and GitHub want them."""

import io
import json
import os
import re
import signal
import sys
import traceback
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NoReturn

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pwatrack.compilation import while_compiling
from pwatrack.errors import ExitCode, Place, Problem, PwatrackError
from pwatrack.interruption import ended_by
from pwatrack.remote_files import content
from pwatrack.report.codes import code_of

Style = Literal["text", "json", "github"]
STYLE: ContextVar[Style] = ContextVar("how refusals are said", default="text")

_MOST_LINES = 10  # of a refusal
_MOST_FAULTS = 20  # of a file: its writer wants to see them all
_LONGEST = 2_000  # characters of one message
_MESSAGE = str.maketrans({"%": "%25", "\r": "%0D", "\n": "%0A"})
_PROPERTY = _MESSAGE | str.maketrans({":": "%3A", ",": "%2C"})
_WIDEST = 100  # characters of a line that are shown
_LARGEST = 4 * 2**20  # bytes of a file that is looked into


@contextmanager
def refusals_as(style: Style) -> Iterator[None]:
    """Say refusals inside in this style, and as before when it ends."""
    before = STYLE.set(style)
    try:
        yield
    finally:
        STYLE.reset(before)


@contextmanager
def compiling(screen: Console, *, meant: bool = True) -> Iterator[None]:
    """Say on a console that the simulation is compiled, if that takes a while; not where refusals are for machines."""

    def say(kept: bool) -> None:
        left = "once: it is kept for later runs" if kept else "as in each run: no folder is writable that would keep it"
        screen.print(f"Compiling the simulation, {left}")

    with while_compiling(say) if meant and STYLE.get() == "text" else nullcontext():
        yield


def visible(text: str) -> str:
    r"""Return a text whose control and invisible characters are written out: a terminal obeys them otherwise.

    Example:
        >>> visible("gap\x1b[2J\u202e"), visible("z1 − z2\n")
        ('gap\\x1b[2J\\u202e', 'z1 − z2\n')
    """
    return "".join(
        c.encode("unicode_escape").decode()
        if c not in "\t\n" and unicodedata.category(c) in ("Cc", "Cf", "Zl", "Zp")
        else c
        for c in text
    )


class _Console(Console):
    """A console on which only its own styles reach the terminal, and no control character of a text."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text as it may be printed."""
        return super().render_str(visible(text), **options)


def console(*, stderr: bool = False) -> Console:
    """Return a console that reads no markup in names and never fails on a letter it cannot print."""
    stream = sys.stderr if stderr else sys.stdout
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="replace")
    return _Console(stderr=stderr, highlight=False, markup=False, emoji=False)


@contextmanager
def refusals() -> Iterator[None]:
    """End the program with the messages and the exit code of a refusal raised inside; no traceback.

    The code is 2 if stdout takes no more, 130 if the program is interrupted (143 by SIGTERM), 1 for other exceptions.
    """
    try:
        yield
    except KeyboardInterrupt:
        _end(128 + signal.SIGINT)
    except Exception as error:
        if (code := ended_by()) is not None:  # whatever was made of that
            _end(code)
        if isinstance(error, OSError) and error.filename is None:  # those of files are refusals by now
            _end(ExitCode.INVALID, f"error: cannot print: {error.strerror or error}")
        code, lines = told(error)
        _end(code, *lines)


def told(error: Exception) -> tuple[int, list[str]]:
    """Return the exit code of a program that ends with an exception, and what it says on stderr.

    Example:
        >>> told(PwatrackError("no proof"))
        (<ExitCode.BUG: 1>, ['error: no proof [P100]'])
    """
    if isinstance(error, PwatrackError):
        verdict, wrong = error.code.verdict, faults(error)
        if STYLE.get() == "json":
            notes = [note.strip() for note in getattr(error, "__notes__", ())]
            problems = [{"code": fault.code, **asdict(fault)} for fault in wrong]
            content = {"exit": int(error.code), "verdict": verdict, "problems": problems, "notes": notes}
            return error.code, [json.dumps(content)]
        if STYLE.get() == "github":
            return error.code, [annotated(f, title=verdict, file=f.place.file if f.place else "") for f in wrong]
        return error.code, [*refusal_lines(error), *getattr(error, "__notes__", ())]
    where = traceback.extract_tb(error.__traceback__)[-1]  # whatever else comes is a bug of ours
    place = f"{Path(where.filename).name}:{where.lineno}"
    what, hint = f"a bug in pwatrack: {type(error).__name__}: {error}", "please report it together with the spec"
    if isinstance(error, MemoryError):
        what = f"out of memory: {error or 'nothing more is to be had'}"
        hint = "fewer states, cells or samples, or more memory"
    return ExitCode.BUG, [f"error: {what} ({place}) [P100]", f"  hint: {hint}"]


def _end(code: int, *messages: str) -> NoReturn:
    """End the program with messages on stderr, if it takes them."""
    for stream, texts in ((sys.stdout, ()), (sys.stderr, messages)):
        try:
            for text in texts:
                console(stderr=True).print(text, soft_wrap=True)
            if stream is not None:
                stream.flush()
        except OSError:  # full: what still waits to be printed goes nowhere
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    raise SystemExit(int(code)) from None


def refusal_lines(error: PwatrackError) -> list[str]:
    """Return what a terminal shows of a refusal: about ten lines; `error` itself has the whole text.

    Example:
        >>> from pwatrack.errors import OutsideTheory
        >>> refusal_lines(OutsideTheory(*(f"cell {k} is wrong" for k in range(48)), hint="mend it"))[-3:]
        ['error: cell 8 is wrong [P300]', '  hint: mend it', "error: … and 39 more; 'check --json' lists them"]
    """
    shown = error.problems[:_MOST_FAULTS]
    if error.code is not ExitCode.INVALID:
        while len(shown) > 1 and len(_hints_last(shown, error.code)) > _MOST_LINES:
            shown = shown[:-1]
    hidden = len(error.problems) - len(shown)
    excerpts = error.code is ExitCode.INVALID or len(shown) == 1
    return _hints_last(shown, error.code, excerpts=excerpts) + (
        [f"error: … and {hidden:,} more; 'check --json' lists them"] if hidden else []
    )


def _hints_last(problems: Sequence[Problem], code: ExitCode, *, excerpts: bool = False) -> list[str]:
    """Return the messages of problems, with code, and each hint once, below the last in a row that have it."""
    lines = []
    for k, problem in enumerate(problems):
        message = (problem.short or problem.message).replace("\n", "\\n")  # no text of a file looks like a line of ours
        message = message if len(message) <= _LONGEST else f"{message[:_LONGEST]} …"
        lines.append(f"error: {problem.where}{message} [{code_of(problem.message, code)}]")
        if excerpts and problem.place:
            lines += excerpt(problem.place, message)
        if problem.hint and (k + 1 == len(problems) or problems[k + 1].hint != problem.hint):
            lines.append(f"  hint: {problem.hint}")
    return lines


@dataclass(frozen=True, kw_only=True)
class JobFault:
    """One thing that is wrong: what, its code, what helps, and where it stands if that is known."""

    message: str
    code: str = ""
    hint: str = ""
    place: Place | None = None

    @property
    def text(self) -> str:
        """What is wrong and what helps."""
        return self.message + (f"\nhint: {self.hint}" if self.hint else "")


def faults(error: PwatrackError) -> tuple[JobFault, ...]:
    """Return what is wrong, one by one."""
    return tuple(
        JobFault(message=p.message, code=code_of(p.message, error.code), hint=p.hint, place=p.place)
        for p in error.problems
    )


def excerpt(place: Place, message: str) -> list[str]:
    """Return the line of a file, if it is there, and a caret below what the message quotes or else the place."""
    try:
        path = Path(place.file)
        text = content(path, lambda: _bytes(path)).decode("utf-8")
        line = text.split("\n")[place.line - 1].rstrip("\r").expandtabs(1)
    except (OSError, ValueError, IndexError, PwatrackError):
        return []
    first, length = min(max(place.column - 1, 0), len(line)), 1
    quoted = re.search(r"'([^']{1,60})'", message)
    if quoted and (found := re.compile(rf"(?<!\w){re.escape(quoted[1])}(?!\w)").search(line, max(place.column - 1, 0))):
        first, length = found.start(), len(quoted[1])
    start = max(0, min(first - _WIDEST // 2, len(line) - _WIDEST))
    before, shown = "… " if start else "", line[start : start + _WIDEST]
    margin = f"{place.line:5} | "
    under = " " * cell_len(before + line[start:first]) + "^" + "~" * (cell_len(line[first : first + length]) - 1)
    return [margin + before + shown, " " * (len(margin) - 2) + "| " + under[: _WIDEST + 2]]


def _bytes(path: Path) -> bytes:
    if not path.is_file() or path.stat().st_size > _LARGEST:
        raise ValueError("it is not looked into")
    return path.read_bytes()


def annotated(fault: JobFault, *, title: str, file: str, said: Callable[[str], str] = str) -> str:
    r"""Return a workflow command of GitHub: it stands beside the line of a file. `said` is what a terminal may have.

    Example:
        >>> fault = JobFault(message="a\nb", code="1", place=Place(file="", line=3, column=1))
        >>> annotated(fault, title="no:", file="a,b.yaml")
        '::error file=a%2Cb.yaml,line=3,col=1,title=no%3A 1::a%0Ab'
    """
    place = f",line={fault.place.line},col={fault.place.column}" if fault.place else ""
    file, title = file.translate(_PROPERTY), f"{title} {fault.code}".rstrip().translate(_PROPERTY)
    return f"::error file={file}{place},title={title}::{said(fault.text).translate(_MESSAGE)}"


def print_rows(console: Console, title: str | None, rows: Iterable[tuple[str, str]]) -> None:
    """Print labels and sentences as a table."""
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0), title=title or None, title_justify="left")
    table.title_style = "bold"
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)
