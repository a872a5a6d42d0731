"""A spec, a run folder or a controller.json -> FMUs of its controller and its plant."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from pwatrack.commands.export import ExportTask, its_spec, subject_of, unwritable
from pwatrack.errors import CheckFailed, InvalidSpec
from pwatrack.export.fmu import Model, Version, c_compiler, packed, write_fmu
from pwatrack.export.fmu_models import controller_model, plant_model
from pwatrack.export.source import prefix
from pwatrack.export.stored import read
from pwatrack.spec.load import load_spec

_DURATION = 10.0  # s: how long the FMU of a controller may run whose spec is not at hand


def export_fmu(
    task: ExportTask, out: Path, *, versions: Sequence[Version], of: Sequence[Literal["controller", "plant"]]
) -> list[str]:
    """Write FMUs `of` a controller, a plant whose spec is at hand, or both; return in sentences what was written.

    The rest is as for `export`. Raises also InvalidSpec for too many cells, or an option that is not for what is
    exported, and CheckFailed if a compiler that is there makes no binary.
    """
    made = dict[str, Model]()
    if "controller" not in of:
        unused = {"--sample-time": task.sample_time is not None, "--reference outside": task.given}
        unused |= {"--unproved": task.unproved, "--failed": task.failed}
        if any(unused.values()):
            names = ", ".join(name for name, there in unused.items() if there)
            message = f"{names}: that is for a controller, and only the plant is exported"
            raise InvalidSpec(message, hint="leave it out, or export the controller, too: --of both")
        path = task.stored
        spec = load_spec(task.target, task.parameters) if path is None else its_spec(read(path), path.parent)
    else:
        subject = subject_of(task)
        code, spec = subject.source(prefix(task.name or subject.file.name), given=task.given), subject.spec
        resources = {file: text.encode() for file, text in subject.beside.items()}
        made["controller"] = controller_model(code, _DURATION if spec is None else spec.scenario.duration, resources)
    if "plant" in of:
        if spec is None:
            message = f"{task.target}: the spec that it was made from is not at hand, or was changed since"
            hint = "--of controller exports the controller by itself; a spec exports its plant"
            raise InvalidSpec(message, hint=hint)
        made["plant"] = plant_model(spec, prefix(task.name or spec.name))
    return _write_fmus(made, versions, out)


def _write_fmus(made: Mapping[str, Model], versions: Sequence[Version], out: Path) -> list[str]:
    compiler = c_compiler()
    inside = "sources and a Linux binary" if compiler else "sources only: no C compiler for Linux on x86-64 was found"
    try:
        found = {
            (version, part, out / f"{model.identifier}_fmi{version}.fmu"): packed(model, version, compiler)
            for part, model in made.items()
            for version in versions
        }
        for (_, _, path), files in found.items():
            write_fmu(files, path)
    except RuntimeError as error:
        raise CheckFailed(f"the FMU's own sources were not compiled: {error}") from None
    except OSError as error:
        raise unwritable(out, error) from None
    return [f"FMI {version}.0 of the {part} in {path}, {inside}" for version, part, path in found]
