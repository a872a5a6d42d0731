"""What is said of boxes of uncertain parameters, held against random plants that have parameters everywhere.

    .venv/bin/python -m benchmarks.uncertain [specs] [first]

In each spec numbers of matrices, slopes, values, offsets and `into` are products and quotients of up to three
parameters. For each that is proved, plants inside the box, whose field is read without the package, are to be means of
those at its corners; the eigenvalues of loops inside it are to be left of the rate that is proved; and no error or
input may be above its bound, from error 0, while the parameters jump about in the box. Anything else is a false proof.
"""

import sys
import time
from collections import Counter

from rich.console import Console

from tests.boxes import judge

_OFF = 1e-9  # of the size of a field: what the weights of a mean are worked out to
_LEFT = 1e-4  # in 1/s: A is read off differences


def main(specs: int, first: int) -> None:
    """Print what came of so many specs."""
    begin, console, kinds = time.perf_counter(), Console(width=140), Counter[str]()
    false, part, strict = 0, 0.0, 0
    for seed in range(first, first + specs):
        found = judge(seed)
        kinds[found.kind] += 1
        strict += found.kind == "refused" and found.outside < _OFF
        if found.kind != "proved":
            continue
        part = max(part, found.part)
        if found.outside > _OFF or found.part > 1 or found.real > _LEFT:
            false += 1
            console.print(f"false: spec {seed}: {found}")
    each = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    console.print(f"{specs} specs in {time.perf_counter() - begin:.0f} s: {each}; {false} false proofs")
    console.print(f"largest part of a bound that was reached: {part:.3f}")
    console.print(f"refused, though all plants that were tried are means of the corners: {strict}")


if __name__ == "__main__":
    main(*(int(text) for text in (sys.argv[1:] + ["2000", "0"][len(sys.argv) - 1 :])))
