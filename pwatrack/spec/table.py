"""Tables of samples: a text file with a header and columns -> a course."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pwatrack.arrays import Array, amount, readonly
from pwatrack.errors import InvalidSpec, Subject
from pwatrack.model.profile import Table, low_passed
from pwatrack.model.signal import LARGEST
from pwatrack.remote_files import content, regular
from pwatrack.spec.signal_section import TableSection
from pwatrack.spec.wording import guess

LARGEST_FILE = 50_000_000  # bytes
MOST_ROWS = 200_000  # each is a piece of the signal
FINEST = 1e-12  # of the time: rows that are closer are one time, but for rounding
_WIDE = (b"\xff\xfe", b"\xfe\xff")  # byte-order marks of UTF-16


@dataclass(frozen=True, kw_only=True)
class Folder:
    """Where the files are that a spec refers to, and whether others may be read too."""

    path: Path
    outside: bool = False


def read_table(folder: Folder, section: TableSection, subject: Subject) -> Table:
    """Return the course of a table: a text file with a header, a column of times and others.

    Raises InvalidSpec if it cannot be read, its times do not increase, or its filter does not fit them.
    """
    path = folder.path / section.file
    try:
        values = _values(content(path, lambda: table_content(path, folder)), section)
        _check(values)
        t, y = values.T
        if section.filter is not None:
            t, y = low_passed(t, y, section.filter.cutoff)
            if len(t) > MOST_ROWS:
                raise ValueError(
                    f"a cutoff of {section.filter.cutoff:g} Hz leaves {len(t):,} points, at most {MOST_ROWS:,}"
                )
    except (ValueError, OSError, csv.Error) as error:  # a path with a NUL is a ValueError too
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        shown = str(path).encode("unicode_escape").decode()
        raise InvalidSpec(f"table {shown}: {reason}", subject=subject) from None
    return Table(readonly(t), readonly(y), filtered=section.filter is not None)


def _values(text: bytes, section: TableSection) -> Array:
    """Return times in s and values, (K, 2)."""
    lines = _lines(text)
    header = next((line for line in lines if line.strip()), "")
    delimiter: str = section.delimiter or max(",;\t", key=header.count)  # the most frequent one
    rows = [
        [cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True) if row
    ]
    if len(rows) - 1 > MOST_ROWS:
        raise ValueError(f"{len(rows) - 1:,} rows, at most {MOST_ROWS:,} are read")
    names = rows[0] if rows else []
    column = section.column or next((name for name in names if name != section.time), "y")
    for name in (section.time, column):
        if name not in names:
            raise ValueError(f"the header has no column '{name}'; it has {_shown(names)}{guess(name, names)}")
        if names.count(name) > 1:
            raise ValueError(f"the header has two columns '{name}'")
    wanted = names.index(section.time), names.index(column)
    cells = [tuple(row[k] if k < len(row) else "" for k in wanted) for row in rows[1:]]
    marks = {mark for texts in cells for text in texts for mark in ",." if mark in text}
    commas = section.decimal == "," or (section.decimal is None and delimiter != "," and marks == {","})
    numbers = []
    for line, (texts, row) in enumerate(zip(cells, rows[1:], strict=True), start=2):
        if len(row) > len(names):
            raise ValueError(f"row {line} has {len(row)} entries, the header {len(names)}: decimal commas? {_ADVICE}")
        numbers.append(_numbers(texts, line, commas=commas))
    return np.array(numbers).reshape(-1, 2) * _scales(section.scale, section.time, column)


def table_content(path: Path, folder: Folder) -> bytes:
    """Return the bytes of a table."""
    if not folder.outside and not path.resolve().is_relative_to(folder.path.resolve()):  # wherever links lead
        raise ValueError("it is outside of the spec's folder, and is read with --allow-outside only")
    return regular(path, LARGEST_FILE)


def _lines(text: bytes) -> list[str]:
    wide = text.startswith(_WIDE)
    try:
        return text.decode("utf-16" if wide else "utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        kind = "UTF-16" if wide else "UTF-8"
        raise ValueError(f"not {kind} text: byte {text[error.start]:#04x} at position {error.start + 1}") from None


_ADVICE = "write points in numbers, or semicolons between columns"


def _shown(names: list[str]) -> str:
    """Return the names of columns, but not a whole line of some other file."""
    short = [name.encode("unicode_escape").decode()[:20] for name in names[:5]]
    return (", ".join(f"'{name}'" for name in short) + (", …" if len(names) > 5 else "")) or "none"


def _numbers(texts: Sequence[str], line: int, *, commas: bool) -> tuple[float, float]:
    """Return two numbers, whose decimals are behind commas or points."""
    written = [text.replace(",", ".") if commas and "." not in text else text for text in texts]
    try:
        if not any("_" in text or (commas and "." in text) for text in texts):
            return float(written[0]), float(written[1])
    except ValueError:
        pass
    shown = ", ".join(f"'{text.encode('unicode_escape').decode()[:30]}'" for text in texts)
    hint = ": write points in numbers, or 'decimal: \",\"'" if not commas and any("," in text for text in texts) else ""
    hint = ": decimals have a comma here" if commas and any("." in text for text in texts) else hint
    raise ValueError(f"row {line}: {shown} are no two numbers{hint}")


def _scales(scale: float | dict[str, float], time: str, column: str) -> Array:
    if not isinstance(scale, dict):
        scale = {time: scale}
    for name, value in scale.items():
        if name not in (time, column):
            raise ValueError(f"scale: '{name}' is not a column that is read: '{time}' and '{column}' are")
        if value == 0 or (name == time and value < 0):
            raise ValueError(f"scale: {value:g} makes no use of column '{name}'")
    return np.array([scale.get(time, 1.0), scale.get(column, 1.0)])


def _check(values: Array) -> None:
    t = values[:, 0]
    if len(values) < 4:
        raise ValueError(f"{amount(len(values), 'row')}, at least 4 are needed")
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
