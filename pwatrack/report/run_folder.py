"""A folder of results that is never torn: every file under a temporary name first, all moved at the end."""

import errno
import json
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pwatrack.errors import InvalidSpec, Problem

INDEX = "run.json"  # names the files of the run; written last
REFUSAL = "refusal.json"  # the proof of a refusal; stays beside an earlier run, until a run succeeds


class RunFolder:
    """Files on their way into a folder; use it through `run_folder`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: dict[str, Path] = {}

    @property
    def names(self) -> list[str]:
        """Files added so far."""
        return list(self._waiting)

    def place(self, name: str) -> Path:
        """Return a temporary path to write the file `name` to."""
        temporary = self._waiting[name] = self.path / f".{name}.{secrets.token_hex(4)}"  # known before it is there
        temporary.touch(exist_ok=False)
        return temporary

    def text(self, name: str, content: str) -> None:
        """Add a text file."""
        self.place(name).write_text(content, encoding="utf-8")

    def json(self, name: str, content: object) -> None:
        """Add a JSON file; floats keep every bit."""
        self.text(name, json.dumps(content, indent=2, allow_nan=False) + "\n")

    def commit(self) -> None:
        """Move all files to their names, the index last, and drop what only an earlier run had."""
        for name in self._waiting:
            if (self.path / name).is_dir():
                raise IsADirectoryError(errno.EISDIR, f"'{name}' is a folder there")
        stale = {REFUSAL, *_indexed(self.path)} - set(self._waiting) if INDEX in self._waiting else set()
        for name in sorted(self._waiting, key=lambda name: name == INDEX):
            self._waiting.pop(name).replace(self.path / name)
        for name in stale:
            if (self.path / name).is_file():
                (self.path / name).unlink()

    def discard(self) -> None:
        """Remove what was written so far; files of earlier runs stay."""
        for temporary in self._waiting.values():
            temporary.unlink(missing_ok=True)


@contextmanager
def run_folder(path: str | Path) -> Iterator[RunFolder]:
    """Open a run folder; its files appear all together when the block ends, or not at all.

    Raises:
        InvalidSpec: If the folder cannot be written.

    Example:
        >>> with run_folder("/tmp/pwatrack-example") as run:
        ...     run.json("run.json", {"files": []})
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        run = RunFolder(path)
        try:
            yield run
            run.commit()
        finally:
            run.discard()
    except OSError as error:
        raise InvalidSpec(
            Problem(
                message=f"cannot write results to {path}: {error.strerror or error}",
                hint="choose another --out",
            )
        ) from None


def _indexed(path: Path) -> list[str]:
    """Return the files that the index of an earlier run names, as far as they are plain names."""
    try:
        names = json.loads((path / INDEX).read_text(encoding="utf-8"))["files"]
        return [name for name in names if isinstance(name, str) and Path(name).name == name]
    except (OSError, ValueError, KeyError, TypeError):
        return []
