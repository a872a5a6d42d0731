"""Practical tracking: the proved final bound against the worst that simulations of random plants come to.

    .venv/bin/python -m benchmarks.practical [plants]

Each plant has one or two dead zones that are merged. Amplitude, frequency and offset of the reference, and the start,
are optimised for the largest error in the end. A part above 1 would be a false proof.
"""

import sys
import time

import numpy as np
from rich.console import Console

from tests.gaps import plant_with_gaps, practical_controller, worst_found

_TRIES, _STEPS = 10, 10  # simulations with random references, and about the best of them


def main(plants: int) -> None:
    """Print how far so many plants get, with either observer."""
    begin, found = time.perf_counter(), {False: list[tuple[float, float]](), True: list[tuple[float, float]]()}
    refused = 0
    for seed in range(plants):
        plant, form = plant_with_gaps(seed)
        for watched in (False, True):
            try:
                controller = practical_controller(plant, form, watched=watched)
            except Exception as error:
                if not watched:
                    raise
                refused += "infeasible" in str(error) or "undecided" in str(error)
                continue
            seen = worst_found(controller, seed, tries=_TRIES, steps=_STEPS)
            found[watched].append((seen.final, seen.part))
            if max(seen.final, seen.part) > 1 + 1e-9:
                Console(width=140).print(
                    f"above its bound: plant {seed}, observer of {'all' if watched else 'merged'} cells: {seen}"
                )
    console = Console(width=140)
    console.print(f"{plants} plants, {_TRIES + _STEPS} simulations each: {time.perf_counter() - begin:.0f} s")
    for watched, pairs in found.items():
        final, part = np.array(pairs).T
        runs = "all cells" if watched else "the merged cells"
        above = int((np.maximum(part, final) > 1 + 1e-9).sum())
        console.print(
            f"observer runs {runs}: {len(pairs)} loops, {above} above the bound; largest part of it {final.max():.6f}; "
            f"bound over worst found: median {np.median(1 / final):.2f}, 90 % below {np.quantile(1 / final, 0.9):.2f}"
        )
    console.print(f"(9) for all cells refused: {refused}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
