"""A controller and a plant as models for FMUs: the very C that `export c` writes, and tables of cells for an engine."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import repeat

import numpy as np

from pwatrack.arrays import EPS, Array
from pwatrack.errors import InvalidSpec
from pwatrack.export.c import code, header, initialiser
from pwatrack.export.fmu import Model, ModelVariable
from pwatrack.export.source import Source, reference_unit, said, template
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.tables import taylor, unit
from pwatrack.spec.spec import Spec, Steady
from pwatrack.workflow.tracking import desired_trajectory, plant_start

_ORDER = (
    "At each step: set the inputs, step it, hand its outputs over, then step the plant. To step both at once, give the "
    "design a delay of a sample, and hand over next.* after the step."
)
_MOST_NUMBERS = 2**19  # of A_i and b_i: 4 MB
_MOST_TERMS = 24  # of a step
_LONGEST = 2.0**20  # s
_FEW_CELLS = 32  # that a description names
_TIME = ModelVariable("simulation.time", "independent", "time", "s")


def controller_model(c: Source, duration: float, resources: Mapping[str, bytes]) -> Model:
    """Return the model of a controller in doubles, that may run so long, in s, with files beside it."""
    variables, of = _controller_variables(c), c.program.sizes
    step, late = c.program.sampling.sample_time, c.program.sampling.delay
    proved = (
        "NOT PROVED: " + "; ".join(c.unproved)
        if c.unproved
        else " ".join(["Proved for the gains K and L of the design, in continuous time.", *c.claims])
    )
    failed = f"FAILED: {'; '.join(c.file.failed)}. " if c.file.failed else ""
    shown = f"    (void)memcpy(&of->real[NEXT], of->core.late, {of['m']}u * sizeof(double));\n"
    values = {
        **_reals(variables),
        "name": c.name,
        "sample_time": repr(step),
        "ref": f"&of->real[{1 + of['q']}]" if c.given else "NULL",
        "X": of["q"] + of["m"],
        "next": of["m"] if late else 0,
        "show_next": shown if late else "",
        **{key: of[key] for key in ("q", "m", "n", "N", "p")},
    }
    return Model(
        identifier=f"{c.name}_controller",
        title=f"{c.file.name}: controller",
        description=f"{failed}Runs once every {step!r} s. {proved} {_ORDER}",
        variables=variables,
        step=step,
        preferred=(step, duration),
        sources={f"{c.name}.h": header(c), f"{c.name}.c": code(c), "model.h": template("controller.h", **values)},
        resources=resources,
    )


def _reals(variables: Sequence[ModelVariable]) -> dict[str, object]:
    reals = [variable for variable in variables if not variable.whole]
    causalities = [variable.causality for variable in reals]
    return {
        "inputs": causalities.count("input"),
        "parameter": causalities.index("parameter"),
        "reals": len(reals),
        "start": initialiser([0.0 if variable.start is None else variable.start for variable in reals]),
    }


def _controller_variables(c: Source) -> list[ModelVariable]:
    plant, of = c.file.plant, c.program.sizes
    counted = {f"eta{k}": name for k, name in enumerate(c.file.trajectory.eta, 1)}
    named = dict(zip(plant.loads.where, plant.loads.names, strict=True)) if plant.loads else {}
    loads = list[str]()
    for k in range(of["N"] - of["n"]):  # a sinusoid has two entries, the first with its name
        loads.append(named[k] if k in named else f"{loads[-1]}.quadrature")
    states, (x_hat, eta_hat) = [*plant.states, *loads], c.file.started
    cells = ": " + ", ".join(f"{k} {name}" for k, name in enumerate(plant.cells[:_FEW_CELLS]))
    desired = cells if len(c.program.sides) == len(plant.cells) else ", of those left where cells are merged"
    told = {
        "status": "0; 1: the reference has ended; -1: a number was not finite, the output is held",
        "cell": f"cell of the observer{cells}",
        "cell_desired": f"cell of the desired state{desired}",
    }

    def each(
        causality: str, form: str, text: str, names: Iterable[str], starts: Iterable[float | None] = repeat(None)
    ) -> list[ModelVariable]:
        held = causality in ("output", "local")
        return [
            ModelVariable(form.format(name), causality, text.format(name), plant.units.get(name, ""), start, held=held)
            for name, start in zip(names, starts, strict=False)
        ]

    return [
        _TIME,
        *each("input", "{}", "measured now", plant.outputs, repeat(0.0)),
        *(
            ModelVariable(f"reference.{own}", "input", f"reference: {name}", reference_unit(name, plant.units), 0.0)
            for name in c.program.given
            for own in [re.sub(r"\W", "_", name)]
        ),
        *each("output", "{}", "put out from the start of the step", plant.inputs),
        *each("output", "next.{}", "put out from the end of the step", plant.inputs * bool(c.program.sampling.delay)),
        *each("local", "estimate.{}", "{}, as observed", states),
        *(ModelVariable(f"generator.{k}", "local", f"generator: {name}", held=True) for k, name in counted.items()),
        *each("local", "desired.{}", "{}, as desired", plant.states),
        *each("parameter", "start.{}", "{} that the observer starts with", states, x_hat),
        *(
            ModelVariable(f"start.{k}", "parameter", f"what the generator starts with: {name}", "", value)
            for (k, name), value in zip(counted.items(), eta_hat, strict=True)
        ),
        *(ModelVariable(f"diagnosis.{name}", "output", text, whole=True) for name, text in told.items()),
    ]


def plant_model(spec: Spec, name: str) -> Model:
    """Return the model of the plant that a spec simulates, with a prefix of its C names; InvalidSpec of many cells."""
    plant, scenario = spec.scenario.conditions.plant or spec.problem.plant, spec.scenario
    numbers = plant.A.size + plant.b.size
    if numbers > _MOST_NUMBERS:
        raise InvalidSpec(
            f"the plant has {len(plant.b):,} cells: A_i and b_i are {numbers:,} numbers, "
            f"and at most {_MOST_NUMBERS:,} are exported"
        )
    inputs, B = _inputs(spec, plant)
    rows = dict(zip(plant.outputs, plant.C, strict=True))
    rows |= {k: row for k, row in zip(plant.tracked_names, plant.tracked, strict=True) if k not in plant.outputs}
    variables = _plant_variables(spec, plant, inputs, rows)
    values = {
        **_reals(variables),
        "name": name,
        "NAME": name.upper(),
        "title": said(spec.name),
        "spec": spec.sha256,
        "n": len(plant.states),
        "states": ", ".join(plant.states),
        "inputs_said": ", ".join(variable.name for variable in inputs),
        "q": len(rows),
        "C": initialiser([*rows.values()]),
        "m": len(inputs),
        **_tables(plant, B),
    }
    other = ", ".join(f"{key} = {value:g}" for key, value in (scenario.conditions.parameters or {}).items())
    sources = {f"{name}.h": "plant.h", f"{name}.c": "plant.c", "model.h": "plant_model.h"}
    return Model(
        identifier=f"{name}_plant",
        title=f"{spec.name}: plant",
        description=f"Exact between communication points; inputs are held over a step. {other and f'With {other}.'}",
        variables=variables,
        step=None,
        preferred=(scenario.sample_time, scenario.duration),
        sources={file: template(form, **values) for file, form in sources.items()},
        resources={},
    )


def _inputs(spec: Spec, plant: PWASystem) -> tuple[list[ModelVariable], Array]:
    """Return inputs, loads that are estimated, and disturbances of the spec, with their columns in ẋ."""
    units, loads, disturbance = spec.problem.units, spec.problem.plant.loads, spec.scenario.conditions.disturbance
    found, columns = list[ModelVariable](), list[Array]()

    def add(name: str, text: str, unit: str, column: Array) -> None:
        text = f"{text}, held over a step" if text else "held over a step"
        found.append(ModelVariable(name, "input", text, unit, 0.0))
        columns.append(column)

    for k, name in enumerate(plant.inputs):
        add(name, "", units.get(name, ""), plant.B[:, k])
    if loads is not None:
        for k, name in zip(loads.where, loads.names, strict=True):
            add(name, "load", units.get(name, ""), loads.E.floats[:, k])
    if disturbance is not None:
        for k, name in enumerate(plant.states):
            if disturbance.Q[k].any():
                rate = f"{units[name]}/s" if units.get(name) else ""
                add(f"disturbance.{name}", f"added to the derivative of {name}", rate, np.eye(len(plant.states))[k])
    return found, np.array(columns).T


def _plant_variables(
    spec: Spec, plant: PWASystem, inputs: Sequence[ModelVariable], outputs: Iterable[str]
) -> list[ModelVariable]:
    start, units = spec.scenario.initial.plant, spec.problem.units
    if isinstance(start, Steady):
        trajectory = desired_trajectory(spec, False)
        start = plant_start(spec, trajectory, trajectory.eta0)
    start = np.zeros(len(plant.states)) if start is None else np.asarray(start, dtype=np.float64)
    words = {name: "measured" if name in plant.outputs else "tracked" for name in outputs}
    cells = ", ".join(f"{k} {name}" for k, name in enumerate(plant.cell_names[:_FEW_CELLS]))
    return [
        _TIME,
        *inputs,
        *(
            ModelVariable(name, "output", text, units.get(name, ""))
            for name, text in [*words.items(), *((name, "state") for name in plant.states)]
        ),
        *(
            ModelVariable(f"start.{name}", "parameter", f"{name} at the start", units.get(name, ""), value)
            for name, value in zip(plant.states, start.tolist(), strict=True)
        ),
        ModelVariable("diagnosis.cell", "output", f"cell: {cells}", whole=True),
    ]


def _tables(plant: PWASystem, B: Array) -> dict[str, object]:
    """Return the tables of the engine; a plant of one cell has a hyperplane that bounds nothing."""
    n, m = B.shape
    H, h, signs = plant.partition.H, plant.partition.h, plant.partition.signs
    if not len(h):
        H, h, signs = np.zeros((1, n)), np.zeros(1), np.zeros((1, 1), dtype=np.int64)
    steps, degrees = zip(*(_step(A, b, B) for A, b in zip(plant.A, plant.b, strict=True)), strict=True)
    tables = {"A": plant.A, "b": plant.b, "B": B, "step": steps, "H": H, "h": h, "signs": signs}
    return {
        "cells": len(signs),
        "planes": len(h),
        "degree": max(degrees),
        "unit": repr(float(unit(n + m + 1) / EPS)),
        **{name: initialiser(values).replace("}, {", "},\n    {") for name, values in tables.items()},
    }


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
