"""A spec file -> `Spec`, or every error in the file at once with line and column."""

import difflib
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from pwatrack.arrays import Array, readonly
from pwatrack.errors import InvalidSpec, Place, Problem, PwatrackError, Subject
from pwatrack.lmi.inequality import Solver
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Reference
from pwatrack.spec.build import build_plant, build_reference
from pwatrack.spec.expression import RESERVED, BrokenParameter, ExpressionError, number
from pwatrack.spec.schema import (
    Context,
    ExpectSection,
    SimulationSection,
    SpecFile,
    SystemSection,
    flat_matrices,
    known_keys,
    path_text,
    shape_problems,
)
from pwatrack.spec.yaml_tree import Document, parse_yaml

_MOST_SAMPLES = 10_000_000


@dataclass(frozen=True, kw_only=True)
class Spec:
    """What one file asks for.

    Attributes:
        name: Title of the problem.
        path: The file.
        sha256: Of the file's bytes.
        parameters: Values of the parameters.
        plant: The system (1).
        units: Unit of each state, input and output that has one.
        tracking: "output" (Theorem 3) or "state" (Theorem 2).
        K, L: Gains to prove, or None where they are to be designed.
        solver: Which interior-point solver to ask.
        reference: What to track.
        duration, sample_time: In s.
        x0, x_hat0, eta_hat0: Initial states of plant, observer and generator; None for zero.
        expected_exit: How a run of this spec should end; 0 unless the file says otherwise.
        places: Where each part of the description stands in the file.
    """

    name: str
    path: Path
    sha256: str
    parameters: Mapping[str, float]
    plant: PWASystem
    units: Mapping[str, str]
    tracking: Literal["output", "state"]
    K: Array | None
    L: Array | None
    solver: Solver
    reference: Reference
    duration: float
    sample_time: float
    x0: Array | None
    x_hat0: Array | None
    eta_hat0: Array | None
    expected_exit: int
    places: Mapping[Subject, Place]

    @contextmanager
    def located(self) -> Iterator[None]:
        """Give every refusal raised inside the place in the file that it is about."""
        try:
            yield
        except PwatrackError as error:
            raise error.located(self.places) from None


def load_spec(path: str | Path, parameters: Mapping[str, float | str] | None = None) -> Spec:
    """Read a spec file.

    Args:
        path: The YAML file.
        parameters: Values that replace those in the file, as numbers or expressions.

    Raises:
        InvalidSpec: With every error in the file (exit code 2).
        OutsideTheory: If the plant is not a continuous PWA system (exit code 3).

    Example:
        >>> spec = load_spec("specs/two_mass_backlash.yaml", {"k2": 0.3})
        >>> spec.plant.cell_names
        ('upper spring', 'gap', 'lower spring')
    """
    path = Path(path)
    document, digest = _read(path)
    values, problems = _parameters(document.data.get("parameters", {}), parameters or {})
    context = Context(
        parameters=values,
        **{name: _declared(document.data, name) for name in ("states", "inputs", "outputs")},
    )
    problems = [
        *document.problems,
        *problems,
        *shape_problems(document.data, context),
        *_name_problems(document.data, context),
        *_sampling_problems(document.data, context),
    ]
    try:
        file = SpecFile.model_validate(document.data, context=context)
    except ValidationError as error:
        problems += _validation_problems(error, document.data)
    if not problems:
        problems += _plant_problems(file.system) + _reference_problems(file)
    if problems:
        raise InvalidSpec(*problems).located(document.places).sorted()
    simulation, initial = file.simulation, file.simulation.initial
    try:
        plant = build_plant(file.system, file.tolerance.continuity)
        reference = build_reference(file.reference, plant.outputs, path.parent, simulation.duration)
    except PwatrackError as error:
        raise error.located(document.places) from None
    return Spec(
        name=file.name,
        path=path,
        sha256=digest,
        parameters={name: value for name, value in values.items() if value is not None},
        plant=plant,
        units=file.system.units,
        tracking=file.design.tracking,
        K=_optional(file.design.controller.K),
        L=_optional(file.design.observer.L),
        solver=file.design.solver,
        reference=reference,
        duration=simulation.duration,
        sample_time=simulation.sample_time,
        x0=_optional(initial.plant),
        x_hat0=_optional(initial.observer),
        eta_hat0=_optional(initial.generator),
        expected_exit=file.expect.exit if file.expect else 0,
        places=document.places,
    )


def assignments(texts: Sequence[str]) -> dict[str, str]:
    """Return parameters given as NAME=VALUE.

    Raises:
        InvalidSpec: For each text that is not of this form.

    Example:
        >>> assignments(["k2=0.3", "omega=2*pi"])
        {'k2': '0.3', 'omega': '2*pi'}
    """
    parts = [text.partition("=") for text in texts]
    wrong = [text for text, (name, _, value) in zip(texts, parts, strict=True) if not (name.strip() and value.strip())]
    if wrong:
        raise InvalidSpec(*(f"--set {text}: expected NAME=VALUE, for example --set k2=0.3" for text in wrong))
    return {name.strip(): value.strip() for name, _, value in parts}


def expected_exit(path: str | Path) -> int:
    """Return the exit code that a spec file expects, also where the rest of it is in error; 0 if it says none."""
    try:
        document, _ = _read(Path(path))
        return ExpectSection.model_validate(document.data["expect"]).exit
    except (PwatrackError, KeyError, ValidationError):
        return 0


def _read(path: Path) -> tuple[Document, str]:
    try:
        content = path.read_bytes()
        return parse_yaml(content.decode("utf-8"), str(path)), hashlib.sha256(content).hexdigest()
    except OSError as error:
        raise InvalidSpec(Problem(message=f"cannot read {path}: {error.strerror or error}")) from None
    except UnicodeDecodeError as error:
        before = content[: error.start]
        place = Place(str(path), before.count(b"\n") + 1, error.start - before.rfind(b"\n"))
        raise InvalidSpec(Problem(message=f"not UTF-8 text: byte {content[error.start]:#04x}", place=place)) from None


def _parameters(section: Any, overrides: Mapping[str, float | str]) -> tuple[dict[str, float | None], list[Problem]]:
    """Evaluate the parameters in order; each may use those before it."""
    values: dict[str, float | None] = {}
    problems = []
    texts = dict(section) if isinstance(section, dict) else {}
    for name in overrides:
        if name not in texts:
            known = ", ".join(texts) or "none"
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
            values[name] = number(str(text), values)
        except BrokenParameter:
            values[name] = None
        except ExpressionError as error:
            values[name] = None
            outside = name in overrides
            below = [other for other in texts if other not in values and f"unknown name '{other}'" in str(error)]
            message = f"parameter '{name}': {error}"
            message += "; it is declared below: a parameter may use those above it" if below and below != [name] else ""
            message += " (set from outside the file)" if outside else ""
            problems.append(Problem(message=message, subject=None if outside else ("parameters", name)))
    return values, problems


def _declared(data: dict[str, Any], name: str) -> tuple[str, ...]:
    system = data.get("system")
    names = system.get(name) if isinstance(system, dict) else None
    return tuple(n for n in names if isinstance(n, str)) if isinstance(names, list) else ()


_EXPECTED = {"list_type": "a list", "dict_type": "a mapping", "model_type": "a mapping", "string_type": "a text"}


def _validation_problems(error: ValidationError, data: Any) -> list[Problem]:
    problems = []
    flat = flat_matrices(data)
    for item in error.errors(include_url=False):
        cause = item.get("ctx", {}).get("error")
        if isinstance(cause, BrokenParameter):
            continue
        subject = _in_tree(item["loc"], data, missing=item["type"] == "missing")
        if any(subject[: len(matrix)] == matrix for matrix in flat):
            continue  # said once for the whole matrix
        where = path_text(subject)
        if item["type"] == "missing":
            message, subject = f"{where} is missing", subject[:-1]
        elif item["type"] == "extra_forbidden":
            close = difflib.get_close_matches(str(subject[-1]), known_keys(), n=1)
            message = f"{where}: unknown key" + (f"; did you mean '{close[0]}'?" if close else "")
        elif item["type"] in _EXPECTED:
            message = f"{where}: {_EXPECTED[item['type']]} is expected"
        elif item["type"] == "union_tag_invalid":
            message = f"{where}: kind '{item['ctx']['tag']}' is none of {item['ctx']['expected_tags']}"
        elif item["type"] == "union_tag_not_found":
            message = f"{where}: kind is missing"
        else:
            reason = str(cause) if cause else item["msg"][0].lower() + item["msg"][1:]
            message = f"{where}: {reason}"
        problems.append(Problem(message=message, subject=subject))
    return problems


def _in_tree(loc: Sequence[str | int], data: Any, *, missing: bool) -> Subject:
    """Return a path of pydantic without the parts that name a variant instead of an entry of the file."""
    subject: list[str | int] = []
    for k, part in enumerate(loc):
        there = part in data if isinstance(data, dict) else isinstance(data, list) and part in range(len(data))
        if there:
            data = data[part]
        if there or (missing and k == len(loc) - 1):
            subject.append(part)
    return tuple(subject)


def _name_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Check on the raw tree that every name stands for one thing."""
    problems = []
    taken: dict[str, str] = {}
    for kind in ("parameters", "states", "inputs", "outputs"):
        for name in context.parameters if kind == "parameters" else getattr(context, kind):
            if taken.get(name, kind) != kind:
                message = f"'{name}' is declared under {taken[name]} and under {kind}"
                problems.append(Problem(message=message, subject=("system", kind)))
            taken[name] = kind
    signals = [*context.states, *context.inputs, *context.outputs]
    for name in signals:
        for suffix in ("_hat", "_d", "_ff"):
            if name + suffix in signals:
                message = f"'{name}{suffix}' is how the trace names a signal that belongs to '{name}'"
                problems.append(Problem(message=message, subject=("system",), hint="choose another name"))
    system = data.get("system")
    system = system if isinstance(system, dict) else {}
    units = system.get("units")
    problems += [
        Problem(message=f"system.units: '{name}' is no state, input or output", subject=("system", "units", name))
        for name in (units if isinstance(units, dict) and context.states else {})
        if name not in signals
    ]
    seen: list[str] = []
    cells = system.get("cells")
    for k, cell in enumerate(cells if isinstance(cells, list) else []):
        name = cell.get("name") if isinstance(cell, dict) else None
        if isinstance(name, str) and name in seen:
            subject: Subject = ("system", "cells", k, "name")
            problems.append(Problem(message=f"a second cell is named '{name}'", subject=subject))
        seen.append(str(name))
    return problems


def _sampling_problems(data: Mapping[str, Any], context: Context) -> list[Problem]:
    """Check that the samples are neither too many nor too few, where both numbers can be read."""
    try:
        section = SimulationSection.model_validate(data.get("simulation"), context=context)
    except ValidationError:
        return []
    duration, step, subject = section.duration, section.sample_time, ("simulation", "sample_time")
    if step > duration:
        message = f"sample_time {step:g} s is longer than the duration {duration:g} s"
        return [Problem(message=message, subject=subject)]
    if duration / step > _MOST_SAMPLES:
        message = f"{duration / step:.3g} samples, at most {_MOST_SAMPLES:,} are taken"
        hint = "events are exact at any sample time; a longer one only draws fewer points"
        return [Problem(message=message, subject=subject, hint=hint)]
    return []


def _plant_problems(system: SystemSection) -> list[Problem]:
    """Check that the plant is written in exactly one of the three ways."""
    problems: list[tuple[str, Subject]] = []
    if system.cells is None:
        if system.A is None:
            problems.append(("system.cells, or system.A with nonlinearities, is missing", ("system",)))
        if system.hyperplanes is not None:
            problems.append(("hyperplanes need cells with signs", ("system", "hyperplanes")))
    else:
        problems += [
            (f"system.{name} does not go with cells: give one or the other", ("system", name))
            for name in ("A", "b", "nonlinearities")
            if getattr(system, name) is not None
        ]
        wanted = "where" if system.hyperplanes is None else "signs"
        for k, cell in enumerate(system.cells):
            subject: Subject = ("system", "cells", k)
            if wanted == "signs" and (cell.where is not None or len(cell.signs or []) != len(system.hyperplanes or [])):
                count = len(system.hyperplanes or [])
                found = "none" if cell.signs is None else str(len(cell.signs))
                problems.append((f"cell '{cell.name}': {found} signs, expected {count}, one per hyperplane", subject))
            if wanted == "where" and cell.signs is not None:
                problems.append((f"cell '{cell.name}' has signs but the system has no hyperplanes", subject))
    for k, element in enumerate(system.nonlinearities or []):
        for state in element.into:
            if state not in system.states:
                subject = ("system", "nonlinearities", k, "into", state)
                problems.append((f"nonlinearity '{element.name}': '{state}' is no state", subject))
    return [Problem(message=message, subject=subject) for message, subject in problems]


def _reference_problems(file: SpecFile) -> list[Problem]:
    """Check that there is one reference, of the kind that is tracked."""
    reference, tracking = file.reference, file.design.tracking
    given = [kind for kind in ("output", "state", "input", "setpoint") if getattr(reference, kind) is not None]
    fitting = ["output"] if tracking == "output" else ["state", "input", "setpoint"]
    problems = []
    if len(given) != 1 or given[0] not in fitting:
        found = " and ".join(given) or "nothing"
        message = f"{tracking} tracking needs a reference that is {' or '.join(fitting)}, found {found}"
        problems.append(Problem(message=message, subject=("reference",)))
    if reference.start is not None and reference.input is None:
        problems.append(Problem(message="start goes with a reference 'input' only", subject=("reference", "start")))
    if reference.input is not None and reference.start is None:
        message = "reference.start is missing: x_d(0), or 'periodic'"
        problems.append(Problem(message=message, subject=("reference",)))
    if reference.setpoint is not None and set(reference.setpoint) != set(file.system.outputs):
        message = f"setpoint must give every output: {', '.join(file.system.outputs)}"
        problems.append(Problem(message=message, subject=("reference", "setpoint")))
    return problems


def _optional(values: Any) -> Array | None:
    return None if values is None else readonly(values)
