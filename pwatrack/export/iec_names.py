"""Names in IEC 61131-3: what signals are called in a function block, and what it then calls its own variables."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from pwatrack.export.source import Source, in_ascii, reference_unit, said

# Words of the 2nd and 3rd edition, and what CODESYS, TwinCAT and matiec take besides; of the letters that stand for
# qualifiers and operators those that such tools refuse as variables.
_WORDS = """
ABS ABSTRACT ACOS ACTION ADD ADR AND ANDN AND_THEN ANY ANY_BIT ANY_DATE ANY_INT ANY_NUM ANY_REAL ARRAY ASIN AT ATAN
ATAN2 BIT BITADR BOOL BY BYTE CAL CALC CALCN CASE CEIL CHAR CLASS CONCAT CONFIGURATION CONSTANT CONTINUE COS CTD CTU
CTUD DATE DATE_AND_TIME DELETE DINT DIV DO DT DWORD ELSE ELSIF EN END_ACTION END_CASE END_CLASS END_CONFIGURATION
END_FOR END_FUNCTION END_FUNCTIONBLOCK END_FUNCTION_BLOCK END_IF END_INTERFACE END_METHOD END_NAMESPACE END_PROGRAM
END_PROPERTY END_REPEAT END_RESOURCE END_STEP END_STRUCT END_TRANSITION END_TYPE END_UNION END_VAR END_WHILE ENO EQ
EXIT EXP EXPT EXTENDS FALSE FIND FINAL FLOOR FOR FROM FUNCTION FUNCTIONBLOCK FUNCTION_BLOCK F_EDGE F_TRIG GE GOTO GT IF
IMPLEMENTS INI INITIAL_STEP INSERT INT INTERFACE INTERNAL INTERVAL JMP JMPC JMPCN LD LDATE LDN LDT LE LEFT LEN LIMIT
LINT LN LOG LREAL LT LTIME LTOD LWORD MAX METHOD MID MIN MOD MOVE MUL MUX NAMESPACE NE NIL NON_RETAIN NOT NULL OF ON
OR ORN OR_ELSE OVERLAP OVERRIDE PARAMS PERSISTENT POINTER PRIORITY PRIVATE PROGRAM PROPERTY PROTECTED PUBLIC R
READ_ONLY READ_WRITE REAL REF REFERENCE REF_TO REPEAT REPLACE RESOURCE RET RETAIN RETC RETCN RETURN RIGHT ROL ROR RS
RTC R_EDGE R_TRIG S SEL SEMA SHL SHR SIN SINGLE SINT SIZEOF SQRT SR ST STEP STN STRING STRUCT SUB SUPER TAN TASK THEN
THIS TIME TIME_OF_DAY TO TOD TOF TON TP TRANSITION TRUE TRUNC TYPE UDINT UINT ULINT UNION UNTIL USING USINT VAR
VAR_ACCESS VAR_CONFIG VAR_EXTERNAL VAR_GLOBAL VAR_INPUT VAR_INST VAR_IN_OUT VAR_OUTPUT VAR_STAT VAR_TEMP WCHAR WHILE
WITH WORD WSTRING XOR XORN
"""
KEYWORDS = frozenset(_WORDS.split())
FIXED = ("reset", "cell", "cell_d", "status")  # inputs and outputs of a block that are no signals
_OWN = {"y": "measured", "u": "put_out", "given": "from_outside"}  # arrays of the notation, in a block its own


@dataclass(frozen=True)
class Signal:
    """An input or output of a block: what it is called, what it is in the notation, and what is said of it."""

    called: str
    entry: tuple[Literal["y", "given", "u", "wanted"], int]
    what: str


@dataclass(frozen=True)
class Names:
    """What all is called.

    Attributes:
        block, program: The function block, and a program with one.
        inputs, outputs: The signals.
        own: All other variables of the block, by what they are in the notation.
        instance, fault: What a program has besides.
    """

    block: str
    program: str
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    own: dict[str, str]
    instance: str
    fault: str


def legal(name: str, taken: set[str]) -> str:
    """Return a name as an identifier that is not taken, and take it: cases are alike, `_` is between other signs.

    Args:
        name: Any text.
        taken: What is taken, in capitals; it grows.

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


def block_names(source: Source, own: Iterable[str]) -> Names:
    """Return the names in a function block: signals keep theirs where these are legal, what is its own gives way.

    Args:
        source: The controller.
        own: All names in the notation.
    """
    plant, block, program = source.file.plant, f"FB_{source.name}", f"PRG_{source.name}"
    taken = {*KEYWORDS, *(name.upper() for name in (*FIXED, block, program))}

    def unit(text: str) -> str:
        return f", in {said(text)}" if text else ""

    def signals(which: Literal["y", "u"], labels: Iterable[str], what: str) -> tuple[Signal, ...]:
        found = []
        for k, label in enumerate(labels):
            called = legal(label, taken)
            other = "" if called == label else f"; {said(label)} in the spec"
            found.append(Signal(called, (which, k), what + unit(plant.units.get(label, "")) + other))
        return tuple(found)

    y, u = signals("y", plant.outputs, "measured"), signals("u", plant.inputs, "to be put out now")
    given = tuple(
        Signal(legal(f"ref_{w}", taken), ("given", k), f"reference: {said(w)}{unit(reference_unit(w, plant.units))}")
        for k, w in enumerate(source.program.reference if source.given else ())
    )
    wanted = tuple(
        Signal(
            legal(f"{one.called}_wanted", taken), ("wanted", k), "before its limits" + unit(plant.units.get(label, ""))
        )
        for k, (one, label) in enumerate(zip(u, plant.inputs, strict=True))
    )
    called = {name: name if name in FIXED else legal(_OWN.get(name, name), taken) for name in own}
    instance, fault = legal("control", taken), legal("fault", taken)
    return Names(block, program, (*y, *given), (*u, *wanted), called, instance, fault)
