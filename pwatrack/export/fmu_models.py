"""A controller and a plant as models for FMUs: the very C that `export c` writes, and cells as tables of a C engine.

That engine goes from crossing to crossing.
"""

import re

import numpy as np

from pwatrack.arrays import EPS, Array
from pwatrack.errors import InvalidSpec, Problem
from pwatrack.export.c import code, header, initialiser
from pwatrack.export.fmu import Model, ModelVariable, Parts
from pwatrack.export.source import Source, reference_unit, said, template
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.tables import taylor, unit
from pwatrack.spec.spec import Spec, Steady
from pwatrack.workflow.starting import plant_start
from pwatrack.workflow.tracking import desired_trajectory

_ORDER = (
    "At each step: set the inputs, step it, hand its outputs over, then step the plant. To step both at once, give the "
    "design a delay of a sample, and hand over next.* after the step."
)
_MOST_NUMBERS = 2**19  # of A_i and b_i: 4 MB
_MOST_TERMS = 24  # of a step
_LONGEST = 2.0**20  # s


def controller_parts(c: Source, duration: float, resources: dict[str, bytes]) -> Parts:
    """Return what the FMU of a controller is made of.

    Args:
        c: The controller, in doubles.
        duration: How long it may run, in s.
        resources: Files beside it.
    """
    variables, of = _controller_variables(c), c.program.sizes
    step, late = c.program.sampling.sample_time, c.program.sampling.delay
    proved = (
        "NOT PROVED: " + "; ".join(c.unproved)
        if c.unproved
        else " ".join(["Proved for the gains as printed.", *c.claims])
    )
    failed = f"FAILED: {'; '.join(c.file.failed)}. " if c.file.failed else ""
    model = Model(
        identifier=f"{c.name}_controller",
        title=f"{c.file.name}: controller",
        description=f"{failed}Runs once every {step!r} s. {proved} {_ORDER}",
        token="",
        variables=variables,
        step=step,
        preferred=(step, duration),
        files=(),
    )
    reals = [variable for variable in variables if not variable.whole]
    values = {
        "name": c.name,
        "inputs": sum(variable.causality == "input" for variable in reals),
        "parameter": next(k for k, variable in enumerate(reals) if variable.causality == "parameter"),
        "reals": len(reals),
        "sample_time": repr(step),
        "ref": f"&of->real[{1 + of['q']}]" if c.given else "NULL",
        "start": initialiser([0.0 if variable.start is None else variable.start for variable in reals]),
        "X": of["q"] + of["m"],
        "next": of["m"] if late else 0,
        "show_next": f"    (void)memcpy(&of->real[NEXT], of->core.late, {of['m']}u * sizeof(double));\n"
        if late
        else "",
        **{key: of[key] for key in ("q", "m", "n", "N", "p")},
    }
    sources = {f"{c.name}.h": header(c), f"{c.name}.c": code(c), "model.h": template("controller.h", **values)}
    return Parts(model=model, sources=sources, resources=resources)


def _controller_variables(c: Source) -> tuple[ModelVariable, ...]:
    plant, of, eta = c.file.plant, c.program.sizes, c.file.trajectory.eta
    named = dict(zip(plant.loads.where, plant.loads.names, strict=True)) if plant.loads else {}
    loads = list[str]()
    for k in range(of["N"] - of["n"]):  # a sinusoid has two entries, the first with its name
        loads.append(named[k] if k in named else f"{loads[-1]}.quadrature")
    states, start = [*plant.states, *loads], c.file.start
    x_hat, eta_hat = (start.x_hat, start.eta_hat) if start else ([0.0] * of["N"], [0.0] * of["p"])

    def of_kind(causality: str, name: str, text: str, unit: str = "", value: float | None = None) -> ModelVariable:
        held = causality in ("output", "local")
        return ModelVariable(name=name, causality=causality, description=text, unit=unit, start=value, held=held)

    def unit_of(name: str) -> str:
        return plant.units.get(name, "")

    return (
        ModelVariable(name="simulation.time", causality="independent", description="time", unit="s"),
        *(of_kind("input", name, "measured now", unit_of(name), 0.0) for name in plant.outputs),
        *(
            of_kind("input", _reference(name), f"reference: {name}", reference_unit(name, plant.units), 0.0)
            for name in (c.program.reference if c.given else ())
        ),
        *(of_kind("output", name, "put out from the start of the step", unit_of(name)) for name in plant.inputs),
        *(
            of_kind("output", f"next.{name}", "put out from the end of the step", unit_of(name))
            for name in (plant.inputs if c.program.sampling.delay else ())
        ),
        *(of_kind("local", f"estimate.{name}", f"{name}, as observed", unit_of(name)) for name in states),
        *(of_kind("local", f"generator.eta{k + 1}", f"generator: {name}") for k, name in enumerate(eta)),
        *(of_kind("local", f"desired.{name}", f"{name}, as desired", unit_of(name)) for name in plant.states),
        *(
            of_kind("parameter", f"start.{name}", f"{name} that the observer starts with", unit_of(name), value)
            for name, value in zip(states, x_hat, strict=True)
        ),
        *(
            of_kind("parameter", f"start.eta{k + 1}", f"what the generator starts with: {name}", "", value)
            for k, (name, value) in enumerate(zip(eta, eta_hat, strict=True))
        ),
        *_diagnosis(c),
    )


def _diagnosis(c: Source) -> list[ModelVariable]:
    names = c.file.plant.cells
    cells = ": " + ", ".join(f"{k} {name}" for k, name in enumerate(names[:32]))
    same = cells if len(c.program.sides) == len(names) else ", of those left where cells are merged"
    said = {
        "status": "0; 1: the reference has ended; -1: a number was not finite, the output is held",
        "cell": f"cell of the observer{cells}",
        "cell_desired": f"cell of the desired state{same}",
    }
    return [
        ModelVariable(name=f"diagnosis.{name}", causality="output", description=text, whole=True)
        for name, text in said.items()
    ]


def _reference(name: str) -> str:
    """Return the name of an entry of the reference.

    Example:
        >>> _reference("d2y/dt2")
        'reference.d2y_dt2'
    """
    return "reference." + re.sub(r"\W", "_", name)


def plant_parts(spec: Spec, name: str) -> Parts:
    """Return what the FMU of the plant that a spec simulates is made of.

    Args:
        spec: The spec.
        name: Prefix of its C names.

    Raises:
        InvalidSpec: If it has too many cells.
    """
    plant, scenario = spec.scenario.conditions.plant or spec.problem.plant, spec.scenario
    cells, n = plant.b.shape
    if plant.A.size + plant.b.size > _MOST_NUMBERS:
        raise InvalidSpec(
            Problem(
                message=f"the plant has {cells:,} cells: A_i and b_i are {plant.A.size + plant.b.size:,} numbers, "
                f"and at most {_MOST_NUMBERS:,} are exported",
                subject=None,
            )
        )
    inputs, B = _inputs(spec, plant)
    outputs, C = _outputs(plant)
    given = scenario.initial.plant
    if isinstance(given, Steady):
        trajectory, generator = desired_trajectory(spec, False)
        given = plant_start(spec, trajectory, generator, trajectory.eta0)
    start = np.zeros(n) if given is None else np.asarray(given, dtype=np.float64)
    variables = _plant_variables(spec, plant, inputs, outputs, start)
    reals = [variable for variable in variables if not variable.whole]
    text = {"name": name, "NAME": name.upper(), "title": said(spec.name), "spec": spec.sha256}
    text |= {"n": str(n), "states": ", ".join(plant.states), "inputs_said": ", ".join(v.name for v in inputs)}
    values: dict[str, object] = {
        **text,
        "q": len(C),
        "C": initialiser(C),
        "inputs": len(inputs),
        "parameter": len(reals) - n,
        "reals": len(reals),
        "start": initialiser([0.0 if variable.start is None else variable.start for variable in reals]),
    }
    engine: dict[str, object] = {**text, "m": len(inputs), **_tables(plant, B)}
    changed = scenario.conditions.parameters or {}
    other = ", ".join(f"{key} = {value:g}" for key, value in changed.items())
    model = Model(
        identifier=f"{name}_plant",
        title=f"{spec.name}: plant",
        description=f"Exact between communication points; inputs are held over a step. {other and f'With {other}.'}",
        token="",
        variables=variables,
        step=None,
        preferred=(scenario.sample_time, scenario.duration),
        files=(),
    )
    sources = {
        f"{name}.h": template("plant.h", **engine),
        f"{name}.c": template("plant.c", **engine),
        "model.h": template("plant_model.h", **values),
    }
    return Parts(model=model, sources=sources, resources={})


def _inputs(spec: Spec, plant: PWASystem) -> tuple[list[ModelVariable], Array]:
    """Return inputs, loads that are estimated, and disturbances of the spec, with their columns in ẋ."""
    units, disturbance, columns = spec.problem.units, spec.scenario.conditions.disturbance, list(plant.B.T)
    found = [_input(name, "held over a step", units.get(name, "")) for name in plant.inputs]
    if spec.problem.plant.loads is not None:
        loads = spec.problem.plant.loads
        for name, k in zip(loads.names, loads.where, strict=True):
            found.append(_input(name, "load, held over a step", units.get(name, "")))
            columns.append(loads.E.floats[:, k])
    if disturbance is not None:
        for k, name in enumerate(plant.states):
            if disturbance.Q[k].any():
                text = f"added to the derivative of {name}, held over a step"
                found.append(_input(f"disturbance.{name}", text, _per_second(units.get(name, ""))))
                columns.append(np.eye(len(plant.states))[k])
    return found, np.array(columns).T


def _input(name: str, text: str, of_unit: str) -> ModelVariable:
    return ModelVariable(name=name, causality="input", description=text, unit=of_unit, start=0.0)


def _per_second(text: str) -> str:
    return f"{text}/s" if text else ""


def _outputs(plant: PWASystem) -> tuple[list[tuple[str, str]], Array]:
    """Return what is measured, and what is tracked beside it: names with words, and rows on x."""
    names, rows = [(name, "measured") for name in plant.outputs], list(plant.C)
    for name, row in zip(plant.tracked_names, plant.tracked, strict=True):
        if name not in plant.outputs:
            names.append((name, "tracked"))
            rows.append(row)
    return names, np.array(rows)


def _plant_variables(
    spec: Spec, plant: PWASystem, inputs: list[ModelVariable], outputs: list[tuple[str, str]], start: Array
) -> tuple[ModelVariable, ...]:
    units = spec.problem.units
    found = [ModelVariable(name="simulation.time", causality="independent", description="time", unit="s"), *inputs]
    for name, text in [*outputs, *((name, "state") for name in plant.states)]:
        found.append(ModelVariable(name=name, causality="output", description=text, unit=units.get(name, "")))
    for name, value in zip(plant.states, start.tolist(), strict=True):
        text = f"{name} at the start"
        found.append(
            ModelVariable(
                name=f"start.{name}", causality="parameter", description=text, unit=units.get(name, ""), start=value
            )
        )
    cells = ", ".join(f"{k} {name}" for k, name in enumerate(plant.cell_names[:32]))
    return (*found, ModelVariable(name="diagnosis.cell", causality="output", description=f"cell: {cells}", whole=True))


def _tables(plant: PWASystem, B: Array) -> dict[str, object]:
    """Return the tables of the engine; a plant of one cell has a hyperplane that bounds nothing."""
    n, m = B.shape
    H, h, signs = plant.partition.H, plant.partition.h, plant.partition.signs
    if not len(h):
        H, h, signs = np.zeros((1, n)), np.zeros(1), np.zeros((1, 1), dtype=np.int64)
    steps: dict[bytes, tuple[float, int]] = {}
    for A, b in zip(plant.A, plant.b, strict=True):
        key = A.tobytes() + b.tobytes()
        if key not in steps:
            steps[key] = _step(A, b, B)
    each = [steps[A.tobytes() + b.tobytes()] for A, b in zip(plant.A, plant.b, strict=True)]
    found: dict[str, object] = {"cells": len(signs), "planes": len(h), "degree": max(degree for _, degree in each)}
    found["unit"] = repr(float(unit(n + m + 1) / EPS))
    tables = {"A": plant.A, "b": plant.b, "B": B, "step": [step for step, _ in each], "H": H, "h": h}
    text = {name: initialiser(values) for name, values in tables.items()}
    text["signs"] = str(signs.tolist()).replace("[", "{").replace("]", "}")
    return found | {name: values.replace("}, {", "},\n    {") for name, values in text.items()}


def _step(A: Array, b: Array, B: Array) -> tuple[float, int]:
    """Return the length of a step, and the degree of its Taylor series, whose rest is rounding in every entry."""
    n, m = B.shape
    F = np.zeros((n + 1 + m, n + 1 + m))
    F[:n] = np.column_stack([A, b, B])
    rate = np.abs(np.linalg.eigvals(np.abs(A))).max(initial=0.0)
    h = 2.0 ** np.floor(-np.log2(rate)) if rate > 1 / _LONGEST else _LONGEST
    while len(terms := taylor(F * h)) > _MOST_TERMS:
        h /= 2
    return float(h), max(len(terms) - 1, 1)
