import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.run import Options, run_batch
from pwatrack.batch.work import Ended
from pwatrack.report.run_folder import INDEX, read_index
from tests.runs import record
from tests.stand_ins import count, written

SPEC = "name: {name}\nreference: {{table: {{file: {name}.csv}}}}\n"


def make(folder: Path, names: tuple[str, ...] = ("exit0", "exit4", "exit6")) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / f"{name}.yaml").write_text(SPEC.format(name=name), encoding="utf-8")
        (folder / f"{name}.csv").write_text("t,y\n0,1\n", encoding="utf-8")
    return folder


def again(folder: Path, out: Path, which: Any = "changed", **options: Any) -> dict[str, str]:
    """Run a batch again and return what the table says of each spec."""
    outcomes = run_batch(folder, out, Options(again=which, **options), work=written)
    return {o.spec.stem: o.result for o in outcomes}


ALL = {"exit0": "pass", "exit4": "FAIL", "exit6": "FAIL"}
CACHED = {"exit0": "cached", "exit4": "FAIL, cached", "exit6": "FAIL, cached"}


def test_what_has_not_changed_is_not_run_again(tmp_path: Path) -> None:
    folder, out = make(tmp_path / "specs"), tmp_path / "out"
    assert again(folder, out) == ALL
    assert again(folder, out) == CACHED
    assert count(out) == 3
    assert again(folder, out, "failed") == {**ALL, "exit0": "cached"}
    assert count(out) == 5
    assert again(folder, out, "all") == ALL


def test_a_cached_outcome_says_what_the_run_said(tmp_path: Path) -> None:
    folder, out = make(tmp_path / "specs"), tmp_path / "out"
    first = run_batch(folder, out, work=written)
    second = run_batch(folder, out, Options(again="changed"), work=written)
    for one, two in zip(first, second, strict=True):
        fields = ("exit", "figures", "messages", "faults", "required", "code", "folder")
        assert [getattr(one, name) for name in fields] == [getattr(two, name) for name in fields]
    assert any(outcome.faults for outcome in second)


CHANGES = {
    "spec": lambda folder, _: (folder / "exit0.yaml").write_text("name: other\n"),
    "table": lambda folder, _: (folder / "exit0.csv").write_text("t,y\n0,2\n"),
    "no table": lambda folder, _: (folder / "exit0.csv").unlink(),
    "a file is gone": lambda _, out: (out / "exit0" / "gains.json").unlink(),
    "a file is shorter": lambda _, out: (out / "exit0" / "gains.json").write_text("{"),
    "a file has other bytes": lambda _, out: (out / "exit0" / "gains.json").write_text("[]"),
    "index": lambda _, out: (out / "exit0" / INDEX).write_text("{}"),
    "another run": lambda _, out: record(out / "exit0", {"verdict": "proved", "exit": 0}),
    "torn record": lambda _, out: [p.write_bytes(p.read_bytes()[:-9]) for p in (out / ".batch").glob("*.json")],
    "foreign record": lambda _, out: [p.write_text("[1]") for p in (out / ".batch").glob("*.json")],
}


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_what_has_changed_is_run_again(tmp_path: Path, change: Any) -> None:
    folder, out = make(tmp_path / "specs", ("exit0",)), tmp_path / "out"
    assert again(folder, out) == {"exit0": "pass"}
    change(folder, out)
    assert again(folder, out) == {"exit0": "pass"}
    assert again(folder, out) == {"exit0": "cached"}


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"parameters": ("k2=1",)}, {"plots": "none"}])
def test_other_options_are_another_run(tmp_path: Path, options: dict[str, Any]) -> None:
    folder, out = make(tmp_path / "specs", ("exit0",)), tmp_path / "out"
    again(folder, out)
    assert again(folder, out, **options) == {"exit0": "pass"}
    assert again(folder, out, jobs=2, timeout=30.0, **options) == {"exit0": "cached"}


def test_times_of_files_alone_are_no_change(tmp_path: Path) -> None:
    folder, out = make(tmp_path / "specs", ("exit0",)), tmp_path / "out"
    again(folder, out)
    for path in (folder / "exit0.yaml", out / "exit0" / "gains.json"):
        os.utime(path, (1, 1))
    assert again(folder, out) == {"exit0": "cached"}


def test_what_left_no_folder_is_run_again(tmp_path: Path) -> None:
    folder, out = make(tmp_path / "specs", ("exit2", "killed")), tmp_path / "out"
    for _ in range(2):
        assert again(folder, out) == {"exit2": "FAIL", "killed": "FAIL"}
    assert read_index(out / "exit2") is None


def test_leftovers_of_killed_runs_are_swept_and_those_at_work_stay(tmp_path: Path) -> None:
    folder, out = make(tmp_path / "specs", ("exit0",)), tmp_path / "out"
    again(folder, out)
    dead, alive = (f".pwatrack-{letter * 16}" for letter in "da")
    for name in (dead, alive):
        (out / "exit0" / name).mkdir()
    (temporary,) = (p.with_name(f".{p.name}.{'0' * 16}") for p in (out / ".batch").glob("*.json"))
    temporary.touch()
    hold = "import fcntl, os, sys; fcntl.flock(os.open(sys.argv[1], 0), fcntl.LOCK_EX); print(flush=True); input()"
    command = [sys.executable, "-S", "-c", hold, str(out / "exit0" / alive)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        assert again(folder, out) == {"exit0": "cached"}
        assert [path.name for path in (out / "exit0").glob(".*")] == [alive]
        holder.communicate(b"\n")
    assert again(folder, out, "all") == {"exit0": "pass"}
    assert not list((out / "exit0").glob(".*"))
    assert not temporary.exists()


@pytest.mark.slow
def test_two_batches_into_one_folder_do_not_harm_each_other(tmp_path: Path) -> None:
    names = tuple(f"exit0 {k}" for k in range(30))
    folder, out = make(tmp_path / "specs", names), tmp_path / "out"
    with batches(folder, out) as one, batches(folder, out) as two:
        assert (one.wait(), two.wait()) == (0, 0)
    assert set(again(folder, out).values()) <= {"cached", "pass"}
    assert set(again(folder, out).values()) == {"cached"}
    assert not [path for path in out.rglob(".*") if path.name != ".batch"]


PROGRAM = """
import sys
from pathlib import Path
from pwatrack.batch.run import Options, run_batch
if __name__ == "__main__":
    from tests.stand_ins import written
    options = Options(again="changed", jobs=2)
    run_batch(Path(sys.argv[1]), Path(sys.argv[2]), options, work=written, preload=["tests.stand_ins"])
"""


def batches(folder: Path, out: Path) -> subprocess.Popen[bytes]:
    (folder.parent / "program.py").write_text(PROGRAM)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, str(folder.parent / "program.py"), str(folder), str(out)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_batch_that_is_killed_goes_on_where_it_was(tmp_path: Path, number: signal.Signals) -> None:
    names = tuple(f"exit0 {k:02}" for k in range(24))
    folder, out = make(tmp_path / "specs", names), tmp_path / "out"
    for finished in (3, 12):
        with batches(folder, out) as process:
            while len(list((out / ".batch").glob("*.json"))) < finished and process.poll() is None:
                time.sleep(0.002)
            process.send_signal(number)
        for path in out.glob("*/" + INDEX):
            assert json.loads(path.read_text())["verdict"] in ("proved", "incomplete")
    before = count(out)
    outcomes = run_batch(folder, out, Options(again="changed"), work=written)
    assert all(o.passed for o in outcomes)
    assert sum(o.how == "cached" for o in outcomes) >= 12
    assert count(out) <= len(names) + 2 * 2  # of each interrupted batch, two were in flight
    ran = sum(o.how == "run" for o in outcomes)
    assert ran <= count(out) - before <= ran + 2  # what was in flight may have ended since it was counted
    assert not [path for path in out.rglob(".*") if path.name != ".batch"]


@pytest.mark.slow
def test_without_a_place_for_records_all_is_run_again(tmp_path: Path) -> None:
    folder, out = make(tmp_path / "specs", ("exit0",)), tmp_path / "out"
    out.mkdir()
    (out / ".batch").touch()
    for _ in range(2):
        assert again(folder, out) == {"exit0": "pass"}


def test_a_run_without_a_key_is_not_remembered() -> None:
    assert SpecOutcome.of(Path("a.yaml"), Path("a"), Ended(exit=0), seconds=1.0, cached=True).result == "cached"
