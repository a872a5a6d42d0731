"""A refusal -> its messages on stderr and its exit code."""

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pwatrack.errors import ExitCode, PwatrackError


@contextmanager
def refusals() -> Iterator[None]:
    """End the program with the messages and the exit code of a refusal raised inside; no traceback.

    Raises:
        SystemExit: With the code of the refusal, or 1 for an exception that is none.
    """
    try:
        yield
    except PwatrackError as error:
        for problem in error.problems:
            print(f"error: {problem}", file=sys.stderr)
        raise SystemExit(int(error.code)) from None
    except Exception as error:  # whatever else comes is a bug of ours, said without a traceback
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        print(f"error: a bug in pwatrack: {type(error).__name__}: {error} ({place})", file=sys.stderr)
        print("  hint: please report it together with the spec", file=sys.stderr)
        raise SystemExit(int(ExitCode.BUG)) from None
