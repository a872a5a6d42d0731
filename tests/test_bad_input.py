"""Bad input: one clear error with its place, the right exit code, no traceback, and nothing written."""

import os
import re
import stat
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from pwatrack.cli import app
from pwatrack.errors import InvalidSpec, PwatrackError
from pwatrack.spec.expression import ExpressionError, formula, inequalities, linear_form, real
from pwatrack.spec.load import load_spec
from pwatrack.spec.yaml_tree import parse_yaml
from tests.test_outcome import cart

SPEC = """\
name: Mass that meets a spring
parameters:
  m: 2
  k: 0.5
  gap: 0.1
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  units: {z: m, u: N}
  A: [[0, 1], [-1/m, -1]]
  b: [0, 0]
  nonlinearities:
    - {name: stop, kind: spring, of: z, start: gap, slope: k, into: {v: -1/m}}
  B: [[0], [1/m]]
  C: [[1, 0]]
design:
  controller: {rate: 0.1}
reference:
  output: {constant: 0.05, sine: {amplitude: 0.2, frequency: 2}}
simulation:
  duration: 2
  sample_time: 0.01
  initial: {plant: [gap, 0]}
  ensemble: {initial: {plant: {z: [0, 0.1]}}}
"""

# What is written instead of what, the line that the error must name, and words that it must have.
# A case is one line; the replaced text stands in SPEC once.
INVALID = [
    # numbers
    ("m: 2", "m: 2t", 3, "write 2*t"),
    ("m: 2", "m: 0x10", 3, "'0x10' is no decimal number"),
    ("m: 2", "m: 0b11", 3, "'0b11' is no decimal number"),
    ("m: 2", "m: 1_000", 3, "write 1000"),
    ("m: 2", "m: 0_1", 3, "without '_'"),
    ("m: 2", "m: 010", 3, "write 10"),
    ("m: 2", "m: '1 # c'", 3, "no comment inside quotes"),
    ("m: 2", "m: \uff11\uff10", 3, "U+FF11, FULLWIDTH DIGIT ONE): write 1"),
    ("m: 2", "m: 0,5", 3, "write 0.5: decimals have a point"),
    ("m: 2", "m: \u22122", 3, "U+2212, MINUS SIGN): write -"),
    ("m: 2", "m: 2\u00d73", 3, "U+00D7, MULTIPLICATION SIGN): write *"),
    ("m: 2", "m: 2\u00b73", 3, "U+00B7, MIDDLE DOT): write *"),
    ("m: 2", "m: 2*\u03c0", 3, "GREEK SMALL LETTER PI): write pi"),
    ("m: 2", "m: 2\u00b2", 3, "SUPERSCRIPT TWO): write **2"),
    ("m: 2", "m: 2^3", 3, "write ** for powers"),
    ("m: 2", "m: 2 kg", 3, "units are not read"),
    ("m: 2", "m: 1e", 3, "'1e' has no exponent"),
    ("m: 2", "m: 1.5.2", 3, "'1.5.2' is no number"),
    ("m: 2", "m:", 3, "nothing is given"),
    ("m: 2", "m: [2]", 3, "a number or an expression is expected"),
    ("m: 2", "m: 3(1 + 1)", 3, "write * for a product"),
    ("m: 2", "m: (1 + 1)(1 + 2)", 3, "write * for a product"),
    ("m: 2", "m: 1/0", 3, "divides by zero"),
    ("m: 2", "m: 9**9**9**9", 3, "'9**9**9' is not finite"),
    ("k: 0.5", "k: m(3)", 4, "'m' is no function: write m*"),
    ("k: 0.5", "k: g\u0430p", 4, "CYRILLIC SMALL LETTER A"),
    ("k: 0.5", "k: gap", 4, "declared below"),
    ("k: 0.5", 'k: "0.5\\e[2J"', 4, "U+001B"),
    ("k: 0.5", "k: sine(1)", 4, "did you mean 'sin'"),
    ("k: 0.5", "k: sin(0,5)", 4, "write 0.5"),
    ("m: 2", "m: 1e-308", 11, "-1e+308 is larger than 1e+60"),
    ("m: 2", "m: 1e-308", 15, "1e+308 is larger than 1e+60"),
    ("[-1/m, -1]]", "[-1e61, -1]]", 11, "-1e+61 is larger than 1e+60"),
    ("[-1/m, -1]]", "[-1e-308, -1]]", 11, "is smaller than 1e-60 but not 0"),
    ("B: [[0], [1/m]]", "B: [[0], [5e-324]]", 15, "is smaller than 1e-60"),
    ("C: [[1, 0]]", "C: [[1e-308, 0]]", 16, "is smaller than 1e-60"),
    ("of: z,", "of: 1e-300*z,", 14, "is smaller than 1e-60"),
    # names
    ("states: [z, v]", "states: [z, \uff56]", 7, "FULLWIDTH LATIN SMALL LETTER V"),
    ("states: [z, v]", "states: [z, z]", 7, "'z' stands in the list twice"),
    ("states: [z, v]", "states: z", 7, "a list is expected"),
    ("states: [z, v]", "states: []", 7, "at least one name is expected"),
    ("states: [z, v]", f"states: [{', '.join(f'z{k}' for k in range(201))}]", 7, "201 entries, at most 200 are read"),
    ("inputs: [u]", f"inputs: [{', '.join(f'u{k}' for k in range(101))}]", 8, "at most 100 are read"),
    ("inputs: [u]", "inputs: [u, lambda]", 8, "'lambda' is a word of Python's"),
    ("outputs: [y]", "outputs: [v]", 9, "declared under states and under outputs"),
    ("z: m, u: N", "q: m, u: N", 10, "'q' is no state, input or output"),
    ("z: m, u: N", "z: [m], u: N", 10, "a text is expected"),
    ("name: Mass that", f"name: {'x' * 201}", 1, "characters, at most 200 are read"),
    ("name: Mass that meets a spring", 'name: "a\\e[31mb"', 1, "U+001B"),
    ("name: Mass that meets a spring", 'name: "a\\nerror: b"', 1, "a line end is in it"),
    ("name: Mass that meets a spring", 'name: "a\\u202eb"', 1, "RIGHT-TO-LEFT OVERRIDE"),
    ("name: stop", f"name: {'x' * 500}", 14, "at most 200 are read"),
    ("name: stop", "name: [stop]", 14, "a text is expected"),
    ("into: {v: -1/m}", "into: {\u0475: -1/m}", 14, "CYRILLIC SMALL LETTER IZHITSA"),
    ("into: {v: -1/m}", "into: {}", 14, "at least 1 entry is expected"),
    ("into: {v: -1/m}", "into: [v]", 14, "a mapping is expected"),
    # keys and kinds
    ("  controller: {rate: 0.1}", "  rate: 5", 18, "'rate' belongs under controller or observer"),
    ("  controller: {rate: 0.1}", "  K: [[1, 1]]", 18, "'K' belongs under controller"),
    ("  controller: {rate: 0.1}", "  contoller: {rate: 0.1}", 18, "did you mean 'controller'?"),
    ("  controller: {rate: 0.1}", "  tracking: outputs", 18, "'outputs' is not 'output', 'state' or 'practical'"),
    ("  controller: {rate: 0.1}", "  controller: 3", 18, "a mapping is expected"),
    ("kind: spring", "kind: sprng", 14, "kind 'sprng' is none of"),
    ("kind: spring, ", "", 14, "kind is missing"),
    ("  duration: 2", "  tracking: output\n  duration: 2", 22, "'tracking' belongs under design"),
    ("duration: 2", "duration: two", 22, "unknown name 'two'"),
    ("duration: 2", "duration: 0", 22, "0 is not positive"),
    ("duration: 2", "duration: {a: 1}", 22, "a number or an expression is expected"),
    ("sample_time: 0.01", "sample_time: 1e-9", 23, "at most 10,000,000 are taken"),
    ("{plant: [gap, 0]}", "{plant: {q: 0.1}}", 24, "'q' is no state; states: z, v"),
    ("{plant: [gap, 0]}", "{plant: {z: 2t}}", 24, "write 2*t"),
    ("{plant: [gap, 0]}", "{plant: gap}", 24, "'gap' is neither 'steady' nor a list or mapping"),
    ("{plant: [gap, 0]}", "{observer: {w: 1}}", 24, "'w' is no state"),
    ("{plant: {z: [0, 0.1]}}", "{plant: {z: [0.1, 0]}}", 25, "low 0.1 is above high 0"),
    ("{plant: {z: [0, 0.1]}}", "{plant: {z: 3}}", 25, "a list is expected"),
    ("simulation:", "expect: {exit: 1.5}\nsimulation:", 21, "a whole number"),
    ("simulation:", "expect: {exit: 7}\nsimulation:", 21, "7 is above 6"),
    ("simulation:", "expect: {exit: -1}\nsimulation:", 21, "-1 is below 0"),
    ("duration: 2", "duration: 2\n  noise: {std: {y: 1}, sample_time: 0.1, seed: 1_0}", 23, "a whole number"),
    ("duration: 2", "duration: 2\n  portraits: [[z]]", 23, "two linear forms"),
    ("duration: 2", "duration: 2\n  actuator: {limits: {u: 3}}", 23, "a lower and an upper limit"),
    ("duration: 2", "duration: 2\n  actuator: {limits: {u: [[1], 2]}}", 23, "a number or an expression is expected"),
    ("duration: 2", "duration: 2\n  quantum: {q: 1}\n  controller: {sample_time: 0}", 23, "'q' is no input or output"),
    # formulas
    ("{constant: 0.05, sine: {amplitude: 0.2, frequency: 2}}", "sin(2t)", 20, "write 2*t"),
    ("{constant: 0.05, sine: {amplitude: 0.2, frequency: 2}}", "t^2", 20, "write ** for powers"),
    ("{constant: 0.05, sine: {amplitude: 0.2, frequency: 2}}", "{}", 20, "nothing is given"),
    ("{constant: 0.05, sine: {amplitude: 0.2, frequency: 2}}", "[1]", 20, "a mapping is expected"),
    ("sine: {amplitude: 0.2, frequency: 2}", f"sine: [{'{amplitude: 1, frequency: 1}, ' * 201}]", 20, "at most 200"),
    # YAML
    ("m: 2", "\tm: 2", 3, "that is a tab"),
    ("m: 2", "m: @2", 3, "put the value in quotes"),
    ("m: 2", "m: &a 2", 3, "anchors and aliases are not supported"),
    ("m: 2", "m: 2\n  m: 3", 4, "stands here a second time"),
    ("m: 2", "m: !!float 2", 3, "tags are not supported"),
]  # fmt: skip

OUTSIDE = [
    ("[1/m]]", "[0]]", 15, "no relative degree"),
    ("{constant: 0.05, sine: {amplitude: 0.2, frequency: 2}}", "t", 20, "not bounded"),
    ("{constant: 0.05, sine: {amplitude: 0.2, frequency: 2}}", "{step: {size: 1, at: 1}}", 20, "jumps by 1"),
]


def call(*arguments: object) -> tuple[int, str, str]:
    run = CliRunner().invoke(app, [str(a) for a in arguments])
    assert "Traceback" not in run.output
    return run.exit_code, run.stdout, run.stderr


def written(folder: Path, *replacements: tuple[str, str]) -> Path:
    text = SPEC
    for old, new in replacements:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("old", "new", "line", "words", "code"),
    [(*case, 2) for case in INVALID] + [(*case, 3) for case in OUTSIDE],
    ids=lambda value: ascii(value)[:40] if isinstance(value, str) else None,
)
def test_bad_input_is_refused_at_its_line_in_plain_words(
    tmp_path: Path, old: str, new: str, line: int, words: str, code: int
) -> None:
    path = written(tmp_path, (old, new))
    found, _, message = call("check", path)
    assert found == code, message
    lines = [int(number) for number in re.findall(rf"^error: {re.escape(str(path))}:(\d+):\d+: ", message, re.M)]
    assert line in lines, message
    about = [text for text in message.splitlines() if f"{path}:{line}:" in text or text.startswith("  hint")]
    assert any(words in text for text in about), message
    assert "Input should" not in message
    assert "\x1b" not in message
    assert len(message) < 5_000
    assert [p.name for p in tmp_path.iterdir()] == ["plant.yaml"]


def test_the_spec_without_a_fault_is_read(tmp_path: Path) -> None:
    assert call("check", written(tmp_path))[0] == 0


def test_initial_states_by_name_are_those_in_order(tmp_path: Path) -> None:
    by_name = load_spec(
        written(tmp_path, ("{plant: [gap, 0]}", "{plant: {z: gap}, observer: {v: -1}}"))
    ).scenario.initial
    in_order = load_spec(
        written(tmp_path, ("{plant: [gap, 0]}", "{plant: [gap, 0], observer: [0, -1]}"))
    ).scenario.initial
    for one, other in ((by_name.plant, in_order.plant), (by_name.observer, in_order.observer)):
        assert isinstance(one, np.ndarray)
        assert isinstance(other, np.ndarray)
        assert one.tolist() == other.tolist()


@pytest.mark.parametrize("names", ["plant: {names: 0.1, v: 2}", "plant: {v: 2, names: 0.1}"])
def test_any_name_of_a_state_will_do(tmp_path: Path, names: str) -> None:
    path = written(tmp_path, ("[gap, 0]", "[0, 0]"), ("plant: {z: [0, 0.1]}", "plant: {names: [0, 0.1]}"))
    path.write_text(
        re.sub(r"\bz\b", "names", path.read_text(encoding="utf-8")).replace("plant: [0, 0]", names), encoding="utf-8"
    )
    x0 = load_spec(path).scenario.initial.plant
    assert isinstance(x0, np.ndarray)
    assert x0.tolist() == [0.1, 2.0]


def test_a_parameter_that_is_set_twice_is_refused_with_both_values(tmp_path: Path) -> None:
    code, _, message = call("check", written(tmp_path), "--set", "k=1", "--set", " k = 2")
    assert code == 2
    assert "--set k is given 2 times: 1 and 2" in message


def test_a_fifo_is_no_spec_and_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.yaml")
    code, _, message = call("check", tmp_path / "fifo.yaml")
    assert (code, "it is no regular file" in message) == (2, True)


def test_neither_is_it_a_controller_nor_the_index_of_a_run(tmp_path: Path, specs: Path) -> None:
    (tmp_path / "run").mkdir()
    for name in ("fifo.json", "run/run.json"):
        os.mkfifo(tmp_path / name)
    spec, out = specs / "two_mass_paper_gains.yaml", ("--out", tmp_path / "run")
    code, _, message = call("simulate", spec, "--controller", tmp_path / "fifo.json", *out)
    assert (code, "it is no regular file" in message) == (2, True)
    assert call("compare", tmp_path / "run", tmp_path / "run")[0] == 2


def test_a_device_that_never_ends_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    assert stat.S_ISCHR((tmp_path / "zero.yaml").stat().st_mode)
    code, _, message = call("check", tmp_path / "zero.yaml")
    assert (code, "it is no regular file" in message) == (2, True)


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    with path.open("wb") as file:
        file.truncate(2**40)  # a hole: it takes no room
    code, _, message = call("check", path)
    assert (code, "at most 4,194,304 are read" in message) == (2, True)


@pytest.mark.parametrize("path", ["a\0b.yaml", "missing.yaml", "."])
def test_a_path_that_cannot_be_read_is_said(path: str) -> None:
    with pytest.raises(InvalidSpec, match="cannot read"):
        load_spec(path)


def test_many_parameters_are_read_and_many_faults_are_counted(tmp_path: Path) -> None:
    many = "".join(f"  p{k}: {k}*m\n" for k in range(3_000))
    assert call("check", written(tmp_path, ("  gap: 0.1\n", f"  gap: 0.1\n{many}")))[0] == 0
    wrong = "".join(f"  p{k}: q{k}\n" for k in range(3_000))
    code, _, message = call("check", written(tmp_path, ("  gap: 0.1\n", f"  gap: 0.1\n{wrong}")))
    assert code == 2
    assert "… and 2,980 more" in message
    assert sum(line.startswith("error: ") for line in message.splitlines()) == 21


def test_what_is_unknown_many_times_is_guessed_at_only_a_few_times(tmp_path: Path) -> None:
    keys = ", ".join(f"rate{k}: 1" for k in range(3_000))
    with pytest.raises(InvalidSpec) as caught:
        load_spec(written(tmp_path, ("controller: {rate: 0.1}", f"controller: {{{keys}}}")))
    assert len(caught.value.problems) == 3_000
    assert sum("did you mean" in p.message for p in caught.value.problems) == 100


_CHARACTERS = st.text(alphabet=st.sampled_from("ab12 :-[]{}&*!|>'\"%@`,?#\n\t\0~<ä\u0430\u2212\x1b\ue000"), max_size=60)


@settings(max_examples=150)
@given(_CHARACTERS)
def test_any_text_is_a_tree_or_is_refused(text: str) -> None:
    try:
        parse_yaml(text, "f.yaml")
    except InvalidSpec as error:
        assert error.problems[0].place is not None  # noqa: PT017


_TERMS = st.lists(
    st.sampled_from([*"0123456789.+-*/()^,<>=# _eEtzw²\u2212", "**", "sin(", "exp(", "max(", "pi", "1e", "0x", "and"]),
    max_size=16,
).map("".join)


@settings(max_examples=400)
@given(_TERMS)
def test_any_text_is_an_expression_or_is_refused(text: str) -> None:
    parameters = {"k": 2.0, "w": 0.5}
    for read in (
        lambda: real(text, parameters),
        lambda: linear_form(text, ["z"], parameters),
        lambda: inequalities(text, ["z"], parameters),
        lambda: formula(text, parameters),
    ):
        try:
            read()
        except ExpressionError as error:
            assert str(error)  # noqa: PT017


_VALUES = st.sampled_from(
    [
        "",
        "3",
        "-1",
        "1e-300",
        "nan",
        "x",
        "[]",
        "{}",
        "[[]]",
        "[1, 2]",
        "{a: 1}",
        "[z]",
        "periodic",
        "*",
        "'",
        "[[1], 3]",
    ]
)


@settings(max_examples=60)
@given(st.integers(0, len(SPEC.splitlines()) - 1), _VALUES)
def test_any_value_in_any_place_is_read_or_refused_in_our_own_words(
    tmp_path_factory: pytest.TempPathFactory, line: int, value: str
) -> None:
    lines = SPEC.splitlines()
    key, _, _ = lines[line].partition(":")
    lines[line] = f"{key}: {value}"
    path = tmp_path_factory.mktemp("any") / "x.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    try:
        load_spec(path)
    except PwatrackError as error:
        for problem in error.problems:
            text = problem.message
            assert not re.search(r"Input|should (be|have)|valid (tuple|list|dict|string|integer)", text), text


def test_a_key_of_another_kind_is_said_to_be_that(tmp_path: Path) -> None:
    path = cart(tmp_path, duration=2)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("start: 0.1,", "start: 0.1, lower: -1,"), encoding="utf-8")
    code, _, error = call("check", path)
    assert code == 2
    assert "lower: unknown key; 'lower' is for kind: " in error
    assert "did you mean 'lower'" not in error
