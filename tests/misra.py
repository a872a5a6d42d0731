"""What cppcheck says of exported C, and the deviations from MISRA C:2012 that docs/misra.md lists."""

import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

LIST = Path(__file__).parent.parent / "docs" / "misra.md"


@dataclass(frozen=True)
class Checked:
    """What cppcheck says.

    Attributes:
        broken: Rules of MISRA C:2012.
        others: Findings of its own.
        said: All of it.
    """

    broken: frozenset[str]
    others: tuple[str, ...]
    said: str


def listed(part: str = "A controller") -> frozenset[str]:
    """Return the rules that may be broken in a part of the list."""
    _, _, text = LIST.read_text(encoding="utf-8").partition(f"## {part}\n")
    return frozenset(re.findall(r"^\| ([0-9.]+) \|", text.partition("\n## ")[0], re.MULTILINE))


def checked(folder: Path, *names: str) -> Checked:
    """Let cppcheck read files of a folder: as they are called, or a controller and the replay of its vector."""
    command = ["cppcheck", "--addon=misra", "--std=c99", "--enable=warning,portability,performance"]
    command += names or ("loop.c", "main.c")
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if "addon" in found.stdout + found.stderr and found.returncode != 0:
        pytest.skip(f"the addon of cppcheck for MISRA does not run: {(found.stdout + found.stderr).strip()[:200]}")
    assert found.returncode == 0, found.stderr
    said = found.stderr
    kinds = re.findall(r"\[(\w+)\]$", said, re.MULTILINE)
    others = tuple(kind for kind in kinds if not kind.startswith("misra"))
    return Checked(frozenset(re.findall(r"misra-c2012-([0-9.]+)", said)), others, said)
