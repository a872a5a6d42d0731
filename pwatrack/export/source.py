"""What all exported code of a controller is written from."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.control.program import Follows, Program
from pwatrack.errors import InvalidSpec
from pwatrack.export.schema import ControllerFile
from pwatrack.export.stored import runs

_LAST_TICK = 2**31 - 2  # that 31 bits count, with one to spare: Structured Text has a sign


@dataclass(frozen=True)
class Vector:
    """What a controller reads, step by step.

    Attributes:
        y: Measured outputs, (steps, q).
        w: The reference from outside, (steps, s).
        origin: Where it is from, in a few words.
    """

    y: Array
    w: Array
    origin: str


@dataclass(frozen=True, kw_only=True)
class Source:
    """What is written.

    Attributes:
        file: The controller.
        name: Prefix of all names.
        single: Whether in single floats.
        given: Whether the reference comes from outside.
        unproved: What is not proved of it, in sentences.
    """

    file: ControllerFile
    name: str
    single: bool
    given: bool
    unproved: tuple[str, ...]

    @property
    def real(self) -> Any:
        """Type of its numbers."""
        return np.float32 if self.single else np.float64

    @cached_property
    def program(self) -> Program:
        """What runs."""
        return runs(self.file, given=self.given, single=self.single)

    @cached_property
    def follows(self) -> Follows | None:
        """The reference that is made inside."""
        found = self.program.follows
        last = 0 if found is None else max([found.end or 0, *(piece.tick for piece in found.pieces)])
        if last > _LAST_TICK:
            raise InvalidSpec(f"the reference has pieces up to tick {last}, more than a whole number of 32 bits counts")
        return found if self.program.sizes["s"] else None

    @property
    def claims(self) -> list[str]:
        """What is proved of its error, in sentences."""
        return [f"Of the loop that the theorems are about {claim}." for claim in self.file.claims]

    @property
    def counted(self) -> bool:
        """Whether ticks are counted: the reference has pieces, or an end."""
        return self.follows is not None and (bool(self.follows.pieces) or self.follows.end is not None)

    @property
    def copies(self) -> int:
        """How many copies of w are kept."""
        return 0 if self.follows is None else len(self.follows.turn) - 1

    @cached_property
    def tables(self) -> dict[str, Array]:
        """All constants of floats, by name; those that are empty are left out."""
        program, follows, start = self.program, self.follows, self.file.start
        of = program.sizes
        found: dict[str, Array] = {"H": program.H, "h": program.h, "observer": program.observer}
        found |= {"generator": program.generator, "x_d": program.x_d, "u_ff": program.u_ff, "K": program.K}
        found["guards"] = program.guards
        found["start_x_hat"] = np.array(start.x_hat) if start else np.zeros(of["N"])
        found["start_eta_hat"] = np.array(start.eta_hat) if start else np.zeros(of["p"])
        if follows is not None:
            found |= {"turn": follows.turn, "start_w": follows.w0}
            found["piece_values"] = np.concatenate([np.zeros(0), *(piece.w for piece in follows.pieces)])
        return {name: values for name, values in found.items() if values.size}

    @cached_property
    def whole(self) -> dict[str, IntArray]:
        """All constants of whole numbers; those that are empty are left out."""
        found = {"signs": self.program.signs, "sides": self.program.sides}
        if self.follows is not None:
            pieces = self.follows.pieces
            lengths = [len(piece.w) for piece in pieces]
            found["piece_tick"] = np.array([piece.tick for piece in pieces])
            found["piece_start"] = np.array([piece.start for piece in pieces])
            found["piece_length"] = np.array(lengths)
            found["piece_value"] = np.cumsum([0, *lengths])[:-1]
        return {name: values for name, values in found.items() if values.size}

    def about(self, sizes: Sequence[str] = (), reference: str = "made inside") -> list[str]:
        """Return what stands at the top: what it is, what is proved, digests, signals.

        Args:
            sizes: Lines on its size, if anything is known of that.
            reference: What is to be said of a reference that is made inside.
        """
        of, part = self.program.sizes, self.file
        signals = self.signals([*part.plant.outputs, *part.plant.inputs])
        y, u = ", ".join(signals[: of["q"]]), ", ".join(signals[of["q"] :])
        proved = [f"NOT PROVED: {line}" for line in self.unproved] or [
            "Proved for the gains as printed, in continuous time: certificate.json.",
            *self.claims,
            "The loop that is sampled is not proved for switching between cells: docs/arithmetic.md of pwatrack.",
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
            f"ref          {', '.join(self.program.reference) if self.given else reference}",
            f"u            {u}",
        ]
        return [said(line) for line in lines]

    def signals(self, names: Sequence[str]) -> list[str]:
        """Return names of signals with their units."""
        units = self.file.plant.units
        return [f"{name} ({units[name]})" if name in units else name for name in names]


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


_ASCII = {"°": "deg", "·": "*", "⋅": "*", "×": "x", "−": "-", "–": "-", "Ω": "Ohm", "⁄": "/", "\u0307": "'"}


def in_ascii(text: str) -> str:
    """Return a text with what is read as the same in ASCII, where there is something: m³ is m3, µm um, η eta."""
    text = re.sub(r"[µμ](?=\w)", "u", text)
    found = []
    for sign in unicodedata.normalize("NFKD", "".join(_ASCII.get(sign, sign) for sign in text)):
        greek = re.fullmatch(r"GREEK (SMALL|CAPITAL) LETTER (\w+)", unicodedata.name(sign, ""))
        if sign in _ASCII:
            found.append(_ASCII[sign])
        elif greek:
            found.append(greek[2].lower() if greek[1] == "SMALL" else greek[2].capitalize())
        elif not unicodedata.combining(sign):
            found.append(sign)
    return "".join(found)
