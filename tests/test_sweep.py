import csv
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pwatrack.batch.pool import Lost
from pwatrack.batch.sweep import axis, look, places, sweep
from pwatrack.cli import app
from pwatrack.errors import InvalidSpec

SPEC = """
name: Unstable drive
parameters: {a: 0, b: 0}
system:
  states: [v]
  inputs: [u]
  outputs: [y]
  A: [[a + b]]
  B: [[1]]
  C: [[1]]
  nonlinearities: [{name: brake, kind: spring, of: v, start: 1, slope: 1, into: {v: -1}}]
design: {controller: {K: [[-1]]}}
reference: {output: "0.2*sin(t)"}
simulation: {duration: 30, sample_time: 0.1, initial: {plant: [0.1]}}
"""


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    """A plant for which (8) holds with the gain given if and only if a + b < 1."""
    (tmp_path / "drive.yaml").write_text(SPEC, encoding="utf-8")
    return tmp_path / "drive.yaml"


@pytest.mark.parametrize("method", ["random", "lhs"])
def test_places_that_are_drawn_are_within_and_the_same_every_time(method: Any) -> None:
    axes = [axis("a=-1:1"), axis("b=10:1e3")]
    one, again, other = (places(axes, method, 50, seed) for seed in (3, 3, 4))
    assert one == again != other
    assert all(-1 <= p["a"] <= 1 and 10 <= p["b"] <= 1000 for p in one)
    if method == "lhs":  # one in each fiftieth of every range
        assert sorted(int((p["a"] + 1) * 25) for p in one) == list(range(50))


def test_a_grid_has_the_numbers_that_are_written() -> None:
    assert [p["k"] for p in places([axis("k=0.1:0.9:9")])] == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]


@pytest.mark.parametrize(
    "text", ["k", "k=1", "k=1:0", "k=0:1:1", "k=0:1:x", "k=0:1:2:3", "2k=a:b", "k=1/0:1", "k=0:nan"]
)
def test_what_is_no_range_is_refused(text: str) -> None:
    with pytest.raises(InvalidSpec, match="--sweep"):
        axis(text)


@pytest.mark.parametrize("texts", [["a=0:1", "a=0:2"], ["a=0:1:10000", "b=0:1:10000"]])
def test_parameters_that_vary_twice_and_too_many_points_are_refused(texts: list[str]) -> None:
    with pytest.raises(InvalidSpec, match="--sweep"):
        places([axis(text) for text in texts])


def test_the_end_of_the_proof_is_where_the_theory_has_it(spec: Path) -> None:
    axes = [axis("a=0:1.6:5"), axis("b=0:1.5:4")]
    with ThreadPoolExecutor(1) as executor:
        points, edges = sweep(spec, axes, executor, at=places(axes), simulated=False, refine=1e-6)
    assert len(points) == 20
    for point in points:
        total = point.values["a"] + point.values["b"]
        assert point.proved == (total < 1), point
        if point.proved:
            assert point.figures["controller_rate"] == pytest.approx(1 - total, rel=1e-3)
    assert {edge.name for edge in edges} == {"a", "b"}
    for edge in edges:
        ends = [sum(point.values.values()) for point in (edge.proved, edge.refused)]
        assert ends[0] < 1 <= ends[1] <= ends[0] + 2e-6
        assert edge.proved.proved
        assert not edge.refused.proved


def test_a_point_that_is_lost_is_said_to_be(spec: Path) -> None:
    class Losing(Executor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            future: Future[Any] = Future()
            if args[4]["a"] == 0:
                future.set_exception(Lost("killed by signal 9"))
            else:
                future.set_result(fn(*args, **kwargs))
            return future

    axes = [axis("a=0:0.5:3")]
    points, edges = sweep(spec, axes, Losing(), at=places(axes), simulated=False, refine=0.1)
    assert [point.verdict for point in points] == ["lost", "proved", "proved"]
    assert points[0].said == "killed by signal 9"
    assert edges == []


def test_a_simulated_point_has_the_figures_of_a_run(spec: Path) -> None:
    point = look(spec, {}, {"a": 0.5}, simulated=True)
    assert point.exit == 0
    assert point.figures["final_error"] < 1e-3


def test_the_command_line_writes_tables_and_a_picture(spec: Path, tmp_path: Path) -> None:
    arguments = ["sweep", str(spec), "--sweep", "a=0:2:5", "--set", "b=0", "--design", "--refine", "1e-3"]
    run = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "out")])
    assert run.exit_code == 0, run.output
    assert "2 proved" in run.stdout
    with (tmp_path / "out" / "sweep.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["a"]) for row in rows] == [0, 0.5, 1, 1.5, 2]
    assert [row["verdict"] == "proved" for row in rows] == [True, True, False, False, False]
    with (tmp_path / "out" / "boundary.csv").open(encoding="utf-8", newline="") as file:
        (edge,) = csv.DictReader(file)
    assert float(edge["a"]) < 1 <= float(edge["refused_at"]) <= float(edge["a"]) + 2e-3
    assert (tmp_path / "out" / "sweep.png").stat().st_size > 1_000
    run = CliRunner().invoke(app, [*arguments[:2], "--sweep", "nothing=0:1"])
    assert run.exit_code == 2
    assert "nothing" in run.stderr


def test_two_parameters_give_maps(spec: Path, tmp_path: Path) -> None:
    options = ["--sweep", "a=0:0.4:2", "--sweep", "b=0:2:2", "--design", "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, ["sweep", str(spec), *options])
    assert run.exit_code == 0, run.output
    assert (tmp_path / "out" / "sweep.png").stat().st_size > 1_000
