"""Numbers of a description: exact decimals and fractions, and what is only known to lie in a ball around one.

And parameters that are known to lie in intervals.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Protocol, Self

from pwatrack.arrays import EPS, outward

_BITS = 128  # of the arithmetic that encloses sines, roots and the like
_KEPT = 80  # of what it gives: more make exact arithmetic slow, and the 53 of doubles are too few for thin tubes
_MOST_BITS = 16_384  # of a fraction
_EPS = Fraction(1, 2**50)  # more than a rounding of a double, of its size
_TINY = Fraction(1, 2**1060)  # the same where doubles lose digits


class Ring(Protocol):
    """What can be added and multiplied, so that differences are known too."""

    __slots__ = ()

    def __add__(self, other: Any, /) -> Self: ...

    def __mul__(self, other: Any, /) -> Self: ...

    def __neg__(self) -> Self:
        return self.__mul__(-1)

    def __sub__(self, other: Any, /) -> Self:
        return self.__add__(-other)

    def __rsub__(self, other: Any, /) -> Self:
        return (-self).__add__(other)


@dataclass(frozen=True, slots=True)
class Real(Ring):
    """A number within `radius` of a rational centre; a radius of 0 makes it exact.

    Sums, products and whole powers of exact numbers are exact. What is irrational, such as 2*pi, is 80 binary
    digits with a ball around them. The same expression always has the same centre, so what cancels does so exactly.

    Example:
        >>> Real.of("0.3") - 3 * Real.of("0.1")
        Real(centre=Fraction(0, 1), radius=Fraction(0, 1))
        >>> half = Real.of(0.25).applied("sqrt")
        >>> float(half), half.radius <= Fraction(1, 2**53)
        (0.5, True)
    """

    centre: Fraction
    radius: Fraction = Fraction(0)

    @classmethod
    def of(cls, value: "Real | Fraction | int | float | str") -> "Real":
        """Return a number as it is printed: 0.1 is one tenth, not the double next to it; inf is a ValueError."""
        if isinstance(value, Real):
            return value
        try:
            return cls(Fraction(repr(float(value))) if isinstance(value, float) else Fraction(value))
        except (ValueError, OverflowError):
            raise ValueError(f"{value} is not a finite number") from None

    @property
    def exact(self) -> bool:
        """Whether nothing is left open."""
        return not self.radius

    def __float__(self) -> float:
        return float(self.centre)

    def __add__(self, other: object) -> "Real":
        if not isinstance(other, Number):
            return NotImplemented
        other = Real.of(other)
        return Real(self.centre + other.centre, self.radius + other.radius)

    def __mul__(self, other: object) -> "Real":
        if not isinstance(other, Number):
            return NotImplemented
        other = Real.of(other)
        if not (self.radius or other.radius):
            return Real(self.centre * other.centre)
        a, b = abs(self.centre), abs(other.centre)
        return Real(self.centre * other.centre, a * other.radius + b * self.radius + self.radius * other.radius)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "Real":
        return Real(-self.centre, self.radius)

    def __truediv__(self, other: object) -> "Real":
        """Return the quotient; ZeroDivisionError if the divisor may be 0."""
        if not isinstance(other, Number):
            return NotImplemented
        other = Real.of(other)
        least = abs(other.centre) - other.radius
        if least <= 0:
            raise ZeroDivisionError("division by zero")
        return self * Real(1 / other.centre, other.radius / (abs(other.centre) * least))

    def __rtruediv__(self, other: object) -> "Real":
        return Real.of(other) / self if isinstance(other, Number) else NotImplemented

    def __abs__(self) -> "Real":
        return Real(abs(self.centre), self.radius)

    def __pow__(self, other: object) -> "Real":
        """Return the power: exactly where the exponent is a whole number of modest size; raises as `enclosed`."""
        if not isinstance(other, Number):
            return NotImplemented
        other = Real.of(other)
        exponent = int(other.centre)
        if other.exact and exponent == other.centre:
            if exponent < 0:
                return 1 / self ** (-exponent)
            if exponent * self.bits <= _MOST_BITS:
                power = self.centre**exponent
                spread = (abs(self.centre) + self.radius) ** exponent - abs(power) if self.radius else Fraction(0)
                return Real(power, spread)
        return enclosed(lambda x, y: x**y, self, other)

    def __rpow__(self, other: object) -> "Real":
        return Real.of(other) ** self if isinstance(other, Number) else NotImplemented

    def __lt__(self, other: "Real") -> bool:
        return self.centre < other.centre

    @property
    def bits(self) -> int:
        """The length of the centre's fraction."""
        return self.centre.numerator.bit_length() + self.centre.denominator.bit_length()

    def shortened(self) -> "Real":
        """Return a double in a ball around a number whose fraction is too long to work with, or OverflowError."""
        if self.bits <= _MOST_BITS and self.radius.denominator.bit_length() <= _MOST_BITS:
            return self
        nearest, radius = Fraction(float(self.centre)), Fraction(float(self.radius))
        return Real(nearest, radius * (1 + _EPS) + abs(nearest) * _EPS + _TINY)

    def applied(self, name: str) -> "Real":
        """Return a function such as sqrt, with a ball around it; raises as `enclosed`."""
        return enclosed(lambda x: getattr(x, name)(), self)


def enclosed(function: Callable[..., Any], *arguments: Real) -> Real:
    """Return a function of balls, of FLINT's `arb`, as 80 binary digits with a ball around them.

    Raises ValueError if it is not defined there, OverflowError if it is beyond all doubles.
    """
    import flint

    with flint.ctx.workprec(_BITS):
        balls = []
        for argument in arguments:
            middle = flint.arb(flint.fmpq(argument.centre.numerator, argument.centre.denominator))
            spread = flint.fmpq(argument.radius.numerator, argument.radius.denominator)
            balls.append(middle + flint.arb(0, flint.arb(spread).upper()) if argument.radius else middle)
        value = function(*balls)
    if value.is_nan() or not value.is_finite():
        raise ValueError("has no real value there")
    if value.abs_upper() < flint.arb(2) ** -1060:
        return Real(Fraction(0), Fraction(0) if value.is_zero() else _TINY)
    if value.abs_upper() > flint.arb(2) ** 1024:
        raise OverflowError("not finite")
    with flint.ctx.workprec(_KEPT):
        kept = value * 1
    centre, away = dyadic(kept.mid()), dyadic(kept.rad())
    nearest = Fraction(float(centre))  # cos(pi) is -1
    return Real(nearest, abs(centre - nearest) + away) if abs(centre - nearest) <= away else Real(centre, away)


def dyadic(value: Any) -> Fraction:
    """Return a ball without a radius as a fraction."""
    mantissa, exponent = value.man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


Number = (Real, Fraction, int, float)  # what a Real is added to, multiplied by, divided by


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
        sides = (float(self.low), 1), (float(self.high), -1)  # inward: what is said of it is proved
        return f"{self.name} in [{', '.join(outward(*end, 8 * EPS, digits=6) for end in sides)}]"


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
