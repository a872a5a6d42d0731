"""What is wrong, as others than a reader at a terminal want it: the line of a file with a caret, GitHub, JSON."""

import json
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.cells import cell_len

from pwatrack.errors import Place, PwatrackError
from pwatrack.remote_files import content
from pwatrack.report.codes import code_of

_MESSAGE = str.maketrans({"%": "%25", "\r": "%0D", "\n": "%0A"})
_PROPERTY = _MESSAGE | str.maketrans({":": "%3A", ",": "%2C"})
_WIDEST = 100  # characters of a line that are shown
_LARGEST = 4 * 2**20  # bytes of a file that is looked into


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
    codes = (code_of(problem.message, error.code) for problem in error.problems)
    both = zip(error.problems, codes, strict=True)
    return tuple(JobFault(message=p.message, code=code, hint=p.hint, place=p.place) for p, code in both)


def excerpt(place: Place, message: str) -> list[str]:
    """Return the line of a file, if it is there, and a caret below what the message quotes or else the place."""
    try:
        path = Path(place.file)
        text = content(path, lambda: _bytes(path)).decode("utf-8")
        line = text.split("\n")[place.line - 1].rstrip("\r").expandtabs(1)
    except (OSError, ValueError, IndexError, PwatrackError):
        return []
    first, length = _meant(line, place.column - 1, message)
    start = max(0, min(first - _WIDEST // 2, len(line) - _WIDEST))
    before, shown = "… " if start else "", line[start : start + _WIDEST]
    margin = f"{place.line:5} | "
    under = " " * cell_len(before + line[start:first]) + "^" + "~" * (cell_len(line[first : first + length]) - 1)
    return [margin + before + shown, " " * (len(margin) - 2) + "| " + under[: _WIDEST + 2]]


def _bytes(path: Path) -> bytes:
    if not path.is_file() or path.stat().st_size > _LARGEST:
        raise ValueError("it is not looked into")
    return path.read_bytes()


def _meant(line: str, first: int, message: str) -> tuple[int, int]:
    """Return where in a line that is what a message is about, and how long it is."""
    quoted = re.search(r"'([^']{1,60})'", message)
    if quoted and (found := re.compile(rf"(?<!\w){re.escape(quoted[1])}(?!\w)").search(line, max(first, 0))):
        return found.start(), len(quoted[1])
    return min(max(first, 0), len(line)), 1


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


def annotations(error: PwatrackError) -> list[str]:
    """Return a workflow command for each problem of a refusal."""
    verdict = error.code.verdict
    return [annotated(f, title=verdict, file=f.place.file if f.place else "") for f in faults(error)]


def as_json(error: PwatrackError) -> str:
    """Return a refusal as one line of JSON."""
    problems = [{"code": fault.code, **asdict(fault)} for fault in faults(error)]
    notes = [note.strip() for note in getattr(error, "__notes__", ())]
    return json.dumps({"exit": int(error.code), "verdict": error.code.verdict, "problems": problems, "notes": notes})
