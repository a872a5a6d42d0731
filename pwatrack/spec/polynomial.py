"""Sums of products of powers of parameters: how an expression depends on them, exactly."""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

from pwatrack.model.signal import NotRepresentable
from pwatrack.real import Number, Real

Powers = tuple[tuple[str, int], ...]  # by name, sorted, none of them 0
_MOST_TERMS = 500  # of a polynomial in parameters: longer ones are slow to multiply
_MOST_POWER = 20  # of a parameter: nobody writes more


@dataclass(frozen=True)
class Polynomial:
    """Σ c p₁^k₁ p₂^k₂ … with whole exponents, of either sign.

    Attributes:
        terms: c of each product of powers; what is exactly 0 is not there.

    Example: the stiffness k over the mass m, and what is left where m cancels.

        >>> k, m = Polynomial.of("k"), Polynomial.of("m")
        >>> [list(p.terms) for p in (2 * k / m, m * k / m + 1)]
        [[(('k', 1), ('m', -1))], [(('k', 1),), ()]]
    """

    terms: Mapping[Powers, Real]

    @staticmethod
    def of(value: "Polynomial | Real | Fraction | float | str") -> "Polynomial":
        """Return a number, or the parameter of a name, as a polynomial."""
        if isinstance(value, Polynomial):
            return value
        if isinstance(value, str):
            return Polynomial({((value, 1),): Real.of(1)})
        return _kept({(): Real.of(value)})

    def __add__(self, other: object) -> "Polynomial":
        """Return the sum."""
        if not isinstance(other, (Polynomial, *Number)):
            return NotImplemented
        terms = dict(self.terms)
        for powers, c in Polynomial.of(other).terms.items():
            terms[powers] = terms[powers] + c if powers in terms else c
        return _kept(terms)

    __radd__ = __add__

    def __neg__(self) -> "Polynomial":
        """Return the negative."""
        return self * -1

    def __sub__(self, other: object) -> "Polynomial":
        """Return the difference."""
        return self + -Polynomial.of(other) if isinstance(other, (Polynomial, *Number)) else NotImplemented

    def __rsub__(self, other: object) -> "Polynomial":
        """Return the difference."""
        return -self + other

    def __mul__(self, other: object) -> "Polynomial":
        """Return the product."""
        if not isinstance(other, (Polynomial, *Number)):
            return NotImplemented
        terms = dict[Powers, Real]()
        for one, a in self.terms.items():
            for two, b in Polynomial.of(other).terms.items():
                powers = _product(one, two)
                terms[powers] = terms[powers] + a * b if powers in terms else a * b
        return _kept(terms)

    __rmul__ = __mul__

    def __truediv__(self, other: object) -> "Polynomial":
        """Return the quotient by a single product of powers.

        Raises:
            NotRepresentable: If the divisor is a sum.
        """
        if not isinstance(other, (Polynomial, *Number)):
            return NotImplemented
        divisor = Polynomial.of(other)
        if not divisor.terms:
            raise ZeroDivisionError("division by zero")
        if len(divisor.terms) > 1:
            raise NotRepresentable("divides by a sum of parameters")
        ((powers, c),) = divisor.terms.items()
        return self * Polynomial({tuple((name, -k) for name, k in powers): 1 / c})

    def __rtruediv__(self, other: object) -> "Polynomial":
        """Return the quotient."""
        return Polynomial.of(other) / self if isinstance(other, Number) else NotImplemented

    def __pow__(self, other: object) -> "Polynomial":
        """Return a whole power.

        Raises:
            NotRepresentable: If the exponent is no whole number of modest size.
        """
        exponent = Real.of(other) if isinstance(other, Number) else None
        if exponent is None or not exponent.exact or exponent.centre.denominator != 1:
            raise NotRepresentable("is no whole power")
        if abs(exponent.centre) > _MOST_POWER:
            raise NotRepresentable(f"is a power above {_MOST_POWER}")
        power = Polynomial.of(1)
        for _ in range(abs(int(exponent.centre))):
            power = power * self
        return power if exponent.centre >= 0 else 1 / power

    def __rpow__(self, other: object) -> "Polynomial":
        """Refuse: a parameter in an exponent."""
        raise NotRepresentable("is no whole power")


def _product(one: Powers, two: Powers) -> Powers:
    total = dict(one)
    for name, k in two:
        total[name] = total.get(name, 0) + k
    return tuple(sorted((name, k) for name, k in total.items() if k))


def _kept(terms: Mapping[Powers, Real]) -> Polynomial:
    """Return the polynomial without the terms that are exactly 0."""
    kept = {powers: c for powers, c in terms.items() if c.centre or c.radius}
    if len(kept) > _MOST_TERMS:
        raise NotRepresentable(f"has more than {_MOST_TERMS} terms")
    return Polynomial(kept)
