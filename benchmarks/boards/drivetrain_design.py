"""A controller of our own for the drivetrain of ARCH-COMP, in place of the benchmark's: check, design and simulate.

    python -m benchmarks.boards.drivetrain_design [--masses 0 2 22 47] [--seconds 300] [--out runs/boards]

The plant is the benchmark's without its controller and its reference: the input u is the torque that is asked of the
engine, which follows with the benchmark's lag, and the angles are those between neighbours, as speeds alone are to be
held. What is measured is the speed of the engine and the twist of the shaft. Nothing is said of sizes or goals. The
engine is to turn at 360 rad/s, so the load at 30 rad/s, from rest with all at 0, where the backlash is open.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.boards.compleib import STEPS, verdict, worked
from benchmarks.boards.drivetrain import LAG, chain, system
from benchmarks.boards.limited import machine, table

SPEED, DURATION, SAMPLE = 360.0, 3000.0, 0.5  # rad/s and s: the chain swings for long, its slowest mode for 200 s


def sections(masses: int) -> dict[str, Any]:
    """Return the sections of a spec: 4 states and 2 for each mass between.

    Example:
        >>> sections(2)["system"]["states"]
        ['twist', 'torque', 'engine', 'angle1', 'angle2', 'speed1', 'speed2', 'load']
    """
    whole, bodies = system(masses), chain(masses)
    angles, speeds = ([body[k] for body in bodies] for k in (0, 1))
    differ = np.eye(len(whole["A"]))
    differ[angles[:-1], angles[1:]] = -1.0
    A = differ @ np.array(whole["A"]) @ np.linalg.inv(differ).round()  # of the last angle alone nothing depends
    A[1] = 0.0
    A[1, 1] = -1 / LAG
    kept = [0, 1, 6, *angles[:-1], *speeds]
    counts = range(1, masses + 1)
    states = ["twist", "torque", "engine", *(f"angle{k}" for k in counts), *(f"speed{k}" for k in counts), "load"]
    (gap,) = whole["nonlinearities"]
    into = {states[kept.index(int(name[1:]) - 1)]: by for name, by in gap["into"].items() if name != "x2"}
    n = len(states)
    return {
        "name": f"Drivetrain with {masses} masses between",
        "system": {
            "states": states,
            "inputs": ["u"],
            "outputs": ["w", "gap"],
            "track": ["w"],
            "A": A[np.ix_(kept, kept)].tolist(),
            "nonlinearities": [gap | {"of": "twist", "into": into}],
            "B": (np.eye(n)[:, [1]] / LAG).tolist(),
            "C": [np.eye(n)[2].tolist(), np.eye(n)[0].tolist()],
        },
        "design": {"tracking": "state"},
        "reference": {"setpoint": {"w": SPEED}},
        "simulation": {"duration": DURATION, "sample_time": SAMPLE},
    }


def rows(masses: list[int], out: Path, seconds: float, gibibytes: float) -> Iterator[list[str]]:
    """Yield a row of the table for each number of masses between."""
    for count in masses:
        spec, folder = out / f"{count}.yaml", out / str(count)
        spec.write_text(json.dumps(sections(count)), encoding="utf-8")
        ends = worked(spec, folder, seconds, gibibytes)
        last, kept = ends[next(reversed(ends))], folder / "run.json"
        told = json.loads(kept.read_text(encoding="utf-8")) if last.code == 0 else {}
        figures, ended = told.get("figures", {}), told.get("simulation", {}).get("outcome", "–")
        yield [
            str(4 + 2 * count),
            str(count),
            verdict(last),
            f"{1 / figures['rate']:.0f}" if figures else "–",
            f"{ended}, {figures['final_error']:.0e}" if figures else ended,
            *(f"{ends[step].seconds:.1f}" if step in ends else "–" for step in STEPS),
            f"{max(end.mebibytes for end in ends.values()):.0f}",
        ]


def main() -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masses", nargs="*", type=int, default=[0, 2, 22, 47])
    parser.add_argument("--seconds", type=float, default=300.0, help="for each of check, design and simulate")
    parser.add_argument("--gibibytes", type=float, default=4.0)
    parser.add_argument("--out", type=Path, default=Path("runs/boards"))
    given, found = parser.parse_args(), list[list[str]]()
    out = given.out / "drivetrain_design"
    out.mkdir(parents=True, exist_ok=True)
    for row in rows(given.masses, out, given.seconds, given.gibibytes):
        sys.stderr.write("  ".join(row) + "\n")
        found.append(row)
    columns = ["states", "masses between", "verdict", "time constant s", "run ends", *(f"{step} s" for step in STEPS)]
    text = table(f"Drivetrain with a controller of our own, {machine()}", [*columns, "MiB"], found)
    (given.out / "drivetrain_design.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
