"""The JSON Schema of a spec is what the reader reads, and the starters run."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from pwatrack.cli import app
from pwatrack.errors import PwatrackError
from pwatrack.spec.json_schema import json_schema, schema_text
from pwatrack.spec.load import load_spec

ROOT = Path(__file__).parents[1]
SHIPPED = sorted((ROOT / "specs").rglob("*.yaml"))
STARTERS = sorted((ROOT / "pwatrack" / "starters").glob("*.yaml"))
TYPES: dict[str, type | tuple[type, ...]] = {
    "string": str,
    "number": (int, float),
    "integer": int,
    "object": dict,
    "array": list,
}
KNOWN = {"$defs", "$schema", "title", "description", "default", "discriminator"}


def fits(value: Any, schema: dict[str, Any], whole: dict[str, Any]) -> bool:
    """Whether a value keeps to a schema: as much of JSON Schema as ours uses."""
    for rule, limit in schema.items():
        if rule == "$ref":
            ok = fits(value, whole["$defs"][limit.rpartition("/")[2]], whole)
        elif rule == "type":
            names = limit if isinstance(limit, list) else [limit]
            ok = any(isinstance(value, TYPES[name]) for name in names) and not isinstance(value, bool)
        elif rule == "anyOf":
            ok = any(fits(value, choice, whole) for choice in limit)
        elif rule == "oneOf":
            ok = sum(fits(value, choice, whole) for choice in limit) == 1
        elif rule in ("const", "enum"):
            ok = value in (limit if rule == "enum" else [limit])
        elif rule == "required":
            ok = not isinstance(value, dict) or set(limit) <= set(value)
        elif rule == "properties":
            ok = not isinstance(value, dict) or all(fits(value[k], limit[k], whole) for k in limit if k in value)
        elif rule == "additionalProperties":
            others = set(value) - set(schema.get("properties", ())) if isinstance(value, dict) else set()
            ok = not others if limit is False else all(fits(value[k], limit, whole) for k in others)
        elif rule == "items":
            ok = not isinstance(value, list) or all(fits(entry, limit, whole) for entry in value)
        elif rule in ("minItems", "minProperties"):
            ok = not isinstance(value, list | dict) or len(value) >= limit
        elif rule == "maxItems":
            ok = not isinstance(value, list) or len(value) <= limit
        elif rule in ("minimum", "maximum"):
            ok = not isinstance(value, int) or (value >= limit if rule == "minimum" else value <= limit)
        else:
            assert rule in KNOWN, rule
            ok = True
        if not ok:
            return False
    return True


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_the_schema_in_docs_is_current() -> None:
    message = "pwatrack schema --out docs/spec.schema.json"
    assert (ROOT / "docs" / "spec.schema.json").read_text(encoding="utf-8") == schema_text(), message


@pytest.mark.parametrize("path", SHIPPED + STARTERS, ids=lambda path: path.stem)
def test_every_shipped_spec_names_the_schema_and_keeps_to_it(path: Path) -> None:
    found = re.match(r"# yaml-language-server: \$schema=(\S+)\n", path.read_text(encoding="utf-8"))
    assert found
    target = path.parent / found[1]
    assert target.resolve() == ROOT / "docs" / "spec.schema.json" or found[1] == "pwatrack.schema.json"
    if path.stem != "many_errors":
        assert fits(read(path), json_schema(), json_schema())


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
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG)
def test_what_the_schema_refuses_the_reader_refuses(change: Any, tmp_path: Path) -> None:
    spec = read(STARTERS[0].with_name("output.yaml"))
    assert fits(spec, json_schema(), json_schema())
    change(spec)
    assert not fits(spec, json_schema(), json_schema())
    (tmp_path / "wrong.yaml").write_text(json.dumps(spec), encoding="utf-8")
    with pytest.raises(PwatrackError):
        load_spec(tmp_path / "wrong.yaml")


FORMS: list[Any] = [
    {"output": 0.1},
    {"output": "0.1*sin(t)"},
    {"output": {"sine": {"amplitude": 1, "frequency": "2*pi"}}},
    {"output": {"sine": [{"amplitude": 1, "frequency": 2}], "step": [{"size": 1, "at": 1, "smooth": 1}]}},
    {"output": {"trapezoid": {"high": 1, "rise": 1, "fall": 1, "hold": 1, "smooth": 0.5}, "constant": "gap"}},
]


@pytest.mark.parametrize("reference", FORMS)
def test_every_form_of_a_reference_is_in_the_schema(reference: Any, tmp_path: Path) -> None:
    spec = read(STARTERS[0].with_name("output.yaml")) | {"reference": reference}
    (tmp_path / "spec.yaml").write_text(json.dumps(spec), encoding="utf-8")
    assert load_spec(tmp_path / "spec.yaml")
    assert fits(spec, json_schema(), json_schema())


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
