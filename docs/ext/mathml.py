"""Formulas as MathML, which browsers draw by themselves: nothing is loaded while a page is read.

MathJax would come from a server, or be five megabytes beside the site; pictures of formulas need LaTeX. docutils turns
the part of LaTeX that these pages use into MathML, so it takes no further dependency. What it cannot read is a warning,
and so an error.
"""

import re
from html import unescape
from itertools import pairwise
from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

_ACCENTED = re.compile(
    r"(\\(?:dot|ddot|hat|bar|tilde)\s*(?:\\[a-z]+|\w|\{[^{}]*(?:\{[^{}]*\}[^{}]*)?\}))_", re.IGNORECASE
)
_MATH = "{http://www.w3.org/1998/Math/MathML}"
_INDEXED = tuple(_MATH + kind for kind in ("msub", "msup", "msubsup"))
_LOGGER = logging.getLogger(__name__)


def mathml(formula: str, *, block: bool) -> str:
    """Return a formula as MathML.

    Raises:
        MathError: If it is not of the part of LaTeX that docutils reads.
    """
    if found := re.fullmatch(r"\s*\\begin\{(equation|align|gather)\*?\}(.*)\\end\{\1\*?\}\s*", formula, re.DOTALL):
        formula = found[2]
    formula = _ACCENTED.sub(r"{\1}{}_", formula.strip())  # or the index is drawn below the letter
    written = re.sub(
        r"&(?!lt;|gt;|amp;)\w+;", lambda found: unescape(found.group()), tex2mathml(formula, as_block=block)
    )
    tree = ElementTree.fromstring(written)  # noqa: S314  (docutils wrote it)
    for parent in tree.iter():
        for accented, index in pairwise(list(parent)):
            if index.tag in _INDEXED and len(index[0]) == 0 and not index[0].text and accented.tag == _MATH + "mover":
                parent.remove(accented)
                index[0] = accented
    ElementTree.register_namespace("", _MATH[1:-1])
    return ElementTree.tostring(tree, encoding="unicode")


def _element(translator: Any, node: Any, *, block: bool) -> str:
    try:
        return mathml(node.astext(), block=block)
    except MathError as error:
        _LOGGER.warning("formula %r: %s", node.astext(), error, location=node)
        return str(translator.encode(node.astext()))


def inline(translator: Any, node: Any) -> None:
    """Write a formula within a line."""
    translator.body.append(_element(translator, node, block=False))
    raise nodes.SkipNode


def displayed(translator: Any, node: Any) -> None:
    """Write a formula of its own, with its number if it has one."""
    number = node.get("label") or ""
    anchor = f' id="eq-{number}"' if number else ""
    shown = f'<span class="number">({number})</span>' if number else ""
    translator.body.append(f'<div class="formula"{anchor}>{_element(translator, node, block=True)}{shown}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Let Sphinx know it."""
    app.add_html_math_renderer("mathml", (inline, None), (displayed, None))
