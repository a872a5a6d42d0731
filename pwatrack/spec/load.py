"""A spec file -> `Spec`, or every error in the file at once with line and column."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from pwatrack.arrays import Array, readonly
from pwatrack.errors import InvalidSpec, Place, Problem, PwatrackError, Subject
from pwatrack.lmi.inequality import Solver
from pwatrack.model.cells import Partition
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Reference, sinusoids
from pwatrack.spec.expression import RESERVED, BrokenParameter, ExpressionError, number
from pwatrack.spec.schema import Context, SpecFile, SystemSection, path_text, shape_problems
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
        K, L: Gains to prove, or None where they are to be designed.
        solver: Which interior-point solver to ask.
        reference: y_d.
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
    problems = [*document.problems, *problems, *shape_problems(document.data, context)]
    try:
        file = SpecFile.model_validate(document.data, context=context)
    except ValidationError as error:
        problems += _validation_problems(error)
    if not problems:
        problems += _further_problems(file)
    if problems:
        raise InvalidSpec(*problems).located(document.places).sorted()
    simulation, initial = file.simulation, file.simulation.initial
    output = file.reference.output
    try:
        plant = _plant(file.system, file.tolerance.continuity)
    except PwatrackError as error:
        raise error.located(document.places) from None
    return Spec(
        name=file.name,
        path=path,
        sha256=digest,
        parameters={name: value for name, value in values.items() if value is not None},
        plant=plant,
        units=file.system.units,
        K=_optional(file.design.controller.K),
        L=_optional(file.design.observer.L),
        solver=file.design.solver,
        reference=sinusoids(
            constant=output.constant,
            amplitudes=[s.amplitude for s in output.sine],
            frequencies=[s.frequency for s in output.sine],
            phases=[s.phase for s in output.sine],
        ),
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
        return int(document.data["expect"]["exit"])
    except (PwatrackError, KeyError, TypeError, ValueError):
        return 0


def _read(path: Path) -> tuple[Document, str]:
    start = Place(str(path), 1, 1)
    try:
        content = path.read_bytes()
        return parse_yaml(content.decode("utf-8"), str(path)), hashlib.sha256(content).hexdigest()
    except OSError as error:
        raise InvalidSpec(Problem(message=f"cannot read {path}: {error.strerror or error}")) from None
    except UnicodeDecodeError as error:
        raise InvalidSpec(
            Problem(message=f"not UTF-8 text: byte {error.start} is {content[error.start]:#04x}", place=start)
        ) from None


def _parameters(section: Any, overrides: Mapping[str, float | str]) -> tuple[dict[str, float | None], list[Problem]]:
    """Evaluate the parameters in order; each may use those before it."""
    values: dict[str, float | None] = {}
    problems = []
    texts = dict(section) if isinstance(section, dict) else {}
    for name in overrides:
        if name not in texts:
            known = ", ".join(texts) or "none"
            problems.append(Problem(message=f"parameter '{name}' is set but not declared; declared: {known}"))
    for name, text in texts.items():
        text = overrides.get(name, text)
        values[name] = None
        if name in RESERVED:
            continue  # said by the schema
        try:
            if not isinstance(text, str | int | float):
                raise ExpressionError("a number or an expression is expected")
            values[name] = number(str(text), values)
        except BrokenParameter:
            pass
        except ExpressionError as error:
            problems.append(Problem(message=f"parameter '{name}': {error}", subject=("parameters", name)))
    return values, problems


def _declared(data: dict[str, Any], name: str) -> tuple[str, ...]:
    system = data.get("system")
    names = system.get(name) if isinstance(system, dict) else None
    return tuple(n for n in names if isinstance(n, str)) if isinstance(names, list) else ()


def _validation_problems(error: ValidationError) -> list[Problem]:
    problems = []
    for item in error.errors(include_url=False):
        cause = item.get("ctx", {}).get("error")
        if isinstance(cause, BrokenParameter):
            continue
        subject = tuple(part for part in item["loc"] if part != "[key]")
        where = path_text(subject)
        if item["type"] == "missing":
            message, subject = f"{where} is missing", subject[:-1]
        elif item["type"] == "extra_forbidden":
            message = f"{where}: unknown key"
        else:
            reason = str(cause) if cause else item["msg"][0].lower() + item["msg"][1:]
            message = f"{where}: {reason}"
        problems.append(Problem(message=message, subject=subject))
    return problems


def _further_problems(file: SpecFile) -> list[Problem]:
    """Check what spans several entries."""
    problems = []
    system = file.system
    taken: dict[str, str] = {}
    for kind in ("parameters", "states", "inputs", "outputs"):
        names = file.parameters if kind == "parameters" else getattr(system, kind)
        for name in names:
            if name in taken:
                problems.append(
                    Problem(
                        message=f"'{name}' is declared under {taken[name]} and under {kind}",
                        subject=("system", kind),
                    )
                )
            taken[name] = kind
    problems += [
        Problem(message=f"system.units: '{name}' is no state, input or output", subject=("system", "units", name))
        for name in system.units
        if taken.get(name, "parameters") == "parameters"
    ]
    cells = [cell.name for cell in system.cells]
    for k, name in enumerate(cells):
        if name in cells[:k]:
            problems.append(Problem(message=f"a second cell is named '{name}'", subject=("system", "cells", k, "name")))
    duration, step = file.simulation.duration, file.simulation.sample_time
    if step > duration:
        problems.append(
            Problem(
                message=f"sample_time {step:g} s is longer than the duration {duration:g} s",
                subject=("simulation", "sample_time"),
            )
        )
    elif duration / step > _MOST_SAMPLES:
        problems.append(
            Problem(
                message=f"{duration / step:.3g} samples, at most {_MOST_SAMPLES:,} are taken",
                subject=("simulation", "sample_time"),
                hint="events are exact at any sample time; a longer one only draws fewer points",
            )
        )
    return problems


def _plant(system: SystemSection, tolerance: float) -> PWASystem:
    n = len(system.states)
    forms = [[form for chain in cell.where for form in chain] for cell in system.cells]
    rows = [form.row for cell in forms for form in cell]
    signs = np.zeros((len(forms), len(rows)), dtype=np.int64)
    start = 0
    for i, cell in enumerate(forms):
        signs[i, start : start + len(cell)] = 1
        start += len(cell)
    return PWASystem.create(
        partition=Partition.create(
            H=np.array(rows).reshape(-1, n),
            h=[form.constant for cell in forms for form in cell],
            signs=signs,
            names=[cell.name for cell in system.cells],
        ),
        A=[cell.A for cell in system.cells],
        b=[cell.b or np.zeros(n) for cell in system.cells],
        B=system.B,
        C=system.C,
        states=system.states,
        inputs=system.inputs,
        outputs=system.outputs,
        tolerance=tolerance,
    )


def _optional(values: Any) -> Array | None:
    return None if values is None else readonly(values)
