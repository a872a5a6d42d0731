"""A folder around a controller in C99: a test vector and what replays it, build files, a page of advice."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pwatrack.export.c_source import CSource, header
from pwatrack.export.c_step import source
from pwatrack.export.controller import Controller
from pwatrack.export.source import Vector

FLAGS = "-std=c99 -Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Werror -ffp-contract=off"

_MAIN = """/* Replay vector.h: every input must come out as it is there, in every bit. */
#include "{name}.h"
#include "vector.h"

#include <stdio.h>
#include <string.h>

int main(void)
{{
    {name}_state state;
    {name}_real u[{upper}_INPUTS];
    long wrong = 0;
    long k;

    if ({name}_init(&state) != {upper}_OK) {{
        wrong++;
    }}
    for (k = 0; k < VECTOR_STEPS; k++) {{
        const int status = {name}_step(&state, vector_y[k], {ref}, u);
        if ((status < {upper}_OK) || (memcmp(u, vector_u[k], sizeof u) != 0)) {{
            wrong++;
        }}
    }}
    (void)printf("%ld steps, %ld wrong; state %lu bytes, constants %lu bytes\\n", k, wrong,
                 (unsigned long)sizeof(state), (unsigned long){upper}_CONSTANT_BYTES);
    return (wrong == 0) ? 0 : 1;
}}
"""

_MAKEFILE = """# 'make' builds the replay of the test vector, 'make check' runs it.
CC ?= cc
CFLAGS ?= -O2
ALL_CFLAGS = {flags} $(CFLAGS)

replay: main.c vector.h {name}.c {name}.h
\t$(CC) $(ALL_CFLAGS) -o $@ main.c {name}.c

.PHONY: check clean
check: replay
\t./replay
clean:
\trm -f replay
"""

_CMAKE = """cmake_minimum_required(VERSION 3.10)
project({name} C)
set(CMAKE_C_STANDARD 99)
add_library({name} STATIC {name}.c)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
if(NOT MSVC)
  target_compile_options({name} PRIVATE -ffp-contract=off)
endif()
add_executable(replay main.c)
target_link_libraries(replay PRIVATE {name})
enable_testing()
add_test(NAME replay COMMAND replay)
"""

_README = """# {name}

The controller of "{title}" in C99. {proved}

    {name}_state state;              /* {bytes} bytes, yours: static, on a stack, as many as you like */
    {name}_init(&state);
    every {h} s:
        y = what is measured now     /* {y} */
        status = {name}_step(&state, y, {ref}, u);
        put u out at once            /* {u} */

{reference}

- `status` is 0; 1 where the reference has ended (it stays as it was, and no theorem speaks of that); -1 for a null
  pointer or a number that is not finite: the state is as it was and u is the last input again; -2 where the state was
  not made ready, or overwritten: u is 0. `state.status` keeps the last one.
- `state.cell` and `state.cell_d` are the cells that the observer and the desired state are in; `state.wanted` is the
  input before its limits. The observer is told the input that is put out, with its limits{late}.
- After `{name}_init` the observer starts where the spec says. To start it elsewhere, write x_hat into
  `state.v` from entry {first} on, before the first step.
- No memory is allocated, nothing is global, no loop is unbounded. The constants are read-only, {constants} bytes.
- Every bit is that of the simulation, whatever the level of optimization is: the source itself keeps the compiler from
  fusing products with sums, and does not compile with `-ffast-math`. `make check` replays `vector.h`, which is from
  {vector}.
"""


def write_c(c: CSource, vector: Vector, out: Path) -> list[str]:
    """Write all files to a folder and return their names."""
    controller = Controller(c.file, single=c.single)
    y, w = vector.y.astype(c.real), vector.w.astype(c.real)
    u = np.array([controller.step(y[k], w[k] if c.given else None) for k in range(len(y))])
    name, names = c.name, {"name": c.name, "upper": c.name.upper(), "flags": FLAGS}
    texts = {
        f"{name}.h": header(c),
        f"{name}.c": source(c),
        "main.c": _MAIN.format(**names, ref="vector_w[k]" if c.given else "NULL"),
        "vector.h": _vector(c, y, w if c.given else None, u),
        "Makefile": _MAKEFILE.format(**names),
        "CMakeLists.txt": _CMAKE.format(**names),
        "README.md": _readme(c, vector),
    }
    out.mkdir(parents=True, exist_ok=True)
    for file, text in texts.items():
        (out / file).write_text(text, encoding="utf-8")
    return list(texts)


def _vector(c: CSource, y: NDArray[Any], w: NDArray[Any] | None, u: NDArray[Any]) -> str:
    arrays = {"y": y, "u": u} | ({} if w is None else {"w": w})
    lines = [f'#include "{c.name}.h"\n', f"#define VECTOR_STEPS {len(y)}\n"]
    for name, values in arrays.items():
        rows = ",\n    ".join(c.numbers(row) for row in values)
        lines.append(
            f"static const {c.name}_real vector_{name}[{values.shape[0]}][{values.shape[1]}] = {{\n    {rows}}};\n"
        )
    return "\n".join(lines)


def _readme(c: CSource, vector: Vector) -> str:
    plant, program, of = c.file.plant, c.program, c.program.sizes
    late = program.sampling.delay
    proved = (
        "It is NOT PROVED: " + "; ".join(c.unproved) + "."
        if c.unproved
        else " ".join(
            [
                "Its gains are proved in continuous time; that the sampled loop is stable was looked at cell by cell.",
                *c.claims,
            ]
        )
    )
    reference = "The reference is made inside, from the first step on; pass NULL for it."
    if c.given:
        reference = f"`ref` is, in this order: {', '.join(program.reference)}."

    failed = f"Its run FAILED: {'; '.join(c.file.failed)}. " if c.file.failed else ""
    return _README.format(
        name=c.name,
        title=c.file.name,
        proved=failed + proved,
        bytes=c.state_bytes,
        constants=c.constant_bytes,
        h=repr(program.sampling.sample_time),
        y=", ".join(c.signals(plant.outputs)),
        u=", ".join(c.signals(plant.inputs)),
        ref="ref" if c.given else "NULL",
        reference=reference,
        late=f", and that it is put out {late} samples late" if late else "",
        first=of["q"] + of["m"],
        vector=vector.origin,
    )
