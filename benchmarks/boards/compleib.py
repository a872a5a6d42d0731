"""Plants of COMPleib, each with one element by one rule: check, design and simulate, within limits.

    python -m benchmarks.boards.compleib FOLDER-OR-FILES [--seconds 300] [--gibibytes 4] [--out runs/boards]

A file is one of MATLAB's (`.mat`) with A (n, n), B2 or B (n, m), the inputs, and C (q, n), what is measured, as
controlgym has them. Nothing else in it is read, and nothing is known of its name.

The rule, written down before anything was run. States are x1, x2, …, inputs u1, …, outputs y1, …, as the file has them.
The element is a stiffening dead zone on the state that the first output shows most:

- its state is the x_j with the largest |C_1j| among those that act on anything, A e_j ≠ 0; of equals, the first;
- between −1 and 1 the plant is the file's; outside, x_j acts half as much again on every state that it acts on:
  ẋ = A x + ½ A e_j φ(x_j) + B u, φ the dead zone of slope 1 on [−1, 1].

All states are to be held at 0: state tracking with x_d = 0, K and L as they come from the default of `design`. The run
lasts 10 s, from x_j(0) = 3, all others 0, the observer at 0, so that it begins outside of the zone.

What is proved so, and has 12 states at most, is designed once more for a controller that is sampled, as often as
`benchmarks.sampled_loop` says for the K of the first design.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.boards.limited import Ended, machine, pwatrack, run, table
from benchmarks.sampled_loop import sample_time
from pwatrack import plant as plant_of
from pwatrack.arrays import Array

MOST_SAMPLED = 12  # states
SHARE = 0.5  # by which the state acts more beyond the zone
START, DURATION, SAMPLES = 3.0, 10.0, 1000
STEPS = "check", "design", "simulate"
VERDICTS = {0: "proved", 3: "outside the theory", 4: "refused with proof", 5: "undecided", 6: "proved, run ends off"}


def matrices(path: Path) -> tuple[Array, Array, Array]:
    """Return A (n, n), B (n, m) and C (q, n) of a file; a ValueError names what is missing or does not fit."""
    from scipy.io import loadmat

    held = {name: np.atleast_2d(np.asarray(value)) for name, value in loadmat(path).items() if name[0] != "_"}
    names = "A", "B2" if "B2" in held else "B", "C"
    missing = [name for name in names if name not in held]
    if missing:
        raise ValueError(f"{path}: no {', '.join(missing)}; it has {', '.join(sorted(held))}")
    A, B, C = (np.asarray(held[name], dtype=float) for name in names)
    n = len(A)
    for name, value, shape in ((names[0], A, (n, n)), (names[1], B, (n, B.shape[1])), (names[2], C, (len(C), n))):
        if value.shape != shape:
            raise ValueError(f"{path}: {name} is {value.shape}, expected {shape}")
    return A, B, C


def shown_most(A: Array, C: Array) -> int:
    """Return the state that the first output shows most, among those that act on anything.

    Example:
        >>> shown_most(np.array([[0.0, 1], [0, 0]]), np.array([[1.0, 0]]))
        1
    """
    acting = np.flatnonzero(np.any(A != 0, axis=0))
    if not len(acting):
        raise ValueError("A is 0: no state acts on another")
    return int(acting[np.argmax(np.abs(C[0, acting]))])


def sections(name: str, A: Array, B: Array, C: Array) -> dict[str, Any]:
    """Return the sections of a spec: the plant, its element by the rule, and what is asked."""
    (n, m), q = B.shape, len(C)
    states, j = [f"x{k + 1}" for k in range(n)], shown_most(A, C)
    zone = {
        "name": f"stiffer {states[j]}",
        "kind": "dead_zone",
        "of": states[j],
        "lower": -1,
        "upper": 1,
        "into": {states[i]: SHARE * float(A[i, j]) for i in np.flatnonzero(A[:, j])},
    }
    return {
        "name": name,
        "system": {
            "states": states,
            "inputs": [f"u{k + 1}" for k in range(m)],
            "outputs": [f"y{k + 1}" for k in range(q)],
            "A": A.tolist(),
            "nonlinearities": [zone],
            "B": B.tolist(),
            "C": C.tolist(),
        },
        "design": {"tracking": "state"},
        "reference": {"state": [0] * n},
        "simulation": {
            "duration": DURATION,
            "sample_time": DURATION / SAMPLES,
            "initial": {"plant": {states[j]: START}},
        },
    }


def verdict(ended: Ended) -> str:
    """Return in a word how a step ended."""
    if ended.stopped:
        return "no time left"
    if "MemoryError" in ended.text or ended.code < 0:
        return "no memory left"
    return VERDICTS.get(ended.code, f"exit {ended.code}")


def files(given: list[Path]) -> list[Path]:
    """Return the files that are meant: themselves, and those of folders."""
    found = [sorted(path.glob("*.mat")) if path.is_dir() else [path] for path in given]
    return [path for part in found for path in part]


def worked(spec: Path, folder: Path, seconds: float, gibibytes: float) -> dict[str, Ended]:
    """Check, design and simulate a spec, up to the first that fails, and return how each ended."""
    ends = dict[str, Ended]()
    for step in STEPS:
        more = [] if step == "check" else ["--out", str(folder)]
        plots = ["--plots", "none"] if step == "simulate" else []
        ends[step] = run(pwatrack(step, str(spec), *more, *plots), seconds=seconds, gibibytes=gibibytes)
        folder.with_name(f"{folder.name}.{step}.txt").write_text(ends[step].text, encoding="utf-8")
        if ends[step].code != 0:
            break
    return ends


def as_sampled(given: dict[str, Any], folder: Path, seconds: float, gibibytes: float) -> tuple[list[str], float]:
    """Return the sample time, whether the loop is proved with it, the seconds of its design, and its MiB."""
    gains = json.loads((folder / "gains.json").read_text(encoding="utf-8"))
    time = sample_time(plant_of(**given["system"]).system, np.array(gains["K"]))
    spec, out = folder.with_name(f"{folder.name}.sampled.yaml"), folder.with_name(f"{folder.name}.sampled")
    simulation = given["simulation"] | {"controller": {"sample_time": time}}
    spec.write_text(json.dumps(given | {"simulation": simulation}), encoding="utf-8")
    ended = run(pwatrack("design", str(spec), "--out", str(out)), seconds=seconds, gibibytes=gibibytes)
    folder.with_name(f"{folder.name}.sampled.txt").write_text(ended.text, encoding="utf-8")
    told = json.loads((out / "run.json").read_text(encoding="utf-8")) if ended.code == 0 else {}
    said = verdict(ended) if not told or told["sampled"]["rate"] is not None else "undecided"
    return [f"{time:g}", said, f"{ended.seconds:.1f}"], ended.mebibytes


def rows(paths: list[Path], out: Path, seconds: float, gibibytes: float) -> Iterator[list[str]]:
    """Yield a row of the table for each plant; each step is told how it ended."""
    for path in paths:
        A, B, C = matrices(path)
        spec, folder, given = out / f"{path.stem}.yaml", out / path.stem, sections(path.stem, A, B, C)
        spec.write_text(json.dumps(given), encoding="utf-8")
        ends = worked(spec, folder, seconds, gibibytes)
        last = ends[next(reversed(ends))]
        said = "" if last.code == 0 else next((line for line in last.text.splitlines() if "error:" in line), "")[:150]
        times = [f"{ends[step].seconds:.1f}" if step in ends else "–" for step in STEPS]
        most = max(end.mebibytes for end in ends.values())
        where = "" if last.code == 0 else f" ({next(reversed(ends))})"
        again = last.code == 0 and len(A) <= MOST_SAMPLED
        sampled, held = as_sampled(given, folder, seconds, gibibytes) if again else (["–"] * 3, 0.0)
        sizes = [path.stem, str(len(A)), str(B.shape[1]), str(len(C)), f"x{shown_most(A, C) + 1}"]
        yield [
            *sizes,
            verdict(last) + where,
            *times,
            *sampled,
            f"{max(most, held):.0f}",
            said.replace(str(spec), "").replace("|", "/"),
        ]


def main() -> None:
    """Print the table, and write it beside the runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, help="files, or folders of them")
    parser.add_argument("--seconds", type=float, default=300.0, help="for each of check, design and simulate")
    parser.add_argument("--gibibytes", type=float, default=4.0)
    parser.add_argument("--out", type=Path, default=Path("runs/boards"))
    given = parser.parse_args()
    out = given.out / "compleib"
    out.mkdir(parents=True, exist_ok=True)
    columns = ["plant", "n", "m", "q", "element", "verdict", "check s", "design s", "simulate s"]
    columns += ["sampled every s", "as sampled", "design s", "MiB", "said"]
    found = list[list[str]]()
    for row in rows(files(given.paths), out, given.seconds, given.gibibytes):
        sys.stderr.write("  ".join(row) + "\n")
        found.append(row)
    text = table(f"COMPleib, {machine()}", columns, found)
    (given.out / "compleib.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
