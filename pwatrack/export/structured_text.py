"""A controller as a function block in Structured Text of IEC 61131-3: no pointer, no function, nothing of a vendor."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from textwrap import indent, wrap
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pwatrack.export.notation import Language, names, printed
from pwatrack.export.source import Source, Vector, in_ascii, reference_unit, said, template, write_texts
from pwatrack.export.step import Kind, Variable

ST = Language(
    assign="{} := {};",
    loop="FOR {} := {} TO {} DO\n{}\nEND_FOR;",
    branch="IF {} THEN\n{}\n",
    other="ELSIF {} THEN\n{}\n",
    otherwise="ELSE\n{}\n",
    end="END_IF;",
    words={"and": "AND", "or": "OR", "not": "NOT ", "==": "=", "True": "TRUE", "False": "FALSE", "sqrt": "SQRT"},
    remainder="{} MOD {}",
    name=str,
    element="{}[{}]",
    from_one=False,
    comment="(* {} *)",
    once="{0} := {1};\n{2}",  # there are compilers that run a loop from 0 to 0 no time
)
_LARGEST, _READY = "largest", "ready"
_POWER = 120  # of 2 that a number of an expression has at most: also a REAL holds it

# Words of the 2nd and 3rd edition, and what CODESYS, TwinCAT and matiec take besides; of the letters that stand for
# qualifiers and operators those that such tools refuse as variables.
KEYWORDS = frozenset(template("st_keywords.txt").split())
FIXED = ("reset", "cell", "cell_d", "status")  # inputs and outputs of a block that are no signals
_OWN = {"y": "measured", "u": "put_out", "given": "from_outside"}  # arrays of the notation, in a block its own


@dataclass(frozen=True)
class Port:
    """An input or output of a block: what it is called, what it is in the notation, and what is said of it."""

    called: str
    entry: tuple[Literal["y", "given", "u", "wanted"], int]
    what: str


@dataclass(frozen=True)
class Names:
    """What all is called."""

    block: str  # the function block
    program: str  # a program with one
    inputs: tuple[Port, ...]  # signals, as the outputs
    outputs: tuple[Port, ...]
    own: dict[str, str]  # all other variables of the block, by what they are in the notation
    instance: str  # what a program has besides
    fault: str
    floats: str  # their type


def function_block(source: Source) -> str:
    """Return a controller as a function block."""
    found, of, called = source.step, source.program.sizes, _called(source)
    used, cells = names(found.body), ", ".join(f"{k} {name}" for k, name in enumerate(source.file.plant.cells))
    types: dict[Kind, str] = {"real": called.floats, "whole": "DINT", "side": "SINT", "flag": "BOOL"}

    def declared(variable: Variable) -> str:
        kind = types[variable.kind]
        kind = f"ARRAY[0..{variable.length - 1}] OF {kind}" if variable.length else kind
        return _declared(called.own.get(variable.name, variable.name), kind, variable.what)

    own = [Variable("y", "real", of["q"], "inputs"), Variable("u", "real", of["m"], "outputs")]
    own += [Variable("given", "real", len(source.program.given), "inputs")] if source.given else []
    own += [*(v for v in found.kept if v.name not in FIXED), Variable(_READY, "flag", what="whether it was started")]
    own += [variable for variable in found.own if variable.name in used]
    own.append(Variable(_LARGEST, "real", what="number"))
    language = replace(ST, name=called.own.__getitem__)
    return template(
        "st_block.st",
        name=called.block,
        about="\n".join([*source.about(), *wrap(said(f"cells        {cells}"), 118, subsequent_indent=" " * 13)]),
        real=called.floats,
        inputs="\n".join([*_signals(called, called.inputs), declared(Variable("reset", "flag", what="start anew"))]),
        outputs="\n".join([*_signals(called, called.outputs), *(declared(v) for v in found.kept if v.name in FIXED)]),
        constants="\n".join(
            _constant(called.own[name], types[kind], values)
            for name, (kind, values) in found.constants.items()
            if name != _LARGEST
        ),
        variables="\n".join(map(declared, own)),
        read="\n".join(f"{_entry(called, signal)} := {signal.called};" for signal in called.inputs),
        largest="\n".join(_largest(source, called.own[_LARGEST])),
        ready=called.own[_READY],
        begin=indent(printed(found.begin, language), "    "),
        body=printed(found.body, language),
        put_out="\n".join(f"{signal.called} := {_entry(called, signal)};" for signal in called.outputs),
    )


def program_text(source: Source) -> str:
    """Return a program with an instance of the block, and a task of its sample time in a comment."""
    called = _called(source)
    put_out = [signal for signal in called.outputs if signal.entry[0] == "u"]
    assigned = [*(signal.called for signal in called.inputs), "reset"]
    read = [*((signal.called, signal.called) for signal in put_out), (called.fault, "status < 0")]
    variables = [
        *_signals(called, (*called.inputs, *put_out)),
        _declared("reset", "BOOL", "start anew"),
        _declared(called.fault, "BOOL", "a number is not finite, or the memory was overwritten"),
    ]
    milliseconds = Decimal(repr(source.program.sampling.sample_time)).scaleb(3).normalize()
    return template(
        "st_program.st",
        name=source.name,
        block=called.block,
        program=called.program,
        instance=called.instance,
        variables="\n".join(variables),
        inputs=", ".join(f"{name} := {name}" for name in assigned),
        outputs="\n".join(f"{name} := {called.instance}.{value};" for name, value in read),
        time=f"{milliseconds:f}ms",
    )


def _signals(called: Names, signals: Iterable[Port]) -> list[str]:
    return [_declared(signal.called, called.floats, signal.what) for signal in signals]


def _declared(name: str, kind: str, what: str) -> str:
    return f"    {name} : {kind};" + f" (* {what} *)" * bool(what)


def _entry(called: Names, signal: Port) -> str:
    array, place = signal.entry
    return f"{called.own[array]}[{place}]"


def _largest(source: Source, name: str) -> Iterator[str]:
    """Yield what works out the largest number: matiec refuses a number in an expression that a REAL would not hold."""
    finfo = np.finfo(source.real)
    times, rest = divmod(finfo.maxexp - 1, _POWER)
    yield f"{name} := {_number(source.real(2.0 - finfo.eps))} * {_number(source.real(2.0) ** rest)};"
    for _ in range(times):
        yield f"{name} := {name} * {_number(source.real(2.0) ** _POWER)};"


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


def write(source: Source, vector: Vector, out: Path) -> list[str]:
    """Write the function block, and a program that calls it, to a folder and return the names of the files."""
    del vector  # nothing is said of what it would read in a test
    texts = {f"{source.name}.st": function_block(source), f"{source.name}_program.st": program_text(source)}
    return write_texts(texts, out)


def legal(name: str, taken: set[str]) -> str:
    """Return a name as an identifier that is not taken, and take it: cases are alike, `_` is between other signs.

    What is taken, in capitals, grows.

    Example:
        >>> taken = set(KEYWORDS)
        >>> [legal(name, taken) for name in ("F", "f", "in__1", "at", "dη/dt", "3", "_", "T_")]
        ['F', 'f_1', 'in_1', 'at_1', 'deta_dt', 'signal_3', 'signal', 'T']
    """
    text = re.sub(r"[^A-Za-z0-9]+", "_", in_ascii(name)).strip("_")
    text = text if text[:1].isalpha() else "_".join(filter(None, ["signal", text]))
    found, count = text, 0
    while found.upper() in taken:
        count += 1
        found = f"{text}_{count}"
    taken.add(found.upper())
    return found


def _called(source: Source) -> Names:
    """Return the names in a function block: signals keep theirs where these are legal, what is its own gives way."""
    plant, found = source.file.plant, source.step
    block, program = f"FB_{source.name}", f"PRG_{source.name}"
    taken = {*KEYWORDS, *(name.upper() for name in (*FIXED, block, program))}

    def unit(text: str) -> str:
        return f", in {said(text)}" if text else ""

    def signals(which: Literal["y", "u"], labels: Iterable[str], what: str) -> tuple[Port, ...]:
        ports = list[Port]()
        for k, label in enumerate(labels):
            called = legal(label, taken)
            also = "" if called == label else f"; {said(label)} in the spec"
            ports.append(Port(called, (which, k), what + units[label] + also))
        return tuple(ports)

    units = {label: unit(plant.units.get(label, "")) for label in (*plant.outputs, *plant.inputs)}
    y, u = signals("y", plant.outputs, "measured"), signals("u", plant.inputs, "to be put out now")
    given = tuple(
        Port(legal(f"ref_{w}", taken), ("given", k), f"reference: {said(w)}{unit(reference_unit(w, plant.units))}")
        for k, w in enumerate(source.program.given)
    )
    wanted = tuple(
        Port(legal(f"{one.called}_wanted", taken), ("wanted", k), "before its limits" + units[label])
        for k, (one, label) in enumerate(zip(u, plant.inputs, strict=True))
    )
    variables = (variable.name for variable in (*found.kept, *found.own))
    own = dict.fromkeys(["y", "u", "given", _READY, _LARGEST, *found.constants, *variables])
    called = {name: name if name in FIXED else legal(_OWN.get(name, name), taken) for name in own}
    instance, fault = legal("control", taken), legal("fault", taken)
    floats = "REAL" if source.single else "LREAL"
    return Names(block, program, (*y, *given), (*u, *wanted), called, instance, fault, floats)
