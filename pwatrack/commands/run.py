"""One run of one spec as the command line does it: progress, files, summary."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.status import Status

from pwatrack.control.controller import ProvedController
from pwatrack.control.pareto import Front, pareto
from pwatrack.control.program import SampledController
from pwatrack.control.task import Task
from pwatrack.errors import CheckFailed, ExitCode, InvalidSpec, Problem, PwatrackError, Undecided
from pwatrack.export.stored import check_same, read, with_gains
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER, Solver
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.lmi.solve import answers, asking
from pwatrack.report import files, summary
from pwatrack.report.files import Effort
from pwatrack.report.first_rows import first_rows
from pwatrack.report.parameters import how_far_texts, largest_text
from pwatrack.report.required import Checked, required
from pwatrack.report.run_folder import INDEX, REFUSAL, Plots, read_index
from pwatrack.report.screen import print_screen, screen
from pwatrack.report.terminal import compiling, console
from pwatrack.spec.load import assignments, load_spec
from pwatrack.spec.spec import Spec
from pwatrack.workflow import pipeline
from pwatrack.workflow.cautions import Assessment, assessed
from pwatrack.workflow.how_far import HowFar, LargestBox, how_far, largest_box
from pwatrack.workflow.result import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult, ensemble

Shown = Literal["summary", "more", "json", "nothing"]


def run(
    path: Path,
    folder: Path,
    parameters: Sequence[str],
    solver: Solver | None,
    *,
    simulated: bool,
    fronts: bool = False,
    scaled: bool = False,
    stored: Path | None = None,
    members: Mapping[str, Any] | None = None,
    plots: Plots = "all",
    drawing: Executor | None = None,
    shown: Shown = "summary",
    outside: bool = False,
) -> None:
    """Design, simulate if asked, write the files, and print what came out.

    Args:
        path, folder, parameters: The spec file, where the files go, and replacements as NAME=VALUE.
        solver: Which interior-point solver to ask, instead of the one in the spec.
        simulated: Whether to simulate.
        fronts, scaled: Whether to find what other rates would cost, how far a box can be scaled; without a simulation.
        stored, members: A controller.json that is simulated instead of a new one, and what `ensemble` of it takes.
        plots, drawing: Whether pictures are drawn, or only if the run does not end as its spec expects; who else draws.
        shown: What is printed on stdout: the summary, also how long each step took, run.json instead, or nothing.
        outside: Whether the spec may refer to files outside of its folder.

    Raises:
        PwatrackError: Whatever loading, design, simulation or writing refuses; a refusal of the theory is written too.
        CheckFailed: After all is written and printed, if the loop or a member of its ensemble fails: see `_check`.
    """
    made, many = _Made(path=path, parameters=assignments(parameters), outside=outside, stored=stored), None
    progress, meant = console(stderr=True), shown in ("summary", "more")
    with answers() as made.answered, progress.status("Reading the spec") as status, compiling(progress, meant=meant):
        try:
            spec, controller = made.design(status, solver, growing=simulated, scaled=scaled)
            result = made.simulated(spec, controller, status) if simulated else None
            if result is not None and members:
                with made.timed("ensemble"):
                    many = ensemble(result, **members, progress=_shown(status, members["count"]))
            found = made.fronts(spec, controller, status) if fronts and not simulated else []
            checked, assessment = required(spec, controller, result, many), assessed(spec, controller)
        except PwatrackError as refusal:
            made.keep(refusal, folder, status, shown)
            raise
        status.update("Writing the files")
        long = partial(_print_all, made, result, many, checked, assessment)
        came: dict[str, Any] = {"checked": checked, "result": result, "many": many, "largest": made.largest}
        first = list(first_rows(spec, controller, assessment, **came))
        kept: Any = {"assessment": assessment, "effort": made.effort, "summary": summary.written(long)}
        if result is not None:
            files.write_result(result, folder, many=many, first=first, plots=plots, executor=drawing, **kept)
        else:
            files.write_design(spec, controller, folder, fronts=found, largest=made.largest, **kept)
    if shown == "summary":
        print_screen(console(), screen(spec.name, first, folder))
    else:
        made.tell(folder, long, shown)
    _check(spec, result, many, checked)


@dataclass(kw_only=True)
class _Made:
    """What a run has made so far, and how long each step took in s: what is left where the next step is refused."""

    path: Path
    parameters: dict[str, str]
    outside: bool
    seconds: dict[str, float] = field(default_factory=dict)
    stored: Path | None = None
    spec: Spec | None = None
    controller: ProvedController | None = None
    runs: SampledController | None = None
    largest: LargestBox | None = None
    answered: Mapping[str, int] = field(default_factory=dict)

    @property
    def effort(self) -> Effort:
        """What it took so far."""
        return {"seconds": self.seconds, "answered": self.answered}

    def design(
        self, status: Status, solver: Solver | None, *, growing: bool, scaled: bool
    ) -> tuple[Spec, ProvedController]:
        with self.timed("load"):
            spec = load_spec(self.path, self.parameters, outside=self.outside)
            self.spec = spec = replace(spec, objectives=replace(spec.objectives, solver=solver)) if solver else spec
        known = None if self.stored is None else read(self.stored)
        if known is not None:
            self.spec = spec = with_gains(spec, known)
        status.update("Solving the matrix inequalities")
        with self.timed("design"):
            asked = replace(spec, objectives=replace(spec.objectives, uncertain=())) if scaled else spec
            controller = pipeline.design(asked, growing=growing)
        if known is not None:
            self.spec, self.runs = spec, _ = check_same(spec, controller, known)
        if scaled:
            status.update("Scaling the box of uncertain parameters")
            with self.timed("largest box"):
                self.largest, controller = self._scaled(spec, controller)
        self.controller = controller
        return spec, controller

    def simulated(self, spec: Spec, controller: ProvedController, status: Status) -> SimulatedLoop:
        status.update("Simulating the closed loop")
        with self.timed("simulate"):
            return pipeline.simulate(spec, controller, self.runs)

    def fronts(self, spec: Spec, controller: ProvedController, status: Status) -> list[Front]:
        status.update("Finding the smallest gains at other rates")
        with self.timed("pareto"):
            return _fronts(spec, controller)

    def _scaled(self, spec: Spec, controller: ProvedController) -> tuple[LargestBox, ProvedController]:
        """Return the largest box, and the design with the proof for the one of the spec."""
        box, subject = spec.objectives.uncertain, ("design", "uncertain")
        with spec.located():
            if not box:
                raise InvalidSpec("--robust: no parameter is uncertain", subject=("design",))
            largest = largest_box(spec, controller)
            if largest.factor < 1:
                message = f"the proof for the uncertain parameters is undecided; {largest_text(largest)}"
                raise Undecided(message, subject=subject, hint="give these intervals")
        return largest, pipeline.proved_for(spec, controller)

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[step] = round(time.perf_counter() - start, 4)

    def tell(self, folder: Path, long: Callable[[Console], None], shown: Shown) -> None:
        """Print run.json, or all that came out with where it is and how long it took; or nothing."""
        if shown == "json":
            sys.stdout.write((folder / INDEX).read_text(encoding="utf-8"))
        elif shown == "more":
            long(console())
            summary.print_files(console(), folder)
            console().print(", ".join(f"{step} {seconds:.2f} s" for step, seconds in self.seconds.items()))

    def keep(self, refusal: PwatrackError, folder: Path, status: Status, shown: Shown) -> None:
        """Write what came out before a refusal goes on its way, and note where. An invalid spec changes nothing."""
        spec, controller = self.spec, self.controller
        if refusal.code in (ExitCode.INVALID, ExitCode.BUG):
            if read_index(folder) is not None:
                refusal.add_note(f"  the earlier results in {folder!s} are as they were")
            return
        try:
            if spec is not None and controller is not None and refusal.code == ExitCode.CHECK_FAILED:
                kept: dict[str, Any] = {"assessment": assessed(spec, controller), "effort": self.effort}
                files.write_design(spec, controller, folder, broken=refusal, **kept)
                refusal.add_note(
                    f"  UNSTABLE as sampled: do not run the gains in {folder!s}: proved is the ideal loop only"
                )
                return
            expected = spec is not None and refusal.code == spec.expected_exit
            found = self._how_far(refusal, status) if shown != "nothing" or not expected else None
            for text in () if found is None else how_far_texts(found):
                refusal.add_note(f"  how far: {text}")
            if files.write_refusal(
                refusal, folder, path=self.path, parameters=self.parameters, spec=spec, effort=self.effort, far=found
            ):
                refusal.add_note(f"  proof: {folder / REFUSAL!s}; 'pwatrack verify' checks it")
        except InvalidSpec as unwritable:
            refusal.add_note(f"  {unwritable}")

    def _how_far(self, refusal: PwatrackError, status: Status) -> HowFar | None:
        """Return how far away an inequality is that is proved to have no solution, where that can be looked for."""
        if self.spec is None or not isinstance(refusal.evidence, Impossibility):
            return None
        with self.timed("how far"), asking(self.spec.objectives.solver), suppress(PwatrackError):
            said = "Looking how far away it is: "
            return how_far(self.spec, refusal.evidence, lambda what: status.update(said + what))
        return None


def _print_all(
    made: _Made,
    result: SimulatedLoop | None,
    many: EnsembleResult | None,
    checked: Sequence[Checked],
    assessment: Assessment,
    printed: Console,
) -> None:
    """Print all that came out."""
    assert made.spec is not None
    assert made.controller is not None
    if result is not None:
        summary.print_result(printed, result, checked, assessment)
    else:
        summary.print_design(printed, made.spec, made.controller, checked, made.largest, assessment)
    if many:
        summary.print_ensemble(printed, many)


def _check(spec: Spec, result: SimulatedLoop | None, many: EnsembleResult | None, checked: Sequence[Checked]) -> None:
    """Refuse a loop, or a member of its ensemble, that grows without bound, contradicts its proof, or misses a wish."""
    found: list[Problem] = []
    if result is not None and result.outcome.code != ExitCode.DONE:
        growth = result.controller.trajectory.growth
        found.append(growth or Problem(message=f"{result.spec.path}: {result.outcome.text}", subject=None))
    if many is not None and many.failed:
        found.append(Problem(message=f"{many.nominal.spec.path}: {many.failure}", subject=None))
    found += [
        Problem(message=f"requirement missed: {each.text}", subject=each.requirement.subject)
        for each in checked
        if not each.met
    ]
    if found:
        with spec.located():
            raise CheckFailed(*found)


def _shown(status: Status, members: int) -> Callable[[int], object]:
    def show(done: int) -> None:
        if done * 100 // members > (done - 1) * 100 // members:
            status.update(f"Simulating the ensemble: {done:,} of {members:,} members")

    return show


def _fronts(spec: Spec, controller: ProvedController) -> list[Front]:
    gains, plant, sizes = controller.design, controller.plant, controller.sizes
    with spec.located(), asking(spec.objectives.solver):
        return [
            pareto(Task.of(plant, CONTROLLER, sizes=sizes), gains.K, gains.controller.rate),
            pareto(Task.of(plant, OBSERVER, sizes=sizes), gains.L.T, gains.observer.rate),
        ]
