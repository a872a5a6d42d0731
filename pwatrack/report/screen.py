"""Ten lines of 80 columns: what comes first, what is cut, and what gives way to what. The long form is in `summary`."""

import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from rich.console import Console

from pwatrack.control.controller import Row
from pwatrack.report.run_folder import SUMMARY, kept_files, read_index
from pwatrack.report.terminal import visible

LINES, COLUMNS = 10, 80  # of the first screen
_LABEL = 12  # columns of what a row is about
_ORDER = {  # what comes first; the number says what gives way to what: the largest first
    "verdict": 0,  # which stands in the title
    "missed": 0,
    "simulated": 0,
    "plant": 1,
    "warning": 2,
    "question": 2,
    "remark": 8,
    "ensemble": 1,
    "required": 4,  # that all is met; what is not stands under "missed"
    "as sampled": 1,
    "ideal loop": 1,
    "largest box": 1,
    "NOT proved": 3,
    "input": 3,
    "margins": 6,
    "K, L": 7,
    "K, M": 7,
    "open loop": 4,
    "reference": 2,
    "sizes": 5,
    "files": 0,
}
_EACH = ("missed", "warning", "question", "remark", "open loop")  # a row for each; of other labels all is one sentence
_WHOLE = ("missed", "simulated", "warning", "question", "as sampled")  # the first two of each have two lines first
_WEIGHTY = 3  # what weighs so much has a line before anything has two: also what is NOT proved
_FIRST = 3  # of a label: more give way to the rest


def screen(name: str, rows: Iterable[Row], folder: Path | None = None) -> list[str]:
    """Return the lines of the first screen: the title, and at most nine more of what there is to say."""
    (_, verdict), *others = joined([*rows, *_files(folder)])
    room = COLUMNS - len(f": {verdict}")
    return [f"{textwrap.shorten(visible(name), room, placeholder=' …')}: {verdict}", *fitted(others, LINES - 1)]


def print_screen(console: Console, lines: Iterable[str]) -> None:
    """Print lines as they are, whatever the width of the terminal."""
    for line in lines:
        console.print(line, soft_wrap=True)


def joined(rows: Iterable[Row]) -> list[Row]:
    """Return rows in their order, those of a label in one, but for what stands by itself.

    Example:
        >>> joined([("K, L", "K = 1"), ("warning", "hot"), ("K, L", "L = 2"), ("warning", "late")])
        [('warning', 'hot'), ('warning', 'late'), ('K, L', 'K = 1; L = 2')]
    """
    found: dict[str, list[str]] = {label: [] for label in _ORDER}
    for label, text in rows:
        found[label].append(visible(text))
    return [
        (label, text)
        for label, texts in found.items()
        for text in (texts if label in _EACH else ["; ".join(texts)] if texts else [])
    ]


def fitted(rows: Sequence[Row], most: int) -> list[str]:
    """Return rows as so many lines at most: each has one, if need be cut; what is left goes to what weighs most.

    Example:
        >>> fitted([("simulated", "tracks"), ("margins", "gain 2"), ("files", "runs/a")], 2)
        ['simulated   tracks', 'files       runs/a']
    """
    seen, weighed, whole = dict[str, int](), list[tuple[int, int]](), list[bool]()
    for k, (label, _) in enumerate(rows):
        seen[label] = seen.get(label, 0) + 1
        weighed.append((_ORDER[label] + (max(_ORDER.values()) if seen[label] > _FIRST else 0), k))
        whole.append(label in _WHOLE and seen[label] < _FIRST)
    wanted, given, spare = [len(_wrapped(row, most)) for row in rows], [0] * len(rows), most
    ranked = [k for _, k in sorted(weighed)]
    first = [k for weight, k in sorted(weighed) if weight <= _WEIGHTY]
    for k, lines in (*((k, 1) for k in first), *((k, 1 + whole[k]) for k in ranked), *((k, most) for k in ranked)):
        more = min(spare, max(min(wanted[k], lines) - given[k], 0))
        given[k], spare = given[k] + more, spare - more
    return [line for k in range(len(rows)) if given[k] for line in _wrapped(rows[k], given[k])]


def _wrapped(row: Row, lines: int) -> list[str]:
    """Return a row in so many lines at most: of what has no room whole parts are left out, if the first one has."""
    label, text = row
    parts = text.split("; ")
    shorter = ["; ".join(parts[:count]) + "; …" for count in range(len(parts) - 1, 0, -1)]
    fits = (said for said in (text, *shorter) if len(_lines(label, said, None)) <= lines)
    return _lines(label, next(fits, text), lines)


def _lines(label: str, text: str, lines: int | None) -> list[str]:
    return textwrap.wrap(
        text,
        COLUMNS,
        initial_indent=label.ljust(_LABEL),
        subsequent_indent=" " * _LABEL,
        max_lines=lines,
        placeholder=" …",
        break_on_hyphens=False,
    ) or [label]


def _files(folder: Path | None) -> Iterator[Row]:
    """Yield where the files are, and which files of the user's were kept."""
    if folder is None:
        return
    count = len((read_index(folder) or {"files": ()})["files"])
    yield "files", f"{folder / SUMMARY!s} says all; {count} more files"
    if kept := kept_files(folder):
        yield "files", f"kept, as no run had left them so: {', '.join(kept)}"
