"""`python -m pwatrack` is the command line."""

import os
import signal
import sys

from pwatrack.cli import app


def run() -> None:
    """Entry point of the console script."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # small matrices: threads only cost time, and change the last bit
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that nothing half-written is left
    app(prog_name="pwatrack")


if __name__ == "__main__":
    run()
