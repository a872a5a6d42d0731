"""The pages of the site: before Sphinx reads them their blocks are run, and remembered until something changes."""

import hashlib
import json
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from docs.ext import gallery, mathml, reference
from docs.ext.cells import ROOT, Page, blocks, prepared

DOCS = ROOT / "docs"
WORK = DOCS / "_build" / "pages"
PICTURES = DOCS / "generated"
GENERATED = {**reference.GENERATED, **gallery.GENERATED}


def expanded(name: str, text: str) -> str:
    """Return a page with what its blocks made: from before, if neither it nor the program has changed."""
    if not blocks(text):
        return text
    key = hashlib.sha256((text + _program()).encode()).hexdigest()
    known = WORK / f"{name.replace('/', '-')}.json"
    if known.is_file():
        kept = json.loads(known.read_text(encoding="utf-8"))
        if kept["key"] == key and all((PICTURES / made).is_file() for made in kept["pictures"]):
            return str(kept["text"])
    page = Page(name, prepared(WORK / name), GENERATED, PICTURES)
    made = page.expand(text)
    content = {"key": key, "text": made, "pictures": [path.name for path in page.made]}
    known.write_text(json.dumps(content), encoding="utf-8")
    return made


def _program() -> str:
    """Return what changes with the program, its specs, and how pages are made."""
    digest = hashlib.sha256()
    for pattern in ("pwatrack/**/*.py", "specs/**/*.yaml", "docs/ext/*.py", "docs/reference/spec_file.md"):
        for path in sorted(ROOT.glob(pattern)):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _run(_app: Any, _env: Any, names: Iterable[str]) -> None:
    """Run the blocks of all pages, two pages at a time, whichever is next: Sphinx deals them out beforehand."""
    texts = {name: (DOCS / f"{name}.md").read_text(encoding="utf-8") for name in names}
    longest = sorted(texts, key=lambda name: name != "gallery/index")
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda name: expanded(name, texts[name]), longest))


def _read(_: Any, name: str, source: list[str]) -> None:
    source[0] = expanded(name, source[0])


def setup(app: Any) -> dict[str, Any]:
    """Let Sphinx know it."""
    WORK.mkdir(parents=True, exist_ok=True)
    PICTURES.mkdir(parents=True, exist_ok=True)
    mathml.setup(app)
    app.connect("env-before-read-docs", _run)
    app.connect("source-read", _read)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
