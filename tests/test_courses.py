"""Courses of a reference as a file gives them: what is built, what is refused, with place and limit."""

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pwatrack import load_spec
from pwatrack.cli import app
from pwatrack.errors import InvalidSpec, Problem, PwatrackError
from pwatrack.model.reference import OutputReference, exosystem

SPEC = """name: lag
system: {states: [x], inputs: [u], outputs: [y], A: [[-1]], B: [[1]], C: [[1]]}
reference:
  output: %s
simulation: {duration: %s, sample_time: 0.1}
"""


def write(folder: Path, output: str, duration: float = 4) -> Path:
    path = folder / "lag.yaml"
    path.write_text(SPEC % (output, duration))
    return path


def refused(path: Path) -> list[Problem]:
    with pytest.raises(InvalidSpec) as refusal:
        load_spec(path)
    assert all(problem.place is not None and problem.place.line == 4 for problem in refusal.value.problems)
    return list(refusal.value.problems)


def calls(work: Callable[[], object]) -> int:
    """Count the calls of functions that some work takes, which no other load of the machine changes."""
    count = 0

    def seen(frame: object, event: str, _: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(seen)
    try:
        work()
    finally:
        sys.setprofile(before)
    return count


def values(path: Path, times: np.ndarray, r: int = 0) -> np.ndarray:
    reference = load_spec(path).problem.reference
    assert isinstance(reference, OutputReference)
    (signal,), system = reference.signals([r]), exosystem(reference.signals([r]))
    found = np.array([signal(float(t)) for t in times])
    np.testing.assert_allclose((system.states(times) @ system.Q.T)[:, 0], found, atol=1e-9 * np.abs(found).max())
    return found


NO_COURSE = [
    ("{trapezoid: {high: 1, rise: 0.1, fall: 0.1, hold: -0.05}}", "trapezoid.hold: -0.05 is negative"),
    ("{trapezoid: {high: 1, rise: 0.1, fall: 0.1, hold: -0.3}}", "trapezoid.hold: -0.3 is negative"),
    ("{trapezoid: {high: 1, rise: 0.1, fall: 0.1, rest: -0.2}}", "trapezoid.rest: -0.2 is negative"),
    (
        "{trapezoid: {high: 1, rise: 1e-17, fall: 1, rest: 1}}",
        "rise: 1e-17 s is too short beside 4 s: at least 4e-12",
    ),
    ("{trapezoid: {high: 1, rise: 1e-7, fall: 1e-7}}", "2e+07 trapezoids until t = 4 s"),
    ("{polyline: {points: [[], [1, 2]]}}", "points[1]: a point is a pair [t, y]"),
    ("{polyline: {points: [[1, 2, 3]]}}", "points[1]: a point is a pair [t, y]"),
    ("{polyline: {points: [[1, 2], [1, 3]]}}", "points[2]: t = 1 s does not come after 1 s"),
    (
        "{polyline: {points: [[0, 0], [0.1, 1], [3, 0]], smooth: 0.3}}",
        "polyline.points[2]: the corner at t = 0.1 s is rounded from t = -0.05 s on, before t = 0",
    ),
    (
        "{polyline: {points: [[-1, 0], [0, 0], [3, 2]], smooth: 0.3}}",
        "polyline.points[2]: the corner at t = 0 s is rounded from t = -0.15 s on, before t = 0",
    ),
    (
        "{polyline: {points: [[0.1, 0], [3, 2]], smooth: 0.3}}",
        "polyline.points[1]: the corner at t = 0.1 s is rounded from t = -0.05 s on, before t = 0",
    ),
    ("{polyline: {points: [[0, 0], [1e-30, 1e60]]}}", "points 1 and 2, 1e-30 s apart, is too short beside 4 s"),
    ("{step: {size: 1, at: 1, smooth: 1e-15}}", "smooth: 1e-15 s is too short beside 5 s"),
    ("{step: {size: 1}}", "says neither when it begins, `at`, nor where its middle is, `centre`"),
    ("{step: {size: 1, at: 1, centre: 1}}", "give `at`, when it begins, or `centre`, its middle, not both"),
    ("{step: {size: 3, at: -1e3}, constant: 1}", "the step begins at t = -1000 s, before t = 0"),
    ("{step: {size: 1, centre: 0.2, smooth: 1}}", "the step begins at t = -0.3 s, before t = 0"),
    ("{step: [{size: 1, at: 0}, {size: 1, centre: -0.1}]}", "step[2]: the step begins at t = -0.1 s, before t = 0"),
    ("sin(1e300*t)", "'1e300*t' has a coefficient beyond 1e+60"),
    ("exp(-1e308*t)", "'-1e308*t' has a coefficient beyond 1e+60"),
    ("sin(1e30*t)", "a sine of 1e+30 rad/s is too fast for 4 s: 4e+30 radians or time constants, at most 1e+09"),
    ("exp(-1e30*t)", "exp(-1e+30*t) is too fast for 4 s"),
    ("{formula: exp(50*t), until: 4}", "exp(50*t) is beyond 1e60 before 4 s"),
    ("{sine: {amplitude: 1, frequency: 1e40}}", "a sine of 1e+40 rad/s is too fast"),
    ("((sin(t)+sin(1.1*t)+sin(1.3*t)+sin(1.7*t))**20)**20", "101 terms or more when multiplied out, at most 100"),
    ("((((t+1)**20)**20)**20)**20*exp(-t)", "has t to a power of 40, at most 20 is read"),
    ("t**11*t**11*exp(-t)", "has t to a power of 22, at most 20 is read"),
    ("1e50*t*1e50*exp(-t)", "has a coefficient beyond 1e+60"),
]


@pytest.mark.parametrize(("output", "message"), NO_COURSE)
def test_a_course_beyond_its_limits_is_refused_at_its_line_with_the_limit(
    tmp_path: Path, output: str, message: str
) -> None:
    path, found = write(tmp_path, output), list[Problem]()
    assert calls(lambda: found.extend(refused(path))) < 1_000_000
    assert message in found[0].message


def test_everything_wrong_with_a_signal_is_said_at_once(tmp_path: Path) -> None:
    both = "{polyline: {points: [[1, 2], [0, 3]]}, table: {file: none.csv}, step: [{size: 1, at: 1, smooth: 1e-15}]}"
    assert len(refused(write(tmp_path, both))) == 3


def rounded(t: np.ndarray, corners: list[float], y: list[float], width: float, r: int) -> np.ndarray:
    """Lines through corners averaged r times over a moving window of width / r, by sums."""
    around = (np.arange(4000) + 0.5) / 4000 - 0.5
    window = width / r * around
    for _ in range(r - 1):
        window = np.quantile(np.add.outer(window, width / r * around), (np.arange(4000) + 0.5) / 4000)
    return np.asarray(np.interp(np.add.outer(t, window), corners, y).mean(axis=1))


@pytest.mark.slow
@pytest.mark.parametrize("r", [0, 1, 2])
@pytest.mark.parametrize(
    ("output", "corners", "y"),
    [  # what is written: from t = 0 on, with no corner before
        ("{polyline: {points: [[0, 2], [1, 3], [3, 0]], smooth: 0.8}}", [-9, 1, 3, 9], [-7, 3, 0, 0]),
        ("{polyline: {points: [[0.4, 1], [1.5, 3], [3, 0]], smooth: 0.8}}", [-9, 0.4, 1.5, 3, 9], [1, 1, 3, 0, 0]),
        ("{polyline: {points: [[-3, 9], [-1, 1], [1.5, 3]], smooth: 0.8}}", [-3, -1, 1.5, 9], [9, 1, 3, 3]),
        (
            "{trapezoid: {low: 1, high: 2, rise: 0.5, hold: 1, fall: 0.5, rest: 9, smooth: 0.4}}",
            [-9, 0.2, 0.7, 1.7, 2.2, 9],
            [1, 1, 2, 2, 1, 1],
        ),
        (
            "{trapezoid: {high: 2, start: 0.5, rise: 1, fall: 1, rest: 9, smooth: 0.4}}",
            [-9, 0.7, 1.7, 2.7, 9],
            [0, 0, 2, 0, 0],
        ),
        (
            "{trapezoid: {high: 2, start: -0.5, rise: 1, fall: 1, rest: 9, smooth: 0.4}}",
            [-9, -0.3, 0.7, 1.7, 9],
            [0, 0, 2, 0, 0],
        ),
    ],
)
def test_a_rounded_reference_begins_as_it_is_written(
    tmp_path: Path, output: str, corners: list[float], y: list[float], r: int
) -> None:
    t, path = np.linspace(0, 3.99, 57), write(tmp_path, output)
    found = values(path, t, r)
    np.testing.assert_allclose(found, rounded(t, corners, y, float(output[-5:-2]), max(r, 1)), atol=2e-4)
    if "-" not in output:
        assert found[0] == pytest.approx(float(np.interp(0, corners, y)), abs=1e-12)


@pytest.mark.parametrize(
    ("output", "wanted"),
    [
        ("{trapezoid: {low: 2, high: 5, start: 1e9, rise: 1, fall: 1}}", lambda t: 2 + 0 * t),
        ("{trapezoid: {high: 1, start: -1e3, rise: 1, fall: 1}}", lambda t: 1 - abs(t % 2 - 1)),
        (
            "{trapezoid: {high: 1, start: 1, rise: 1, hold: 1, fall: 1, rest: 9}}",
            lambda t: np.interp(t, [1, 2, 3, 4], [0, 1, 1, 0]),
        ),
        ("{polyline: {points: [[1e60, 5]]}}", lambda t: 5 + 0 * t),
        ("{polyline: {points: [[-1, -1], [9, 9]]}}", lambda t: t),
        ("{step: {size: 3, at: 1e50}}", lambda t: 0 * t),
        ("{step: {size: 3, at: 0}, constant: 1}", lambda t: 4 + 0 * t),
        ("{step: {size: 3, centre: 2}}", lambda t: 3 * (t >= 2)),
        ("{step: {size: 3, at: 0, smooth: 4}}", lambda t: np.interp(t, [0, 4], [0, 3])),
        ("{step: {size: 3, at: 0.3, smooth: 0.6}}", lambda t: np.interp(t, [0.3, 0.9], [0, 3])),
        ("{step: {size: 3, centre: 0.3, smooth: 0.6}}", lambda t: np.interp(t, [0, 0.6], [0, 3])),
        ("{step: {size: 3, at: 2}, formula: t, until: 5}", lambda t: t + 3 * (t >= 2)),
        ("{formula: exp(30*t)*0 + exp(t/9), until: 4}", lambda t: np.exp(t / 9)),
    ],
)
def test_courses_have_the_values_that_are_written(tmp_path: Path, output: str, wanted: object) -> None:
    t = np.linspace(0, 3.99, 57)
    np.testing.assert_allclose(values(write(tmp_path, output), t), wanted(t), atol=1e-9)  # type: ignore[operator]


def table(folder: Path, content: bytes, name: str = "wanted.csv") -> Path:
    (folder / "wanted.csv").write_bytes(content)
    return write(folder, f"{{table: {{file: {name}}}}}")


def rows(t: np.ndarray, y: np.ndarray, between: str = ",", point: str = ".") -> str:
    lines = [between.join(repr(v).replace(".", point) for v in row) for row in zip(t.tolist(), y.tolist(), strict=True)]
    return "\n".join([f"t{between}y", *lines])


T = np.linspace(0, 4, 41)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("start", [0.0, -0.55, -3.0])
def test_a_table_is_read_with_a_byte_order_mark_and_from_before_0(tmp_path: Path, encoding: str, start: float) -> None:
    t = np.linspace(start, 4, 60)
    path = table(tmp_path, rows(t, np.sin(t)).replace("\n", "\r\n").encode(encoding))
    inner = np.linspace(0, 3.9, 40)
    np.testing.assert_allclose(values(path, inner), np.sin(inner), atol=1e-5)


NO_TABLE = [
    (rows(T, T, point=","), "row 2 has 4 entries, the header 2: decimal commas? write points in numbers, or"),
    ('t,y\n"0,5",1\n', "row 2: '0,5', '1' are no two numbers: write points in numbers, or 'decimal: \",\"'"),
    ("t;y\n0,5;1.0\n", "row 2: '0,5', '1.0' are no two numbers: write points in numbers, or 'decimal: \",\"'"),
    ("time;y\n0;1\n", "the header has no column 't'; it has 'time', 'y'"),
    ("tt;y\n0;1\n", "the header has no column 't'; it has 'tt', 'y'; did you mean 'tt'?"),
    ("\xff\xfet", "not UTF-16 text: byte 0x74 at position 3"),
    ("t,y\n0,1_000\n", "row 2: '0', '1_000' are no two numbers"),
    ("t,y\n0\n", "row 2: '0', '' are no two numbers"),
    ("t,y,y\n0,1,2\n", "the header has two columns 'y'"),
    ("", "the header has no column 't'; it has none"),
    (
        "root:x:0:0:root and more of that file, which is none of your business, a\n",
        "it has 'root:x:0:0:root and ', ",
    ),
    ("t,y\n0,0\n1e-300,1\n2e-300,2\n3e-300,3\n", "reference.output ends at t = 3e-300 s"),
    (
        "t,y\n0,0\n1e-300,1\n1,2\n5,3\n",
        "t does not increase enough: 1e-300 s, at least 5e-12 s are told apart at row 3",
    ),
    ("t,y\n0,0\n1,1\n1,2\n5,3\n", "t does not increase at row 4"),
    ("t,y\n0,0\n1,1e99\n2,2\n5,3\n", "row 3 has a number beyond 1e+60"),
    ("t,y\n0,0\n1,nan\n2,2\n5,3\n", "row 3 is not finite"),
    ("t,y\n0," + "1" * 200_000, "field larger than field limit"),
    ("t,y\n0,\xff", "not UTF-8 text: byte 0xff at position 7"),
]


@pytest.mark.parametrize(("content", "message"), NO_TABLE)
def test_a_table_that_cannot_be_read_says_why(tmp_path: Path, content: str, message: str) -> None:
    (problem,) = refused(table(tmp_path, content.encode("latin-1")))
    assert message in problem.message
    assert len(problem.message) < 400


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize(("between", "point"), [(";", "."), (";", ","), ("\t", ","), ("\t", "."), (",", ".")])
def test_a_table_of_a_spreadsheet_is_read_as_it_is(tmp_path: Path, encoding: str, between: str, point: str) -> None:
    path = table(tmp_path, rows(T, np.sin(T), between, point).replace("\n", "\r\n").encode(encoding))
    inner = np.linspace(0, 3.9, 40)
    np.testing.assert_allclose(values(path, inner), np.sin(inner), atol=1e-5)


def with_options(folder: Path, content: str, options: str) -> Path:
    (folder / "wanted.csv").write_text(content, encoding="utf-8")
    return write(folder, f"{{table: {{file: wanted.csv, {options}}}}}")


@pytest.mark.parametrize(
    ("content", "options"),
    [
        (rows(1000 * T, np.sin(T)).replace("t,y", "t_ms,y"), "time: t_ms, scale: 1e-3"),
        (rows(1000 * T, 5 * np.sin(T)).replace("t,y", "t_ms,y"), "time: t_ms, scale: {t_ms: 1e-3, y: 1/5}"),
        (rows(T, -np.sin(T)), "column: y, scale: {y: -1}"),
        (rows(T, np.sin(T), "|", ","), 'delimiter: "|", decimal: ","'),
        (rows(T, np.sin(T), " "), 'delimiter: " "'),
        (rows(T, np.sin(T)).replace("t,y", "a;b;t,y;z"), 'time: "a;b;t", column: "y;z", delimiter: ","'),
    ],
)
def test_columns_of_a_table_are_read_as_it_is_said(tmp_path: Path, content: str, options: str) -> None:
    inner = np.linspace(0, 3.9, 40)
    np.testing.assert_allclose(values(with_options(tmp_path, content, options), inner), np.sin(inner), atol=1e-5)


NO_OPTION = [
    ("decimal: ','", "'0.0', '0.0' are no two numbers: decimals have a comma here"),
    ("scale: 0", "scale: 0 makes no use of column 't'"),
    ("scale: -1", "scale: -1 makes no use of column 't'"),
    ("scale: {q: 2}", "scale: 'q' is not a column that is read: 't' and 'y' are"),
    ("delimiter: x", "delimiter: 'x' is not ',', ';', "),
    ("decimal: x", "decimal: 'x' is not '.' or ','"),
    ("filter: {cutoff: 0}", "cutoff: 0 is not positive"),
    ("filter: {cutoff: 6}", "rows 0.1 s apart tell nothing above 5 Hz: the cutoff is 6 Hz"),
    ("filter: {cutoff: 0.2}", "a cutoff of 0.2 Hz averages over 4.55 s, the table lasts 4 s"),
    ("filter: 20", "filter: a mapping is expected"),
]


@pytest.mark.parametrize(("options", "message"), NO_OPTION)
def test_options_that_a_table_does_not_bear_out_are_refused(tmp_path: Path, options: str, message: str) -> None:
    (problem,) = refused(with_options(tmp_path, rows(T, T), options))
    assert message in problem.message


def test_a_table_with_gaps_has_room_for_so_many_points_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pwatrack.spec.table.MOST_ROWS", 100)
    (problem,) = refused(with_options(tmp_path, rows(T, T), "filter: {cutoff: 4.9}"))
    assert "a cutoff of 4.9 Hz leaves 174 points, at most 100" in problem.message


def test_only_regular_files_of_a_modest_size_are_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "zero.csv").symlink_to("/dev/zero")
    for name, message in {
        "pipe.csv": "it is no regular file",
        "zero.csv": "outside of the spec's folder",
        ".": "it is a folder",
        "none.csv": "No such file",
        '"a\\0b"': r"a\\x00b: embedded null",
    }.items():
        (problem,) = refused(table(tmp_path, b"", name))
        assert message.replace("\\\\", "\\") in problem.message
    monkeypatch.setattr("pwatrack.spec.table.LARGEST_FILE", 100)
    (problem,) = refused(table(tmp_path, b"t,y\n" + b"0,0\n" * 50))
    assert "bytes, at most 100 are read" in problem.message
    monkeypatch.undo()
    monkeypatch.setattr("pwatrack.spec.table.MOST_ROWS", 40)
    (problem,) = refused(table(tmp_path, rows(T, T).encode()))
    assert "41 rows, at most 40 are read" in problem.message


def built(path: Path) -> int:
    reference = load_spec(path).problem.reference
    assert isinstance(reference, OutputReference)
    (signal,) = reference.signals([2])
    assert signal.jump(1) is None
    return len(exosystem([signal]).breaks)


def long_table(folder: Path, samples: int) -> Path:
    t = 0.01 * np.arange(samples + 1)
    (folder / "wanted.csv").write_text(rows(t, np.sin(t)))
    return write(folder, "{table: {file: wanted.csv}, sine: {amplitude: 0, frequency: 1}}", duration=samples // 100)


def many_trapezoids(folder: Path, periods: int) -> Path:
    shape = "{trapezoid: {high: 1, rise: 0.2, fall: 0.2, rest: 0.1, smooth: 0.05}}"
    return write(folder, shape, duration=periods)


@pytest.mark.slow
@pytest.mark.parametrize(("written", "size"), [(long_table, 1000), (many_trapezoids, 100)])
def test_signals_with_many_pieces_are_built_in_proportion_to_these(
    tmp_path: Path, written: Callable[[Path, int], Path], size: int
) -> None:
    assert built(written(tmp_path, 20 * size)) > 19_000  # what is imported with it is there now
    one, four = (calls(partial(built, written(tmp_path, k * size))) for k in (1, 4))
    assert four < 4.2 * one


def test_a_refusal_of_a_formula_that_grows_is_about_the_theory_and_no_warning(tmp_path: Path) -> None:
    from pwatrack import design

    with pytest.raises(PwatrackError, match="y_d is not bounded"):
        design(load_spec(write(tmp_path, "exp(400*t) + sin(t)")))


OUTSIDE = ["../wanted.csv", "below/../../wanted.csv", "link.csv", "linked/wanted.csv", "{absolute}"]


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_table_outside_of_the_folder_is_read_only_if_that_is_allowed(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "specs"
    (folder / "below").mkdir(parents=True)
    (tmp_path / "wanted.csv").write_text("t,y\n0,0\n1,0.1\n2,0\n3,0.1\n4,0\n")
    (folder / "link.csv").symlink_to(tmp_path / "wanted.csv")
    (folder / "linked").symlink_to(tmp_path)
    starter = (Path(__file__).parents[1] / "pwatrack" / "starters" / "output.yaml").read_text(encoding="utf-8")
    table = f"{{table: {{file: {name.format(absolute=tmp_path / 'wanted.csv')}}}}}"
    text = starter.replace('"0.12*sin(2*t)"', table).replace("duration: 20", "duration: 3")
    (folder / "spec.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InvalidSpec, match=r"spec\.yaml:\d+:\d+: table .*outside of the spec's folder.*--allow-outside"):
        load_spec(folder / "spec.yaml")
    assert load_spec(folder / "spec.yaml", outside=True).name == "Cart with a stop"
    for option, code in (([], 2), (["--allow-outside"], 0)):
        assert CliRunner().invoke(app, ["check", str(folder / "spec.yaml"), *option]).exit_code == code
