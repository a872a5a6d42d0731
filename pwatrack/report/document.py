"""Pages in HTML that need nothing else: text as text, pictures in the page, one look for all of them."""

import base64
import html
from importlib.resources import files
from string import Template
from urllib.parse import quote

from pwatrack.report.terminal import visible
from pwatrack.version import __version__

_PLAIN = " <>=:/;,.()'!?-_@+*[]{}"  # letters that may stand in the address of a picture as they are


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


def image(picture: bytes | str, name: str) -> str:
    """Return a picture with this name, in the page: a PNG file, or an SVG file as text."""
    if isinstance(picture, bytes):
        data = f"png;base64,{base64.b64encode(picture).decode()}"
    else:
        data = f"svg+xml,{quote(' '.join(picture.split()), safe=_PLAIN)}"
    return f'<img src="data:image/{data}" alt="{escaped(name)}">'
