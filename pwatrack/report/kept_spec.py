"""The spec that a run was made from: kept in its folder as it was read, with its tables, and found again."""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from pwatrack.errors import PwatrackError
from pwatrack.remote_files import attempt, carried, content
from pwatrack.report.run_folder import SPEC, RunFolder
from pwatrack.spec.load import load_spec, referenced_names, spec_bytes
from pwatrack.spec.spec import Spec
from pwatrack.spec.table import Folder, table_content
from pwatrack.spec.yaml_tree import WRITTEN


def keep(run: RunFolder, spec: Spec) -> None:
    """Put what was read of a spec, and of the tables that it refers to, beside its run: the folder may be moved."""
    with suppress(PwatrackError, OSError, ValueError):  # a table has gone
        text = spec_text(spec)
        if text is None:
            return
        run.place(SPEC if spec.text is None else WRITTEN).write_bytes(text)
        for k, name in enumerate(referenced_names(text)):
            table = _content(spec.path.parent / name, outside=True)  # it was allowed to be there
            run.place(_table(k)).write_bytes(table)


def spec_text(spec: Spec) -> bytes | None:
    """Return a spec as it was read; None where its file has gone, or was changed since."""
    with suppress(PwatrackError, OSError, ValueError):
        text = spec_bytes(spec.path) if spec.text is None else spec.text.encode()
        return text if hashlib.sha256(text).hexdigest() == spec.sha256 else None
    return None


def load(path: Path, parameters: Mapping[str, float | str]) -> Spec:
    """Return the spec of a file, with the tables of its run where it is the copy that a run keeps."""
    if path.name not in (SPEC, WRITTEN) or not _tables(path):
        return load_spec(path, parameters)
    known = {str(path): attempt(lambda: spec_bytes(path))}
    known |= {str(path.parent / name): attempt(partial(_content, table)) for name, table in _tables(path).items()}
    with carried(known):
        return load_spec(path, parameters)


def spec_of(index: Mapping[str, Any], folder: Path, sha256: str) -> tuple[Path | None, str]:
    """Return the spec of these bytes that a run in a folder was made from, and what is to be said of the file it was.

    The folder's own copy is what it was made from, if that is as it was and has its tables. Next comes the file of the
    name that the index has, from here, then from the folder of the run and those that it is in: the first one of these
    bytes, or else the first one that is there, which has others.
    """
    name = Path(str(index.get("spec", "")))
    own = [folder / (WRITTEN if name == Path(WRITTEN) else SPEC)]
    own = [copy for copy in own if copy.is_file() and all(table.is_file() for table in _tables(copy).values())]
    read = [place for place in (name, *(above / name for above in folder.resolve().parents)) if place.is_file()]
    read = [] if name == Path(WRITTEN) else read
    same = [place for place in (*own, *read) if hashlib.sha256(place.read_bytes()).hexdigest() == sha256]
    found = next(iter([*same, *own, *read]), None)
    changed = found in own and bool(read) and not {*same} & {*read}
    return found, f"{read[0]} has other bytes than the spec it was made for, and was not looked at" if changed else ""


def _tables(copy: Path) -> dict[str, Path]:
    try:
        names = referenced_names(spec_bytes(copy))
    except PwatrackError:
        return {}
    return {name: copy.parent / _table(k) for k, name in enumerate(names)}


def _table(k: int) -> str:
    return f"table_{k + 1}.csv"


def _content(table: Path, *, outside: bool = False) -> bytes:
    folder = Folder(path=table.parent, outside=outside)
    return content(table, lambda: table_content(table, folder))
