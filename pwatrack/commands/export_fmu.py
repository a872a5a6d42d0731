"""A spec, a run folder or a controller.json -> FMUs of its controller and its plant."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pwatrack.commands.export import its_spec, stored, subject_of, unwritable
from pwatrack.commands.verify import CONTROLLER
from pwatrack.errors import CheckFailed, InvalidSpec, Problem
from pwatrack.export.fmu import Parts, Version, c_compiler, packed, write_fmu
from pwatrack.export.fmu_models import controller_parts, plant_parts
from pwatrack.export.source import prefix
from pwatrack.export.stored import read
from pwatrack.spec.load import load_spec
from pwatrack.spec.spec import Spec

Of = Literal["controller", "plant"]
_RUNS = 10.0  # s: of a controller whose spec is not at hand


def export_fmu(
    target: Path,
    out: Path,
    *,
    parameters: Mapping[str, Any],
    sample_time: float | None,
    name: str | None,
    versions: Sequence[Version],
    of: Sequence[Of],
    given: bool,
    unproved: bool,
    failed: bool,
) -> list[str]:
    """Write FMUs for co-simulation.

    Args:
        target: A spec, a run folder or a controller.json; for a plant its spec must be at hand.
        out: The folder for them.
        parameters: Replacements, for a spec.
        sample_time: In s, for a spec that has none.
        name: Prefix of all names; by default from the name of the spec.
        versions: Of FMI.
        of: What is written: its controller, its plant.
        given: Whether the reference comes from outside.
        unproved: Whether to write a controller that is not proved, too.
        failed: Whether to write one whose run failed, too.

    Returns:
        What was written, in sentences.

    Raises:
        InvalidSpec: If there is no sample time, too many cells, something cannot be read or written, or an option is
            not for what is exported.
        CheckFailed: If the controller is not proved, unless `unproved`; if its run failed, unless `failed`; if a
            compiler that is there makes no binary.
    """
    made = dict[str, Parts]()
    if "controller" not in of:
        unused = {"--sample-time": sample_time is not None, "--reference outside": given, "--unproved": unproved}
        unused["--failed"] = failed
        if any(unused.values()):
            names = ", ".join(name for name, there in unused.items() if there)
            message = f"{names}: that is for a controller, and only the plant is exported"
            raise InvalidSpec(message, hint="leave it out, or export the controller, too: --of both")
        spec = _spec(target, parameters)
    else:
        subject = subject_of(target, parameters, sample_time, given, unproved, failed)
        called = prefix(name or subject.file.name)
        code = subject.source(called, given=given)
        resources = {file: text.encode() for file, text in subject.beside.items()}
        spec = subject.spec
        duration = _RUNS if spec is None else spec.scenario.duration
        made["controller"] = controller_parts(code, duration, resources)
    if "plant" in of:
        if spec is None:
            message = f"{target}: the spec that it was made from is not at hand, or was changed since"
            hint = "--of controller exports the controller by itself; a spec exports its plant"
            raise InvalidSpec(Problem(message=message, subject=None, hint=hint))
        made["plant"] = plant_parts(spec, prefix(name or spec.name))
    return _written(made, versions, out)


def _written(made: Mapping[str, Parts], versions: Sequence[Version], out: Path) -> list[str]:
    compiler = c_compiler()
    inside = "sources and a Linux binary" if compiler else "sources only: no C compiler for Linux on x86-64 was found"
    try:
        paths = {
            out / f"{parts.model.identifier}_fmi{version}.fmu": (version, part, packed(parts, version, compiler))
            for part, parts in made.items()
            for version in versions
        }
        for path, (_, _, found) in paths.items():
            write_fmu(found, path)
    except RuntimeError as error:
        raise CheckFailed(Problem(message=f"the FMU's own sources were not compiled: {error}", subject=None)) from None
    except OSError as error:
        raise unwritable(out, error) from None
    return [f"FMI {version}.0 of the {part} in {path}, {inside}" for path, (version, part, _) in paths.items()]


def _spec(target: Path, parameters: Mapping[str, Any]) -> Spec | None:
    """Return the spec, or that of a run, if it is there as it was."""
    if not stored(target, parameters, None):
        return load_spec(target, parameters)
    path = target / CONTROLLER if target.is_dir() else target
    return its_spec(read(path), path.parent)
