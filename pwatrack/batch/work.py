"""What a batch asks of a worker, in whatever process, on any machine, what comes back, and what it remembers of it."""

import hashlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pwatrack.errors import ExitCode, InvalidSpec, Place, PwatrackError
from pwatrack.report.run_folder import INDEX, Left, Plots, read_index, stamp, written_at_once
from pwatrack.report.terminal import JobFault, faults, told
from pwatrack.version import versions

_FOLDER = ".batch"
_FORMAT = "pwatrack batch 1"


@dataclass(frozen=True, kw_only=True)
class Job:
    """One spec, its run folder, and what is to be done with it, as in `Options`."""

    spec: Path
    out: Path
    parameters: tuple[str, ...] = ()
    plots: Plots = "all"
    outside: bool = False


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How the run of a job ended by itself: its exit code, the one that the spec expects, and how long it took."""

    exit: int
    expected: int = 0
    messages: str = ""  # what the command line would say on stderr
    faults: tuple[JobFault, ...] = ()  # the same, one by one
    index: Mapping[str, Any] = field(default_factory=dict)  # its run.json; empty if it left none
    key: str = ""  # a digest of all that it depended on when it began
    inputs: tuple[str, ...] = ()  # the files that the spec refers to
    seconds: float = 0.0
    left: Left | None = None  # what it left, if that is not in its folder yet


Work = Callable[[Job], Ended]  # what is done with a job, in whatever process


def simulate(job: Job) -> Ended:
    """Design and simulate a spec and write its run folder; nothing is printed."""
    from pwatrack.commands.run import run
    from pwatrack.spec.load import expected_exit

    said, before = io.StringIO(), stamp(job.out)
    code, lines, wrong = int(ExitCode.DONE), list[str](), tuple[JobFault, ...]()
    with redirect_stderr(said):
        try:
            run(
                job.spec,
                job.out,
                job.parameters,
                None,
                simulated=True,
                plots=job.plots,
                shown="nothing",
                outside=job.outside,
            )
        except MemoryError:
            raise
        except Exception as error:
            code, lines, wrong = refused(error)
    index = (read_index(job.out) if stamp(job.out) != before else None) or {}
    return Ended(
        exit=code,
        expected=expected_exit(job.spec),
        messages="\n".join([*said.getvalue().splitlines(), *lines]),
        faults=wrong,
        index=index if index.get("exit") == code else {},
    )


def refused(error: Exception) -> tuple[int, list[str], tuple[JobFault, ...]]:
    """Return how a run ends with an exception: its exit code, what the command line says, and what is wrong."""
    code, lines = told(error)
    return int(code), lines, faults(error) if isinstance(error, PwatrackError) else ()


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
    """Write the record of a run that left a folder, last, so that it is complete; it runs again where that fails."""
    if not ended.index:
        return
    with suppress(OSError, InvalidSpec):
        stamps = {name: (job.out / name).stat().st_mtime_ns for name in ended.index["files"]}
        told = {name: getattr(ended, name) for name in ("key", "inputs", "seconds", "exit", "expected", "messages")}
        wrong = [asdict(fault) for fault in ended.faults]
        content = {"format": _FORMAT, **told, "index": _digest(job.out / INDEX), "stamps": stamps, "faults": wrong}
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
        wrong = tuple(JobFault(**f | {"place": Place(**f["place"]) if f["place"] else None}) for f in record["faults"])
        return Ended(**{name: record[name] for name in ("exit", "expected", "messages")}, faults=wrong, index=index)
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
    with suppress(OSError, ValueError):  # ValueError: a path with a null character
        if file.is_file():
            with file.open("rb") as content:
                return hashlib.file_digest(content, "sha256").hexdigest()
    return None
