"""The parameters of a file, and the plant that they make: also with other values than those of the file."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from pwatrack.errors import InvalidSpec, Problem, PwatrackError, Subject
from pwatrack.model.pwa import PWASystem
from pwatrack.real import Real
from pwatrack.spec.build import build_plant
from pwatrack.spec.expression import RESERVED, BrokenParameter, ExpressionError, UnknownName, real
from pwatrack.spec.problems import MOST, validation_problems
from pwatrack.spec.schema import Context, SystemSection


@dataclass(frozen=True, kw_only=True)
class PlantRecipe:
    """A plant as its file writes it, to be made again with other parameters.

    Attributes:
        parameters: Their texts, in the order in which they are evaluated.
        system: The section of the plant, as text.
        names: Those that it declares.
        overrides: Parameters set from outside the file.
        tolerance: For the continuity of the plant.
    """

    parameters: Mapping[str, Any]
    system: Mapping[str, Any]
    names: Context
    overrides: Mapping[str, float | str]
    tolerance: float

    def plant(self, parameters: Mapping[str, float | str], subject: Subject) -> tuple[PWASystem, dict[str, float]]:
        """Return the plant with these parameters, and their values.

        Args:
            parameters: Numbers or expressions, by name; the others stay as they are.
            subject: Where the file asks for them.

        Raises:
            PwatrackError: If one has no value, or the plant is not of class (1) with them.
        """
        values, problems = evaluated(
            self.parameters,
            {**self.overrides, **parameters},
            outside=set(self.overrides) - set(parameters),
        )
        refusal: PwatrackError = InvalidSpec()
        if not problems:
            context = replace(self.names, parameters=values)
            try:
                system = SystemSection.model_validate(self.system, context=context)
                changed = {name: float(value) for name in parameters if (value := values[name]) is not None}
                return build_plant(system, self.tolerance), changed
            except ValidationError as error:
                problems = [p.prefixed("system.") for p in validation_problems(error, self.system)]
            except PwatrackError as error:
                problems, refusal = list(error.problems), error
        with_them = ", ".join(f"{name} = {value}" for name, value in parameters.items())
        said = f"plant with {with_them}: "
        raise type(refusal)(*(replace(p.prefixed(said), subject=subject, place=None) for p in problems))


def evaluated(
    section: Any, overrides: Mapping[str, float | str], outside: Collection[str] | None = None
) -> tuple[dict[str, Real | None], list[Problem]]:
    """Evaluate parameters in order; each may use those before it.

    Args:
        section: What the file has under `parameters`.
        overrides: Texts or numbers that take the place of those in the file.
        outside: Which of these are not in the file; None for all.

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
            if not isinstance(text, str | int | float):
                raise ExpressionError("a number or an expression is expected")
            values[name] = real(str(text), values)
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
