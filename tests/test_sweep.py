import csv
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from fractions import Fraction
from math import pi
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pwatrack.batch.pool import Lost
from pwatrack.batch.sweep import look, places, sweep
from pwatrack.cli import app
from pwatrack.errors import InvalidSpec
from pwatrack.spec.axis import Axis, axis
from pwatrack.spec.load import load_spec

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


@pytest.mark.slow
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
        ends = [sum(point.values.values()) for point in (edge.inside, edge.beyond)]
        assert ends[0] < 1 <= ends[1] <= ends[0] + 2e-6
        assert edge.inside.proved
        assert not edge.beyond.proved


@pytest.mark.slow
def test_the_common_P_of_the_example_ends_where_the_formula_says(specs: Path) -> None:
    axes = [axis("k2=0.5:0.9:2"), axis("d1=0.15:0.25:2")]
    with ThreadPoolExecutor(1) as executor:
        points, edges = sweep(
            specs / "two_mass_backlash.yaml",
            axes,
            executor,
            at=places(axes),
            fixed={"k3": "k2"},
            simulated=False,
            refine=5e-3,
        )
    assert [point.verdict == "proved" for point in points] == [True, True, False, False]
    common = [edge for edge in edges if edge.inside.proof == "proved"]
    assert [edge.name for edge in common] == ["k2", "k2"]
    for edge in common:
        ends = edge.inside.values["k2"], edge.beyond.values["k2"]
        d1 = edge.inside.values["d1"]
        assert ends[1] - ends[0] <= 2e-3
        assert ends[0] <= (1 + d1 + 0.1) ** 2 - 1 <= ends[1]  # sqrt(k1 + k2) - sqrt(k1) = d1 + d2


@pytest.mark.slow
def test_merged_cells_are_another_kind_of_proof(specs: Path) -> None:
    spec = specs / "two_mass_backlash.yaml"
    found = [look(spec, {"k3": "k2"}, {"k2": k2}, simulated=False) for k2 in (0.4, 1.0, 1.5)]
    assert [point.verdict for point in found] == ["proved", "proved by a polynomial", "practical"]
    assert all(point.proved for point in found)


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
    assert float(edge["a"]) < 1 <= float(edge["beyond"]) <= float(edge["a"]) + 2e-3
    assert (tmp_path / "out" / "sweep.png").stat().st_size > 1_000
    run = CliRunner().invoke(app, [*arguments[:2], "--sweep", "nothing=0:1"])
    assert run.exit_code == 2
    assert "nothing" in run.stderr


def test_two_parameters_give_maps(spec: Path, tmp_path: Path) -> None:
    options = ["--sweep", "a=0:0.4:2", "--sweep", "b=0:2:2", "--design", "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, ["sweep", str(spec), *options])
    assert run.exit_code == 0, run.output
    assert (tmp_path / "out" / "sweep.png").stat().st_size > 1_000


SECTION = "sweep: {a: {from: 0, to: 2, points: 5}, b: [0, 1/8, pi/8]}\n"


@pytest.mark.slow
def test_the_file_may_say_what_varies(spec: Path, tmp_path: Path) -> None:
    spec.write_text(SPEC + SECTION, encoding="utf-8")
    run = CliRunner().invoke(app, ["sweep", str(spec), "--design", "--out", str(tmp_path / "out")])
    assert run.exit_code == 0, run.output
    with (tmp_path / "out" / "sweep.csv").open(encoding="utf-8", newline="") as file:
        rows = [(float(row["a"]), float(row["b"]), row["verdict"] == "proved") for row in csv.DictReader(file)]
    assert rows == [(a, b, a + b < 1) for a in (0.0, 0.5, 1.0, 1.5, 2.0) for b in (0.0, 0.125, pi / 8)]
    options = ["--sweep", "b=0:1:2", "--design", "--out", str(tmp_path / "other")]
    run = CliRunner().invoke(app, ["sweep", str(spec), *options])
    assert run.exit_code == 0, run.output
    assert "2 points" not in run.stdout
    assert len((tmp_path / "other" / "sweep.csv").read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("sweep: {c: [1, 2]}", r":\d+:\d+: sweep: 'c' is no parameter \(a, b\)"),
        ("sweep: {a: {from: 1, to: 0}}", "from 1 is not below to 0"),
        ("sweep: {a: {from: 0, to: 1, points: 1}}", "sweep.a.points: 1 is below 2"),
        ("sweep: {a: {from: 0}}", "sweep.a.to is missing"),
        ("sweep: {a: {form: 0, to: 1}}", "sweep.a.form: unknown key; did you mean 'from'"),
        ("sweep: {a: {from: x, to: 1}}", "sweep.a.from: unknown name 'x'"),
        ("sweep: {a: [1, 0]}", "values in increasing order"),
        ("sweep: {a: []}", "at least 1 entry"),
        ("sweep: {a: 3}", "sweep.a: a mapping is expected"),
        ("sweep: [a]", "sweep: a mapping is expected"),
    ],
)
def test_a_section_that_is_none_is_refused(spec: Path, section: str, said: str) -> None:
    spec.write_text(SPEC + section, encoding="utf-8")
    with pytest.raises(InvalidSpec, match=said):
        load_spec(spec)


def test_without_a_section_and_a_range_nothing_varies(spec: Path) -> None:
    run = CliRunner().invoke(app, ["sweep", str(spec)])
    assert run.exit_code == 2
    assert "nothing varies" in run.stderr


def test_given_values_are_drawn_as_often_as_each_other() -> None:
    given = Axis(name="a", values=(Fraction(0), Fraction(1, 10), Fraction(5)))
    drawn = [place["a"] for place in places([given, axis("b=0:1")], "lhs", 30)]
    assert sorted(drawn) == [0.0] * 10 + [0.1] * 10 + [5.0] * 10


def test_a_sweep_whose_first_place_is_outside_the_theory_goes_on(spec: Path, tmp_path: Path) -> None:
    jump = SPEC.replace("[[a + b]]", "[[0.5]]").replace("slope: 1,", "slope: 1,").replace("B: [[1]]", "B: [[a]]")
    spec.write_text(jump, encoding="utf-8")
    options = ["--sweep", "a=0:1:2", "--design", "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, ["sweep", str(spec), *options])
    assert run.exit_code == 0, run.output
    assert run.stdout.splitlines()[1] == "1 proved"


@pytest.mark.parametrize(("range_", "said"), [("a=1:3:3", "1 invalid spec"), ("a=1:1:1", "")])
def test_a_sweep_whose_first_place_is_in_error_goes_on_if_others_are_not(
    range_: str, said: str, spec: Path, tmp_path: Path
) -> None:
    """A slope of 1/(a − 1) is no number at a = 1."""
    spec.write_text(SPEC.replace("slope: 1,", "slope: 1/(a - 1),"), encoding="utf-8")
    run = CliRunner().invoke(app, ["sweep", str(spec), "--sweep", range_, "--design", "--out", str(tmp_path / "out")])
    assert (run.exit_code, said in run.stdout) == (0 if said else 2, True), run.output


def test_the_table_is_there_as_parquet_too(spec: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    options = ["--sweep", "a=0:2:5", "--sweep", "b=0:1:2", "--design", "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, ["sweep", str(spec), *options])
    assert run.exit_code == 0, run.output
    columns = parquet.read_table(tmp_path / "out" / "sweep.parquet").to_pydict()
    with (tmp_path / "out" / "sweep.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(columns) == list(rows[0])
    for name, values in columns.items():
        assert ["" if v is None else repr(v) if isinstance(v, float) else str(v) for v in values] == [
            row[name] for row in rows
        ]


@pytest.mark.parametrize(
    ("more", "said"),
    [(["--points", "4"], "a grid has its points in"), (["--set", "a=1"], "--set a: it varies in this sweep")],
)
def test_what_says_one_thing_twice_is_refused(spec: Path, more: list[str], said: str) -> None:
    run = CliRunner().invoke(app, ["sweep", str(spec), "--sweep", "a=0:2:5", *more])
    assert run.exit_code == 2
    assert said in " ".join(run.stderr.replace("│", " ").split())
