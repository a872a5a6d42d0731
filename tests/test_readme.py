"""What the README shows is true."""

import re
import textwrap
from pathlib import Path

import pytest

from pwatrack import load_spec, simulate
from tests.test_cli import call

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def test_the_spec_in_the_readme_is_a_whole_one_and_tracks(tmp_path: Path) -> None:
    block = re.search(r"(?m)^    name: Cart with a stop\n(?:    .*\n)+", README)
    assert block is not None
    (tmp_path / "cart.yaml").write_text(textwrap.dedent(block.group()))
    result = simulate(load_spec(tmp_path / "cart.yaml"))
    assert result.final_error < 1e-9
    assert result.spec.problem.plant.cell_names == ("stop off", "stop on")


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 150


@pytest.mark.slow
def test_the_summary_in_the_readme_is_how_what_is_printed_begins(tmp_path: Path) -> None:
    """All but the digits, which differ between machines."""

    def words(text: str) -> list[str]:
        return re.sub(r"-?\d[\d.]*(e[-+]\d+)?", "#", text).split()

    shown = re.search(r"(?m)^    Two masses with backlash: .*\n(?:    .*\n)+", README)
    printed = call("simulate", "specs/two_mass_backlash.yaml", "--out", tmp_path / "run").stdout
    assert shown is not None
    beginning = words(shown.group())
    assert len(beginning) > 40
    assert beginning == words(printed)[: len(beginning)]


def test_every_yaml_in_the_description_of_the_format_is_of_the_format() -> None:
    """Each key shown in docs/reference/spec_file.md is a key of the schema."""
    from pwatrack.spec.schema import known_keys

    text = (Path(__file__).parents[1] / "docs" / "reference" / "spec_file.md").read_text(encoding="utf-8")
    shown = {
        key for block in re.findall(r"```yaml\n(.*?)```", text, re.S) for key in re.findall(r"(?m)^ *(\w+):", block)
    }
    assert shown <= set(known_keys())
    assert len(shown) > 20
