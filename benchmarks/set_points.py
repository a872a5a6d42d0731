"""What a program makes of set-points against Ruckig: when it arrives, what it keeps, and what a sample takes.

    make set-point-bench

Both have limits of speed, acceleration and jerk. First 1000 moves, half of them from rest and half from the middle of
another one; then 300 sequences of set-points that change on the move, sample by sample. The program is that of a
controller of three integrators, all of it, measured in C as it is exported; of Ruckig an update is timed, from Python,
and a calculation, which is in C++ but for the call.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from pwatrack import load_spec
from pwatrack.arrays import Array
from pwatrack.commands.export import of_spec
from pwatrack.export.c import FLAGS, write
from pwatrack.export.fmu import c_compiler
from pwatrack.export.source import Source
from pwatrack.export.stored import runs
from pwatrack.simulation.controller_arrays import memory, routine
from pwatrack.simulation.kernel import tick

SPEC = """name: Three integrators
system:
  states: [s, v, a]
  inputs: [u]
  outputs: [y]
  A: [[0, 1, 0], [0, 0, 1], [0, 0, 0]]
  B: [[0], [0], [1]]
  C: [[1, 0, 0]]
reference:
  output: {constant: 0}
  outside: {filter: {y: {speed: 0.5, acceleration: 2, jerk: 40}}}
simulation: {duration: 1, sample_time: 0.001, controller: {sample_time: 0.001}}
"""
LIMITS, H = np.array([0.5, 2.0, 40.0]), 1e-3
TIMED = 200_000
MAIN = """#include "loop.h"
#include <stdio.h>
#include <time.h>
static double loop_moves(const loop_state *state)
{
    return (state->status == 0) && (state->course[1] != 0.0);
}
int main(void)
{
    static loop_state state;
    double y[1] = {0.0}, ref[1] = {0.0}, u[1], all = 0.0, moved = 0.0;
    int k, long_ones = 0;
    loop_init(&state);
    for (k = 0; k < STEPS; k++) {
        struct timespec a, b;
        double took;
        if (k % 150 == 0) { ref[0] = (k / 150 % 7) * 0.1; }
        clock_gettime(CLOCK_MONOTONIC, &a);
        loop_step(&state, y, ref, u);
        clock_gettime(CLOCK_MONOTONIC, &b);
        took = 1e6 * (double)(b.tv_sec - a.tv_sec) + 1e-3 * (double)(b.tv_nsec - a.tv_nsec);
        all += took;
        long_ones += took > 20.0;
        moved += loop_moves(&state);
    }
    printf("%.2f %d", all / STEPS, long_ones);
    return moved < 0.5 * STEPS;
}
"""


class Ours:
    """The program, from a state of its own."""

    def __init__(self, file: Any, state: Any = (0.0, 0.0, 0.0)) -> None:
        found = runs(file, given=True)
        self.table, self.kept, self.at = routine(found), memory(found, np.zeros(3), np.zeros(0)), found.places
        self.kept["memory"][self.at["course"]][:3] = state

    def step(self, r: float) -> Array:
        """Run once; w at this tick."""
        kept = self.kept
        tick(self.table, kept["memory"], kept["counts"], kept["room"], np.zeros(1), np.array([r]))
        return kept["memory"][self.at["w"]].copy()

    @property
    def course(self) -> Array:
        """Distance to go, speed and acceleration at the next tick."""
        return self.kept["memory"][self.at["course"]][:3].copy()

    def arrives(self, r: float) -> float:
        """When it is at rest at a set-point, in s."""
        for k in range(1, 100_000):
            self.step(r)
            if not self.course.any():
                return k * H
        raise RuntimeError("it did not arrive")


def asked(ruckig: Any, state: Any, target: float) -> Any:
    """What Ruckig is asked; its limits are wider by rounding, since the state may be at one."""
    found = ruckig.InputParameter(1)
    found.current_position, found.current_velocity, found.current_acceleration = ([float(v)] for v in state)
    found.target_position = [target]
    found.max_velocity, found.max_acceleration, found.max_jerk = ([v * (1 + 1e-9)] for v in LIMITS.tolist())
    return found


def moves(ruckig: Any, file: Any) -> None:
    """Compare when both arrive."""
    random, late, ratios, refused = np.random.default_rng(1), [], [], 0
    calculator = ruckig.Ruckig(1)
    for number in range(1000):
        ours, distance = Ours(file), float(random.choice([-1, 1]) * 10 ** random.uniform(-4, 0.3))
        if number % 2:
            for _ in range(int(random.integers(1, 600))):
                ours.step(0.3)
        _, v, a = ours.course
        trajectory = ruckig.Trajectory(1)
        result = calculator.calculate(asked(ruckig, (0.0, v, a), distance), trajectory)
        if result not in (ruckig.Result.Working, ruckig.Result.Finished):
            refused += 1
            continue
        took = Ours(file, (distance, v, a)).arrives(0.0)
        late.append((took - trajectory.duration) / H)
        ratios.append(took / trajectory.duration)
    told(f"moves: ours/Ruckig, duration: median {np.median(ratios):.4f}, from {min(ratios):.4f} to {max(ratios):.4f}")
    told(f"  ours later by at most {max(late):.2f} samples, earlier by at most {-min(late):.2f}; refused: {refused}")


def sequences(ruckig: Any, file: Any) -> None:
    """Compare how far both use their limits while set-points change, and time Ruckig's update."""
    random, used, their, late, spent, count = np.random.default_rng(2), np.zeros(3), np.zeros(3), list[float](), 0.0, 0
    for _ in range(300):
        ours, online, out = Ours(file), ruckig.Ruckig(1, H), ruckig.OutputParameter(1)
        want = asked(ruckig, np.zeros(3), 0.0)
        for r in (random.uniform(-1, 1, 6) * 10 ** random.uniform(-3, 0)).tolist():
            want.target_position = [r]
            for _ in range(int(random.integers(1, 400))):
                used = np.maximum(used, np.abs(ours.step(r)[1:]) / LIMITS)
                begun = time.perf_counter()
                online.update(want, out)
                spent, count = spent + time.perf_counter() - begun, count + 1
                last = want.current_acceleration[0]
                out.pass_to_input(want)
                now = [out.new_velocity[0], out.new_acceleration[0], (out.new_acceleration[0] - last) / H]
                their = np.maximum(their, np.abs(now) / LIMITS)
        mine = ours.arrives(r)
        k = 0
        while online.update(want, out) == ruckig.Result.Working:
            out.pass_to_input(want)
            k += 1
        late.append(mine / H - k)
    told(f"sequences: largest part of speed, acceleration, jerk: {said(used)} (ours), {said(their)} (Ruckig)")
    told(f"  at rest later than Ruckig by {min(late):.0f} to {max(late):.0f} samples, median {np.median(late):.0f}")
    told("  (a set-point that is just passed, for want of a sample, is gone back to)")
    told(f"Ruckig: {1e6 * spent / count:.1f} µs an update, from Python")


def told(line: str) -> None:
    """Print a line."""
    sys.stdout.write(line + "\n")


def said(parts: Array) -> str:
    """Return parts of limits as a text."""
    return ", ".join(f"{v:.6f}" for v in parts)


def timed(subject: Any) -> None:
    """Time a step of the exported program on moves; what is interrupted takes longer."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(Source(file=subject.file, name="loop", single=False, given=True, unproved=()), subject.vector, folder)
        (folder / "main.c").write_text(MAIN, encoding="ascii")
        flags = [*FLAGS.split(), "-O2", f"-DSTEPS={TIMED}", "-D_POSIX_C_SOURCE=200112L"]
        compiler = c_compiler()
        assert compiler is not None
        subprocess.run([compiler, *flags, "-o", "timed", "main.c", "loop.c", "-lm"], cwd=folder, check=True)
        mean, many = subprocess.run([folder / "timed"], capture_output=True, text=True, check=True).stdout.split()
    told(f"ours:   {mean} µs a step of the whole controller in C, {many} of {TIMED:,} more than 20 µs")


def main() -> None:
    """Print all of it."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "spec.yaml"
        path.write_text(SPEC, encoding="utf-8")
        subject = of_spec(load_spec(path), given=True, steps=10)
    timed(subject)
    try:
        import ruckig
    except ImportError:
        sys.exit("Ruckig is not there: pip install ruckig")
    moves(ruckig, subject.file)
    sequences(ruckig, subject.file)


if __name__ == "__main__":
    main()
