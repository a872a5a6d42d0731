"""What a run may be required to achieve: figures of run.json by name, and their limits, in units that Pint knows."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Literal

from pydantic import ValidationInfo

from pwatrack.errors import InvalidSpec, Problem, Subject
from pwatrack.simulation.enclosure import CLOSE
from pwatrack.spec.entries import sized_real, two_limits
from pwatrack.spec.expression import BrokenParameter, UnknownName
from pwatrack.spec.section import Context, Fault, Faults
from pwatrack.spec.wording import NUMBER, guess, shown

_HERE = "require"
_UNIT = r"([A-Za-zµμΩ°].*)"
_WITH_UNIT = re.compile(rf"(.*?[\w.)])\s+{_UNIT}|({NUMBER.pattern})(?![eE][+-]?\d){_UNIT}")
_ROUNDING = 1e-12  # of a figure
_ENCLOSED = CLOSE + _ROUNDING  # likewise, of one that is a bound on what is between samples


@dataclass(frozen=True)
class Quantity:
    """What a figure is."""

    of: Literal["design", "run", "member"]  # "member": each of an ensemble, and the run itself
    best: Literal["at most", "at least"] = "at most"  # whether a requirement is its largest value or its smallest
    # of which each has its own; "errors": of what follows a reference; "limited": of what has limits
    per: Literal["outputs", "inputs", "errors", "limited", "cells"] | None = None
    each: str | None = None  # the figure that is the same of each signal by itself: limits by name are about that
    unit: Literal["", "1/s", "s", "°", "of the error", "of the signal"] = ""  # its unit, or which unit that is
    share: bool = False  # whether it is a share, that may be written in percent
    known: float = _ROUNDING  # to which part of itself it is known; missing a limit by less is no miss


QUANTITIES: Mapping[str, Quantity] = {
    "norm_K": Quantity("design"),
    "norm_L": Quantity("design"),
    "controller_rate": Quantity("design", "at least", unit="1/s"),
    "observer_rate": Quantity("design", "at least", unit="1/s"),
    "generator_rate": Quantity("design", "at least", unit="1/s"),
    "rate": Quantity("design", "at least", unit="1/s"),
    "robust_rate": Quantity("design", "at least", unit="1/s"),
    "robust_share_K": Quantity("design", "at least", share=True),
    "robust_share_L": Quantity("design", "at least", share=True),
    "gain_margin": Quantity("design", "at least"),
    "phase_margin": Quantity("design", "at least", unit="°"),
    "delay_margin": Quantity("design", "at least", unit="s"),
    "final_error": Quantity("member", each="final_errors", unit="of the error", known=_ENCLOSED),
    "largest_error": Quantity("member", each="largest_errors", unit="of the error", known=_ENCLOSED),
    "final_errors": Quantity("member", per="errors", unit="of the signal", known=_ENCLOSED),
    "largest_errors": Quantity("member", per="errors", unit="of the signal", known=_ENCLOSED),
    "final_observer_error": Quantity("member"),
    "largest_input": Quantity("member", per="inputs", unit="of the signal", known=_ENCLOSED),
    "mode_changes": Quantity("member"),
    "joint_modes": Quantity("member"),
    "settling_time": Quantity("member", per="outputs", unit="s"),
    "rise_time": Quantity("member", per="outputs", unit="s"),
    "overshoot": Quantity("member", per="outputs", share=True),
    "time_share": Quantity("member", per="cells", share=True),
    "largest_multiplier": Quantity("run"),
    "steady_state_residual": Quantity("run"),
}
RANGES: Mapping[str, Quantity] = {  # what `limits` are about
    "lowest": Quantity("member", "at least", per="limited", unit="of the signal", known=_ENCLOSED),
    "highest": Quantity("member", per="limited", unit="of the signal", known=_ENCLOSED),
}
LIMITS = "limits"


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """A limit of a figure."""

    figure: str
    signal: str | None  # of which output or input, or None for all that have one
    limit: float  # the largest value that is allowed, or the smallest
    share: float | None  # of the members of an ensemble that must keep it; None where it is about the run itself
    subject: Subject
    other: float = 0.0  # the limit on the other side of a signal, where it has one: the figure is known to that too

    @property
    def quantity(self) -> Quantity:
        """What the figure is."""
        return RANGES.get(self.figure) or QUANTITIES[self.figure]

    def met(self, value: float) -> bool:
        """Whether a value keeps the limit, but for what it is known to."""
        sign = 1.0 if self.quantity.best == "at most" else -1.0
        return sign * value <= sign * self.limit + self.quantity.known * max(abs(self.limit), abs(self.other))


def read_requirements(data: Any, info: ValidationInfo[Context]) -> tuple[Requirement, ...]:
    """Return what the section `require` asks for; a validator of pydantic."""
    if not isinstance(data, Mapping):
        raise Faults([Fault(": a mapping such as {final_error: 1e-3} is expected")])
    found, faults, share = list[Requirement](), list[Fault](), 1.0
    members = data.get("ensemble")
    if "ensemble" in data and not (isinstance(members, Mapping) and set(members) - {"members"}):
        hint = "for example ensemble: {members: 95%, final_error: 1e-3}"
        faults.append(Fault(": what each member is to achieve is expected", ("ensemble",), hint))
        members = None
    inner = sorted((members or {}).items(), key=lambda entry: entry[0] != "members")  # the share comes first
    given = [(("ensemble", name), value) for name, value in inner]
    for at, value in [((name,), value) for name, value in data.items() if name != "ensemble"] + given:
        of_each = at[-1] == LIMITS and isinstance(value, Mapping) and value
        for path, one in (((*at, signal), ends) for signal, ends in value.items()) if of_each else [(at, value)]:
            try:
                if path == ("ensemble", "members"):
                    share = _share(one, info.context)
                else:
                    found += _asked(path, one, share if len(at) > 1 else None, info)
            except BrokenParameter:
                continue  # said where the parameter stands
            except ValueError as fault:
                faults.append(Fault(f": {fault}{fault.guess if isinstance(fault, UnknownName) else ''}", path))
    if faults:
        raise Faults(faults)
    return tuple(found)


def _asked(path: Subject, value: Any, share: float | None, info: ValidationInfo[Context]) -> Iterator[Requirement]:
    """Yield what is asked of a figure, or of how low and how high an output or state gets."""
    context, inside = info.context, path[0] == "ensemble"
    name, *signals = (str(part) for part in path[inside:])
    about: Any = {"share": share, "subject": (_HERE, *path)}
    if name != LIMITS:
        quantity = _quantity(name, inside=inside)
        if quantity.each is not None and isinstance(value, Mapping):
            name, quantity = quantity.each, QUANTITIES[quantity.each]
        for signal, limit in _limits(value, quantity, context):
            yield Requirement(figure=name, signal=signal, limit=limit, **about)
        return
    if not signals:
        raise ValueError("limits of outputs or states by name are expected, for example {y: [0, 0.4]}")
    signal, names, unit = signals[0], context.limited, context.units.get(signals[0], "")
    if signal not in names:
        of_input = "; limits of inputs stand under simulation: actuator" if signal in context.inputs else ""
        text = f"{shown(signal)} is no output or state ({', '.join(names)}){of_input or guess(signal, names)}"
        raise ValueError(text)
    both = two_limits([_in_unit(end, unit, context) for end in value] if isinstance(value, list) else value, info)
    finite = {figure: limit for figure, limit in zip(RANGES, both, strict=True) if isfinite(limit)}
    for figure, limit in finite.items():
        other = max(finite.values(), key=abs)
        yield Requirement(figure=figure, signal=signal, limit=limit, other=other, **about)


def check_cells(requirements: Sequence[Requirement], cells: Sequence[str]) -> None:
    """Refuse a share of the time in what is no cell of the plant, nor what one of its elements is."""
    of = {asked.signal: asked.subject for asked in requirements if asked.figure == "time_share" and asked.signal}
    known = dict.fromkeys([*cells, *(part for cell in cells for part in cell.split(", "))])
    wrong = [
        Problem(
            message=f"{'.'.join(map(str, at))}: {shown(cell)} is no cell of the plant, nor what one of its elements is",
            subject=(*at, cell),
            hint=f"there are {', '.join(map(repr, known))}"[:300],
        )
        for cell, at in of.items()
        if cell not in known
    ]
    if wrong:
        raise InvalidSpec(*wrong)


def _quantity(name: str, *, inside: bool) -> Quantity:
    """Return what the figure of a name is; `inside` what each member of an ensemble is to achieve."""
    known = [name for name, quantity in QUANTITIES.items() if quantity.of == "member" or not inside]
    known.append(LIMITS)
    if name in QUANTITIES and name in known:
        return QUANTITIES[name]
    if name in QUANTITIES:
        raise ValueError(f"a member of an ensemble has no such figure of its own: put it under '{_HERE}' itself")
    meant = guess(name, [*known, "members" if inside else "ensemble"])
    raise ValueError(f"no figure has this name{meant or '; there are ' + ', '.join(known)}")


def _limits(value: Any, quantity: Quantity, context: Context) -> list[tuple[str | None, float]]:
    """Return the limits of a figure, with the name of the signal where it is that of one."""
    if quantity.per == "cells":
        if not isinstance(value, Mapping) or not value:
            raise ValueError("a share for some of the cells by name is expected, such as {in the stop: 5%}")
        return [(cell, _limit(share, quantity, "", context)) for cell, share in value.items()]
    names = {"inputs": context.inputs, "outputs": context.followed, "errors": context.errors}.get(
        quantity.per or "", ()
    )
    of_signal = quantity.unit == "of the signal"
    if not isinstance(value, Mapping):
        alike = {context.units.get(name, "") for name in (names if of_signal else context.errors)}
        unit = quantity.unit if not quantity.unit.startswith("of") else alike.pop() if len(alike) == 1 else ""
        unit = "" if quantity.unit == "of the error" and len(context.errors) > 1 else unit  # it is in sizes
        return [(None, _limit(value, quantity, unit, context))]
    if quantity.per is None:
        raise ValueError("one number is expected: this figure is not one of a signal")
    if not value:
        raise ValueError(f"nothing is given: a number, or one for some of the {quantity.per} by name")
    for signal in value:
        if signal not in names:
            meant = guess(signal, names)
            of = {"errors": "signals that have an error"}.get(quantity.per, quantity.per)
            raise ValueError(f"{shown(signal)} is none of the {of} ({', '.join(names)}){meant}")
    own = {name: context.units.get(name, "") if of_signal else quantity.unit for name in value}
    return [(signal, _limit(limit, quantity, own[signal], context)) for signal, limit in value.items()]


def _limit(value: Any, quantity: Quantity, unit: str, context: Context) -> float:
    """Return a number that is not negative; a share may be written in percent, and what has a `unit` in another one."""
    if not isinstance(value, str):
        raise ValueError("a number or an expression is expected")
    if quantity.share and value.rstrip().endswith("%"):
        limit = float(sized_real(value.rstrip()[:-1], context)) / 100
    else:
        found = _in_unit(value, unit, context, difference=quantity.per == "errors" or quantity.unit == "of the error")
        limit = found if isinstance(found, float) else float(sized_real(found, context))
    if limit < 0:
        raise ValueError(f"{limit:g} is negative, and no figure is")
    return limit


def _in_unit(value: Any, unit: str, context: Context, *, difference: bool = False) -> Any:
    """Return the number of a text such as '0.5 mm' in the unit of what it limits; what has no unit as it is."""
    if isinstance(value, str) and value.rstrip().endswith("%"):
        if unit != "%":
            raise ValueError(f"{shown(value)}: percent of what? a number in the unit of the figure is expected")
        return value.rstrip()[:-1]
    number, given = split(value) if isinstance(value, str) else (value, "")
    return float(sized_real(number, context)) * times(given, unit, difference=difference) if given else value


def _share(value: Any, context: Context) -> float:
    share = 1.0 if value == "all" else _limit(value, Quantity("member", share=True), "", context)
    if not 0 < share <= 1:
        raise ValueError(f"{shown(value)} is no share of the members: 'all', or for example 95%")
    return share


def split(text: str) -> tuple[str, str]:
    """Return the number of a text, and the unit behind it; '' where there is none.

    Example:
        >>> split("0.5 mm"), split("2*k N m"), split("a + b"), split("1E-3"), split("500ms")
        (('0.5', 'mm'), ('2*k', 'N m'), ('a + b', ''), ('1E-3', ''), ('500', 'ms'))
    """
    found = _WITH_UNIT.fullmatch(text.strip())
    return (found[1] or found[3], found[2] or found[4]) if found else (text, "")


def times(unit: str, into: str, *, difference: bool = False) -> float:
    """Return by what a number in one unit is multiplied to be in another; of a difference wherever these begin.

    Raises:
        ValueError: If these are not of one kind, or a unit is not known.

    Example:
        >>> times("mm", "m"), times("N", "N"), round(times("K", "degC", difference=True), 9)
        (0.001, 1.0, 1.0)
        >>> times("mm", "s")
        Traceback (most recent call last):
        ValueError: 'mm' is no unit of what is in 's'
    """
    if unit == into:
        return 1.0
    if not into:
        raise ValueError(f"{shown(unit)}: what this is about has no unit: give a number alone")
    from pint import PintError, UnitRegistry

    known: Any = UnitRegistry(cache_folder=None)
    try:
        zero, one = (float(known.Quantity(v, unit).to(into).magnitude) for v in (0.0, 1.0))
    except (PintError, AttributeError, ValueError, TypeError, AssertionError):
        raise ValueError(f"{shown(unit)} is no unit of what is in {shown(into)}") from None
    if zero and not difference:  # degrees that begin elsewhere
        raise ValueError(f"{shown(unit)} begins at another zero than {shown(into)}: give the number in that")
    return one - zero
