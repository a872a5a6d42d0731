"""One run of one spec as the command line does it: progress, files, summary."""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from rich.status import Status

from pwatrack.control.controller import ProvedController
from pwatrack.control.pareto import Front, pareto
from pwatrack.control.program import SampledController
from pwatrack.control.task import Task
from pwatrack.errors import CheckFailed, ExitCode, InvalidSpec, Problem, ProblemPart, PwatrackError, Undecided
from pwatrack.export.stored import check_same, read, with_gains
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER, Solver
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.lmi.solve import answers, asking
from pwatrack.report import files, summary
from pwatrack.report.files import Effort
from pwatrack.report.parameters import how_far_texts, largest_text
from pwatrack.report.run_folder import INDEX, REFUSAL, Plots, read_index
from pwatrack.report.screen import Findings, first_rows, print_screen, screen
from pwatrack.report.terminal import compiling, console
from pwatrack.spec.load import assignments, load_spec
from pwatrack.spec.spec import Spec
from pwatrack.spec.spelling import path_of
from pwatrack.workflow import pipeline
from pwatrack.workflow.how_far import LargestBox, how_far, largest_box
from pwatrack.workflow.outcome import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult, ensemble

Shown = Literal["summary", "more", "json", "nothing"]
_LONG = 2.0  # seconds after which a step says how long it has been at it


def run(
    path: Path,
    folder: Path,
    parameters: Sequence[str],
    solver: Solver | None,
    *,
    simulated: bool,
    paretos: bool = False,
    scaled: bool = False,
    stored: Path | None = None,
    members: Mapping[str, Any] | None = None,
    plots: Plots = "all",
    drawing: Executor | None = None,
    shown: Shown = "summary",
    outside: bool = False,
) -> None:
    """Design, simulate if asked, write the files, and print what came out; a refusal of the theory is written, too.

    Args:
        path, folder, parameters: The spec file, where the files go, and replacements as NAME=VALUE.
        solver: Which interior-point solver to ask, instead of the one in the spec.
        simulated: Whether to simulate.
        paretos, scaled: Whether to find what other rates would cost, how far a box can be scaled; without a simulation.
        stored, members: A controller.json that is simulated instead of a new one, and what `ensemble` of it takes.
        plots, drawing: Whether pictures are drawn, or only if the run does not end as its spec expects; who else draws.
        shown: What is printed on stdout: the summary, also how long each step took, run.json instead, or nothing.
        outside: Whether the spec may refer to files outside of its folder.
    """
    progress, meant = console(stderr=True), shown in ("summary", "more")
    status = progress.status("Reading the spec")
    made = _Made(path=path, parameters=assignments(parameters), outside=outside, status=status)
    with answers() as made.answered, status, compiling(progress, meant=meant):
        try:
            spec, controller = made.design(solver, stored, growing=simulated, scaled=scaled)
            result, many = made.simulate(spec, controller, members) if simulated else (None, None)
            controller = controller if result is None else result.controller  # which knows whether x_d stays bounded
            fronts = made.fronts(spec, controller) if paretos and not simulated else ()
            found = Findings(spec=spec, controller=controller, result=result, many=many, largest=made.largest)
            first = list(first_rows(found))
        except PwatrackError as refusal:
            made.keep(refusal, folder, shown)
            raise
        status.update("Writing the files")
        long = partial(summary.print_all, found=found)
        kept: Any = {"summary": summary.written(long), "plots": plots, "executor": drawing}
        files.write(found, folder, fronts=fronts, effort=made.effort, warned=True, **kept)
    if shown == "summary":
        print_screen(console(), screen(spec.name, first, folder))
    elif shown == "json":
        sys.stdout.write((folder / INDEX).read_text(encoding="utf-8"))
    elif shown == "more":
        long(console())
        summary.print_files(console(), folder)
        console().print(", ".join(f"{step} {seconds:.2f} s" for step, seconds in made.seconds.items()))
    _check(found)


@dataclass(frozen=True, kw_only=True)
class _Going:
    """What a step says of itself as long as it goes on: how long that is, and how many programs it has solved."""

    said: str
    solved: Mapping[str, int]
    before: int
    since: float = field(default_factory=time.perf_counter)

    def __rich__(self) -> str:
        count, seconds = sum(self.solved.values()) - self.before, time.perf_counter() - self.since
        programs = f"{count:,} programs, " * (count > 0)
        return f"{self.said}: {programs}{seconds:.0f} s" if seconds >= _LONG else self.said


@dataclass(kw_only=True)
class _Made:
    """What a run has made so far, and how long each step took in s: what is left where the next step is refused."""

    path: Path
    parameters: dict[str, str]
    outside: bool
    status: Status
    seconds: dict[str, float] = field(default_factory=dict)
    spec: Spec | None = None
    controller: ProvedController | None = None
    runs: SampledController | None = None
    largest: LargestBox | None = None
    result: SimulatedLoop | None = None
    answered: Mapping[str, int] = field(default_factory=dict)

    @property
    def effort(self) -> Effort:
        """What it took so far."""
        return {"seconds": self.seconds, "answered": self.answered}

    def design(
        self, solver: Solver | None, stored: Path | None, *, growing: bool, scaled: bool
    ) -> tuple[Spec, ProvedController]:
        with self.step("load"):
            spec = load_spec(self.path, self.parameters, outside=self.outside)
            self.spec = spec = replace(spec, objectives=replace(spec.objectives, solver=solver)) if solver else spec
        known = None if stored is None else read(stored)
        if known is not None:
            self.spec = spec = with_gains(spec, known)
        with self.step("design", "Finding gains, proofs and bounds"):
            asked = replace(spec, objectives=replace(spec.objectives, uncertain=())) if scaled else spec
            controller = pipeline.design(asked, growing=growing)
        if known is not None:
            self.runs = check_same(spec, controller, known)
        if scaled:
            with self.step("largest box", "Scaling the box of uncertain parameters"):
                self.largest = _scaled(spec, controller)
                controller = pipeline.proved_for(spec, controller)
        self.controller = controller
        return spec, controller

    def simulate(
        self, spec: Spec, controller: ProvedController, members: Mapping[str, Any] | None
    ) -> tuple[SimulatedLoop, EnsembleResult | None]:
        with self.step("simulate", "Simulating the closed loop"):
            self.result = result = pipeline.simulate(spec, controller, self.runs)
        if not members:
            return result, None
        count = members["count"]

        def show(done: int) -> None:
            if done * 100 // count > (done - 1) * 100 // count:
                self.status.update(f"Simulating the ensemble: {done:,} of {count:,} members")

        with self.step("ensemble"):
            return result, ensemble(result, **members, progress=show)

    def fronts(self, spec: Spec, controller: ProvedController) -> list[Front]:
        gains, plant, sizes = controller.design, controller.plant, controller.sizes
        said = "Finding the smallest gains at other rates"
        with self.step("pareto", said), spec.located(), asking(spec.objectives.solver):
            return [
                pareto(Task.of(plant, CONTROLLER, sizes=sizes), gains.K, gains.controller.rate),
                pareto(Task.of(plant, OBSERVER, sizes=sizes), gains.L.T, gains.observer.rate),
            ]

    @contextmanager
    def step(self, name: str, said: str = "") -> Iterator[None]:
        if said:
            self.status.update(_Going(said=said, solved=self.answered, before=sum(self.answered.values())))
        start = time.perf_counter()
        yield
        self.seconds[name] = round(time.perf_counter() - start, 4)

    def keep(self, refusal: PwatrackError, folder: Path, shown: Shown) -> None:
        """Write what came out before a refusal goes on its way, and note where. An invalid spec changes nothing."""
        spec, controller = self.spec, self.controller
        if refusal.code in (ExitCode.INVALID, ExitCode.BUG):
            if read_index(folder) is not None:
                refusal.add_note(f"  the earlier results in {folder!s} are as they were")
            return
        try:
            if spec is not None and controller is not None and refusal.code == ExitCode.CHECK_FAILED:
                run, controller = self.result, self.result.controller if self.result else controller
                found = Findings(spec=spec, controller=controller, result=run)
                files.write(found, folder, broken=refusal, effort=self.effort, warned=True)
                at = path_of((ProblemPart.SAMPLE_TIME,))
                sampled = any(problem.subject == at for problem in refusal.problems)
                unstable = f"UNSTABLE as sampled: do not run the gains in {folder!s}: proved is the ideal loop only"
                broken = f"what is proved of the gains is in {folder!s}; this run does not show that they work"
                broken = broken if run is None else f"the run itself is in {folder!s}"
                refusal.add_note(f"  {unstable if sampled else broken}")
                return
            expected = spec is not None and refusal.code == spec.expected_exit
            far, impossible = None, refusal.evidence
            if spec is not None and isinstance(impossible, Impossibility) and (shown != "nothing" or not expected):
                with self.step("how far"), asking(spec.objectives.solver), suppress(PwatrackError):
                    said = "Looking how far away it is: "
                    far = how_far(spec, impossible, lambda what: self.status.update(said + what))
            for text in () if far is None else how_far_texts(far):
                refusal.add_note(f"  how far: {text}")
            if files.write_refusal(
                refusal, folder, path=self.path, parameters=self.parameters, spec=spec, effort=self.effort, far=far
            ):
                refusal.add_note(f"  proof: {folder / REFUSAL!s}; 'pwatrack verify' checks it")
        except InvalidSpec as unwritable:
            refusal.add_note(f"  {unwritable}")


def _scaled(spec: Spec, controller: ProvedController) -> LargestBox:
    """Return the largest box that is proved, which has to hold the one of the spec."""
    with spec.located():
        if not spec.objectives.uncertain:
            raise InvalidSpec("--robust: no parameter is uncertain", subject=("design",))
        largest = largest_box(spec, controller)
        if largest.factor < 1:
            message = f"the proof for the uncertain parameters is undecided; {largest_text(largest)}"
            raise Undecided(message, subject=("design", "uncertain"), hint="give these intervals")
    return largest


def _check(came: Findings) -> None:
    """Refuse a loop, or a member of its ensemble, that grows without bound, contradicts its proof, or misses a wish."""
    found, result, many = list[Problem](), came.result, came.many
    if result is not None and result.outcome.code != ExitCode.DONE:
        growth = result.controller.trajectory.growth
        found.append(growth or Problem(message=f"{result.spec.path}: {result.outcome.text}", subject=None))
    if many is not None and many.failed:
        found.append(Problem(message=f"{many.nominal.spec.path}: {many.failure}", subject=None))
    found += [
        Problem(message=f"requirement missed: {each.text}", subject=each.requirement.subject)
        for each in came.checked
        if not each.met
    ]
    if found:
        with came.spec.located():
            raise CheckFailed(*found)
