"""Controllers in whole numbers of 32 bits: what is proved of their rounding, and what is seen beside a plant.

    python -m benchmarks.rounding                       (all of specs/, a run of 4,000 samples each at most)
    python -m benchmarks.rounding damper --steps 500    (specs whose names have one of these in them)

A spec without sample time gets one: 25 samples in a period of the fastest mode. Where its numbers have proved ranges,
the controller is worked out in whole numbers, and read in Python beside the plant of its spec, which is integrated by
Runge and Kutta, with noise as large as it is drawn and of any sign. Printed are the bound of the first signal that is
tracked in the end of the run, with real numbers, whole ones and single floats; how much of its bound from the start on
each signal had at most, and of its range each state of the observer; and how many steps differ of C, which has read the
same.
"""

import argparse
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.sampled_loop import sample_time
from pwatrack import load_spec
from pwatrack.arrays import Array
from pwatrack.commands.export import Subject, of_spec
from pwatrack.errors import PwatrackError
from pwatrack.export.c import FLAGS, write
from pwatrack.export.fixed_point import FixedPoint
from pwatrack.export.reading import Reading
from pwatrack.export.rounding import Rounding, largest, of_run
from pwatrack.export.source import Source, Vector
from pwatrack.workflow import pipeline
from tests.beside import beside

SUBSTEPS = 16  # of the integration of a sample


@dataclass(frozen=True)
class Row:
    """What is proved and seen."""

    h: float
    real: float
    whole: float
    single: float | None  # None where it is not proved
    of_bound: float
    of_range: float
    wrong: int  # steps of C


def judged(path: Path, steps: int) -> Row:
    """Return what is found of a spec. Raises PwatrackError where nothing is proved."""
    spec = load_spec(path)
    h = None
    if spec.scenario.conditions.sampling is None:
        made = pipeline.design(spec, growing=True)
        h = float(f"{sample_time(made.plant, made.K):.1g}")
    subject = of_spec(spec, h, steps=10)
    controller = subject.controller
    assert controller is not None
    assert subject.spec is not None
    code = Source(file=subject.file, name="loop", single=False, given=False, unproved=subject.unproved)
    h = code.program.sampling.sample_time
    given = np.zeros((int(subject.spec.scenario.duration / h) + 1, 0))
    found = of_run(controller, code, "int32", given)
    tracked = controller.tracking, 0
    proved = [found.ranges.bounds, found.bounds]
    with suppress(PwatrackError):
        proved.append(of_run(controller, code, "float32", given).bounds)
    ends = [bounds.ends_below(controller)[tracked] for bounds in proved]
    y, u, of_bound, of_range = ran(subject, found, min(steps, len(given) - 1))
    return Row(
        h, ends[0], ends[1], ends[2] if len(ends) > 2 else None, of_bound, of_range, differing(code, found, y, u)
    )


def ran(subject: Subject, found: Rounding, steps: int) -> tuple[Array, Array, float, float]:
    """Return y and u, and how much of bounds and ranges is seen at most, in the loop of the program and its plant."""
    controller, spec = subject.controller, subject.spec
    assert controller is not None
    assert spec is not None
    numbers = found.numbers
    assert isinstance(numbers, FixedPoint)
    bounds, plant, disturbance = found.bounds, spec.problem.plant, spec.scenario.conditions.disturbance
    gains, reading, random = bounds.errors.gains, Reading(numbers.step), np.random.default_rng(1)
    h = gains.sample_time
    run = pipeline.simulate(
        replace(spec, scenario=replace(spec.scenario, duration=h * steps, sample_time=h)), controller
    ).response
    rows, x_hat = list[tuple[Array, Array]](), list[Array]()

    def step(k: int, x: Array) -> Array:
        y = plant.C @ x + random.choice([-1, 1], size=len(bounds.noise)) * bounds.noise
        told = reading.step(numbers.counts("y", y).tolist())
        if told["status"] < 0:
            raise AssertionError(f"a number was out of range at tick {k}")
        rows.append((y, np.array(told["u"]) * numbers.units["u"]))
        x_hat.append(np.array(told["v"])[numbers.program.places["x_hat"]] * numbers.units["x_hat"])
        return rows[-1][1]

    x = beside(plant, step, run.x[0], ticks=steps, h=h, disturbance=disturbance, substeps=SUBSTEPS)
    signals = np.eye(len(plant.B)) if controller.tracking == "state" else plant.tracked
    most = bounds.from_start or bounds.from_zero
    limits = np.array([most[controller.tracking, k] for k in range(len(signals))]).T[:: gains.substeps][:steps]
    first = 0 if bounds.from_start else steps // 2 + 1  # where the start is not known, it is not in the bounds
    off = np.abs((x - run.x_d[:steps]) @ signals.T)
    ends = largest(replace(found.ranges, bounds=bounds), found.given)["x_hat"]
    of_bound = (off / np.maximum(limits, 1e-300))[first:].max()
    of_range = (np.abs(x_hat) / np.maximum(ends, 1e-300)).max()
    return np.array([y for y, _ in rows]), np.array([u for _, u in rows]), float(of_bound), float(of_range)


def differing(code: Source, found: Rounding, y: Array, u: Array) -> int:
    """Return how many steps of C differ, which has read the same."""
    assert isinstance(found.numbers, FixedPoint)
    with tempfile.TemporaryDirectory() as place:
        vector = Vector(y, np.zeros((len(y), 0)), "the loop beside its plant")
        write(replace(code, whole=found.numbers), vector, Path(place))
        command = f"cc {FLAGS} -O2 -o replay main.c loop.c && ./replay"
        done = subprocess.run(command, shell=True, cwd=place, capture_output=True, text=True, check=False)  # noqa: S602
        if "steps" not in done.stdout:
            raise AssertionError(done.stderr)
        return int(done.stdout.split()[2])


def rows(names: list[str], steps: int) -> Iterator[tuple[str, Row | str]]:
    """Yield each spec with what is found, or why nothing is."""
    for path in [*sorted(Path("specs").glob("*.yaml")), *sorted(Path("specs/gallery").glob("*.yaml"))]:
        if not names or any(name in path.stem for name in names):
            try:
                yield path.stem, judged(path, steps)
            except PwatrackError as error:
                yield path.stem, str(error).splitlines()[0]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--steps", type=int, default=4000)
    asked = parser.parse_args()
    console = Console(width=150)
    table = Table("spec", "h (s)", "real", "int32", "float32", "of bound", "of range", "C differs")
    for name, row in rows(asked.names, asked.steps):
        if isinstance(row, str):
            console.print(f"{name}: {row}")
            continue
        single = "-" if row.single is None else f"{row.single:.3g}"
        cells = [f"{v:.3g}" for v in (row.h, row.real, row.whole)]
        table.add_row(name, *cells, single, f"{row.of_bound:.2f}", f"{row.of_range:.2f}", str(row.wrong))
        console.print(f"{name}: {row}")
    console.print(table)


if __name__ == "__main__":
    main()
