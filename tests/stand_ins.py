"""What the workers of a batch do in tests, instead of a design: the name of the spec says how it ends."""

import os
import signal
import sys
import time
from pathlib import Path

from pwatrack.batch.work import Ended, Job, refused
from pwatrack.errors import InvalidSpec
from pwatrack.report.run_folder import read_index, run_folder
from pwatrack.report.terminal import JobFault
from tests.runs import record

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
    from pwatrack.spec.load import expected_exit

    return Ended(exit=int(kind.removeprefix("exit")), expected=expected_exit(job.spec))


def written(job: Job) -> Ended:
    """End so, and leave a run folder as a design does, unless the spec is in error; `count` says how often."""
    ended = work(job)
    if ended.exit in (1, 2):
        return ended
    time.sleep(0.02)
    record(job.out, {"verdict": "proved", "exit": ended.exit, "figures": {"norm_K": 1.5}})
    with (job.out.parent / "count").open("a") as file:
        file.write("x")
    faults = (JobFault(message="no", hint="yes"),) if ended.exit else ()
    index = read_index(job.out) or {}
    return Ended(exit=ended.exit, messages="said", faults=faults, index=index)


def bulky(job: Job) -> Ended:
    """End so, and leave a run folder of 100 kB, where there is room."""
    try:
        with run_folder(job.out) as run:
            run.text("trace.csv", "x" * 100_000)
            run.commit({"verdict": "proved", "exit": 0})
    except InvalidSpec as error:
        code, lines, faults = refused(error)
        return Ended(exit=code, messages="\n".join(lines), faults=faults)
    return Ended(exit=0, index=read_index(job.out) or {})


def count(out: Path) -> int:
    """Return how many runs have ended so in a folder."""
    return (out / "count").stat().st_size
