"""The outcomes of a batch as one HTML page that needs nothing else: a table to sort and filter, with small pictures."""

import io
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from string import Template
from urllib.parse import quote

from pwatrack.batch.outcomes import FIGURES, SpecOutcome, counted
from pwatrack.report.page import document, escaped, image
from pwatrack.report.run_folder import PAGE, written_at_once

_TEXTS = ("spec", "result", "verdict")
_PICTURES = ("outputs.png", "tracking_error.png")
_WIDTH = 130  # of a small picture, in dots
_SPEC, _VERDICT = 10, 18  # rem: at least so wide are names of files, and what is said of a run, about 38 letters a line


def write_page(outcomes: Sequence[SpecOutcome], path: Path) -> None:
    """Write the page, what failed first; small pictures are in it; the page of a run and large ones are links."""
    required = any(outcome.required for outcome in outcomes)
    names = [*_TEXTS, *(["required"] if required else []), *FIGURES.values(), "time (s)"]
    ordered = sorted(outcomes, key=lambda outcome: not outcome.failed)
    kinds = sorted({_kind(outcome) for outcome in outcomes})
    body = Template(files("pwatrack.batch").joinpath("page.html").read_text(encoding="utf-8")).substitute(
        title=escaped(counted(outcomes)),
        width=_WIDTH,
        spec=_SPEC,
        verdict=_VERDICT,
        kinds="".join(f"<option>{kind}</option>" for kind in kinds),
        head="".join(map(_head, names)) + '<th class="pictures">pictures</th>',
        rows="\n".join(_row(outcome, path.parent, required=required) for outcome in ordered),
    )
    with written_at_once(path) as temporary:
        temporary.write_text(document(counted(outcomes), body), encoding="utf-8")


def _row(outcome: SpecOutcome, here: Path, *, required: bool) -> str:
    notes = [f'<div class="missed">missed: {escaped(text)}</div>' for text in outcome.missed]
    notes += [f'<div class="note">{escaped(note)}</div>' for note in outcome.notes]
    if outcome.failed and outcome.messages:
        notes.append(f"<details><summary>what it said</summary><pre>{escaped(outcome.messages)}</pre></details>")
    met = len(outcome.required) - len(outcome.missed)
    left = bool(outcome.figures)  # else what is in its folder is of an earlier run
    name = re.sub("([/_])", r"\1<wbr>", escaped(str(outcome.spec)))  # it may go on in the next line after each part
    cells = [
        f'<td class="spec">{_linked(name, outcome.folder / PAGE, here) if left else name}</td>',
        f'<td class="{_kind(outcome)}">{escaped(outcome.result)}</td>',
        f'<td class="verdict">{escaped(outcome.verdict)}{"".join(notes)}</td>',
    ]
    if required:
        share = met / len(outcome.required) if outcome.required else ""
        cells.append(_number("required", share, f"{met} of {len(outcome.required)}" if outcome.required else ""))
    for figure, name in FIGURES.items():
        value, unit = outcome.figures.get(figure, ""), outcome.unit if figure == "final_error" else ""
        cells.append(_number(name, value, f"{value:.3g} {escaped(unit)}".rstrip() if value != "" else ""))
    cells.append(_number("time (s)", outcome.seconds, f"{outcome.seconds:.1f}"))
    cells.append(f'<td class="pictures">{_pictures(outcome.folder, here) if left else ""}</td>')
    return f'<tr data-kind="{_kind(outcome)}">{"".join(cells)}</tr>'


def _head(name: str) -> str:
    numbers = "" if name in _TEXTS else ' class="n"'
    return f'<th{numbers}><button type="button">{escaped(name)}</button></th>'


def _kind(outcome: SpecOutcome) -> str:
    """Return what the page filters by."""
    return "fail" if outcome.failed else outcome.how if outcome.how != "run" else "pass"


def _number(name: str, value: object, text: str) -> str:
    return f'<td class="n" data-name="{name}" data-value="{value}">{text}</td>'


def _pictures(folder: Path, here: Path) -> str:
    parts = []
    for name in _PICTURES:
        with suppress(OSError):
            whole = folder / PAGE if (folder / PAGE).is_file() else folder / name
            parts.append(_linked(image(_small(folder / name), name), whole, here))
    return "".join(parts)


def _linked(shown: str, file: Path, here: Path) -> str:
    """Return HTML as a link to a file, if that is there."""
    link = quote(os.fsencode(os.path.relpath(file, here)))
    return f'<a href="{link}">{shown}</a>' if file.is_file() else shown


def _small(picture: Path) -> bytes:
    from PIL import Image

    with Image.open(picture) as image:
        image.thumbnail((_WIDTH, 4 * _WIDTH), reducing_gap=2.0)
        small = image.convert("RGB").quantize(32)
        content = io.BytesIO()
        small.save(content, format="PNG", optimize=True)
    return content.getvalue()
