"""Random plants that are not minimum phase: is the bounded solution one, and does the closed loop follow it?

    python -m benchmarks.preview [plants]

Each has one to four unstable zeros between 0.1 and 2,000 rad/s, up to two stable ones, two cells, and a reference that
is periodic or goes from rest to rest. Printed: the residual of (15) relative to its terms, and the largest
|y − y_d| of the simulated closed loop from x_d(0), relative to the reference; the worst of all, and what was refused.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console

from pwatrack import design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.errors import PwatrackError
from tests.plants import saddle


def spec_text(seed: int) -> str:
    """Return a spec with states (y, η): η' = A_i η + g y, y' = a y + c η + u."""
    random = np.random.default_rng(seed)
    zeros, first, bend, h = saddle(random, 2)
    p = len(zeros)
    fast = float(np.abs(zeros).max())
    A = np.zeros((p + 1, p + 1))
    A[0], A[1:, 0], A[1:, 1:] = random.normal(size=p + 1) * fast, random.normal(size=p) * fast, first
    kink = np.concatenate([[0.0], bend])
    speed = 10 ** random.uniform(-0.5, 1.0)
    wave = f'"sin({speed:.6g}*t) + 0.3*cos({2 * speed:.6g}*t)"'
    rest = f"{{step: {{size: 1, at: {5 / speed:.6g}, smooth: {2 / speed:.6g}}}}}"
    names = ["y"] + [f"eta{k}" for k in range(p)]
    edge = " + ".join(f"({v:.17g})*{name}" for v, name in zip(h, names[1:], strict=True))
    into = ", ".join(f"{name}: {v:.17g}" for name, v in zip(names, kink, strict=True) if v)
    return f"""name: plant {seed}
system:
  states: [{", ".join(names)}]
  inputs: [u]
  outputs: [{", ".join(f"m_{name}" for name in names)}]
  track: [m_y]
  A: {rows(A)}
  B: [[1]{", [0]" * p}]
  C: {rows(np.eye(p + 1))}
  nonlinearities:
    - {{name: kink, kind: spring, of: "{edge}", start: {0.3 * abs(random.normal()):.6g}, slope: 1, into: {{{into}}}}}
reference: {{output: {wave if seed % 2 else rest}}}
simulation: {{duration: {15 / speed:.6g}, sample_time: {0.01 / speed:.6g}}}
"""


def rows(X: Array) -> str:
    """Return a matrix as YAML."""
    return "[" + ", ".join("[" + ", ".join(f"{v:.17g}" for v in row) + "]" for row in X) + "]"


def main(count: int) -> None:
    """Print the figures."""
    console, residuals, errors, refused = Console(), list[float](), list[float](), list[str]()
    with TemporaryDirectory() as folder:
        for seed in range(count):
            path = Path(folder) / f"{seed}.yaml"
            path.write_text(spec_text(seed), encoding="utf-8")
            try:
                spec = load_spec(path)
                controller = design(spec)
                trajectory = controller.trajectory
                x_d = trajectory.state(np.append(trajectory.exosystem.w0, 1.0))
                start = replace(spec.scenario.initial, plant=x_d, observer=x_d)
                result = simulate(replace(spec, scenario=replace(spec.scenario, initial=start)), controller)
            except PwatrackError as refusal:
                refused.append(f"{seed}: {refusal.problems[0].message[:150]}")
                continue
            preview = result.controller.trajectory.preview
            assert preview is not None
            residuals.append(float((preview.residual / preview.terms).max()))
            errors.append(float(np.abs(result.response.tracking_error).max()))
            console.print(f"{seed:4d}  residual {residuals[-1]:.1e}  largest error {errors[-1]:.1e}")
    console.print(f"{len(errors)} of {count} designed and simulated")
    console.print(f"worst residual {max(residuals):.1e} of the terms of (15), median {np.median(residuals):.1e}")
    console.print(f"worst |y − y_d| at any time {max(errors):.1e} of a reference of 1, median {np.median(errors):.1e}")
    console.print(*refused, sep="\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
