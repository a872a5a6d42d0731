"""Parameters that vary in a sweep: evenly on a grid, or through given values."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Annotated

from pydantic import ConfigDict, Discriminator, Field, Tag

from pwatrack.errors import InvalidSpec
from pwatrack.real import Real
from pwatrack.spec.entries import Exact, Name, Whole, increasing, must, whole
from pwatrack.spec.section import Context, Fault, Section

_TEXT = re.compile(r"\s*(\w+)\s*=\s*([^:]+):([^:]+)(?::\s*(\d{1,12})\s*)?")
MOST = 1_000_000  # of a sweep: more than anyone waits for
_POINTS = 11  # of an axis that says no number: ten steps


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A parameter that varies over a range, at its values on a grid, or has no other values than these."""

    name: str
    values: tuple[Fraction, ...]  # in increasing order
    between: bool = False  # whether all in between may be taken, too

    @staticmethod
    def over(name: str, low: Fraction, high: Fraction, points: int = _POINTS) -> "Axis":
        """Return a parameter that varies over a range, with points of a grid."""
        values = (low + (high - low) * Fraction(k, points - 1) for k in range(points))
        return Axis(name=name, values=tuple(values), between=True)

    @property
    def width(self) -> float:
        """How far its values are apart."""
        return float(self.values[-1] - self.values[0])

    def at(self, share: float) -> float:
        """Return the value at a share of the way, 0 to 1; of given values, the one that has this share of them."""
        if self.between:
            return float(self.values[0] + (self.values[-1] - self.values[0]) * Fraction(share))
        return float(self.values[min(int(share * len(self.values)), len(self.values) - 1)])


def axis(text: str) -> Axis:
    """Return a parameter's range, written as NAME=LOW:HIGH:POINTS."""
    found = _TEXT.fullmatch(text)
    try:
        if found is None:
            raise ValueError
        low, high = Fraction(found[2].strip()), Fraction(found[3].strip())
    except (ValueError, ZeroDivisionError):
        raise InvalidSpec(f"--sweep {text}: expected NAME=LOW:HIGH:POINTS, such as --sweep k2=0.1:0.9:17") from None
    points = int(found[4] or _POINTS)
    if points > MOST:
        raise InvalidSpec(f"--sweep {text}: {points:,} points, at most {MOST:,} are looked at")
    if not low < high or points < 2:
        raise InvalidSpec(f"--sweep {text}: LOW is to be below HIGH, with at least two points")
    return Axis.over(found[1], low, high, points)


class RangeSection(Section):
    """From where to where a parameter varies in a sweep, and at how many points of a grid."""

    model_config = ConfigDict(json_schema_extra=increasing("from", "to"))

    start: Annotated[Exact, Field(alias="from")]
    to: Exact
    points: Annotated[Whole, Field(ge=2, le=MOST), whole(2, MOST)] = _POINTS

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield a range that goes nowhere."""
        if not self.start.centre < self.to.centre:
            yield Fault(f": from {float(self.start):g} is not below to {float(self.to):g}")


_INCREASING = must(
    lambda values: all(one.centre < other.centre for one, other in pairwise(values)),
    "values in increasing order are expected",
)
SweepSection = dict[
    Name,
    Annotated[
        Annotated[RangeSection, Tag("a range")]
        | Annotated[list[Exact], _INCREASING, Field(min_length=1, max_length=MOST), Tag("values")],
        Discriminator(lambda value: "values" if isinstance(value, list) else "a range"),
    ],
]


def axes_of(section: Mapping[str, RangeSection | list[Real]]) -> list[Axis]:
    """Return the parameters that a file says vary."""
    return [
        Axis(name=name, values=tuple(value.centre for value in entry))
        if isinstance(entry, list)
        else Axis.over(name, entry.start.centre, entry.to.centre, entry.points)
        for name, entry in section.items()
    ]
