"""Pages in HTML that need nothing else; that of a run: first screen, pictures, cells, and each claim with its check."""

import base64
import html
import json
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import Any
from urllib.parse import quote

from pwatrack.control.controller import Row
from pwatrack.report.figures import percent
from pwatrack.report.kept_spec import spec_text
from pwatrack.report.run_folder import SUMMARY, json_text
from pwatrack.report.screen import Findings, first_rows, joined
from pwatrack.report.stays import Stay, stays
from pwatrack.report.terminal import visible
from pwatrack.version import __version__

_FIRST = ("outputs", "tracking_error", "input", "ensemble")  # of the pictures; then by name
_WIDTH, _LEAST = 1000, 0.5  # dots of a row of bars, and of a bar
_MOST = 20_000  # characters of the numbers of a claim, and of a spec, that are in the page: the files have all
_CHECK = (
    "To check it: <code>pwatrack verify</code> with the folder of this run decides it again from certificate.json, "
    "{keys}; so does <code>python audit certificate.json</code>, a copy of the folder pwatrack/lmi/audit alone."
)
_PLAIN = " <>=:/;,.()'!?-_@+*[]{}"  # letters that may stand in the address of a picture as they are


def page(found: Findings, pictures: Mapping[str, str], *, certificate: str, summary: str | None = None) -> str:
    """Return the page of a run, which needs no other file and no network; pictures are SVG files by name."""
    spec, result = found.spec, found.result
    assert result is not None
    changed = "".join(f"<p>with {escaped(f'{name} = {value}')}</p>" for name, value in spec.overrides.items())
    text = spec_text(spec)
    said = "it is not there any more as it was read" if text is None else _cut(text.decode())
    title, ordered = spec.name, [*_FIRST, *sorted(pictures.keys() - {*_FIRST})]
    body = Template(files("pwatrack.report").joinpath("page.html").read_text(encoding="utf-8")).substitute(
        title=escaped(title),
        screen=_rows(joined(first_rows(found))),
        pictures="".join(_picture(name, pictures[name]) for name in ordered if name in pictures),
        cells="".join(_part(part, rows, result.end) for part, rows in stays(result, _WIDTH)),
        claims="".join(_claims(found, json.loads(certificate))) + _unfolds(f"All of {SUMMARY}", summary or ""),
        spec=f"{changed}<pre>{escaped(said)}</pre>",
    )
    return document(title, body)


def _rows(rows: Sequence[Row]) -> str:
    """Return labels and sentences; what is missed or warned of is marked."""
    marked = dict.fromkeys(("missed", "warning", "question"), ' class="warning"')
    return "".join(f"<dt>{escaped(one)}</dt><dd{marked.get(one, '')}>{escaped(text)}</dd>" for one, text in rows)


def _picture(file: str, svg: str) -> str:
    name = file.replace("_", " ")
    return f'<figure><button type="button">{image(svg, name)}</button><figcaption>{escaped(name)}</figcaption></figure>'


def _part(part: str, rows: Sequence[Stay], end: float) -> str:
    """Return the cells of a part of the loop up to a time (s): name, share of the time, and a row of bars."""
    found = [f'<h3>{escaped(part)}</h3><table class="time">']
    for row in rows:
        bars = "".join(
            f"M{_WIDTH * t / end:.1f} 0h{wide:.1f}v1h-{wide:.1f}z"
            for t, length in row.bars
            for wide in [max(_WIDTH * length / end, _LEAST)]
        )
        drawn = f'<svg viewBox="0 0 {_WIDTH} 1" preserveAspectRatio="none"><path d="{bars}"/></svg>'
        found.append(f'<tr><th>{escaped(row.name)}</th><td class="n">{percent(row.share)}</td><td>{drawn}</td></tr>')
    ends = f"<span>0 s</span><span>{end:g} s</span>"
    return "".join([*found, f'<tr><th></th><td></td><td><div class="note ends">{ends}</div></td></tr></table>'])


def _claims(found: Findings, certificate: Mapping[str, Any]) -> Iterator[str]:
    """Yield each claim: in a line what it is, unfolded what it says, its statement, its numbers and how to check it."""
    words, controller = found.spec.words, found.controller
    for claim in controller.claims:
        rows = list(claim.rows(words, controller))
        keys = [key for key in claim.nothing if certificate.get(key)]
        if not rows and not keys:
            continue
        parts = [f"<dl>{_rows(rows)}</dl>"]
        if keys:  # else it says why it is not proved
            parts.append(f"<p>Statement: {escaped(claim.statement)}</p>")
            parts.append(f'<p class="note">{_CHECK.format(keys=", ".join(keys))}</p>')
            parts.append(_unfolds("Its numbers", json_text({key: certificate[key] for key in keys})))
        title = (type(claim).__doc__ or type(claim).__name__).partition("\n")[0].rstrip(".")
        yield f'<details class="claim"><summary>{escaped(title)}</summary>{"".join(parts)}</details>'


def _unfolds(title: str, text: str) -> str:
    return f"<details><summary>{escaped(title)}</summary><pre>{escaped(_cut(text))}</pre></details>" if text else ""


def _cut(text: str) -> str:
    return text if len(text) <= _MOST else f"{text[:_MOST]}\n… and {len(text) - _MOST:,} characters more"


def document(title: str, body: str) -> str:
    """Return a page with a title, which is text, and a body, which is HTML."""
    frame = files("pwatrack.report").joinpath("document.html").read_text(encoding="utf-8")
    return Template(frame).substitute(title=escaped(title), body=body, version=__version__)


def escaped(text: str) -> str:
    r"""Return text that a page shows as it is.

    Example:
        >>> escaped("<b>\x1b & more")
        '&lt;b&gt;\\x1b &amp; more'
    """
    return html.escape(visible(text).encode("utf-8", "backslashreplace").decode())


def image(picture: bytes | str, name: str, more: str = "") -> str:
    """Return a picture with this name and `more` attributes, in the page: a PNG file, or an SVG file as text."""
    if isinstance(picture, bytes):
        data = f"png;base64,{base64.b64encode(picture).decode()}"
    else:
        data = f"svg+xml,{quote(' '.join(picture.split()), safe=_PLAIN)}"
    return f'<img src="data:image/{data}" alt="{escaped(name)}"{more}>'
