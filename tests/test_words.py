"""What people are told: how much of it, in which order, and nothing that a terminal would obey."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from typer.testing import CliRunner

from pwatrack.arrays import number_text
from pwatrack.cli import app
from pwatrack.control.convergence import prove_convergence
from pwatrack.errors import Infeasible, InvalidSpec, OutsideTheory, Problem, PwatrackError
from pwatrack.model.nonlinearity import dead_zone, drives_away, spring
from pwatrack.model.pwa import continuous_offset
from pwatrack.report.terminal import console, refusal_lines, visible
from pwatrack.spec.load import load_spec
from pwatrack.spec.wording import guess, misread, odd_character

PLANT = """\
name: Mass that meets a spring
parameters: {k: 4, gap: 0.1}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  B: [[0], [1]]
  C: [[1, 0]]
"""
REST = """\
reference: {output: "0.1*sin(t)"}
simulation: {duration: 1, sample_time: 0.1}
"""


def written(folder: Path, plant: str, rest: str = REST) -> Path:
    path = folder / "plant.yaml"
    path.write_text(PLANT + plant + rest, encoding="utf-8")
    return path


def test_a_refusal_of_many_cells_is_a_few_words_with_the_worst_first_and_complete_in_the_exception() -> None:
    rates = np.linspace(-2.0, 1.0, 48)
    with pytest.raises(Infeasible) as caught:
        prove_convergence(rates[:, None, None], claim="(7)", cells=[f"cell {k}" for k in range(48)])
    (problem,) = caught.value.problems
    assert all(f"{rate:+.4g} in cell 'cell {k}'" in problem.message for k, rate in enumerate(rates))
    assert problem.short.startswith("(7) is infeasible: 'cell 47', 'cell 46', 'cell 45' … and 13 more not stable")
    assert problem.short.endswith(
        "+1 in cell 'cell 47', +0.9362 in cell 'cell 46', +0.8723 in cell 'cell 45' … and 45 more"
    )
    assert refusal_lines(caught.value)[0].startswith(f"error: {problem.short} [P")


@pytest.mark.parametrize(("kind", "most"), [(OutsideTheory, 11), (InvalidSpec, 21)])
def test_however_many_problems_there_are_the_terminal_shows_a_few_and_counts_the_rest(
    kind: type[PwatrackError], most: int
) -> None:
    error = kind(*(Problem(message=f"wrong {k}", hint="mend it" if k % 7 else "") for k in range(300)))
    lines = refusal_lines(error)
    shown = [line for line in lines if line.startswith("error: wrong")]
    assert lines[-1] == f"error: … and {300 - len(shown)} more; 'check --json' lists them"
    assert shown == [f"error: wrong {k} [P{int(kind.code)}00]" for k in range(len(shown))]
    assert len(lines) <= most + 6 * (kind is InvalidSpec)


@given(st.lists(st.sampled_from(["", "mend it", "or that"]), min_size=1, max_size=30))
def test_each_shown_problem_has_its_hint_below_it_or_below_its_neighbours(hints: list[str]) -> None:
    lines = refusal_lines(OutsideTheory(*(Problem(message=str(k), hint=hint) for k, hint in enumerate(hints))))
    waiting: list[int] = []
    for line in lines:
        if line.startswith("  hint: "):
            assert {hints[k] for k in waiting if hints[k]} == {line.removeprefix("  hint: ")}
            waiting = []
        elif "… and" not in line:
            waiting.append(int(line.removeprefix("error: ").removesuffix(" [P300]")))
    assert not any(hints[k] for k in waiting)


def test_facets_at_which_the_field_jumps_are_told_with_the_largest_jump_first(tmp_path: Path) -> None:
    cells = "  cells:\n" + "".join(
        f'    - {{name: c{k}, where: ["{k} <= z <= {k + 1}"], A: [[0, 1], [-1, -1]], b: [0, {k * k}]}}\n'
        for k in range(24)
    )
    ends = (
        '    - {name: left, where: ["z <= 0"], A: [[0, 1], [-1, -1]]}\n'
        '    - {name: right, where: ["z >= 24"], A: [[0, 1], [-1, -1]], b: [0, 576]}\n'
    )
    run = CliRunner().invoke(app, ["check", str(written(tmp_path, cells + ends))])
    assert run.exit_code == 3
    assert len(run.stderr.splitlines()) <= 11
    assert "… and" in run.stderr.splitlines()[-1]
    found = json.loads(CliRunner().invoke(app, ["check", str(tmp_path / "plant.yaml"), "--json"]).stdout)["problems"]
    sizes = [float(re.findall(r"([\d.e+-]+) of that equation's terms", problem["message"])[0]) for problem in found]
    assert len(sizes) > 20
    assert sizes == sorted(sizes, reverse=True)
    assert all(problem["place"].startswith(str(tmp_path)) for problem in found)


@given(st.text())
def test_no_text_has_a_control_character_left(text: str) -> None:
    assert not any(ord(c) < 32 or 127 <= ord(c) < 160 or c in "\u202e\u2028" for c in visible(text) if c not in "\t\n")
    assert visible("".join(c for c in text if c.isprintable())) == "".join(c for c in text if c.isprintable())


def test_a_table_on_the_terminal_obeys_no_name(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.table import Table

    table = Table(title="a\x1b]0;title\x07")
    table.add_column("b\x9b31m")
    table.add_row("c\x1b[2J")
    console().print(table)
    console().print("d\x1b[2J", soft_wrap=True)
    printed = capsys.readouterr().out
    assert "\x1b" not in printed
    assert "\x9b" not in printed
    assert "\\x1b[2J" in printed


def test_a_key_with_a_line_end_forges_no_line_of_ours(tmp_path: Path) -> None:
    path = written(tmp_path, "", REST + '"a\\nerror: b\\e[2J": 1\n')
    run = CliRunner().invoke(app, ["check", str(path)])
    assert run.exit_code == 2
    assert "\nerror: b" not in run.stderr
    assert "\x1b" not in run.stderr


@given(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from([".4g", "+.4g", ".5g", ".3f", ".2e", "g"]))
def test_a_number_is_printed_as_python_does_but_zero_has_no_minus(value: float, form: str) -> None:
    text = number_text(value, form)
    assert text.lstrip("+-") == format(value, form).lstrip("+-")
    assert not text.startswith("-") or float(text) < 0


SPRING = """\
  A: [[0, 1], [-1, -1]]
  nonlinearities: [{name: stop, kind: %s}]
"""


STOP = "spring, of: z, start: gap, slope: k, into: {v: -1}"


@pytest.mark.parametrize(
    ("element", "said"),
    [
        ("spring, of: z, start: gap, slope: k, into: {v: -1}", None),
        (
            "spring, of: z, start: gap, slope: k, into: {v: 1}",
            "pushes z on, away from where it acts: write into: {v: -1}",
        ),
        ("spring, of: z, start: gap, slope: k, into: {v: 0}", "acts on nothing: its factors are all 0"),
        ("saturation, of: z, lower: -1, upper: 1, slope: 0, into: {v: 1}", "acts on nothing: its slopes are all 0"),
        ("saturation, of: z, lower: -1, upper: 1, slope: k, into: {v: 1}", None),
    ],
)
def test_check_remarks_a_spring_that_pushes_or_does_nothing(tmp_path: Path, element: str, said: str | None) -> None:
    run = CliRunner().invoke(app, ["check", str(written(tmp_path, SPRING % element)), "--json"])
    assert run.exit_code == 0
    found = json.loads(run.stdout)["remarks"]
    assert len(found) == (said is not None)
    assert said is None or said in found[0]


@given(
    st.floats(0.1, 10), st.floats(0.1, 10), st.floats(0.1, 10), st.booleans(), st.booleans(), st.sampled_from([1, -1])
)
def test_a_spring_between_two_masses_is_remarked_exactly_where_it_gives_energy(
    m1: float, m2: float, k: float, first: bool, second: bool, slope: int
) -> None:
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0  # z1, v1, z2, v2
    row = np.array([-1.0, 0.0, 1.0, 0.0])
    pull = np.array([0.0, 1 / m1 if first else -1 / m1, 0.0, -1 / m2 if second else 1 / m2]) * slope
    gap = dead_zone(lower=-0.1, upper=0.1, lower_slope=slope * k, upper_slope=slope * k)
    # the acceleration of s = z2 - z1 through each mass, where s is above the gap
    through = (row @ A) * pull * gap(0.3)
    assert drives_away(A, [float(v) for v in gap.slopes], row, pull) == np.flatnonzero(through > 0).tolist()


def test_elements_that_drive_no_velocity_or_have_both_slopes_are_left_alone() -> None:
    A = np.array([[0.0, 1.0], [0.0, 0.0]])
    for function, direction in (
        (spring(), np.array([1.0, 0.0])),  # drives what it looks at: a valve
        (dead_zone(lower=-1, upper=1, lower_slope=-1.0, upper_slope=1.0), np.array([0.0, 1.0])),
    ):
        assert drives_away(A, [float(v) for v in function.slopes], np.array([1.0, 0.0]), direction) == []


CELLS = """\
  cells:
    - {{name: free, where: ["z <= gap"], A: [[0, 1], [-1, -1]]{free}}}
    - {{name: touching, where: ["z >= gap"], A: [[0, 1], [-1 - k, -1]]{touching}}}
"""


@pytest.mark.parametrize(
    ("free", "touching", "hint"),
    [
        ("", "", "b: [0, 0.4] in cell 'touching' would make it continuous"),
        (", b: [0, 1]", "", "b: [0, 1.4] in cell 'touching' would make it continuous"),
        ("", ", b: [0, 1]", "b: [0, 0.4] in cell 'touching' would make it continuous"),
        (", b: [0, 1]", ", b: [0, 2]", "correct the cell"),
    ],
)
def test_a_missing_b_is_proposed_and_the_plant_with_it_is_continuous(
    tmp_path: Path, free: str, touching: str, hint: str
) -> None:
    with pytest.raises(OutsideTheory) as caught:
        load_spec(written(tmp_path, CELLS.format(free=free, touching=touching)))
    (problem,) = caught.value.problems
    assert hint in problem.hint
    if hint.startswith("b: "):
        b = f", {hint.partition(' in cell')[0]}"
        found = {"free": free, "touching": touching} | ({"free": b} if "'free'" in hint else {"touching": b})
        assert load_spec(written(tmp_path, CELLS.format(**found))).problem.plant.b.shape == (2, 2)


_VECTORS = st.lists(st.integers(-9, 9).map(float), min_size=3, max_size=3).map(np.array)


@given(_VECTORS, _VECTORS, _VECTORS, st.integers(-9, 9), st.integers(0, 8))
def test_the_proposed_offset_makes_the_field_continuous_at_every_point_of_the_facet(
    g: np.ndarray, H: np.ndarray, b: np.ndarray, h: int, entry: int
) -> None:
    assume(H.any())
    A = np.arange(9.0).reshape(3, 3)
    other = A + np.outer(g, H)
    found = continuous_offset(other, A, b, H, h)
    assert found is not None
    foot = -h * H / (H @ H)
    null = np.linalg.svd(H[None])[2][1:]
    for x in (foot, foot + null[0], foot - 3 * null[1]):
        assert np.allclose(other @ x + found, A @ x + b, atol=1e-9)
    bent = other.copy()
    bent.flat[entry] += 1.0
    if np.linalg.matrix_rank(np.vstack([bent - A, H])) > 1:  # more than one direction: no offset can help
        assert continuous_offset(bent, A, b, H, h) is None


@pytest.mark.parametrize(
    ("reference", "code", "words"),
    [
        ('{output: "0.1*sin(t)"}', 0, "bounded and smooth enough for relative degree 2"),
        ('{output: "t"}', 3, "not bounded"),
        ("{output: {polyline: {points: [[0, 0], [0.5, 1]]}}}", 3, "jumps by 2 at t = 0.5"),
        ("{output: {step: {size: 1, at: 0.5, smooth: 0.2}}}", 0, "smooth enough"),
    ],
)
def test_check_says_whether_the_reference_is_one_of_the_theorem(
    tmp_path: Path, reference: str, code: int, words: str
) -> None:
    rest = f"reference: {reference}\nsimulation: {{duration: 1, sample_time: 0.1}}\n"
    run = CliRunner().invoke(app, ["check", str(written(tmp_path, SPRING % STOP, rest))])
    assert run.exit_code == code, run.output
    assert words in " ".join((run.stdout + run.stderr).split())
    assert "relative degree 2" in " ".join(run.stdout.split())  # what is known of the plant is said either way


@pytest.mark.parametrize(
    ("reference", "code"),
    [
        ("{state: [sin(t), cos(t)]}", 0),
        ("{state: [sin(t), sin(t)]}", 3),
        ("{setpoint: {y: 0.05}}", 0),
        ("{input: [sin(t)], start: periodic}", 0),
        ("{input: [sin(t) + sin(pi*t)], start: periodic}", 2),
    ],
)
def test_check_looks_at_a_reference_for_state_tracking(tmp_path: Path, reference: str, code: int) -> None:
    rest = f"design: {{tracking: state}}\nreference: {reference}\nsimulation: {{duration: 1, sample_time: 0.1}}\n"
    run = CliRunner().invoke(app, ["check", str(written(tmp_path, SPRING % STOP, rest)), "--json"])
    assert run.exit_code == code, run.output
    assert (json.loads(run.stdout)["reference"] is None) == (code != 0)


def test_names_that_look_alike_are_told_apart_by_the_character() -> None:
    assert guess("g\u0430p", ["gap"]) == (
        "; it has the character '\u0430' (U+0430, CYRILLIC SMALL LETTER A); did you mean 'gap'?"
    )
    assert odd_character("gap") == ""


@pytest.mark.parametrize(
    "text",
    ["1e-3", "-.5", "5.", "2*pi", "sin(2*t)", "max(1, 2)", "atan2(1,2)", "x1*2e3", "a <= z < b", "a if b else c"],
)
def test_nothing_is_said_against_what_is_well_written(text: str) -> None:
    assert misread(text) == ""
