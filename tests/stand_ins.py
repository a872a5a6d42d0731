"""What the workers of a batch do in tests, instead of a design: the name of the spec says how it ends."""

import os
import signal
import sys
import time

from pwatrack.batch.work import Ended, Job
from pwatrack.spec.load import expected_exit

NOISE = "\x1b[31mred\x00 \udcff <&>]]>"


def work(job: Job) -> Ended:
    """End as the name of the spec says: `exit3 …` with 3."""
    kind = job.spec.stem.split(" ")[0].lower()
    if kind == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "segfault":
        sys.stderr.write("about to crash")
        sys.stderr.flush()
        os.kill(os.getpid(), signal.SIGSEGV)
    if kind == "slow":
        time.sleep(60)
    if kind == "stubborn":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(60)
    if kind == "tidy":
        try:
            time.sleep(60)
        finally:
            job.out.touch()
    if kind == "hungry":
        bytearray(2**34)
    if kind == "noisy":
        return Ended(exit=1, messages=NOISE)
    if kind == "leaves":
        sys.exit(7)
    return Ended(exit=int(kind.removeprefix("exit")), expected=expected_exit(job.spec))
