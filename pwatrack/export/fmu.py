"""A model in C -> an FMU of FMI 2.0 or 3.0: its description, its sources and, where a compiler is there, a binary."""

import hashlib
import platform
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import pi
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal
from uuid import UUID

from pwatrack.export.source import template
from pwatrack.version import __version__

Version = Literal[2, 3]
_OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden")
_PLATFORMS: Mapping[Version, str] = {2: "linux64", 3: "x86_64-linux"}
_NAMES: Mapping[Version, Mapping[str, str]] = {  # of what both have
    2: {"instance": "fmi2Component", "state": "FMUstate", "deserialize": "DeSerialize"},
    3: {"instance": "fmi3Instance", "state": "FMUState", "deserialize": "Deserialize"},
}
_TIME = (1980, 1, 1, 0, 0, 0)  # of all files: the same content is the same file
_UNKNOWN = "@token@"
_BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")

_UNITS: dict[str, tuple[float, dict[str, int]]] = {
    **{name: (1.0, {name: 1}) for name in _BASE},
    "g": (1e-3, {"kg": 1}),
    "N": (1.0, {"kg": 1, "m": 1, "s": -2}),
    "J": (1.0, {"kg": 1, "m": 2, "s": -2}),
    "W": (1.0, {"kg": 1, "m": 2, "s": -3}),
    "Pa": (1.0, {"kg": 1, "m": -1, "s": -2}),
    "bar": (1e5, {"kg": 1, "m": -1, "s": -2}),
    "Hz": (1.0, {"s": -1}),
    "C": (1.0, {"A": 1, "s": 1}),
    "V": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -1}),
    **dict.fromkeys(("Ohm", "ohm", "Ω"), (1.0, {"kg": 1, "m": 2, "s": -3, "A": -2})),
    "F": (1.0, {"kg": -1, "m": -2, "s": 4, "A": 2}),
    "H": (1.0, {"kg": 1, "m": 2, "s": -2, "A": -2}),
    "T": (1.0, {"kg": 1, "s": -2, "A": -1}),
    **dict.fromkeys(("l", "L"), (1e-3, {"m": 3})),
    "min": (60.0, {"s": 1}),
    "h": (3600.0, {"s": 1}),
    "deg": (pi / 180, {"rad": 1}),
    "rpm": (pi / 30, {"rad": 1, "s": -1}),
    "%": (0.01, {}),
    "1": (1.0, {}),
}
_PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "h": 1e2, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
_SCALED = _UNITS.keys() - {"kg", "min", "h", "deg", "rpm", "%", "1"}
_CELSIUS = ("degC", "°C")  # alone, else only differences are meant
_PART = re.compile(r"([*·/ ]+|^)([^\W\d_]+|[%°Ω]\w*|1)(?:\^?(-?\d+))?(?=[*·/ ]|$)")


@dataclass(frozen=True)
class ModelVariable:
    """A variable of a model; its number is its place in the list, the real ones come first."""

    name: str  # of FMI's structured names
    causality: str  # "independent", "input", "output", "local" or "parameter"
    description: str  # in words
    unit: str = ""  # as a text, "" for none
    start: float | None = None  # of inputs and parameters
    whole: bool = False  # whether it is a whole number
    held: bool = False  # whether it changes at steps only


@dataclass(frozen=True, kw_only=True)
class Model:
    """What an FMU is made of."""

    identifier: str  # its name in C
    title: str  # for people, as the next one
    description: str
    variables: Sequence[ModelVariable]  # all of them, in order
    step: float | None  # the only length of a step in s, or whole multiples of it; None for any length
    preferred: tuple[float, float]  # a length of steps, and how long it may run, in s
    sources: Mapping[str, str]  # C files and headers by name, without those of FMI
    resources: Mapping[str, bytes]  # other files by name


def packed(model: Model, version: Version, compiler: str | None) -> dict[str, bytes]:
    """Return all files of an FMU by their paths, without a compiler its sources only; raises as `compiled`."""
    main = f"fmi{version}.c"
    calls = template("fmi_calls.c", version=version, fmi=f"fmi{version}", FMI=f"FMI{version}", **_NAMES[version])
    sources = {main: template(main, calls=calls), "instance.h": template("instance.h"), **model.sources}
    files = [name for name in sources if name.endswith(".c")]
    whole = [_description(model, version, files, ""), *(text.encode() for text in sources.values())]
    token = str(UUID(hashlib.sha256(b"".join(whole)).hexdigest()[:32]))  # tells it apart from every other one
    token = f"{{{token}}}" if version == 2 else token
    sources = {name: text.replace(_UNKNOWN, token) for name, text in sources.items()}
    found = {"modelDescription.xml": _description(model, version, files, token)}
    found |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    if version == 3:
        root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
        configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=model.identifier)
        options = "-std=c99 -O2 -ffp-contract=off"
        _named(configuration, "SourceFileSet", "SourceFile", files, language="C99", compilerOptions=options)
        ET.SubElement(configuration, "Library", name="m", external="true")
        found["sources/buildDescription.xml"] = _text(root)
    found |= {f"resources/{name}": content for name, content in model.resources.items()}
    if compiler is not None:
        found[f"binaries/{_PLATFORMS[version]}/{model.identifier}.so"] = compiled(sources, compiler)
    return found


def write_fmu(found: Mapping[str, bytes], path: Path) -> None:
    """Write an FMU: the same files are the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in found.items():
            entry = zipfile.ZipInfo(name, _TIME)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)


def compiled(sources: Mapping[str, str], compiler: str, options: Sequence[str] = ()) -> bytes:
    """Return a shared library of C files and headers; raises RuntimeError with the first error of the compiler."""
    with TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        names = [name for name in sources if name.endswith(".c")]
        command = [compiler, *_OPTIONS, *options, "-o", "model.so", *names, "-lm"]
        found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if found.returncode:
            errors = [line for line in found.stderr.splitlines() if "error" in line] or [f"exit {found.returncode}"]
            raise RuntimeError(f"{compiler}: {errors[0]}")
        return (Path(folder) / "model.so").read_bytes()


def c_compiler() -> str | None:
    """Return the C compiler of this machine, where FMUs for it have a folder for their binary."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    return next((path for path in map(shutil.which, ("cc", "gcc", "clang")) if path), None)


def _description(model: Model, version: Version, files: Sequence[str], token: str) -> bytes:
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{version}.0",
            "modelName": _line(model.title),
            "guid" if version == 2 else "instantiationToken": token,
            "description": _line(model.description),
            "license": "It belongs to its user: LICENSE-EXCEPTION of pwatrack",
            "generationTool": f"pwatrack {__version__}",
            "variableNamingConvention": "structured",
        },
    )
    state = _NAMES[version]["state"]
    able = {
        "modelIdentifier": model.identifier,
        "canHandleVariableCommunicationStepSize": "true" if model.step is None else "false",
        f"canGetAndSet{state}": "true",
        f"canSerialize{state}": "true",
    }
    if version == 2:
        able["canNotUseMemoryManagementFunctions"] = "true"
    elif model.step is not None:
        able["fixedInternalStepSize"] = repr(model.step)
    interface = ET.SubElement(root, "CoSimulation", able)
    if version == 2:
        _named(interface, "SourceFiles", "File", files)
    _units(root, model)
    _named(root, "LogCategories", "Category", ("logStatusWarning", "logStatusError"))
    step, stop = model.preferred
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime=repr(stop), stepSize=repr(step))
    variables = ET.SubElement(root, "ModelVariables")
    for number, variable in enumerate(model.variables):
        _variable(variables, variable, number, version)
    _structure(root, model, version)
    return _text(root)


def _named(root: ET.Element, tag: str, each: str, names: Iterable[str], **said: str) -> None:
    found = ET.SubElement(root, tag, said)
    for name in names:
        ET.SubElement(found, each, name=name)


def _units(root: ET.Element, model: Model) -> None:
    names = dict.fromkeys(variable.unit for variable in model.variables if variable.unit)
    units = ET.SubElement(root, "UnitDefinitions")
    for name in names:
        unit, base = ET.SubElement(units, "Unit", name=_line(name)), base_unit(name)
        if base is not None:
            powers, factor, offset = base
            said = {power: str(value) for power, value in powers.items()}
            said |= {"factor": repr(factor)} if factor != 1 else {}
            ET.SubElement(unit, "BaseUnit", said | ({"offset": repr(offset)} if offset else {}))


def _variable(variables: ET.Element, variable: ModelVariable, number: int, version: Version) -> None:
    said = {"name": variable.name, "valueReference": str(number), "description": _line(variable.description)}
    variability = "discrete" if variable.held or variable.whole else "continuous"
    said["causality"] = variable.causality
    said["variability"] = "fixed" if variable.causality == "parameter" else variability
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
    for name, more in (("Output", {"dependencies": ""}), ("InitialUnknown", dict[str, str]())):
        within = structure if version == 3 else ET.SubElement(structure, f"{name}s")
        for k in outputs:
            number = {"valueReference": str(k)} if version == 3 else {"index": str(k + 1)}
            ET.SubElement(within, name if version == 3 else "Unknown", number | more)


def _line(text: str) -> str:
    """Return a text as one line of what XML can hold."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _text(root: ET.Element) -> bytes:
    ET.indent(root)
    found: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return found + b"\n"


def base_unit(text: str) -> tuple[Mapping[str, int], float, float] | None:
    """Return powers of base units, factor and offset: v of a unit is factor · v + offset; None where it is not known.

    A product has spaces, `*` or `·` between its factors; `/` divides by the next one; a number is a power.

    Example:
        >>> base_unit("mN m/s^2")
        ({'kg': 1, 'm': 2, 's': -4}, 0.001, 0.0)
        >>> base_unit("degC"), base_unit("degC/s"), base_unit("pieces")
        (({'K': 1}, 1.0, 273.15), ({'s': -1, 'K': 1}, 1.0, 0.0), None)
    """
    if text in _CELSIUS:
        return {"K": 1}, 1.0, 273.15
    powers, factor, place = dict[str, int](), 1.0, 0
    for part in _PART.finditer(text):
        between, symbol = part[1].strip(), "K" if part[2] in _CELSIUS else part[2]
        scaled = symbol not in _UNITS and symbol[1:] in _SCALED
        scale, symbol = (_PREFIXES.get(symbol[0]), symbol[1:]) if scaled else (1.0, symbol)
        if part.start() != place or scale is None or symbol not in _UNITS or len(between) > 1:
            return None
        place, power = part.end(), int(part[3] or 1) * (-1 if between == "/" else 1)
        factor *= (scale * _UNITS[symbol][0]) ** power
        for name, count in _UNITS[symbol][1].items():
            powers[name] = powers.get(name, 0) + power * count
    if not text or place != len(text):
        return None
    return {name: powers[name] for name in _BASE if powers.get(name)}, factor, 0.0
