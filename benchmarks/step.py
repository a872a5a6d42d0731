"""One step of an exported controller against a hand-written dense loop in C and against python-control's.

    make step-bench [STEPS=200000]

The plant is a chain of four masses, eight states, with backlash: three cells. All three run the same controller, that
of `method: emulated`, on the same measurements; before anything is timed their inputs must agree. Each C program times
the same steps several times, in turns with the other, and the best time of each counts. Beside them is the exported
program that predicts and corrects, on measurements of its own loop: another controller, the one of the same plant that
is the default.
"""

import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from pwatrack import load_spec
from pwatrack.arrays import Array
from pwatrack.commands.export import of_spec
from pwatrack.control.program import SampledController
from pwatrack.export.c import FLAGS, write
from pwatrack.export.source import Source

SPEC = """name: Chain of four masses with backlash
system:
  states: [x1, v1, x2, v2, x3, v3, x4, v4]
  inputs: [u]
  outputs: [y1, y4]
  track: [y1]
  A:
    - [0, 1, 0, 0, 0, 0, 0, 0]
    - [-200, -4, 100, 0, 0, 0, 0, 0]
    - [0, 0, 0, 1, 0, 0, 0, 0]
    - [100, 0, -200, -4, 100, 0, 0, 0]
    - [0, 0, 0, 0, 0, 1, 0, 0]
    - [0, 0, 100, 0, -200, -4, 100, 0]
    - [0, 0, 0, 0, 0, 0, 0, 1]
    - [0, 0, 0, 0, 100, 0, -200, -4]
  nonlinearities:
    - {name: play, kind: dead_zone, of: x3 - x4, lower: -0.01, upper: 0.01, slope: 40, into: {v3: -1, v4: 1}}
  B: [[0], [1], [0], [0], [0], [0], [0], [0]]
  C: [[1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 1, 0]]
reference: {output: 0.1*sin(2*t)}
simulation: {duration: 10, sample_time: 0.01, controller: {sample_time: 0.001, method: emulated}}
"""

TIMED = """
#include <stdio.h>
#include <time.h>
#include "vector.h"
{declared}
int main(int count, char **arguments)
{{
    static double u[VECTOR_STEPS];
    struct timespec before, after;
    long k, rounds = {rounds};
    double sum = 0.0;
    int part;
    (void)count; (void)arguments;
    clock_gettime(CLOCK_MONOTONIC, &before);
    for (part = 0; part < rounds; part++) {{
        {begin}
        for (k = 0; k < VECTOR_STEPS; k++) {{
            {step}
        }}
        sum += u[VECTOR_STEPS - 1];
    }}
    clock_gettime(CLOCK_MONOTONIC, &after);
    printf("%.17g\\n", ((after.tv_sec - before.tv_sec) * 1e9 + (after.tv_nsec - before.tv_nsec))
           / ((double)rounds * VECTOR_STEPS));
    for (k = 0; k < VECTOR_STEPS; k++) {{
        printf("%.17g\\n", u[k]);
    }}
    return sum != sum;
}}
"""

DENSE = """
/* As one writes it by hand: the cell by comparisons, then dense products. */
static double z[WIDTH], s[KNOWN], u_held;

static void begin(void)
{
    int k;
    for (k = 0; k < WIDTH; k++) { z[k] = start_z[k]; }
    for (k = 0; k < KNOWN; k++) { s[k] = start_s[k]; }
    z[WIDTH - 1] = 1.0;
    s[KNOWN - 1] = 1.0;
    u_held = 0.0;
}

static double step(const double y[], int first)
{
    double x[N], eta[P], w[S], x_d[N], u;
    int a, b, i, j;
    if (!first) {
        double g = h[0], f = h[1];
        for (a = 0; a < N; a++) { g += H[0][a] * z[Q + 1 + a]; f += H[1][a] * z[Q + 1 + a]; }
        i = CELL(g, f);
        g = 0.0; f = 0.0;
        for (a = 0; a < KNOWN; a++) { g += guards[0][a] * s[a]; f += guards[1][a] * s[a]; }
        j = CELL(g, f);
        for (a = 0; a < N; a++) {
            x[a] = 0.0;
            for (b = 0; b < WIDTH; b++) { x[a] += observer[i][a][b] * z[b]; }
        }
        for (a = 0; a < P; a++) {
            eta[a] = 0.0;
            for (b = 0; b < KNOWN; b++) { eta[a] += generator[j][a][b] * s[b]; }
        }
        for (a = 0; a < S; a++) {
            w[a] = 0.0;
            for (b = 0; b < S; b++) { w[a] += turn[a][b] * s[P + b]; }
        }
        for (a = 0; a < N; a++) { z[Q + 1 + a] = x[a]; }
        for (a = 0; a < P; a++) { s[a] = eta[a]; }
        for (a = 0; a < S; a++) { s[P + a] = w[a]; }
    }
    for (a = 0; a < Q; a++) { z[a] = y[a]; }
    {
        double g = 0.0, f = 0.0;
        for (a = 0; a < KNOWN; a++) { g += guards[0][a] * s[a]; f += guards[1][a] * s[a]; }
        j = CELL(g, f);
    }
    u = 0.0;
    for (b = 0; b < KNOWN; b++) { u += u_ff[j][b] * s[b]; }
    for (a = 0; a < N; a++) {
        x_d[a] = 0.0;
        for (b = 0; b < KNOWN; b++) { x_d[a] += rows_x_d[j][a][b] * s[b]; }
        u += K[a] * (z[Q + 1 + a] - x_d[a]);
    }
    z[Q] = u;
    return u;
}
"""


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def table(name: str, values: Array) -> str:
    """Return an array in C."""
    shape = "".join(f"[{k}]" for k in values.shape)
    text = str(values.tolist()).replace("[", "{").replace("]", "}")
    return f"static const double {name}{shape} = {text};\n"


def dense(program: SampledController, start: Any) -> str:
    """Return the hand-written loop with its tables."""
    of = program.sizes
    n, p, s, q = of["n"], of["p"], of["s"], of["q"]
    assert (of["m"], of["N"], len(program.signs)) == (1, n, 3), "one input, no loads, three cells"
    assert program.follows is not None
    text = f"#define N {n}\n#define P {p}\n#define S {s}\n#define Q {q}\n"
    text += f"#define WIDTH {q + 1 + n + 1}\n#define KNOWN {p + s + 1}\n"
    cell = {tuple(signs): k for k, signs in enumerate(program.signs.tolist())}
    order = [next((k for signs, k in cell.items() if all(v * w >= 0 for v, w in zip(signs, side, strict=True))), 0)
             for side in ((1, 1), (1, -1), (-1, 1), (-1, -1))]  # fmt: skip
    a, b, c, d = order
    text += f"#define CELL(g, f) (((g) >= 0) ? (((f) >= 0) ? {a} : {b}) : (((f) >= 0) ? {c} : {d}))\n"
    arrays = {"H": program.H, "h": program.h, "observer": program.observer, "generator": program.generator}
    arrays |= {"turn": program.follows.turn[0], "guards": program.guards, "u_ff": program.u_ff[:, 0]}
    arrays |= {"rows_x_d": program.x_d, "K": program.K[0]}
    arrays["start_z"] = np.concatenate([np.zeros(q + 1), start.x_hat, [1.0]])
    arrays["start_s"] = np.concatenate([start.eta_hat, program.follows.w0, [1.0]])
    return text + "".join(table(name, values) for name, values in arrays.items()) + DENSE


def with_control(program: SampledController, start: Any, y: Array) -> tuple[float, Array]:
    """Return the seconds that python-control takes for each step of the same controller, and its inputs."""
    import control

    of = program.sizes
    n, p, s, q = of["n"], of["p"], of["s"], of["q"]
    follows = program.follows
    assert follows is not None

    def cell(g: Array, signs: Any) -> int:
        return int(np.argmin(np.maximum(-(signs * g), 0.0).max(axis=1)))

    def parts(state: Array) -> tuple[Array, Array, int]:
        known = np.append(state[n:], 1.0)
        return state[:n], known, cell(program.guards @ known, program.sides)

    def law(state: Array) -> Array:
        x, known, j = parts(state)
        return np.asarray(program.u_ff[j] @ known + program.K @ (x - program.x_d[j] @ known))

    def update(_t: float, state: Array, measured: Array, _params: Any) -> Array:
        x, known, j = parts(state)
        i = cell(program.H @ x + program.h, program.signs)
        seen = np.concatenate([measured, law(state), x, [1.0]])
        return np.concatenate([program.observer[i] @ seen, program.generator[j] @ known, follows.turn[0] @ known[p:-1]])

    system = control.nlsys(
        update, lambda _t, state, _y, _params: law(state), inputs=q, outputs=1, states=n + p + s, dt=True
    )
    first = np.concatenate([start.x_hat, start.eta_hat, follows.w0])
    began = time.perf_counter()
    found = control.input_output_response(system, np.arange(len(y)), y.T, first)
    return (time.perf_counter() - began) / len(y), np.asarray(found.outputs).ravel()


def timed(folder: Path, name: str) -> tuple[float, Array]:
    """Run a program: nanoseconds for each step, and its inputs."""
    said = subprocess.run([folder / f"{name}.exe"], check=True, capture_output=True, text=True).stdout.split()
    return float(said[0]), np.array(said[1:], dtype=np.float64)


def exported(folder: Path, name: str, spec: str) -> tuple[Source, Array]:
    """Export a spec as C into a folder of its name; return the program, and what is measured in its loop."""
    (folder / f"{name}.yaml").write_text(spec, encoding="utf-8")
    subject = of_spec(load_spec(folder / f"{name}.yaml"), steps=2000)
    code = Source(file=subject.file, name=name, single=False, given=False, unproved=subject.unproved)
    (folder / name).mkdir()
    write(code, subject.vector, folder / name)
    return code, subject.vector.y


def compiled(folder: Path, name: str, text: str, include: Path, *, alone: bool = False) -> None:
    """Compile a program that is timed, with the exported one of a folder unless it is alone."""
    (folder / f"{name}.c").write_text("#include <stddef.h>\n" + text, encoding="utf-8")
    flags = FLAGS.replace("-std=c99", "-std=gnu99").replace("-Werror", "").split()
    sources = [] if alone else [str(include / f"{include.name}.c")]
    command = ["gcc", *flags, "-w", "-O2", "-I", str(include), "-o", f"{name}.exe", f"{name}.c", *sources, "-lm"]
    subprocess.run(command, cwd=folder, check=True)


def main(steps: int) -> int:
    """Time all, after the inputs of one controller agree."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        emulated, y = exported(folder, "loop", SPEC)
        exported(folder, "corrected", SPEC.replace(", method: emulated", ""))
        rounds, program, start = max(1, steps // 2000), emulated.program, emulated.file.start
        for name, where in (("ours", "loop"), ("corrected", "corrected")):
            parts = {
                "declared": f'#include "{where}.h"\n',
                "begin": f"{where}_state state; {where}_init(&state);",
                "step": f"{where}_step(&state, vector_y[k], NULL, &u[k]);",
            }
            compiled(folder, name, TIMED.format(rounds=rounds, **parts), folder / where)
        theirs = {"declared": dense(program, start), "begin": "begin();", "step": "u[k] = step(vector_y[k], k == 0);"}
        compiled(folder, "dense", TIMED.format(rounds=rounds, **theirs), folder / "loop", alone=True)
        runs = {name: [timed(folder, name) for _ in range(5)] for name in ("ours", "dense", "corrected")}
        seconds, u_control = with_control(program, start, y)
    u = {name: found[0][1] for name, found in runs.items() if name != "corrected"} | {"python-control": u_control}
    largest = float(np.abs(u["ours"]).max())
    off = {name: float(np.abs(values - u["ours"]).max()) / largest for name, values in u.items()}
    if max(off.values()) > 1e-9:
        say(f"they disagree: {off}")
        return 1
    best = {name: min(found[0] for found in all_) for name, all_ in runs.items()} | {"python-control": seconds * 1e9}
    of = program.sizes
    say(f"n = {of['n']}, {len(program.signs)} cells; inputs agree to {max(off.values()):.1e} of the largest")
    for name, ns in best.items():
        say(f"{name:16} {ns:10.1f} ns a step, {ns / best['ours']:8.2f} times ours")
    return 0


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200_000))
