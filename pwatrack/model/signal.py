"""Signals of time whose derivatives are exact: piecewise sums of p(t) e^{λt}."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
import scipy
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from pwatrack.arrays import EPS, Array
from pwatrack.real import Ring

ComplexArray = NDArray[np.complex128]
_JUMP = 1e-9  # of a derivative's own size: what it jumps by less is rounding
_SAME = 1e-12  # relative distance below which two exponents λ are one
_MOST_COEFFICIENTS = 100  # of one signal: as many states of the exosystem
_HIGHEST = 20  # power of t
LARGEST = 1e60  # number: products of a few stay finite, and those of the smallest do not vanish


class NotRepresentable(ValueError):
    """An operation leads out of the class of signals or forms."""


@dataclass(frozen=True)
class ExponentialPolynomial(Ring):
    """Σ_λ (c_λ0 + c_λ1 t + …) e^{λt}, real valued: λ comes with its conjugate.

    It is closed under sums, products and differentiation: constants, polynomials, sines, cosines and exponentials.

    Example:
        >>> t = ExponentialPolynomial.time()
        >>> wave = (3 * t).sin() * (3 * t).sin()
        >>> round(wave(0.5), 6)
        0.994996
    """

    terms: Mapping[complex, ComplexArray]  # coefficients c_λ by λ

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
        terms = dict(self.terms)
        for rate, c in _lift(other).terms.items():
            _accumulate(terms, rate, c)
        return ExponentialPolynomial(terms)

    def __mul__(self, other: "ExponentialPolynomial | float") -> "ExponentialPolynomial":
        terms: dict[complex, ComplexArray] = {}
        for one, c in self.terms.items():
            for two, d in _lift(other).terms.items():
                _accumulate(terms, one + two, np.convolve(c, d))
                ExponentialPolynomial(terms).check_size()
        return ExponentialPolynomial(terms)

    __radd__, __rmul__ = __add__, __mul__

    def __truediv__(self, other: "ExponentialPolynomial | float") -> "ExponentialPolynomial":
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
        result = ExponentialPolynomial({complex(slope): np.array([np.exp(start)], dtype=np.complex128)})
        result.check_size()
        return result

    def sin(self) -> "ExponentialPolynomial":
        """Return the sine of a t + b."""
        slope, start = self._line("sin")
        return _wave(slope, start - np.pi / 2)

    def cos(self) -> "ExponentialPolynomial":
        """Return the cosine of a t + b."""
        return _wave(*self._line("cos"))

    def check_size(self) -> None:
        """Refuse what is too large before it grows further: products of sums, and powers of them, grow without end."""
        lengths = [len(c) for c in self.terms.values()]
        count, highest = sum(lengths), max(lengths, default=1) - 1
        if highest > _HIGHEST:
            raise NotRepresentable(f"has t to a power of {highest}, at most {_HIGHEST} is read")
        if count > _MOST_COEFFICIENTS:
            raise NotRepresentable(
                f"has {count} terms or more when multiplied out, at most {_MOST_COEFFICIENTS} are read"
            )
        largest = max((float(np.abs(c).max(initial=0.0)) for c in self.terms.values()), default=0.0)
        if not largest <= LARGEST or not np.isfinite(list(self.terms)).all():
            raise NotRepresentable(f"has a coefficient beyond {LARGEST:g}")

    def derivative(self) -> "ExponentialPolynomial":
        """Return the derivative with respect to t."""
        shifted = {rate: np.append(c[1:] * np.arange(1, len(c)), 0.0) for rate, c in self.terms.items()}
        return ExponentialPolynomial({rate: rate * c + shifted[rate] for rate, c in self.terms.items()})

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
                power = "t" if degree == 1 else f"t**{degree}"
                return f"a term like {f'exp({rate.real:.4g}*t)' if rate.real > 0 else power}"
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
    if rate not in terms:
        rate = next((known for known in terms if abs(known - rate) <= _SAME * max(abs(known), abs(rate))), rate)
    before = terms.get(rate, np.zeros(0, dtype=np.complex128))
    length = max(len(before), len(c))
    one, two = np.pad(before, (0, length - len(before))), np.pad(c, (0, length - len(c)))
    total = one + two
    total[np.abs(total) <= 8 * EPS * (np.abs(one) + np.abs(two))] = 0.0  # what cancelled is gone
    terms[rate] = total


@dataclass(frozen=True)
class Signal:
    """A signal made of pieces, each an exponential polynomial of the time since its start."""

    starts: tuple[float, ...]  # increasing, the first is 0, in s
    pieces: tuple[ExponentialPolynomial, ...]  # one per start
    end: float | None = None  # last time at which it is defined, or None if it goes on for ever

    @classmethod
    def of(cls, formula: ExponentialPolynomial | float) -> "Signal":
        """Return the signal with one formula at all times."""
        return cls((0.0,), (_lift(formula),))

    @classmethod
    def piecewise_polynomial(cls, pieces: "scipy.interpolate.PPoly", end: float | None = None) -> "Signal":
        """Return a piecewise polynomial of scipy, from t = 0 on."""
        first = max(0, int(np.searchsorted(pieces.x, 0.0, side="right")) - 1)
        coefficients = pieces.c[::-1, first:].T  # rising powers, one row per piece
        formulas = [ExponentialPolynomial.polynomial(row) for row in coefficients]
        formulas[0] = formulas[0].delayed(-float(pieces.x[first]))
        return cls((0.0, *pieces.x[first + 1 : -1].tolist()), tuple(formulas), end)

    def __call__(self, t: float, derivative: int = 0) -> float:
        """Return a derivative at time t, from the right at a break."""
        k = max(0, bisect_right(self.starts, t) - 1)
        piece = self.pieces[k]
        for _ in range(derivative):
            piece = piece.derivative()
        return piece(t - self.starts[k])

    def __add__(self, other: "Signal") -> "Signal":
        end = min((end for end in (self.end, other.end) if end is not None), default=None)
        starts = tuple(t for t in sorted({*self.starts, *other.starts}) if end is None or t < end or t == 0)
        pieces = tuple(self._from(t) + other._from(t) for t in starts)
        return Signal(starts, pieces, end)

    def jump(self, order: int) -> tuple[float, float] | None:
        """Return (time, size) of the first of the largest jumps of a derivative that are no rounding, or None."""
        terms = self.stacked()
        for _ in range(order):
            for rate, c in terms.items():
                terms[rate] = rate * c + np.pad(c[:, 1:] * np.arange(1, c.shape[1]), ((0, 0), (0, 1)))
        starts = np.array(self.starts)
        span = np.diff(starts)
        if not len(span):
            return None
        nothing = np.zeros(len(starts), dtype=np.complex128)
        with np.errstate(all="ignore"):  # what grows may be out of range: then it is no number, and no jump
            left, middle, right = (
                sum((polyval(t, c.T, tensor=False) * np.exp(rate * t) for rate, c in terms.items()), nothing).real
                for t in (np.append(span, 0.0), np.append(span, 0.0) / 2, 0 * starts)
            )
            size = np.maximum(np.maximum(np.abs(left), np.abs(middle))[:-1], np.abs(right[1:]))
            scale = float((size * (1 + EPS / _JUMP * starts[1:] / span)).max())  # the break itself is rounded
            gap = np.abs(right[1:] - left[:-1])
        worst = int(np.argmax(gap >= (1 - _JUMP) * gap.max()))
        return (self.starts[worst + 1], float(gap[worst])) if gap[worst] > _JUMP * scale else None

    def stacked(self) -> dict[complex, ComplexArray]:
        """Return the coefficients of all pieces by λ, each (pieces, longest)."""
        longest: dict[complex, int] = {}
        for piece in self.pieces:
            for rate, c in piece.terms.items():
                longest[rate] = max(longest.get(rate, 0), len(c))
        found = {rate: np.zeros((len(self.pieces), n), dtype=np.complex128) for rate, n in longest.items()}
        for k, piece in enumerate(self.pieces):
            for rate, c in piece.terms.items():
                found[rate][k, : len(c)] = c
        return found

    def _from(self, t: float) -> ExponentialPolynomial:
        k = max(0, bisect_right(self.starts, t) - 1)
        return self.pieces[k].delayed(t - self.starts[k]) if t != self.starts[k] else self.pieces[k]
