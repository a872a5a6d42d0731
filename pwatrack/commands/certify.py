"""A run folder -> a development for Coq, whose kernel checks what the certificate proves."""

from pathlib import Path

from pwatrack.commands.verify import certificate_text, verify
from pwatrack.export.coq import development
from pwatrack.export.source import prefix, write_texts
from pwatrack.lmi.audit.reading import parsed


def certify(path: Path, out: Path) -> list[str]:
    """Write what Coq checks of a certificate to a folder, and return the names of the files.

    Raises as `verify`, and InvalidSpec if nothing in it is of the kind that the theory speaks of.
    """
    verify(path)
    file, text = certificate_text(path)
    return write_texts(development(parsed(text), prefix(file.resolve().parent.name)), out)
