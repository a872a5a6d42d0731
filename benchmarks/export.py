"""Exported C against the stored controller, and both against the simulation: every spec that designs, random designs.

    make export [STEPS=100000] [RANDOM=50]

Each is compiled with all warnings as errors at -O0, -O2 and -O3 and with sanitizers, in double and single floats, and
fed with what was measured in its simulation, over and over again. cppcheck, where it is installed, may find no other
deviation from MISRA C:2012 than docs/misra.md lists.
"""

import ctypes
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz import spec_text
from pwatrack import load_spec
from pwatrack.errors import PwatrackError
from pwatrack.export.c_project import FLAGS, write_c
from pwatrack.export.c_source import CSource
from pwatrack.export.controller import Controller
from pwatrack.export.source import Vector
from pwatrack.model.conditions import Sampling
from pwatrack.pipeline import design
from pwatrack.report.export import Subject, of_spec
from pwatrack.simulation.sample_map import SampleMaps
from pwatrack.spec.spec import Spec
from tests.misra import checked, listed

LEVELS = ("-O0", "-O2", "-O3")
SANE = "-O1 -fsanitize=address,undefined -fno-sanitize-recover=all"


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


ALL_STEPS = """
#include "loop.h"
#include <string.h>

void all_steps(const loop_real *y, long steps, loop_real *u, loop_real *v, int width);

/* Run from the start and write u and the numbers of the state after each step. */
void all_steps(const loop_real *y, long steps, loop_real *u, loop_real *v, int width)
{
    loop_state state;
    long k;
    (void)loop_init(&state);
    for (k = 0; k < steps; k++) {
        (void)loop_step(&state, &y[k * LOOP_OUTPUTS], NULL, &u[k * LOOP_INPUTS]);
        memcpy(&v[k * width], state.v, sizeof(loop_real) * (unsigned long)width);
    }
}
"""


def compiled(folder: Path, compiler: str, options: str, *, shared: bool) -> Path:
    """Compile the controller as a library, or the replay of its vector as a program; any warning is an error."""
    target = folder / (f"loop_{compiler}.so" if shared else "replay")
    sources = ["loop.c", "all_steps.c"] if shared else ["main.c", "loop.c"]
    kind = ["-shared", "-fPIC"] if shared else []
    command = [compiler, *FLAGS.split(), *options.split(), *kind, "-o", target.name, *sources, "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    return target


def python_steps(controller: Controller, y: Any) -> tuple[Any, Any]:
    """Return u and the numbers of the state after each step."""
    inputs, states = [], []
    for measured in y:
        inputs.append(controller.step(measured))
        states.append(np.concatenate([controller.state(name) for name in (*PARTS, "w")]))
    return np.array(inputs), np.array(states)


def differing(library: Path, y: Any, expected: tuple[Any, Any]) -> int:
    """Return in how many steps an input or the state differs in some bit."""
    found = tuple(np.zeros_like(values) for values in expected)
    pointers = [values.ctypes.data_as(ctypes.c_void_p) for values in (y, *found)]
    run = ctypes.CDLL(str(library)).all_steps
    run(pointers[0], ctypes.c_long(len(y)), *pointers[1:], found[1].shape[1])
    whole = f"u{y.dtype.itemsize}"
    differ = [(one.view(whole) != other.view(whole)).any(axis=1) for one, other in zip(found, expected, strict=True)]
    return int((differ[0] | differ[1]).sum())


PARTS = ("y", "u", "x_hat", "s_hat", "eta_hat")


def short_enough(spec: Spec) -> float:
    """A sample time for a spec that has none: a twentieth of the longest that is stable in all cells."""
    controller = design(spec, growing=True)
    sampling = Sampling(sample_time=1.0)
    longest = SampleMaps(controller, controller.plant, sampling).longest(1.0)
    return float(f"{(longest or 1e-3) / 20:.2g}")


def judged(name: str, subject: Subject, compilers: list[str], steps: int) -> int:
    """Print and return how many steps differ, in all ways to compile."""
    wrong, count = 0, 0
    repeated = np.resize(subject.vector.y, (steps, subject.vector.y.shape[1]))
    for single in (False, True):
        real: Any = np.float32 if single else np.float64
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            code = CSource(file=subject.file, name="loop", single=single, given=False, unproved=subject.unproved)
            short = Vector(subject.vector.y[:300], subject.vector.w[:300], subject.vector.origin)
            write_c(code, short, folder)
            (folder / "all_steps.c").write_text(ALL_STEPS, encoding="utf-8")
            y = np.ascontiguousarray(repeated.astype(real))
            expected = python_steps(Controller(subject.file, single=single), y)
            rules = checked(folder).broken - listed() if shutil.which("cppcheck") else frozenset()
            if rules:
                say(f"{name:40} breaks MISRA C:2012 {', '.join(sorted(rules))}")
                wrong += len(rules)
            for compiler in compilers:
                for level in (*LEVELS, SANE):
                    replay = compiled(folder, compiler, level, shared=False)
                    wrong += subprocess.run([replay], capture_output=True, check=False).returncode != 0
                    count += 1
                wrong += differing(compiled(folder, compiler, "-O2", shared=True), y, expected)
    say(f"{name:40} {wrong} of {count} replays and 2 x {steps:,} steps differ")
    return wrong


def subjects(random: int) -> Iterator[tuple[str, Path]]:
    """Yield each spec in specs/, then random ones until so many of them could be exported, with its name."""
    for path in (*sorted(Path("specs").glob("*.yaml")), *sorted(Path("specs/gallery").glob("*.yaml"))):
        yield path.stem, path
    with tempfile.TemporaryDirectory() as place:
        home = Path(place)
        table = "".join(f"{0.01 * k},{0.1 * np.sin(0.02 * k)}\n" for k in range(6001))
        (home / "wanted.csv").write_text("t,y\n" + table, encoding="utf-8")
        for seed in range(4 * random):
            path = home / f"random_{seed}.yaml"
            path.write_text(spec_text(seed), encoding="utf-8")
            yield path.stem, path


def main(steps: int, random: int) -> int:
    """Judge all, and return 1 if a bit differs."""
    compilers = [name for name in ("gcc", "clang") if shutil.which(name)]
    started, wrong, done = time.perf_counter(), 0, Counter[bool]()
    for name, path in subjects(random):
        if done[True] == random and name.startswith("random_"):
            break
        try:
            spec = load_spec(path)
            sampled = spec.scenario.conditions.sampling is not None
            subject = of_spec(spec, None if sampled else short_enough(spec), steps=2000)
        except PwatrackError as refusal:
            say(f"{name:40} left out: {refusal.problems[0].message[:70]}")
            continue
        done[name.startswith("random_")] += 1
        wrong += judged(name, subject, compilers, steps)
    took = time.perf_counter() - started
    say(f"{done[False]} specs, {done[True]} random, {', '.join(compilers)}: {wrong} differ; {took:.0f} s")
    return int(wrong > 0)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    given = [int(argument) for argument in sys.argv[1:]]
    sys.exit(main(*given, *(100_000, 50)[len(given) :]))
