"""One run of one spec as the command line does it: progress, files, summary."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from rich.status import Status

from pwatrack import pipeline
from pwatrack.control.controller import Controller
from pwatrack.control.pareto import Front, pareto
from pwatrack.control.task import Task
from pwatrack.errors import CheckFailed, ExitCode, InvalidSpec, Problem, PwatrackError
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.role import CONTROLLER, OBSERVER
from pwatrack.pipeline import Result
from pwatrack.report import files, summary
from pwatrack.report.run_folder import REFUSAL, read_index
from pwatrack.report.terminal import console
from pwatrack.spec.load import assignments, load_spec
from pwatrack.spec.spec import Spec
from pwatrack.variation import EnsembleResult, Over, ensemble


def run(
    path: Path,
    folder: Path,
    parameters: Sequence[str],
    solver: Solver | None,
    *,
    simulated: bool,
    fronts: bool = False,
    members: int | None = None,
    over: Over = "initial",
    seed: int = 1,
) -> None:
    """Design, simulate if asked, write the files, and print what came out.

    Args:
        path: The spec file.
        folder: Where the files go.
        parameters: Replacements as NAME=VALUE.
        solver: Which interior-point solver to ask, instead of the one in the spec.
        simulated: Whether to simulate.
        fronts: Whether to find what other rates would cost; only without a simulation.
        members, over, seed: As for `ensemble`; None for no ensemble; only with a simulation.

    Raises:
        PwatrackError: Whatever loading, design, simulation or writing refuses; a refusal of the theory is written too.
        CheckFailed: After all is written and printed, if the loop or a member of its ensemble grows without bound or
            contradicts its proof.
    """
    screen, seconds = console(), dict[str, float]()
    spec, controller, many = None, None, None
    with console(stderr=True).status("Reading the spec") as status:
        try:
            with _timed(seconds, "load"):
                spec = load_spec(path, assignments(parameters))
                spec = replace(spec, objectives=replace(spec.objectives, solver=solver)) if solver else spec
            status.update("Solving the matrix inequalities")
            with _timed(seconds, "design"):
                controller = pipeline.design(spec, growing=simulated)
            if simulated:
                status.update("Simulating the closed loop")
                with _timed(seconds, "simulate"):
                    result = pipeline.simulate(spec, controller)
                if members:
                    with _timed(seconds, "ensemble"):
                        many = ensemble(result, members, over=over, seed=seed, progress=_shown(status, members))
            else:
                status.update("Finding the smallest gains at other rates")
                with _timed(seconds, "pareto"):
                    found = _fronts(spec, controller) if fronts else []
        except PwatrackError as refusal:
            _keep(refusal, folder, path, assignments(parameters), spec, controller, seconds)
            raise
        status.update("Writing the files")
        if simulated:
            files.write_result(result, folder, many=many, seconds=seconds)
        else:
            files.write_design(spec, controller, folder, fronts=found, seconds=seconds)
    if simulated:
        summary.print_result(screen, result)
    else:
        summary.print_design(screen, spec, controller)
    if many:
        summary.print_ensemble(screen, many)
    summary.print_files(screen, folder)
    with spec.located():
        _check(result if simulated else None, many)


def _check(result: Result | None, many: EnsembleResult | None) -> None:
    """Refuse a loop, or a member of its ensemble, that grows without bound or contradicts its proof."""
    found: list[Problem] = []
    if result is not None and result.outcome.code != ExitCode.DONE:
        growth = result.controller.trajectory.growth
        found.append(growth or Problem(message=f"{result.spec.path}: {result.outcome.text}", subject=None))
    if many is not None and many.failed:
        found.append(Problem(message=f"{many.nominal.spec.path}: {many.failure}", subject=None))
    if found:
        raise CheckFailed(*found)


def _keep(
    refusal: PwatrackError,
    folder: Path,
    path: Path,
    parameters: dict[str, str],
    spec: Spec | None,
    controller: Controller | None,
    seconds: dict[str, float],
) -> None:
    """Write what came out before a refusal goes on its way, and note where. An invalid spec changes nothing."""
    if refusal.code in (ExitCode.INVALID, ExitCode.BUG):
        if read_index(folder) is not None:
            refusal.add_note(f"  the earlier results in {folder!s} are as they were")
        return
    try:
        if spec is not None and controller is not None and refusal.code == ExitCode.CHECK_FAILED:
            files.write_design(spec, controller, folder, broken=refusal, seconds=seconds)
            refusal.add_note(f"  the design is proved all the same: {folder!s}")
        elif files.write_refusal(refusal, folder, path=path, parameters=parameters, spec=spec, seconds=seconds):
            refusal.add_note(f"  proof: {folder / REFUSAL!s}; 'pwatrack verify' checks it")
    except InvalidSpec as unwritable:
        refusal.add_note(f"  {unwritable}")


def _shown(status: Status, members: int) -> Callable[[int], object]:
    """Return what shows the progress of an ensemble, in whole percents."""

    def show(done: int) -> None:
        if done * 100 // members > (done - 1) * 100 // members:
            status.update(f"Simulating the ensemble: {done:,} of {members:,} members")

    return show


def _fronts(spec: Spec, controller: Controller) -> list[Front]:
    gains = controller.design
    return [
        pareto(Task.of(spec.problem.plant, CONTROLLER, spec.objectives.solver), gains.K, gains.controller.rate),
        pareto(Task.of(spec.problem.plant, OBSERVER, spec.objectives.solver), gains.L.T, gains.observer.rate),
    ]


@contextmanager
def _timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[step] = round(time.perf_counter() - start, 4)
