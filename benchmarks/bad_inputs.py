"""Give `pwatrack check` every bad input of the tests, each in a process of its own: what it says and what it takes.

    python -m benchmarks.bad_inputs

Wanted of each: exit 2, a code and the line, no traceback, nothing written, 1 s of processor and 300 MB at most.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.test_bad_files import BadInput, bad_inputs

MOST_SECONDS, MOST_MEGABYTES = 1.0, 300.0


def checked(bad: BadInput, folder: Path) -> tuple[list[str], float, float]:
    """Return what is amiss with the answer, and the seconds of processor and megabytes that it took."""
    path = bad.written(folder)
    before = {file.name for file in folder.iterdir()}
    with tempfile.TemporaryFile() as said:
        command = [sys.executable, "-m", "pwatrack", "check", str(path)]
        process = subprocess.Popen(command, stdout=said, stderr=said)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = code = os.waitstatus_to_exitcode(status)
        said.seek(0)
        text = said.read().decode()
    seconds, megabytes = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    errors = [line for line in text.splitlines() if line.startswith("error: ") and ": … and" not in line]
    lines = {int(found) for found in re.findall(rf"^error: {re.escape(str(path))}:(\d+):\d+: ", text, re.M)}
    amiss = {
        f"exit {code}": code != 2,
        "no line": not lines if bad.line is None else bad.line not in lines,
        "no code": not all(re.search(r"\[P\d{3}\]$", error) for error in errors),
        "a traceback": "Traceback" in text,
        "something written": {file.name for file in folder.iterdir()} != before,
        f"{seconds:.2f} s": seconds > MOST_SECONDS,
        f"{megabytes:.0f} MB": megabytes > MOST_MEGABYTES,
    }
    return [what for what, is_so in amiss.items() if is_so], seconds, megabytes


def main() -> int:
    """Print what is amiss, and the worst of all."""
    inputs, wrong, times, memory = list(bad_inputs()), 0, list[float](), list[float]()
    for bad in inputs:
        with tempfile.TemporaryDirectory() as folder:
            amiss, seconds, megabytes = checked(bad, Path(folder))
        times.append(seconds)
        memory.append(megabytes)
        if amiss:
            wrong += 1
            sys.stdout.write(f"{ascii(bad.about)[:70]}: {', '.join(amiss)}\n")
    sys.stdout.write(
        f"{len(inputs)} bad inputs, {len(inputs) - wrong} with code and line and within "
        f"{MOST_SECONDS:g} s and {MOST_MEGABYTES:g} MB; at most {max(times):.2f} s of processor "
        f"(half of them {sorted(times)[len(times) // 2]:.2f} s) and {max(memory):.0f} MB\n"
    )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
