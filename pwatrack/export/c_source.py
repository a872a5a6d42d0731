"""A controller as C99: header and source of the program of `docs/arithmetic.md`."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.arrays import Array, IntArray, up
from pwatrack.control.program import Follows, Program
from pwatrack.errors import InvalidSpec
from pwatrack.export.schema import ControllerFile
from pwatrack.export.stored import runs

_LAST_TICK = 2**32 - 2
_PREFIX = 20  # letters at most: C99 tells 31 letters of a name apart


@dataclass(frozen=True, kw_only=True)
class CSource:
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

    @cached_property
    def program(self) -> Program:
        """What runs."""
        return runs(self.file, given=self.given)

    @cached_property
    def follows(self) -> Follows | None:
        """The reference that is made inside."""
        found = self.program.follows
        last = 0 if found is None else max([found.end or 0, *(piece.tick for piece in found.pieces)])
        if last > _LAST_TICK:
            raise InvalidSpec(f"the reference has pieces up to tick {last}, more than 32 bits count")
        return found if self.program.sizes["s"] else None

    @property
    def claims(self) -> list[str]:
        """What is proved of its error, a sentence for each tracked signal."""
        part = self.file
        if part.practical is None:
            names = part.plant.tracked if part.tracking == "output" else part.plant.states
            return [f"Of the loop that the theorems are about the error goes to 0: {', '.join(names)}."]
        return [
            f"Of the loop that the theorems are about the error of {bound.signal} "
            f"ends below {up(bound.below)} {bound.unit}".rstrip()
            + "; it need not go to 0."
            for bound in part.practical
        ]

    @property
    def counted(self) -> bool:
        """Whether ticks are counted: the reference has pieces, or an end."""
        return self.follows is not None and (bool(self.follows.pieces) or self.follows.end is not None)

    @property
    def copies(self) -> int:
        """How many copies of w are kept."""
        return 0 if self.follows is None else len(self.follows.turn) - 1

    def numbers(self, values: Any) -> str:
        """Return an array as a C initialiser; each number is the shortest decimal that gives it."""
        if np.ndim(values):
            return "{" + ", ".join(self.numbers(value) for value in values) + "}"
        value = (np.float32 if self.single else np.float64)(values)
        text = str(value)
        return (text if re.search(r"[.e]", text) else f"{text}.0") + "f" * self.single

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
    def whole(self) -> dict[str, tuple[str, IntArray]]:
        """All constants of whole numbers, with their types."""
        found: dict[str, tuple[str, IntArray]] = {
            "signs": ("int8_t", self.program.signs),
            "sides": ("int8_t", self.program.sides),
        }
        if self.follows is not None:
            pieces = self.follows.pieces
            found["piece_tick"] = ("uint32_t", np.array([piece.tick for piece in pieces]))
            found["piece_start"] = ("uint32_t", np.array([piece.start for piece in pieces]))
            lengths = [len(piece.w) for piece in pieces]
            found["piece_length"] = ("uint32_t", np.array(lengths))
            found["piece_value"] = ("uint32_t", np.cumsum([0, *lengths])[:-1])
        return {name: (kind, values) for name, (kind, values) in found.items() if values.size}

    @property
    def constant_bytes(self) -> int:
        """Bytes of all constants."""
        widths = {"int8_t": 1, "uint32_t": 4}
        floats = sum(values.size for values in self.tables.values()) * (4 if self.single else 8)
        return floats + sum(values.size * widths[kind] for kind, values in self.whole.values())

    @property
    def fields(self) -> list[tuple[str, str, int, str]]:
        """The fields of the state: type, name, length, and what it is."""
        of, late, real = self.program.sizes, self.program.sampling.delay, f"{self.name}_real"
        m = of["m"]
        vector = of["q"] + m + of["N"] + of["p"] + of["s"]
        found = [
            (real, "v", vector, "y, u, x_hat, s_hat, eta_hat, w"),
            (real, "copies", self.copies * of["s"], "of w, renewed every 2^10 and 2^20 samples"),
            (real, "late", late * m, "inputs that wait to be put out, the next one first"),
            (real, "before", m, "inputs computed last, limited"),
            (real, "wanted", m, "inputs wanted before they were limited"),
            (real, "x_d", of["n"], "desired state"),
            ("uint32_t", "ready", 1, "set by init"),
            ("uint32_t", "started", 1, "whether it has run"),
            ("uint32_t", "tick", int(self.counted), "samples so far"),
            ("uint32_t", "since", int(self.copies > 0), "samples since the reference began anew"),
            ("uint32_t", "piece", int("piece_tick" in self.whole), "pieces of the reference so far"),
            ("uint32_t", "cell", 1, "cell of x_hat"),
            ("uint32_t", "cell_d", 1, "cell of x_d"),
            ("int32_t", "status", 1, "of the last step"),
        ]
        return [field for field in found if field[2]]

    @property
    def state_bytes(self) -> int:
        """Bytes of the state."""
        width = 4 if self.single else 8
        size = sum(length * (width if kind.endswith("_real") else 4) for kind, _, length, _ in self.fields)
        return -(-size // width) * width

    @property
    def operations(self) -> tuple[int, int, int]:
        """The most multiplications, additions and comparisons of floats in one step."""
        of, program = self.program.sizes, self.program
        planes, guards = len(program.h), len(program.guards)
        n, m, p, s = of["n"], of["m"], of["p"], of["s"]
        seen, known = of["q"] + m + of["N"], of["N"] - n + p + s
        rows = of["N"] * seen + (p + n + m + guards) * known + planes * n + m * n
        inside = s * s if self.follows is not None else 0
        quanta = int((program.quantum > 0).sum())
        found = len(program.signs) * (2 * planes + 1) + len(program.sides) * (2 * guards + 1)
        compared = found + 4 * m + 2 * (2 * seen + p + s + n + m)
        return rows + inside + 2 * quanta, rows + inside + m * n + 2 * m + quanta, compared


def prefix(title: str) -> str:
    """Return a title as the prefix of C names.

    Example:
        >>> prefix("Two masses, 2 µm"), prefix("3 tanks"), prefix("Δ")
        ('two_masses_2_m', 'c_3_tanks', 'controller')
        >>> prefix("Two masses with backlash, on a machine")
        'two_masses_with'
    """
    words = re.findall(r"[a-z0-9]+", title.lower()) or ["controller"]
    words = words if words[0][0].isalpha() else ["c", *words]
    while len("_".join(words)) > _PREFIX and len(words) > 1:
        words.pop()
    return "_".join(words)[:_PREFIX]


def header(c: CSource) -> str:
    """Return the header."""
    name, upper, of = c.name, c.name.upper(), c.program.sizes
    real = "float" if c.single else "double"
    lines = "\n".join(
        f"    {kind} {field}{f'[{length}]' if _array(field) else ''}; /* {what} */"
        for kind, field, length, what in c.fields
    )
    return (
        _comment(c)
        + f"""\
#ifndef {upper}_H
#define {upper}_H

#include <stdint.h>

#define {upper}_OUTPUTS {of["q"]}
#define {upper}_INPUTS {of["m"]}
#define {upper}_REFERENCE {of["s"] if c.given else 0}
#define {upper}_STATE_BYTES {c.state_bytes}
#define {upper}_CONSTANT_BYTES {c.constant_bytes}

typedef {real} {name}_real;

typedef struct {{
{lines}
}} {name}_state;

/* What a step returns. */
#define {upper}_OK 0
#define {upper}_ENDED 1       /* the reference has ended: it stays as it is */
#define {upper}_REFUSED (-1)  /* a null pointer, or a number that is not finite: state kept, last input held */
#define {upper}_NOT_READY (-2) /* no init before, or the state was overwritten: u = 0 */

/* Make a state ready: {name}_reset does the same, to start anew. -1 for a null pointer. */
int {name}_init({name}_state *state);
int {name}_reset({name}_state *state);

/* Run once: read y and ref, write u, which is to be put out now. */
int {name}_step({name}_state *state, const {name}_real y[],
    const {name}_real ref[], {name}_real u[]);

#endif
"""
    )


def _comment(c: CSource) -> str:
    """Return the comment at the top: what it is, what is proved, sizes, signals."""
    of, part, units = c.program.sizes, c.file, c.file.plant.units
    multiplications, additions, comparisons = c.operations
    reference = ", ".join(c.program.reference) if c.given else "made inside; NULL will do"
    signals = [
        f"{signal} ({units[signal]})" if signal in units else signal
        for signal in (*part.plant.outputs, *part.plant.inputs)
    ]
    y, u = ", ".join(signals[: of["q"]]), ", ".join(signals[of["q"] :])
    proved = "\n".join(f" * NOT PROVED: {_said(line)}" for line in c.unproved) or "\n".join(
        [
            " * Proved for the gains as printed, in continuous time: certificate.json.",
            *(f" * {_said(claim)}" for claim in c.claims),
            " * The loop that is sampled is not proved for switching between cells: docs/arithmetic.md of pwatrack.",
        ]
    )
    return f"""/*
 * {_said(part.name)}
 *
 * Run once every {c.program.sampling.sample_time!r} s.
 * Written by pwatrack. It belongs to its user: see LICENSE-EXCEPTION of pwatrack.
{proved}
 *
 * Spec         sha256 {part.spec_sha256}
 * Certificate  sha256 {part.proof}
 * Controller   sha256 {part.sha256}
 *
 * State        {c.state_bytes} bytes
 * Constants    {c.constant_bytes} bytes
 * One step     at most {multiplications} products and quotients, {additions} sums, {comparisons} comparisons of floats
 *
 * y            {_said(y)}
 * ref          {_said(reference)}
 * u            {_said(u)}
 */
"""


def _array(field: str) -> bool:
    return field in ("v", "copies", "late", "before", "wanted", "x_d")


def _said(text: str) -> str:
    """Return a text as it may stand in a comment."""
    return re.sub(r"[^ -~]", "?", text).replace("*/", "* /").replace("/*", "/ *")
