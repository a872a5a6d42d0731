"""Tables of samples: a CSV file with a header -> a course."""

import csv
import stat
from pathlib import Path

import numpy as np

from pwatrack.arrays import Array, readonly
from pwatrack.causes import Subject
from pwatrack.errors import InvalidSpec, Problem
from pwatrack.model.course import Table
from pwatrack.model.signal import LARGEST

LARGEST_FILE = 50_000_000  # bytes
MOST_ROWS = 200_000  # each is a piece of the signal
FINEST = 1e-12  # of the time: times that are closer are one time, but for rounding


def read_table(path: Path, column: str | None, subject: Subject) -> Table:
    """Return the course of a table.

    Args:
        path: A CSV file with a header, a column t (s) and others; a byte-order mark at its start is no part of it.
        column: Which one; None for the first beside t.
        subject: Where the file is named.

    Raises:
        InvalidSpec: If it cannot be read, or its times do not increase.
    """
    try:
        rows = _rows(path)
        names = rows[0] if rows else []
        column = column or next((name for name in names if name != "t"), "y")
        for name in ("t", column):
            if name not in names:
                raise ValueError(f"the header has no column '{name}'; it has {_shown(names)}{_hint(names, rows)}")
            if names.count(name) > 1:
                raise ValueError(f"the header has two columns '{name}'")
        wanted = names.index("t"), names.index(column)
        values = np.array([_numbers(row, wanted, k, names) for k, row in enumerate(rows[1:], start=2)]).reshape(-1, 2)
        _check(values)
    except (ValueError, OSError, csv.Error) as error:  # a path with a NUL is a ValueError too
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        shown = str(path).encode("unicode_escape").decode()
        raise InvalidSpec(Problem(message=f"table {shown}: {reason}", subject=subject)) from None
    return Table(readonly(values[:, 0]), readonly(values[:, 1]))


def _rows(path: Path) -> list[list[str]]:
    """Return the cells of the file; only a regular one is opened, and no more is read than is taken."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise ValueError("not a regular file")
    with path.open("rb") as file:
        content = file.read(LARGEST_FILE + 1)
    if len(content) > LARGEST_FILE:
        raise ValueError(f"more than {LARGEST_FILE:,} bytes, which is the most that is read")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 text: byte {content[error.start]:#04x} at position {error.start + 1}") from None
    rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), skipinitialspace=True) if row]
    if len(rows) - 1 > MOST_ROWS:
        raise ValueError(f"{len(rows) - 1:,} rows, at most {MOST_ROWS:,} are read")
    return rows


def _shown(names: list[str]) -> str:
    """Return the names of columns, but not a whole line of some other file."""
    short = [name.encode("unicode_escape").decode()[:20] for name in names[:5]]
    return (", ".join(f"'{name}'" for name in short) + (", …" if len(names) > 5 else "")) or "none"


def _hint(names: list[str], rows: list[list[str]]) -> str:
    """Say what else the file seems to be written with."""
    for mark, what in ((";", "semicolons"), ("\t", "tabs")):
        if any(mark in name for name in names):
            decimal = (
                any("," in cell for cell in next(csv.reader([",".join(rows[1])], delimiter=mark))) if rows[1:] else 0
            )
            more = ", and decimal commas" if decimal and mark == ";" else ""
            return f"; it is written with {what}{more}: write commas between columns and points in numbers"
    return ""


def _numbers(row: list[str], wanted: tuple[int, int], line: int, names: list[str]) -> tuple[float, float]:
    texts = [row[k] if k < len(row) else "" for k in wanted]
    try:
        if len(row) <= len(names) and not any("_" in text for text in texts):
            return float(texts[0]), float(texts[1])
    except ValueError:
        pass
    if len(row) > len(names):
        raise ValueError(
            f"row {line} has {len(row)} entries, the header {len(names)}: decimal commas? write points in numbers"
        )
    shown = ", ".join(f"'{text.encode('unicode_escape').decode()[:30]}'" for text in texts)
    comma = ": write points in numbers, not commas" if any("," in text for text in texts) else ""
    raise ValueError(f"row {line}: {shown} are no two numbers{comma}")


def _check(values: Array) -> None:
    t = values[:, 0]
    if len(values) < 4:
        raise ValueError(f"{len(values)} rows, at least 4 are needed")
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        raise ValueError(f"row {int(np.argmin(finite)) + 2} is not finite")
    large = np.abs(values).max(axis=1) > LARGEST
    if large.any():
        raise ValueError(f"row {int(np.argmax(large)) + 2} has a number beyond {LARGEST:g}")
    close = np.diff(t) <= FINEST * np.abs(t).max()
    if close.any():
        k = int(np.argmax(close))
        gap = t[k + 1] - t[k]
        far = "" if gap <= 0 else f" enough: {gap:.3g} s, at least {FINEST * np.abs(t).max():.1g} s are told apart"
        raise ValueError(f"t does not increase{far} at row {k + 3}")
    if t[0] > 0:
        raise ValueError(f"t starts at {t[0]:g} s, after 0")
