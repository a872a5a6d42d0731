"""The limits that the code keeps: sizes, and which words belong to which room."""

import ast
import re
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from statistics import median

import pytest

from pwatrack.errors import Problem, ProblemPart, Remedy, Way
from pwatrack.spec.schema import known_keys
from pwatrack.spec.spelling import path_of, spelled

HOUSE = Path(__file__).parents[1] / "pwatrack"
MODULES = sorted(HOUSE.rglob("*.py"))
LONG_MODULES = {"simulation/kernel.py"}  # the compiled walk in one file
BELOW = ("model", "lmi", "control", "simulation")  # rooms that know no file and no command line


def lines(module: Path) -> int:
    return len(module.read_text(encoding="utf-8").splitlines())


def name(module: Path) -> str:
    return module.relative_to(HOUSE).as_posix()


def test_no_module_is_long_and_half_of_them_are_short() -> None:
    assert {name(m) for m in MODULES if lines(m) > 450} == LONG_MODULES
    assert median(map(lines, MODULES)) <= 165


def test_no_function_is_long() -> None:
    found = {
        f"{name(module)}: {node.name}"
        for module in MODULES
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and (node.end_lineno or 0) - node.lineno >= 60
    }
    assert not found


def number(node: ast.AST | None) -> bool:
    """Whether it is a number, or made of numbers alone."""
    if isinstance(node, ast.Tuple):
        return bool(node.elts) and all(map(number, node.elts))
    if isinstance(node, ast.BinOp):
        return number(node.left) and number(node.right)
    if isinstance(node, ast.Call):
        return ast.unparse(node.func) in ("Fraction", "range") and all(map(number, node.args))
    node = node.operand if isinstance(node, ast.UnaryOp) else node
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def test_every_number_that_a_module_decides_by_has_its_reason_beside_it() -> None:
    for module in MODULES:
        rows = module.read_text(encoding="utf-8").splitlines()
        for node in ast.parse("\n".join(rows)).body:
            if isinstance(node, ast.Assign) and number(node.value):
                around = [*rows[node.lineno - 1 : node.end_lineno], rows[node.lineno - 2][:1]]
                assert any("#" in row for row in around), f"{name(module)}:{node.lineno}"


def test_tests_and_benchmarks_call_nothing_private() -> None:
    private = re.compile(
        r"(?<!self)(?<!cls)\._(?!replace\b|asdict\b|fields\b|repr_html_|_)\w"
        r"|import .*(?<=[ ,])_[a-z]|attr\(.*\"_[A-Za-z]"
    )
    for file in [*Path(__file__).parent.glob("*.py"), *(HOUSE.parent / "benchmarks").glob("*.py")]:
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
            assert not private.search(line), f"{file.name}:{number}: {line.strip()}"


def test_properties_end_early_by_assume_alone() -> None:
    """A `return` for what does not apply would count as passed."""
    found = [
        f"{file.name}:{inner.lineno}"
        for file in Path(__file__).parent.glob("*.py")
        for test in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(test, ast.FunctionDef) and any("given(" in ast.unparse(each) for each in test.decorator_list)
        for inner in ast.walk(test)
        if isinstance(inner, ast.Return) and inner.value is None
    ]
    assert not found


def test_no_test_measures_time() -> None:
    """What another program takes of the machine would decide it."""
    found = [
        f.name for f in Path(__file__).parent.glob("*.py") if re.search(r"perf_counte[r]|process_tim[e]", f.read_text())
    ]
    assert not found


def test_the_rooms_of_architecture_are_those_of_the_import_contract_in_its_order() -> None:
    told = (HOUSE.parent / "ARCHITECTURE.md").read_text(encoding="utf-8").partition("## The rooms")[2]
    listed = re.findall(
        r"`(\w+)(?:\.py|/)`", "".join(re.findall(r"(?m)^\| (`[^|]*)\|", told.partition("## A claim")[0]))
    )
    contract = tomllib.loads((HOUSE.parent / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    layers = [re.findall(r"\.(\w+)", layer) for layer in contract["contracts"][0]["layers"]]
    place = {room: k for k, layer in enumerate(layers) for room in layer}
    assert place.keys() - {"cli_export", "starter"} <= set(listed)
    places = [place[room] for room in listed if room in place]
    assert places == sorted(places)


def test_files_that_architecture_and_contributing_name_are_there() -> None:
    for page in ("ARCHITECTURE.md", "CONTRIBUTING.md"):
        named = re.findall(
            r"[`\s]((?:\w+/)*\w+\.(?:py|md|toml)|(?:\w+/)+)(?=[`\s])", (HOUSE.parent / page).read_text("utf-8")
        )
        assert named
        rooms = [HOUSE, HOUSE.parent, *(path for path in HOUSE.iterdir() if path.is_dir()), HOUSE / "lmi" / "audit"]
        assert not [one for one in named if not any((room / one).exists() for room in rooms)]


def test_the_first_line_of_a_module_says_what_it_is() -> None:
    for module in MODULES:
        if module.name != "__init__.py":
            first = (ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or "").partition("\n")[0]
            assert len(first.split()) >= 3, name(module)


def test_no_modules_import_each_other() -> None:
    modules = {"pwatrack." + name(m).removesuffix(".py").replace("/", "."): m for m in MODULES if m.stem[:2] != "__"}
    imports = {
        one: {
            other
            for node in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom)
            for home in [one.rpartition(".")[0] + f".{node.module}" if node.level else node.module]
            for other in (home, *(f"{home}.{alias.name}" for alias in node.names))
            if other in modules
        }
        for one, module in modules.items()
    }
    assert len([*TopologicalSorter(imports).static_order()]) == len(modules)


def texts(module: Path) -> Iterator[tuple[int, str]]:
    """Yield every text that a module may print: no docstrings; a figure in a text is one character."""
    tree = ast.parse(module.read_text(encoding="utf-8"))
    silent = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            silent |= {id(part) for part in node.values}
            yield node.lineno, "".join(str(v.value) if isinstance(v, ast.Constant) else "0" for v in node.values)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in silent:
            yield node.lineno, node.value


@pytest.mark.parametrize("room", BELOW)
def test_rooms_below_know_no_words_of_files_or_command_line(room: str) -> None:
    """They say `ProblemPart` and `Way`; `spec/spelling.py` has the words."""
    keys = "|".join(map(re.escape, known_keys()))
    words = re.compile(rf"--[a-z]|YAML|(?:^|['{{])(?:{keys}): |[ (](?:{keys}): ?[\d\[{{…]")
    for module in (HOUSE / room).glob("*.py"):
        for number, text in texts(module):
            assert not words.search(text), f"{name(module)}:{number}: {text}"


@pytest.mark.parametrize("room", BELOW)
def test_rooms_below_know_no_paths_of_files(room: str) -> None:
    for module in (HOUSE / room).glob("*.py"):
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if isinstance(node, ast.keyword) and node.arg == "subject":
                path = [part.value for part in ast.walk(node.value) if isinstance(part, ast.Constant)]
                assert not any(isinstance(part, str) for part in path), f"{name(module)}:{node.value.lineno}"


@pytest.mark.parametrize("part", ProblemPart)
def test_every_part_has_a_path_in_a_file(part: ProblemPart) -> None:
    assert all(step in known_keys() for step in path_of((part,)))


@pytest.mark.parametrize("way", Way)
def test_every_way_has_words(way: Way) -> None:
    figures = (0.5, "stop") if way is not Way.OFFSET else ("0, 1", "stop")
    hint = spelled(Problem(message="wrong", hint="change it", remedy=Remedy(way, figures))).hint
    assert hint != "change it"
    assert "{hint}" not in hint


def test_a_name_of_a_class_stands_once() -> None:
    found = [
        (node.name, name(module))
        for module in MODULES
        for node in ast.parse(module.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    names = [one for one, _ in found]
    twice = {one: where for one, where in found if names.count(one) > 1}
    assert not twice
