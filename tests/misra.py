"""What cppcheck says of exported C, and the deviations from MISRA C:2012 that docs/misra.md lists."""

import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

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


def listed() -> frozenset[str]:
    """Return the rules that may be broken."""
    return frozenset(re.findall(r"^\| ([0-9.]+) \|", LIST.read_text(encoding="utf-8"), re.MULTILINE))


def checked(folder: Path) -> Checked:
    """Let cppcheck read a controller and the replay of its vector."""
    command = ["cppcheck", "--addon=misra", "--std=c99", "--enable=warning,portability,performance", "loop.c", "main.c"]
    said = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stderr
    kinds = re.findall(r"\[(\w+)\]$", said, re.MULTILINE)
    others = tuple(kind for kind in kinds if not kind.startswith("misra"))
    return Checked(frozenset(re.findall(r"misra-c2012-([0-9.]+)", said)), others, said)
