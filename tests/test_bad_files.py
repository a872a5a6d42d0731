"""All that the tests of the reader refuse, as files: `check` says why, with code and line, and writes nothing."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pwatrack.cli import app
from tests import test_bad_input, test_courses, test_expression, test_spec, test_yaml_tree

FILE = "plant.yaml"
_PLACE = "m: 2"  # of a number in the spec of `test_bad_input`
_WHERE = 'where: ["z <= gap"]'  # of an inequality in that of `test_spec`


@dataclass(frozen=True, kw_only=True)
class BadInput:
    """A file that is refused.

    Attributes:
        about: What is wrong with it.
        content: What it holds.
        line: Where that is, from 1; where any line will do, none.
        beside: Files that lie beside it, by name.
    """

    about: str
    content: bytes
    line: int | None
    beside: tuple[tuple[str, bytes], ...] = ()

    def written(self, folder: Path) -> Path:
        """Write it into a folder and return its path."""
        for name, content in (*self.beside, (FILE, self.content)):
            (folder / name).write_bytes(content)
        return folder / FILE


def bad_inputs() -> Iterator[BadInput]:
    """Yield all of them."""
    for old, new, line, words in test_bad_input.INVALID:
        yield _replaced(words, test_bad_input.SPEC, old, new, line)
    for text in (*test_expression.NO_NUMBER, *test_expression.NO_ARITHMETIC, *test_expression.NOT_FINITE):
        yield _replaced(f"number {text}", test_bad_input.SPEC, _PLACE, f"m: {json.dumps(text)}")
    for text in test_expression.NO_INEQUALITY:
        yield _replaced(f"inequality {text}", test_spec.SPEC, _WHERE, f"where: [{json.dumps(text)}]")
    for old, new, *_ in test_spec.WRONG_SHAPE:
        yield _replaced(f"shape {new}", test_spec.SPEC, old, new)
    for old, new in test_spec.WRONG_KIND:
        yield _replaced(f"kind {new}", test_spec.SPEC, old, new)
    for file, words in test_spec.NO_SPEC:
        yield BadInput(about=words, content=file, line=None)
    for text, place in (*test_yaml_tree.TAGGED, *test_yaml_tree.BROKEN):
        yield BadInput(about=f"YAML {text}", content=text.encode(), line=int(place.split(":")[0]))
    for text, line in test_yaml_tree.DEEP:
        yield BadInput(about="YAML that is deep", content=text.encode(), line=line)
    for course, words in test_courses.NO_COURSE:
        yield _course(words, course, b"")
    for content, words in test_courses.NO_TABLE:
        yield _course(words, "{table: {file: wanted.csv}}", content.encode("latin-1"))
    table = test_courses.rows(test_courses.T, test_courses.T).encode()
    for options, words in test_courses.NO_OPTION:
        yield _course(words, f"{{table: {{file: wanted.csv, {options}}}}}", table)
    for name in ("/etc/passwd", "../wanted.csv", "none.csv", ".", '"a\\0b"'):
        yield _course(f"table {name}", f"{{table: {{file: {name}}}}}", table)


def _replaced(about: str, text: str, old: str, new: str, line: int | None = None) -> BadInput:
    assert text.count(old) == 1, old
    if line is None:
        line = text[: text.index(old) + len(old)].count("\n") + 1  # what is wrong with a section stands at its entries
    return BadInput(about=about, content=text.replace(old, new).encode(), line=line)


def _course(about: str, course: str, table: bytes) -> BadInput:
    content = (test_courses.SPEC % (course, 4)).encode()
    return BadInput(about=about, content=content, line=4, beside=(("wanted.csv", table),))


def test_there_are_many() -> None:
    assert len({(bad.content, bad.beside) for bad in bad_inputs()}) >= 200


@pytest.mark.slow
@pytest.mark.parametrize("bad", list(bad_inputs()), ids=lambda bad: ascii(bad.about)[1:50])
def test_a_bad_file_is_refused_with_code_and_line_and_nothing_is_written(tmp_path: Path, bad: BadInput) -> None:
    path = bad.written(tmp_path)
    there = sorted(tmp_path.iterdir())
    run = CliRunner().invoke(app, ["check", str(path)])
    assert run.exit_code == 2, run.output
    errors = re.findall(r"^error: (?!… and )(.*)$", run.stderr, re.MULTILINE)
    assert all(re.search(r" \[P2\d\d\]$", error) for error in errors), run.stderr
    lines = {int(line) for line in re.findall(rf"^error: {re.escape(str(path))}:(\d+):\d+: ", run.stderr, re.MULTILINE)}
    assert bad.line in lines if bad.line is not None else lines, run.stderr
    assert "Traceback" not in run.output
    assert sorted(tmp_path.iterdir()) == there
