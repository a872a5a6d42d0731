"""Numbers with a unit of their own, such as '0.5 mm' of what is in m; Pint knows the units."""

import re
from typing import Any

from pwatrack.spec.wording import shown

_WITH_UNIT = re.compile(r"(.*?[\w.)])\s+([A-Za-zµμΩ°].*)")


def split(text: str) -> tuple[str, str]:
    """Return the number of a text, and the unit behind it; '' where there is none.

    Example:
        >>> split("0.5 mm"), split("2*k N m"), split("a + b"), split("1e-3")
        (('0.5', 'mm'), ('2*k', 'N m'), ('a + b', ''), ('1e-3', ''))
    """
    found = _WITH_UNIT.fullmatch(text.strip())
    return (found[1], found[2]) if found else (text, "")


def times(unit: str, into: str) -> float:
    """Return by what a number in one unit is multiplied to be in another.

    Raises:
        ValueError: If these are not of one kind, or a unit is not known.

    Example:
        >>> times("mm", "m"), times("N", "N"), round(times("deg", "rad"), 6)
        (0.001, 1.0, 0.017453)
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
    if zero:  # degrees that begin elsewhere: of a difference other numbers would be right than of a temperature
        raise ValueError(f"{shown(unit)} begins at another zero than {shown(into)}: give the number in that")
    return one
