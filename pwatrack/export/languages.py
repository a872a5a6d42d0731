"""The languages that a controller is written in: a new one is a module with a function `write`, and a line here."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pwatrack.export.source import Source, Vector


@dataclass(frozen=True, kw_only=True)
class Target:
    """A language.

    Attributes:
        module: Of this room, where `write` is.
        help: What is written, in a sentence.
        example: Arguments of a command that writes it.
        single: Whether it may be in single floats.
    """

    module: str
    help: str
    example: str
    single: bool = True

    @property
    def write(self) -> Callable[["Source", "Vector", Path], list[str]]:
        """What writes a controller to a folder, with what it reads in a test, and returns the names of the files."""
        found: Callable[[Source, Vector, Path], list[str]] = import_module(f"pwatrack.export.{self.module}").write
        return found


LANGUAGES = {
    "c": Target(
        module="c",
        help="Write a controller in C99, with a test vector of its simulation.",
        example="runs/two_mass_machine --out firmware --float32",
    ),
    "st": Target(
        module="structured_text",
        help="Write a controller as a function block in Structured Text of IEC 61131-3.",
        example="runs/two_mass_machine --out plc --float32",
    ),
    "mat": Target(
        module="matlab",
        help="Write a controller for MATLAB and Octave: a file of all its matrices, and a function that steps it.",
        example="runs/two_mass_machine --out matlab",
        single=False,
    ),
}
