"""The plants at the corners of a box of parameters, and whether they speak for all of it.

Where every entry of A_i, b_i and B is a sum of products of the p_k^q_k, each of them at most once in a product, with
one whole exponent q_k for each parameter, the entries are affine in each p_k^q_k by itself. This is monotone over an
interval (without 0, unless q_k = 1), so the plant for any p is a mean of the plants at the corners, with the same
weights for all cells and entries: products of the shares at which the p_k^q_k lie between their ends.
"""

from collections.abc import Collection, Iterator, Mapping
from itertools import product
from typing import Any

from pwatrack.causes import Subject
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem, Undecided
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.spec.box import SUBJECT, Box
from pwatrack.spec.expression import Expression, ExpressionError, real
from pwatrack.spec.parametric import ParametricPlant
from pwatrack.spec.paths import path_text
from pwatrack.spec.polynomial import Polynomial
from pwatrack.spec.wording import shown

_MOST_CORNERS = 4096  # of 12 parameters: a plant is made for each
_SHAPE = ("slope", "lower_slope", "upper_slope", "slopes", "value")  # what a nonlinearity is linear in


def corners(parametric: ParametricPlant, nominal: PWASystem, box: Box) -> tuple[Matrices, ...]:
    """Return the matrices of the plant at all corners of a box that they speak for.

    Args:
        parametric: The plant as a function of its parameters.
        nominal: The plant of the design.
        box: What is uncertain.

    Raises:
        InvalidSpec: If a parameter is nowhere in the plant.
        OutsideTheory: If the corners do not speak for all of the box, or hyperplanes or C are uncertain too.
        Undecided: If there are too many.

    Example:
        >>> from pwatrack import load_spec
        >>> from pwatrack.real import Real
        >>> from pwatrack.spec.box import Uncertain
        >>> problem = load_spec("specs/two_mass_backlash.yaml").problem
        >>> mass = Uncertain(name="m1", nominal=Real.of(1), low=Real.of("0.8"), high=Real.of("1.25"))
        >>> [float(X.B.floats[1, 0]) for X in corners(problem.parametric, problem.plant, (mass,))]
        [1.25, 0.8]
    """
    if 2 ** len(box) > _MOST_CORNERS:
        message = f"{len(box)} uncertain parameters have 2^{len(box)} corners, at most {_MOST_CORNERS:,} are tried"
        raise Undecided(Problem(message=message, subject=SUBJECT, hint="let those that matter least be known"))
    _check_dependence(parametric, box)
    found = []
    for ends in product(*((interval.low, interval.high) for interval in box)):
        plant, _ = parametric.at({i.name: end for i, end in zip(box, ends, strict=True)}, SUBJECT)
        found.append(plant)
    if nominal.repair is not None or any(plant.repair is not None for plant in found):
        message = "the data of the plant jump at facets by rounding: for uncertain parameters they must be continuous"
        raise OutsideTheory(Problem(message=message, subject=SUBJECT, hint="write b as an expression that closes it"))
    return tuple(plant.exact for plant in found)


def _check_dependence(parametric: ParametricPlant, box: Box) -> None:
    """Refuse a box whose corners do not speak for all of it."""
    names = _polynomials(parametric, {interval.name for interval in box})
    varying = {name for name, value in names.items() if value is None or isinstance(value, Polynomial)}
    seen = dict[tuple[str, int], str]()
    for text, terms in _entries(parametric, names, varying):
        for powers in terms.terms:
            for name, k in powers:
                seen.setdefault((name, k), text)
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


def _polynomials(parametric: ParametricPlant, uncertain: Collection[str]) -> dict[str, Any]:
    """Return every parameter: a number, or a polynomial in those that are uncertain; None where it is none."""
    names = dict[str, Any]()
    for name, written in parametric.parameters.items():
        names[name] = parametric.names.parameters[name]
        if name in uncertain:
            names[name] = Polynomial.of(name)
        elif isinstance(written, Expression) and any(
            names.get(other) is None or isinstance(names[other], Polynomial) for other in written.names & set(names)
        ):
            try:
                names[name] = real(written, names)
            except ExpressionError:
                names[name] = None
    return names


def _entries(
    parametric: ParametricPlant, names: Mapping[str, Any], varying: Collection[str]
) -> Iterator[tuple[str, Polynomial]]:
    """Yield every entry of the matrices that varies, and what it is as a polynomial."""
    elements = dict[int, list[Subject]]()
    for path, expression in parametric.varying.items():
        if expression.names.isdisjoint(varying):
            continue
        if path[0] not in ("A", "b", "B", "cells", "nonlinearities") or (path[0] == "cells" and path[2] == "where"):
            raise _fixed(path, expression)
        if path[0] == "nonlinearities":
            if path[2] not in ("into", *_SHAPE):
                raise _fixed(path, expression)
            assert isinstance(path[1], int)
            elements.setdefault(path[1], []).append(path)
            continue
        yield _named(path, expression), _polynomial(path, expression, names)
    for paths in elements.values():
        factors, shapes = (
            [
                (path, _polynomial(path, parametric.varying[path], names))
                for path in paths
                if (path[2] == "into") == into
            ]
            for into in (True, False)
        )
        for factor, shape in product(factors or [((), Polynomial.of(1))], shapes or [((), Polynomial.of(1))]):
            named = [_named(path, parametric.varying[path]) for path in (factor[0], shape[0]) if path]
            yield " times ".join(named), factor[1] * shape[1]


def _polynomial(path: Subject, expression: Expression, names: Mapping[str, Any]) -> Polynomial:
    try:
        return Polynomial.of(real(expression, names))
    except ExpressionError:
        message = f"{_named(path, expression)} is no sum of products of whole powers of the uncertain parameters"
        raise OutsideTheory(Problem(message=message, subject=("system", *path))) from None


def _fixed(path: Subject, expression: Expression) -> OutsideTheory:
    what = "what is measured and tracked is" if path[0] in ("C", "track") else "hyperplanes are"
    message = f"{_named(path, expression)} depends on an uncertain parameter: {what} to be known"
    return OutsideTheory(Problem(message=message, subject=("system", *path)))


def _named(path: Subject, expression: Expression) -> str:
    return f"{path_text(('system', *path))} = {shown(expression.text)}"


def _power(name: str, k: int) -> str:
    return {1: name, -1: f"1/{name}"}.get(k, f"{name}**{k}")
