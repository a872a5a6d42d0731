"""Kill a batch at random moments, go on with --resume, and count what is torn, lost, left over, repeated or orphaned.

    python -m benchmarks.kills [KILLS] [SIGNAL]

200 kills with SIGKILL where nothing is said; SIGNAL is KILL, INT or TERM. Each round begins with an empty folder.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from importlib.resources import files
from pathlib import Path

import numpy as np

from pwatrack.report.run_folder import INDEX

SPECS, JOBS = 24, 2


def begun(specs: Path, out: Path) -> subprocess.Popen[bytes]:
    """Start a batch that goes on where the last one was."""
    command = [sys.executable, "-m", "pwatrack", "batch", str(specs), "--out", str(out), "--jobs", str(JOBS)]
    nowhere = subprocess.DEVNULL
    command += ["--plots", "none", "--resume", "--report", str(out / "report.jsonl")]
    return subprocess.Popen(command, stdout=nowhere, stderr=nowhere, start_new_session=True)


def finished(out: Path) -> dict[str, str]:
    """Return the digest of the index of every run that has a record: a run that is repeated has another one."""
    return {path.name: json.loads(path.read_bytes())["index"] for path in (out / ".batch").glob("*.json")}


def torn(out: Path) -> int:
    """Count files of finished runs that are not as their index says, and indexes that are not whole."""
    count = 0
    for path in out.glob(f"*/{INDEX}"):
        index = json.loads(path.read_text(encoding="utf-8"))  # an index that is not whole ends the benchmark
        if index["verdict"] != "incomplete":
            there = {name: path.with_name(name) for name in index["files"]}
            count += sum(not f.exists() or f.stat().st_size != index["files"][n]["bytes"] for n, f in there.items())
    return count


def alive(group: int) -> int:
    """Count the processes of a batch that are still there, after as long as they may take to notice."""
    left: list[Path] = []
    for _ in range(100):
        left = [path for path in Path("/proc").glob("[0-9]*") if group_of(path) == group]
        if not left:
            break
        time.sleep(0.1)
    return len(left)


def group_of(process: Path) -> int | None:
    """Return the group of a process, None if it has ended."""
    try:
        state, _, group, *_ = (process / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if state == "Z" else int(group)


def main(kills: int, number: signal.Signals) -> None:
    """Print the counts."""
    draw = np.random.default_rng(1)
    text = files("pwatrack.starters").joinpath("output.yaml").read_text(encoding="utf-8")
    counts = dict.fromkeys(("torn", "lost", "leftovers", "orphans", "repeated", "in flight at most"), 0)
    with tempfile.TemporaryDirectory() as name:
        specs = Path(name) / "specs"
        specs.mkdir()
        for k in range(SPECS):
            (specs / f"spec{k}.yaml").write_text(text.replace("duration: 20", f"duration: {2 + k % 3}"))
        begun(specs, Path(name) / "first").wait()  # which may have to compile what is kept on disk from then on
        done, out, whole, round_ = 0, Path(name) / "0", 0.0, 0
        while done < kills:
            sys.stderr.write(f"\r{done} of {kills} times, {round_} batches ended")
            before, start = finished(out), time.monotonic()
            process = begun(specs, out)
            limit = draw.uniform(0, whole) if whole else None  # the next batch is measured and not killed
            try:
                process.wait(limit)
                whole = whole or time.monotonic() - start
                same = {run: at for run, at in finished(out).items() if before.get(run, at) != at}
                counts["lost"] += len(same)  # run again, though finished before
                counts["lost"] += SPECS - len(finished(out))
                counts["leftovers"] += len([p for p in out.rglob(".*") if p.name != ".batch"])
                round_ += 1
                out = Path(name) / str(round_)
            except subprocess.TimeoutExpired:
                process.send_signal(number)
                process.wait()
                done += 1
                counts["orphans"] += alive(process.pid)
                counts["torn"] += torn(out)
                stages = len(list(out.glob("*/.pwatrack-*")))
                counts["repeated"] += stages
                counts["in flight at most"] = max(counts["in flight at most"], stages)
    said = ", ".join(f"{count} {what}" for what, count in counts.items())
    sys.stderr.write("\r\033[K")
    sys.stdout.write(f"{done} times {number.name}, {round_} batches of {SPECS} specs ended: {said}\n")


if __name__ == "__main__":
    for thread in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(thread, "1")
    wanted = sys.argv[2] if len(sys.argv) > 2 else "KILL"
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200, signal.Signals[f"SIG{wanted}"])
