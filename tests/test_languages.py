"""Languages that controllers are exported in: one tick, stated once in the kernel, and one list of who prints it."""

import inspect

import pytest
from typer.testing import CliRunner

from pwatrack.cli import app
from pwatrack.export.notation import LANGUAGES, printed
from pwatrack.export.structured_text import ST


@pytest.mark.parametrize("name", LANGUAGES)
def test_every_language_is_a_command_and_a_module_that_writes(name: str) -> None:
    language = LANGUAGES[name]
    assert [*inspect.signature(language.write).parameters] == ["source", "vector", "out"]
    said = CliRunner().invoke(app, ["export", name, "--help"], env={"COLUMNS": "200", "TERM": "dumb"})
    assert said.exit_code == 0
    assert language.help in " ".join(said.output.split())
    options = said.output.partition("Example")[0]
    assert ["float64", *(kind for kind in ("float32", "int32") if f"--{kind}" in options)] == [*language.numbers]


def test_a_statement_that_no_language_has_is_refused() -> None:
    for text in ("while True:\n    u = 0.0", "u = [k for k in v]", "u = f(v)"):
        with pytest.raises(ValueError, match="not a part of the notation"):
            printed(text, ST)
