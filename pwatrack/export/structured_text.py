"""A controller as a function block in Structured Text of IEC 61131-3: no pointer, no function, nothing of a vendor."""

from pathlib import Path
from textwrap import indent, wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pwatrack.export.notation import Language, names, printed
from pwatrack.export.source import Source, said
from pwatrack.export.step import Kind, Variable, step

ST = Language(
    assign="{} := {};",
    loop="FOR {} := {} TO {} DO\n{}\nEND_FOR;",
    branch="IF {} THEN\n{}\n",
    other="ELSIF {} THEN\n{}\n",
    otherwise="ELSE\n{}\n",
    end="END_IF;",
    words={"and": "AND", "or": "OR", "not": "NOT ", "==": "=", "True": "TRUE", "False": "FALSE"},
    remainder="{} MOD {}",
    name=str,
    element="{}[{}]",
    from_one=False,
    comment="(* {} *)",
    once="{0} := {1};\n{2}",  # there are compilers that run a loop from 0 to 0 no time
)
_LARGEST = "largest"
_OUT = ("wanted", "cell", "cell_d", "status")  # of what it remembers, what is put out

_BLOCK = """\
(*
{about}

Call {name} once in that time. u is what is to be put out now. While `reset` is TRUE it starts anew in every call; the
first call starts it in any case. Each product and each sum is rounded by itself, to nearest, in {real}.
*)
FUNCTION_BLOCK {name}
VAR_INPUT
{inputs}
END_VAR
VAR_OUTPUT
{outputs}
END_VAR
VAR CONSTANT
{constants}
END_VAR
VAR
{variables}
END_VAR

{largest}
IF reset OR (NOT ready) THEN
{begin}
    ready := TRUE;
END_IF;
{body}
END_FUNCTION_BLOCK
"""


def function_block(source: Source) -> str:
    """Return a controller as a function block."""
    found, of = step(source), source.program.sizes
    used, floats = names(found.body), "REAL" if source.single else "LREAL"
    types: dict[Kind, str] = {"real": floats, "whole": "DINT", "side": "SINT", "flag": "BOOL"}

    def declared(variable: Variable) -> str:
        kind = types[variable.kind]
        kind = f"ARRAY[0..{variable.length - 1}] OF {kind}" if variable.length else kind
        return f"    {variable.name} : {kind};" + f" (* {variable.what} *)" * bool(variable.what)

    plant, lines = source.file.plant, source.about()
    inputs = [Variable("y", "real", of["q"], "measured"), Variable("reset", "flag", what="start anew")]
    if source.given:
        inputs.insert(1, Variable("given", "real", of["s"], "reference: ref above"))
    outputs = [Variable("u", "real", of["m"], "to be put out now"), *(v for v in found.kept if v.name in _OUT)]
    own = [*(v for v in found.kept if v.name not in _OUT), Variable("ready", "flag", what="whether it was started")]
    own += [variable for variable in found.own if variable.name in used]
    own.append(Variable(_LARGEST, "real", what="number"))
    cells = ", ".join(f"{k} {name}" for k, name in enumerate(plant.cells))
    return _BLOCK.format(
        name=f"FB_{source.name}",
        about="\n".join([*lines, *wrap(said(f"cells        {cells}"), 118, subsequent_indent=" " * 13)]),
        real=floats,
        inputs="\n".join(map(declared, inputs)),
        outputs="\n".join(map(declared, outputs)),
        constants="\n".join(
            _constant(name, types[kind], values) for name, (kind, values) in found.constants.items() if name != _LARGEST
        ),
        variables="\n".join(map(declared, own)),
        largest=_largest(source),
        begin=indent(printed(found.begin, ST), "    "),
        body=printed(found.body, ST),
    )


def _largest(source: Source) -> str:
    """Return what sets the largest number: as a product, since there are compilers that refuse it as it is written."""
    finfo = np.finfo(source.real)
    factors = source.real(2.0 - finfo.eps), source.real(2.0) ** (finfo.maxexp - 1)
    return f"{_LARGEST} := {' * '.join(map(_number, factors))};"


def _constant(name: str, kind: str, values: NDArray[Any]) -> str:
    numbers = [_number(value) for value in values.reshape(-1)]
    if not values.ndim:
        return f"    {name} : {kind} := {numbers[0]};"
    places = ", ".join(f"0..{size - 1}" for size in values.shape)
    rows = "\n".join(wrap(", ".join(numbers), 112, initial_indent=" " * 8, subsequent_indent=" " * 8))
    return f"    {name} : ARRAY[{places}] OF {kind} := [\n{rows}];"


def _number(value: Any) -> str:
    """Return a number as a literal; a float as the shortest decimal that gives it, with a point and no small e."""
    text = str(value)
    if not isinstance(value, np.floating):
        return text
    digits, _, power = text.partition("e")
    digits = digits if "." in digits else f"{digits}.0"
    return digits + (f"E{int(power)}" if power else "")


def write_structured_text(source: Source, out: Path) -> list[str]:
    """Write the function block to a folder and return the name of the file."""
    text, name = function_block(source), f"{source.name}.st"
    out.mkdir(parents=True, exist_ok=True)
    (out / name).write_text(text, encoding="ascii")
    return [name]
