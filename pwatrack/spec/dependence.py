"""How the field of the plant (1) depends on parameters: every entry of A_i, b_i and B, from all its factors.

A scalar element adds direction · φ(row · x + constant). Its breakpoints, row and constant being known, slopes and
intercepts of φ are linear in the numbers that `SHAPE` lists, so its entries are sums of a factor of `into`, one of
these numbers, and what φ is where this number is 1 and the others are 0.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from pwatrack.arrays import number_text
from pwatrack.causes import Subject
from pwatrack.errors import OutsideTheory, Problem
from pwatrack.model.nonlinearity import PiecewiseLinear
from pwatrack.model.signal import NotRepresentable
from pwatrack.real import Number, Real
from pwatrack.spec.expression import Expression, ExpressionError, real
from pwatrack.spec.parametric import ParametricPlant
from pwatrack.spec.plant_section import Element
from pwatrack.spec.wording import shown
from pwatrack.spec.yaml_tree import path_text

Powers = tuple[tuple[str, int], ...]  # by name, sorted, none of them 0
_MOST_TERMS = 500  # of a polynomial in parameters: longer ones are slow to multiply
_MOST_POWER = 20  # of a parameter: nobody writes more


@dataclass(frozen=True)
class LaurentPolynomial:
    """Σ c p₁^k₁ p₂^k₂ … with whole exponents, of either sign: c of each product of powers that is not exactly 0.

    A sum as a divisor, and an exponent that is no whole number of modest size, are `NotRepresentable`.

    Example: the stiffness k over the mass m, and what is left where m cancels.

        >>> k, m = LaurentPolynomial.of("k"), LaurentPolynomial.of("m")
        >>> [list(p.terms) for p in (2 * k / m, m * k / m + 1)]
        [[(('k', 1), ('m', -1))], [(('k', 1),), ()]]
    """

    terms: Mapping[Powers, Real]

    @staticmethod
    def of(value: "LaurentPolynomial | Real | Fraction | float | str") -> "LaurentPolynomial":
        """Return a number, or the parameter of a name, as a polynomial."""
        if isinstance(value, LaurentPolynomial):
            return value
        if isinstance(value, str):
            return LaurentPolynomial({((value, 1),): Real.of(1)})
        return _kept({(): Real.of(value)})

    def __add__(self, other: object) -> "LaurentPolynomial":
        if not isinstance(other, (LaurentPolynomial, *Number)):
            return NotImplemented
        terms = dict(self.terms)
        for powers, c in LaurentPolynomial.of(other).terms.items():
            terms[powers] = terms[powers] + c if powers in terms else c
        return _kept(terms)

    def __mul__(self, other: object) -> "LaurentPolynomial":
        if not isinstance(other, (LaurentPolynomial, *Number)):
            return NotImplemented
        terms = dict[Powers, Real]()
        for one, a in self.terms.items():
            for two, b in LaurentPolynomial.of(other).terms.items():
                powers = _product(one, two)
                terms[powers] = terms[powers] + a * b if powers in terms else a * b
        return _kept(terms)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "LaurentPolynomial":
        return self * -1

    def __sub__(self, other: object) -> "LaurentPolynomial":
        return (
            self + -LaurentPolynomial.of(other) if isinstance(other, (LaurentPolynomial, *Number)) else NotImplemented
        )

    def __rsub__(self, other: object) -> "LaurentPolynomial":
        return -self + other

    def __truediv__(self, other: object) -> "LaurentPolynomial":
        if not isinstance(other, (LaurentPolynomial, *Number)):
            return NotImplemented
        divisor = LaurentPolynomial.of(other)
        if not divisor.terms:
            raise ZeroDivisionError("division by zero")
        if len(divisor.terms) > 1:
            raise NotRepresentable("divides by a sum of parameters")
        ((powers, c),) = divisor.terms.items()
        return self * LaurentPolynomial({tuple((name, -k) for name, k in powers): 1 / c})

    def __rtruediv__(self, other: object) -> "LaurentPolynomial":
        return LaurentPolynomial.of(other) / self if isinstance(other, Number) else NotImplemented

    def __pow__(self, other: object) -> "LaurentPolynomial":
        exponent = Real.of(other) if isinstance(other, Number) else None
        if exponent is None or not exponent.exact or exponent.centre.denominator != 1:
            raise NotRepresentable("is no whole power")
        if abs(exponent.centre) > _MOST_POWER:
            raise NotRepresentable(f"is a power above {_MOST_POWER}")
        power = LaurentPolynomial.of(1)
        for _ in range(abs(int(exponent.centre))):
            power = power * self
        return power if exponent.centre >= 0 else 1 / power

    def __rpow__(self, other: object) -> "LaurentPolynomial":
        raise NotRepresentable("is no whole power")


def _product(one: Powers, two: Powers) -> Powers:
    total = dict(one)
    for name, k in two:
        total[name] = total.get(name, 0) + k
    return tuple(sorted((name, k) for name, k in total.items() if k))


def _kept(terms: Mapping[Powers, Real]) -> LaurentPolynomial:
    """Return the polynomial without the terms that are exactly 0."""
    kept = {powers: c for powers, c in terms.items() if c.centre or c.radius}
    if len(kept) > _MOST_TERMS:
        raise NotRepresentable(f"has more than {_MOST_TERMS} terms")
    return LaurentPolynomial(kept)


_ZERO = Real.of(0)
SHAPE = ("slope", "lower_slope", "upper_slope", "slopes", "value")  # what φ is linear in
_NOT_OF_THE_FIELD = ("sizes", "units")  # of the design and of reports alone


@dataclass(frozen=True)
class Summand:
    """A part of a sum: where it stands in the file with what stands there, and what it is."""

    text: str
    polynomial: LaurentPolynomial

    def __neg__(self) -> "Summand":
        return Summand(self.text, -self.polynomial)


class Dependence:
    """The field as a function of some parameters, `free`, the others being as they are.

    Raises:
        OutsideTheory: If an entry is no sum of products of their powers, or hyperplanes or C depend on them.

    Example: the paper's example, in the stiffness of its spring and in a mass.

        >>> from pwatrack import load_spec
        >>> plant = Dependence(load_spec("specs/two_mass_backlash.yaml").problem.parametric, ["k1", "m1"])
        >>> plant.powers()["m1", -1]
        "system.B[2][1] = '1/m1'"
    """

    def __init__(self, parametric: ParametricPlant, free: Collection[str]) -> None:
        self._parametric = parametric
        self._names = _polynomials(parametric, free)
        varying = {name for name, value in self._names.items() if value is None or isinstance(value, LaurentPolynomial)}
        self._of_any = dict(parametric.varying)
        self._varying = {p: e for p, e in self._of_any.items() if not e.names.isdisjoint(varying)}

    def powers(self) -> dict[tuple[str, int], str]:
        """Return each power of a parameter that is in an entry of a matrix, and a place where it is from.

        What cancels in an entry is not in it.
        """
        seen = dict[tuple[str, int], str]()
        try:
            for pieces in self._entries():
                total = sum((piece.polynomial for piece in pieces), LaurentPolynomial({}))
                for power in (power for term in total.terms for power in term if power not in seen):
                    seen[power] = next(p.text for p in pieces if any(power in term for term in p.polynomial.terms))
        except NotRepresentable as error:
            message = f"an entry of the plant as a function of the uncertain parameters {error}"
            raise OutsideTheory(Problem(message=message, subject=("system",))) from None
        return seen

    def _entries(self) -> Iterator[list[Summand]]:
        """Yield sums that are affine in parameters wherever all entries of A_i, b_i and B are, and the other way round.

        The entries are T + Σ d over the elements, d the difference between a segment of one and its first segment:
        so these are T and all d.
        """
        entries = defaultdict[Subject, list[Summand]](list)  # by ("A", j, k), ("b", j), …
        elements = dict[int, None]()
        for path in self._varying:
            if path[0] in _NOT_OF_THE_FIELD:
                continue
            of_element, of_cell = path[0] == "nonlinearities", path[0] == "cells"
            if of_element and path[2] in ("into", *SHAPE):
                assert isinstance(path[1], int)
                elements[path[1]] = None
            elif path[0] in ("A", "b", "B") or (of_cell and path[2] != "where"):
                entries[path].append(self._piece(path))
            else:
                what = "what is measured and tracked is" if path[0] in ("C", "track") else "hyperplanes are"
                message = f"{self._named(path)} depends on an uncertain parameter: {what} to be known"
                raise OutsideTheory(Problem(message=message, subject=("system", *path)))
        for number in elements:
            for place, first, *others in self._element(number):
                entries[place] += first
                yield from ([*pieces, *(-piece for piece in first)] for pieces in others)
        yield from entries.values()

    def _element(self, number: int) -> Iterator[tuple[Any, ...]]:
        """Yield each entry that an element adds to, and its pieces on each of its segments, where they vary."""
        at: Subject = ("nonlinearities", number)
        section = (self._parametric.nominal.nonlinearities or [])[number]
        states, row = self._parametric.nominal.states, section.of
        shapes = [(path, self._piece((*at, *path), value), unit) for path, value, unit in _units(section)]
        found = defaultdict[Subject, list[list[Summand]]](lambda: [[] for _ in shapes[0][2].slopes])
        for state, written in section.into.items():
            j, factor = states.index(state), self._piece((*at, "into", state), written)
            for path, shape, unit in shapes:
                q = factor.polynomial * shape.polynomial
                if not any(q.terms):
                    continue  # the only product of powers in it is the empty one
                said = (*at, *path) in self._varying or path[0] in section.model_fields_set
                text = f"{factor.text} times {shape.text}" if said else factor.text
                for segment, (slope, intercept) in enumerate(zip(unit.slopes, unit.intercepts, strict=True)):
                    places: dict[Subject, Real] = {("A", j, k): slope * v for k, v in enumerate(row.coefficients)}
                    places["b", j] = slope * row.offset + intercept
                    for place, coefficient in places.items():
                        if coefficient.centre or coefficient.radius:
                            found[place][segment].append(Summand(text, q * coefficient))
        for place, segments in found.items():
            yield place, *segments

    def _piece(self, path: Subject, nominal: Real | None = None) -> Summand:
        """Return what stands at a path; its value is `nominal` where that depends on nothing that is left open."""
        if path not in self._varying:
            assert nominal is not None
            return Summand(self._named(path, nominal), LaurentPolynomial.of(nominal))
        try:
            return Summand(self._named(path), LaurentPolynomial.of(real(self._varying[path], self._names)))
        except ExpressionError:
            message = f"{self._named(path)} is no sum of products of whole powers of the uncertain parameters"
            raise OutsideTheory(Problem(message=message, subject=("system", *path))) from None

    def _named(self, path: Subject, nominal: Real = _ZERO) -> str:
        expression = self._of_any.get(path)
        text = number_text(float(nominal), "g") if expression is None else shown(expression.text)
        return f"{path_text(('system', *path))} = {text}"


def _units(section: Element) -> Iterator[tuple[Subject, Real, PiecewiseLinear]]:
    """Yield each number that φ is linear in: its path, its value, and φ with 1 in its place and 0 for the others."""
    given: dict[str, Any] = {name: v for name in SHAPE if (v := getattr(section, name, None)) is not None}
    nothing = {name: [_ZERO] * len(value) if isinstance(value, list) else _ZERO for name, value in given.items()}
    for name, value in given.items():
        for k, entry in enumerate(value if isinstance(value, list) else [value]):
            one: Any = Real.of(1)
            if isinstance(value, list):
                one = [Real.of(int(j == k)) for j in range(len(value))]
            path = (name, k) if isinstance(value, list) else (name,)
            yield path, entry, section.model_copy(update=nothing | {name: one}).function()


def _polynomials(parametric: ParametricPlant, free: Collection[str]) -> dict[str, Any]:
    """Return every parameter: a number, or a polynomial in those that are free; None where it is none."""
    names = dict[str, Any]()
    for name, written in parametric.parameters.items():
        names[name] = parametric.names.parameters[name]
        if name in free:
            names[name] = LaurentPolynomial.of(name)
        elif isinstance(written, Expression) and any(
            names.get(other) is None or isinstance(names[other], LaurentPolynomial)
            for other in written.names & set(names)
        ):
            try:
                names[name] = real(written, names)
            except ExpressionError:
                names[name] = None
    return names
