"""A folder of results that tells one run: at every instant all of it, or nothing that could pass for a run.

All files are written in a hidden folder inside, and moved when the last of them is there. While they are moved the
index says `incomplete` and names what is on its way, so that a run that is killed just then leaves nothing that the
next one cannot clear away.
"""

import csv
import errno
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from glob import escape
from itertools import chain, count
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Literal

from pwatrack.errors import InvalidSpec, Problem
from pwatrack.interruption import uninterrupted
from pwatrack.remote_files import regular
from pwatrack.spec.yaml_tree import WRITTEN

Plots = Literal["all", "failed", "none"]  # which runs have pictures

INDEX = "run.json"  # says how the run ended and names its files; written last
REFUSAL = "refusal.json"  # the proof of a refusal
SUMMARY = "summary.txt"  # all that was found, for people
PAGE = "report.html"  # likewise, with pictures and proofs, for a browser
SPEC = "spec.txt"  # as the run read it; no .yaml, or a batch over a folder of runs would take it for one of its specs
INCOMPLETE = "incomplete"  # the verdict while files are moved: no run

_FORMAT = "pwatrack run 1"
_LARGEST = 2**28  # bytes of an index that is read
NAMES = re.compile(  # the files that a run can have: nothing else is ever removed
    r"(gains|certificate|generator|refusal|bounds|controller)\.json|(trace|events|ensemble|pareto)\.csv|"
    rf"{re.escape(WRITTEN)}|{re.escape(SPEC)}|{re.escape(SUMMARY)}|{re.escape(PAGE)}|"
    r"(tracking_error|observer_error|outputs|input|cells|states|internal_states|steady_state|estimates|ensemble|pareto)\.png|"
    r"nonlinearities\.png|starts\.png|"
    r"portrait_[1-9]\d*\.png|table_[1-9]\d*\.csv"
)
_PROOFS = ("certificate.json", REFUSAL)  # last to come and first to go, but for the index
_STAGE = ".pwatrack-"
_GOING, _COMING = "going.json", "coming.json"  # the index while files of the earlier run go, and the new ones come


@dataclass
class Left:
    """What a run leaves that is made on another machine than its folder is on."""

    index: dict[str, Any] | None = None  # what `read_index` finds there: first that of the earlier run, if there is one
    files: dict[str, bytes] | None = None  # what each file holds, once there is a run

    def write(self, path: str | Path) -> None:
        """Write it where it belongs, if there is a run, as if it had been made there; raises as `run_folder`."""
        if self.index is None or self.files is None:
            return
        with run_folder(path) as run:
            for name, content in self.files.items():
                run.place(name).write_bytes(content)
            run.commit(self.index)


_LEFT: ContextVar[Left | None] = ContextVar("where runs are left", default=None)


@contextmanager
def left_elsewhere(left: Left) -> Iterator[None]:
    """Let the one run of the block be left there, and nothing be written into its folder."""
    token = _LEFT.set(left)
    try:
        yield
    finally:
        _LEFT.reset(token)


class RunFolder:
    """Files on their way into a folder; use it through `run_folder`."""

    def __init__(self, path: Path, stage: Path, left: Left | None) -> None:
        self.path, self._stage, self._left, self._names = path, stage, left, list[str]()

    def place(self, name: str) -> Path:
        """Return the path to write the file `name` to for now; a ValueError if runs have no such file."""
        if not NAMES.fullmatch(name):
            raise ValueError(f"{name} is none of the files of a run")
        self._names.append(name)
        return self._stage / name

    def text(self, name: str, content: str) -> None:
        """Add a text file."""
        self.place(name).write_text(content, encoding="utf-8")

    def rows(self, name: str, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
        """Add a table as a CSV file."""
        with self.place(name).open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows(chain([header], rows))

    def json(self, name: str, content: object) -> None:
        """Add a JSON file; floats keep every bit."""
        self.text(name, json_text(content))

    def commit(self, index: Mapping[str, object]) -> None:
        """Take the place of the earlier run: its files go, those added here come, and the index last.

        A file of the user's under one of these names, and one that was changed since a run wrote it, is kept: `name~`.
        """
        if self._left is not None:
            self._left.files = {name: (self._stage / name).read_bytes() for name in self._names}
            self._left.index = json.loads(json_text(index))
            return
        new = {name: _record(self._stage / name) for name in self._names}
        with _alone(self.path):
            for name in (*new, INDEX):
                if (self.path / name).is_dir():
                    raise IsADirectoryError(errno.EISDIR, f"'{name}' is a folder there")
            known = _index(self.path).get("files", {})
            there = [file.name for file in self.path.iterdir() if NAMES.fullmatch(file.name) and not file.is_dir()]
            files = [self.path / name for name in there if name in known]
            files = [file for file in files if file.is_file() and not file.is_symlink()]
            old = {file.name: known[file.name] for file in files if _record(file) == known[file.name]}
            self._write_index({**index, "files": new}, INDEX)
            self._write_index({"verdict": INCOMPLETE, "files": old}, _GOING)
            self._write_index({"verdict": INCOMPLETE, "files": new}, _COMING)
            with uninterrupted():
                if not _index(self.path):
                    _keep(self.path / INDEX)
                (self._stage / _GOING).replace(self.path / INDEX)
                for name in sorted(there, key=lambda name: name not in _PROOFS):
                    if name in old:
                        (self.path / name).unlink()
                    else:
                        _keep(self.path / name)
                (self._stage / _COMING).replace(self.path / INDEX)
                for name in sorted(new, key=lambda name: name in _PROOFS):
                    (self._stage / name).replace(self.path / name)
                (self._stage / INDEX).replace(self.path / INDEX)

    def _write_index(self, content: Mapping[str, object], name: str) -> None:
        (self._stage / name).write_text(json_text({"format": _FORMAT, **content}), encoding="utf-8")


@contextmanager
def run_folder(path: str | Path) -> Iterator[RunFolder]:
    """Open a run folder; the block ends with `commit`, or leaves it as it was. InvalidSpec if it cannot be written.

    Example:
        >>> with run_folder("/tmp/pwatrack-example") as run:
        ...     run.json("gains.json", {"K": [[1.0]]})
        ...     run.commit({"verdict": "proved"})
        >>> index = read_index("/tmp/pwatrack-example")
        >>> index["verdict"], list(index["files"])
        ('proved', ['gains.json'])
    """
    if not os.fspath(path):
        raise InvalidSpec("cannot write to '': no folder is named", subject=None, hint="'.' is the current one")
    path, left = Path(path), _LEFT.get()
    home = path if left is None else Path(gettempdir()) / f"pwatrack-{os.getuid()}"
    with _hidden(home, _STAGE, f"results to {path}", "choose another folder (--out)", folder=True) as stage:
        yield RunFolder(path, stage, left)


@contextmanager
def written_at_once(path: Path) -> Iterator[Path]:
    """Return a path to write to, which takes the place of `path` when the block ends, or raise InvalidSpec."""
    with _hidden(path.parent, f".{path.name[:100]}.", str(path), "choose another path") as temporary:
        yield temporary
        temporary.replace(path)


@contextmanager
def _hidden(home: Path, name: str, said: str, hint: str, *, folder: bool = False) -> Iterator[Path]:
    """Make a file or folder whose name begins so, and remove it in the end; raise InvalidSpec where that fails."""
    temporary = home / f"{name}{secrets.token_hex(8)}"
    try:
        home.mkdir(parents=True, exist_ok=True)
        with _alone(home) if folder else nullcontext():  # or another would take it for one that nobody owns
            sweep(home, name)
            if folder:
                temporary.mkdir()
            new = 0 if folder else os.O_CREAT | os.O_EXCL
            owner = _locked(os.open(temporary, os.O_RDONLY | new, 0o666))
        try:
            yield temporary
        finally:
            _remove(temporary)
            os.close(owner)
    except OSError as error:
        message = f"cannot write {said}: {error.strerror or error}"
        raise InvalidSpec(Problem(message=message, hint=hint)) from None


def read_index(path: str | Path) -> dict[str, Any] | None:
    """Return the index of the run that a folder tells; None if it tells none, or that of another program."""
    if (left := _LEFT.get()) is not None:
        return left.index
    index = _index(Path(path))
    return index if index.get("verdict") != INCOMPLETE and index else None


def lacking(folder: Path, name: str) -> InvalidSpec:
    """Return the refusal of a folder without a file that a run with a design has: why, where its index tells."""
    match read_index(folder):
        case {"exit": int(code), "reasons": [{"message": str(why)}, *_]}:
            message = f"{folder}: its run was refused (exit {code}), so there is no {name}: {why}"
            return InvalidSpec(message, subject=None, hint=f"{INDEX} there has all reasons")
    message = f"{folder}: there is no {name}, so it is no folder of a run with a design"
    return InvalidSpec(message, subject=None, hint="name one that 'design' or 'simulate' wrote")


def stamp(path: Path) -> tuple[int, int] | None:
    """Return what tells one index of a folder from the next; None if there is none."""
    if (left := _LEFT.get()) is not None:
        return None if left.files is None else (id(left.files), 0)
    try:
        found = (path / INDEX).stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def kept_files(path: Path) -> list[str]:
    """Return the files that a run found under one of its names and kept, since no run had left them so."""
    names = sorted(file.name for file in path.glob("*~*"))
    return [name for name in names if name.startswith(f"{INDEX}~") or NAMES.fullmatch(name.partition("~")[0])]


def _index(path: Path) -> dict[str, Any]:
    try:
        index = json.loads(regular(path / INDEX, _LARGEST).decode("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    ours = isinstance(index, dict) and index.get("format") == _FORMAT and isinstance(index.get("files"), dict)
    return index if ours else {}


def _record(file: Path) -> dict[str, object]:
    with file.open("rb") as content:
        return {"bytes": file.stat().st_size, "sha256": hashlib.file_digest(content, "sha256").hexdigest()}


def _keep(file: Path) -> None:
    """Move a file out of the way that is not ours to remove, if there is one."""
    if os.path.lexists(file):
        names = (file.with_name(f"{file.name}~{number}") for number in chain([""], count(2)))
        file.rename(next(name for name in names if not os.path.lexists(name)))


def sweep(path: Path, name: str = _STAGE) -> None:
    """Remove what runs that were killed left half-written in a folder: nobody holds their lock."""
    for leftover in path.glob(escape(name) + "[0-9a-f]" * 16):
        with suppress(OSError):  # it has gone, or its owner is at work, or nobody can tell
            owner = os.open(leftover, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                fcntl.flock(owner, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _remove(leftover)
            finally:
                os.close(owner)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def _locked(opened: int) -> int:
    """Lock what is open: the lock ends with the process, however that ends; close it to give it back."""
    with suppress(OSError):  # a file system without locks
        fcntl.flock(opened, fcntl.LOCK_EX)
    return opened


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep other runs from changing a folder for the moment."""
    lock = _locked(os.open(folder, os.O_RDONLY | os.O_DIRECTORY))
    try:
        yield
    finally:
        os.close(lock)


def json_text(content: object) -> str:
    """Return JSON with each row of a matrix on one line; floats keep every bit."""
    return _indented(content, "\n") + "\n"


def _indented(content: Any, line: str) -> str:
    deeper = line + "  "
    if isinstance(content, dict) and content:
        parts = [f"{json.dumps(str(key))}: {_indented(value, deeper)}" for key, value in content.items()]
        return "{" + deeper + f",{deeper}".join(parts) + line + "}"
    if isinstance(content, list | tuple) and any(isinstance(value, dict | list | tuple) for value in content):
        return "[" + deeper + f",{deeper}".join(_indented(value, deeper) for value in content) + line + "]"
    return json.dumps(content, allow_nan=False)
