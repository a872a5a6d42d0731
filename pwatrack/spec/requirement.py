"""What a run may be required to achieve: the figures of run.json by name, and limits of them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Literal

from pydantic import ValidationInfo

from pwatrack.errors import Subject
from pwatrack.simulation.enclosure import CLOSE
from pwatrack.spec.entries import sized_real, two_limits
from pwatrack.spec.expression import BrokenParameter, UnknownName
from pwatrack.spec.section import Context, Fault, Faults
from pwatrack.spec.wording import guess, shown

_HERE = "require"
_ROUNDING = 1e-12  # of a figure
_ENCLOSED = CLOSE + _ROUNDING  # likewise, of one that is a bound on what is between samples


@dataclass(frozen=True)
class Quantity:
    """What a figure is."""

    of: Literal["design", "run", "member"]  # "member": each of an ensemble, and the run itself
    best: Literal["at most", "at least"] = "at most"  # whether a requirement is its largest value or its smallest
    # of which each has its own; "errors": of what follows a reference; "limited": of what has limits
    per: Literal["outputs", "inputs", "errors", "limited"] | None = None
    each: str | None = None  # the figure that is the same of each signal by itself: limits by name are about that
    unit: Literal["", "1/s", "s", "of the error", "of the signal"] = ""  # its unit, or which unit that is
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
    found, faults = list[Requirement](), list[Fault]()
    members = data.get("ensemble")
    if "ensemble" in data and not (isinstance(members, Mapping) and set(members) - {"members"}):
        hint = "for example ensemble: {members: 95%, final_error: 1e-3}"
        faults.append(Fault(": what each member is to achieve is expected", ("ensemble",), hint))
        members = None
    share = 1.0
    inner = dict(sorted((members or {}).items(), key=lambda entry: entry[0] != "members"))  # the share comes first
    for entries, inside in ((data, ()), (inner, ("ensemble",))):
        for name, value in entries.items():
            at: Subject = (*inside, name)
            try:
                if inside and name == "members":
                    share = _share(value, info.context)
                elif name == LIMITS:
                    found += _ranges(value, info, share if inside else None, at)
                elif inside or name != "ensemble":
                    quantity, of = _quantity(name, inside=bool(inside)), share if inside else None
                    figure = name
                    if quantity.each is not None and isinstance(value, Mapping):
                        figure, quantity = quantity.each, QUANTITIES[quantity.each]
                    found += [
                        Requirement(figure=figure, signal=signal, limit=limit, share=of, subject=(_HERE, *at))
                        for signal, limit in _limits(value, quantity, info.context)
                    ]
            except BrokenParameter:
                continue  # said where the parameter stands
            except Faults as several:
                faults += several.faults
            except ValueError as fault:
                faults.append(Fault(f": {fault}{fault.guess if isinstance(fault, UnknownName) else ''}", at))
    if faults:
        raise Faults(faults)
    return tuple(found)


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


def _ranges(value: Any, info: ValidationInfo[Context], share: float | None, at: Subject) -> list[Requirement]:
    """Return what limits of outputs and states ask of how low and how high each of them gets."""
    if not isinstance(value, Mapping) or not value:
        raise ValueError("limits of outputs or states by name are expected, for example {y: [0, 0.4]}")
    names, found, faults = info.context.limited, list[Requirement](), list[Fault]()
    for signal, ends in value.items():
        here = (*at, signal)
        if signal not in names:
            of_input = "; limits of inputs stand under simulation: actuator" if signal in info.context.inputs else ""
            text = f"{shown(signal)} is no output or state ({', '.join(names)}){of_input or guess(signal, names)}"
            faults.append(Fault(f": {text}", here))
            continue
        try:
            both = two_limits(ends, info)
        except BrokenParameter:
            continue
        except ValueError as fault:
            faults.append(Fault(f": {fault}", here))
            continue
        finite = [limit for limit in both if isfinite(limit)]
        for figure, limit in zip(RANGES, both, strict=True):
            asked = Requirement(figure=figure, signal=signal, limit=limit, share=share, subject=(_HERE, *here))
            found += [replace(asked, other=max(finite, key=abs))] if isfinite(limit) else []
    if faults:
        raise Faults(faults)
    return found


def _limits(value: Any, quantity: Quantity, context: Context) -> list[tuple[str | None, float]]:
    """Return the limits of a figure, with the name of the signal where it is that of one."""
    if not isinstance(value, Mapping):
        return [(None, _limit(value, quantity, context))]
    if quantity.per is None:
        raise ValueError("one number is expected: this figure is not one of a signal")
    names = {"inputs": context.inputs, "outputs": context.followed, "errors": context.errors}[quantity.per]
    if not value:
        raise ValueError(f"nothing is given: a number, or one for some of the {quantity.per} by name")
    for signal in value:
        if signal not in names:
            meant = guess(signal, names)
            of = {"errors": "signals that have an error"}.get(quantity.per, quantity.per)
            raise ValueError(f"{shown(signal)} is none of the {of} ({', '.join(names)}){meant}")
    return [(signal, _limit(limit, quantity, context)) for signal, limit in value.items()]


def _limit(value: Any, quantity: Quantity, context: Context) -> float:
    """Return a number that is not negative; a share may be written in percent."""
    if not isinstance(value, str):
        raise ValueError("a number or an expression is expected")
    if value.rstrip().endswith("%"):
        if not quantity.share:
            raise ValueError(f"{shown(value)}: percent of what? a number in the unit of the figure is expected")
        limit = float(sized_real(value.rstrip()[:-1], context)) / 100
    else:
        limit = float(sized_real(value, context))
    if limit < 0:
        raise ValueError(f"{limit:g} is negative, and no figure is")
    return limit


def _share(value: Any, context: Context) -> float:
    share = 1.0 if value == "all" else _limit(value, Quantity("member", share=True), context)
    if not 0 < share <= 1:
        raise ValueError(f"{shown(value)} is no share of the members: 'all', or for example 95%")
    return share
