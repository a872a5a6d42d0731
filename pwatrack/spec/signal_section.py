"""Signals of time as pydantic models, and the section `reference`."""

from collections.abc import Collection, Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Discriminator, Field, GetJsonSchemaHandler, Tag
from pydantic.json_schema import JsonSchemaValue
from pydantic_core.core_schema import CoreSchema

from pwatrack.spec.entries import (
    TEXT_OR_VALUE,
    Interval,
    Name,
    NotNegative,
    Number,
    Or,
    PeriodicOrVector,
    Point,
    Positive,
    Scale,
    Time,
)
from pwatrack.spec.section import Context, Fault, Section, shaped, unknown_names
from pwatrack.spec.wording import shown

_LISTED = BeforeValidator(lambda value: [value] if isinstance(value, dict) else value)  # one may stand without a list
_MOST_TERMS = 200  # sines or steps of one signal: each adds states to the exosystem


class SineSection(Section):
    """amplitude · sin(frequency · t + phase); frequency in rad/s, phase in rad."""

    amplitude: Number
    frequency: Positive
    phase: Number = 0.0


class StepSection(Section):
    """A change by `size` that begins at a time (s), rounded over `smooth` (s); added to everything else."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["at"]}, {"required": ["centre"]}]})

    size: Number
    at: Number | None = Field(None, description="When it begins, in s.")
    centre: Number | None = Field(None, description="Its middle, in s, in place of `at`.")
    smooth: Positive | None = None


class TrapezoidSection(Section):
    """Rise from low to high, hold, fall, rest, and again; times in s, corners rounded over `smooth`.

    It leaves `low` at `start`, where it is rounded too.
    """

    low: Number = 0.0
    high: Number
    start: Number = 0.0
    rise: Positive
    hold: NotNegative = 0.0
    fall: Positive
    rest: NotNegative = 0.0
    smooth: Positive | None = None


class PolylineSection(Section):
    """Straight lines through points (t in s, y), corners rounded over `smooth`; constant before and after.

    A line that begins at t = 0 has no corner there.
    """

    points: Annotated[list[Point], Field(min_length=1)]
    smooth: Positive | None = None


class FilterSection(Section):
    """What is left of a measured table: what is slower than the cutoff (Hz), without a phase."""

    cutoff: Positive


class TableSection(Section):
    """A text file with a header, a column of times and the signal's column, joined by a spline.

    `scale` is that of the times, in s, or of each column by its name.
    """

    file: str
    column: str | None = None
    time: str = "t"
    scale: Scale = 1.0
    delimiter: Literal[",", ";", "\t", " ", "|"] | None = None
    decimal: Literal[".", ","] | None = None
    filter: FilterSection | None = None


class ProfileSection(Section):
    """A signal of time: the sum of everything that is given."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1})

    constant: Number = 0.0
    sine: Annotated[list[SineSection], Field(max_length=_MOST_TERMS), _LISTED, Or()] = []
    formula: Time | None = None
    until: Positive | None = None
    step: Annotated[list[StepSection], Field(max_length=_MOST_TERMS), _LISTED, Or()] = []
    trapezoid: TrapezoidSection | None = None
    polyline: PolylineSection | None = None
    table: TableSection | None = None


def _as_course(value: Any) -> Any:
    """A formula may stand for a course that is nothing else."""
    if value == {}:
        raise ValueError("nothing is given: write a formula in t, or entries such as constant, sine, step, table")
    return {"formula": value} if isinstance(value, str) else value


Signal = Annotated[ProfileSection, BeforeValidator(_as_course), TEXT_OR_VALUE]


def _signal_kind(value: Any) -> str:
    """A mapping with none of the entries of a signal is one of signals by name."""
    several = isinstance(value, dict) and value and not set(value) & set(ProfileSection.model_fields)
    return "by name" if several else "one"


class _OneOrByName:
    """For `pwatrack schema`: `{constant: 1}` is one signal, and reads like one by name, so that both may fit."""

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": handler(core)["oneOf"]}


Signals = Annotated[
    Annotated[Signal, Tag("one")] | Annotated[dict[Name, Signal], Field(min_length=1), Tag("by name")],
    Discriminator(_signal_kind),
    _OneOrByName(),
]


class PaceSection(Section):
    """Limits of what is made of set-points: of as many derivatives as the relative degree, at least to the jerk."""

    speed: Positive
    acceleration: Positive
    jerk: Positive
    snap: Positive | None = None
    crackle: Positive | None = None
    range: Interval | None = Field(
        None,
        description="What set-points may be: one that is beyond counts as its end. Needed where inputs have limits and "
        "a value of\nthe output itself takes some of them.",
    )

    @property
    def limits(self) -> list[float]:
        """Those of derivatives that there are, in order."""
        each = (self.speed, self.acceleration, self.jerk, self.snap, self.crackle)
        return [limit for limit in each if limit is not None]

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield where one is left out."""
        if self.crackle is not None and self.snap is None:
            yield Fault(".snap is missing: crackle is beyond it")


class OutsideSection(Section):
    """A reference that comes at run time: set-points, of which the program makes y_d within limits, by output."""

    filter: Annotated[dict[Name, PaceSection], Field(min_length=1)]


class ReferenceSection(Section):
    """What to track: outputs, or for state tracking one of state, input, setpoint."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": [kind]} for kind in ("output", "state", "input", "setpoint")],
            "dependentRequired": {"input": ["start"], "start": ["input"]},
        }
    )

    output: Signals | None = Field(None, description="Of one tracked output, or of each by its name.")
    preview: Literal["auto", "none"] = Field(
        "auto",
        description="Whether x_d is worked out beforehand where the zero dynamics have unstable modes, or that is "
        "refused.",
    )
    outside: OutsideSection | None = Field(
        None, description="What the program makes of set-points at run time, where it is exported for these."
    )
    state: Annotated[list[Signal], shaped("states")] | None = None
    input: Annotated[list[Signal], shaped("inputs")] | None = None
    start: Annotated[PeriodicOrVector, shaped("states")] | None = Field(
        None, description="x_d(0); an empty list where it is the periodic steady state."
    )
    setpoint: dict[str, Number] | None = None

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield where there is not one reference, of the kind that is tracked, for all that is tracked."""
        kinds = {"output": ["output"], "state": ["state", "input", "setpoint"]}
        fitting = kinds.get(context.tracking, [*kinds["output"], *kinds["state"]])
        given = [kind for kind in (*kinds["output"], *kinds["state"]) if getattr(self, kind) is not None]
        if len(given) != 1 or given[0] not in fitting:
            found = " and ".join(given) or "nothing"
            text = f"{context.tracking} tracking needs a reference that is {' or '.join(fitting)}, found {found}"
            other = "'tracking: state' under design tracks states" * (len(given) == 1 and given[0] in kinds["state"])
            yield Fault(text, hint=other or "a 'setpoint' is the simplest" * ("setpoint" in fitting), late=True)
        if self.start is not None and self.input is None:
            yield Fault("start goes with a reference 'input' only", ("start",))
        if self.preview != "auto" and self.output is None:
            yield Fault(".preview goes with reference.output", key=("preview",))
        if self.outside is not None:
            if self.output is None:
                yield Fault(".outside goes with reference.output", key=("outside",))
            yield from _not_each(self.outside.filter, context.followed, ("outside", "filter"))
            if len({len(pace.limits) for pace in self.outside.filter.values()}) > 1:
                yield Fault(".outside.filter must limit as many derivatives of each output", key=("outside",))
        if self.input is not None and self.start is None:
            yield Fault(".start is missing: x_d(0), or 'periodic'")
        followed = context.followed if "output" in fitting else ()
        if isinstance(self.output, dict) and followed:
            hint = f"entries of a signal are {', '.join(ProfileSection.model_fields)}"
            yield from _not_each(self.output, followed, ("output",), f" ({', '.join(followed)})", hint)
        elif self.output is not None and len(followed) > 1:
            text = f".output is one signal, and {len(followed)} outputs are tracked: {', '.join(followed)}"
            one = followed[0]
            hint = f"give each its own, output: {{{one}: …}}, or say which one follows the reference: track: [{one}]"
            yield Fault(text, hint=hint, key=("output",), late=True)
        if self.setpoint is not None and set(self.setpoint) != set(context.followed):
            tracked, own = (", ".join(names) for names in (context.followed, self.setpoint))
            yield Fault(f"setpoint must give what is tracked, {tracked}, and gives {own}", ("setpoint",), late=True)


def _not_each(
    given: Collection[str], tracked: tuple[str, ...], at: tuple[str, ...], known: str = "", hint: str = ""
) -> Iterator[Fault]:
    """Yield names that are no tracked output, or else the tracked outputs that are left out."""
    unknown = [*unknown_names(given, tracked)]
    for name, meant in unknown:
        yield Fault(f": {shown(name)} is no tracked output{known}{meant}", (*at, name), hint, late=True)
    missing = [name for name in tracked if name not in given]
    if missing and not unknown:
        text = f".{'.'.join(at)} must give every tracked output, and leaves out {', '.join(missing)}"
        yield Fault(text, key=at[:1], late=True)
