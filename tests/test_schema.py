"""The JSON Schema of a spec is what the reader reads, and the starters run."""

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator
from typer.testing import CliRunner

from pwatrack.cli import app
from pwatrack.errors import PwatrackError
from pwatrack.spec.load import load_spec
from pwatrack.spec.schema import json_schema, schema_text

ROOT = Path(__file__).parents[1]
SHIPPED = sorted((ROOT / "specs").rglob("*.yaml"))
STARTERS = sorted((ROOT / "pwatrack" / "starters").glob("*.yaml"))


@cache
def validator() -> Draft202012Validator:
    schema = json_schema()
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def fits(value: Any) -> bool:
    """Whether a value keeps to the schema."""
    return bool(validator().is_valid(value))


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_the_schema_in_docs_is_current() -> None:
    message = "pwatrack schema --out docs/spec.schema.json"
    assert (ROOT / "docs" / "spec.schema.json").read_text(encoding="utf-8") == schema_text(), message


@pytest.mark.slow
@pytest.mark.parametrize("path", SHIPPED + STARTERS, ids=lambda path: path.stem)
def test_every_shipped_spec_names_the_schema_and_keeps_to_it(path: Path) -> None:
    found = re.match(r"# yaml-language-server: \$schema=(\S+)\n", path.read_text(encoding="utf-8"))
    assert found
    target = path.parent / found[1]
    assert target.resolve() == ROOT / "docs" / "spec.schema.json" or found[1] == "pwatrack.schema.json"
    if path.stem != "many_errors":
        assert fits(read(path))


WRONG: dict[str, Any] = {
    "unknown key": lambda spec: spec.update(sytem=1),
    "unknown key below": lambda spec: spec["simulation"].update(sample_tim=1),
    "missing": lambda spec: spec.pop("reference"),
    "missing below": lambda spec: spec["system"].pop("B"),
    "list for text": lambda spec: spec.update(name=["x"]),
    "number for a list": lambda spec: spec["system"].update(B=1),
    "row for a matrix": lambda spec: spec["system"].update(B=[0, 1]),
    "word": lambda spec: spec.update(design={"tracking": "outputs"}),
    "kind": lambda spec: spec["system"].update(
        nonlinearities=[{"name": "s", "kind": "springs", "of": "z", "into": {"v": 1}}]
    ),
    "entry of a kind": lambda spec: spec["system"].update(
        nonlinearities=[{"name": "s", "kind": "spring", "of": "z", "lower": 1, "into": {"v": 1}}]
    ),
    "figure": lambda spec: spec.update(require={"norm_M": 1}),
    "exit": lambda spec: spec.update(expect={"exit": 7}),
    "sine": lambda spec: spec.update(reference={"output": {"sine": {"amplitude": 1}}}),
    "filter": lambda spec: spec.update(reference={"output": {"table": {"file": "x", "filter": 3}}}),
    "null": lambda spec: spec["system"].update(A=None),
    "negative duration": lambda spec: spec["simulation"].update(duration=-1),
    "no duration": lambda spec: spec["simulation"].update(duration=0),
    "negative sample time": lambda spec: spec["simulation"].update(sample_time=-0.01),
    "negative sample time of the controller": lambda spec: spec["simulation"].update(controller={"sample_time": -1e-3}),
    "negative noise": lambda spec: spec["simulation"].update(noise={"std": {"y": -1}, "sample_time": 0.1}),
    "negative seed": lambda spec: spec["simulation"].update(noise={"std": {"y": 1}, "sample_time": 0.1, "seed": -1}),
    "late by too much": lambda spec: spec["simulation"].update(controller={"sample_time": 0.1, "delay": 11}),
    "quantum of no controller": lambda spec: spec["simulation"].update(quantum={"y": 1e-3}),
    "reversed limits": lambda spec: spec["simulation"].update(actuator={"limits": {"u": [5, -5]}}),
    "equal limits": lambda spec: spec["simulation"].update(actuator={"limits": {"u": [0, 0]}}),
    "reversed interval": lambda spec: spec["simulation"].update(ensemble={"initial": {"plant": {"z": [0, -1]}}}),
    "interval of one": lambda spec: spec["simulation"].update(ensemble={"initial": {"plant": {"z": [1]}}}),
    "reversed sweep": lambda spec: spec.update(sweep={"k": {"from": 1, "to": -1}}),
    "sweep of a point": lambda spec: spec.update(sweep={"k": {"from": 1, "to": 2, "points": 1}}),
    "reversed stops": lambda spec: spec["system"].update(
        nonlinearities=[{"name": "s", "kind": "stop", "of": "z", "lower": 0.1, "upper": -0.1, "into": {"v": -1}}]
    ),
    "both references": lambda spec: spec["reference"].update(setpoint={"y": 1}),
    "no reference": lambda spec: spec.update(reference={}),
    "reference of states": lambda spec: spec.update(reference={"state": [0, 0]}),
    "reference of outputs": lambda spec: spec.update(design={"tracking": "state"}),
    "input without a start": lambda spec: spec.update(design={"tracking": "state"}, reference={"input": [0]}),
    "signal of nothing": lambda spec: spec.update(reference={"output": {}}),
    "point of three": lambda spec: spec.update(reference={"output": {"polyline": {"points": [[0, 0, 0]]}}}),
    "negative frequency": lambda spec: spec.update(reference={"output": {"sine": {"amplitude": 1, "frequency": -1}}}),
    "negative size": lambda spec: spec["system"].update(sizes={"y": -1}),
    "name with a space": lambda spec: spec["system"].update(outputs=["y 1"]),
    "name twice": lambda spec: spec["system"].update(inputs=["u", "u"], B=[[0, 0], [1, 1]]),
    "two ways to write a plant": lambda spec: spec["system"].update(cells=[{"name": "all", "A": [[0, 1], [0, 0]]}]),
    "no plant": lambda spec: [spec["system"].pop(name, None) for name in ("A", "b", "nonlinearities", "cells")],
    "negative rate": lambda spec: spec.update(design={"controller": {"rate": -1}}),
    "coarse": lambda spec: spec.update(tolerance={"continuity": 0.1}),
    "reversed box": lambda spec: spec.update(design={"uncertain": {"k": [1, -1]}}),
    "negative requirement": lambda spec: spec.update(require={"final_error": -1}),
    "requirement of no signal": lambda spec: spec.update(require={"largest_input": {}}),
}


@pytest.mark.slow
@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG)
def test_what_the_schema_refuses_the_reader_refuses(change: Any, tmp_path: Path) -> None:
    spec = read(STARTERS[0].with_name("output.yaml"))
    assert fits(spec)
    change(spec)
    assert not fits(spec)
    (tmp_path / "wrong.yaml").write_text(json.dumps(spec), encoding="utf-8")
    with pytest.raises(PwatrackError):
        load_spec(tmp_path / "wrong.yaml")


def test_expressions_stand_where_numbers_with_a_rule_do(tmp_path: Path) -> None:
    spec = read(STARTERS[0].with_name("output.yaml"))
    spec["simulation"] |= {"duration": "2*5", "sample_time": "1/100", "controller": {"sample_time": "1e-2", "delay": 1}}
    spec["simulation"] |= {"actuator": {"limits": {spec["system"]["inputs"][0]: ["-1e3", "1e3"]}}}
    (tmp_path / "spec.yaml").write_text(json.dumps(spec), encoding="utf-8")
    assert load_spec(tmp_path / "spec.yaml")
    assert fits(spec)


FORMS: list[Any] = [
    {"output": 0.1},
    {"output": "0.1*sin(t)"},
    {"output": {"sine": {"amplitude": 1, "frequency": "2*pi"}}},
    {"output": {"sine": [{"amplitude": 1, "frequency": 2}], "step": [{"size": 1, "at": 1, "smooth": 1}]}},
    {"output": {"trapezoid": {"high": 1, "rise": 1, "fall": 1, "hold": 1, "smooth": 0.5}, "constant": "gap"}},
]


@pytest.mark.slow
@pytest.mark.parametrize("reference", FORMS)
def test_every_form_of_a_reference_is_in_the_schema(reference: Any, tmp_path: Path) -> None:
    spec = read(STARTERS[0].with_name("output.yaml")) | {"reference": reference}
    (tmp_path / "spec.yaml").write_text(json.dumps(spec), encoding="utf-8")
    assert load_spec(tmp_path / "spec.yaml")
    assert fits(spec)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [path.stem for path in STARTERS])
def test_a_starter_runs_in_an_empty_folder(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    call = CliRunner().invoke
    run = call(app, ["init", "--from", kind])
    assert run.exit_code == 0, run.output
    assert {path.name for path in tmp_path.iterdir()} == {"spec.yaml", "pwatrack.schema.json"}
    run = call(app, ["simulate", "spec.yaml", "--plots", "none"])
    assert run.exit_code == 0, run.output
    assert call(app, ["schema"]).stdout == (tmp_path / "pwatrack.schema.json").read_text(encoding="utf-8")


def test_init_replaces_no_spec(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("mine")
    run = CliRunner().invoke(app, ["init", str(tmp_path / "mine.yaml")])
    assert run.exit_code == 2
    assert "exists" in run.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]
    assert (tmp_path / "mine.yaml").read_text() == "mine"
