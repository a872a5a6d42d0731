import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from pwatrack.errors import InvalidSpec
from pwatrack.report.run_folder import INDEX, kept_files, read_index, run_folder, written_at_once
from tests.runs import NAMES, RUNS, write

# Runs from `first` on, each with its number in all its files; a signal comes at the n-th change of a name.
PROGRAM = """
import itertools, os, sys
from tests.runs import write
folder, first, fatal, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
seen = itertools.count(1)
def hook(event, arguments):
    if event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir") and next(seen) == number:
        os.kill(os.getpid(), fatal)
sys.addaudithook(hook)
print("ready", flush=True)
for k in itertools.count(first) if number == 0 else [first]:
    write(folder, k)
"""


def child(folder: Path, first: int, fatal: int, number: int) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", PROGRAM, str(folder), str(first), str(fatal), str(number)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def told(folder: Path) -> int | None:
    """Return the number of the run that a folder tells; fail if it is torn."""
    index = read_index(folder)
    if index is None:
        return None
    files = {path.name for path in folder.iterdir() if not path.name.startswith(".")} - {"notes.txt", INDEX}
    assert files == set(index["files"]) == set(RUNS[index["number"] % 3])
    assert {json.loads((folder / name).read_text())["number"] for name in files} == {index["number"]}
    return int(index["number"])


def stages(folder: Path) -> list[Path]:
    return list(folder.glob(".*"))


@pytest.mark.slow
@pytest.mark.parametrize(("earlier", "first"), [(0, 1), (1, 2), (0, 2)])
def test_a_run_that_is_killed_at_any_change_of_a_name_leaves_one_run_whole_or_none(
    tmp_path: Path, earlier: int, first: int
) -> None:
    """In between there is never a proof beside files of another run; the next run clears away all that is left."""
    seen = set()
    for number in range(1, 30):
        folder = tmp_path / str(number)
        write(folder, earlier)
        (folder / "notes.txt").write_text("mine")
        with child(folder, first, signal.SIGKILL, number) as process:
            process.wait()
        seen.add(told(folder))
        proofs = [path for path in folder.glob("*.json") if path.name in ("certificate.json", "refusal.json")]
        numbers = {json.loads(path.read_text())["number"] for path in proofs}
        others = [folder / name for name in ("gains.json", "trace.csv") if (folder / name).exists()]
        assert len(numbers | {json.loads(path.read_text())["number"] for path in others if numbers}) <= 1
        write(folder, 5)
        assert (told(folder), stages(folder), kept_files(folder)) == (5, [], [])
        assert (folder / "notes.txt").read_text() == "mine"
        if process.returncode == 0:
            break
    assert seen == {earlier, None, first}
    assert 8 < number < 29


@pytest.mark.slow
@pytest.mark.parametrize("fatal", [signal.SIGTERM, signal.SIGINT])
def test_a_run_that_is_interrupted_at_any_change_of_a_name_leaves_one_run_whole(tmp_path: Path, fatal: int) -> None:
    seen = set()
    for number in range(1, 30):
        folder = tmp_path / str(number)
        write(folder, 0)
        with child(folder, 1, fatal, number) as process:
            process.wait()
        seen.add(told(folder))
        if process.returncode == 0:
            break
        assert process.returncode in (-fatal, 1)
    assert seen == {0, 1}


def test_a_run_that_is_killed_at_any_time_leaves_one_run_whole_or_none(tmp_path: Path) -> None:
    write(tmp_path, 0)
    seen: list[int | None] = []
    for _ in range(8):
        with child(tmp_path, (seen[-1] or 0) + 1 if seen else 1, 0, 0) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(random.uniform(0.0, 0.05))
            process.kill()
        seen.append(told(tmp_path))
    write(tmp_path, 4)
    assert (told(tmp_path), stages(tmp_path), kept_files(tmp_path)) == (4, [], [])


def test_the_files_of_a_run_at_work_are_left_to_it(tmp_path: Path) -> None:
    with run_folder(tmp_path) as slow:
        slow.text("gains.json", "slow")
        write(tmp_path, 0)
        assert told(tmp_path) == 0
        slow.commit({"verdict": "proved"})
    assert (tmp_path / "gains.json").read_text() == "slow"
    assert {path.name for path in tmp_path.iterdir()} == {"gains.json", INDEX}


def test_a_block_without_commit_changes_nothing(tmp_path: Path) -> None:
    write(tmp_path, 0)
    with run_folder(tmp_path) as run:
        run.text("gains.json", "half")
    assert (told(tmp_path), stages(tmp_path)) == (0, [])


FOREIGN: list[dict[str, Any]] = [
    {"files": ["other.txt", "gains.json"]},
    {"format": "pwatrack run 1", "files": ["other.txt", "gains.json"]},
    {"format": "pwatrack run 1", "verdict": "proved", "files": {"other.txt": {}, "gains.json": {"bytes": 4}}},
    {"format": "pwatrack run 1", "verdict": "incomplete", "files": {"../other.txt": None, "gains.json": None}},
]


@pytest.mark.parametrize("index", FOREIGN)
def test_what_no_run_wrote_is_never_lost(tmp_path: Path, index: dict[str, Any]) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    mine = ("other.txt", "gains.json", "cells.png", "gains.json~")
    for path in (*(folder / name for name in mine), tmp_path / "other.txt"):
        path.write_text("mine")
    (folder / INDEX).write_text(json.dumps(index))
    write(folder, 0)
    found = {path.name: path.read_text() for path in folder.iterdir()}
    assert found["other.txt"] == found["gains.json~"] == found["gains.json~2"] == found["cells.png~"] == "mine"
    assert (tmp_path / "other.txt").read_text() == "mine"
    assert set(found) >= {*NAMES, INDEX}
    assert "cells.png" not in found
    assert ("run.json~" in found) == (read_index_of(index) is None)


def test_a_forged_record_of_a_file_that_runs_do_not_have_removes_nothing(tmp_path: Path) -> None:
    write(tmp_path, 0)
    index = read_index(tmp_path)
    assert index is not None
    (tmp_path / "other.txt").write_bytes((tmp_path / "gains.json").read_bytes())
    index["files"]["other.txt"] = index["files"]["gains.json"]
    (tmp_path / INDEX).write_text(json.dumps(index))
    write(tmp_path, 1)
    assert (tmp_path / "other.txt").is_file()


def test_a_file_that_was_changed_since_it_was_written_is_kept(tmp_path: Path) -> None:
    write(tmp_path, 0)
    (tmp_path / "gains.json").write_text("edited")
    write(tmp_path, 1)
    assert (tmp_path / "gains.json~").read_text() == "edited"
    assert kept_files(tmp_path) == ["gains.json~"]
    assert not (tmp_path / "gains.json").exists()


def test_a_file_of_another_name_than_those_of_runs_is_none_of_a_run(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"notes\.txt is none"), run_folder(tmp_path) as run:
        run.text("notes.txt", "")


def test_many_runs_at_once_leave_the_whole_of_one(tmp_path: Path) -> None:
    processes = [child(tmp_path, number, 0, 99) for number in range(6)]
    assert [process.wait() for process in processes] == [0] * 6
    for process in processes:
        assert process.stdout is not None
        process.stdout.close()
    assert told(tmp_path) in range(6)
    assert stages(tmp_path) == []


@pytest.mark.parametrize("name", ["file", "file/below"])
def test_what_cannot_be_written_is_said(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InvalidSpec, match="cannot write results"):
        write(tmp_path / name, 0)
    with pytest.raises(InvalidSpec, match="cannot write"), written_at_once(tmp_path / name / "x") as path:
        path.touch()
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def read_index_of(index: dict[str, Any]) -> object:
    return index if isinstance(index["files"], dict) else None
