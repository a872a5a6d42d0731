"""Blocks of a page that are run when the site is built: what a page shows is what came out, never pasted.

| block | does |
|---|---|
| ```` ```{file} NAME ```` | writes its text to the file NAME of the page's folder, and shows it |
| ```` ```{run} [exit=N] ```` | runs its lines in a shell there, and shows what was printed |
| ```` ```{python} ```` | runs its text with Python there, and shows both |
| ```` ```{picture} FILE ```` | shows a picture that was made there; its text is the caption |
| ```` ```{explore} FILE NAME=LOW:HIGH:POINTS … ```` | its text, a spec, at each place of a grid, with sliders |
| ```` ```{equation} NUMBER ```` | a formula; lines `modules:` and `tests:` name what carries it |
| ```` ```{generated} NAME ```` | what a function of `docs.ext.reference` or `docs.ext.gallery` returns |

Each page has a folder of its own, empty but for a copy of `specs/`. Nothing here knows Sphinx: the tests run pages too.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(
    r"^(?P<fence>`{3,})\{(?P<kind>\w+)\} *(?P<told>.*)\n(?P<text>(?:.*\n)*?)(?P=fence) *$", re.MULTILINE
)
_LANGUAGES = {".yaml": "yaml", ".yml": "yaml", ".py": "python", ".c": "c", ".json": "json", ".csv": "text"}


class PageError(Exception):
    """A block of a page did not do what it says."""


@dataclass(frozen=True)
class Block:
    """A block of a page: its kind, what is told behind it, and its text."""

    kind: str
    told: str
    text: str


@dataclass(frozen=True)
class Carried:
    """A formula of a page: its number, what carries it in the program, and what tests it."""

    number: str
    formula: str
    modules: tuple[str, ...]
    tests: tuple[str, ...]


@dataclass
class Page:
    """A page while it is run.

    Attributes:
        name: Its path below docs/, without suffix.
        folder: Where its files are.
        generated: What stands for blocks of that kind, by name.
        pictures: Where pictures are put, below docs/.
        made: The pictures that were put there.
    """

    name: str
    folder: Path
    generated: Mapping[str, Callable[[], str]]
    pictures: Path
    made: list[Path] = field(default_factory=list)

    def expand(self, text: str) -> str:
        """Return the page with what its blocks made, in the order in which they stand."""
        return _BLOCK.sub(lambda found: self._expanded(_block(found), found.group()), text)

    def _expanded(self, block: Block, as_it_stands: str) -> str:
        match block.kind:
            case "file":
                return self._file(block)
            case "run" | "python":
                return self._run(block)
            case "picture":
                return self._picture(block)
            case "explore":
                from docs.ext.explore import explored

                name, *axes = block.told.split()
                shown_file = self._file(Block("file", name, block.text))
                return explored(self.folder / name, axes) + "\n" + shown_file
            case "equation":
                return shown(carried(block))
            case "generated":
                return self.generated[block.told]()
        return as_it_stands

    def _file(self, block: Block) -> str:
        path = self.folder / block.told
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.text, encoding="utf-8")
        return _code(block.text, _LANGUAGES.get(path.suffix, "text"), caption=block.told)

    def _run(self, block: Block) -> str:
        python = block.kind == "python"
        command = [sys.executable, "-c", block.text] if python else ["bash", "-euc", block.text]
        run = subprocess.run(
            command,
            cwd=self.folder,
            env=self._environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            check=False,
        )
        printed = "\n".join(line.rstrip() for line in run.stdout.decode("utf-8").replace("\r", "").splitlines())
        expected = int(block.told.removeprefix("exit=") or 0)
        if run.returncode != expected:
            raise PageError(f"{self.name}: exit {run.returncode}, not {expected}:\n{block.text}\n{printed}")
        printed = printed.replace(str(self.folder) + "/", "").replace(str(ROOT) + "/", "")
        after = f"\n:::{{container}} output\n{_code(printed, 'text')}\n:::\n" if printed.strip() else ""
        return _code(block.text, "python" if python else "sh") + after

    def _environment(self) -> dict[str, str]:
        """Return the environment with `pwatrack` as the program of this folder, one thread, and no colours."""
        bin_folder = self.folder / ".bin"
        if not bin_folder.exists():
            bin_folder.mkdir(parents=True)
            starter = bin_folder / "pwatrack"
            starter.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m pwatrack "$@"\n', encoding="utf-8")
            starter.chmod(0o755)
        given = {
            "PATH": f"{bin_folder}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "COLUMNS": "88",
            "NO_COLOR": "1",
            "TERM": "dumb",
            "MPLBACKEND": "Agg",
            "OMP_NUM_THREADS": "1",
        }
        return os.environ | given

    def _picture(self, block: Block) -> str:
        source = self.folder / block.told
        if not source.is_file():
            raise PageError(f"{self.name}: there is no picture {block.told}")
        target = self.pictures / f"{self.name.replace('/', '-')}-{source.name}"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
        self.made.append(target)
        caption = " ".join(block.text.split())
        return f":::{{figure}} /generated/{target.name}\n:alt: {caption}\n:loading: lazy\n\n{caption}\n:::\n"


def prepared(folder: Path) -> Path:
    """Return a folder for a page: empty, but for the specs of this project.

    They are copied: a link would have a build of the package pass by the real ones, which it has seen then.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copytree(ROOT / "specs", folder / "specs")
    return folder


def blocks(text: str) -> list[Block]:
    r"""Return all blocks of a page.

    Example:
        >>> blocks("```{run} exit=4\npwatrack check x.yaml\n```")
        [Block(kind='run', told='exit=4', text='pwatrack check x.yaml\n')]
    """
    return [_block(found) for found in _BLOCK.finditer(text)]


def carried(block: Block) -> Carried:
    """Return what a block says of its formula."""
    lines = block.text.splitlines()
    told = {key: value for line in lines if (parts := line.partition(": "))[1] for key, value in [parts[::2]]}
    formula = "\n".join(line for line in lines if not line.startswith(("modules: ", "tests: ")))
    modules, tests = (tuple(told.get(key, "").split()) for key in ("modules", "tests"))
    return Carried(block.told, formula, modules, tests)


def shown(equation: Carried) -> str:
    """Return a formula as Markdown, with what carries it."""
    label = f" ({equation.number})" if equation.number else ""
    modules = ", ".join(f"`{module}`" for module in equation.modules)
    tests = ", ".join(f"`{test}`" for test in equation.tests)
    told = f"carried by {modules}; tested by {tests}"
    return f"$$\n{equation.formula.strip()}\n$${label}\n\n:::{{container}} carried\n{told}\n:::\n"


def _block(found: re.Match[str]) -> Block:
    return Block(found["kind"], found["told"].strip(), found["text"])


def _code(text: str, language: str, *, caption: str = "") -> str:
    about = f":caption: {caption}\n" if caption else ""
    return f"````{{code-block}} {language}\n{about}\n{text.rstrip()}\n````\n"
