"""A controller as a function block in Structured Text of IEC 61131-3: no pointer, no function, nothing of a vendor."""

from collections.abc import Iterable
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from textwrap import indent, wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pwatrack.export.iec_names import FIXED, Names, Signal, block_names
from pwatrack.export.notation import Language, names, printed
from pwatrack.export.source import Source, said
from pwatrack.export.step import Kind, Step, Variable, step

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
_LARGEST, _READY = "largest", "ready"

_BLOCK = """\
(*
{about}

Call {name} once in that time. While `reset` is TRUE it starts anew in every call; the first call starts it in any case.
Each product and each sum is rounded by itself, to nearest, in {real}.
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

{read}
{largest}
IF reset OR (NOT {ready}) THEN
{begin}
    {ready} := TRUE;
END_IF;
{body}
{put_out}
END_FUNCTION_BLOCK
"""

_PROGRAM = """\
(* A program that calls {block}: tie its variables to inputs and outputs, and call it once every {time}. *)
PROGRAM {program}
VAR
    {instance} : {block};
{variables}
END_VAR

{instance}({inputs});
{outputs}
END_PROGRAM

(*
The task, where it is not set in a menu but pasted: take it out of this comment.

CONFIGURATION CONF_{name}
    RESOURCE RES_{name} ON PLC
        TASK TASK_{name}(INTERVAL := T#{time}, PRIORITY := 0);
        PROGRAM RUN_{name} WITH TASK_{name} : {program};
    END_RESOURCE
END_CONFIGURATION
*)
"""


def function_block(source: Source) -> str:
    """Return a controller as a function block."""
    found, of = step(source), source.program.sizes
    called, used, floats = _called(source, found), names(found.body), _floats(source)
    types: dict[Kind, str] = {"real": floats, "whole": "DINT", "side": "SINT", "flag": "BOOL"}

    def declared(variable: Variable) -> str:
        kind = types[variable.kind]
        kind = f"ARRAY[0..{variable.length - 1}] OF {kind}" if variable.length else kind
        return _declared(called.own.get(variable.name, variable.name), kind, variable.what)

    own = [Variable("y", "real", of["q"], "inputs"), Variable("u", "real", of["m"], "outputs")]
    own += [Variable("given", "real", of["s"], "inputs")] if source.given else []
    own += [*(v for v in found.kept if v.name not in FIXED), Variable(_READY, "flag", what="whether it was started")]
    own += [variable for variable in found.own if variable.name in used]
    own.append(Variable(_LARGEST, "real", what="number"))
    language = replace(ST, name=called.own.__getitem__)
    return _BLOCK.format(
        name=called.block,
        about="\n".join([*source.about(), *wrap(said(_cells(source)), 118, subsequent_indent=" " * 13)]),
        real=floats,
        inputs="\n".join([*_signals(called.inputs, floats), declared(Variable("reset", "flag", what="start anew"))]),
        outputs="\n".join([*_signals(called.outputs, floats), *(declared(v) for v in found.kept if v.name in FIXED)]),
        constants="\n".join(
            _constant(called.own[name], types[kind], values)
            for name, (kind, values) in found.constants.items()
            if name != _LARGEST
        ),
        variables="\n".join(map(declared, own)),
        read="\n".join(f"{_entry(called, signal)} := {signal.called};" for signal in called.inputs),
        largest=f"{called.own[_LARGEST]} := {_largest(source)};",
        ready=called.own[_READY],
        begin=indent(printed(found.begin, language), "    "),
        body=printed(found.body, language),
        put_out="\n".join(f"{signal.called} := {_entry(called, signal)};" for signal in called.outputs),
    )


def program_text(source: Source) -> str:
    """Return a program with an instance of the block, and a task of its sample time in a comment."""
    called, floats = _called(source, step(source)), _floats(source)
    put_out = [signal for signal in called.outputs if signal.entry[0] == "u"]
    assigned = [*(signal.called for signal in called.inputs), "reset"]
    read = [*((signal.called, signal.called) for signal in put_out), (called.fault, "status < 0")]
    variables = [
        *_signals((*called.inputs, *put_out), floats),
        _declared("reset", "BOOL", "start anew"),
        _declared(called.fault, "BOOL", "a number is not finite, or the memory was overwritten"),
    ]
    milliseconds = Decimal(repr(source.program.sampling.sample_time)).scaleb(3).normalize()
    return _PROGRAM.format(
        name=source.name,
        block=called.block,
        program=called.program,
        instance=called.instance,
        variables="\n".join(variables),
        inputs=", ".join(f"{name} := {name}" for name in assigned),
        outputs="\n".join(f"{name} := {called.instance}.{value};" for name, value in read),
        time=f"{milliseconds:f}ms",
    )


def _called(source: Source, found: Step) -> Names:
    variables = (*found.kept, *found.own)
    own = ["y", "u", "given", _READY, _LARGEST, *found.constants, *(variable.name for variable in variables)]
    return block_names(source, dict.fromkeys(own))


def _floats(source: Source) -> str:
    return "REAL" if source.single else "LREAL"


def _cells(source: Source) -> str:
    return "cells        " + ", ".join(f"{k} {name}" for k, name in enumerate(source.file.plant.cells))


def _signals(signals: Iterable[Signal], floats: str) -> list[str]:
    return [_declared(signal.called, floats, signal.what) for signal in signals]


def _declared(name: str, kind: str, what: str) -> str:
    return f"    {name} : {kind};" + f" (* {what} *)" * bool(what)


def _entry(called: Names, signal: Signal) -> str:
    array, place = signal.entry
    return f"{called.own[array]}[{place}]"


def _largest(source: Source) -> str:
    """Return the largest number: as a product, since there are compilers that refuse it as it is written."""
    finfo = np.finfo(source.real)
    factors = source.real(2.0 - finfo.eps), source.real(2.0) ** (finfo.maxexp - 1)
    return " * ".join(map(_number, factors))


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
    """Write the function block, and a program that calls it, to a folder and return the names of the files."""
    texts = {f"{source.name}.st": function_block(source), f"{source.name}_program.st": program_text(source)}
    out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (out / name).write_text(text, encoding="ascii")
    return [*texts]
