from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pwatrack import simulate
from pwatrack.control.goal import DEFAULT
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem
from pwatrack.model.reference import OutputReference
from pwatrack.spec.load import expected_exit, load_spec
from pwatrack.spec.spec import Spec

SPEC = """\
name: Mass on two springs
parameters:
  m: 2
  k: 0.5
  stiff: 3*k
  gap: 1e-1
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  units: {z: m, y: m}
  B: [[0], [1/m]]
  C: [[1, 0]]
  cells:
    - name: free
      where: ["z <= gap"]
      A: [[0, 1], [-k/m, -1]]
    - name: stop
      where: ["z >= gap"]
      A: [[0, 1], [-(k + stiff)/m, -1]]
      b: [0, stiff*gap/m]
reference:
  output: {constant: 0.5, sine: [{amplitude: 2, frequency: pi}, {amplitude: k, frequency: 1, phase: 0.1}]}
simulation:
  duration: 2
  sample_time: 0.01
  initial: {plant: [gap, 0]}
"""

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Return a function that writes SPEC with replacements, each of which must fit exactly once."""

    def _write(*replacements: tuple[str, str], text: str = SPEC) -> Path:
        for old, new in replacements:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        path = tmp_path / "plant.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return _write


def place(path: Path, part: str) -> str:
    """Return line:column of a part of the file that occurs once."""
    text = path.read_text(encoding="utf-8")
    assert text.count(part) == 1, part
    before = text[: text.index(part)]
    return f"{before.count(chr(10)) + 1}:{len(before) - before.rfind(chr(10))}"


def problems(path: Path, parameters: dict[str, float | str] | None = None) -> tuple[Problem, ...]:
    with pytest.raises(InvalidSpec) as caught:
        load_spec(path, parameters)
    return caught.value.problems


def only(path: Path, parameters: dict[str, float | str] | None = None) -> Problem:
    found = problems(path, parameters)
    assert len(found) == 1, [str(p) for p in found]
    return found[0]


def at(problem: Problem) -> str:
    assert problem.place is not None
    return f"{problem.place.line}:{problem.place.column}"


def test_a_spec_is_read_with_its_expressions(write: Write) -> None:
    spec = load_spec(write())
    assert spec.parameters == {"m": 2.0, "k": 0.5, "stiff": 1.5, "gap": 0.1}
    assert spec.problem.plant.A.tolist() == [[[0, 1], [-0.25, -1]], [[0, 1], [-1.0, -1]]]
    assert spec.problem.plant.b.tolist() == [[0, 0], [0, 0.075]]
    assert spec.problem.plant.B.tolist() == [[0], [0.5]]
    assert (spec.objectives.controller, spec.objectives.observer) == (DEFAULT, DEFAULT)
    initial = spec.scenario.initial
    assert isinstance(initial.plant, np.ndarray)
    assert initial.plant.tolist() == [0.1, 0]
    assert (initial.observer, initial.generator) == (None, None)
    assert (spec.scenario.duration, spec.scenario.sample_time, spec.expected_exit) == (2.0, 0.01, 0)


def test_the_order_of_the_sections_does_not_matter(write: Write) -> None:
    head, tail = SPEC.split("system:\n")
    moved = load_spec(write(text=f"system:\n{tail}{head}"))
    assert moved.problem.plant.A.tolist() == load_spec(write()).problem.plant.A.tolist()


@pytest.mark.parametrize(
    ("text", "value"), [("1e-3", 0.001), ("1E3", 1000.0), ("'2.5'", 2.5), ("2*pi", 2 * np.pi), (".5", 0.5)]
)
def test_a_number_is_what_the_engineer_means(write: Write, text: str, value: float) -> None:
    assert load_spec(write(("m: 2", f"m: {text}"))).parameters["m"] == value


@pytest.mark.parametrize(
    "text", ["010", "12:30:45", "no", "yes", "on", "~", "null", "", "nan", "inf", ".inf", "2001-01-01", "[2]", "{a: 2}"]
)
def test_what_yaml_would_guess_into_a_number_is_refused(write: Write, text: str) -> None:
    path = write(("m: 2", f"m: {text}"), ("1/m", "1"), ("-k/m", "-k"), ("stiff)/m", "stiff)"), ("gap/m", "gap"))
    problem = only(path)
    assert problem.message.startswith("parameter 'm': ")
    assert problem.place is not None
    assert problem.place.line == 3


@pytest.mark.parametrize("name", ["no", "yes", "on", "off", "y1", "n", "e", "_", "j"])
def test_a_name_that_yaml_would_read_as_a_truth_value_is_a_name(write: Write, name: str) -> None:
    spec = load_spec(write(("[z, v]", f"[z, {name}]"), ("k: 0.5", f"k: 0.5\n  off_{name}: 1")))
    assert spec.problem.plant.states == ("z", name)


@pytest.mark.parametrize("name", ["2z", "z-1", "z 1", "z.1", "ż", "''", "pi", "sin", "1e-3"])
def test_a_word_that_is_no_name_is_refused_as_one(write: Write, name: str) -> None:
    path = write(("states: [z, v]", f"states: [z, {name}]"))
    assert at(only(path)) == "8:15"
    path = write(("gap: 1e-1", f"gap: 1e-1\n  {name}: 1"))
    assert [p.place.line for p in problems(path) if p.place] == [7]


@pytest.mark.parametrize("name", ["lambda", "in", "is", "not", "if", "None", "True"])
def test_a_name_is_refused_where_it_is_declared_or_can_be_used(write: Write, name: str) -> None:
    declared, used = ("gap: 1e-1", f"gap: 1e-1\n  {name}: 1"), ("duration: 2", f"duration: 2*{name}")
    try:
        assert load_spec(write(declared, used)).scenario.duration == 2.0
    except InvalidSpec as error:
        assert next(p.place.line for p in error.problems if p.place) == 7  # noqa: PT017


def test_a_misspelt_parameter_is_named_with_a_guess_and_its_place(write: Write) -> None:
    path = write(("-(k + stiff)/m", "-(k + stif)/m"))
    problem = only(path)
    assert at(problem) == place(path, "-(k + stif)/m")
    assert "system.cells[2].A[2][1]: unknown name 'stif'; did you mean 'stiff'?" in problem.message


def test_every_error_of_a_file_is_reported_in_its_order_with_line_and_column(write: Write) -> None:
    path = write(
        ("k: 0.5", "k: 0.5\n  k: 0.6"),
        ("gap: 1e-1", "gap: 1/0"),
        ("C: [[1, 0]]", "C: [[1, 0, 0]]"),
        ("name: free", "nam: free"),
        ("-k/m, -1]", "-q/m, print(1)]"),
        ("b: [0, stiff*gap/m]", "b: [0]"),
        ("phase: 0.1", "phase: 010"),
        ("sample_time: 0.01", "sample_time: -0.01"),
        ("initial: {plant: [gap, 0]}", "initial: {plant: [gap, 0, z]}\nsolver: clarabel"),
    )
    expected = [
        ("k: 0.6", "second time"),
        ("1/0", "divides by zero"),
        ("[1, 0, 0]", "3 entries, expected 2"),
        ("nam: free", "system.cells[1].name is missing"),
        ("nam: free", "system.cells[1].nam: unknown key"),
        ("-q/m", "unknown name 'q'"),
        ("print(1)", "unknown function 'print'"),
        ("[0]\nref", "1 entry, expected 2"),
        ("010", "'010' is not a number"),
        ("-0.01", "-0.01 is not positive"),
        ("[gap, 0, z]", "3 entries, expected 2"),
        ("z]}\nsolver", "unknown name 'z'"),
        ("solver: clarabel", "solver: unknown key"),
    ]
    found = problems(path)
    assert [at(p) for p in found] == [place(path, part) for part, _ in expected]
    for problem, (_, message) in zip(found, expected, strict=True):
        assert message in problem.message


def test_errors_between_entries_are_reported_with_all_others(write: Write) -> None:
    path = write(("name: stop", "name: free"), ("sample_time: 0.01", "sample_time: 3"), ("u]", "u]\n  surplus: 1"))
    messages = [p.message for p in problems(path)]
    assert len(messages) == 3
    assert "unknown key" in messages[0]
    assert "a second cell is named 'free'" in messages[1]
    assert "longer than the duration" in messages[2]


def test_a_parameter_in_error_is_said_once_and_not_where_it_is_used(write: Write) -> None:
    path = write(("k: 0.5", "k: 2*kk"), ("gap: 1e-1", "gap: k/10"))
    problem = only(path)
    assert at(problem) == place(path, "2*kk")
    assert "parameter 'k': unknown name 'kk'" in problem.message


def test_a_parameter_in_error_hides_no_other_error(write: Write) -> None:
    path = write(("k: 0.5", "k: 2*kk"), ("[-k/m, -1]", "[-k/m, -1, k]"), ("duration: 2", "duration: 2*kkk"))
    assert [at(p) for p in problems(path)] == [place(path, x) for x in ("2*kk\n", "[-k/m, -1, k]", "2*kkk")]


@pytest.mark.parametrize("use", ["stiff: 3*k", "stiff: 3"])
def test_a_parameter_that_uses_itself_is_refused(write: Write, use: str) -> None:
    path = write(("k: 0.5", "k: 2*k"), ("stiff: 3*k", use))
    problem = only(path)
    assert at(problem) == place(path, "2*k")
    assert "parameter 'k': " in problem.message


def test_a_parameter_may_only_use_those_above_it(write: Write) -> None:
    path = write(("m: 2", "m: 4*k"))
    found = problems(path)
    assert at(found[0]) == place(path, "4*k")
    assert "unknown name 'k'" in found[0].message
    assert len(found) == 1


@pytest.mark.parametrize("name", ["pi", "sin", "max"])
def test_a_parameter_named_like_a_constant_or_function_is_said_once(write: Write, name: str) -> None:
    path = write(("gap: 1e-1", f"gap: 1e-1\n  {name}: 3"), ("duration: 2", f"duration: 2*{name}"))
    assert "has a meaning of its own" in problems(path)[0].message


WRONG_SHAPE = [
    ("B: [[0], [1/m]]", "B: [[0]]", "[[0]]", "system.B: 1 row, expected 2, one for each of the states"),
    ("B: [[0], [1/m]]", "B: [[0], [1, 2]]", "[1, 2]", "system.B[2]: 2 entries, expected 1"),
    ("C: [[1, 0]]", "C: [[1]]", "[[1]]", "system.C[1]: 1 entry, expected 2"),
    ("C: [[1, 0]]", "C: []", "[]", "system.C: 0 rows, expected 1"),
    ("[[0, 1], [-k/m, -1]]", "[[0, 1]]", "[[0, 1]]\n", "system.cells[1].A: 1 row, expected 2"),
    ("b: [0, stiff*gap/m]", "b: []", "[]", "system.cells[2].b: 0 entries, expected 2"),
    ("plant: [gap, 0]", "plant: [gap]", "[gap]", "simulation.initial.plant: 1 entry, expected 2"),
    ("plant: [gap, 0]", "observer: [0]", "[0]}", "simulation.initial.observer: 1 entry, expected 2"),
]


@pytest.mark.parametrize(("old", "new", "part", "message"), WRONG_SHAPE)
def test_a_wrong_shape_is_refused_where_it_stands(write: Write, old: str, new: str, part: str, message: str) -> None:
    path = write((old, new))
    problem = only(path)
    expected = place(path, part) if part != "[[1]]" else place(path, "[1]]\n")
    assert at(problem) == expected
    assert problem.message.startswith(message)


@pytest.mark.parametrize("gains", ["controller: {K: [[1]]}", "observer: {L: [[1, 2]]}"])
def test_given_gains_of_a_wrong_shape_are_refused(write: Write, gains: str) -> None:
    found = problems(write(("reference:", f"design: {{{gains}}}\nreference:")))
    assert all("expected" in p.message and p.place and p.place.line == 22 for p in found)


WRONG_KIND = [
    ("B: [[0], [1/m]]", "B: [0, 1/m]"),
    ("B: [[0], [1/m]]", "B: 1"),
    ("C: [[1, 0]]", "C: [[1, [0]]]"),
    ("C: [[1, 0]]", "C: {a: 1}"),
    ("states: [z, v]", "states: z"),
    ("states: [z, v]", "states: [z, [v]]"),
    ("states: [z, v]", "states: [z, {v: 1}]"),
    ("states: [z, v]", "states: [z, z]"),
    ("inputs: [u]", "inputs: []"),
    ("inputs: [u]", "inputs: {u: N}"),
    ("{z: m, y: m}", "[m, m]"),
    ("{z: m, y: m}", "{z: [m]}"),
    ("{z: m, y: m}", "{q: m}"),
    ('where: ["z <= gap"]', 'where: "z <= gap"'),
    ('where: ["z <= gap"]', "where: [[z <= gap]]"),
    ('where: ["z <= gap"]', "where: [z == gap]"),
    ('where: ["z <= gap"]', "where: [gap <= 1]"),
    ('where: ["z <= gap"]', "where: [z*v <= gap]"),
    ("frequency: pi", "frequency: 0"),
    ("frequency: pi", "freq: pi"),
    ("duration: 2", "duration: 0"),
    ("duration: 2", "duration: [2]"),
    ("sample_time: 0.01", "sample_time: 3"),
    ("reference:", "refrence:"),
    ("name: Mass", "title: Mass"),
    ("outputs: [y]", "outputs: [z]"),
    ("outputs: [y]", "outputs: [k]"),
    ("name: Mass on two springs", "name: [a]"),
]


@pytest.mark.parametrize(("old", "new"), WRONG_KIND)
def test_a_part_of_the_wrong_kind_is_refused_with_its_place(write: Write, old: str, new: str) -> None:
    path = write((old, new))
    lines = {p.place.line for p in problems(path) if p.place}
    line = int(place(path, new).split(":")[0])
    assert lines & {line, 1, line + 1}
    assert all(p.place is not None for p in problems(path))


@pytest.mark.parametrize("section", ["system", "reference", "simulation", "parameters", "design", "expect"])
@pytest.mark.parametrize("content", ["", "3", "[1]", "[[]]", "{}", "{q: 1}", "text", "~"])
def test_a_section_of_whatever_kind_is_read_or_refused_with_a_place(write: Write, section: str, content: str) -> None:
    kept = [part for part in SPEC.replace("\n  ", "\0").splitlines() if not part.startswith(f"{section}:")]
    path = write(text="\n".join(kept).replace("\0", "\n  ") + f"\n{section}: {content}\n")
    found: tuple[Problem, ...] = ()
    try:
        load_spec(path)
    except InvalidSpec as error:
        found = error.problems
    assert bool(found) == ((section, content) != ("design", "{}"))
    assert all(p.place is not None and len(str(p)) < 400 for p in found)


def test_a_second_cell_of_one_name_is_refused_at_its_name(write: Write) -> None:
    path = write(("name: stop", "name: 'free'"))
    problem = only(path)
    assert at(problem) == place(path, "'free'")
    assert "a second cell is named 'free'" in problem.message


def test_a_missing_key_is_refused_where_its_section_stands(write: Write) -> None:
    path = write(("  sample_time: 0.01\n", ""))
    problem = only(path)
    assert problem.message == "simulation.sample_time is missing"
    assert at(problem) == place(path, "duration: 2")


def test_a_missing_section_is_named(write: Write) -> None:
    assert {p.message for p in problems(write(text="parameters: {a: 1}\n"))} == {
        "name is missing",
        "system is missing",
        "reference is missing",
        "simulation is missing",
    }


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("states: [z, v]", "states: [z, {0} {0}]"),
        ("duration: 2", "duration: {0}"),
        ("frequency: pi", "{0}: pi"),
        ("reference:", "design: {{solver: {0}}}\nreference:"),
        ("reference:", "expect: {{exit: {0}}}\nreference:"),
    ],
)
def test_a_huge_scalar_is_refused_without_being_repeated(write: Write, old: str, new: str) -> None:
    found = problems(write((old, new.format("x" * (10**5 if "frequency" not in old else 900)))))
    assert all(len(p.message) < 1100 for p in found)


NO_SPEC = [
    (b"", "must hold a mapping"),
    (b"name: x\n\0", "not valid YAML"),
    (b"name: \xff\xfe", "not UTF-8 text"),
    (SPEC.encode("utf-16"), "not UTF-8 text"),
    (b"\x89PNG\r\n\x1a\n", "not UTF-8 text"),
    (b"a: &a {b: 1}\nc: {<<: *a}\n", "not supported"),
    (SPEC.encode() + b"---\n" + SPEC.encode(), "second document"),
]


@pytest.mark.parametrize(("content", "message"), NO_SPEC)
def test_a_file_that_is_no_spec_at_all_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(content)
    problem = only(path)
    assert message in problem.message
    assert problem.place is not None
    assert problem.place.file == str(path)


def test_a_byte_that_is_not_utf_8_is_reported_on_its_line(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(b"name: x\n# d\xe4mpfer\n")
    assert at(only(path)) == "2:4"


def test_a_file_with_a_byte_order_mark_is_read(write: Write) -> None:
    assert load_spec(write(text="\ufeff" + SPEC)).name == "Mass on two springs"


@pytest.mark.parametrize("name", ["missing.yaml", "."])
def test_a_path_that_is_no_readable_file_is_refused(tmp_path: Path, name: str) -> None:
    assert "cannot read" in only(tmp_path / name).message


def test_a_parameter_that_is_set_changes_those_that_depend_on_it(write: Write) -> None:
    spec = load_spec(write(), {"k": 0.25, "gap": "k/2"})
    assert spec.parameters == {"m": 2.0, "k": 0.25, "stiff": 0.75, "gap": 0.125}
    assert spec.problem.plant.A[0, 1, 0] == -0.125


def test_a_parameter_set_as_a_number_keeps_every_bit(write: Write) -> None:
    value = 0.1 + 2**-56 + 1e-17
    assert load_spec(write(), {"m": value}).parameters["m"] == value


def test_setting_a_parameter_repairs_one_in_error(write: Write) -> None:
    assert load_spec(write(("k: 0.5", "k: 2*kk")), {"k": 0.5}).parameters["stiff"] == 1.5


def test_setting_an_undeclared_parameter_is_refused_with_the_declared_ones(write: Write) -> None:
    assert "'kk' is set but not declared; declared: m, k, stiff, gap" in only(write(), {"kk": 1}).message


@pytest.mark.parametrize("value", ["", "010", "no", "z", "1/0", float("nan"), float("inf"), "stiff", "k"])
def test_a_value_that_cannot_be_set_is_refused(write: Write, value: float | str) -> None:
    assert only(write(), {"k": value}).message.startswith("parameter 'k': ")


def test_an_error_in_a_value_that_was_set_is_not_blamed_on_the_file(write: Write) -> None:
    assert only(write(), {"k": "1/0"}).place is None


def test_several_values_that_cannot_be_set_are_refused_at_once(write: Write) -> None:
    assert len(problems(write(), {"k": "1/0", "q": 1, "gap": "010"})) == 3


@pytest.mark.parametrize(("duration", "sample_time"), [("1e6", "1e-3"), ("10000001", "1"), ("1e30", "1e-30")])
def test_more_samples_than_the_limit_are_refused_with_the_place(write: Write, duration: str, sample_time: str) -> None:
    path = write(("duration: 2", f"duration: {duration}"), ("0.01", sample_time))
    problem = only(path)
    assert "at most 10,000,000" in problem.message
    assert problem.place is not None
    assert problem.place.line == 26


def test_as_many_samples_as_the_limit_are_read(write: Write) -> None:
    assert load_spec(write(("duration: 2", "duration: 1e7"), ("0.01", "1"))).scenario.duration == 1e7


def test_a_jump_across_a_facet_is_refused_at_the_cell(write: Write) -> None:
    path = write(("b: [0, stiff*gap/m]", "b: [0, 0]"))
    with pytest.raises(OutsideTheory) as caught:
        load_spec(path)
    (problem,) = caught.value.problems
    assert problem.place is not None
    assert 15 <= problem.place.line <= 21
    assert "'free'" in problem.message
    assert "'stop'" in problem.message


def test_a_hole_between_the_cells_is_refused(write: Write) -> None:
    with pytest.raises(OutsideTheory):
        load_spec(write(("z >= gap", "z >= 2*gap")))


def test_the_hash_is_that_of_the_bytes_of_the_file(write: Write) -> None:
    import hashlib

    path = write()
    assert load_spec(path).sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_single_sine_may_stand_without_a_list(write: Write) -> None:
    one = "{sine: {amplitude: 2, frequency: pi}}"
    listed = "{sine: [{amplitude: 2, frequency: pi}]}"
    line = next(line for line in SPEC.splitlines() if line.startswith("  output:"))

    def read(output: str) -> Spec:
        return load_spec(write((line, f"  output: {output}")))

    first, second = read(one).problem.reference, read(listed).problem.reference
    assert isinstance(first, OutputReference)
    assert isinstance(second, OutputReference)
    assert first.signals([2])[0](0.3) == second.signals([2])[0](0.3) != 0.0


@pytest.mark.parametrize("text", ["7", "-1", "four", "", "1.5", "[4]"])
def test_an_exit_code_that_cannot_be_is_refused(write: Write, text: str) -> None:
    path = write(("reference:", f"expect: {{exit: {text}}}\nreference:"))
    problem = only(path)
    assert "expect.exit" in problem.message
    assert problem.place is not None
    assert problem.place.line == 22


@pytest.mark.parametrize("text", ["0", "4", "'4'", "4.0", "+4", "04", "0_4", "4e0"])
def test_the_expected_exit_code_is_the_same_whoever_reads_it(write: Write, text: str) -> None:
    path = write(("reference:", f"expect: {{exit: {text}}}\nreference:"))
    try:
        expected = load_spec(path).expected_exit
    except InvalidSpec:
        expected = 0
    assert expected_exit(path) == expected


def test_the_expected_exit_code_of_a_file_in_error_is_read(write: Write) -> None:
    path = write(("k: 0.5", "k: 2*kk"), ("reference:", "expect: {exit: 2}\nrefrence:"))
    assert len(problems(path)) > 1
    assert expected_exit(path) == 2


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"a: [",
        b"\xff",
        b"expect: 4",
        b"expect: [4]",
        b"expect: {exit: four}",
        b"expect: {exit: [4]}",
        b"expect:",
        b"[expect]",
        b"expect: {exit: 1e400}",
        b"expect: {exit: " + b"9" * 5000 + b"}",
    ],
)
def test_a_file_that_says_no_exit_code_expects_zero(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(content)
    assert expected_exit(path) == 0
    assert expected_exit(tmp_path / "missing.yaml") == 0


def test_a_matrix_without_inner_brackets_is_said_once(write: Write) -> None:
    problem = only(write(("C: [[1, 0]]", "C: [1, 0]")))
    assert "system.C: a list of rows is expected" in problem.message
    assert "[[1, 0]]" in problem.hint


def test_a_reference_faster_than_the_samples_is_remarked(write: Write) -> None:
    line = next(line for line in SPEC.splitlines() if line.startswith("  output:"))
    result = simulate(load_spec(write((line, "  output: {sine: {amplitude: 0.1, frequency: 2*pi*100}}"))))
    assert any("too long for a reference with a period of 0.01 s" in remark for remark in result.remarks)


def test_more_trapezoids_than_can_be_built_are_refused(write: Write) -> None:
    shape = "{trapezoid: {high: 1, rise: 1e-6, fall: 1e-6, smooth: 1e-6}}"
    path = write(("output: ", f"output: {shape} #"))
    assert only(path).message == "reference.output.trapezoid: 1e+06 trapezoids until t = 2 s"


def test_a_unit_of_1_is_no_unit(write: Write) -> None:
    spec = load_spec(write(("units: {z: m, y: m}", 'units: {z: m, y: 1, v: "1"}')))
    assert spec.problem.units == {"z": "m"}
