"""Signals of time whose derivatives are exact: piecewise sums of p(t) e^{λt}."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PPoly

from pwatrack.arrays import Array

ComplexArray = NDArray[np.complex128]
_EPS = float(np.finfo(np.float64).eps)
_SAME = 1e-12  # relative distance below which two exponents λ are one


class NotRepresentable(ValueError):
    """An operation leads out of the class of signals or forms."""


@dataclass(frozen=True)
class ExponentialPolynomial:
    """Σ_λ (c_λ0 + c_λ1 t + …) e^{λt}, real valued: λ comes with its conjugate.

    The class is closed under sums, products and differentiation, and holds
    constants, polynomials, sines, cosines and exponentials of linear arguments.

    Attributes:
        terms: Coefficients c_λ by λ.

    Example:
        >>> t = ExponentialPolynomial.time()
        >>> wave = (3 * t).sin() * (3 * t).sin()
        >>> round(wave(0.5), 6)
        0.994996
    """

    terms: Mapping[complex, ComplexArray]

    @classmethod
    def constant(cls, value: float) -> "ExponentialPolynomial":
        """Return the signal that is `value` at all times."""
        return cls.polynomial([value])

    @classmethod
    def time(cls) -> "ExponentialPolynomial":
        """Return the signal t."""
        return cls.polynomial([0.0, 1.0])

    @classmethod
    def polynomial(cls, coefficients: Sequence[float] | Array) -> "ExponentialPolynomial":
        """Return coefficients[0] + coefficients[1] t + …."""
        return cls({0j: np.array(coefficients, dtype=np.complex128)})

    def __call__(self, t: float) -> float:
        """Return the value at time t."""
        total = sum(np.polyval(c[::-1], t) * np.exp(rate * t) for rate, c in self.terms.items())
        return float(np.real(total))

    def __add__(self, other: "ExponentialPolynomial | float") -> "ExponentialPolynomial":
        """Return the sum."""
        terms = dict(self.terms)
        for rate, c in _lift(other).terms.items():
            _accumulate(terms, rate, c)
        return ExponentialPolynomial(terms)

    def __mul__(self, other: "ExponentialPolynomial | float") -> "ExponentialPolynomial":
        """Return the product."""
        terms: dict[complex, ComplexArray] = {}
        for one, c in self.terms.items():
            for two, d in _lift(other).terms.items():
                _accumulate(terms, one + two, np.convolve(c, d))
        return ExponentialPolynomial(terms)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "ExponentialPolynomial":
        """Return the negative."""
        return self * -1.0

    def __sub__(self, other: "ExponentialPolynomial | float") -> "ExponentialPolynomial":
        """Return the difference."""
        return self + -other

    def __rsub__(self, other: float) -> "ExponentialPolynomial":
        """Return the difference."""
        return -self + other

    def __truediv__(self, other: "ExponentialPolynomial | float") -> "ExponentialPolynomial":
        """Return the quotient by a number."""
        if isinstance(other, ExponentialPolynomial):
            raise NotRepresentable("divides by a function of t")
        return self * (1.0 / other)

    def __rtruediv__(self, other: float) -> "ExponentialPolynomial":
        """Refuse: 1/t has no exact exosystem."""
        raise NotRepresentable("divides by a function of t")

    def __pow__(self, exponent: "ExponentialPolynomial | float") -> "ExponentialPolynomial":
        """Return a power with a whole exponent from 0 to 20."""
        if isinstance(exponent, ExponentialPolynomial) or exponent not in range(21):
            raise NotRepresentable("has an exponent that is not a whole number from 0 to 20")
        result = ExponentialPolynomial.constant(1.0)
        for _ in range(int(exponent)):
            result = result * self
        return result

    def __rpow__(self, base: float) -> "ExponentialPolynomial":
        """Return a power of a positive number, base^(a t + b)."""
        if base <= 0:
            raise NotRepresentable("is a power of a number that is not positive")
        return (self * float(np.log(base))).exp()

    def exp(self) -> "ExponentialPolynomial":
        """Return e^(a t + b)."""
        slope, start = self._line("exp")
        return ExponentialPolynomial({complex(slope): np.array([np.exp(start)], dtype=np.complex128)})

    def sin(self) -> "ExponentialPolynomial":
        """Return the sine of a t + b."""
        slope, start = self._line("sin")
        return _wave(slope, start - np.pi / 2)

    def cos(self) -> "ExponentialPolynomial":
        """Return the cosine of a t + b."""
        return _wave(*self._line("cos"))

    def derivative(self) -> "ExponentialPolynomial":
        """Return the derivative with respect to t."""
        terms: dict[complex, ComplexArray] = {}
        for rate, c in self.terms.items():
            shifted = np.append(c[1:] * np.arange(1, len(c)), 0.0)
            terms[rate] = rate * c + shifted
        return ExponentialPolynomial(terms)

    def delayed(self, delay: float) -> "ExponentialPolynomial":
        """Return the signal t ↦ self(t + delay)."""
        terms = {}
        for rate, c in self.terms.items():
            moved = [
                sum(c[k] * comb(k, j) * delay ** (k - j) for k in range(j, len(c))) * np.exp(rate * delay)
                for j in range(len(c))
            ]
            terms[rate] = np.array(moved, dtype=np.complex128)
        return ExponentialPolynomial(terms)

    def unbounded_term(self) -> str:
        """Say which term grows without bound as t → ∞, or '' if none does."""
        for rate, c in self.terms.items():
            degree = max((k for k in range(len(c)) if abs(c[k]) > 0), default=-1)
            if degree >= 0 and (rate.real > 0 or (rate.real == 0 and degree > 0)):
                return f"a term like exp({rate.real:.4g}*t)" if rate.real > 0 else f"a term like t**{degree}"
        return ""

    def _line(self, function: str) -> tuple[float, float]:
        if set(self.terms) - {0j} or len(np.trim_zeros(self.terms[0j], "b")) > 2:
            raise NotRepresentable(f"is {function} of something that is not linear in t")
        start, slope = np.append(np.trim_zeros(self.terms[0j], "b"), [0.0, 0.0])[:2].real
        return float(slope), float(start)


def _lift(value: "ExponentialPolynomial | float") -> ExponentialPolynomial:
    return value if isinstance(value, ExponentialPolynomial) else ExponentialPolynomial.constant(value)


def _wave(slope: float, phase: float) -> ExponentialPolynomial:
    """Return cos(slope t + phase)."""
    if slope == 0:
        return ExponentialPolynomial.constant(float(np.cos(phase)))
    half = np.array([np.exp(1j * phase) / 2])
    return ExponentialPolynomial({1j * slope: half, -1j * slope: half.conj()})


def _accumulate(terms: dict[complex, ComplexArray], rate: complex, c: ComplexArray) -> None:
    for known in terms:
        if abs(known - rate) <= _SAME * max(abs(known), abs(rate)):
            rate = known
            break
    before = terms.get(rate, np.zeros(0, dtype=np.complex128))
    length = max(len(before), len(c))
    one, two = np.pad(before, (0, length - len(before))), np.pad(c, (0, length - len(c)))
    total = one + two
    total[np.abs(total) <= 8 * _EPS * (np.abs(one) + np.abs(two))] = 0.0  # what cancelled is gone
    terms[rate] = total


@dataclass(frozen=True)
class Signal:
    """A signal made of pieces, each an exponential polynomial of the time since its start.

    Attributes:
        starts: Increasing, the first is 0, in s.
        pieces: One per start.
        end: Last time at which it is defined, or None if it goes on for ever.

    Example:
        >>> ramp = Signal((0.0, 2.0), (ExponentialPolynomial.time(), ExponentialPolynomial.constant(2.0)))
        >>> ramp(1.5), ramp(7.0), ramp(1.5, derivative=1)
        (1.5, 2.0, 1.0)
    """

    starts: tuple[float, ...]
    pieces: tuple[ExponentialPolynomial, ...]
    end: float | None = None

    @classmethod
    def of(cls, formula: ExponentialPolynomial | float) -> "Signal":
        """Return the signal with one formula at all times."""
        return cls((0.0,), (_lift(formula),))

    @classmethod
    def piecewise_polynomial(cls, pieces: PPoly, end: float | None = None) -> "Signal":
        """Return a piecewise polynomial of scipy, from its first break on."""
        coefficients = pieces.c[::-1].T  # rising powers, one row per piece
        formulas = tuple(ExponentialPolynomial.polynomial(row) for row in coefficients)
        return cls(tuple(float(x) for x in pieces.x[:-1]), formulas, end)

    def __call__(self, t: float, derivative: int = 0) -> float:
        """Return a derivative at time t, from the right at a break."""
        k = max(0, int(np.searchsorted(self.starts, t, side="right")) - 1)
        piece = self.pieces[k]
        for _ in range(derivative):
            piece = piece.derivative()
        return piece(t - self.starts[k])

    def __add__(self, other: "Signal") -> "Signal":
        """Return the sum."""
        starts = tuple(sorted({*self.starts, *other.starts}))
        pieces = tuple(self._from(t) + other._from(t) for t in starts)
        ends = [end for end in (self.end, other.end) if end is not None]
        return Signal(starts, pieces, min(ends, default=None))

    def jump(self, order: int) -> tuple[float, float] | None:
        """Return (time, size) of the largest jump of the derivative of this order, or None if there is none.

        Sizes within 1e-9 of the derivative's own size are rounding.
        """
        worst, where, scale = 0.0, 0.0, 0.0
        for k in range(1, len(self.starts)):
            before, after = self.pieces[k - 1], self.pieces[k]
            for _ in range(order):
                before, after = before.derivative(), after.derivative()
            span = self.starts[k] - self.starts[k - 1]
            left, right = before(span), after(0.0)
            size = max(abs(left), abs(right), abs(before(span / 2)))
            scale = max(scale, size * (1 + 1e9 * _EPS * self.starts[k] / span))  # the break itself is rounded
            if abs(right - left) > worst:
                worst, where = abs(right - left), self.starts[k]
        return (where, worst) if worst > 1e-9 * scale else None

    def _from(self, t: float) -> ExponentialPolynomial:
        k = max(0, int(np.searchsorted(self.starts, t, side="right")) - 1)
        return self.pieces[k].delayed(t - self.starts[k]) if t != self.starts[k] else self.pieces[k]
