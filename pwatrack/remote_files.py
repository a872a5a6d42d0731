"""Files that came along with work from another machine: they are read in place of those of this one."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

Found = bytes | Exception  # what a file holds, or why it cannot be read
_CARRIED: ContextVar[Mapping[str, Found] | None] = ContextVar("files of another machine", default=None)


def attempt(read: Callable[[], bytes]) -> Found:
    """Return what a file holds, or the refusal to read it."""
    try:
        return read()
    except Exception as error:
        return error


def content(path: Path, read: Callable[[], bytes]) -> bytes:
    """Return what a file holds: what came along with the work, or else what `read` returns or raises.

    Raises FileNotFoundError if this work came with files, and it is none of them; else what `read` raised where the
    file is.

    Example:
        >>> with carried({"a.csv": b"t,y"}):
        ...     content(Path("a.csv"), lambda: b"of this machine")
        b't,y'
    """
    files = _CARRIED.get()
    if files is None:
        return read()
    found = files.get(str(path), FileNotFoundError(2, "No such file or directory", str(path)))
    if isinstance(found, Exception):
        raise found
    return found


@contextmanager
def carried(files: Mapping[str, Found]) -> Iterator[None]:
    """Let the block read these files, by their paths, and no others."""
    token = _CARRIED.set(files)
    try:
        yield
    finally:
        _CARRIED.reset(token)
