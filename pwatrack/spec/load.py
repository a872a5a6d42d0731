"""A spec file -> `Spec`, or every error in the file at once with line and column."""

import hashlib
import re
import stat
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from pwatrack.arrays import Array, readonly
from pwatrack.control.goal import Goal
from pwatrack.errors import InvalidSpec, Place, Problem, PwatrackError, Subject
from pwatrack.lmi.inequality import Solver
from pwatrack.model.conditions import Conditions
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Reference
from pwatrack.simulation.region import Region
from pwatrack.spec.build import build_conditions, build_goal, build_plant, build_reference, build_regions
from pwatrack.spec.expression import LinearForm
from pwatrack.spec.problems import (
    condition_problems,
    goal_problems,
    name_problems,
    plant_problems,
    reference_problems,
    sampling_problems,
    shape_problems,
    size_problems,
    start_problems,
    validation_problems,
)
from pwatrack.spec.recipe import PlantRecipe, evaluated
from pwatrack.spec.schema import Context, ExpectSection, SpecFile
from pwatrack.spec.yaml_tree import Document, parse_yaml

_LARGEST_FILE = 4 * 2**20  # bytes
_EXPECT = re.compile(r"^expect:\s*\{?\s*exit:\s*([02-6])\b", re.MULTILINE)


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
        controller, observer: What K and Lᵀ are to achieve.
        solver: Which interior-point solver to ask.
        reference: What to track.
        duration, sample_time: In s.
        x0, x_hat0, eta_hat0: Initial states of plant, observer and generator; None for zero.
        conditions: What is not as the theorems assume when it is simulated.
        portraits: Pairs of linear forms of the states to draw against each other.
        regions: Where the members of an ensemble start, by part; empty where the file says nothing.
        intervals: Lowest and highest values of the plant's parameters in an ensemble, by name; likewise.
        recipe: What makes the plant from its parameters.
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
    controller: Goal
    observer: Goal
    solver: Solver
    reference: Reference
    duration: float
    sample_time: float
    x0: Array | None
    x_hat0: Array | None
    eta_hat0: Array | None
    conditions: Conditions
    portraits: tuple[tuple[LinearForm, LinearForm], ...]
    regions: Mapping[str, Region]
    intervals: Mapping[str, tuple[float, float]]
    recipe: PlantRecipe
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
    if too_much := size_problems(document.data):
        raise InvalidSpec(*document.problems, *too_much).located(document.places).sorted()
    values, problems = evaluated(document.data.get("parameters", {}), parameters or {})
    context = Context(
        parameters=values,
        **{name: _declared(document.data, name) for name in ("states", "inputs", "outputs")},
    )
    problems = [
        *document.problems,
        *problems,
        *shape_problems(document.data, context),
        *name_problems(document.data, context),
        *start_problems(document.data, context),
        *sampling_problems(document.data, context),
    ]
    try:
        file = SpecFile.model_validate(document.data, context=context)
    except ValidationError as error:
        problems += validation_problems(error, document.data)
    if not problems:
        problems += plant_problems(file.system) + reference_problems(file) + goal_problems(file)
        problems += condition_problems(file, values)
    if problems:
        raise InvalidSpec(*problems).located(document.places).sorted()
    simulation, initial = file.simulation, file.simulation.initial
    x0, x_hat0 = (_initial(values, file.system.states) for values in (initial.plant, initial.observer))
    recipe = PlantRecipe(
        parameters=document.data.get("parameters", {}),
        system=document.data["system"],
        names=context,
        overrides=parameters or {},
        tolerance=file.tolerance.continuity,
    )
    try:
        plant = build_plant(file.system, file.tolerance.continuity)
        reference = build_reference(file.reference, plant.outputs, path.parent, simulation.duration)
        conditions = build_conditions(simulation, plant, path.parent)
        if simulation.plant is not None:
            running, changed = recipe.plant(simulation.plant.parameters, ("simulation", "plant", "parameters"))
            conditions = replace(conditions, plant=running, parameters=changed)
    except PwatrackError as error:
        raise error.located(document.places) from None
    return Spec(
        name=file.name,
        path=path,
        sha256=digest,
        parameters={name: float(value) for name, value in values.items() if value is not None},
        plant=plant,
        units=file.system.units,
        tracking=file.design.tracking,
        controller=build_goal(file.design.controller, file.design.controller.K),
        observer=build_goal(file.design.observer, file.design.observer.L),
        solver=file.design.solver,
        reference=reference,
        duration=simulation.duration,
        sample_time=simulation.sample_time,
        x0=x0,
        x_hat0=x_hat0,
        eta_hat0=None if initial.generator is None else readonly(initial.generator),
        conditions=conditions,
        portraits=tuple((first, second) for first, second in simulation.portraits),
        regions=build_regions(simulation.ensemble.initial, plant.states, {"plant": x0, "observer": x_hat0}),
        intervals={name: (low, high) for name, (low, high) in simulation.ensemble.parameters.items()},
        recipe=recipe,
        expected_exit=file.expect.exit if file.expect else 0,
        places=document.places,
    )


def assignments(texts: Sequence[str]) -> dict[str, str]:
    """Return parameters given as NAME=VALUE.

    Raises:
        InvalidSpec: For each text that is not of this form, and each name that is given twice.

    Example:
        >>> assignments(["k2=0.3", "omega=2*pi"])
        {'k2': '0.3', 'omega': '2*pi'}
    """
    parts = [tuple(part.strip() for part in text.partition("=")) for text in texts]
    problems = [
        f"--set {text}: expected NAME=VALUE, for example --set k2=0.3"
        for text, (name, _, value) in zip(texts, parts, strict=True)
        if not (name and value)
    ]
    for name, times in Counter(name for name, _, _ in parts).items():
        if name and times > 1:
            given = " and ".join(value for other, _, value in parts if other == name)
            problems.append(f"--set {name} is given {times} times: {given}; each parameter has one value")
    if problems:
        raise InvalidSpec(*problems)
    return {name: value for name, _, value in parts}


def expected_exit(path: str | Path) -> int:
    """Return the exit code that a spec file expects, also where the rest of it is in error; 0 if it says none."""
    try:
        document, _ = _read(Path(path))
        return ExpectSection.model_validate(document.data["expect"]).exit
    except PwatrackError:  # not even YAML
        try:
            found = _EXPECT.search(_content(Path(path)).decode("utf-8", errors="replace"))
        except InvalidSpec:
            return 0
        return int(found[1]) if found else 0
    except (KeyError, ValidationError):
        return 0


def _read(path: Path) -> tuple[Document, str]:
    content = _content(path)
    try:
        return parse_yaml(content.decode("utf-8"), str(path)), hashlib.sha256(content).hexdigest()
    except UnicodeDecodeError as error:
        before = content[: error.start]
        place = Place(str(path), before.count(b"\n") + 1, error.start - before.rfind(b"\n"))
        raise InvalidSpec(Problem(message=f"not UTF-8 text: byte {content[error.start]:#04x}", place=place)) from None


def _content(path: Path) -> bytes:
    """Return the bytes of a regular file that is not too large: others may never end."""
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            kind = "is a folder" if stat.S_ISDIR(about.st_mode) else "is no regular file"
            raise InvalidSpec(Problem(message=f"cannot read {path}: it {kind}"))
        if about.st_size > _LARGEST_FILE:
            message = f"cannot read {path}: it has {about.st_size:,} bytes, at most {_LARGEST_FILE:,} are read"
            raise InvalidSpec(Problem(message=message))
        with path.open("rb") as file:
            return file.read(_LARGEST_FILE + 1)
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        raise InvalidSpec(Problem(message=f"cannot read {path}: {getattr(error, 'strerror', None) or error}")) from None


def _declared(data: dict[str, Any], name: str) -> tuple[str, ...]:
    system = data.get("system")
    names = system.get(name) if isinstance(system, dict) else None
    return tuple(n for n in names if isinstance(n, str)) if isinstance(names, list) else ()


def _initial(values: Mapping[str, float] | Sequence[float] | None, states: Sequence[str]) -> Array | None:
    """Return initial values in the order of the states; those that are not named are 0."""
    if values is None:
        return None
    return readonly([values.get(name, 0.0) for name in states] if isinstance(values, Mapping) else values)
