"""A controller as C99: header and source of the program of `docs/arithmetic.md`."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from pwatrack.export.source import Source

_PREFIX = 20  # letters at most: C99 tells 31 letters of a name apart


@dataclass(frozen=True, kw_only=True)
class CSource(Source):
    """What is written in C."""

    def numbers(self, values: Any) -> str:
        """Return an array as a C initialiser; each number is the shortest decimal that gives it."""
        return initialiser(values, single=self.single)

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


def initialiser(values: Any, *, single: bool = False) -> str:
    """Return an array as a C initialiser; each number is the shortest decimal that gives it.

    Example:
        >>> initialiser([[1.0, 0.1], [1e-300, 2.0]]), initialiser(0.1, single=True)
        ('{{1.0, 0.1}, {1e-300, 2.0}}', '0.1f')
    """
    if np.ndim(values):
        return "{" + ", ".join(initialiser(value, single=single) for value in values) + "}"
    text = str((np.float32 if single else np.float64)(values))
    return (text if re.search(r"[.e]", text) else f"{text}.0") + "f" * single


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
    multiplications, additions, comparisons = c.operations
    sizes = (
        f"State        {c.state_bytes} bytes",
        f"Constants    {c.constant_bytes} bytes",
        f"One step     at most {multiplications} products and quotients, {additions} sums, {comparisons} comparisons"
        " of floats",
    )
    lines = c.about(sizes, "made inside; NULL will do")
    return "\n".join(["/*", *(f" * {line}".rstrip() for line in lines), " */", ""])


def _array(field: str) -> bool:
    return field in ("v", "copies", "late", "before", "wanted", "x_d")
