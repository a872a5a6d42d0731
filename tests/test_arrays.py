"""Plants and problems from arrays and mappings are those of files, and so is all that is said of them."""

import ast
import doctest
import json
import math
import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PPoly

import pwatrack
from pwatrack import (
    CheckFailed,
    Infeasible,
    InvalidSpec,
    OutsideTheory,
    PwatrackError,
    Result,
    Spec,
    design,
    ensemble,
    load_spec,
    plant,
    problem,
    simulate,
)
from pwatrack.commands.verify import verify
from pwatrack.rational import fraction_of
from pwatrack.spec.expression import Expression
from pwatrack.spec.yaml_tree import document_of, parse_yaml, yaml_text
from tests.conftest import SPECS

SHIPPED = sorted(SPECS.rglob("*.yaml"))
FILE_ONLY = {"path", "sha256", "text", "places"}  # of a spec

STOP: dict[str, Any] = {
    "A": [[[0, 1], [-1, -1]], [[0, 1], [-3, -1]]],
    "b": [[0, 0], [0, 0.1]],
    "B": [[0], [1]],
    "C": [[1, 0]],
    "H": [[1, 0]],
    "h": [-0.05],
    "signs": [[-1], [1]],
}
ASKED: dict[str, Any] = {"reference": "0.1*sin(t)", "simulation": {"duration": 10, "sample_time": 0.1}}


def differences(one: Any, other: Any, where: str = "spec") -> list[str]:
    """Return where two descriptions differ; of a spec, but for the file that it is from."""
    if isinstance(one, np.ndarray):
        return [] if np.array_equal(one, other) else [where]
    if isinstance(one, Expression) and isinstance(other, Expression):  # 0.40 is 0.4
        return [] if ast.dump(one.tree) == ast.dump(other.tree) else [where]
    if isinstance(one, PPoly) and isinstance(other, PPoly):
        return differences([one.c, one.x], [other.c, other.x], where)
    if is_dataclass(one) and type(one) is type(other):
        names = [f.name for f in fields(one) if not (isinstance(one, Spec) and f.name in FILE_ONLY)]
        pairs = [(name, getattr(one, name), getattr(other, name)) for name in names]
    elif isinstance(one, Mapping) and list(one) == list(other):
        pairs = [(str(key), one[key], other[key]) for key in one]
    elif isinstance(one, list | tuple) and len(one) == len(other):
        pairs = [(str(k), *pair) for k, pair in enumerate(zip(one, other, strict=True))]
    else:
        return [] if type(one) is type(other) and repr(one) == repr(other) else [where]
    return [found for name, a, b in pairs for found in differences(a, b, f"{where}.{name}")]


def with_numbers(tree: Any) -> Any:
    """Return a tree of texts with numbers in place of those that are numbers."""
    if isinstance(tree, dict):
        return {key: with_numbers(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [with_numbers(value) for value in tree]
    if re.fullmatch(r"-?\d+", tree):
        return int(tree)
    return float(tree) if re.fullmatch(r"-?\d*\.?\d+(e[+-]?\d+)?", tree) else tree


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_mapping_is_read_as_the_file_with_the_same_content(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = with_numbers(parse_yaml(path.read_text(encoding="utf-8"), path.name).data)
    try:
        wanted = load_spec(path)
    except PwatrackError as refusal:
        with pytest.raises(type(refusal)) as raised:
            load_spec(content)
        assert len(raised.value.problems) == len(refusal.problems)  # noqa: PT017
        assert all(str(p.place).startswith("spec") for p in raised.value.problems if p.place)
        return
    monkeypatch.chdir(path.parent)  # tables
    assert not differences(load_spec(content), wanted)


def test_what_differs_is_seen() -> None:
    """Of the comparison above."""
    one, other = (problem(plant(**STOP), **ASKED, controller={"rate": rate}) for rate in (0.1, 0.2))
    assert differences(one, other) == ["spec.objectives.controller.rate"]
    other = problem(plant(**STOP | {"C": [[2, 0]]}), **ASKED, controller={"rate": 0.1})
    assert "spec.problem.plant.exact.C.centre" in differences(one, other)


decimals = st.integers(-40, 40).map(lambda k: k / 10) | st.fractions(-5, 5, max_denominator=7)


@st.composite
def plants(draw: st.DrawFn) -> dict[str, Any]:
    """Draw the arguments of a plant with one or two hyperplanes H x + h = 0, behind which the field bends."""
    n, m, q, k = (draw(st.integers(1, most)) for most in (3, 2, 2, 1))
    k = draw(st.integers(1, min(2, n)))

    def matrix(rows: int, columns: int) -> list[list[Fraction]]:
        return [[Fraction(str(draw(decimals))) for _ in range(columns)] for _ in range(rows)]

    A, b, H, h, g = matrix(n, n), matrix(1, n)[0], matrix(k, n), matrix(1, k)[0], matrix(k, n)
    for j, row in enumerate(H):
        row[j] = Fraction(7)  # independent
        if j:
            row[0] = Fraction(0)
    signs = [[(-1, 1)[cell >> j & 1] for j in range(k)] for cell in range(2**k)]
    bent = [[Fraction(side > 0) for side in row] for row in signs]
    return {
        "A": [
            [[A[i][j] + sum(on[p] * g[p][i] * H[p][j] for p in range(k)) for j in range(n)] for i in range(n)]
            for on in bent
        ],
        "b": [[b[i] + sum(on[p] * g[p][i] * h[p] for p in range(k)) for i in range(n)] for on in bent],
        "B": matrix(n, m),
        "C": [[Fraction(i == j) for j in range(n)] for i in range(min(q, n))],
        "H": H,
        "h": h,
        "signs": signs,
    }


@given(plants(), st.booleans())
@settings(max_examples=30)
def test_arrays_mapping_text_and_file_give_the_same_problem(arguments: dict[str, Any], doubles: bool) -> None:
    if doubles:  # of dyadic numbers, so that they are exact
        arguments = {name: np.array(value, dtype=np.float64) for name, value in arguments.items()}
        arguments |= {name: np.round(arguments[name] * 2**20) / 2**20 for name in ("B", "H", "h")}
        arguments["A"] = np.repeat(arguments["A"][:1], len(arguments["A"]), axis=0)
        arguments["b"] = np.repeat(arguments["b"][:1], len(arguments["b"]), axis=0)
    made = plant(**arguments)
    n, m = made.system.B.shape
    asked = {"state": ["sin(t)"] * n} if m > 1 else {"input": ["sin(t)"] * m, "start": [0.1] * n}
    spec = problem(made, reference=asked, tracking="state", simulation={"duration": 1, "sample_time": 0.1})
    assert spec.text is not None
    tree = parse_yaml(spec.text, "spec.yaml").data
    for other in (load_spec(tree), load_spec(yaml.safe_load(spec.text))):
        assert not differences(other, spec)
        assert other.sha256 == spec.sha256
    exact = [[Fraction(str(v)) for v in row] for row in np.asarray(arguments["B"]).tolist()]
    assert [[fraction_of(v) for v in row] for row in made.system.exact.B.centre.tolist()] == exact


@pytest.mark.slow
@given(
    st.recursive(
        st.text(max_size=8).filter(lambda text: not any(0xD800 <= ord(c) < 0xE000 for c in text)),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=8,
    )
)
def test_any_tree_is_read_back_from_its_text(tree: Any) -> None:
    whole = {"name": tree, "system": {"a": tree, "b": [tree]}}
    document = document_of(whole)
    assert not document.problems
    try:
        assert parse_yaml(yaml_text(document.data), "spec.yaml").data == document.data
    except InvalidSpec as refusal:
        assert "merge keys" in str(refusal) or "surrogate" in str(refusal)  # noqa: PT017


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.1, "0.1"),
        (np.float64(1e-3), "0.001"),
        (np.int64(-2), "-2"),
        (np.array([[1.5]]), [["1.5"]]),
        ((1, Fraction(-1, 3)), ["1", "-1/3"]),
        (math.inf, ".inf"),
        ("-k/m", "-k/m"),
        (np.str_("-k/m"), "-k/m"),
        (range(2), ["0", "1"]),
    ],
)
def test_values_are_texts_of_the_same_number(value: Any, text: Any) -> None:
    assert document_of({"a": value}).data == {"a": text}


def without(*names: str, **changes: Any) -> dict[str, Any]:
    return {name: value for name, value in (STOP | changes).items() if name not in names}


WRONG_PLANTS: dict[str, tuple[dict[str, Any], str]] = {
    "rows": (without(B=[[0], [1], [2]]), "B: 3 rows, expected 2"),
    "entries": (without(C=[[1, 0, 0]]), r"C\[0\]: 3 entries, expected 2"),
    "of one cell": (without(A=[STOP["A"][0], [[0, 1]]]), r"A\[1\]: 1 row, expected 2"),
    "a flat matrix": (without(H=[1, 0]), r"H\[0\]: a list is expected"),
    "a flat row": (without(C=[1, 0, 0]), r"C\[0\]: 3 entries, expected 2"),
    "a missing cell": (without(A=STOP["A"][:1]), r"A\[1\] is missing"),
    "an offset": (without(b=[[0, 0], [0, "0.1*k"]]), r"b\[1\]\[1\]: unknown name 'k'"),
    "no number": (without(b=[[0, 0], [0, 1j]]), r"b\[1\]\[1\]: a value of type complex is no number"),
    "not a number": (without(h=[math.nan]), r"h\[0\]: nan is no number"),
    "infinite": (without(h=[math.inf]), r"h\[0\]: '.inf' is not a number"),
    "a normal": (without(H=[[0, 0]]), r"H\[0\]: all entries are 0"),
    "a sign": (without(signs=[[-1], [2]]), r"signs\[1\]\[0\]: '2' is not '\+', '-' or '0'"),
    "signs": (without(signs=[[-1], [1, 1]]), r"signs\[1\]: cell 'A\[1\]': 2 signs, expected 1"),
    "no signs": (without("signs"), r"none signs, expected 1"),
    "an inequality": (without("H", "h", "signs", where=["x1 <= 0", "x1"]), r"where\[1\]\[0\]: 'x1' is not an inequal"),
    "a cell's name": (without(cells=["a", "a"]), r"cells\[1\]: a second cell is named 'a'"),
    "a state's name": (without(states=["z", "2z"]), r"states\[1\]: '2z' is not a name"),
    "an input": (without(inputs=["u", "v"]), r"B\[0\]: 1 entry, expected 2"),
    "a unit": (without(units={"q": "m"}), r"units\['q'\]: units: 'q' is no state"),
    "a size": (without(sizes={"x1": -1}), r"sizes\['x1'\]: -1 is not positive"),
    "what is tracked": (without(track=["z"]), "track: 'z' is no output"),
    "a parameter": (without(parameters={"k": "m"}), r"parameters\['k'\]: parameter 'k': unknown name 'm'"),
    "a tolerance": (without(tolerance=0.1), "tolerance: 0.1 is more than data are rounded by"),
    "planes alone": (without("signs", A=[[0, 1], [-1, -1]], b=[0, 0]), "H: hyperplanes need cells with signs"),
    "an element": (
        {"A": [[-1]], "B": [[1]], "C": [[1]], "nonlinearities": [{"name": "s", "kind": "sprung"}]},
        r"nonlinearities\[0\]: kind 'sprung' is none of",
    ),
    "too deep": (
        without(b=(lambda nest: nest(nest, 30))(lambda again, k: [again(again, k - 1)] if k else 0)),
        r"b[\[\]\d]+: nested deeper",
    ),
}


@pytest.mark.parametrize("case", WRONG_PLANTS)
def test_what_is_wrong_with_a_plant_is_said_by_argument(case: str) -> None:
    arguments, said = WRONG_PLANTS[case]
    with pytest.raises(InvalidSpec, match=rf"(?m)^(cells\[\d\]: )?(cell 'A\[1\]': )?{said}") as raised:
        plant(**arguments)
    assert "system" not in str(raised.value)
    assert all(problem.place is not None for problem in raised.value.problems)


def test_all_that_is_wrong_is_said_at_once() -> None:
    with pytest.raises(InvalidSpec) as raised:
        plant(A=[[0, 1], ["k", -1]], B=[[0], [1], [2]], C=[[1]], tolerance=-1)
    assert [str(p.place) for p in raised.value.problems] == ["A[1][0]", "B", "C[0]", "tolerance"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"signs": [[-1], [-1]]}, "cells: the cells do not cover"),
        ({"signs": [[-1], [0]]}, r"cells\[1\]: cells 'A\[0\]' and 'A\[1\]' overlap"),
        ({"b": [[0, 0], [0, 0.2]]}, r"b\[0\]: cells 'A\[0\]' and 'A\[1\]' disagree on x1 = 0.05: b jumps by 0.1"),
    ],
)
def test_plants_outside_the_theory_are_refused_by_argument(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(OutsideTheory, match=said):
        plant(**STOP | changes)


WRONG_PROBLEMS: dict[str, tuple[dict[str, Any], str]] = {
    "a reference": ({"reference": {"output": "sin(2t)"}}, r"reference\['output'\].*write 2\*t"),
    "a formula": ({"reference": "sin(t"}, r"reference\['output'\].*'sin\(t' is not a number or an expression"),
    "an amplitude": (
        {"reference": {"output": {"sine": {"frequency": 1}}}},
        r"reference\['output'\]\['sine'\]\['amplitude'\] is missing",
    ),
    "a duration": ({"simulation": {"sample_time": 1}}, r"simulation\['duration'\] is missing"),
    "a start": (
        {"simulation": {"duration": 1, "sample_time": 0.1, "initial": {"plant": [1]}}},
        r"simulation\['initial'\]\['plant'\]: 1 entry, expected 2",
    ),
    "a rate": ({"controller": {"rate": -1}}, r"controller\['rate'\]: -1 is not positive"),
    "a gain": ({"controller": {"K": np.ones((1, 3))}}, r"controller\['K'\]\[0\]: 3 entries, expected 2"),
    "another": ({"observer": {"L": np.ones((1, 1))}}, r"observer\['L'\]: 1 row, expected 2"),
    "a weight": (
        {"controller": {"cost": {"Q": -np.eye(2), "R": [[1]]}}},
        r"controller\['cost'\]\['Q'\] is not positive semidefinite",
    ),
    "a key": ({"controller": {"rat": 1}}, r"controller\['rat'\]: unknown key; did you mean 'rate'"),
    "a load": ({"estimate": {"f": {"into": {"q": 1}}}}, r"estimate\['f'\]\['into'\]\['q'\]: load 'f': 'q' is no state"),
    "a box": ({"uncertain": {"m": "5%"}}, r"uncertain\['m'\]"),
    "a solver": ({"solver": "mosek"}, "solver: 'mosek' is not"),
    "tracking": ({"tracking": "state"}, "reference: state tracking needs a reference that is state or input"),
    "a requirement": ({"require": {"overshot": 1}}, r"require\['overshot'\].*did you mean 'overshoot'"),
    "a name": ({"name": "a\nb"}, "name: a line end is in it"),
    "no plant": ({"plant": STOP}, "plant: a dict is none"),
}


@pytest.mark.parametrize("case", WRONG_PROBLEMS)
def test_what_is_wrong_with_a_problem_is_said_by_argument(case: str) -> None:
    changes, said = WRONG_PROBLEMS[case]
    with pytest.raises(InvalidSpec, match=f"(?m)^{said}"):
        problem(**{"plant": plant(**STOP)} | ASKED | changes)


def test_everything_that_a_file_has_can_be_given() -> None:
    """Each section and each entry of `system` and `design` is an argument, or made from some."""
    from inspect import signature

    from pwatrack.spec.design_section import DesignSection
    from pwatrack.spec.plant_section import SystemSection
    from pwatrack.spec.schema import SpecFile

    of_plant, of_problem = signature(plant).parameters, signature(problem).parameters
    assert {*SystemSection.model_fields} - {*of_plant} == {"hyperplanes"}  # H, h
    assert {*DesignSection.model_fields} <= {*of_problem}
    of_commands = {"expect", "sweep"}  # of batch and sweep, which take files
    assert {*SpecFile.model_fields} - {*of_problem} - of_commands == {"system", "design", "parameters", "tolerance"}


def paper_arrays() -> dict[str, Any]:
    """Return the plant of Section V in numbers, but for where its cells are."""
    k1, d1, d2 = 1.0, 0.2, 0.1

    def matrix(k: float) -> list[list[float]]:
        return [[0, 1, 0, 0], [-k, -d2, k, d2], [0, 0, 0, 1], [k, d2, -(k + k1), -round(d1 + d2, 12)]]

    return {
        "A": np.array([matrix(0.4), matrix(0.0), matrix(0.4)]),
        "b": np.array([[0, -0.02, 0, 0.02], [0, 0, 0, 0], [0, 0.04, 0, -0.04]]),
        "B": np.array([[0.0], [1], [0], [0]]),
        "C": np.array([[1.0, 0, 0, 0]]),
        "states": ["z1", "v1", "z2", "v2"],
        "cells": ["upper spring", "gap", "lower spring"],
        "units": {"z1": "m", "v1": "m/s", "z2": "m", "v2": "m/s", "u": "N", "y": "m"},
    }


WAYS: dict[str, dict[str, Any]] = {
    "inequalities": {"where": ["z2 - z1 >= 0.05", "-0.1 <= z2 - z1 <= 0.05", "z2 - z1 <= -0.1"]},
    "signs": {
        "H": np.array([[-1, 0, 1, 0], [-1, 0, 1, 0]]),
        "h": np.array([-0.05, 0.1]),
        "signs": np.array([[1, 1], [-1, 1], [-1, -1]]),
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_the_example_of_the_paper_from_arrays_is_the_very_design_of_its_file(way: str) -> None:
    simulation = {"duration": 60, "sample_time": 0.01, "initial": {"plant": [0.25, 0, 0, 0], "generator": [0.2, 0]}}
    reference = {"output": {"sine": {"amplitude": 0.15, "frequency": "2*pi"}}}
    spec = problem(plant(**paper_arrays(), **WAYS[way]), reference=reference, simulation=simulation)
    wanted, made = design(load_spec(SPECS / "two_mass_backlash.yaml")), design(spec)
    assert made.K.tobytes() == wanted.K.tobytes()
    assert made.L.tobytes() == wanted.L.tobytes()
    same = made.certificate | {"spec_sha256": wanted.certificate["spec_sha256"]}
    if way == "inequalities":
        assert same == wanted.certificate
    proved = [proof for proof in wanted.certificate["proofs"] if proof["of"] != "generator"]
    assert [proof for proof in same["proofs"] if proof["of"] != "generator"] == proved
    assert np.array_equal(simulate(made).e, simulate(wanted).e)


@pytest.fixture(scope="module")
def run() -> Result:
    return simulate(problem(plant(**STOP), **ASKED, controller={"rate": 0.5}))


def test_the_results_are_those_of_the_trace(run: Result, tmp_path: Path) -> None:
    response = run.response
    for name in ("t", "x", "x_hat", "x_d", "y", "y_d", "u", "u_ff"):
        assert np.array_equal(getattr(run, name), getattr(response, name))
    assert np.array_equal(run.e, run.y - run.y_d)
    with (run.save(tmp_path / "run") / "trace.csv").open(encoding="utf-8") as file:
        header = file.readline().strip().split(",")
        rows = np.loadtxt(file, delimiter=",")
    for name, values in run.signals.items():
        assert np.array_equal(rows[:, header.index(name)], values)
    assert not [*(tmp_path / "run").glob("*.png")]


def test_a_saved_run_is_verified_against_its_own_description(run: Result, tmp_path: Path) -> None:
    folder = run.save(tmp_path / "run")
    assert any("from_python.yaml: same plant, gains and goals" in sentence for sentence in verify(folder))
    assert (folder / "from_python.yaml").read_text(encoding="utf-8") == run.spec.text
    index = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    (folder / "from_python.yaml").write_text(
        str(run.spec.text).replace("[[0, 1], [-1, -1]]", "[[0, 1], [-1.0, -1]]"), encoding="utf-8"
    )
    with pytest.raises(CheckFailed, match="has other bytes"):
        verify(folder)
    assert index["spec_sha256"] == run.spec.sha256
    assert run.controller.save(tmp_path / "design") == tmp_path / "design"


def test_pictures_are_drawn_where_they_are_asked_for(run: Result) -> None:
    assert {"tracking_error", "outputs", "input"} <= {*run.plot()}
    assert ensemble(run, 2).plot().axes


def test_the_table_of_an_ensemble_has_what_was_drawn_and_measured(run: Result, tmp_path: Path) -> None:
    many = ensemble(run, 3, seed=2)
    assert many.e.shape == (3, len(many.t))
    assert many.table["largest_error"] == pytest.approx(many.e.max(axis=1), rel=1e-2)  # between samples it is larger
    assert (many.table["largest_error"] >= many.e.max(axis=1)).all()
    assert {"x1", "x2", "final_error", "largest_input_u"} <= {*many.table}
    rows = np.genfromtxt(many.save(tmp_path / "many") / "ensemble.csv", delimiter=",", names=True, dtype=None)
    assert np.array_equal(rows["x1"], many.table["x1"])


def test_a_design_runs_in_another_scenario(run: Result) -> None:
    longer = problem(plant(**STOP), reference="0.1*sin(t)", simulation={"duration": 20, "sample_time": 0.1})
    other = simulate(longer, run.controller)
    assert other.spec is longer
    assert len(other.t) == 201
    assert np.array_equal(other.x[:101], run.x)


def test_a_design_for_another_plant_is_refused(run: Result) -> None:
    stiffer = plant(**STOP | {"A": [[[0, 1], [-1, -1]], [[0, 1], [-5, -1]]], "b": [[0, 0], [0, 0.2]]})
    with pytest.raises(InvalidSpec, match="the design is for another plant"):
        simulate(problem(stiffer, **ASKED), run.controller)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda made: design(made), "design: a value of type Plant"),
        (lambda made: simulate(made), "simulate: a value of type Plant"),
        (lambda made: ensemble(made, 3), "ensemble: a value of type Plant"),
        (lambda made: load_spec(made), "load_spec: a value of type Plant"),
    ],
)
def test_what_a_function_does_not_take_is_said(call: Callable[[Any], Any], said: str) -> None:
    with pytest.raises(InvalidSpec, match=said):
        call(plant(**STOP))


def test_the_program_of_a_design_is_that_of_its_run() -> None:
    sampled = {"duration": 5, "sample_time": 0.01, "controller": {"sample_time": 0.01}}
    made = design(problem(plant(**STOP), reference="0.1*sin(t)", simulation=sampled))
    program, run = made.controller, simulate(made)
    assert np.array_equal([program.step(y) for y in run.y], run.u)
    assert (made.K.tolist(), made.L.tolist()) == (program.file.K, program.file.L)
    assert np.abs(program.K / made.K - 1).max() < 0.1  # what K does over a sample
    with pytest.raises(InvalidSpec, match="has no sample time"):
        _ = design(problem(plant(**STOP), **ASKED)).controller


@pytest.mark.slow
def test_problems_designs_and_runs_can_be_pickled_and_are_the_same_elsewhere(tmp_path: Path) -> None:
    asked = problem(plant(**STOP), reference="0.1*sin(t)", simulation={"duration": 5, "sample_time": 0.01})
    run = simulate(asked)
    spec, made, again = pickle.loads(pickle.dumps((asked, design(asked), run)))
    assert not differences(spec, asked)
    assert not differences(again.spec, asked)
    assert np.array_equal(simulate(made).e, run.e)
    assert np.array_equal(again.e, run.e)
    (tmp_path / "design").write_bytes(pickle.dumps(made))
    program = f"import pickle; print(pickle.load(open({str(tmp_path / 'design')!r}, 'rb')).K.tolist())"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert json.loads(found.stdout) == run.controller.K.tolist()


def test_a_long_run_takes_its_samples_along_when_it_is_pickled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pwatrack.workflow.pipeline.MOST_KEPT", 100)
    asked = problem(plant(**STOP), reference="0.1*sin(t)", simulation={"duration": 5, "sample_time": 0.01})
    run = simulate(asked)
    again = pickle.loads(pickle.dumps(run))
    assert len(run.e) < 501
    whole = [np.concatenate([block.tracking_error for block in one.blocks()]) for one in (run, again)]
    assert len(whole[0]) == 501
    assert np.array_equal(whole[0], whole[1])


def test_what_is_refused_in_a_design_is_said_by_argument() -> None:
    with pytest.raises(Infeasible, match=r"(?m)^controller\['K'\]: \(8\) for the given gain K is infeasible") as raised:
        design(problem(plant(**STOP), **ASKED, controller={"K": np.array([[5, 0]])}))
    assert raised.value.code.verdict == "infeasible"


def test_there_are_at_most_16_public_names_each_with_an_example() -> None:
    assert len(pwatrack.__all__) <= 16
    for name in pwatrack.__all__:
        public = getattr(pwatrack, name)
        assert doctest.DocTestFinder(recurse=False).find(public, name)[0].examples, name
        assert public.__doc__


def test_importing_is_light_and_arrays_load_no_solver_and_no_picture() -> None:
    program = """
import sys, pwatrack
assert "numpy" not in sys.modules
pwatrack.plant(A=[[-1]], B=[[1]], C=[[1]])
pwatrack.simulate
print([name for name in ("matplotlib", "picos", "numba", "control", "pyarrow", "distributed") if name in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_a_run_loads_only_what_it_computes_with(specs: Path, tmp_path: Path) -> None:
    """Each of these takes from 0.1 s to 0.4 s to import; the run of the paper's example took 1.0 s without them."""
    names = "matplotlib", "picos", "pint", "pandas", "scipy.signal", "scipy.stats", "scipy.optimize", "scipy.io"
    program = f"""
import sys
from pwatrack.cli import app
try:
    app(["simulate", {str(specs / "two_mass_backlash.yaml")!r}, "--plots", "none", "--out", {str(tmp_path / "out")!r}])
except SystemExit as end:
    assert not end.code
print([name for name in {names} if name in sys.modules], file=sys.stderr)
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stderr.strip().splitlines()[-1] == "[]"
