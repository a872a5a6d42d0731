"""What an FMU says of itself: modelDescription.xml, of FMI 2.0 and 3.0."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Literal

from pwatrack.export.unit_text import base_unit
from pwatrack.version import __version__

Version = Literal[2, 3]


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A variable of a model; its number is its place in the list, the real ones come first.

    Attributes:
        name: Of FMI's structured names.
        causality: "independent", "input", "output", "local" or "parameter".
        description: In words.
        unit: As a text, "" for none.
        start: Of inputs and parameters.
        whole: Whether it is a whole number.
        held: Whether it changes at steps only.
    """

    name: str
    causality: str
    description: str
    unit: str = ""
    start: float | None = None
    whole: bool = False
    held: bool = False

    @property
    def variability(self) -> str:
        """In the words of FMI."""
        if self.causality == "parameter":
            return "fixed"
        return "discrete" if self.held or self.whole else "continuous"


@dataclass(frozen=True, kw_only=True)
class Model:
    """What a description is about.

    Attributes:
        identifier: Its name in C.
        title, description: Of it, for people.
        token: What tells it apart from every other one.
        variables: All of them, in order.
        step: The only length of a step in s, or whole multiples of it; None for any length.
        preferred: A length of steps, and how long it may run, in s.
        files: Names of the C files.
    """

    identifier: str
    title: str
    description: str
    token: str
    variables: tuple[Variable, ...]
    step: float | None
    preferred: tuple[float, float]
    files: tuple[str, ...]


def description(model: Model, version: Version) -> bytes:
    """Return modelDescription.xml."""
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{version}.0",
            "modelName": _line(model.title),
            "guid" if version == 2 else "instantiationToken": model.token,
            "description": _line(model.description),
            "license": "It belongs to its user: LICENSE-EXCEPTION of pwatrack",
            "generationTool": f"pwatrack {__version__}",
            "variableNamingConvention": "structured",
        },
    )
    _interface(root, model, version)
    _units(root, model)
    categories = ET.SubElement(root, "LogCategories")
    for name in ("logStatusWarning", "logStatusError"):
        ET.SubElement(categories, "Category", name=name)
    step, stop = model.preferred
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime=repr(stop), stepSize=repr(step))
    variables = ET.SubElement(root, "ModelVariables")
    for number, variable in enumerate(model.variables):
        _variable(variables, variable, number, version)
    _structure(root, model, version)
    return _text(root)


def build_description(model: Model) -> bytes:
    """Return sources/buildDescription.xml of FMI 3.0."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=model.identifier)
    options = "-std=c99 -O2 -ffp-contract=off"
    sources = ET.SubElement(configuration, "SourceFileSet", language="C99", compilerOptions=options)
    for name in model.files:
        ET.SubElement(sources, "SourceFile", name=name)
    ET.SubElement(configuration, "Library", name="m", external="true")
    return _text(root)


def _interface(root: ET.Element, model: Model, version: Version) -> None:
    state = "FMUstate" if version == 2 else "FMUState"
    said = {
        "modelIdentifier": model.identifier,
        "canHandleVariableCommunicationStepSize": "true" if model.step is None else "false",
        f"canGetAndSet{state}": "true",
        f"canSerialize{state}": "true",
    }
    if version == 2:
        said["canNotUseMemoryManagementFunctions"] = "true"
    elif model.step is not None:
        said["fixedInternalStepSize"] = repr(model.step)
    interface = ET.SubElement(root, "CoSimulation", said)
    if version == 2:
        files = ET.SubElement(interface, "SourceFiles")
        for name in model.files:
            ET.SubElement(files, "File", name=name)


def _units(root: ET.Element, model: Model) -> None:
    names = dict.fromkeys(variable.unit for variable in model.variables if variable.unit)
    units = ET.SubElement(root, "UnitDefinitions")
    for name in names:
        unit, base = ET.SubElement(units, "Unit", name=_line(name)), base_unit(name)
        if base is not None:
            said = {power: str(value) for power, value in base.powers.items()}
            said |= {"factor": repr(base.factor)} if base.factor != 1 else {}
            ET.SubElement(unit, "BaseUnit", said | ({"offset": repr(base.offset)} if base.offset else {}))


def _variable(variables: ET.Element, variable: Variable, number: int, version: Version) -> None:
    said = {"name": variable.name, "valueReference": str(number), "description": _line(variable.description)}
    said |= {"causality": variable.causality, "variability": variable.variability}
    of: dict[str, str] = {"unit": _line(variable.unit)} if variable.unit else {}
    of |= {} if variable.start is None else {"start": repr(variable.start)}
    if version == 3:
        ET.SubElement(variables, "Int32" if variable.whole else "Float64", said | of)
    else:
        scalar = ET.SubElement(variables, "ScalarVariable", said)
        ET.SubElement(scalar, "Integer" if variable.whole else "Real", of)


def _structure(root: ET.Element, model: Model, version: Version) -> None:
    """Say that no output depends on an input at once: it follows in the next step."""
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [k for k, variable in enumerate(model.variables) if variable.causality == "output"]
    if version == 3:
        for k in outputs:
            ET.SubElement(structure, "Output", valueReference=str(k), dependencies="")
        for k in outputs:
            ET.SubElement(structure, "InitialUnknown", valueReference=str(k))
        return
    lists = [ET.SubElement(structure, name) for name in ("Outputs", "InitialUnknowns")]
    for k in outputs:
        ET.SubElement(lists[0], "Unknown", index=str(k + 1), dependencies="")
        ET.SubElement(lists[1], "Unknown", index=str(k + 1))


def _line(text: str) -> str:
    """Return a text as one line of what XML can hold."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _text(root: ET.Element) -> bytes:
    ET.indent(root)
    found: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return found + b"\n"
