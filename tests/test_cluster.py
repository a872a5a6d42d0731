"""Two dask workers on the loopback address, as docs/cluster.md starts them; one of them is killed on the way."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pwatrack import ensemble, load_spec, simulate
from pwatrack.batch.cluster import Cluster
from pwatrack.batch.outcomes import SpecOutcome
from pwatrack.batch.pool import Lost, Pool
from pwatrack.batch.run import Options, run_batch
from pwatrack.batch.sweep import places, sweep
from pwatrack.cli import app
from pwatrack.errors import InvalidSpec
from pwatrack.report.codes import code_of
from pwatrack.spec.axis import axis
from pwatrack.version import __version__
from tests.stand_ins import work
from tests.test_pool import sleeping, suicide
from tests.test_sweep import SPEC

pytest.importorskip("distributed")

HOME = Path(__file__).parents[1]

TABLE = "t,y\n" + "".join(f"{t},{0.01 * (t % 3)}\n" for t in range(40))
TABLED = SPEC.replace('"0.2*sin(t)"', "{table: {file: course.csv}}")


def dask(kind: str, *options: str, home: Path = HOME) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, "--no-dashboard"]
    environment = {**os.environ, "PYTHONPATH": str(home)}
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, env=environment, cwd=home, **silent)  # type: ignore[call-overload, no-any-return]


@contextmanager
def scheduler_and_worker(folder: Path, home: Path = HOME) -> Iterator[str]:
    """A scheduler with one worker, which imports pwatrack from its home; gives its address."""
    file = folder / "scheduler.json"
    with dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)) as process:
        while not file.exists() or not file.read_text():
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        local = "--local-directory", str(folder)
        with dask("worker", address, "--nthreads", "1", *local, home=home) as worker:
            try:
                yield address
            finally:
                worker.terminate()
                worker.wait()
                process.terminate()


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with scheduler_and_worker(tmp_path_factory.mktemp("dask")) as address:
        yield address


@pytest.fixture
def second(scheduler: str) -> Iterator["subprocess.Popen[bytes]"]:
    """A second worker, which can be killed: nobody starts it again."""
    with dask("worker", scheduler, "--nthreads", "1", "--no-nanny") as worker:
        with Cluster(scheduler) as cluster:
            while cluster.jobs < 2:
                time.sleep(0.05)
        yield worker
        worker.kill()


class Killing:
    """Kills a worker when some have ended."""

    def __init__(self, worker: "subprocess.Popen[bytes]", after: int) -> None:
        self.worker, self.after, self.count = worker, after, 0

    def ended(self, outcome: SpecOutcome) -> None:
        self.progress(self.count + (outcome.how == "run"), 0)

    def progress(self, done: int, _: int) -> None:
        self.count = done
        if done == self.after:
            self.worker.kill()


@pytest.fixture
def folder(specs: Path, tmp_path: Path) -> Path:
    """Specs that end in all ways, one of which refers to a table."""
    folder = tmp_path / "specs"
    (folder / "below").mkdir(parents=True)
    for k in range(6):
        (folder / f"drive{k}.yaml").write_text(SPEC.replace("a: 0,", f"a: {k / 4},"))
    (folder / "tabled.yaml").write_text(TABLED)
    (folder / "course.csv").write_text(TABLE)
    (folder / "below" / "absent.yaml").write_text(TABLED)
    (folder / "below" / "outside.yaml").write_text(TABLED.replace("course", "../course"))
    (folder / "wrong.yaml").write_text(SPEC.replace("duration", "duratoin"))
    (folder / "no.yaml").write_text("name: [")
    (folder / "jump.yaml").write_text((specs / "refused" / "printed_A1.yaml").read_text())
    return folder


def contents(out: Path) -> dict[str, Any]:
    """Return what the files of runs hold, without the times that they took."""
    found: dict[str, Any] = {
        str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*.*") if ".batch" not in p.parts
    }
    for name, content in found.items():
        if name.endswith("run.json"):
            found[name] = {k: v for k, v in json.loads(content).items() if k != "seconds"}
    return found


def said(outcomes: list[SpecOutcome], out: Path) -> list[Any]:
    return [
        (o.spec, o.exit, o.expected, o.figures, o.notes, o.messages.replace(str(out), ""), o.faults) for o in outcomes
    ]


@pytest.mark.slow
def test_a_batch_is_the_same_on_two_workers_of_which_one_is_killed(
    scheduler: str, second: "subprocess.Popen[bytes]", folder: Path, tmp_path: Path
) -> None:
    local, remote = tmp_path / "local", tmp_path / "remote"
    here = run_batch(folder, local, Options(plots="failed"))
    with Cluster(scheduler, timeout=300) as cluster:
        watcher = Killing(second, 2)
        there = run_batch(folder, remote, Options(plots="failed", jobs=2), executor=cluster, told=watcher.ended)
    assert watcher.count == len(there) == 12
    assert said(here, local) == said(there, remote)
    assert {o.exit for o in there} >= {0, 2, 3, 4}
    assert contents(local) == contents(remote)
    assert len(contents(remote)) > 30
    again = run_batch(folder, remote, Options(plots="failed", again="changed"))
    assert {o.spec.stem for o in again if o.how == "run"} == {
        "wrong",
        "no",
        "absent",
        "outside",
    }  # specs in error leave no run


@pytest.mark.slow
def test_a_sweep_is_the_same_on_two_workers_of_which_one_is_killed(
    scheduler: str, second: "subprocess.Popen[bytes]", folder: Path
) -> None:
    axes = [axis("a=0:1.6:5"), axis("b=0:1.5:4")]
    found = list[Any]()
    with ExitStack() as stack:
        executors = stack.enter_context(Pool(1)), stack.enter_context(Cluster(scheduler))
        for executor, progress in zip(executors, (lambda *_: None, Killing(second, 4).progress), strict=True):
            at = places(axes)
            found.append(
                sweep(folder / "tabled.yaml", axes, executor, at=at, simulated=True, refine=1e-3, progress=progress)
            )
    assert found[0] == found[1]
    assert second.wait() == -signal.SIGKILL
    points, edges = found[0]
    assert {point.verdict for point in points} == {"proved", "infeasible"}
    assert edges


@pytest.mark.parametrize("over", ["initial", "parameters"])
def test_an_ensemble_is_the_same_on_a_worker(scheduler: str, folder: Path, over: Any) -> None:
    result = simulate(load_spec(folder / "drive1.yaml"))
    with Cluster(scheduler) as cluster:
        there = ensemble(result, 7, over=over, executor=cluster, workers=cluster.jobs)
    here = ensemble(result, 7, over=over)
    assert np.array_equal(here.ensemble.error, there.ensemble.error)
    assert (here.outcomes, here.figures) == (there.outcomes, there.figures)
    assert np.array_equal(here.ensemble.mode_changes, there.ensemble.mode_changes)


def test_what_kills_or_hangs_a_task_is_lost_there_too_and_the_worker_lives_on(scheduler: str) -> None:
    with Cluster(scheduler, timeout=2, preload=()) as cluster:
        dead, slow, wrong = (cluster.submit(*call) for call in ((suicide, 9), (time.sleep, 60), (divmod, 1, 0)))
        fine = cluster.submit(divmod, 7, 3)
        assert fine.result() == (2, 1)
        lost = [dead.exception(), slow.exception()]
        assert all(isinstance(error, Lost) for error in lost)
        assert [str(error) for error in lost] == ["killed by signal 9", "given up after 2 s"]
        with pytest.raises(ZeroDivisionError):
            wrong.result()


def test_what_nobody_waits_for_any_more_is_ended(scheduler: str, tmp_path: Path) -> None:
    with suppress(KeyboardInterrupt), Cluster(scheduler, preload=()) as cluster:
        futures = [cluster.submit(sleeping, str(tmp_path / str(k)), 600) for k in range(3)]
        until((tmp_path / "0").exists)
        raise KeyboardInterrupt
    assert all(future.cancelled() for future in futures)
    until(lambda: not Path("/proc", (tmp_path / "0").read_text()).exists())
    with Cluster(scheduler, preload=()) as cluster:
        assert cluster.submit(divmod, 7, 3).result() == (2, 1)
    assert not (tmp_path / "2").exists()


@pytest.mark.slow
def test_an_interruption_ends_with_130_and_what_was_completed(scheduler: str, folder: Path, tmp_path: Path) -> None:
    many = tmp_path / "many"
    many.mkdir()
    for k in range(60):
        (many / f"{k}.yaml").write_text((folder / "drive0.yaml").read_text())
    options = ["--scheduler", scheduler, "--plots", "none", "--out", str(tmp_path / "out")]
    command = [
        sys.executable,
        "-m",
        "pwatrack",
        "batch",
        str(many),
        *options,
        "--report",
        str(tmp_path / "ended.jsonl"),
    ]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        assert process.stderr is not None
        first = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        said = process.stderr.read().decode()
    assert process.returncode == 128 + signal.SIGINT
    assert b"pass" in first
    assert "Traceback" not in said
    ended = [json.loads(line) for line in (tmp_path / "ended.jsonl").read_text().splitlines()]
    assert 0 < len(ended) < 60
    assert not list((tmp_path / "out").glob("*/.*"))


def test_what_comes_back_and_cannot_be_written_fails_that_spec(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "drive1").touch()
    with ThreadPoolExecutor(1) as executor:
        outcomes = run_batch(folder, tmp_path / "out", Options(pattern="drive[01]*", plots="none"), executor=executor)
    assert [(o.spec.stem, o.exit, bool(o.figures)) for o in outcomes] == [("drive0", 0, True), ("drive1", 2, False)]
    assert "cannot write" in outcomes[1].messages
    assert (tmp_path / "out" / "drive0" / "trace.csv").exists()


def until(true: Callable[[], bool]) -> None:
    limit = time.monotonic() + 60
    while not true():
        assert time.monotonic() < limit
        time.sleep(0.05)


def test_a_failing_spec_fails_by_itself_there_too(scheduler: str, tmp_path: Path) -> None:
    (tmp_path / "specs").mkdir()
    for name in ("exit0", "killed", "hungry", "noisy"):
        (tmp_path / "specs" / f"{name}.yaml").touch()
    with Cluster(scheduler, memory=500, preload=()) as cluster:
        outcomes = run_batch(tmp_path / "specs", tmp_path / "out", work=work, executor=cluster)
    assert [(o.spec.stem, o.exit, o.verdict) for o in outcomes] == [
        ("exit0", 0, "proved"),
        ("hungry", None, "out of memory: it may take 500 MB"),
        ("killed", -9, "killed by signal 9"),
        ("noisy", 1, "crashed"),
    ]


def test_the_command_line_takes_a_scheduler(scheduler: str, folder: Path, tmp_path: Path) -> None:
    options = ["--scheduler", scheduler, "--plots", "none", "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, ["batch", str(folder / "drive0.yaml"), *options])
    assert run.exit_code == 0, run.output
    assert "1 passed, 0 failed" in run.stdout
    run = CliRunner().invoke(app, ["simulate", str(folder / "drive0.yaml"), "--ensemble", "3", *options])
    assert run.exit_code == 0, run.output
    assert "3 members" in run.stdout
    options = ["--sweep", "a=0:2:3", "--design", "--scheduler", scheduler, "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, ["sweep", str(folder / "drive0.yaml"), *options])
    assert run.exit_code == 0, run.output
    assert (tmp_path / "out" / "sweep.csv").exists()
    run = CliRunner().invoke(app, ["simulate", str(folder / "drive0.yaml"), "--scheduler", scheduler])
    assert run.exit_code == 2
    assert "--ensemble" in run.stderr


def test_where_no_scheduler_is_or_distributed_is_missing_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidSpec, match="no dask scheduler") as caught:
        Cluster("nonsense://nowhere")
    assert code_of(str(caught.value), caught.value.code) == "P211"
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InvalidSpec, match=r"not installed[\s\S]*pwatrack\[cluster\]"):
        Cluster("tcp://127.0.0.1:1")


@pytest.mark.slow
def test_a_worker_of_another_version_is_refused_by_both_names_and_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(HOME / "pwatrack", tmp_path / "home" / "pwatrack", ignore=shutil.ignore_patterns("__pycache__"))
    version = tmp_path / "home" / "pwatrack" / "version.py"
    text = version.read_text(encoding="utf-8").replace(f'"{__version__}"', '"0.0.9"')
    version.write_text(text, encoding="utf-8")
    words = f"a worker has pwatrack 0.0.9 instead of {__version__} [P211]\n  hint: install the same versions there"
    with scheduler_and_worker(tmp_path, tmp_path / "home") as address:
        for command in (["batch"], ["simulate", "--ensemble", "3"], ["sweep", "--sweep", "a=0:2:3", "--design"]):
            name, *options = command
            out = tmp_path / "out" / name
            where = [*options, "--scheduler", address, "--out", str(out)]
            run = CliRunner().invoke(app, [name, str(folder / "drive0.yaml"), *where])
            assert (run.exit_code, words in run.stderr) == (2, True), run.output
            assert not list(out.rglob("*.*"))
