"""A controller as a model for an FMU: the very C that `export c` writes, and what its variables are."""

import re

from pwatrack.export.c_source import CSource, header
from pwatrack.export.c_step import source
from pwatrack.export.fmu import Parts, template
from pwatrack.export.fmu_description import Model, Variable
from pwatrack.export.source import reference_unit

_ORDER = (
    "At each step: set the inputs, step it, hand its outputs over, then step the plant. To step both at once, give the "
    "design a delay of a sample, and hand over next.* after the step."
)


def controller_parts(c: CSource, duration: float, resources: dict[str, bytes]) -> Parts:
    """Return what the FMU of a controller is made of.

    Args:
        c: The controller, in doubles.
        duration: How long it may run, in s.
        resources: Files beside it.
    """
    variables, of = _variables(c), c.program.sizes
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
        "start": c.numbers([0.0 if variable.start is None else variable.start for variable in reals]),
        "X": of["q"] + of["m"],
        "next": of["m"] if late else 0,
        "show_next": f"    (void)memcpy(&of->real[NEXT], of->core.late, {of['m']}u * sizeof(double));\n"
        if late
        else "",
        **{key: of[key] for key in ("q", "m", "n", "N", "p")},
    }
    sources = {f"{c.name}.h": header(c), f"{c.name}.c": source(c), "model.h": template("controller.h", values)}
    return Parts(model=model, sources=sources, resources=resources)


def _variables(c: CSource) -> tuple[Variable, ...]:
    plant, of, eta = c.file.plant, c.program.sizes, c.file.trajectory.eta
    named = dict(zip(plant.loads.where, plant.loads.names, strict=True)) if plant.loads else {}
    loads = list[str]()
    for k in range(of["N"] - of["n"]):  # a sinusoid has two entries, the first with its name
        loads.append(named[k] if k in named else f"{loads[-1]}.quadrature")
    states, start = [*plant.states, *loads], c.file.start
    x_hat, eta_hat = (start.x_hat, start.eta_hat) if start else ([0.0] * of["N"], [0.0] * of["p"])

    def of_kind(causality: str, name: str, text: str, unit: str = "", value: float | None = None) -> Variable:
        held = causality in ("output", "local")
        return Variable(name=name, causality=causality, description=text, unit=unit, start=value, held=held)

    def unit(name: str) -> str:
        return plant.units.get(name, "")

    return (
        Variable(name="simulation.time", causality="independent", description="time", unit="s"),
        *(of_kind("input", name, "measured now", unit(name), 0.0) for name in plant.outputs),
        *(
            of_kind("input", _reference(name), f"reference: {name}", reference_unit(name, plant.units), 0.0)
            for name in (c.program.reference if c.given else ())
        ),
        *(of_kind("output", name, "put out from the start of the step", unit(name)) for name in plant.inputs),
        *(
            of_kind("output", f"next.{name}", "put out from the end of the step", unit(name))
            for name in (plant.inputs if c.program.sampling.delay else ())
        ),
        *(of_kind("local", f"estimate.{name}", f"{name}, as observed", unit(name)) for name in states),
        *(of_kind("local", f"generator.eta{k + 1}", f"generator: {name}") for k, name in enumerate(eta)),
        *(of_kind("local", f"desired.{name}", f"{name}, as desired", unit(name)) for name in plant.states),
        *(
            of_kind("parameter", f"start.{name}", f"{name} that the observer starts with", unit(name), value)
            for name, value in zip(states, x_hat, strict=True)
        ),
        *(
            of_kind("parameter", f"start.eta{k + 1}", f"what the generator starts with: {name}", "", value)
            for k, (name, value) in enumerate(zip(eta, eta_hat, strict=True))
        ),
        *_diagnosis(c),
    )


def _diagnosis(c: CSource) -> list[Variable]:
    names = c.file.plant.cells
    cells = ": " + ", ".join(f"{k} {name}" for k, name in enumerate(names[:32]))
    same = cells if len(c.program.sides) == len(names) else ", of those left where cells are merged"
    said = {
        "status": "0; 1: the reference has ended; -1: a number was not finite, the output is held",
        "cell": f"cell of the observer{cells}",
        "cell_desired": f"cell of the desired state{same}",
    }
    return [
        Variable(name=f"diagnosis.{name}", causality="output", description=text, whole=True)
        for name, text in said.items()
    ]


def _reference(name: str) -> str:
    """Return the name of an entry of the reference.

    Example:
        >>> _reference("d2y/dt2")
        'reference.d2y_dt2'
    """
    return "reference." + re.sub(r"\W", "_", name)
