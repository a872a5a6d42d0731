"""The terminal: consoles that print text as it is, and refusals with their exit codes."""

import io
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
        SystemExit: With the code of the refusal, or 1 for an exception that is none; as for a program that SIGINT or
            SIGPIPE ends, if it is interrupted or nobody reads its output.
    """
    errors = console(stderr=True)
    try:
        yield
    except PwatrackError as error:
        for problem in error.problems:
            errors.print(f"error: {problem}", soft_wrap=True)
        for note in getattr(error, "__notes__", ()):
            errors.print(note, soft_wrap=True)
        raise SystemExit(int(error.code)) from None
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGINT) from None
    except BrokenPipeError:  # whoever read our output has enough of it
        _drop_output()
        raise SystemExit(128 + signal.SIGPIPE) from None
    except OSError as error:  # those of files are refusals by now
        _drop_output()
        errors.print(f"error: cannot print the results: {error.strerror or error}", soft_wrap=True)
        raise SystemExit(int(ExitCode.INVALID)) from None
    except Exception as error:  # whatever else comes is a bug of ours, said without a traceback
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        errors.print(f"error: a bug in pwatrack: {type(error).__name__}: {error} ({place})", soft_wrap=True)
        errors.print("  hint: please report it together with the spec")
        raise SystemExit(int(ExitCode.BUG)) from None


def _drop_output() -> None:
    """Let what still waits to be printed go nowhere."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
