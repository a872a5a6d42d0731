"""What all exported code of a controller is written from, and how texts and names are written in all of it."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.program import SampledController
from pwatrack.errors import InvalidSpec
from pwatrack.export.fixed_point import FixedPoint
from pwatrack.export.schema import ControllerFile
from pwatrack.export.step import Step, step
from pwatrack.export.stored import runs
from pwatrack.simulation.controller_arrays import memory, routine

if TYPE_CHECKING:
    from pwatrack.simulation.kernel import ControllerArrays

_UNCHECKED = (
    "NOT CHECKED: its spec was not at hand, so what follows is what controller.json says, of a program that may be "
    "another than the one that is proved."
)
_LAST_TICK = 2**31 - 2  # that 31 bits count, with one to spare: Structured Text has a sign
_PREFIX = 20  # letters at most: C99 tells 31 letters of a name apart
_FILES = "main vector model instance fmi2 fmi3"  # that an export has besides
_HEADERS = """
assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic
stdbool stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype
"""
_TARGETS = "all check clean help install package replay test"  # of make and CMake
_TAKEN = frozenset(f"{_FILES} {_HEADERS} {_TARGETS}".split())


@dataclass(frozen=True)
class Vector:
    """What a controller reads, step by step."""

    y: Array  # measured outputs, (steps, q)
    w: Array  # the reference from outside, (steps, s)
    origin: str  # where it is from, in a few words


@dataclass(frozen=True, kw_only=True)
class Source:
    """What is written."""

    file: ControllerFile  # the controller
    name: str  # prefix of all names
    single: bool  # whether in single floats
    given: bool  # whether the reference comes from outside
    unproved: tuple[str, ...]  # what is not proved of it, in sentences
    checked: bool = True  # whether it was made from its spec again: else its file alone says what is proved
    whole: FixedPoint | None = None  # what it is in whole numbers; None for floats
    rounding: str = ""  # what their rounding makes of its bounds, in a sentence

    @property
    def real(self) -> Any:
        """Type of its numbers."""
        return np.float32 if self.single else np.float64

    @cached_property
    def program(self) -> SampledController:
        """What runs."""
        return runs(self.file, given=self.given, single=self.single)

    @cached_property
    def routine(self) -> "ControllerArrays":
        """The same as arrays."""
        found = routine(self.program, self.real)
        if (last := found.last) > _LAST_TICK:
            raise InvalidSpec(f"the reference has pieces up to tick {last}, more than a whole number of 32 bits counts")
        return found

    @cached_property
    def step(self) -> Step:
        """What it does in a sample time."""
        return step(self.routine, self.starts) if self.whole is None else self.whole.step

    @property
    def starts(self) -> dict[str, Array]:
        """What x̂ with ŝ, η̂, and w if it is made inside, start with: `start_x_hat`, `start_eta_hat`, `start_w`."""
        kept, at = memory(self.program, *self.file.started, self.real)["memory"], self.program.places
        starts = {"start_x_hat": kept[at["x_hat"].start : at["s_hat"].stop], "start_eta_hat": kept[at["eta_hat"]]}
        return starts if self.given else {**starts, "start_w": kept[at["w"]]}

    @property
    def entries(self) -> str:
        """What is given of the reference, in order."""
        return ", ".join(self.program.given) + ": set-points, also on the move" * bool(len(self.program.pace))

    @property
    def claims(self) -> list[str]:
        """What is proved of its error, in sentences; last of the loop that is sampled."""
        assert self.file.program is not None
        said = [f"Of the loop that the theorems are about {claim}." for claim in self.file.claims]
        found = [*[_UNCHECKED] * (not self.checked), *said, f"The loop that is sampled: {self.file.program.proved}."]
        return [*found, self.rounding] if self.rounding else found

    def about(self, sizes: Sequence[str] = (), reference: str = "made inside") -> list[str]:
        """Return what stands at the top: what it is, what is proved, digests, lines on its size, signals."""
        of, part = self.program.sizes, self.file
        signals = self.signals([*part.plant.outputs, *part.plant.inputs])
        y, u = ", ".join(signals[: of["q"]]), ", ".join(signals[of["q"] :])
        proved = [f"NOT PROVED: {line}" for line in self.unproved] or [
            "Proved for the gains K and L of the design, in continuous time: certificate.json.",
            *self.claims,
        ]
        lines = [
            part.name,
            "",
            *(f"FAILED: {line}" for line in part.failed),
            f"Run once every {self.program.sampling.sample_time!r} s.",
            "Written by pwatrack. It belongs to its user: see LICENSE-EXCEPTION of pwatrack.",
            *proved,
            "",
            f"Spec         sha256 {part.spec_sha256}",
            f"Certificate  sha256 {part.proof}",
            f"Controller   sha256 {part.sha256}",
            "",
            *([*sizes, ""] if sizes else []),
            f"y            {y}",
            f"ref          {self.entries if self.given else reference}",
            f"u            {u}",
        ]
        return [said(line) for line in lines]

    def signals(self, names: Sequence[str]) -> list[str]:
        """Return names of signals with their units."""
        units = self.file.plant.units
        return [f"{name} ({units[name]})" if name in units else name for name in names]


def prefix(title: str) -> str:
    """Return a title as the prefix of C names, and the name of files: one that is taken has a 1 behind it.

    Example:
        >>> prefix("Two masses, 2 µm"), prefix("3 tanks"), prefix("Δ")
        ('two_masses_2_m', 'c_3_tanks', 'controller')
        >>> prefix("Two masses with backlash, on a machine"), prefix("Model")
        ('two_masses_with', 'model_1')
    """
    words = re.findall(r"[a-z0-9]+", title.lower()) or ["controller"]
    words = words if words[0][0].isalpha() else ["c", *words]
    while len("_".join(words)) > _PREFIX and len(words) > 1:
        words.pop()
    found = "_".join(words)[:_PREFIX]
    return f"{found}_1" if found in _TAKEN else found


def template(name: str, /, **values: object) -> str:
    """Return a file of `templates` with each @key@ replaced that has a value."""
    text = files("pwatrack.export").joinpath(f"templates/{name}").read_text(encoding="utf-8")
    return re.sub(r"@(\w+)@", lambda found: str(values.get(found[1], found[0])), text)


def write_texts(texts: Mapping[str, str | bytes], out: Path) -> list[str]:
    """Write files to a folder, which is made, and return their names."""
    out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (out / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return list(texts)


def reference_unit(name: str, units: Mapping[str, str]) -> str:
    """Return the unit of a signal, of what is desired of one, or of a derivative.

    Example:
        >>> units = {"y": "m", "z": "N m"}
        >>> reference_unit("d2y/dt2", units), reference_unit("dz_d/dt", units), reference_unit("u_ff", units)
        ('m/s^2', 'N m/s', '')
    """
    found = re.fullmatch(r"d(\d*)(.+)/dt\1", name)
    signal, order = (name, None) if found is None else (found[2], found[1])
    unit = units.get(signal) or units.get(re.sub(r"_(d|ff)$", "", signal), "")
    return unit if order is None or not unit else f"{unit}/s{'^' * bool(order)}{order}"


def said(text: str) -> str:
    """Return a text as it may stand in a comment, of C or of Structured Text.

    Example:
        >>> said("ẏ in m³/s, µm, °C or s⁻¹; η */")
        "y' in m3/s, um, degC or s-1; eta * /"
    """
    text = re.sub(r"[^ -~]", "?", in_ascii(text))
    for mark in ("*/", "/*", "*)", "(*"):
        text = text.replace(mark, " ".join(mark))
    return text


_ASCII = {"°": "deg", "·": "*", "⋅": "*", "×": "x", "−": "-", "–": "-", "Ω": "Ohm", "⁄": "/", "≤": "<=", "\u0307": "'"}


def in_ascii(text: str) -> str:
    """Return a text with what is read as the same in ASCII, where there is something: m³ is m3, µm um, x̂ x_hat."""
    text = unicodedata.normalize("NFKD", re.sub(r"[µμ](?=\w)", "u", text))
    found = []
    for sign in re.sub(r"\b(\w)\u0302(?!\w)", r"\1_hat", text):
        greek = re.fullmatch(r"GREEK (SMALL|CAPITAL) LETTER (\w+)", unicodedata.name(sign, ""))
        if sign in _ASCII:
            found.append(_ASCII[sign])
        elif greek:
            found.append(greek[2].lower() if greek[1] == "SMALL" else greek[2].capitalize())
        elif not unicodedata.combining(sign):
            found.append(sign)
    return "".join(found)
