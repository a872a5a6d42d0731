"""Certificates of less than 100 kB that are made to keep the auditor busy: how long does it take to answer?

Some are genuine ones that have grown: longer numbers, entries of lists many times over, other powers of two, other
whole numbers. Others are made as large as they can be: elements, cells, states, proofs, parts of bounds, runs of steps
of a peak gain, with numbers of a few digits or of thousands, so that nothing in their form keeps them from the work.
"""

import copy
import json
from collections.abc import Callable, Iterator
from time import process_time
from typing import Any

import numpy as np
from rich.progress import track

from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.reading import FORMAT

BYTES = 100_000  # of a file
SECONDS = 10.0  # of the processor's time: others may be busy on the machine
DIGITS = (1, 3, 20, 200, 2000)  # of a number
Content = dict[str, Any]
Random = np.random.Generator


def number(random: Random, digits: int) -> str:
    """Return a fraction of so many digits, as it is to be written."""
    p, q = (int("".join(map(str, random.integers(1, 10, size=digits)))) | 1 for _ in range(2))
    return str(p) if digits < 3 else f"{p}/{2 ** (q.bit_length())}" if p % 2 else str(p)


def diagonal(n: int, value: str) -> list[list[str]]:
    """Return value I."""
    return [[value if i == j else "0" for j in range(n)] for i in range(n)]


def whole(n: int, bits: int, random: Random) -> list[list[int]]:
    """Return a symmetric matrix of whole numbers with a large diagonal."""
    low = [[int(random.integers(-9, 10)) for _ in range(n)] for _ in range(n)]
    return [[(n * 10) << bits if i == j else low[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]


def made(random: Random) -> Content:
    """Return a certificate of state tracking with as much to decide as its few numbers ask for."""
    kind = str(random.choice(["elements", "cells", "states", "proofs", "bounds", "numbers"]))
    digits = int(random.choice(DIGITS)) if kind != "states" else 1
    n = {"elements": 16, "cells": 6, "states": 60, "proofs": 8, "bounds": 5, "numbers": 4}[kind]
    n = int(random.integers(2, n + 1)) if kind != "states" else int(random.integers(20, 60))
    names = [f"x{k}" for k in range(n)]
    plant: Content = {"states": names, "inputs": ["u"], "outputs": ["y"], "tracked": ["y"], "loads": None}
    plant |= {"B": [["0"]] * n, "C": diagonal(n, "1")[:1], "tracked_rows": diagonal(n, "1")[:1]}
    radius = dict.fromkeys(("A", "b", "B", "C", "tracked_rows"))
    if kind == "elements":
        segments = int(random.integers(2, 5))
        function = {"breakpoints": list(map(str, range(segments - 1))), "slopes": ["0"] * segments, "value": "0"}
        terms = [
            {
                "row": diagonal(n, "1")[i],
                "direction": [str(v) for v in random.integers(-2, 3, size=n)],
                "constant": "0",
                "function": function | {"slopes": [f"0.0{k}" if k else "0" for k in range(segments)]},
                "segments": [f"s{k}" for k in range(segments)],
            }
            for i in range(n)
        ]
        plant |= {"A": diagonal(n, "-9"), "b": [["0"]] * n, "elements": terms}
    else:
        planes = int(random.integers(1, 15)) if kind == "cells" else 0
        cells = int(random.integers(2, 80)) if planes else 1
        signs = sorted({tuple(random.choice([-1, 1], size=planes).tolist()) for _ in range(cells)})
        H = [[str(2 * v + 1) for v in random.integers(-9, 9, size=n).tolist()] for _ in range(planes)]
        A = diagonal(n, f"-{number(random, digits)}")
        A[0][-1] = number(random, digits)
        plant |= {"cells": [f"c{k}" for k in range(len(signs))], "signs": [list(row) for row in signs]}
        plant |= {"H": H, "h": [str(v) for v in random.integers(-9, 9, size=planes)]}
        plant |= {"A": [A] * len(signs), "b": [[["0"]] * n] * len(signs)}
    low, high = random.choice([[0, 1], [-3, 4], [-2000, 2001]]).tolist()
    exponents = [int(v) for v in random.integers(low, high, size=n)]
    P = {"integers": whole(n, int(random.choice([0, 40, 400])), random), "exponents": exponents}
    proofs = [
        {"of": of, "rate": "0.001", "margin": "0.001", "radius": "0", "P": P}
        for of in ("controller", "observer") * (int(random.integers(2, 40)) if kind == "proofs" else 1)
    ]
    twice = {"integers": whole(2 * n, 0, random), "exponents": [0] * (2 * n)}
    part = {"loop": "joint", "channel": ["noise", 0], "a": "0.001", "Q": twice, "signals": [["state", 0, "1000000000"]]}
    steps = [[int(random.integers(0, 60)), int(10 ** random.uniform(0, 9))] for _ in range(int(random.integers(1, 9)))]
    peaks = [{"part": 0, "unit": int(random.integers(-60, 60)), "steps": steps, "P": twice, "size": "1000000000"}]
    parts = [part] * int(random.integers(1, 60))
    bounds = [{"channel": ["noise", 0], "signals": [["state", 0, "1000000000"]], "parts": parts, "peaks": peaks}]
    found: Content = {"format": FORMAT, "claim": "", "spec_sha256": "", "set": {}, "tracking": "state"}
    found |= {"plant": plant | {"radius": radius}, "generator": None, "K": [["0"] * n], "L": [["0"]] * n}
    found |= {"proofs": proofs, "bounds": bounds if kind == "bounds" else [], "limits": []}
    return found | {"uncertain": None, "practical": None}


def grown(content: Content, random: Random) -> Content:
    """Return a certificate with some numbers much longer, and some entries of lists many times."""
    changed, digits = copy.deepcopy(content), int(random.choice(DIGITS))
    for _ in range(int(random.integers(1, 12))):
        lists = [value for value in _lists(changed) if value]
        chosen = lists[random.integers(len(lists))]
        k = int(random.integers(len(chosen)))
        if isinstance(chosen[k], str) and chosen[k].lstrip("-")[:1].isdecimal():
            chosen[k] = number(random, digits)
        elif isinstance(chosen[k], int):
            chosen[k] = int(random.choice([-1, 1]) * 10 ** random.uniform(0, 9))
        else:
            chosen.extend(copy.deepcopy(chosen[k]) for _ in range(int(random.integers(1, 30))))
    return changed


def _lists(value: Any) -> Iterator[list[Any]]:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if isinstance(value, list):
        yield value
    for part in parts:
        yield from _lists(part)


def longest(genuine: list[Content], count: int, console: Any) -> tuple[int, float, str]:
    """Return how many of such files are decided too slowly, the longest time in s, and what was said of that file."""
    random, slow, worst = np.random.default_rng(2026), 0, (0.0, "")
    make: list[Callable[[], Content]] = [lambda: made(random), lambda: grown(_one(genuine, random), random)]
    for k in track(range(count), "long", console=console):
        text = json.dumps(make[k % len(make)]())
        while len(text) >= BYTES:
            text = json.dumps(make[k % len(make)]())
        start = process_time()
        said, faults = audit(text)
        took = process_time() - start
        slow += took > SECONDS
        worst = max(worst, (took, f"{len(text):,} bytes: {(faults or said)[0]}"))
    return slow, *worst


def _one(genuine: list[Content], random: Random) -> Content:
    return genuine[random.integers(len(genuine))]
