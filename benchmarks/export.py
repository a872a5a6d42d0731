"""Exported C against the stored controller, and both against the simulation: every spec that designs, random designs.

    make export                                                    (all of specs/ and 50 random ones, 100,000 steps)
    python -m benchmarks.export backlash tanks --random 0          (specs whose names have one of these in them)
    python -m benchmarks.export --after two_mass_machine           (what comes behind that one)
    python -m benchmarks.export machine --random 0 --fmu --steps 1000000
    python -m benchmarks.export machine --random 0 --odd           (NaN, ±Inf, denormals, −0 among what is measured)

Each is simulated for so many samples of its controller, or until its reference ends; then what was measured begins
again. The stored controller reads that in Python, in double and in single floats, and so does C: compiled with all
warnings as errors at -O0, -O2 and -O3 and with sanitizers, by each compiler that is here, and as FMUs if that is asked
for. Counted is each bit of the inputs and of the state in which one differs from the other at any step. cppcheck,
where it is installed, may find no other deviation from MISRA C:2012 than docs/misra.md lists.

A line is printed as each is done; in the end, or when it is cut by Ctrl-C, a table of all of them.
"""

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.fuzz import spec_text
from pwatrack import load_spec
from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController as Designed
from pwatrack.errors import PwatrackError
from pwatrack.export.c import FLAGS, write
from pwatrack.export.controller import Controller
from pwatrack.export.fmu import c_compiler, packed, write_fmu
from pwatrack.export.fmu_models import controller_model
from pwatrack.export.schema import ControllerFile
from pwatrack.export.source import Source, Vector
from pwatrack.export.stored import parsed
from pwatrack.model.conditions import Sampling
from pwatrack.report.controller import has_tables, starts, written
from pwatrack.simulation.sampled_runs import SampleMaps
from pwatrack.spec.spec import Spec
from pwatrack.workflow import pipeline
from tests.fmus import Block
from tests.misra import checked, listed

LEVELS = ("-O0", "-O2", "-O3", "-O1 -fsanitize=address,undefined -fno-sanitize-recover=all")
MEMORY = ("y", "u", "x_hat", "s_hat", "eta_hat", "w")
ODD = (np.nan, -np.nan, np.inf, -np.inf, 5e-324, -5e-324, 1e-310, -0.0, 1.7e308, -1.7e308)  # that no sensor gives
SHORT = 20  # steps of the vector that goes with the code

ALL_STEPS = """
#include "loop.h"
#include <stddef.h>
#include <stdio.h>

/* Read what is measured, step by step, and write u, the numbers of the state and the status. */
int main(void)
{
    static loop_state state;
    loop_real y[LOOP_OUTPUTS], u[LOOP_INPUTS], status;

    (void)loop_init(&state);
    while (fread(y, sizeof y, 1, stdin) == 1) {
        status = (loop_real)loop_step(&state, y, NULL, u);
        (void)fwrite(u, sizeof u, 1, stdout);
        (void)fwrite(state.v, sizeof state.v, 1, stdout);
        (void)fwrite(state.wanted, sizeof state.wanted, 1, stdout);
        (void)fwrite(state.x_d, sizeof state.x_d, 1, stdout);
        (void)fwrite(&status, sizeof status, 1, stdout);
    }
    return 0;
}
"""


@dataclass(frozen=True)
class Subject:
    """A sampled controller, what it measures, (steps, q), and u, x̂, ŝ, η̂ of its simulation, as far as that went."""

    file: ControllerFile
    y: Array
    simulated: Array


@dataclass
class Row:
    """What is found of a controller.

    Attributes:
        name: Of its spec.
        size: q, m, n, cells.
        bits: How many differ, by what is compared; None if that is not done.
        faults: What does not compile, stops, or breaks a rule.
        held: Steps that were refused since a number was not finite.
        simulated: Steps of the simulation.
        seconds: It took.
    """

    name: str
    size: str = ""
    bits: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    held: int = 0
    simulated: int = 0
    seconds: float = 0.0


def differing(one: Any, other: Any) -> int:
    """Return in how many bits two arrays differ."""
    assert (one.dtype, one.shape) == (other.dtype, other.shape)
    unequal = np.frombuffer(one.tobytes(), np.uint8) ^ np.frombuffer(other.tobytes(), np.uint8)
    return int(np.unpackbits(unequal[unequal != 0]).sum())


def subject(spec: Spec, steps: int) -> Subject:
    """Design what a spec asks for and simulate it; where it has no sample time, at a short one.

    That is a twentieth of the longest that is stable in all cells.
    """
    made = pipeline.design(spec, growing=True)
    if not has_tables(made):
        raise PwatrackError("it has too many cells for tables")
    conditions = spec.scenario.conditions
    sampling = conditions.sampling or Sampling(sample_time=short_enough(made))
    h, end = sampling.sample_time, made.trajectory.exosystem.end
    last = steps * h if end is None else min(steps * h, end)
    conditions = replace(conditions, sampling=sampling)
    spec = replace(spec, scenario=replace(spec.scenario, conditions=conditions, duration=float(last), sample_time=h))
    result = pipeline.simulate(spec, made)
    file, at = parsed(written(spec, made, starts(result.loop, result.start)).controller, spec.path), result.loop.at
    blocks = [block.trace.z for block in result.blocks()]
    y = np.concatenate([z[:, at.y] for z in blocks])
    parts = (at.u, at.x_hat, at.s_hat, at.eta_hat)
    simulated = np.concatenate([np.hstack([z[:, part] for part in parts]) for z in blocks])[:steps]
    return Subject(file, np.resize(y, (steps, y.shape[1])), simulated)


def short_enough(made: Designed) -> float:
    """Return a twentieth of the longest sample time that is stable in all cells."""
    longest = SampleMaps(made, made.plant, Sampling(sample_time=1.0)).longest(1.0)
    return float(f"{(longest or 1e-3) / 20:.2g}")


def python_steps(controller: Controller, y: Any) -> Any:
    """Return u, the numbers of the state and the status after each step."""
    found = None
    for k, measured in enumerate(y):
        controller.step(measured)
        row = [controller.state(name) for name in ("u", *MEMORY, "wanted", "x_d")]
        row.append(np.array([controller.status], dtype=y.dtype))
        if found is None:
            found = np.zeros((len(y), sum(map(len, row))), dtype=y.dtype)
        np.concatenate(row, out=found[k])
    return found


def c_bits(code: Source, subject: Subject, expected: Any, row: Row) -> int:
    """Return in how many bits C differs, compiled in all ways; what else is wrong goes to the row."""
    y, bits = subject.y.astype(code.real), 0
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write(code, Vector(subject.y[:SHORT], np.zeros((SHORT, 0)), "its simulation"), folder)
        (folder / "all_steps.c").write_text(ALL_STEPS, encoding="utf-8")
        if shutil.which("cppcheck") and not code.single:
            said = checked(folder)
            row.faults += [f"MISRA {rule}" for rule in sorted(said.broken - listed())] + [*said.others]
        for compiler in (name for name in ("gcc", "clang") if shutil.which(name)):
            for level in LEVELS:
                ran = built(folder, compiler, level, "all_steps.c", y.tobytes())
                if isinstance(ran, str):
                    row.faults.append(ran)
                    continue
                bits += differing(np.frombuffer(ran, dtype=y.dtype).reshape(-1, expected.shape[1]), expected)
            ran = built(folder, compiler, "-O2", "main.c", b"")
            row.faults += [ran] if isinstance(ran, str) else []
    return bits


def built(folder: Path, compiler: str, level: str, main: str, read: bytes) -> bytes | str:
    """Return what a program writes, or what is wrong with it; a warning is an error."""
    command = [compiler, *FLAGS.split(), *level.split(), "-o", "program", main, "loop.c"]
    made = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if made.returncode:
        return f"{compiler} {level}: {made.stderr.splitlines()[0]}"
    ran = subprocess.run([folder / "program"], cwd=folder, input=read, capture_output=True, check=False)
    return f"{compiler} {level}: {main} ends with {ran.returncode}" if ran.returncode else ran.stdout


def fmu_bits(code: Source, subject: Subject, expected: Any) -> int:
    """Return in how many bits of u, x̂, ŝ, η̂ and x_d the FMUs of both versions differ."""
    of, h, bits = code.program.sizes, code.program.sampling.sample_time, 0
    m, n, first = of["m"], of["n"], of["m"] + of["q"] + of["m"]
    wanted = [expected[:, :m], expected[:, first : first + of["N"] + of["p"]], expected[:, -1 - n : -1]]
    known = np.hstack(wanted)
    with tempfile.TemporaryDirectory() as place:
        for version in (2, 3):
            path = Path(place) / f"fmi{version}.fmu"
            parts = controller_model(code, h * len(subject.y), {})
            write_fmu(packed(parts, 2 if version == 2 else 3, c_compiler()), path)
            block = Block(path, Path(place))
            inputs, names = block.named("", "input"), list(subject.file.plant.inputs)
            names += [*block.named("estimate."), *block.named("generator."), *block.named("desired.")]
            found = np.zeros_like(known)
            for k, measured in enumerate(subject.y):
                block.set(inputs, measured)
                block.step(k * h, h)
                found[k] = block.get(names)
            block.close()
            bits += differing(found, known)
    return bits


def with_odd(y: Array) -> Array:
    """Return what is measured, (steps, q), with one entry in twenty that no sensor should give."""
    random, found = np.random.default_rng(25), y.copy()
    chosen = random.random(y.shape) < 0.05
    chosen[:SHORT] = False  # they are written into a file of their own
    found[chosen] = random.choice(ODD, int(chosen.sum()))
    return found


def judged(name: str, spec: Spec, steps: int, fmu: bool, odd: bool) -> Row:
    """Return what is found of a spec; where odd numbers are measured it is not its simulation that is compared."""
    started, of = time.perf_counter(), subject(spec, steps)
    of = replace(of, y=with_odd(of.y), simulated=of.simulated[:0]) if odd else of
    row = Row(name, simulated=len(of.simulated))
    for single in (False, True):
        code = Source(file=of.file, name="loop", single=single, given=False, unproved=tuple(of.file.open))
        expected = python_steps(Controller(of.file, single=single), of.y.astype(code.real))
        row.held += int((expected[:, -1] < 0).sum())
        row.bits["float" if single else "double"] = c_bits(code, of, expected, row)
        if single:
            continue
        sizes, count = code.program.sizes, len(of.simulated)
        row.size = " ".join(str(size) for size in (*(sizes[key] for key in "qmn"), len(code.program.signs)))
        first = sizes["m"] + sizes["q"] + sizes["m"]
        both = np.hstack([expected[:, : sizes["m"]], expected[:, first : first + sizes["N"] + sizes["p"]]])
        row.bits["simulation"] = differing(both[:count], of.simulated)
        if fmu:
            row.bits["fmu"] = fmu_bits(code, of, expected)
    row.seconds = time.perf_counter() - started
    return row


def specs(home: Path, random: int, names: Sequence[str], after: str | None) -> list[Path]:
    """Return each spec in specs/, and four times as many random ones as are asked for: not all of these design."""
    table = "".join(f"{0.01 * k},{0.1 * np.sin(0.02 * k)}\n" for k in range(6001))
    (home / "wanted.csv").write_text("t,y\n" + table, encoding="utf-8")
    paths = [*sorted(Path("specs").glob("*.yaml")), *sorted(Path("specs/gallery").glob("*.yaml"))]
    paths = [path for path in paths if not names or any(name in path.stem for name in names)]
    for seed in range(4 * random):
        paths.append(home / f"random_{seed}.yaml")
        paths[-1].write_text(spec_text(seed), encoding="utf-8")
    known = [path.stem for path in paths]
    return paths[known.index(after) + 1 :] if after else paths


def tried(path: Path, steps: int, fmu: bool, odd: bool) -> Row | str:
    """Return what is found of a spec, or why it has no controller."""
    try:
        with warnings.catch_warnings(action="ignore"):
            return judged(path.stem, load_spec(path), steps, fmu, odd)
    except PwatrackError as refusal:
        return f"{path.stem}: {refusal.problems[0].message.splitlines()[0]}"
    except Exception as error:  # one that crashes is one row
        return Row(path.stem, faults=[f"{type(error).__name__}: {error}"])


def all_rows(asked: argparse.Namespace, console: Console, rows: list[Row], left_out: list[str]) -> None:
    """Judge all that is asked for, and print each."""
    with tempfile.TemporaryDirectory() as home, ProcessPoolExecutor(asked.jobs, initializer=deaf) as pool:
        paths = specs(Path(home), asked.random, asked.names, asked.after)
        found = [pool.submit(tried, path, asked.steps, asked.fmu, asked.odd) for path in paths]
        try:
            for one in found:
                row = one.result()
                if isinstance(row, str):
                    left_out.append(row)
                    console.print(f"{row.partition(':')[0]:40} left out", highlight=False)
                    continue
                rows.append(row)
                verdict = "; ".join(row.faults) or f"{sum(row.bits.values())} bits differ"
                console.print(f"{row.name:40} {verdict}, {row.seconds:.0f} s", highlight=False)
                if sum(row.name.startswith("random_") for row in rows) == asked.random > 0:
                    break
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def deaf() -> None:
    """Leave it to the first process to end the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def main(asked: argparse.Namespace) -> int:
    """Judge all that is asked for, print a table, and return 1 if a bit differs."""
    console, rows, left_out, started = Console(width=120), list[Row](), list[str](), time.perf_counter()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    cut = ""
    try:
        all_rows(asked, console, rows, left_out)
    except KeyboardInterrupt:
        cut = f"CUT behind {rows[-1].name}: --after goes on from there. " if rows else "CUT. "
    kinds = ["double", "float", "simulation", *(["fmu"] if asked.fmu else [])]
    table = Table("spec", "q m n cells", "simulated", "held", *kinds, "other faults", "s", box=None)
    for row in rows:
        found = [str(row.bits.get(kind, "-")) for kind in kinds]
        faults = "; ".join(row.faults) or "none"
        table.add_row(row.name, row.size, str(row.simulated), str(row.held), *found, faults, f"{row.seconds:.0f}")
    console.print(
        f"\nBits that differ in u and the state over {asked.steps:,} steps:", table, sep="\n", highlight=False
    )
    if left_out:
        console.print("Left out, since there is no controller:", *left_out, sep="\n  ", highlight=False)
    random = sum(row.name.startswith("random_") for row in rows)
    different, faulty = sum(sum(row.bits.values()) for row in rows), sum(len(row.faults) for row in rows)
    took = time.perf_counter() - started
    console.print(
        f"{cut}{len(rows) - random} specs and {random} random ones, {asked.steps:,} steps of each:"
        f" {different} bits different, {faulty} other faults; {took:.0f} s",
        highlight=False,
    )
    return int(different + faulty > 0 or not rows)


def arguments() -> argparse.Namespace:
    """Return what is asked for."""
    parser = argparse.ArgumentParser(description="Compare exported code with the stored controller, bit by bit.")
    parser.add_argument("names", nargs="*", help="parts of the names of specs; all if there is none")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--random", type=int, default=50, help="how many random designs")
    parser.add_argument("--after", help="begin behind this spec")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time")
    parser.add_argument("--fmu", action="store_true", help="run FMUs, too: some 50 microseconds a step")
    parser.add_argument("--odd", action="store_true", help="NaN, ±Inf, denormals, −0 and the like are measured")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main(arguments()))
