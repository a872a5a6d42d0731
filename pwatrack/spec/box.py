"""Parameters that are known to lie in intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pwatrack.arrays import number_text
from pwatrack.causes import Subject
from pwatrack.errors import Problem
from pwatrack.real import Real
from pwatrack.spec.design_section import DesignSection
from pwatrack.spec.names import unknown_names
from pwatrack.spec.paths import path_text
from pwatrack.spec.wording import shown

SUBJECT: Subject = ("design", "uncertain")


@dataclass(frozen=True, kw_only=True)
class Uncertain:
    """A parameter that may have any value of an interval.

    Attributes:
        name: Of the parameter.
        nominal: Its value in the design.
        low, high: The ends.
    """

    name: str
    nominal: Real
    low: Real
    high: Real

    def scaled(self, factor: Real) -> "Uncertain":
        """Return the interval with both ends so many times as far away from the value of the design."""
        low, high = (self.nominal + factor * (end - self.nominal) for end in (self.low, self.high))
        return Uncertain(name=self.name, nominal=self.nominal, low=low, high=high)

    @property
    def text(self) -> str:
        """Say what it is."""
        return f"{self.name} in [{number_text(float(self.low), 'g')}, {number_text(float(self.high), 'g')}]"


Box = tuple[Uncertain, ...]


def box_problems(section: DesignSection, values: Mapping[str, Real | None]) -> list[Problem]:
    """Check that what is uncertain is a parameter whose interval contains its value."""
    where = path_text(SUBJECT)
    problems = [
        Problem(message=f"{where}: {shown(name)} is no parameter{meant}", subject=(*SUBJECT, name))
        for name, meant in unknown_names(section.uncertain, values)
    ]
    for name, given in section.uncertain.items():
        nominal = values.get(name)
        if nominal is None:
            continue
        low, high = _interval(nominal, given)
        if not low.centre < high.centre:
            message = f"{where}.{name}: a share of a value that is 0 is no interval"
            problems.append(Problem(message=message, subject=(*SUBJECT, name), hint="write [low, high]"))
        elif not low.centre <= nominal.centre <= high.centre:
            message = f"{where}.{name}: the value of the design, {float(nominal):g}, is not in it"
            problems.append(Problem(message=message, subject=(*SUBJECT, name)))
    return problems


def build_box(section: DesignSection, values: Mapping[str, Real | None]) -> Box:
    """Return what is uncertain, of a section without a fault."""
    box = []
    for name, given in section.uncertain.items():
        nominal = values[name]
        assert nominal is not None
        low, high = _interval(nominal, given)
        box.append(Uncertain(name=name, nominal=nominal, low=low, high=high))
    return tuple(box)


def _interval(nominal: Real, given: Real | tuple[Real, Real]) -> tuple[Real, Real]:
    if isinstance(given, tuple):
        return given
    low, high = nominal * (1 - given), nominal * (1 + given)
    return (low, high) if low.centre < high.centre else (high, low)


def inside(box: Sequence[Uncertain], parameters: Mapping[str, float]) -> bool:
    """Say whether a plant with some parameters changed is one of the box."""
    known = {interval.name: (float(interval.low), float(interval.high)) for interval in box}
    return all(name in known and known[name][0] <= value <= known[name][1] for name, value in parameters.items())
