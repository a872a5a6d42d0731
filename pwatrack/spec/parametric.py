"""The parameters of a file, and the plant as a function of them: read once, made as often as is asked."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from pwatrack.arrays import number_text
from pwatrack.causes import Subject
from pwatrack.errors import InvalidSpec, Problem, PwatrackError
from pwatrack.model.pwa import PWASystem
from pwatrack.real import Real
from pwatrack.spec.expression import (
    RESERVED,
    BrokenParameter,
    Expression,
    ExpressionError,
    LinearForm,
    UnknownName,
    is_number,
    parsed,
    real,
)
from pwatrack.spec.plant_section import SystemSection, build_plant
from pwatrack.spec.schema import PlantFile, validation_problems
from pwatrack.spec.section import MOST, Context, Section

Value = str | float | Expression | Real


@dataclass(frozen=True, kw_only=True)
class ParametricPlant:
    """The plant (1) as a function of parameters.

    Attributes:
        parameters: What the file and the command line say of each, in the order in which they are evaluated.
        outside: Which of them are set from outside the file.
        nominal: The section of the plant with these parameters.
        written: The same as a tree, with an expression for each entry that depends on a parameter.
        names: Those that the section declares, and the values of the parameters in it.
        tolerance: For the continuity of the plant.

    Example:
        >>> from pwatrack import load_spec
        >>> parametric = load_spec("specs/two_mass_backlash.yaml").problem.parametric
        >>> softer, values = parametric.at({"k2": 0.1}, ())
        >>> float(softer.A[0][1][0]), values
        (-0.1, {'k2': 0.1})
    """

    parameters: Mapping[str, Value]
    outside: frozenset[str]
    nominal: SystemSection
    written: Mapping[str, Any]
    names: Context
    tolerance: float

    @staticmethod
    def of(
        section: Mapping[str, Value],
        overrides: Mapping[str, Value],
        *,
        nominal: SystemSection,
        written: Any,
        names: Context,
        tolerance: float,
    ) -> "ParametricPlant":
        """Return the plant of a file without a fault: of its `parameters`, what takes the place of some, and `system`.

        `written` is the section of the plant as text, `nominal` what it was read as.
        """
        return ParametricPlant(
            parameters={name: parsed(str(text)) for name, text in {**section, **overrides}.items()},
            outside=frozenset(overrides),
            nominal=nominal,
            written=_tree(nominal, written, names.parameters),
            names=names,
            tolerance=tolerance,
        )

    @property
    def varying(self) -> Iterator[tuple[Subject, Expression]]:
        """Every entry that depends on a parameter, with its path."""
        return _expressions(self.written, ())

    def at(self, parameters: Mapping[str, float | str | Real], subject: Subject) -> tuple[PWASystem, dict[str, float]]:
        """Return the plant with these parameters, and their values.

        Args:
            parameters: Numbers or expressions, by name; the others stay as they are.
            subject: Where the file asks for them.

        Raises:
            PwatrackError: If one has no value, or the plant is not of class (1) with them.
        """
        try:
            values = self._values(parameters)
            plant = build_plant(self._section(values), self.tolerance)
        except PwatrackError as refusal:
            given = ((name, number_text(float(v)) if isinstance(v, Real) else v) for name, v in parameters.items())
            said = f"plant with {', '.join(f'{name} = {value}' for name, value in given)}: "
            problems = (replace(p.prefixed(said), subject=subject, place=None) for p in refusal.problems)
            raise type(refusal)(*problems) from None
        return plant, {name: float(value) for name in parameters if (value := values[name]) is not None}

    @property
    def uses(self) -> dict[str, frozenset[str]]:
        """The parameters that the value of each is made of."""
        found = dict[str, frozenset[str]]()
        for name, written in self.parameters.items():
            direct = written.names & found.keys() if isinstance(written, Expression) else frozenset()
            found[name] = direct.union(*(found[other] for other in direct))
        return found

    def _values(self, parameters: Mapping[str, float | str | Real]) -> dict[str, Real | None]:
        values, problems = evaluated(self.parameters, parameters, outside=self.outside - set(parameters))
        if problems:
            raise InvalidSpec(*problems)
        return values

    def _section(self, values: dict[str, Real | None]) -> SystemSection:
        """Return the section of the plant with these values in the entries that depend on them."""
        tree = {"system": self.written}
        try:
            return PlantFile.model_validate(tree, context=replace(self.names, parameters=values)).system
        except ValidationError as error:
            raise InvalidSpec(*validation_problems(error, tree)) from None


def _tree(value: Any, written: Any, parameters: Collection[str]) -> Any:
    """Return a section as the tree that it was read from, with texts for expressions in parameters alone."""
    if isinstance(value, Real | LinearForm) or (isinstance(value, list) and value and isinstance(value[0], LinearForm)):
        expression = None if is_number(written) else parsed(written)
        return value if expression is None or expression.names.isdisjoint(parameters) else expression
    if isinstance(value, Section):
        found = ((name, getattr(value, name)) for name in type(value).model_fields if name in written)
        return {name: _tree(entry, written[name], parameters) for name, entry in found}
    if isinstance(value, dict):
        return {name: _tree(entry, written[name], parameters) for name, entry in value.items()}
    if isinstance(value, list):
        return [_tree(entry, text, parameters) for entry, text in zip(value, written, strict=True)]
    return list(value) if isinstance(value, tuple) else value


def _expressions(tree: Any, path: Subject) -> Iterator[tuple[Subject, Expression]]:
    if isinstance(tree, Expression):
        yield path, tree
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for step, entry in entries:
        yield from _expressions(entry, (*path, step))


def evaluated(
    section: Any, overrides: Mapping[str, Value], outside: Collection[str] | None = None
) -> tuple[dict[str, Real | None], list[Problem]]:
    """Evaluate parameters in order; each may use those before it.

    Args:
        section: What the file has under `parameters`.
        overrides: Expressions or numbers that take the place of those in the file.
        outside: Which parameters are not from the file; None for those of `overrides`.

    Returns:
        The values, None for one that is in error, and what is wrong.
    """
    outside = overrides if outside is None else outside
    values: dict[str, Real | None] = {}
    problems = []
    texts = dict(section) if isinstance(section, dict) else {}
    for name in overrides:
        if name not in texts:
            known = ", ".join(list(texts)[:MOST]) + (", …" if len(texts) > MOST else "") or "none"
            message = f"parameter '{name}' is set but not declared; declared: {known}"
            problems.append(Problem(message=message, subject=None))
    for name, text in texts.items():
        text = overrides.get(name, text)
        if name in RESERVED:
            values[name] = None  # said by the schema
            continue
        try:
            if isinstance(text, Real):
                values[name] = text
                continue
            if not isinstance(text, str | int | float | Expression):
                raise ExpressionError("a number or an expression is expected")
            values[name] = real(text if isinstance(text, Expression) else str(text), values)
        except BrokenParameter:
            values[name] = None
        except ExpressionError as error:
            foreign = name in outside
            message = f"parameter '{name}': {error}"
            if isinstance(error, UnknownName):
                below = error.name in texts and error.name != name
                below_text = "; it is declared below: a parameter may use those above it"
                message += below_text if below else error.guess if len(problems) < MOST else ""
            message += " (set from outside the file)" if foreign else ""
            problems.append(Problem(message=message, subject=None if foreign else ("parameters", name)))
            values[name] = None
    return values, problems
