"""Entries of a spec file as pydantic types: numbers, forms, names, within their limits."""

import keyword
import re
from collections import Counter
from collections.abc import Callable
from fractions import Fraction
from math import inf
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    PlainValidator,
    Tag,
    ValidationInfo,
    WithJsonSchema,
    WrapValidator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core.core_schema import CoreSchema

from pwatrack.model.linear_form import LinearForm
from pwatrack.model.signal import LARGEST, ExponentialPolynomial, NotRepresentable
from pwatrack.real import Real
from pwatrack.spec.expression import RESERVED, Expression, formula, inequalities, linear_form, real
from pwatrack.spec.section import Context, rows
from pwatrack.spec.wording import odd_character, shown

_LONGEST_NAME = 100  # characters: names are columns of tables and of the trace
_COARSEST = 0.01  # rounding of data: with more, little is left of the plant that was written
_LONGEST_LABEL = 200  # of a title, or the name of a cell
_INFINITE = {".inf": inf, "inf": inf, "+.inf": inf, "-.inf": -inf, "-inf": -inf}


def must(holds: Callable[[Any], bool], text: str) -> AfterValidator:
    """Return a validator of what holds; else `text` is said, with the number, or the numbers of a list, in it."""

    def validate(value: Any) -> Any:
        if not holds(value):
            found = (v for v in (value if isinstance(value, list) else [value]) if isinstance(v, float | Real))
            raise ValueError(text.format(*map(float, found)))
        return value

    return AfterValidator(validate)


def sized_real(value: Any, context: Context) -> Real:
    """Return a number, or the value of an expression; a ValueError where it is beyond the numbers that are read."""
    return _sized(
        value if isinstance(value, Real) else real(_text(value, "a number or an expression"), context.parameters)
    )


def _text(value: Any, what: str) -> str | Expression:
    if not isinstance(value, str | Expression):
        raise ValueError(f"{what} is expected")
    return value


def _sized(value: Real) -> Real:
    if value.radius and abs(value.centre) <= value.radius:  # cos(pi/2) is 0 for all that looks at sizes
        return Real(Fraction(0), abs(value.centre) + value.radius)
    size = abs(float(value))
    if size > LARGEST:
        raise ValueError(f"{float(value):g} is larger than {LARGEST:g}")
    if value.centre != 0 and size < 1 / LARGEST:
        raise ValueError(f"{float(value):g} is smaller than {1 / LARGEST:g} but not 0: write 0, or use other units")
    return value


def _sized_form(form: LinearForm) -> LinearForm:
    return LinearForm(tuple(map(_sized, form.coefficients)), _sized(form.offset))


def _number(value: Any, info: ValidationInfo[Context]) -> float:
    return value if isinstance(value, float) else float(sized_real(value, info.context))


def _form(value: Any, info: ValidationInfo[Context]) -> LinearForm:
    """Return a linear form of the states that is not constant."""
    if isinstance(value, LinearForm):
        return value
    text = _text(value, "a linear form of the states such as 'z2 - z1'")
    form = linear_form(text, info.context.states, info.context.parameters)
    if not form.row.any():
        raise ValueError(f"'{text.text if isinstance(text, Expression) else text}' does not depend on any state")
    return _sized_form(form)


def _inequalities(value: Any, info: ValidationInfo[Context]) -> list[LinearForm]:
    if isinstance(value, list) and value and all(isinstance(form, LinearForm) for form in value):
        return value
    text = _text(value, "an inequality such as 'z2 - z1 >= 0.05'")
    return [_sized_form(form) for form in inequalities(text, info.context.states, info.context.parameters)]


def _time(value: Any, info: ValidationInfo[Context]) -> ExponentialPolynomial:
    signal = formula(_text(value, "an expression in t"), info.context.parameters)
    try:
        signal.check_size()
    except NotRepresentable as error:
        raise ValueError(f"'{value}' {error}") from None
    return signal


def _start(value: Any, info: ValidationInfo[Context]) -> list[float]:
    if value == "periodic":
        return []
    if not isinstance(value, list) or not value:
        raise ValueError("a list of numbers, one for each state, or 'periodic' is expected")
    return [_number(entry, info) for entry in value]


def _share_or_interval(value: Any, info: ValidationInfo[Context]) -> Real | tuple[Real, Real]:
    if isinstance(value, str) and value.rstrip().endswith("%"):
        share = sized_real(value.rstrip()[:-1], info.context) / 100
        if share.centre <= 0:
            raise ValueError(f"{shown(value)} is no positive share")
        return share
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("a share such as 5%, or an interval such as [0.9, 1.1], is expected")
    low, high = (sized_real(entry, info.context) for entry in value)
    if not low.centre < high.centre:
        raise ValueError(f"low {float(low):g} is not below high {float(high):g}")
    return low, high


def _scale(value: Any, info: ValidationInfo[Context]) -> float | dict[str, float]:
    if isinstance(value, dict):
        return {name: _number(entry, info) for name, entry in value.items()}
    return _number(value, info)


def two_limits(value: Any, info: ValidationInfo[Context]) -> list[float]:
    """Return a lower and an upper limit, infinite where there is none."""
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("a lower and an upper limit such as [-1, 1] are expected; .inf for none")
    low, high = (_INFINITE[v] if isinstance(v, str) and v in _INFINITE else _number(v, info) for v in value)
    if not low < high:
        raise ValueError(f"the lower limit {low:g} is not below the upper one, {high:g}")
    return [low, high]


def _or(word: str) -> WrapValidator:
    return WrapValidator(lambda value, number: word if value == word else number(value))


def _name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
        odd = f"; it has the character {odd_character(value)}" if odd_character(value) else ""
        raise ValueError(f"{shown(value)} is not a name: use letters, digits and _, not starting with a digit{odd}")
    if len(value) > _LONGEST_NAME:
        raise ValueError(f"a name has {len(value)} characters, at most {_LONGEST_NAME} are read")
    if value in RESERVED or keyword.iskeyword(value):
        what = (
            "has a meaning of its own in expressions"
            if value in RESERVED
            else "is a word of Python's, which reads them"
        )
        raise ValueError(f"'{value}' {what}: choose another name")
    return value


def _label(value: str) -> str:
    """Return a title or a cell's name without spaces around it: it is printed, so it is one line of visible text."""
    value = value.strip()
    hidden = next((c for c in value if not c.isprintable()), None)
    if hidden:
        raise ValueError(f"{odd_character(hidden) or 'a line end'} is in it: a name is one line of visible text")
    if len(value) > _LONGEST_LABEL:
        raise ValueError(f"a name has {len(value)} characters, at most {_LONGEST_LABEL} are read")
    return value


def _whole(value: Any) -> int:
    if isinstance(value, int):
        return value
    if not isinstance(value, str) or not re.fullmatch(r"-?(0|[1-9][0-9]{0,17})", value):
        raise ValueError("a whole number such as 1 is expected")
    return int(value)


def _names(values: tuple[str, ...]) -> tuple[str, ...]:
    doubles = sorted(name for name, times in Counter(values).items() if times > 1)
    if doubles:
        raise ValueError(f"'{doubles[0]}' stands in the list twice")
    return values


class Or:
    """What else may stand for an entry in a file, for `pwatrack schema`: one of a list, or a value of another type."""

    def __init__(self, schema: JsonSchemaValue | None = None) -> None:
        self.schema = schema

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        usual = handler(core)
        return {"anyOf": [usual, self.schema or handler.resolve_ref_schema(usual)["items"]]}


_TEXT = {"type": "string"}
_VALUE = {"type": ["number", "string"]}  # an expression is text
_ABOVE_0 = _VALUE | {"exclusiveMinimum": 0}
_PAIR = {"type": "array", "items": _VALUE, "minItems": 2, "maxItems": 2}
_NAME = {"type": "string", "pattern": "^[A-Za-z_][A-Za-z0-9_]*$", "maxLength": _LONGEST_NAME}
TEXT_OR_VALUE = Or(_VALUE)


def _reversed(low: str, high: str) -> JsonSchemaValue:
    """Return the schema of a pair that is reversed about 0: more than this no schema can say of two numbers."""
    return {"prefixItems": [{"type": "number", low: 0}, {"type": "number", high: 0}]}


def increasing(low: str, high: str) -> JsonSchemaValue:
    """Return the schema of what has two entries that are in increasing order, as far as `_reversed` goes."""
    wrong = {low: {"type": "number", "minimum": 0}, high: {"type": "number", "maximum": 0}}
    return {"not": {"properties": wrong, "required": [low, high]}}


def whole(low: int, high: int | None = None) -> WithJsonSchema:
    """Return the schema of a whole number from `low` to `high`, for `pwatrack schema`."""
    return WithJsonSchema({"type": ["integer", "string"], "minimum": low} | ({} if high is None else {"maximum": high}))


UPWARD = _PAIR | {"not": _reversed("minimum", "maximum")}
_NOT_DOWNWARD = _PAIR | {
    "not": {"anyOf": [_reversed("minimum", "exclusiveMaximum"), _reversed("exclusiveMinimum", "maximum")]}
}

Number = Annotated[float, BeforeValidator(_number), WithJsonSchema(_VALUE)]
Exact = Annotated[Real, PlainValidator(lambda value, info: sized_real(value, info.context)), WithJsonSchema(_VALUE)]
_ABOVE = must(lambda value: float(value) > 0, "{:g} is not positive")
ExactPositive = Annotated[Exact, _ABOVE, WithJsonSchema(_ABOVE_0)]
Positive = Annotated[Number, _ABOVE, WithJsonSchema(_ABOVE_0)]
NotNegative = Annotated[Number, must(lambda v: v >= 0, "{:g} is negative"), WithJsonSchema(_VALUE | {"minimum": 0})]
Rounding = Annotated[
    Positive,
    must(
        lambda value: value <= _COARSEST,
        f"{{:g}} is more than data are rounded by in print: at most {_COARSEST:g} is accepted",
    ),
    WithJsonSchema(_ABOVE_0 | {"maximum": _COARSEST}),
]
PositiveOrLargest = Annotated[Positive | Literal["largest"], _or("largest"), WithJsonSchema(_ABOVE_0)]
PositiveOrSmallest = Annotated[Positive | Literal["smallest"], _or("smallest"), WithJsonSchema(_ABOVE_0)]
Name = Annotated[str, AfterValidator(_name)]
Label = Annotated[str, AfterValidator(_label)]
Whole = Annotated[int, BeforeValidator(_whole), WithJsonSchema({"type": ["integer", "string"]})]
ExitNumber = Annotated[
    Whole,
    Field(ge=0, le=6),
    must(lambda code: code != 1, "1 is a crash, which is never as it should be: 0, or 2 to 6"),
    WithJsonSchema({"enum": [0, 2, 3, 4, 5, 6]}),
]
Time = Annotated[ExponentialPolynomial, PlainValidator(_time), WithJsonSchema(_VALUE)]
Names = Annotated[
    tuple[Name, ...],
    must(bool, "at least one name is expected"),
    AfterValidator(_names),
    WithJsonSchema({"type": "array", "items": _NAME, "minItems": 1, "uniqueItems": True}),
]
Point = Annotated[list[Number], WithJsonSchema(_PAIR)]
Rows = Annotated[list[list[Number]], WrapValidator(rows)]
ExactVector = list[Exact]
ExactRows = Annotated[list[list[Exact]], WrapValidator(rows)]
Normal = Annotated[
    ExactVector, must(lambda row: any(v.centre for v in row), "all entries are 0: this is no hyperplane")
]
_ByName = Annotated[dict[str, Number], Tag("by name")]
_InOrder = Annotated[list[Number], Tag("in order")]
_KIND = Discriminator(
    lambda value: "a word" if isinstance(value, str) else "by name" if isinstance(value, dict) else "in order"
)
StartOrWord = Annotated[Annotated[Literal["measured", "steady"], Tag("a word")] | _ByName | _InOrder, _KIND]
StartOrSteady = Annotated[Annotated[Literal["steady"], Tag("a word")] | _ByName | _InOrder, _KIND]
ShareOrInterval = Annotated[
    Real | tuple[Real, Real], PlainValidator(_share_or_interval), WithJsonSchema({"anyOf": [_TEXT, UPWARD]})
]
Interval = Annotated[
    list[Number],
    must(lambda ends: len(ends) == 2, "two numbers [low, high] are expected"),
    must(lambda ends: ends[0] <= ends[1], "low {:g} is above high {:g}"),
    WithJsonSchema(_NOT_DOWNWARD),
]
PeriodicOrVector = Annotated[
    list[float],
    PlainValidator(_start),
    WithJsonSchema({"anyOf": [{"const": "periodic"}, {"type": "array", "items": _VALUE}]}),
]
Limits = Annotated[list[float], PlainValidator(two_limits), WithJsonSchema(UPWARD)]
Scale = Annotated[
    float | dict[str, float],
    PlainValidator(_scale),
    WithJsonSchema({"anyOf": [_VALUE, {"type": "object", "additionalProperties": _VALUE}]}),
]
Form = Annotated[LinearForm, PlainValidator(_form), WithJsonSchema(_TEXT)]
FormPair = Annotated[
    list[Form],
    must(
        lambda forms: len(forms) == 2,
        "two linear forms of the states are expected, such as [z1, v1] or [z2 - z1, v2 - v1]",
    ),
    must(
        lambda forms: np.linalg.matrix_rank([form.row for form in forms]) == 2,
        "the two forms are multiples of each other: all is on one line",
    ),
    WithJsonSchema({"type": "array", "items": _TEXT, "minItems": 2, "maxItems": 2, "uniqueItems": True}),
]
Tracked = Annotated[
    Annotated[dict[Name, Form], Field(min_length=1), Tag("by name")] | Annotated[Names, Tag("in order")],
    Discriminator(lambda value: "by name" if isinstance(value, dict) else "in order"),
]
Inequalities = Annotated[list[LinearForm], PlainValidator(_inequalities), WithJsonSchema(_TEXT)]
