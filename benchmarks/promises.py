"""What the proofs promise against simulations of random designs from random initial states; prints the counts.

    .venv/bin/python -m benchmarks.promises [designs]

Every error of every sample is held against its bound, and the bounds against a second opinion: see
tests/promises.py. A part of 1 is an error on its bound.
"""

import sys

import numpy as np
from rich.console import Console

from tests.promises import Verdict, judge, random_loop, run


def main(designs: int) -> None:
    """Print the counts of so many designs."""
    verdicts: list[Verdict] = []
    for seed in range(designs):
        loop, x0 = random_loop(seed)
        duration = 20 / loop.controller.guarantees.rate
        verdicts.append(judge(loop, run(loop, x0, duration, duration / 1000)))
    console = Console()
    console.print(f"{designs} designs, {designs * 1001} samples")
    for name in ("output", "state", "observer", "later", "decay"):
        parts = np.array([getattr(verdict, name) for verdict in verdicts])
        above = int((parts > 1 + 1e-9).sum())
        console.print(f"{name}: {above} above the bound; largest part {parts.max():.9f}, median {np.median(parts):.3g}")
    opinions = np.array([verdict.opinions for verdict in verdicts])
    console.print(f"ours over the second opinion: {opinions.min():.9f} to {opinions.max():.9f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
