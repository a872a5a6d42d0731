"""A spec, a run folder or a controller.json -> exported code or FMUs, with what is proved, or its proof for Coq."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pwatrack.commands.verify import CERTIFICATE, CONTROLLER, as_exported, certificate_text, told_design, verify
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController
from pwatrack.errors import CheckFailed, InvalidSpec, OutsideTheory, Problem
from pwatrack.export.fixed_point import FixedPoint
from pwatrack.export.fmu import Model, Version, c_compiler, packed, write_fmu
from pwatrack.export.fmu_models import controller_model, plant_model
from pwatrack.export.notation import LANGUAGES, Numbers
from pwatrack.export.reading import run
from pwatrack.export.rounding import NOT_KNOWN, of_run
from pwatrack.export.schema import ControllerFile
from pwatrack.export.source import Source, Vector, prefix, write_texts
from pwatrack.export.stored import check_same, digest, parsed, read, with_gains, with_played
from pwatrack.lmi.audit.reading import parsed as certificate_content
from pwatrack.model.conditions import Sampling
from pwatrack.model.nonlinearity import MOST_LISTED
from pwatrack.report.controller import has_tables, starts, written
from pwatrack.report.kept_spec import load, spec_of
from pwatrack.report.run_folder import json_text, lacking, read_index
from pwatrack.report.screen import Findings
from pwatrack.spec.load import load_spec
from pwatrack.spec.spec import Spec
from pwatrack.workflow import pipeline

_STEPS = 1000  # of a test vector
_DURATION = 10.0  # s: how long the FMU of a controller may run whose spec is not at hand


@dataclass(frozen=True)
class Subject:
    """What is exported: a controller with its proof, and what goes with it."""

    file: ControllerFile
    certificate: str
    unproved: tuple[str, ...]  # what of it is not proved
    vector: Vector  # what it reads in a test
    spec: Spec | None  # if that is there
    controller: ProvedController | None = None  # likewise

    def source(self, name: str, *, given: bool, single: bool = False) -> Source:
        """Return what its code is written from."""
        return Source(
            file=self.file, name=name, single=single, given=given, unproved=self.unproved, checked=self.spec is not None
        )

    def rounded(self, code: Source, kind: Literal["float32", "int32"]) -> Source:
        """Return code in numbers of a kind, with what their rounding makes of the bounds of its run.

        Of single floats it says why where that is not proved. Raises InvalidSpec, OutsideTheory or CheckFailed if
        whole numbers have no spec at hand, or are not made, or not proved.
        """
        if self.spec is None or self.controller is None:
            if kind == "float32":
                return replace(code, rounding=_unknown("the spec is not at hand"))
            raise InvalidSpec("--int32 needs the ranges of all numbers in a run: export the spec, or its run folder")
        spec, h, end = self.spec, code.program.sampling.sample_time, self.controller.trajectory.exosystem.end
        t = h * np.arange(int(min(spec.scenario.duration, np.inf if end is None else end) / h) + 1)
        given = _outside(self.controller, self.file, t) if code.given else np.zeros((len(t), 0))
        try:
            found = of_run(self.controller, code, kind, given)
            told = found.sentence(spec.words)
            if isinstance(found.numbers, FixedPoint):
                self._check_runs(found.numbers)
        except (OutsideTheory, CheckFailed) as refusal:
            if kind == "float32":
                return replace(code, rounding=_unknown(refusal.problems[0].message.removeprefix(NOT_KNOWN)))
            raise
        return replace(code, rounding=told, whole=found.numbers if isinstance(found.numbers, FixedPoint) else None)

    def _check_runs(self, numbers: FixedPoint) -> None:
        """Refuse whole numbers that what is measured in the simulation does not fit in."""
        seen = run(numbers.step, numbers.counts("y", self.vector.y), numbers.counts("w", self.vector.w))
        if (seen["status"] < 0).any():
            tick = int(np.argmax(seen["status"] < 0))
            message = f"whole numbers of 32 bits: in its simulation a number is out of range at tick {tick}"
            raise CheckFailed(
                message, hint="what is proved of ranges begins with x = x_hat = x_d: start there, or export floats"
            )

    @property
    def beside(self) -> dict[str, str]:
        """The files that go with every export: the controller, and its proof if there is one."""
        files = {CONTROLLER: json_text(self.file.model_dump()), CERTIFICATE: self.certificate}
        return {name: text for name, text in files.items() if text}


@dataclass(frozen=True, kw_only=True)
class ExportTask:
    """What is to be exported, and how."""

    target: Path  # a spec, a run folder or a controller.json
    parameters: Mapping[str, Any]  # replacements, for a spec
    sample_time: float | None  # of the controller, in s, likewise
    name: str | None  # prefix of all names; by default from the name of the spec
    given: bool  # whether the reference comes from outside
    unproved: bool  # whether what is not proved is written, too
    failed: bool  # and the controller of a run that failed

    @property
    def stored(self) -> Path | None:
        """The controller.json that is exported; None where it is a spec, which alone can be changed."""
        if not self.target.is_dir() and self.target.suffix != ".json":
            return None
        if self.parameters or self.sample_time is not None:
            message = f"{self.target}: --set and --sample-time go with a spec, not with a controller that is stored"
            raise InvalidSpec(message, hint="export the spec with them, or design with them and export that run")
        if self.target.is_dir() and not (self.target / CONTROLLER).exists():
            raise lacking(self.target, CONTROLLER)
        return self.target / CONTROLLER if self.target.is_dir() else self.target


def export(to: str, task: ExportTask, out: Path, *, numbers: Numbers = "float64") -> list[str]:
    """Write a controller in one of `LANGUAGES` to a folder; return in sentences what was written, and what is proved.

    Raises InvalidSpec if it has no sample time, or CheckFailed if it is not proved or failed, unless that is exported.
    """
    subject = subject_of(task)
    name, single = prefix(task.name or subject.file.name), numbers == "float32"
    code = subject.source(name, single=single, given=task.given)
    code = code if numbers == "float64" else subject.rounded(code, numbers)
    try:
        names = [*LANGUAGES[to].write(code, subject.vector, out), *write_texts(subject.beside, out)]
    except OSError as error:
        raise unwritable(out, error) from None
    return [f"Code in {out}/: {', '.join(names)}", *filter(None, [code.rounding])]


def subject_of(task: ExportTask) -> Subject:
    """Return what is exported of a spec, a run folder or a controller.json; raises as `export`."""
    path, target = task.stored, task.target
    if path is None:
        found = of_spec(load_spec(target, task.parameters), task.sample_time, task.given)
    else:
        found = _stored(path, task.given)
    against = [
        ("not proved", found.unproved, "--unproved", task.unproved),
        ("its run failed", found.file.failed, "--failed", task.failed),
    ]
    problems = [
        Problem(message=f"{target}: {what}: {line}", hint=f"{option} exports it all the same, and its header says so")
        for what, lines, option, meant in against
        for line in lines
        if not meant
    ]
    if problems:
        raise CheckFailed(*problems)
    return found


def of_spec(spec: Spec, sample_time: float | None = None, given: bool = False, steps: int = _STEPS) -> Subject:
    """Design what a spec asks for, simulate so many steps of it, all of it where it requires something; return it."""
    conditions = spec.scenario.conditions
    if sample_time is not None:
        sampling = replace(conditions.sampling or Sampling(sample_time=sample_time), sample_time=sample_time)
        if sampling.jitter >= sample_time:
            message = (
                f"--sample-time {sample_time:g}: the file has a jitter of {sampling.jitter:g} s, which is not below it"
            )
            raise InvalidSpec(message, hint="a longer one, or less jitter in the file")
        spec = replace(spec, scenario=replace(spec.scenario, conditions=replace(conditions, sampling=sampling)))
    controller = pipeline.design(spec, growing=True)
    found = _simulated(spec, controller, None, given, steps)
    if not spec.requirements:
        return found
    came = Findings(spec=spec, controller=controller, result=pipeline.simulate(spec, controller))
    told = found.file.model_dump() | {"failed": came.missed}
    return replace(found, file=parsed(told | {"sha256": digest(told)}, spec.path))


def _simulated(
    spec: Spec, controller: ProvedController, runs: SampledController | None, given: bool, steps: int
) -> Subject:
    """Return a controller with what it reads in the first steps of its simulation."""
    sampling = spec.scenario.conditions.sampling
    if sampling is None:
        raise InvalidSpec(f"{spec.path}: the controller has no sample time", hint="--sample-time")
    if not has_tables(controller):
        message = f"{spec.path}: the controller has {len(controller.plant.A):,} cells, too many for its tables"
        raise InvalidSpec(message, hint=f"at most {MOST_LISTED:,} are exported")
    h, end = sampling.sample_time, controller.trajectory.exosystem.end
    last = min(steps * h, np.inf if end is None else end)
    short = replace(spec, scenario=replace(spec.scenario, duration=float(last), sample_time=h))
    result = pipeline.simulate(short, controller, runs)
    z, at = result.response.trace.z, result.loop.at
    made = written(spec, result.controller, starts(result.loop, result.start))
    file = parsed(made.controller, spec.path)
    y, t = z[:steps, at.y], h * np.arange(min(steps, len(z)))
    w = _outside(controller, file, t) if given else np.zeros((len(y), 0))
    vector = Vector(y, w, "the exact simulation of its spec")
    return Subject(file, made.certificate, tuple(file.open), vector, spec, result.controller)


def _outside(controller: ProvedController, file: ControllerFile, t: Any) -> Any:
    """Return the reference of a controller as it is given from outside at some ticks: of when the input acts."""
    assert file.program is not None
    sampling, end = file.program.sampling, controller.trajectory.exosystem.end
    t = np.minimum(t + sampling.ahead * sampling.sample_time, np.inf if end is None else end)
    trajectory, count = controller.trajectory, len(file.program.outside.given)
    system, w = trajectory.exosystem, trajectory.exosystem.states(t)
    if not trajectory.names and (controller.generator is None or controller.generator.played_back):
        x_d = trajectory.x_d[0]  # the same in all cells, with its derivative
        return np.hstack([w @ x_d[:, :-1].T + x_d[:, -1], w @ (x_d[:, :-1] @ system.S).T])
    return np.hstack([w @ row.T for row in system.derivative_rows(count)])[:, :count]


def _unknown(why: str) -> str:
    return f"What single floats add to the bounds of its run is not proved: {why}."


def _stored(path: Path, given: bool) -> Subject:
    """Return a controller from its file, with its proof beside it if it is there."""
    file, folder = read(path), path.parent
    certificate, unproved, spec = folder / CERTIFICATE, list(file.open), its_spec(file, folder)
    text = certificate.read_bytes() if certificate.is_file() else b""
    told = bool(text) and hashlib.sha256(text).hexdigest() == file.proof
    if not text:
        unproved.append(f"there is no {CERTIFICATE} beside it")
    elif not told:
        unproved.append(f"the {CERTIFICATE} beside it is not the one that it names")
    else:
        verify(folder, None if spec is None else spec.path)
    proved = json.loads(text) if text else {"K": file.K, "L": file.L}
    if any([[float(v) for v in row] for row in proved.get(of) or []] != getattr(file, of) for of in ("K", "L")):
        unproved.append("the proof is about other gains")
    if file.program is None:
        hint = "give simulation.controller.sample_time and design anew, or export the spec with --sample-time"
        raise InvalidSpec(f"{path}: the controller has no sample time", hint=hint)
    if spec is not None:
        spec = as_exported(spec, file.program, folder)
        again = with_gains(spec, file)
        if told:
            played = with_played(spec, file.trajectory.reference.model_dump())
            controller = told_design(played, certificate_content(text.decode()))
        else:
            controller = pipeline.design(again, growing=True)
        runs = check_same(again, controller, file)
        found = _simulated(again, controller, runs, given, _STEPS)
        return replace(found, file=file, certificate=text.decode(), unproved=tuple(unproved), spec=spec)
    q, s = len(file.plant.outputs), len(file.program.outside.given)
    t = np.arange(_STEPS)[:, None]
    y, w = 0.1 * np.sin(0.01 * t * (1 + np.arange(q))), 0.1 * np.cos(0.01 * t * (1 + np.arange(s)))
    return Subject(file, text.decode(), tuple(unproved), Vector(y, w, "sinusoids: the spec was not at hand"), None)


def its_spec(file: ControllerFile, folder: Path) -> Spec | None:
    """Return the spec that the run in a folder was made from, as it was then; None where that is not at hand."""
    path, _ = spec_of(read_index(folder) or {}, folder, file.spec_sha256)
    spec = None if path is None else load(path, file.set)
    return spec if spec is not None and spec.sha256 == file.spec_sha256 else None


def certify(path: Path, out: Path) -> list[str]:
    """Write what the kernel of Coq checks of a certificate to a folder, and return the names of the files."""
    from pwatrack.export.coq import development

    verify(path)
    file, text = certificate_text(path)
    return write_texts(development(certificate_content(text), prefix(file.resolve().parent.name)), out)


def unwritable(out: Path, error: OSError) -> InvalidSpec:
    """Return the refusal of a folder that cannot be written."""
    return InvalidSpec(f"cannot write to {out}: {error.strerror or error}")


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
