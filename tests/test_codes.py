"""Every error has a code, and every code is explained and in use."""

import ast
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pwatrack.cli import app
from pwatrack.errors import ExitCode, InvalidSpec
from pwatrack.report.codes import CODES, code_of, explanation

HOUSE = Path(__file__).parents[1] / "pwatrack"
USED = {
    "many_errors": {"P203", "P204", "P205", "P202"},
    "printed_A1": {"P303"},
    "hole_between_cells": {"P301"},
    "printed_gains": {"P401"},
}


def literals() -> str:
    """Return all texts of the program, without the codes themselves; figures are an X."""
    found = []
    for module in HOUSE.rglob("*.py"):
        if module.name != "codes.py":
            for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr):
                    found.append("".join(str(v.value) if isinstance(v, ast.Constant) else "X" for v in node.values))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found.append(node.value)
    return "\n".join(found)


def test_codes_are_different_and_their_kinds_occur_in_messages() -> None:
    assert len({kind.code for kind in CODES}) == len(CODES)
    texts = literals()
    unused = [k.code for k in CODES if not re.search(k.like.replace("^", "(?m:^)"), texts) and k.like[:3] != r"^\("]
    assert not unused


@pytest.mark.parametrize("kind", CODES, ids=lambda kind: kind.code)
def test_every_code_is_explained(kind: object) -> None:
    code = kind.code  # type: ignore[attr-defined]
    run = CliRunner().invoke(app, ["explain", code.lower()])
    assert run.exit_code == 0
    assert run.stdout.startswith(f"{code}: ")
    assert len(run.stdout.splitlines()) >= 3


@pytest.mark.parametrize("number", [code for code in ExitCode if code is not ExitCode.DONE])
def test_what_has_no_code_of_its_own_has_that_of_its_exit_code(number: ExitCode) -> None:
    assert explanation(code_of("nobody has said this", number)).startswith(f"P{int(number)}00: ")


def test_names_of_the_file_choose_no_code() -> None:
    said = "not of form (11): row C A^1 differs between cells 'overlap inside' and 'overlap below'"
    assert code_of(said, ExitCode.OUTSIDE_THEORY) == "P304"


@pytest.mark.parametrize("code", ["P999", "", "303", "P30"])
def test_other_codes_are_refused(code: str) -> None:
    with pytest.raises(InvalidSpec, match="is no code"):
        explanation(code)


@pytest.mark.parametrize("name", USED)
def test_refusals_end_with_their_code(name: str, specs: Path) -> None:
    run = CliRunner().invoke(app, ["check", str(specs / "refused" / f"{name}.yaml")])
    errors = [line for line in run.stderr.splitlines() if line.startswith("error: ")]
    codes = [re.search(r" \[(P\d00|P\d\d\d)\]$", line) for line in errors]
    assert all(codes)
    assert USED[name] <= {found[1] for found in codes if found}
