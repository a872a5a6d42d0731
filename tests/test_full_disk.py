"""Disks that are full, and folders that turn read-only while a batch runs: on a file system of its own in memory."""

import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.run import Options, run_batch
from pwatrack.cli import app
from pwatrack.report.run_folder import INDEX, read_index
from tests.stand_ins import bulky

Remount = Callable[[str], None]


def mounted(*arguments: str) -> bool:
    return subprocess.run(["mount", *arguments], stderr=subprocess.DEVNULL).returncode == 0


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 600 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    if os.geteuid() or not mounted("-t", "tmpfs", "-o", "size=600k", "none", str(place)):
        pytest.skip("only root mounts a file system")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def remounted(disk: Path, options: str) -> None:
    """Mount a disk with other options, as soon as nobody is writing."""
    limit = time.monotonic() + 60
    while not mounted("-o", f"remount,{options}", str(disk)):
        assert time.monotonic() < limit
        time.sleep(0.001)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten specs, which leave 100 kB each."""
    (tmp_path / "specs").mkdir()
    for k in range(10):
        (tmp_path / "specs" / f"exit0 {k}.yaml").touch()
    return tmp_path / "specs"


def run(folder: Path, out: Path, told: Callable[[SpecOutcome], None] = lambda _: None) -> list[SpecOutcome]:
    options = Options(again="changed", jobs=2)
    return run_batch(folder, out, options, work=bulky, preload=["tests.stand_ins"], told=told)


def whole(out: Path) -> set[str]:
    """Return which runs are told to be complete, and check that they are."""
    found = set()
    for path in out.glob(f"*/{INDEX}"):
        index = json.loads(path.read_text())
        if index["verdict"] != "incomplete":
            found.add(path.parent.name)
            for name, known in index["files"].items():
                assert path.with_name(name).stat().st_size == known["bytes"]
    return found


def check_gone_on(folder: Path, out: Path, first: list[SpecOutcome], reason: str, least: int) -> None:
    """Check what a batch left that met a wall, and that the next one goes on from there.

    A run whose record met the wall is done again: of at least ``least`` runs it was written before.
    """
    passed = {o.folder.name for o in first if o.passed}
    assert 0 < len(passed) < 10
    assert whole(out) == passed
    assert all(o.exit == 2 and reason in o.messages for o in first if not o.passed)
    records = len(list((out / ".batch").glob("*.json")))
    assert least <= records <= len(passed)
    again = run(folder, out)
    assert all(o.passed for o in again)
    assert sum(o.how == "cached" for o in again) == records
    assert len(whole(out)) == 10
    assert not [path for path in out.rglob(".*") if path.name != ".batch"]


def test_a_batch_on_a_disk_that_gets_full_goes_on_once_there_is_room(folder: Path, disk: Path) -> None:
    first = run(folder, disk / "out")
    remounted(disk, "size=4m")
    check_gone_on(folder, disk / "out", first, "No space left on device", least=1)


class ReadOnly:
    """Makes a disk read-only after three specs."""

    def __init__(self, disk: Path) -> None:
        self.disk, self.count = disk, 0

    def ended(self, outcome: SpecOutcome) -> None:
        self.count += outcome.passed
        if self.count == 3 and outcome.passed:
            remounted(self.disk, "ro")


def test_a_batch_in_a_folder_that_turns_read_only_goes_on_once_it_can_be_written(folder: Path, disk: Path) -> None:
    remounted(disk, "size=4m")
    first = run(folder, disk / "out", ReadOnly(disk).ended)
    remounted(disk, "rw")
    check_gone_on(folder, disk / "out", first, "Read-only file system", least=3)


@pytest.mark.slow
def test_a_run_that_finds_no_room_leaves_the_earlier_one_as_it_was(specs: Path, disk: Path) -> None:
    arguments = ["simulate", str(specs / "two_mass_paper_gains.yaml"), "--plots", "none", "--out", str(disk / "out")]
    remounted(disk, "size=8m")
    assert CliRunner().invoke(app, arguments).exit_code == 0
    before = {path.name: path.read_bytes() for path in (disk / "out").iterdir()}
    (disk / "filler").write_bytes(bytes(room(disk) - 100_000))
    found = CliRunner().invoke(app, [*arguments, "--set", "k2=0.3"])
    assert found.exit_code == 2
    assert "No space left on device" in found.stderr
    assert {path.name: path.read_bytes() for path in (disk / "out").iterdir()} == before
    assert read_index(disk / "out") is not None


def room(disk: Path) -> int:
    found = os.statvfs(disk)
    return found.f_bavail * found.f_bsize
