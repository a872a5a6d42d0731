"""The package that is built is whole: it designs the example in an environment that has nothing else of this folder."""

import ast
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import yaml

from pwatrack.version import __version__

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the wheel and the sdist."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", folder], cwd=ROOT, check=True, capture_output=True
    )
    return folder


@pytest.mark.slow
def test_the_wheel_designs_the_example_away_from_its_sources(built: Path, tmp_path: Path) -> None:
    (wheel,) = built.glob("*.whl")
    assert __version__ in wheel.name
    venv.create(tmp_path / "empty", symlinks=True)
    python = str(tmp_path / "empty" / "bin" / "python")
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def call(*arguments: str) -> str:
        run = subprocess.run([python, *arguments], cwd=tmp_path, env=env, check=False, capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
        return run.stdout

    packages = Path(call("-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    with zipfile.ZipFile(wheel) as content:
        content.extractall(packages)
    (packages / "libraries.pth").write_text(sysconfig.get_path("purelib"))  # what pip would have fetched

    assert str(packages) in call("-c", "import pwatrack; print(pwatrack.__file__)")
    call("-m", "pwatrack", "init", "--from", "example")
    assert "Theorem 3" in call("-m", "pwatrack", "design", "spec.yaml")
    assert "fractions only" in call("-m", "pwatrack", "verify", "runs/spec")


def test_every_module_and_data_file_is_in_the_wheel_and_all_else_in_the_sdist(built: Path) -> None:
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, check=False, capture_output=True, text=True).stdout.split()
    if not tracked:
        pytest.skip("no clone of the repository: what belongs to it is not known")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name for name in tracked if name.startswith("pwatrack/") and (ROOT / name).is_file()} <= names
    with tarfile.open(sdist) as content:
        inside = {name.partition("/")[2] for name in content.getnames()}
    assert {name for name in tracked if name[0] != "." and (ROOT / name).is_file()} <= inside
    assert not any(name.startswith(("docs/_build", "docs/generated", "runs/", ".venv")) for name in inside)


def test_the_packaged_example_is_that_of_the_specs() -> None:
    def told(path: Path) -> str:
        return re.sub(r"(?m)^#.*\n", "", path.read_text(encoding="utf-8"))

    assert told(ROOT / "pwatrack" / "starters" / "example.yaml") == told(ROOT / "specs" / "two_mass_backlash.yaml")


def test_citation_changelog_and_package_tell_one_version() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == __version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"(?m)^## (\S+)", changes)[0] == __version__


def _name(requirement: str) -> str:
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert found, requirement
    return re.sub("[-_.]+", "-", found[0]).lower()


def _locked(name: str) -> dict[str, set[str]]:
    """Return what a lock has of each package: versions with their conditions, and hashes."""
    text = (ROOT / name).read_text(encoding="utf-8")
    found: dict[str, set[str]] = {}
    for entry in re.findall(r"(?m)^[a-z].*(?:\n {4}--hash.*)+", text):
        found.setdefault(_name(entry), set()).update(line.rstrip(" \\").strip() for line in entry.splitlines())
    assert re.findall(r"(?m)^[a-z0-9]\S*", text) == re.findall(r"(?m)^[a-z0-9]\S*==\S+(?= .*\n {4}--hash)", text), name
    return found


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = {extra: {_name(each) for each in needed} for extra, needed in PROJECT["optional-dependencies"].items()}
NEEDED = {_name(each) for each in PROJECT["dependencies"]}
COMPANION = "pydantic-core"  # half of pydantic, which asks for exactly one version of it


def test_the_lock_of_what_runs_has_that_and_the_backend_and_no_tool() -> None:
    runs, tests = _locked("requirements.lock"), _locked("requirements-dev.lock")
    assert set(runs) >= NEEDED | EXTRAS["build"]
    assert not set(runs) & set().union(*(EXTRAS[extra] for extra in ("dev", "cluster", "control", "table", "docs")))
    assert not set(runs) & {"dask", "lxml", "pytest-xdist", "mypy"}
    assert set(tests) > set(runs)
    assert set(tests) >= EXTRAS["dev"] - {"pwatrack"} | EXTRAS["cluster"] | EXTRAS["control"] | EXTRAS["table"]
    assert {name: tests[name] for name in runs} == runs  # so that the second lock installs none of the first again


def _imported(path: Path) -> dict[str, bool]:
    """Return what a module imports from elsewhere by name, and whether as soon as it is imported itself."""
    tree, found = ast.parse(path.read_text(encoding="utf-8")), dict[str, bool]()
    for node in ast.walk(tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [str(node.module)]
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "import_module":
            names = [str(each.value) for each in node.args if isinstance(each, ast.Constant)]
        for name in names:
            top = name.partition(".")[0]
            found[top] = found.get(top, False) or node in tree.body
    return found


def test_what_is_imported_is_needed_or_an_extra_and_then_not_at_once() -> None:
    owners = packages_distributions()
    extras = EXTRAS["cluster"] | EXTRAS["control"] | EXTRAS["table"]
    for path in sorted((ROOT / "pwatrack").rglob("*.py")):
        for top, at_once in _imported(path).items():
            if top in sys.stdlib_module_names or top in {"pwatrack", "audit"}:
                continue
            owner = {_name(each) for each in owners[top]}
            assert owner & {*NEEDED, COMPANION} or (owner & extras and not at_once), f"{path}: {top}"
