"""A spec file -> `Spec`, or every error in the file at once with line and column."""

import hashlib
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from pwatrack.errors import InvalidSpec, Place, Problem, PwatrackError, Subject
from pwatrack.model.pwa import PWASystem
from pwatrack.remote_files import content, regular
from pwatrack.spec.axis import Axis, axes_of
from pwatrack.spec.parametric import ParametricPlant, evaluated
from pwatrack.spec.plant_section import build_plant
from pwatrack.spec.requirement import check_cells
from pwatrack.spec.scenario import build_conditions, build_loads, build_objectives, build_reference, build_scenario
from pwatrack.spec.schema import ExpectSection, PlantFile, SpecFile, validation_problems
from pwatrack.spec.section import Context
from pwatrack.spec.spec import Spec, TrackingProblem
from pwatrack.spec.spelling import located
from pwatrack.spec.table import Folder
from pwatrack.spec.yaml_tree import WRITTEN, Document, at_path, document_of, parse_yaml, path_text, yaml_text

_LARGEST_FILE = 4 * 2**20  # bytes
_LARGEST: dict[Subject, int] = {  # entries of a list, before anything is made of them
    ("system", "states"): 200,
    ("system", "inputs"): 100,
    ("system", "outputs"): 100,
    ("system", "cells"): 100_000,
    ("system", "hyperplanes"): 1_000,
    ("system", "nonlinearities"): 1_000,
}
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
        raise InvalidSpec(message, subject=None)
    path = Path(source)
    document, digest = _read(path)
    return _spec_of(document, parameters, Folder(path=path.parent, outside=outside), path, digest)


def read_spec(
    document: Document,
    parameters: Mapping[str, float | str] | None = None,
    *,
    outside: bool = False,
    plant: PWASystem | None = None,
) -> Spec:
    """Return the spec of values from Python as `load_spec` does, with the plant that its sections were read as."""
    text = yaml_text(document.data)
    folder, digest = Folder(path=Path(), outside=outside), hashlib.sha256(text.encode()).hexdigest()
    return _spec_of(document, parameters, folder, Path(WRITTEN), digest, text, plant)


def read_sweep(path: Path, parameters: Mapping[str, float | str]) -> tuple[str, list[Axis]]:
    """Return the title of a spec file, and which parameters it says vary in a sweep; the plant is not looked at."""
    document, _ = _read(path)
    file, _ = _checked(document, parameters, SpecFile)
    return file.name, axes_of(file.sweep or {})


def read_plant(document: Document) -> PWASystem:
    """Return the plant that the sections parameters, system and tolerance of a tree describe; raises as `load_spec`."""
    file, _ = _checked(document, {}, PlantFile)
    try:
        return build_plant(file.system, file.tolerance.continuity)
    except PwatrackError as error:
        raise located(error, document.places) from None


def _spec_of(
    document: Document,
    parameters: Mapping[str, float | str] | None,
    folder: Folder,
    path: Path,
    sha256: str,
    text: str | None = None,
    plant: PWASystem | None = None,
) -> Spec:
    overrides = parameters or {}
    file, context = _checked(document, overrides, SpecFile)
    parametric = ParametricPlant.of(document.data, overrides, file, context)
    try:
        plant = plant or build_plant(file.system, file.tolerance.continuity)
        plant = replace(plant, loads=build_loads(file.design.estimate, file.system))
        reference = build_reference(file.reference, plant.tracked_names, folder, file.simulation.duration)
        conditions = build_conditions(file.simulation, plant, parametric, folder, file.reference.outside)
        check_cells(file.require, plant.cell_names)
    except PwatrackError as error:
        raise located(error, document.places) from None
    return Spec(
        name=file.name,
        path=path,
        sha256=sha256,
        text=text,
        parameters={name: float(value) for name, value in context.parameters.items() if value is not None},
        overrides=overrides,
        problem=TrackingProblem(
            plant=plant,
            units=_units(file, context, plant),
            sizes=file.system.sizes,
            reference=reference,
            parametric=parametric,
        ),
        objectives=build_objectives(file.design, parametric),
        scenario=build_scenario(file.simulation, plant.states, conditions),
        requirements=file.require,
        expected_exit=file.expect.exit if file.expect else 0,
        places=document.places,
    )


def _units(file: SpecFile, context: Context, plant: PWASystem) -> dict[str, str]:
    """Return the units of all signals that have one: a load at each input has that of the input; 1 is not said."""
    units = dict(context.units)
    if plant.loads is not None and file.design.estimate == "input":
        own = zip(plant.loads.names, plant.inputs, strict=True)
        units |= {load: units[name] for load, name in own if name in units and load not in file.system.units}
    return units


def _checked(document: Document, parameters: Mapping[str, float | str], form: type[_Form]) -> tuple[_Form, Context]:
    """Return the sections of a document and what they were read with, or refuse it with all that is wrong with it."""
    data, places = document.data, document.places
    too_much = [
        Problem(message=f"{path_text(subject)}: {len(entries):,} entries, at most {most:,} are read", subject=subject)
        for subject, most in _LARGEST.items()
        if isinstance(entries := at_path(data, subject), list) and len(entries) > most
    ]
    if too_much:
        raise located(InvalidSpec(*document.problems, *too_much), places).sorted()
    values, problems = evaluated(data.get("parameters", {}), parameters)
    context = Context.of(data, values)
    try:
        file = form.model_validate(data, context=context)
    except ValidationError as error:
        problems += validation_problems(error, data)
    if problems or document.problems:
        said = {problem.subject for problem in document.problems if problem.subject}  # and what follows from it is not
        problems = [problem for problem in problems if problem.subject not in said]
        raise located(InvalidSpec(*document.problems, *problems), places).sorted()
    return file, context


def assignments(texts: Sequence[str]) -> dict[str, str]:
    """Return parameters given as NAME=VALUE.

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
    except (KeyError, ValidationError):
        return 0
    except PwatrackError:  # not even YAML
        try:
            found = _EXPECT.search(spec_bytes(Path(path)).decode("utf-8", errors="replace"))
        except InvalidSpec:
            return 0
        return int(found[1]) if found else 0


def referenced_files(path: str | Path) -> tuple[Path, ...]:
    """Return the files that a spec file refers to, whether they exist or not; none where it cannot be read."""
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
        data = list(data.values())
    for value in data if isinstance(data, list) else ():
        yield from _files(value)


def _read(path: Path) -> tuple[Document, str]:
    text = spec_bytes(path)
    try:
        return parse_yaml(text.decode("utf-8"), str(path)), hashlib.sha256(text).hexdigest()
    except UnicodeDecodeError as error:
        before = text[: error.start]
        place = Place(str(path), before.count(b"\n") + 1, error.start - before.rfind(b"\n"))
        raise InvalidSpec(f"not UTF-8 text: byte {text[error.start]:#04x}", place=place) from None


def spec_bytes(path: Path) -> bytes:
    """Return what a spec file holds, which may have come along from another machine."""
    return content(path, lambda: file_content(path))


def file_content(path: Path) -> bytes:
    """Return the bytes of a spec file."""
    try:
        return regular(path, _LARGEST_FILE)
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        raise InvalidSpec(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
