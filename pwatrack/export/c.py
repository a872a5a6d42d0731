"""A controller in C99: header and source, and beside them a test vector, build files and a page of advice."""

import re
from collections.abc import Set
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pwatrack.export.controller import Controller
from pwatrack.export.notation import Language, most, names, printed
from pwatrack.export.reading import run
from pwatrack.export.source import Source, Vector, said, template, write_texts
from pwatrack.export.step import PRODUCT, Kind, Step, Variable

FLAGS = "-std=c99 -Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Werror -ffp-contract=off"
_WIDTHS = {True: (0, 16, 32), False: (0, 1, 16, 32, 64)}  # of FLT_EVAL_METHOD: these leave floats, or doubles, alone
_BESIDE = {"main.c": "c_main.c", "Makefile": "c_makefile", "CMakeLists.txt": "c_cmake.txt", "README.md": "c_readme.md"}
_FLOATS = """Every bit is that of the simulation, whatever the level of optimization is: the source itself keeps
  the compiler from fusing products with sums, and does not compile with `-ffast-math`."""
_WHOLE = """All numbers are whole ones of 32 bits, their sums of 64: no float is needed. What 1 of a signal is stands in
  the header. What is out of 32 bits is cut off at their ends, and refused."""


def write(source: Source, vector: Vector, out: Path) -> list[str]:
    """Write all files to a folder and return their names."""
    name, whole = source.name, source.whole
    if whole is None:
        controller = Controller(source.file, single=source.single)
        y, w = vector.y.astype(source.real), vector.w.astype(source.real)
        u = np.array([controller.step(y[k], w[k] if source.given else None) for k in range(len(y))])
    else:
        y, w = whole.counts("y", vector.y), whole.counts("w", vector.w)
        u = run(whole.step, y, w)["u"]
    texts = {f"{name}.h": header(source), f"{name}.c": code(source)}
    values = {"name": name, "upper": name.upper(), "flags": FLAGS, **_advice(source, vector)}
    beside = {file: template(form, **values) for file, form in _BESIDE.items()}
    arrays = {"y": y, "u": u} | ({"w": w} if source.given else {})
    return write_texts(texts | {"vector.h": _vector(source, arrays)} | beside, out)


def header(source: Source) -> str:
    """Return the header."""
    of, (state, constants) = source.program.sizes, _bytes(source)
    found = source.step
    reals = {"y", "u", "given", *(name for name, (kind, _) in found.constants.items() if kind == "real")}
    counts = most(found.body, reals | {v.name for v in (*found.kept, *found.own) if v.kind in ("real", "wide")})
    sizes = (
        f"State        {state} bytes",
        f"Constants    {constants} bytes",
        f"One step     at most {counts['*'] + counts['/']} products, quotients and roots, {counts['+'] + counts['-']} "
        f"sums, {counts['<']} comparisons of {'floats' if source.whole is None else 'whole numbers'}",
    )
    about = source.about(sizes, "made inside; NULL will do")
    values = {
        "comment": "\n".join(["/*", *(f" * {line}".rstrip() for line in about), " */"]),
        "name": source.name,
        "upper": source.name.upper(),
        "q": of["q"],
        "m": of["m"],
        "s": len(source.program.given),
        "state_bytes": state,
        "constant_bytes": constants,
        "real": "int32_t" if source.whole is not None else "float" if source.single else "double",
        "units": _units(source),
        "refused": "not finite" if source.whole is None else "out of range",
        "lines": "\n".join(f"    {_declared(source, variable)}" for variable in _state(source.step)),
    }
    return template("c_header.h", **values)


def code(source: Source) -> str:
    """Return the source."""
    found = source.step
    language, real = _language(source), f"{source.name}_real"
    used = names(found.body) - {f"new_{variable.name}" for variable in found.kept}

    def lines(text: str, depth: int) -> str:
        return indent(printed(text, language), "    " * depth)

    values = {
        "name": source.name,
        "upper": source.name.upper(),
        "real": real,
        "zero": language.words["0.0"],
        "m": source.program.sizes["m"],
        **_arithmetic(source, used),
        "constants": "\n".join(_constant(source, name) for name in found.constants),
        "sizes": " + ".join(f"sizeof({name})" for name in found.constants),
        "own": "\n".join(
            f"    {'ROUNDED ' * (v.name == PRODUCT and v.kind == 'real')}{_declared(source, v)}"
            for v in found.own
            if v.name in used
        ),
        "hold": lines(found.hold, 1),
        "body": lines(found.body, 1),
        "begin": lines(found.begin, 2),
        "ref": f", const {real} ref[]" if source.given else "",
        "pass_ref": ", ref" if source.given else "",
        "unused": "" if source.given else "    (void)ref;\n",
        "missing": "(y == NULL) || (ref == NULL)" if source.given else "y == NULL",
    }
    return template("c_source.c", **values)


def _units(source: Source) -> str:
    if source.whole is None:
        return ""
    plant = source.file.plant
    names = [("Y", "y", plant.outputs), ("U", "u", plant.inputs), ("X_HAT", "x_hat", plant.states)]
    names += [("REF", "w", list(source.program.given))] * source.given
    lines = [
        f"#define {source.name.upper()}_{short}{k}_UNIT {float(unit)!r} /* {said(shown)} */"
        for short, kind, each in names
        for k, (unit, shown) in enumerate(zip(source.whole.units[kind], source.signals(each), strict=True))
    ]
    return "\n/* What 1 of a number is. */\n" + "\n".join(lines) + "\n"


def _arithmetic(source: Source, used: Set[str]) -> dict[str, str]:
    """Return what a source needs for its numbers, and how they are rounded."""
    if source.whole is not None:
        operations = template("c_whole.c") + template("c_steps.c") * ("stepped" in used)
        return {"headers": "", "arithmetic": "", "operations": operations, "rounded": "sums have 64 bits"}
    widths = " && ".join(f"(FLT_EVAL_METHOD != {method})" for method in _WIDTHS[source.single])
    return {
        "headers": "#include <float.h>\n" + "#include <math.h>\n" * ("sqrt" in used),
        "arithmetic": template("c_floats.c", widths=widths),
        "operations": "",
        "rounded": "each product and each sum is rounded by itself",
    }


def initialiser(values: Any, *, single: bool = False) -> str:
    """Return an array as a C initialiser; each number is the shortest decimal that gives it, or is whole.

    Example:
        >>> initialiser([[1.0, 0.1], [1e-300, 2.0]]), initialiser(0.1, single=True)
        ('{{1.0, 0.1}, {1e-300, 2.0}}', '0.1f')
    """
    if np.ndim(values):
        return "{" + ", ".join(initialiser(value, single=single) for value in values) + "}"
    if np.asarray(values).dtype.kind == "i":
        return str(int(values))
    text = str((np.float32 if single else np.float64)(values))
    return (text if re.search(r"[.e]", text) else f"{text}.0") + "f" * single


def _bytes(source: Source) -> tuple[int, int]:
    """Return the bytes of the state, which are a multiple of those of a float, and of the constants."""
    real = 4 if source.single or source.whole is not None else 8
    widths: dict[Kind, int] = {"real": real, "wide": 8, "whole": 4, "side": 1, "flag": 4}
    state = sum((variable.length or 1) * widths[variable.kind] for variable in _state(source.step))
    return -(-state // real) * real, sum(v.size * widths[kind] for kind, v in source.step.constants.values())


def _types(source: Source) -> dict[Kind, str]:
    return {"real": f"{source.name}_real", "wide": "int64_t", "whole": "int32_t", "side": "int8_t", "flag": "uint32_t"}


def _state(found: Step) -> tuple[Variable, ...]:
    return (*found.kept, Variable("ready", "flag", what="set by init"))


def _declared(source: Source, variable: Variable) -> str:
    length = f"[{variable.length}]" if variable.length else ""
    what = f" /* {variable.what} */" * bool(variable.what)
    return f"{_types(source)[variable.kind]} {variable.name}{length};{what}"


def _language(source: Source) -> Language:
    """Return C, with what is remembered in `state`, and what it will be in `next`."""
    kept, suffix = {variable.name for variable in source.step.kept}, "f" * source.single

    def name(text: str) -> str:
        if text in kept:
            return f"state->{text}"
        new = text.removeprefix("new_")
        return f"next.{new}" if new != text else "ref" if text == "given" else text

    return Language(
        assign="{} = {};",
        loop="for ({0} = {1}; {0} <= {2}; {0}++) {{\n{3}\n}}",
        branch="if ({}) {{\n{}\n}}\n",
        other="else if ({}) {{\n{}\n}}\n",
        otherwise="else {{\n{}\n}}\n",
        end="",
        within="/* within */",
        truth="{} != 0u",
        words={"and": "&&", "or": "||", "not": "!", "True": "1u", "False": "0u", "sqrt": f"sqrt{suffix}"}
        | {"wide": "(int64_t)", **({} if source.whole is None else {"0.0": "0"})}
        | {text: f"{text}{suffix}" for text in ("0.0", "1.0")},
        remainder="{} % {}",
        name=name,
        element="{}[{}]",
        between="][",
        from_one=False,
        comment="/* {} */",
    )


def _constant(source: Source, name: str) -> str:
    kind, values = source.step.constants[name]
    rows = initialiser(values, single=source.single).replace("}, {", "},\n    {")
    return f"static const {_types(source)[kind]} {name}{_shape(values)} =\n    {rows};"


def _vector(source: Source, arrays: dict[str, Any]) -> str:
    lines = [f'#include "{source.name}.h"\n', f"#define VECTOR_STEPS {len(arrays['y'])}\n"]
    for name, values in arrays.items():
        rows = ",\n    ".join(initialiser(row, single=source.single) for row in values)
        lines.append(f"static const {source.name}_real vector_{name}{_shape(values)} = {{\n    {rows}}};\n")
    return "\n".join(lines)


def _shape(values: NDArray[Any]) -> str:
    return "".join(f"[{size}]" for size in values.shape)


def _advice(source: Source, vector: Vector) -> dict[str, object]:
    plant, program, (state, constants) = source.file.plant, source.program, _bytes(source)
    proved = (
        "It is NOT PROVED: " + "; ".join(source.unproved) + "."
        if source.unproved
        else " ".join(["K and L of its design are proved in continuous time.", *source.claims])
    )
    failed = f"Its run FAILED: {'; '.join(source.file.failed)}. " if source.file.failed else ""
    reference = "The reference is made inside, from the first step on; pass NULL for it."
    if source.given:
        reference = f"`ref` is, in this order: {source.entries}."
    late = program.sampling.delay
    return {
        "title": source.file.name,
        "proved": failed + proved,
        "bytes": state,
        "constants": constants,
        "h": repr(program.sampling.sample_time),
        "y": ", ".join(source.signals(plant.outputs)),
        "u": ", ".join(source.signals(plant.inputs)),
        "ref": "ref" if source.given else "NULL",
        "vector_ref": "vector_w[k]" if source.given else "NULL",
        "reference": reference,
        "late": f", and that it is put out {late} samples late" if late else "",
        "first": source.routine.at.x_hat,
        "vector": vector.origin,
        "refused": "not finite" if source.whole is None else "out of range",
        "every_bit": _FLOATS if source.whole is None else _WHOLE,
    }
