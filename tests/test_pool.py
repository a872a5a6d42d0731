import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import pwatrack
from pwatrack.batch.pool import Lost, Pool

OWNER = """
import sys, time
from pwatrack.batch.pool import Pool
if __name__ == "__main__":
    from tests.test_pool import sleeping
    with Pool(2) as pool:
        futures = [pool.submit(sleeping, sys.argv[1] + str(k), 60) for k in range(3)]
        futures[0].result()
"""


def sleeping(path: str, seconds: float) -> None:
    """Leave the number of the process in a file."""
    Path(path).write_text(str(os.getpid()))
    time.sleep(seconds)


def suicide(number: int) -> None:
    os.kill(os.getpid(), number)


def unpicklable() -> object:
    return lambda: 0


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def seen(paths: list[Path]) -> list[int]:
    """Wait for the numbers of processes."""
    while not all(path.exists() and path.read_text() for path in paths):
        time.sleep(0.01)
    return [int(path.read_text()) for path in paths]


ASKS = """
import os
import pwatrack
from importlib import import_module
from pwatrack.batch.pool import Pool
def where():
    return import_module("pwatrack").__file__ + " " + os.environ.get("PYTHONSAFEPATH", "-")
if __name__ == "__main__":
    with Pool(1) as pool:
        print(pwatrack.__file__, pool.submit(where).result(), os.environ.get("PYTHONSAFEPATH", "-"))
"""


def test_what_a_task_returns_or_raises_comes_back() -> None:
    with Pool(2) as pool:
        futures = [pool.submit(divmod, k, 3) for k in range(20)]
        failed, odd = pool.submit(divmod, 1, 0), pool.submit(unpicklable)
        assert [future.result() for future in futures] == [divmod(k, 3) for k in range(20)]
        with pytest.raises(ZeroDivisionError):
            failed.result()
        with pytest.raises(RuntimeError, match="pickle"):
            odd.result()
    with pytest.raises(RuntimeError, match="shutdown"):
        pool.submit(divmod, 1, 1)


@pytest.mark.parametrize("jobs", [1, 3])
def test_each_death_costs_one_task(jobs: int) -> None:
    with Pool(jobs) as pool:
        futures = [pool.submit(*((suicide, 9) if k % 3 == 0 else (divmod, k, 3))) for k in range(12)]
        lost = [k for k, future in enumerate(futures) if isinstance(future.exception(), Lost)]
    assert lost == [0, 3, 6, 9]


def test_a_death_between_tasks_costs_none() -> None:
    """The kernel kills what is large where memory is short, whatever it is at."""
    with Pool(2) as pool:
        for _ in range(3):
            pid = pool.submit(os.getpid).result()
            os.kill(pid, signal.SIGKILL)
            while alive(pid):
                time.sleep(0.01)
            assert [pool.submit(divmod, k, 3).result() for k in range(4)] == [divmod(k, 3) for k in range(4)]


def interrupted(folder: Path) -> tuple[list[Future[Any]], int]:
    """Begin three tasks with one process and be interrupted; return them, and the number of the process."""
    with suppress(KeyboardInterrupt), Pool(1) as pool:
        futures = [pool.submit(sleeping, str(folder / str(k)), 60) for k in range(3)]
        (pid,) = seen([folder / "0"])
        raise KeyboardInterrupt
    return futures, pid


def test_an_interruption_ends_what_is_done_and_cancels_what_waits(tmp_path: Path) -> None:
    futures, pid = interrupted(tmp_path)
    assert isinstance(futures[0].exception(), Lost)
    assert [future.cancelled() for future in futures] == [False, True, True]
    assert not alive(pid)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_workers_end_with_their_owner_however_it_ends(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "owner.py").write_text(OWNER)
    command = [sys.executable, str(tmp_path / "owner.py"), str(tmp_path / "pid")]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment) as owner:
        pids = seen([tmp_path / "pid0", tmp_path / "pid1"])
        owner.send_signal(number)
        owner.wait()
    limit = time.monotonic() + 30
    while any(map(alive, pids)) and time.monotonic() < limit:
        time.sleep(0.01)
    assert not any(map(alive, pids))
    assert not (tmp_path / "pid2").exists()


def test_what_works_is_this_package_and_not_one_in_the_working_directory(tmp_path: Path) -> None:
    other = tmp_path / "pwatrack"
    other.mkdir()
    (other / "__init__.py").write_text("raise SystemExit('another one')")
    script = tmp_path / "elsewhere" / "ask.py"
    script.parent.mkdir()
    script.write_text(ASKS)
    said = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    here, there, inside, outside = said.stdout.split()
    assert here == there
    assert Path(here) != other / "__init__.py"
    assert inside == outside == "-"


def test_a_copy_that_is_found_in_the_working_directory_alone_works_with_itself(tmp_path: Path) -> None:
    shutil.copytree(Path(pwatrack.__file__).parent, tmp_path / "pwatrack", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "ask.py").write_text(ASKS)
    run = [sys.executable, "-m", "ask"]
    said = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=120)
    here, there, *_ = said.stdout.split()
    assert here == there == str(tmp_path / "pwatrack" / "__init__.py")
