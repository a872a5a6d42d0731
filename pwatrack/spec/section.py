"""What all sections of a spec file have in common: what they are read with, and how all that is wrong is collected."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)

from pwatrack.errors import Subject, listed
from pwatrack.real import Real
from pwatrack.spec.wording import guess, shown
from pwatrack.spec.yaml_tree import at_path

MOST = 100  # for so many faults of a kind it is guessed what was meant
_FEW = 20  # names that are known, of very many


@dataclass(frozen=True)
class Context:
    """What the rest of the file is read with."""

    parameters: Mapping[str, Real | None]  # their values; None for one that is itself in error
    states: tuple[str, ...]  # the names declared under `system`
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    tracked: tuple[str, ...] = ()  # those of what is to follow a reference, where they are declared for that
    loads: Mapping[str, int] = field(default_factory=dict)  # to be estimated, with how many states each has
    chosen: tuple[str, ...] = ()  # those of the outputs that are to follow a reference, where some are named
    tracking: str = "output"  # what `design` says of it
    units: Mapping[str, str] = field(default_factory=dict)  # of signals by name

    @staticmethod
    def of(data: Mapping[str, Any], parameters: Mapping[str, Real | None]) -> "Context":
        """Return what a raw tree declares."""
        states, inputs, outputs = (_texts(at_path(data, ("system", name))) for name in ("states", "inputs", "outputs"))
        tracked, estimate = at_path(data, ("system", "track")), at_path(data, ("design", "estimate"))
        given, forms = at_path(data, ("system", "units")), tracked if isinstance(tracked, dict) else {}
        units = {k: unit for k, unit in given.items() if isinstance(unit, str)} if isinstance(given, dict) else {}
        same = {name: units[of] for name, of in forms.items() if isinstance(of, str) and of in units}  # a state's own
        loads, tracking = estimate if isinstance(estimate, dict) else {}, at_path(data, ("design", "tracking"))
        return Context(
            parameters=parameters,
            states=states,
            inputs=inputs,
            outputs=outputs,
            tracked=tuple(forms),
            loads={f"load_{name}": 1 for name in inputs}
            if estimate == "input"
            else {name: 1 + (isinstance(load, dict) and "frequency" in load) for name, load in loads.items()},
            chosen=tuple(filter(outputs.__contains__, _texts(tracked))),
            tracking=tracking if isinstance(tracking, str) else "output",
            units={name: unit for name, unit in (same | units).items() if unit != "1"},
        )

    @property
    def followed(self) -> tuple[str, ...]:
        """What is to follow a reference: all outputs where nothing is said."""
        return self.tracked or self.chosen or self.outputs

    @property
    def errors(self) -> tuple[str, ...]:
        """What has a tracking error of its own."""
        return (*self.followed, *self.states) if self.tracking == "state" else self.followed

    @property
    def limited(self) -> tuple[str, ...]:
        """What may have limits beside inputs: what follows a reference, outputs and states."""
        return (*dict.fromkeys((*self.followed, *self.outputs, *self.states)),)

    @property
    def ports(self) -> tuple[str, ...]:
        """What a controller writes and reads."""
        return (*self.inputs, *self.outputs)

    @property
    def signals(self) -> tuple[str, ...]:
        """All that has a name and a column in the trace."""
        return (*dict.fromkeys((*self.states, *self.ports, *self.tracked, *self.loads)),)

    @property
    def measured(self) -> tuple[str, ...]:
        """What a unit is said of; none where the states are not known."""
        return self.signals if self.states else ()

    @property
    def sized(self) -> tuple[str, ...]:
        """What a deviation that matters is said of."""
        return tuple(name for name in self.measured if name not in self.tracked)

    @property
    def states_and_estimates(self) -> tuple[str, ...]:
        """The states of the observer."""
        loads = (name for name, order in self.loads.items() for _ in range(order))
        return (*self.states, *loads) if self.states else ()


def _texts(value: Any) -> tuple[str, ...]:
    return tuple(v for v in value if isinstance(v, str)) if isinstance(value, list) else ()


class Fault(NamedTuple):
    """One thing that is wrong with a value."""

    text: str  # what; behind the path of what it is about, where it begins with a colon, a point or a space
    at: Subject = ()  # that path, from the value on
    hint: str = ""  # what to do
    key: Subject = ()  # where it stands, from there on
    late: bool = False  # whether it may follow from another fault, and is said only where there is none


class Faults(ValueError):
    """All that is wrong with a value as a whole, and `inner`, what is wrong inside it."""

    def __init__(self, faults: Iterable[Fault], inner: ValidationError | None = None) -> None:
        self.faults, self.inner = tuple(faults), inner


def _checked(value: Any, handler: Callable[[Any], Any], faults: Iterable[Fault]) -> Any:
    """Return what a handler makes of a value, or raise its faults with those that are given: none hides another."""
    found = [*faults]
    try:
        result = handler(value)
    except ValidationError as inner:
        if not found:
            raise
        raise Faults(found, inner) from None
    if found:
        raise Faults(found)
    return result


def also(check: Callable[[Any, Context], Iterable[Fault]]) -> WrapValidator:
    """Return a validator of a value as it is written, beside that of its type."""

    def validate(value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo[Context]) -> Any:
        return _checked(value, handler, check(value, info.context))

    return WrapValidator(validate)


class Section(BaseModel):
    """A mapping in the file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def declared(cls, context: Context) -> Iterable[Fault]:
        """Return what is wrong with the names of the file, whatever else is wrong in the section."""
        return ()

    def rules(self, context: Context) -> Iterable[Fault]:
        """Return what does not go together in a section whose entries are all well formed."""
        return ()

    @model_validator(mode="wrap")
    @classmethod
    def _all_rules(cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo) -> Self:
        section: Self = _checked(data, handler, cls.declared(info.context) if info.context else ())
        if info.context and (found := [*section.rules(info.context)]):
            raise Faults(found)
        return section

    @classmethod
    def written_keys(cls) -> list[str]:
        """Return its keys, as they stand in a file."""
        return [field.alias or name for name, field in cls.model_fields.items()]


def unknown_names(names: Iterable[str], known: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield the names that are not known, the first ones with a guess at what was meant."""
    wanted, count = set(known), 0
    for name in names:
        if name not in wanted:
            yield name, guess(name, known) if count < MOST else ""
            count += 1


def named(kind: str, of: str, form: str = " ({})") -> WrapValidator:
    """Return a validator of a mapping by name: each is one of the names that a property of the context has.

    Where `form`, which lists them, begins with a semicolon, the path that is said ends with the name.
    """

    def check(value: Any, context: Context) -> Iterator[Fault]:
        known = getattr(context, of)
        if not isinstance(value, dict) or not (known or of == "parameters"):
            return  # they are in error themselves
        for name, meant in unknown_names(value, known):
            at = (name,) if form[:1] == ";" else ()
            text = f": {shown(name)} is no {kind}{form.format(listed(tuple(known), _FEW) or 'none')}{meant}"
            yield Fault(text, at, key=() if at else (name,), late=not known or of == "followed")

    return also(check)


def misfits(value: Any, axes: tuple[str, ...], context: Context, at: Subject = ()) -> Iterator[Fault]:
    """Yield where a vector or matrix has not an entry for each of the names of one or two kinds."""
    if not isinstance(value, list) or (len(axes) == 2 and flat(value)):
        return
    wanted, found = len(getattr(context, axes[0])), len(value)
    if wanted and found != wanted:
        one, many = ("row", "rows") if len(axes) == 2 else ("entry", "entries")
        names = axes[0].replace("_", " ") if context.loads else axes[0].partition("_")[0]
        yield Fault(f": {found} {one if found == 1 else many}, expected {wanted}, one for each of the {names}", at)
    for k, row in enumerate(value if len(axes) == 2 else ()):
        yield from misfits(row, axes[1:], context, (*at, k))


def shaped(*axes: str) -> WrapValidator:
    """Return a validator of a vector or matrix: see `misfits`."""
    return also(lambda value, context: misfits(value, axes, context))


def flat(value: list[Any]) -> bool:
    """Whether a matrix is written as a list of numbers instead of a list of rows."""
    return any(isinstance(entry, str) for entry in value)


def rows(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    """Validate a matrix: without inner brackets that is said once, and nothing of its entries."""
    if isinstance(value, list) and flat(value):
        text = ": a list of rows is expected, each in its own brackets"
        raise Faults([Fault(text, hint="write [[1, 0], [0, 1]] for two rows, [[1, 0]] for one")])
    return handler(value)


def distinct(kind: str) -> WrapValidator:
    """Return a validator of a list of sections: each has a name of its own."""

    def check(value: Any, _: Context) -> Iterator[Fault]:
        seen = set[str]()
        for k, entry in enumerate(value if isinstance(value, list) else ()):
            name = entry.get("name") if isinstance(entry, dict) else None
            if isinstance(name, str):
                name = name.strip()
                if not name:
                    yield Fault(f"this {kind} has an empty name", (k, "name"))
                elif name in seen:
                    yield Fault(f"a second {kind} is named {shown(name)}", (k, "name"))
                seen.add(name)

    return also(check)
