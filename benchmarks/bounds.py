"""What acts on a loop can do to each signal: the proved bounds against the worst that is found.

    .venv/bin/python -m benchmarks.bounds [spec …]
    .venv/bin/python -m benchmarks.bounds 200

With specs, a line for each of their disturbances and noises and each signal. With a number, so many random designs with
one cell, two cells and four in turn: for a disturbance, a noise, a start of x, a start of x̂, and a box of parameters
that change with time, the ratios of bound to worst. The worst is sought over what acts and over the switching that the
proof allows for, see `worst` and `worst_from` in tests/promises.py. A ratio below 1 would be a false proof.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console

from pwatrack import design, load_spec
from pwatrack.claims.bounds import SignalBounds
from tests.promises import box_system, joint_system, random_box, random_design, worst, worst_from


def main(paths: list[Path]) -> None:
    """Print a line for each channel and signal, and the time that the bounds took."""
    console = Console(width=140)
    for path in paths:
        spec = load_spec(path)
        controller = design(spec)
        rate = controller.guarantees.rate
        begin = time.perf_counter()
        found = controller.bounds
        console.print(f"{path}: {time.perf_counter() - begin:.2f} s")
        for bounds in found:
            M, g, rows = joint_system(controller, bounds)
            _, on, _ = spec.words.cause(bounds.channel)
            for signal, size in bounds.sizes.items():
                if signal[0] == "estimate":
                    continue
                seen = worst(M, g, rows[signal], duration=8 / rate)
                name, _ = spec.words.signal(signal)
                console.print(f"    {on} → {name}: bound {size:.4g}, found {seen:.4g}, ratio {size / seen:.2f}")


def ratios(seed: int) -> Iterator[tuple[str, float]]:
    """Yield, for one random design, what acts on what and the ratio of its bound to the worst that is found."""
    random, loop = np.random.default_rng(seed), random_design(seed)
    controller = loop.controller
    n, duration = len(controller.plant.B), 6 / controller.guarantees.rate
    known = controller.claim(SignalBounds)
    driven = known.acting[int(random.integers(n))], known.acting[-1]
    starts = known.starts[int(random.integers(n))], known.starts[n + int(random.integers(n))]
    for bounds in (*driven, *starts):
        M, g, rows = joint_system(controller, bounds)
        for kind, k in bounds.sizes:
            size, row = bounds.sizes[kind, k], rows[kind, k]
            if kind == "estimate" and k != seed % n:
                continue
            if bounds.channel[0] == "start":
                found = worst_from(M, g, row, duration=duration)
            else:
                found = worst(M, g, row, duration=duration, steps=150, rounds=4)
            if size or found:
                yield f"{bounds.channel[0]} → {kind}", size / found
    if (robust := random_box(loop, seed)) is not None:
        M = box_system(loop, robust)
        for bounds in robust.bounds[:1]:
            _, g, rows = joint_system(controller, bounds)
            for kind, k in bounds.sizes:
                found = worst(M, g, rows[kind, k], duration=8 / robust.rate, steps=150, rounds=4)
                yield f"uncertain → {kind}", bounds.sizes[kind, k] / found


def random_designs(count: int) -> None:
    """Print the ratios of so many random designs."""
    console, found = Console(width=140), dict[str, list[float]]()
    cells: dict[int, list[float]] = {1: [], 2: [], 4: []}
    for seed in range(count):
        for name, ratio in ratios(seed):
            found.setdefault(name, []).append(ratio)
            cells[2 ** (seed % 3)].append(ratio)
    console.print(f"{count} random designs with one, two and four cells: bound over the worst that was found")
    everything = {f"all with {k} cell{'s' * (k > 1)}": values for k, values in cells.items()}
    everything["all"] = [ratio for values in found.values() for ratio in values]
    for name, values in (found | everything).items():
        below = sum(value < 1 for value in values)
        figures = f"median {np.median(values):.2f}, least {min(values):.4f}, largest {max(values):.3g}"
        console.print(f"    {name}: {len(values)} bounds, {below} exceeded; {figures}")


if __name__ == "__main__":
    if sys.argv[1:] and sys.argv[1].isdigit():
        random_designs(int(sys.argv[1]))
    else:
        main(
            [Path(name) for name in sys.argv[1:]]
            or sorted(Path("specs").glob("*.yaml")) + sorted(Path("specs/gallery").glob("*.yaml"))
        )
