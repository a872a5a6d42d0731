"""What a batch remembers of each run: whether it may be taken as it is, with nothing changed since.

A record speaks of one run folder. It holds a key of everything that went into the run: version, options, the bytes of
the spec and of the files it refers to; and what the folder held. It is written last, so that it never speaks of a run
that is not complete. Runs that left no folder have none: specs in error, and what was killed.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pwatrack.batch.work import Ended, Job
from pwatrack.errors import InvalidSpec, Place
from pwatrack.report.run_folder import INDEX, read_index, written_at_once
from pwatrack.report.terminal import JobFault
from pwatrack.version import versions

_FOLDER = ".batch"
_FORMAT = "pwatrack batch 1"


def key(job: Job, files: Sequence[Path]) -> str:
    """Return a digest of all that a run depends on; it is another one where a file is missing."""
    parts: dict[str, Any] = {
        "versions": versions(),
        "spec": str(job.spec),
        "parameters": job.parameters,
        "plots": job.plots,
        "outside": job.outside,
        "files": [[str(file), _digest(file)] for file in (job.spec, *files)],
    }
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def inputs(job: Job) -> tuple[str, tuple[str, ...]]:
    """Return the key of a job that is about to run, and the files that its spec refers to."""
    from pwatrack.spec.load import referenced_files

    files = referenced_files(job.spec)
    return key(job, files), tuple(map(str, files))


def remember(job: Job, out: Path, ended: Ended) -> None:
    """Write the record of a run, if it left a folder that is still there. Where that is impossible, it runs again."""
    if not ended.index:
        return
    with suppress(OSError, InvalidSpec):
        stamps = {name: (job.out / name).stat().st_mtime_ns for name in ended.index["files"]}
        content: dict[str, Any] = {"format": _FORMAT, "key": ended.key, "inputs": ended.inputs}
        content |= {"index": _digest(job.out / INDEX), "stamps": stamps, "seconds": ended.seconds}
        content |= {"exit": ended.exit, "expected": ended.expected, "messages": ended.messages}
        content |= {"faults": [asdict(fault) for fault in ended.faults]}
        with written_at_once(_place(job, out)) as temporary:
            temporary.write_text(json.dumps(content), encoding="utf-8")


def recall(job: Job, out: Path) -> Ended | None:
    """Return how an earlier run ended, if nothing that it depends on or left has changed."""
    try:
        record: dict[str, Any] = json.loads(_place(job, out).read_text(encoding="utf-8"))
        if record["format"] != _FORMAT or record["key"] != key(job, [Path(name) for name in record["inputs"]]):
            return None
        index = read_index(job.out)
        if index is None or record["index"] != _digest(job.out / INDEX) or not _whole(job.out, index, record["stamps"]):
            return None
        faults = tuple(JobFault(**f | {"place": Place(**f["place"]) if f["place"] else None}) for f in record["faults"])
        how = {name: record[name] for name in ("exit", "expected", "messages")}
        return Ended(**how, faults=faults, index=index)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):  # there is none, or it is not ours
        return None


def _whole(folder: Path, index: Mapping[str, Any], stamps: Mapping[str, int]) -> bool:
    """Whether all files of a run are as it left them; read only where their time differs."""
    for name, known in index["files"].items():
        found = (folder / name).stat()
        if found.st_size != known["bytes"]:
            return False
        if found.st_mtime_ns != stamps.get(name) and _digest(folder / name) != known["sha256"]:
            return False
    return True


def _place(job: Job, out: Path) -> Path:
    """Return where the record of a job is: any name of a folder will do."""
    name = hashlib.sha256(bytes(job.out.relative_to(out))).hexdigest()[:24]
    return out / _FOLDER / f"{name}.json"


def _digest(file: Path) -> str | None:
    try:
        if not file.is_file():
            return None
        with file.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    except (OSError, ValueError):  # ValueError: a path with a null character
        return None
