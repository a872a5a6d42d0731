"""A spec file -> `Spec`, or every error in the file at once with line and column."""

import hashlib
import re
import stat
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from pwatrack.carried import content
from pwatrack.errors import InvalidSpec, Place, Problem, PwatrackError
from pwatrack.model.pwa import PWASystem
from pwatrack.real import Real
from pwatrack.spec.axis import Axis, axes_of
from pwatrack.spec.box import box_problems
from pwatrack.spec.build import build_loads, build_plant, build_reference
from pwatrack.spec.consistency import load_problems, plant_problems, reference_problems, sampling_problems
from pwatrack.spec.entries import Context
from pwatrack.spec.goals import goal_problems
from pwatrack.spec.names import condition_problems, declared_loads, name_problems, start_problems, sweep_problems
from pwatrack.spec.parametric import ParametricPlant, evaluated
from pwatrack.spec.paths import at_path
from pwatrack.spec.problems import shape_problems, size_problems, validation_problems
from pwatrack.spec.requirement import read_requirements
from pwatrack.spec.scenario import build_conditions, build_objectives, build_scenario
from pwatrack.spec.schema import ExpectSection, PlantFile, SpecFile
from pwatrack.spec.spec import Spec, TrackingProblem
from pwatrack.spec.spelling import located
from pwatrack.spec.table import Folder
from pwatrack.spec.values import WRITTEN, document_of, yaml_text
from pwatrack.spec.yaml_tree import Document, parse_yaml

_LARGEST_FILE = 4 * 2**20  # bytes
_Form = TypeVar("_Form", bound=PlantFile)
_EXPECT = re.compile(r"^expect:\s*\{?\s*exit:\s*([02-6])\b", re.MULTILINE)


def load_spec(
    source: str | Path | Mapping[str, Any],
    parameters: Mapping[str, float | str] | None = None,
    *,
    outside: bool = False,
) -> Spec:
    """Read a spec: a file, or a mapping with the sections of one.

    Args:
        source: The YAML file, or its sections as mappings of numbers, texts, lists and arrays.
            docs/reference/spec_file.md has shapes and units of all of them. A number means
            the shortest decimal that is read as the same double.
        parameters: Values that replace those of the spec, as numbers or expressions.
        outside: Whether it may refer to files outside of its folder; for a mapping, outside of the working directory.

    Raises:
        InvalidSpec: With every error of the spec (exit code 2): line and column of a file, or a mapping's keys.
        OutsideTheory: If the plant is not a continuous PWA system (exit code 3).

    Example:
        >>> spec = load_spec("specs/two_mass_backlash.yaml", {"k2": 0.3})
        >>> spec.problem.plant.cell_names
        ('upper spring', 'gap', 'lower spring')
        >>> motor = load_spec({
        ...     "name": "motor",
        ...     "system": {"states": ["w"], "inputs": ["u"], "outputs": ["y"], "A": [[-0.5]], "B": [[2]], "C": [[1]]},
        ...     "reference": {"output": "sin(t)"},
        ...     "simulation": {"duration": 10, "sample_time": 0.1},
        ... })
        >>> motor.problem.plant.A.tolist()
        [[[-0.5]]]
    """
    if isinstance(source, Mapping):
        return read_spec(document_of(source), parameters, outside=outside)
    if not isinstance(source, str | Path):
        message = f"load_spec: a value of type {type(source).__name__} is neither a path nor a mapping of sections"
        raise InvalidSpec(Problem(message=message, subject=None))
    path = Path(source)
    document, digest = _read(path)
    return _spec_of(document, parameters, Folder(path=path.parent, outside=outside), path=path, sha256=digest)


def read_spec(
    document: Document, parameters: Mapping[str, float | str] | None = None, *, outside: bool = False
) -> Spec:
    """Return the spec that a tree of values from Python describes; args and raises: as `load_spec`."""
    text = yaml_text(document.data)
    folder, digest = Folder(path=Path(), outside=outside), hashlib.sha256(text.encode()).hexdigest()
    return _spec_of(document, parameters, folder, path=Path(WRITTEN), sha256=digest, text=text)


def read_sweep(path: Path, parameters: Mapping[str, float | str]) -> tuple[str, list[Axis]]:
    """Return the title of a spec file, and which parameters it says vary in a sweep.

    Raises:
        InvalidSpec: With every error in the form of the file; the plant is not looked at.
    """
    document, _ = _read(path)
    _check_sizes(document)
    values, problems = evaluated(document.data.get("parameters", {}), parameters)
    file = _checked(document, _context(document.data, values), problems, SpecFile)
    return file.name, axes_of(file.sweep or {})


def read_plant(document: Document) -> PWASystem:
    """Return the plant that the sections parameters, system and tolerance of a tree describe; raises as `load_spec`."""
    _check_sizes(document)
    values, problems = evaluated(document.data.get("parameters", {}), {})
    file = _checked(document, _context(document.data, values), problems, PlantFile)
    try:
        return build_plant(file.system, file.tolerance.continuity)
    except PwatrackError as error:
        raise located(error, document.places) from None


def _check_sizes(document: Document) -> None:
    if too_much := size_problems(document.data):
        raise located(InvalidSpec(*document.problems, *too_much), document.places).sorted()


def _spec_of(
    document: Document,
    parameters: Mapping[str, float | str] | None,
    folder: Folder,
    *,
    path: Path,
    sha256: str,
    text: str | None = None,
) -> Spec:
    _check_sizes(document)
    values, problems = evaluated(document.data.get("parameters", {}), parameters or {})
    context = _context(document.data, values)
    requirements, missing = read_requirements(document.data.get("require"), context)
    file = _checked(document, context, [*problems, *missing], SpecFile)
    simulation = file.simulation
    parametric = ParametricPlant.of(
        document.data.get("parameters", {}),
        parameters or {},
        nominal=file.system,
        written=document.data["system"],
        names=context,
        tolerance=file.tolerance.continuity,
    )
    try:
        plant = build_plant(file.system, file.tolerance.continuity)
        plant = replace(plant, loads=build_loads(file.design.estimate, plant))
        reference = build_reference(file.reference, plant.tracked_names, folder, simulation.duration)
        conditions = build_conditions(simulation, plant, parametric, folder)
    except PwatrackError as error:
        raise located(error, document.places) from None
    return Spec(
        name=file.name,
        path=path,
        sha256=sha256,
        text=text,
        parameters={name: float(value) for name, value in values.items() if value is not None},
        overrides=parameters or {},
        problem=TrackingProblem(
            plant=plant,
            units={name: unit for name, unit in file.system.units.items() if unit != "1"},  # 1 is no unit to be said
            sizes=file.system.sizes,
            reference=reference,
            parametric=parametric,
        ),
        objectives=build_objectives(file.design, parametric),
        scenario=build_scenario(simulation, plant.states, conditions),
        requirements=requirements,
        expected_exit=file.expect.exit if file.expect else 0,
        places=document.places,
    )


def _checked(document: Document, context: Context, problems: list[Problem], form: type[_Form]) -> _Form:
    """Return the sections of a document, or refuse it with all that is wrong with it besides given problems."""
    data = document.data
    problems = [
        *document.problems,
        *problems,
        *shape_problems(data, context),
        *name_problems(data, context),
        *start_problems(data, context),
        *sampling_problems(data, context),
    ]
    try:
        file = form.model_validate(data, context=context)
    except ValidationError as error:
        problems += validation_problems(error, data)
    if not problems:
        problems += plant_problems(file.system)
        if isinstance(file, SpecFile):
            problems += load_problems(file) + reference_problems(file) + goal_problems(file)
            problems += condition_problems(file, context.parameters) + box_problems(file.design, context.parameters)
            problems += sweep_problems(file, context.parameters)
    if problems:
        said = {problem.subject for problem in document.problems if problem.subject}  # and what follows from it is not
        problems = [p for k, p in enumerate(problems) if k < len(document.problems) or p.subject not in said]
        raise located(InvalidSpec(*problems), document.places).sorted()
    return file


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
            found = _EXPECT.search(spec_bytes(Path(path)).decode("utf-8", errors="replace"))
        except InvalidSpec:
            return 0
        return int(found[1]) if found else 0
    except (KeyError, ValidationError):
        return 0


def referenced_files(path: str | Path) -> tuple[Path, ...]:
    """Return the files that a spec file refers to, whether they exist or not; none where it cannot be read.

    Example:
        >>> referenced_files("specs/two_mass_backlash.yaml")
        ()
    """
    path = Path(path)
    try:
        return tuple(path.parent / name for name in referenced_names(spec_bytes(path)))
    except PwatrackError:
        return ()


def referenced_names(text: bytes) -> tuple[str, ...]:
    """Return the names of the files that the text of a spec refers to, each once; none where it cannot be read."""
    try:
        return tuple(dict.fromkeys(_files(parse_yaml(text.decode("utf-8"), "").data)))
    except (PwatrackError, UnicodeDecodeError):
        return ()


def _files(data: object) -> Iterator[str]:
    """Yield what stands under the key `file`, wherever that is."""
    if isinstance(data, dict):
        if isinstance(name := data.get("file"), str):
            yield name
        for value in data.values():
            yield from _files(value)
    elif isinstance(data, list):
        for value in data:
            yield from _files(value)


def _read(path: Path) -> tuple[Document, str]:
    text = spec_bytes(path)
    try:
        return parse_yaml(text.decode("utf-8"), str(path)), hashlib.sha256(text).hexdigest()
    except UnicodeDecodeError as error:
        before = text[: error.start]
        place = Place(str(path), before.count(b"\n") + 1, error.start - before.rfind(b"\n"))
        raise InvalidSpec(Problem(message=f"not UTF-8 text: byte {text[error.start]:#04x}", place=place)) from None


def spec_bytes(path: Path) -> bytes:
    """Return what a spec file holds; raises as `file_content` does."""
    return content(path, lambda: file_content(path))


def file_content(path: Path) -> bytes:
    """Return the bytes of a spec file, a regular one that is not too large: others may never end.

    Raises:
        InvalidSpec: If it is no such file, or cannot be read.
    """
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


def _context(data: dict[str, Any], values: Mapping[str, Real | None]) -> Context:
    """Return what the sections of a raw tree are read with."""
    tracked, outputs = at_path(data, ("system", "track")), _declared(data, "outputs")
    return Context(
        parameters=values,
        **{name: _declared(data, name) for name in ("states", "inputs", "outputs")},
        loads=declared_loads(data),
        tracked=tuple(tracked) if isinstance(tracked, dict) else (),
        chosen=tuple(filter(outputs.__contains__, tracked)) if isinstance(tracked, list) else (),
        follow=at_path(data, ("design", "tracking")) == "state",
    )


def _declared(data: dict[str, Any], name: str) -> tuple[str, ...]:
    system = data.get("system")
    names = system.get(name) if isinstance(system, dict) else None
    return tuple(n for n in names if isinstance(n, str)) if isinstance(names, list) else ()
