"""The parameters of a file, and the plant as a function of them: read once, made as often as is asked."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pwatrack.arrays import number_text
from pwatrack.causes import Subject
from pwatrack.errors import InvalidSpec, Problem, PwatrackError
from pwatrack.model.pwa import PWASystem
from pwatrack.real import Real
from pwatrack.spec.build import build_plant
from pwatrack.spec.entries import not_all_zero, sized_form, sized_inequalities, sized_real
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
from pwatrack.spec.paths import path_text
from pwatrack.spec.plant_section import HyperplaneSection, SystemSection
from pwatrack.spec.section import MOST, Context, Section

Value = str | float | Expression | Real


@dataclass(frozen=True, kw_only=True)
class ParametricPlant:
    """The plant (1) as a function of parameters.

    Attributes:
        parameters: What the file and the command line say of each, in the order in which they are evaluated.
        outside: Which of them are set from outside the file.
        nominal: The section of the plant with these parameters.
        varying: Every entry of it that depends on a parameter, by its path.
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
    varying: Mapping[Subject, Expression]
    names: Context
    tolerance: float

    @staticmethod
    def of(
        section: Any,
        overrides: Mapping[str, Value],
        *,
        nominal: SystemSection,
        written: Any,
        names: Context,
        tolerance: float,
    ) -> "ParametricPlant":
        """Return the plant of a file that was read without a fault.

        Args:
            section: What the file has under `parameters`.
            overrides: Numbers or expressions from outside that take the place of some.
            nominal: The section of the plant, and
            written: the same as text.
            names: Those that it declares, and the values of the parameters.
            tolerance: For the continuity of the plant.
        """
        texts = {**(section if isinstance(section, dict) else {}), **overrides}
        found = ((path, parsed(text)) for path, text in _entries(nominal, written) if not is_number(text))
        return ParametricPlant(
            parameters={name: parsed(str(text)) for name, text in texts.items()},
            outside=frozenset(overrides),
            nominal=nominal,
            varying={path: entry for path, entry in found if not entry.names.isdisjoint(names.parameters)},
            names=names,
            tolerance=tolerance,
        )

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
        """Return the section of the plant with these values in the entries that they change."""
        moved = {name for name, value in values.items() if value != self.names.parameters[name]}
        varying = {path: entry for path, entry in self.varying.items() if not entry.names.isdisjoint(moved)}
        filled = _Filled(varying, replace(self.names, parameters=values))
        system = filled.section(self.nominal)
        if filled.problems:
            raise InvalidSpec(*filled.problems)
        return system


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


def _entries(value: Any, written: Any, path: Subject = ()) -> Iterator[tuple[Subject, str]]:
    """Yield path and text of each number, form or inequality in a section that was read from a tree."""
    if isinstance(value, Real | LinearForm) or _is_inequality(value):
        yield path, written
    elif isinstance(value, Section):
        for name in type(value).model_fields:
            if name in written:
                yield from _entries(getattr(value, name), written[name], (*path, name))
    elif isinstance(value, dict):
        for name, entry in value.items():
            yield from _entries(entry, written[name], (*path, name))
    elif isinstance(value, list):
        for k, entry in enumerate(value):
            yield from _entries(entry, written[k], (*path, k))


def _is_inequality(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], LinearForm)


class _Filled:
    """Sections with other values in the entries that vary; `problems` is what is wrong with these."""

    def __init__(self, varying: Mapping[Subject, Expression], context: Context) -> None:
        self.problems: list[Problem] = []
        self._varying, self._context = varying, context
        self._above = {path[:k] for path in varying for k in range(len(path))}

    def section(self, nominal: SystemSection) -> SystemSection:
        filled = self._of(nominal, ())
        assert isinstance(filled, SystemSection)
        return filled

    def _of(self, value: Any, path: Subject) -> Any:
        if path in self._varying:
            return self._evaluated(value, path)
        if path not in self._above:
            return value
        if isinstance(value, Section):
            names = [name for name in type(value).model_fields if (*path, name) in self._above | self._varying.keys()]
            return value.model_copy(update={name: self._field(value, name, (*path, name)) for name in names})
        if isinstance(value, dict):
            return {name: self._of(entry, (*path, name)) for name, entry in value.items()}
        return [self._of(entry, (*path, k)) for k, entry in enumerate(value)]

    def _field(self, section: Section, name: str, path: Subject) -> Any:
        faults = len(self.problems)
        value = self._of(getattr(section, name), path)
        normal = isinstance(section, HyperplaneSection) and name == "H" and len(self.problems) == faults
        return self._valid(path, not_all_zero, value) if normal else value

    def _evaluated(self, value: Any, path: Subject) -> Any:
        read: Callable[..., Any] = sized_real if isinstance(value, Real) else sized_form
        return self._valid(
            path, sized_inequalities if _is_inequality(value) else read, self._varying[path], self._context
        )

    def _valid(self, path: Subject, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except ValueError as error:
            self.problems.append(Problem(message=f"{path_text(('system', *path))}: {error}"))
            return None
