"""Random specs from end to end: what ends in a crash, takes long, or is not verified afterwards.

    make fuzz

Each spec has 1 to 5 states, up to two inputs and outputs, cells in one of the three ways of writing them, a reference
of any kind, goals and other conditions at random. `simulate` runs on it, then `verify` on whatever it proved. Printed
is what ends with 1 or 2, what is above its own proved bound, what takes more than 10 s of processor time, and every
certificate that does not verify: none is expected; then how many runs ended with which code.
"""

import argparse
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from typer.testing import CliRunner

from pwatrack.cli import app

KINDS = {
    "spring": "start: {a}, slope: {s}",
    "dead_zone": "lower: -{w}, upper: {w}, slope: {s}",
    "stop": "lower: -{w}, upper: 2*{w}, lower_slope: {s}, upper_slope: {s}/2",
    "saturation": "lower: -{w}, upper: {w}, slope: {s}",
    "absolute": "slope: {s}",
    "piecewise_linear": "breakpoints: [-{w}, 0, {w}], slopes: [{s}, 0, {s}/3, {s}]",
}
COURSES = (
    '"{a} + {w}*sin({f}*t)"',
    '"{w}*sin({f}*t)*cos(2*t) + exp(-t)*t"',
    "{{constant: {a}}}",
    "{{constant: {a}, sine: {{amplitude: {w}, frequency: {f}, phase: 1}}}}",
    "{{step: {{size: {w}, at: 1, smooth: 0.5}}}}",
    "{{trapezoid: {{low: {a}, high: {w}, rise: 0.5, hold: 0.5, fall: 0.5, rest: 0.5, smooth: 0.4}}}}",
    "{{polyline: {{points: [[0, {a}], [1, {w}], [3, 0]], smooth: 0.8}}}}",
    "{{table: {{file: wanted.csv}}}}",
)
GOALS = (
    "",
    "",
    "",
    "rate: 0.05",
    "rate: largest, gain: {g}",
    "rate: 0.05, gain: smallest",
    "gain: {g}",
    "cost: {cost}",
)
CONDITIONS = (
    "",
    "",
    "",
    "  actuator: {{limits: {{u0: [-{g}, {g}]}}}}\n",
    "  disturbance: {{x0: {{constant: 0.1, sine: {{amplitude: 0.05, frequency: 3}}}}}}\n",
    "  noise: {{std: {{y0: 0.01}}, sample_time: 0.01, seed: 1}}\n",
    "  controller: {{sample_time: 0.01}}\n",
    "  plant: {{parameters: {{k: 0.5}}}}\n",
)


class Words:
    """Random words of a spec with n states, m inputs and p outputs."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        random = self.random
        self.tracking = str(random.choice(["output", "output", "state"]))
        self.n, (self.m, self.p) = int(random.integers(1, 6)), random.integers(1, 3, size=2).tolist()
        if self.tracking == "output":
            self.m = self.p = 1
        w, f = random.uniform(0.05, 2, size=2)
        self.fields = {"a": self.number(0.2), "w": f"{w:.2f}", "f": f"{f:.2f}", "g": f"{random.uniform(1, 60):.3g}"}

    def number(self, scale: float = 1.0) -> str:
        """Return a decimal, a fraction or an expression."""
        random = self.random
        return str(random.choice([f"{scale * random.normal():.2f}", f"{int(random.integers(-9, 10))}/7", "k/3"]))

    def numbers(self, count: int, scale: float = 1.0) -> str:
        """Return a list of numbers."""
        return listed([self.number(scale) for _ in range(count)])

    def one_of(self, texts: Sequence[str], **more: str) -> str:
        """Return one of some texts, with all its fields filled in."""
        return str(self.random.choice(np.array(texts))).format(**self.fields, **more)

    def goal(self, k: int) -> str:
        """Return what is asked of a gain with k inputs or outputs."""
        Q, R = (rows([[str(int(i == j)) for j in range(size)] for i in range(size)]) for size in (self.n, k))
        return "{" + self.one_of(GOALS, cost=f"{{Q: {Q}, R: {R}}}") + "}"

    def reference(self) -> str:
        """Return what is to be tracked."""
        if self.tracking == "output":
            return f"{{output: {self.one_of(COURSES)}}}"
        kind = int(self.random.integers(4))
        if kind == 0:
            return f"{{state: {listed(['k*sin(t)', 'k*cos(t)', '-k*sin(t)', '-k*cos(t)', 'k*sin(t)'][: self.n])}}}"
        if kind == 1:
            inputs = listed([self.one_of(COURSES) for _ in range(self.m)])
            return f"{{input: {inputs}, start: {self.numbers(self.n, 0.3)}}}"
        if kind == 2:
            return f"{{input: ['sin({self.fields['f']}*t)'{', 0' * (self.m - 1)}], start: periodic}}"
        return "{setpoint: {" + ", ".join(f"y{i}: {self.number()}" for i in range(self.p)) + "}}"


def listed(texts: list[str]) -> str:
    """Return a list as YAML."""
    return "[" + ", ".join(texts) + "]"


def rows(X: list[list[str]]) -> str:
    """Return a matrix as YAML."""
    return listed([listed(row) for row in X])


def spec_text(seed: int) -> str:
    """Return a random spec; wanted.csv is beside it."""
    words = Words(seed)
    random, number, n, m, p = words.random, words.number, words.n, words.m, words.p
    A = [[number() if random.uniform() < 0.7 else "0" for _ in range(n)] for _ in range(n)]
    if random.uniform() < 0.6:  # a chain: a relative degree, and (3) for a closed form
        A[:-1] = [["1" if k == j + 1 else "0" for k in range(n)] for j in range(n - 1)]
    spread = 0.0 if random.uniform() < 0.6 else 1.0  # how much else there is in B and C, and where cells differ
    B = [[number() if j == n - 1 or random.uniform() < 0.3 * spread else "0" for _ in range(m)] for j in range(n)]
    C = [[str(int(j == i)) if random.uniform() > 0.2 * spread else number() for j in range(n)] for i in range(p)]
    if random.uniform() < 0.05:
        B = [["0"] * m] * n
    if random.uniform() < 0.05:
        C = [["0"] * n] * p
    x, u, y = (listed([f"{letter}{i}" for i in range(k)]) for letter, k in (("x", n), ("u", m), ("y", p)))
    return f"""name: random {seed}
parameters: {{k: 0.6, w: sqrt(2)}}
system:
  states: {x}
  inputs: {u}
  outputs: {y}
  B: {rows(B)}
  C: {rows(C)}
{cells_text(random, A, spread)}
design: {{tracking: {words.tracking}, controller: {words.goal(m)}, observer: {words.goal(p)}}}
reference: {words.reference()}
simulation:
  duration: {random.choice([5, 40])}
  sample_time: 0.02
  initial: {{plant: {words.numbers(n, 0.5)}}}
{words.one_of(CONDITIONS)}"""


def cells_text(random: Any, A: list[list[str]], spread: float) -> str:
    """Return A with its cells: none, nonlinearities, hyperplanes with signs, or inequalities."""
    n, k = len(A), int(random.integers(1, 4))

    def linear(row: list[int]) -> str:
        return " + ".join(f"{v}*x{j}" for j, v in enumerate(row) if v).replace("+ -", "- ") or "x0"

    normals = [[int(v) for v in random.integers(-2, 3, size=n)] for _ in range(min(k, n))]
    normals = [row if any(row) else [1] + [0] * (n - 1) for row in normals]
    if np.linalg.matrix_rank(normals) < len(normals):
        normals = np.eye(len(normals), n, dtype=int).tolist()
    kind = random.choice(["none", "elements", "elements", "hyperplanes", "inequalities"])
    if kind == "none":
        return f"  A: {rows(A)}"
    if kind == "elements":
        lines = []
        for j in range(k):
            name = str(random.choice(list(KINDS)))
            w, s, a = random.uniform(0.05, 1), random.normal(), random.normal()
            more = KINDS[name].format(w=f"{w:.3f}", s=f"({s:.2f})", a=f"{0.2 * a:.2f}")
            form = linear(normals[j % len(normals)])
            lines.append(f"    - {{name: e{j}, kind: {name}, of: {form}, {more}, into: {{x{n - 1}: -0.3}}}}")
        return f"  A: {rows(A)}\n  nonlinearities:\n" + "\n".join(lines)
    inner = np.append(np.full(n - 1, spread), 1.0)
    gains = [[f"{0.3 * v:.2f}" for v in inner * random.normal(size=n)] for _ in normals]
    if kind == "inequalities":
        normals, gains = normals[:1], gains[:1]
    offset = "w/4"
    cells = []
    for number in range(2 ** len(normals)):
        on = [j for j in range(len(normals)) if number >> j & 1]
        entries = [
            [value + "".join(f" + ({gains[j][i]})*({normals[j][c]})" for j in on) for c, value in enumerate(row)]
            for i, row in enumerate(A)
        ]
        b = ["0" + "".join(f" + ({gains[j][i]})*{offset}" for j in on) for i in range(n)]
        if kind == "hyperplanes":
            where = "signs: [" + ", ".join('"+"' if j in on else '"-"' for j in range(len(normals))) + "]"
        else:
            where = f'where: ["{linear(normals[0])} {">=" if on else "<="} -{offset}"]'
        cells.append(f"    - {{name: c{number}, {where}, A: {rows(entries)}, b: {listed(b)}}}")
    planes = [f"{{H: {row}, h: {offset}}}" for row in normals]
    head = f"  hyperplanes: [{', '.join(planes)}]\n" if kind == "hyperplanes" else ""
    return head + "  cells:\n" + "\n".join(cells)


def run_of(path: Path, limit: int) -> tuple[int, float, str]:
    """Return exit code, processor time in s and what was said; a run that takes more than `limit` s is broken off."""
    signal.setitimer(signal.ITIMER_PROF, limit)
    begun = time.process_time()
    done = CliRunner().invoke(app, ["simulate", str(path), "--out", str(path.parent / path.stem)])
    seconds, said = time.process_time() - begun, done.stdout + done.stderr
    signal.setitimer(signal.ITIMER_PROF, 0)
    folder = path.parent / path.stem
    if any((folder / name).is_file() for name in ("certificate.json", "refusal.json")):
        checked = CliRunner().invoke(app, ["verify", str(folder)])
        if checked.exit_code:
            said += f"verify ends with {checked.exit_code}: {checked.output}"
    return done.exit_code, seconds, said


def too_long(*_: object) -> None:
    """Break off a run."""
    raise TimeoutError("the run takes too long")


def main() -> None:
    """Print what is wrong, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--keep", type=Path, help="folder for specs and runs, instead of one that is removed")
    options, console = parser.parse_args(), Console(width=160, highlight=False)
    signal.signal(signal.SIGPROF, too_long)
    codes, slowest = Counter[int](), 0.0
    with tempfile.TemporaryDirectory() as removed:
        home = options.keep or Path(removed)
        home.mkdir(parents=True, exist_ok=True)
        times = 0.05 * np.arange(801)
        table = "".join(f"{t!r},{v!r}\n" for t, v in zip(times.tolist(), (0.3 * np.sin(times)).tolist(), strict=True))
        (home / "wanted.csv").write_text("t,y\n" + table)
        for seed in range(options.first, options.first + options.count):
            path = home / f"random{seed}.yaml"
            path.write_text(spec_text(seed))
            code, seconds, said = run_of(path, 120)
            codes[code] += 1
            slowest = max(slowest, seconds)
            if code in (1, 2) or seconds > 10 or "above its bound" in said or "verify ends with" in said:
                console.print(f"{path.name}: {code}, {seconds:.1f} s: {said[-600:].strip()}", markup=False)
            if options.keep:
                (home / f"random{seed}.txt").write_text(f"{code} {seconds:.2f}\n{said}")
    console.print(f"ended with: {dict(sorted(codes.items()))}; the slowest took {slowest:.1f} s")


if __name__ == "__main__":
    main()
