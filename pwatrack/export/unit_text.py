"""What a unit is in base units, read off its text."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")

_UNITS: dict[str, tuple[float, dict[str, int]]] = {
    **{name: (1.0, {name: 1}) for name in BASE},
    "g": (1e-3, {"kg": 1}),
    "N": (1.0, {"kg": 1, "m": 1, "s": -2}),
    "J": (1.0, {"kg": 1, "m": 2, "s": -2}),
    "W": (1.0, {"kg": 1, "m": 2, "s": -3}),
    "Pa": (1.0, {"kg": 1, "m": -1, "s": -2}),
    "bar": (1e5, {"kg": 1, "m": -1, "s": -2}),
    "Hz": (1.0, {"s": -1}),
    "C": (1.0, {"A": 1, "s": 1}),
    "V": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -1}),
    "Ohm": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -2}),
    "ohm": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -2}),
    "Ω": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -2}),
    "F": (1.0, {"kg": -1, "m": -2, "s": 4, "A": 2}),
    "H": (1.0, {"kg": 1, "m": 2, "s": -2, "A": -2}),
    "T": (1.0, {"kg": 1, "s": -2, "A": -1}),
    "l": (1e-3, {"m": 3}),
    "L": (1e-3, {"m": 3}),
    "min": (60.0, {"s": 1}),
    "h": (3600.0, {"s": 1}),
    "deg": (pi / 180, {"rad": 1}),
    "rpm": (pi / 30, {"rad": 1, "s": -1}),
    "%": (0.01, {}),
    "1": (1.0, {}),
}
_PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "h": 1e2, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
_CELSIUS = ("degC", "°C")  # alone, else only differences are meant
_PART = re.compile(r"([*·/ ]+|^)([^\W\d_]+|[%°Ω]\w*|1)(?:\^?(-?\d+))?(?=[*·/ ]|$)")


@dataclass(frozen=True)
class BaseUnit:
    """A value v of a unit is factor · v + offset in these powers of base units."""

    powers: Mapping[str, int]
    factor: float
    offset: float


def base_unit(text: str) -> BaseUnit | None:
    """Return a unit in base units, or None where it cannot be read.

    A product has spaces, `*` or `·` between its factors; `/` divides by the next one; a number is a power.

    Example:
        >>> base_unit("mN m/s^2")
        BaseUnit(powers={'kg': 1, 'm': 2, 's': -4}, factor=0.001, offset=0.0)
        >>> base_unit("degC").offset, base_unit("degC/s").powers, base_unit("pieces")
        (273.15, {'s': -1, 'K': 1}, None)
    """
    if text in _CELSIUS:
        return BaseUnit({"K": 1}, 1.0, 273.15)
    powers, factor, place = dict[str, int](), 1.0, 0
    for part in _PART.finditer(text):
        found = _symbol(part[2])
        between = part[1].strip()
        if part.start() != place or found is None or len(between) > 1:
            return None
        place, power = part.end(), int(part[3] or 1) * (-1 if between == "/" else 1)
        factor *= found[0] ** power
        for name, count in found[1].items():
            powers[name] = powers.get(name, 0) + power * count
    if not text or place != len(text):
        return None
    return BaseUnit({name: powers[name] for name in BASE if powers.get(name)}, factor, 0.0)


def _symbol(text: str) -> tuple[float, Mapping[str, int]] | None:
    if text in _CELSIUS:
        return _UNITS["K"]
    if text in _UNITS:
        return _UNITS[text]
    scale, rest = _PREFIXES.get(text[:1]), text[1:]
    if scale is None or rest not in _UNITS or rest in ("kg", "min", "h", "deg", "rpm", "%", "1"):
        return None
    return scale * _UNITS[rest][0], _UNITS[rest][1]
