"""Parameters that are known to lie in intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pwatrack.arrays import number_text
from pwatrack.causes import Subject
from pwatrack.real import Real
from pwatrack.spec.design_section import DesignSection, interval
from pwatrack.spec.parametric import ParametricPlant

SUBJECT: Subject = ("design", "uncertain")


@dataclass(frozen=True, kw_only=True)
class Uncertain:
    """A parameter that may have any value of an interval.

    Attributes:
        name: Of the parameter.
        nominal: Its value in the design.
        low, high: The ends.
        uses: The parameters that its value is made of in the file.
    """

    name: str
    nominal: Real
    low: Real
    high: Real
    uses: frozenset[str] = frozenset()

    def scaled(self, factor: Real) -> "Uncertain":
        """Return the interval with both ends so many times as far away from the value of the design."""
        low, high = (self.nominal + factor * (end - self.nominal) for end in (self.low, self.high))
        return replace(self, low=low, high=high)

    @property
    def text(self) -> str:
        """Say what it is."""
        return f"{self.name} in [{number_text(float(self.low), 'g')}, {number_text(float(self.high), 'g')}]"


Box = tuple[Uncertain, ...]


def build_box(section: DesignSection, parametric: ParametricPlant) -> Box:
    """Return what is uncertain, of a section without a fault."""
    box, uses = [], parametric.uses if section.uncertain else {}
    for name, given in section.uncertain.items():
        nominal = parametric.names.parameters[name]
        assert nominal is not None
        low, high = interval(nominal, given)
        box.append(Uncertain(name=name, nominal=nominal, low=low, high=high, uses=uses[name]))
    return tuple(box)


def inside(box: Sequence[Uncertain], parameters: Mapping[str, float]) -> bool:
    """Say whether a plant with some parameters changed is one of the box; False where others follow these in the file.

    Example: d may be 1 % off, and is not, by itself, where it is made of m.

        >>> one, zero = Real.of(1), Real.of(0)
        >>> m = Uncertain(name="m", nominal=one, low=zero, high=Real.of(2))
        >>> d = Uncertain(name="d", nominal=one, low=Real.of("0.99"), high=Real.of("1.01"), uses=frozenset(["m"]))
        >>> inside((m,), {"m": 2.0}), inside((m, d), {"m": 2.0}), inside((m, d), {"m": 2.0, "d": 1.0})
        (True, False, True)
    """
    known = {interval.name: (float(interval.low), float(interval.high)) for interval in box}
    follow = any(interval.name not in parameters and interval.uses & parameters.keys() for interval in box)
    return not follow and all(n in known and known[n][0] <= value <= known[n][1] for n, value in parameters.items())
