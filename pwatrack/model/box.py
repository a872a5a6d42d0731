"""Parameters that are known to lie in intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pwatrack.arrays import number_text
from pwatrack.real import Real


@dataclass(frozen=True, kw_only=True)
class Uncertain:
    """A parameter that may have any value of an interval."""

    name: str
    nominal: Real  # its value in the design
    low: Real
    high: Real
    uses: frozenset[str] = frozenset()  # the parameters that its value is made of in the file

    def scaled(self, factor: Real) -> "Uncertain":
        """Return the interval with both ends so many times as far away from the value of the design."""
        low, high = (self.nominal + factor * (end - self.nominal) for end in (self.low, self.high))
        return replace(self, low=low, high=high)

    @property
    def text(self) -> str:
        """Say what it is."""
        return f"{self.name} in [{number_text(float(self.low), 'g')}, {number_text(float(self.high), 'g')}]"


Box = tuple[Uncertain, ...]


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
