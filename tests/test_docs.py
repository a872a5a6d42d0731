"""The documentation is complete, its links lead somewhere, and what it shows runs. Only one test here needs Sphinx."""

import ast
import doctest
import re
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from shutil import which

import pytest
from typer.testing import CliRunner

import pwatrack
from docs.ext import cells, gallery, reference
from pwatrack.cli import app
from pwatrack.report import run_folder
from pwatrack.report.codes import CODES, explanation
from pwatrack.spec.requirement import QUANTITIES
from pwatrack.spec.schema import known_keys
from tests.conftest import SPECS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if not {"_build", "generated"} & set(path.parts))
OF_THE_PAPER = {"1", "3", *map(str, range(7, 24))}  # (2), (4), (5) and (6) are said in words


def text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@cache
def made(name: str) -> str:
    return {**reference.GENERATED, **gallery.GENERATED}[name]()


@cache
def equations() -> list[cells.Carried]:
    found = (block for path in PAGES for block in cells.blocks(text(path)) if block.kind == "equation")
    return [cells.carried(block) for block in found]


def test_every_page_is_in_the_table_of_contents() -> None:
    listed = {DOCS / "index.md"}
    for path in PAGES:
        for tree in re.findall(r"```\{toctree\}\n(.*?)```", text(path), re.DOTALL):
            names = [name for name in tree.split("\n") if name and name[0] != ":"]
            listed |= {other.resolve() for name in names for other in path.parent.glob(f"{name}.md")}
    assert listed == set(PAGES)


@pytest.mark.parametrize("path", [*PAGES, ROOT / "README.md"], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(path: Path) -> None:
    bare = re.sub(r"(?s)```.*?```|`[^`\n]*`", "", text(path))
    for target in re.findall(r"\]\(([^)\s]+)\)", bare):
        if re.match(r"https?:", target):
            continue
        name, _, anchor = target.partition("#")
        other = path.parent / name if name else path
        assert other.exists(), f"{path.name}: {target}"
        if anchor:
            titles = re.findall(r"(?m)^#+ (.*)$", text(other))
            slugs = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
            assert anchor in slugs, f"{path.name}: {target}"


def test_every_key_of_a_spec_is_in_the_reference() -> None:
    shown = set(re.findall(r"(?m)^\| `(\w+)` \|", made("spec_keys")))
    assert set(known_keys()) <= shown
    assert len(shown) > 90
    words = set(re.findall(r"\w+", text(DOCS / "reference" / "spec_file.md")))
    assert set(known_keys()) <= words  # the table is made by itself: what a key means is said there


def test_every_command_and_option_is_in_the_reference() -> None:
    page = made("command_line")
    paths = re.findall(r"(?m)^## `pwatrack ?(.*)`$", page)
    asked = {"": CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).stdout}
    for path in paths:
        asked[path] = CliRunner().invoke(app, [*path.split(), "--help"], env={"COLUMNS": "200"}).stdout
    for path, said in asked.items():
        section = page.partition(f"## `{f'pwatrack {path}'.strip()}`\n")[2].partition("\n## ")[0]
        options = set(re.findall(r"--[a-z][a-z0-9-]*", said)) - {"--help", "--install-completion", "--show-completion"}
        declared = {option for option in options if f"│ {option}" in said or f"--{option[2:]} " in said}
        assert {option for option in declared if f"`{option}" not in section and option not in section} == set(), path
    commands = {name for said in asked.values() for name in re.findall(r"(?m)^│ ([a-z]+) {2,}\w", said)}
    assert commands <= {word for path in paths for word in path.split()}
    assert {"check", "design", "simulate", "verify", "batch", "init", "export", "explain"} <= commands
    told = re.findall(r"(?m)^\| (`[^|]*`) \| *([^|]*?) *\|", page)
    assert len(told) > 60
    assert [option for option, means in told if len(means) < 8] == []


def test_commands_that_pages_name_are_commands_with_these_options() -> None:
    from typer.main import get_command

    page = made("command_line")
    count = 0
    for path in [*PAGES, ROOT / "README.md", ROOT / "CHANGELOG.md"]:
        for line in re.findall(r"(?m)^(?: {4}|\$ )?pwatrack ([a-z][^\n]*)$|`pwatrack ([a-z][^`\n]*)`", text(path)):
            said = re.sub(r"^ *#.*| #.*|[|>].*", "", line[0] or line[1])
            words, command, name = said.split(), get_command(app), "pwatrack"
            while words and words[0] in getattr(command, "commands", {}):
                command, name = command.commands[words[0]], f"{name} {words.pop(0)}"  # type: ignore[attr-defined]
            assert name != "pwatrack", f"{path.name}: {said}"
            section = page.partition(f"## `{name}`\n")[2].partition("\n## ")[0]
            for option in re.findall(r"--[a-z][a-z0-9-]*", " ".join(words)):
                assert option in section, f"{path.name}: {said}: {option}"
            count += 1
    assert count > 60


def test_every_code_of_an_error_is_in_the_reference_with_its_meaning() -> None:
    page = made("error_codes")
    for kind in CODES:
        title, *meaning = explanation(kind.code).splitlines()
        assert f"## {title}" in page
        assert len(" ".join(meaning).strip()) > 40, kind.code


def test_every_figure_is_in_the_reference_with_its_meaning() -> None:
    rows = dict(re.findall(r"(?m)^\| `(\w+)` \|.*\| (.+) \|$", made("figures")))
    assert set(rows) == set(QUANTITIES)
    assert all(len(meaning) > 10 for meaning in rows.values())


def test_every_file_of_a_run_is_in_the_reference() -> None:
    page = text(DOCS / "reference" / "files.md")
    rooms = [ROOT / "pwatrack" / "report", ROOT / "pwatrack" / "batch"]
    named = {
        node.value
        for room in rooms
        for module in room.rglob("*.py")
        for node in ast.walk(ast.parse(text(module)))
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and re.fullmatch(r"[a-z_]+\.(json|csv|png|parquet)", node.value)
    } - {"going.json", "coming.json", "sarif.json"}
    for names, kind in re.findall(r"\(([a-z_|]+)\)\\.(json|csv|png)", run_folder.NAMES.pattern):
        named |= {f"{name}.{kind}" for name in names.split("|")}
    assert len(named) > 20
    assert {name for name in named if f"`{name}`" not in page} == set()


def test_every_public_name_has_its_docstring_and_an_example_that_runs() -> None:
    page = made("python_api")
    for name in pwatrack.__all__:
        section = page.partition(f"## `{name}`\n")[2].partition("\n## ")[0]
        assert section.strip(), name
    functions = [name for name in pwatrack.__all__ if name[0].islower()]
    assert len(functions) >= 6
    for function in functions:
        assert "**Example**" in page.partition(f"## `{function}`\n")[2].partition("\n## ")[0], function


def test_every_equation_names_modules_and_tests_that_exist() -> None:
    loose = [path.name for path in (DOCS / "theory").glob("*.md") if "$$" in text(path)]
    assert loose == []  # a formula that stands by itself is an {equation}, which says what carries it
    assert {e.number for e in equations()} >= OF_THE_PAPER
    assert len({e.number for e in equations()}) == len(equations())
    for equation in equations():
        assert equation.modules, equation.number
        assert equation.tests, equation.number
        for module in equation.modules:
            assert (ROOT / "pwatrack" / module).is_file(), f"({equation.number}): {module}"
        for test in equation.tests:
            file, _, function = test.partition("::")
            assert re.search(rf"(?m)^def {function}\(", text(ROOT / file)), f"({equation.number}): {test}"


def test_equations_of_the_code_are_in_the_theory() -> None:
    """Each number of an equation that ARCHITECTURE.md says the place of has its formula."""
    table = text(ROOT / "ARCHITECTURE.md").partition("## Where the equations live")[2]
    named = set(re.findall(r"\((\d+)\)", table.partition("## Libraries")[0]))
    assert named <= OF_THE_PAPER


def test_every_spec_has_its_entry_in_the_gallery_and_says_what_it_is() -> None:
    assert set(gallery.working()) | set(gallery.refused()) == set(SPECS.rglob("*.yaml"))
    for path in SPECS.rglob("*.yaml"):
        assert len(gallery.words(path)) > 60, path


def test_refusals_of_the_gallery_are_shown_with_code_and_place() -> None:
    page = made("refusals")
    for path in gallery.refused():
        entry = page.partition(f"[`specs/refused/{path.name}`]")[0].rpartition("### ")[2]
        assert re.search(r"\[P\d\d\d\]", entry), path.name
        assert f"specs/refused/{path.name}:" in entry, path.name


def test_blocks_show_what_came_out_and_a_page_that_fails_is_an_error(tmp_path: Path) -> None:
    source = "```{file} a.txt\nhello\n```\n```{run}\ncat a.txt\n```\n```{python}\nprint(6 * 7)\n```\n"
    page = cells.Page("here", cells.prepared(tmp_path / "page"), {"it": lambda: "made"}, tmp_path)
    shown = page.expand(source + "```{generated} it\n```\n")
    assert "hello" in shown.partition("cat a.txt")[2]
    assert "42" in shown
    assert "made" in shown
    assert page.expand("```{run} exit=3\nexit 3\n```\n")
    with pytest.raises(cells.PageError, match="exit 0, not 3"):
        page.expand("```{run} exit=3\ntrue\n```\n")
    with pytest.raises(cells.PageError, match="no picture"):
        page.expand("```{picture} none.png\n```\n")


@pytest.mark.slow
@pytest.mark.skipif(which("make") is None or which("cc") is None, reason="no C compiler: `make docs` runs these pages")
@pytest.mark.parametrize("name", ["tutorial/index", "howto/cells"])
def test_pages_for_newcomers_run_in_an_empty_folder(name: str, tmp_path: Path) -> None:
    """The build runs every page; these are run by the tests too."""
    page = cells.Page(name, cells.prepared(tmp_path / "page"), {}, tmp_path / "pictures")
    shown = page.expand(text(DOCS / f"{name}.md"))
    asked = [block for block in cells.blocks(text(DOCS / f"{name}.md")) if block.kind in ("run", "picture")]
    assert shown.count("{container} output") + len(page.made) == len(asked)
    if name == "tutorial/index":  # what its words say
        assert "≤ 0.00633 rad from every start" in shown
        assert "3 of 3 met" in shown
        assert "1000 steps, 0 wrong" in shown


@pytest.mark.parametrize("module", [cells, gallery, reference], ids=lambda module: module.__name__)
def test_examples_of_the_generators_run(module: object) -> None:
    found = doctest.testmod(module)  # type: ignore[arg-type]
    assert found.attempted
    assert not found.failed


def test_formulas_become_mathml() -> None:
    if find_spec("sphinx") is None:
        pytest.skip("Sphinx is not installed: `make docs` is where formulas are drawn")
    from docs.ext.mathml import mathml

    for equation in equations():
        assert mathml(equation.formula, block=True).startswith("<math")
    indexed = mathml(r"\dot x_d", block=False)
    assert re.search(r"<msub>\s*<mover", indexed)
    assert "munder" not in indexed
