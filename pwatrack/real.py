"""Numbers of a description: exact decimals and fractions, and what is only known to lie in a ball around one."""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

_BITS = 128  # of the arithmetic that encloses sines, roots and the like


@dataclass(frozen=True, slots=True)
class Real:
    """A number within `radius` of a rational centre; a radius of 0 makes it exact.

    Sums, products and whole powers of exact numbers are exact. What is irrational, such as 2*pi, is a double with a
    ball around it. The same expression always has the same centre, so what cancels does so exactly.

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
        """Return a number as it is printed: 0.1 is one tenth, not the double next to it.

        Raises:
            ValueError: If it is not finite.
        """
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
        """Return the double nearest to the centre."""
        return float(self.centre)

    def __add__(self, other: "Real | int | float | Fraction") -> "Real":
        """Return the sum."""
        other = Real.of(other)
        return Real(self.centre + other.centre, self.radius + other.radius)

    def __mul__(self, other: "Real | int | float | Fraction") -> "Real":
        """Return the product."""
        other = Real.of(other)
        a, b = abs(self.centre), abs(other.centre)
        return Real(self.centre * other.centre, a * other.radius + b * self.radius + self.radius * other.radius)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "Real":
        """Return the negative."""
        return Real(-self.centre, self.radius)

    def __sub__(self, other: "Real | int | float | Fraction") -> "Real":
        """Return the difference."""
        return self + -Real.of(other)

    def __rsub__(self, other: "int | float | Fraction") -> "Real":
        """Return the difference."""
        return Real.of(other) - self

    def __truediv__(self, other: "Real | int | float | Fraction") -> "Real":
        """Return the quotient.

        Raises:
            ZeroDivisionError: If the divisor may be 0.
        """
        other = Real.of(other)
        if abs(other.centre) <= other.radius:
            raise ZeroDivisionError("division by zero")
        least = abs(other.centre) - other.radius
        inverse = Real(1 / other.centre, other.radius / (abs(other.centre) * least))
        return self * inverse

    def __rtruediv__(self, other: "int | float | Fraction") -> "Real":
        """Return the quotient."""
        return Real.of(other) / self

    def __abs__(self) -> "Real":
        """Return the size."""
        return Real(abs(self.centre), self.radius)

    def power(self, exponent: int) -> "Real":
        """Return a whole power.

        Raises:
            ZeroDivisionError: If a negative power is taken of what may be 0.
        """
        if exponent < 0:
            return 1 / self.power(-exponent)
        result, square = Real(Fraction(1)), self
        while exponent:
            result = result * square if exponent & 1 else result
            exponent >>= 1
            square = square * square if exponent else square
        return result

    def applied(self, name: str, *others: "Real") -> "Real":
        """Return a function of real numbers, such as sqrt or atan2: the nearest double with a ball around it.

        Raises:
            ValueError: If it is not defined there, or not finite.
        """
        return enclosed(lambda *x: getattr(x[0], name)(*x[1:]), self, *others)


def enclosed(function: Callable[..., object], *arguments: Real) -> Real:
    """Return a function of balls as a double with a ball around it.

    Args:
        function: Takes and returns FLINT's `arb`.
        arguments: Where it is evaluated.

    Raises:
        ValueError: If it is not defined there, or not finite.

    Example:
        >>> from flint import arb
        >>> tau = enclosed(lambda: 2 * arb.pi())
        >>> float(tau), 0 < tau.radius < Fraction(1, 2**51)
        (6.283185307179586, True)
    """
    import flint

    before = flint.ctx.prec
    flint.ctx.prec = _BITS
    try:
        balls = []
        for argument in arguments:
            middle = flint.arb(flint.fmpq(argument.centre.numerator, argument.centre.denominator))
            spread = flint.fmpq(argument.radius.numerator, argument.radius.denominator)
            balls.append(middle + flint.arb(0, flint.arb(spread).upper()) if argument.radius else middle)
        value = function(*balls)
    finally:
        flint.ctx.prec = before
    if not value.is_finite():  # type: ignore[attr-defined]
        raise ValueError("it is not defined, or not finite")
    centre, away = (_dyadic(part) for part in (value.mid(), value.rad()))  # type: ignore[attr-defined]
    nearest = Fraction(float(centre))
    return Real(nearest, abs(centre - nearest) + away)


def _dyadic(value: object) -> Fraction:
    """Return an exact arb as a fraction."""
    mantissa, exponent = value.man_exp()  # type: ignore[attr-defined]
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)
