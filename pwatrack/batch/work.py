"""What a batch does with one spec, in whatever process: design, simulate, write; nothing is printed."""

import contextlib
import io
from collections.abc import Iterator

from pwatrack.batch.job import Ended, Job, JobFault
from pwatrack.errors import ExitCode, PwatrackError
from pwatrack.report.codes import code_of
from pwatrack.report.run_folder import read_index, stamp
from pwatrack.report.terminal import told


def simulate(job: Job) -> Ended:
    """Design and simulate a spec and write its run folder."""
    from pwatrack.commands.run import run
    from pwatrack.spec.load import expected_exit

    said = io.StringIO()
    faults: tuple[JobFault, ...] = ()
    code, lines = int(ExitCode.DONE), list[str]()
    before = stamp(job.out)
    with contextlib.redirect_stderr(said):
        try:
            run(
                job.spec,
                job.out,
                job.parameters,
                None,
                simulated=True,
                plots=job.plots,
                shown="nothing",
                outside=job.outside,
            )
        except MemoryError:
            raise
        except Exception as error:
            code, lines, faults = refused(error)
    index = (read_index(job.out) if stamp(job.out) != before else None) or {}
    return Ended(
        exit=int(code),
        expected=expected_exit(job.spec),
        messages="\n".join([*said.getvalue().splitlines(), *lines]),
        faults=faults,
        index=index if index.get("exit") == code else {},
    )


def refused(error: Exception) -> tuple[int, list[str], tuple[JobFault, ...]]:
    """Return how a run ends with an exception: its exit code, what the command line says, and what is wrong."""
    code, lines = told(error)
    return int(code), lines, tuple(_faults(error)) if isinstance(error, PwatrackError) else ()


def _faults(refusal: PwatrackError) -> Iterator[JobFault]:
    for problem in refusal.problems:
        code = code_of(problem.message, refusal.code)
        yield JobFault(message=problem.message, code=code, hint=problem.hint, place=problem.place)
