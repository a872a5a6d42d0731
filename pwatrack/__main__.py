"""`python -m pwatrack` is the command line."""

import atexit
import gc
import signal
import warnings

from pwatrack.cli import app
from pwatrack.cores import one_thread
from pwatrack.interruption import listen
from pwatrack.report.terminal import refusals


def run() -> None:
    """Entry point of the console script."""
    gc.set_threshold(300_000, 20)  # nearly all that is made when modules are imported stays
    atexit.register(gc.freeze)  # and goes with the process: to look through it at the end would take 0.3 s
    one_thread()
    listen()  # so that nothing half-written is left
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # whoever reads our output has had enough: no word, as customary
    warnings.filterwarnings(
        "ignore", category=RuntimeWarning
    )  # what overflows on the way fails the check of the result
    with refusals():
        app(prog_name="pwatrack")


if __name__ == "__main__":
    run()
