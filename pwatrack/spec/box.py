"""Plants whose parameters lie in intervals: how the plant (1) depends on them, and the plants at corners of the box.

Where every entry of A_i, b_i and B, with all its factors, is a sum of products of the p_k^q_k, each
of them at most once in a product, with one whole exponent q_k for each parameter, the same in all of them, the entries
are affine in each p_k^q_k by itself. This is monotone over an interval (without 0, unless q_k = 1), so the plant for
any p is a mean of the plants at the corners, with the same weights for all cells and entries: products of the shares
at which the p_k^q_k lie between their ends. What is affine in A_i, b_i and B, such as a matrix inequality or a jump at
a facet that does not move, then holds for all p where it holds at the corners.

A scalar element adds direction · φ(row · x + constant). Its breakpoints, row and constant being known, slopes and
intercepts of φ are linear in the numbers that `_SHAPE` lists, so its entries are sums of a factor of `into`, one of
these numbers, and what φ is where this number is 1 and the others are 0.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from pwatrack.arrays import number_text
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem, Subject, Undecided
from pwatrack.model.linear_form import LinearForm
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.model.signal import NotRepresentable
from pwatrack.real import Box, Real, Ring
from pwatrack.spec.expression import ExpressionError, real
from pwatrack.spec.parametric import ParametricPlant, expressions
from pwatrack.spec.plant_section import Element, TouchSection
from pwatrack.spec.wording import shown
from pwatrack.spec.yaml_tree import path_text

SUBJECT: Subject = ("design", "uncertain")
_MOST_CORNERS = 4096  # of 12 parameters: a plant is made for each
Powers = tuple[tuple[str, int], ...]  # by name, sorted, none of them 0
_MOST_TERMS = 500  # of a polynomial in parameters: longer ones are slow to multiply
_SHAPE = ("slope", "lower_slope", "upper_slope", "slopes", "value")  # what φ is linear in
_NOT_OF_THE_FIELD = ("sizes", "units")  # of the design and of reports alone
_ZERO = Real.of(0)
_MOST_POWER = 20  # of a parameter: nobody writes more


@dataclass(frozen=True)
class LaurentPolynomial(Ring):
    """Σ c p₁^k₁ p₂^k₂ … with whole exponents, of either sign: c of each product of powers that is not exactly 0.

    A sum as a divisor, and an exponent that is no whole number of modest size, are `NotRepresentable`.

    Example: the stiffness k over the mass m, and what is left where m cancels.

        >>> k, m = LaurentPolynomial.of("k"), LaurentPolynomial.of("m")
        >>> [list(p.terms) for p in (2 * k / m, m * k / m + 1)]
        [[(('k', 1), ('m', -1))], [(('k', 1),), ()]]
    """

    terms: Mapping[Powers, Real]

    @staticmethod
    def of(value: "_Operand | str") -> "LaurentPolynomial":
        """Return a number, or the parameter of a name, as a polynomial."""
        if isinstance(value, str):
            return LaurentPolynomial({((value, 1),): Real.of(1)})
        return value if isinstance(value, LaurentPolynomial) else _kept({(): Real.of(value)})

    def __add__(self, other: "_Operand") -> "LaurentPolynomial":
        terms = dict(self.terms)
        for powers, c in LaurentPolynomial.of(other).terms.items():
            terms[powers] = terms[powers] + c if powers in terms else c
        return _kept(terms)

    def __mul__(self, other: "_Operand") -> "LaurentPolynomial":
        terms = dict[Powers, Real]()
        for one, a in self.terms.items():
            for two, b in LaurentPolynomial.of(other).terms.items():
                total = Counter(dict(one))
                total.update(dict(two))
                powers = tuple(sorted((name, k) for name, k in total.items() if k))
                terms[powers] = terms[powers] + a * b if powers in terms else a * b
        return _kept(terms)

    __radd__, __rmul__ = __add__, __mul__

    def __truediv__(self, other: "_Operand") -> "LaurentPolynomial":
        divisor = LaurentPolynomial.of(other)
        if not divisor.terms:
            raise ZeroDivisionError("division by zero")
        if len(divisor.terms) > 1:
            raise NotRepresentable("divides by a sum of parameters")
        ((powers, c),) = divisor.terms.items()
        return self * LaurentPolynomial({tuple((name, -k) for name, k in powers): 1 / c})

    def __rtruediv__(self, other: "Real | int") -> "LaurentPolynomial":  # type: ignore[misc]
        return LaurentPolynomial.of(other) / self

    def __pow__(self, other: "_Operand") -> "LaurentPolynomial":
        exponent = None if isinstance(other, LaurentPolynomial) else Real.of(other)
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


_Operand = LaurentPolynomial | Real | int  # what one is added to, multiplied by, divided by


def _kept(terms: Mapping[Powers, Real]) -> LaurentPolynomial:
    """Return the polynomial without the terms that are exactly 0."""
    kept = {powers: c for powers, c in terms.items() if c.centre or c.radius}
    if len(kept) > _MOST_TERMS:
        raise NotRepresentable(f"has more than {_MOST_TERMS} terms")
    return LaurentPolynomial(kept)


Summand = tuple[str, LaurentPolynomial]  # a part of a sum: where it stands in the file with what stands there


class Dependence:
    """The field as a function of some parameters, `free`, the others being as they are.

    Raises OutsideTheory if an entry is no sum of products of their powers, or hyperplanes or C depend on them.

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
        self._written = dict(expressions(parametric.written))
        self._varying = {p: e for p, e in self._written.items() if not e.names.isdisjoint(varying)}

    def powers(self) -> dict[tuple[str, int], str]:
        """Return each power of a parameter that is left in an entry of a matrix, and a place where it is from."""
        seen = dict[tuple[str, int], str]()
        try:
            for pieces in self._entries():
                total = sum((polynomial for _, polynomial in pieces), LaurentPolynomial({}))
                for power in (power for term in total.terms for power in term if power not in seen):
                    seen[power] = next(text for text, part in pieces if any(power in term for term in part.terms))
        except NotRepresentable as error:
            message = f"an entry of the plant as a function of the uncertain parameters {error}"
            raise OutsideTheory(message, subject=("system",)) from None
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
            if of_element and path[2] in ("into", *_SHAPE):
                assert isinstance(path[1], int)
                elements[path[1]] = None
            elif path[0] in ("A", "b", "B") or (of_cell and path[2] != "where"):
                entries[path].append(self._piece(path))
            else:
                what = "what is measured and tracked is" if path[0] in ("C", "track") else "hyperplanes are"
                message = f"{self._named(path)} depends on an uncertain parameter: {what} to be known"
                raise OutsideTheory(message, subject=("system", *path))
        for number in elements:
            for place, first, *others in self._element(number):
                entries[place] += first
                yield from ([*pieces, *((text, -part) for text, part in first)] for pieces in others)
        yield from entries.values()

    def _element(self, number: int) -> Iterator[tuple[Any, ...]]:
        """Yield each entry that an element adds to, and its pieces on each of its segments, where they vary."""
        at: Subject = ("nonlinearities", number)
        section = (self._parametric.nominal.nonlinearities or [])[number]
        states = self._parametric.nominal.states
        shapes = [(path, self._piece((*at, *path), value), unit) for path, value, unit in _units(section, states)]
        found = defaultdict[Subject, list[list[Summand]]](lambda: [[] for _ in shapes[0][2]])
        for state, written in section.into.items():
            j, (factor_text, factor) = states.index(state), self._piece((*at, "into", state), written)
            for path, (shape_text, shape), unit in shapes:
                q = factor * shape
                if not any(q.terms):
                    continue  # the only product of powers in it is the empty one
                said = (*at, *path) in self._varying or not section.model_fields_set.isdisjoint(path[:1])
                text = f"{factor_text} times {shape_text}" if said else factor_text
                for segment, form in enumerate(unit):
                    places: dict[Subject, Real] = {("A", j, k): v for k, v in enumerate(form.coefficients)}
                    places["b", j] = form.offset
                    for place, coefficient in places.items():
                        if coefficient.centre or coefficient.radius:
                            found[place][segment].append((text, q * coefficient))
        for place, segments in found.items():
            yield place, *segments

    def _piece(self, path: Subject, nominal: Real | None = None) -> Summand:
        """Return what stands at a path; its value is `nominal` where that depends on nothing that is left open."""
        if path not in self._varying:
            assert nominal is not None
            return self._named(path, nominal), LaurentPolynomial.of(nominal)
        try:
            return self._named(path), LaurentPolynomial.of(real(self._varying[path], self._names))
        except ExpressionError:
            message = f"{self._named(path)} is no sum of products of whole powers of the uncertain parameters"
            raise OutsideTheory(message, subject=("system", *path)) from None

    def _named(self, path: Subject, nominal: Real = _ZERO) -> str:
        expression = self._written.get(path)
        text = number_text(float(nominal), "g") if expression is None else shown(expression.text)
        return f"{path_text(('system', *path))} = {text}"


def _units(section: Element, states: Sequence[str]) -> Iterator[tuple[Subject, Real, Sequence[LinearForm]]]:
    """Yield each number that φ is linear in: its path, its value, and φ with 1 in its place and 0 for the others."""
    if isinstance(section, TouchSection):  # its hyperplanes depend on all its numbers: what is in `into` alone
        yield (), Real.of(1), section.element(states).forms
        return
    given: dict[str, Any] = {name: v for name in _SHAPE if (v := getattr(section, name, None)) is not None}
    nothing = {name: [_ZERO] * len(value) if isinstance(value, list) else _ZERO for name, value in given.items()}
    for name, value in given.items():
        for k, entry in enumerate(value if isinstance(value, list) else [value]):
            one: Any = Real.of(1)
            if isinstance(value, list):
                one = [Real.of(int(j == k)) for j in range(len(value))]
            path = (name, k) if isinstance(value, list) else (name,)
            yield path, entry, section.model_copy(update=nothing | {name: one}).element(states).forms


def _polynomials(parametric: ParametricPlant, free: Collection[str]) -> dict[str, Any]:
    """Return every parameter: a number, or a polynomial in those that are free; None where it is none."""
    names = dict[str, Any]()
    for name, written in parametric.parameters.items():
        names[name] = parametric.names.parameters[name]
        if name in free:
            names[name] = LaurentPolynomial.of(name)
        elif any(
            names.get(other) is None or isinstance(names[other], LaurentPolynomial)
            for other in written.names & set(names)
        ):
            try:
                names[name] = real(written, names)
            except ExpressionError:
                names[name] = None
    return names


def corners(parametric: ParametricPlant, nominal: PWASystem, box: Box) -> tuple[Matrices, ...]:
    """Return the matrices of the plant at all corners of a box that they speak for.

    Raises as `check_box`, and OutsideTheory where the plants at the corners jump at facets by rounding.
    """
    check_box(parametric, box)
    places = product(*([(i.name, i.low), (i.name, i.high)] for i in box))
    found = [parametric.at(dict(place), SUBJECT)[0] for place in places]
    if nominal.repair is not None or any(plant.repair is not None for plant in found):
        message = "the data of the plant jump at facets by rounding: for uncertain parameters they must be continuous"
        raise OutsideTheory(message, subject=SUBJECT, hint="write b as an expression that closes it")
    return tuple(plant.exact for plant in found)


def check_box(parametric: ParametricPlant, box: Box) -> None:
    """Refuse a box whose corners do not speak for all of it, or are too many.

    Raises InvalidSpec for a parameter that is nowhere in the plant, OutsideTheory where the plant is not affine in a
    power of each, or hyperplanes or C are uncertain too, Undecided for too many corners.
    """
    if 2 ** len(box) > _MOST_CORNERS:
        message = f"{len(box)} uncertain parameters have 2^{len(box)} corners, at most {_MOST_CORNERS:,} are tried"
        raise Undecided(message, subject=SUBJECT, hint="let those that matter least be known")
    seen = Dependence(parametric, {interval.name for interval in box}).powers()
    problems, invalid = [], []
    for interval in box:
        name, found = interval.name, [(k, text) for (of, k), text in seen.items() if of == interval.name]
        where = (*SUBJECT, name)
        if not found:
            invalid.append(Problem(message=f"'{name}' is in no matrix of the plant", subject=where))
        elif len(found) > 1:
            (k, one), (other, two), *_ = found
            message = (
                f"the plant is not affine in a power of '{name}': it is there as {_power(name, k)} in {one} and as "
                f"{_power(name, other)} in {two}, so the corners do not speak for all of the interval"
            )
            problems.append(Problem(message=message, subject=where))
        elif found[0][0] != 1 and float(interval.low) <= 0 <= float(interval.high):
            message = f"{interval.text} contains 0, and the plant has {_power(name, found[0][0])} in {found[0][1]}"
            problems.append(Problem(message=message, subject=where))
    if invalid:
        raise InvalidSpec(*invalid)
    if problems:
        raise OutsideTheory(*problems)


def _power(name: str, k: int) -> str:
    return {1: name, -1: f"1/{name}"}.get(k, f"{name}**{k}")
