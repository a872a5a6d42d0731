"""Files that are read: regular ones alone, or those that came along with work from another machine in their place."""

import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

Found = bytes | Exception  # what a file holds, or why it cannot be read
_CARRIED: ContextVar[Mapping[str, Found] | None] = ContextVar("files of another machine", default=None)


def regular(path: Path, most: int) -> bytes:
    """Return what a file holds, a regular one of so many bytes at most: others may never end.

    Raises OSError, and ValueError where it is none, or its path is none.

    Example:
        >>> regular(Path("."), 10)
        Traceback (most recent call last):
        ValueError: it is a folder
    """
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise ValueError("it is a folder" if stat.S_ISDIR(about.st_mode) else "it is no regular file")
    if about.st_size > most:
        raise ValueError(f"it has {about.st_size:,} bytes, at most {most:,} are read")
    with path.open("rb") as file:
        return file.read(most)


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
