"""The parameters of a file, and the plant as a function of them: read once, made as often as is asked."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from pwatrack.arrays import number_text
from pwatrack.errors import InvalidSpec, Problem, PwatrackError, Subject, listed
from pwatrack.model.linear_form import LinearForm
from pwatrack.model.pwa import PWASystem
from pwatrack.real import Real
from pwatrack.spec.expression import (
    RESERVED,
    BrokenParameter,
    Expression,
    ExpressionError,
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

    Example:
        >>> from pwatrack import load_spec
        >>> parametric = load_spec("specs/two_mass_backlash.yaml").problem.parametric
        >>> softer, values = parametric.at({"k2": 0.1}, ())
        >>> float(softer.A[0][1][0]), values
        (-0.1, {'k2': 0.1})
    """

    parameters: Mapping[str, Expression]  # what is said of each, in the order in which they are evaluated
    outside: frozenset[str]  # which of them are set from outside the file
    nominal: SystemSection  # the section of the plant with these parameters
    written: Mapping[str, Any]  # the same as a tree, with an expression for each entry that depends on a parameter
    names: Context  # those that the section declares, and the values of the parameters in it
    tolerance: float  # for the continuity of the plant

    @staticmethod
    def of(
        data: Mapping[str, Any], overrides: Mapping[str, Value], file: PlantFile, names: Context
    ) -> "ParametricPlant":
        """Return the plant of a tree that was read as a `file`, with what takes the place of some parameters."""
        texts = {**data.get("parameters", {}), **overrides}
        return ParametricPlant(
            parameters={name: parsed(str(text)) for name, text in texts.items()},
            outside=frozenset(overrides),
            nominal=file.system,
            written=_tree(file.system, data["system"], names.parameters),
            names=names,
            tolerance=file.tolerance.continuity,
        )

    def at(self, parameters: Mapping[str, float | str | Real], subject: Subject) -> tuple[PWASystem, dict[str, float]]:
        """Return the plant with these parameters, the others being as they are, and their values.

        A refusal is about `subject`, where the file asks for them.
        """
        try:
            values, wrong = evaluated(self.parameters, parameters, outside=self.outside - set(parameters))
            if wrong:
                raise InvalidSpec(*wrong)
            plant = build_plant(self._section(values), self.tolerance)
        except PwatrackError as refusal:
            given = ((name, number_text(float(v)) if isinstance(v, Real) else v) for name, v in parameters.items())
            said = f"plant with {', '.join(f'{name} = {value}' for name, value in given)}: "
            problems = (replace(p.prefixed(said), subject=subject, place=None) for p in refusal.problems)
            raise type(refusal)(*problems) from None
        return plant, {name: float(value) for name in parameters if (value := values[name]) is not None}

    def _section(self, values: dict[str, Real | None]) -> SystemSection:
        """Return the section of the plant with these values in the entries that depend on them."""
        moved = {name for name, value in values.items() if value != self.names.parameters[name]}
        tree = {"system": _tree(self.nominal, self.written, moved)}
        try:
            return PlantFile.model_validate(tree, context=replace(self.names, parameters=values)).system
        except ValidationError as error:
            raise InvalidSpec(*validation_problems(error, tree)) from None


def _tree(value: Any, written: Any, parameters: Collection[str]) -> Any:
    """Return a section as the tree that it was read from, with expressions only where it depends on parameters."""
    if isinstance(value, Real | LinearForm) or (isinstance(value, list) and value and isinstance(value[0], LinearForm)):
        written = parsed(written) if isinstance(written, str) and not is_number(written) else written
        varies = isinstance(written, Expression) and not written.names.isdisjoint(parameters)
        return written if varies else value
    if isinstance(value, Section):
        found = ((name, getattr(value, name)) for name in type(value).model_fields if name in written)
        return {name: _tree(entry, written[name], parameters) for name, entry in found}
    if isinstance(value, dict):
        return {name: _tree(entry, written[name], parameters) for name, entry in value.items()}
    if isinstance(value, list):
        return [_tree(entry, text, parameters) for entry, text in zip(value, written, strict=True)]
    return list(value) if isinstance(value, tuple) else value


def expressions(tree: Any, path: Subject = ()) -> Iterator[tuple[Subject, Expression]]:
    """Yield every expression of a tree, with its path."""
    if isinstance(tree, Expression):
        yield path, tree
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for step, entry in entries:
        yield from expressions(entry, (*path, step))


def evaluated(
    section: Any, overrides: Mapping[str, Value], outside: Collection[str] | None = None
) -> tuple[dict[str, Real | None], list[Problem]]:
    """Return the values of parameters in order, each made of those before it, and what is wrong; None is in error.

    `overrides` take the place of those that the section has; `outside` are not from the file, all of these if None.
    """
    outside = overrides if outside is None else outside
    values: dict[str, Real | None] = {}
    texts = dict(section) if isinstance(section, dict) else {}
    declared = f"is set but not declared; declared: {listed(list(texts), MOST) or 'none'}"
    unknown = [name for name in overrides if name not in texts]
    problems = [Problem(message=f"parameter '{name}' {declared}", subject=None) for name in unknown]
    for name, text in texts.items():
        text, value = overrides.get(name, text), None
        try:
            if isinstance(text, list | dict):
                raise ExpressionError("a number or an expression is expected")
            if isinstance(text, Real):
                value = text
            elif name not in RESERVED:  # else it is said by the schema
                value = real(text if isinstance(text, Expression) else str(text), values)
        except BrokenParameter:
            pass
        except ExpressionError as error:
            foreign = name in outside
            message = f"parameter '{name}': {error}"
            if isinstance(error, UnknownName):
                if error.name in texts and error.name != name:
                    message += "; it is declared below: a parameter may use those above it"
                elif len(problems) < MOST:
                    message += error.guess
            message += " (set from outside the file)" if foreign else ""
            problems.append(Problem(message=message, subject=None if foreign else ("parameters", name)))
        values[name] = value
    return values, problems
