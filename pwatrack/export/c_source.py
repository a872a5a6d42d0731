"""A controller as C99: header and source of the program of `docs/arithmetic.md`."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.export.notation import most
from pwatrack.export.source import Source
from pwatrack.export.step import Kind, Step, Variable, step

_PREFIX = 20  # letters at most: C99 tells 31 letters of a name apart
_FILES = "main vector model instance fmi2 fmi3"  # that an export has besides
_HEADERS = """
assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic
stdbool stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype
"""
_TARGETS = "all check clean help install package replay test"  # of make and CMake
_TAKEN = frozenset(f"{_FILES} {_HEADERS} {_TARGETS}".split())


@dataclass(frozen=True, kw_only=True)
class CSource(Source):
    """What is written in C."""

    def numbers(self, values: Any) -> str:
        """Return an array as a C initialiser; each number is the shortest decimal that gives it."""
        return initialiser(values, single=self.single)

    @cached_property
    def step(self) -> Step:
        """What it does."""
        return step(self)

    @property
    def types(self) -> dict[Kind, str]:
        """The types of C."""
        return {"real": f"{self.name}_real", "whole": "int32_t", "side": "int8_t", "flag": "uint32_t"}

    def declared(self, variable: Variable) -> str:
        """Return the declaration of a variable."""
        length = f"[{variable.length}]" if variable.length else ""
        return f"{self.types[variable.kind]} {variable.name}{length};" + f" /* {variable.what} */" * bool(variable.what)

    @property
    def state(self) -> tuple[Variable, ...]:
        """The fields of the state."""
        return (*self.step.kept, Variable("ready", "flag", what="set by init"))

    @property
    def widths(self) -> dict[Kind, int]:
        """Bytes of a number of each type."""
        return {"real": 4 if self.single else 8, "whole": 4, "side": 1, "flag": 4}

    @property
    def constant_bytes(self) -> int:
        """Bytes of all constants."""
        return sum(values.size * self.widths[kind] for kind, values in self.step.constants.values())

    @property
    def state_bytes(self) -> int:
        """Bytes of the state."""
        size, width = sum((v.length or 1) * self.widths[v.kind] for v in self.state), self.widths["real"]
        return -(-size // width) * width

    @property
    def operations(self) -> tuple[int, int, int]:
        """The most products and quotients, sums, and comparisons of floats in one step."""
        known, variables = self.step.constants, (*self.step.kept, *self.step.own)
        reals = {"y", "u", "given", *(name for name, (kind, _) in known.items() if kind == "real")}
        found = most(self.step.body, reals | {variable.name for variable in variables if variable.kind == "real"})
        return found["*"] + found["/"], found["+"] + found["-"], found["<"]


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
    lines = "\n".join(f"    {c.declared(variable)}" for variable in c.state)
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

#ifdef __cplusplus
extern "C" {{
#endif

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

#ifdef __cplusplus
}}
#endif

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
