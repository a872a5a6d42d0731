"""The terminal: consoles that print text as it is, and refusals with their exit codes."""

import io
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from rich.console import Console

from pwatrack.errors import ExitCode, PwatrackError


def console(*, stderr: bool = False) -> Console:
    """Return a console that reads no markup in names and never fails on a letter it cannot print."""
    stream = sys.stderr if stderr else sys.stdout
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="replace")
    return Console(stderr=stderr, highlight=False, markup=False, emoji=False)


@contextmanager
def refusals() -> Iterator[None]:
    """End the program with the messages and the exit code of a refusal raised inside; no traceback.

    Raises:
        SystemExit: With the code of the refusal, 2 if stdout takes no more, 130 if the program is interrupted, and 1
            for any other exception.
    """
    try:
        yield
    except PwatrackError as error:
        _end(error.code, *(f"error: {problem}" for problem in error.problems), *getattr(error, "__notes__", ()))
    except KeyboardInterrupt:
        _end(128 + signal.SIGINT)
    except Exception as error:
        if isinstance(error, OSError) and error.filename is None:  # those of files are refusals by now
            _end(ExitCode.INVALID, f"error: cannot print: {error.strerror or error}")
        where = traceback.extract_tb(error.__traceback__)[-1]  # whatever else comes is a bug of ours
        place = f"{Path(where.filename).name}:{where.lineno}"
        said = f"error: a bug in pwatrack: {type(error).__name__}: {error} ({place})"
        _end(ExitCode.BUG, said, "  hint: please report it together with the spec")


def _end(code: int, *messages: str) -> NoReturn:
    """End the program with messages on stderr, if it takes them."""
    for stream, texts in ((sys.stdout, ()), (sys.stderr, messages)):
        try:
            if texts:
                errors = console(stderr=True)
                for text in texts:
                    errors.print(text, soft_wrap=True)
            if stream is not None:
                stream.flush()
        except OSError:  # full: what still waits to be printed goes nowhere
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    raise SystemExit(int(code)) from None
