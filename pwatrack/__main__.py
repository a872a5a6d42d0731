"""`python -m pwatrack` is the command line."""

import os

from pwatrack.cli import app


def run() -> None:
    """Entry point of the console script."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # small matrices: threads only cost time, and change the last bit
    app(prog_name="pwatrack")


if __name__ == "__main__":
    run()
