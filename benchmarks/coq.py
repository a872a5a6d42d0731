"""What Coq checks: all certificates of a folder of runs, changed numbers, and how long a large one takes.

    make coq
    python -m benchmarks.coq runs                (every certificate.json below it)
    python -m benchmarks.coq --changed 200       (of the paper's example: the kernel against minors in fractions)
    python -m benchmarks.coq --size 20 64        (states, cells: random numbers of 60 bits)

Changed is one number of A, B, C, K, L, P, Q or a rate in each: what the kernel computes has to be what another method
finds, all leading minors of the same matrices by FLINT. Whether a continuous plant has the changed numbers is for
the auditor to decide, not looked at here.
"""

import argparse
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from copy import deepcopy
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.errors import InvalidSpec
from pwatrack.export.coq import RUN, THEORY, development, inverse, literal
from pwatrack.export.source import prefix
from pwatrack.lmi.audit.reading import parsed
from pwatrack.report.files import write_design
from tests.coq_numbers import gains_hold, observer_holds, written

COQC = shutil.which("coqc") or "coqc"
_EXAMPLE = Path("specs/two_mass_backlash.yaml")


def compiled(folder: Path, content: Any, name: str) -> float:
    """Write a development, compile its theory if that is not yet done, and return how long that took."""
    begin = time.perf_counter()
    for file, text in development(content, name).items():
        if file == f"{RUN}.v" or not (folder / file).is_file():
            (folder / file).write_text(text, encoding="utf-8")
    for part in THEORY:
        if not (folder / f"{part}.vo").is_file():
            subprocess.run([COQC, f"{part}.v"], cwd=folder, check=True)
    return time.perf_counter() - begin


def example(folder: Path) -> Any:
    """Return the certificate of the paper's example."""
    spec = load_spec(_EXAMPLE)
    made = write_design(spec, design(spec), folder / "run")
    return parsed((made / "certificate.json").read_text(encoding="utf-8"))


def runs(folder: Path, where: Path, console: Console) -> int:
    """Print a line for each certificate, and return how many were not accepted."""
    refused = 0
    for file in sorted(where.rglob("certificate.json")):
        name, content = file.parent.name, parsed(file.read_text(encoding="utf-8"))
        try:
            theory = compiled(folder, content, prefix(name))
        except InvalidSpec as error:
            console.print(f"{name:30} left out: {error}")
            continue
        begin = time.perf_counter()
        done = subprocess.run([COQC, f"{RUN}.v"], cwd=folder, capture_output=True, text=True, check=False)
        took = time.perf_counter() - begin
        found = re.findall(r"Theorem \w+_(\w+) :", (folder / f"{RUN}.v").read_text(encoding="utf-8"))
        theorems = " and ".join(found) or "inequalities alone"
        first = f", after {theory:.1f} s for the theory" if theory > 1 else ""
        said = f"accepted: {theorems}" if not done.returncode else f"REFUSED: {done.stderr.strip()[:200]}"
        console.print(f"{name:30} {said}, {took:.1f} s{first}")
        refused += done.returncode != 0
    return refused


def changed(folder: Path, count: int, console: Console) -> int:
    """Change one number each, and return how often the kernel and the minors disagree."""
    content = example(folder) | {"generator": None}
    compiled(folder, content, "example")
    lines = ["From Bignums Require Import BigZ.", f"Require Import {' '.join(THEORY)}."]
    expected, draw = list[bool](), random.Random(1)  # noqa: S311
    for k in range(count):
        text = development(_one_changed(content, draw), "example")[f"{RUN}.v"]
        found = written(text)
        expected += [gains_hold(found), observer_holds(found)]
        body = text.split("Open Scope list_scope.")[1].split("\n", 1)[1].split("Open Scope R_scope.")[0]
        body = re.sub(r"Lemma (controller|observer) : (.*) = true\.\nProof.*", r"Eval vm_compute in (\2).", body)
        lines += [f"Module M{k}.", "From Coq Require Import List. Import ListNotations.", "Open Scope bigZ_scope."]
        lines += ["Open Scope list_scope.", body, f"End M{k}."]
    (folder / "Changed.v").write_text("\n".join(lines), encoding="utf-8")
    out = subprocess.run([COQC, "Changed.v"], cwd=folder, capture_output=True, text=True, check=True).stdout
    told = [word == "true" for word in re.findall(r"= (true|false)", out)]
    differ = sum(int(a != b) for a, b in zip(told, expected, strict=True))
    whole = sum(a and b for a, b in zip(told[::2], told[1::2], strict=True))
    console.print(
        f"{count} changed certificates: (8) and (9) hold in {whole} all the same, {count - whole} are refused"
    )
    console.print(f"{differ} of {2 * count} inequalities differ from the minors")
    return differ


def _one_changed(content: Any, draw: random.Random) -> Any:
    """Return a certificate with one number changed: a little, much, or in its sign."""
    content = deepcopy(content)
    plant, proof = content["plant"], draw.choice([p for p in content["proofs"] if p["of"] != "generator"])
    place: Any
    match draw.choice("ABCKLPPPr"):
        case "A":
            place = draw.choice(draw.choice(plant["A"]))
        case "B" | "C" as name:
            place = draw.choice(plant[name])
        case "K" | "L" as name:
            place = draw.choice(content[name])
        case "P":
            P = proof["P"]["integers"]
            i, j = draw.randrange(len(P)), draw.randrange(len(P))
            P[i][j] = P[j][i] = int(P[i][j] * draw.choice([-1, 2, 1.1, 0.9]) + draw.choice([-1, 0, 1]))
            return content
        case _:
            proof["rate"] = f"{float(proof['rate']) * draw.choice([0.5, 1.01, 2, 10]):.9f}".rstrip("0")
            return content
    k = draw.randrange(len(place))
    value = float(place[k]) * draw.choice([-1, 2, 1.1, 0.9]) + draw.choice([0, 0.1, -0.1])
    place[k] = f"{value:.9f}".rstrip("0").rstrip(".") if round(value, 9) else "0"
    return content


def size(folder: Path, n: int, cells: int, console: Console) -> int:
    """Time the matrix half of (8) for random numbers of 60 bits."""
    random_ = np.random.default_rng(1)
    X = random_.standard_normal((n, n))
    P = np.round((X @ X.T / n + np.eye(n)) * 2**50).astype(object)
    form = [[int(v) for v in row] for row in P]
    W, d = inverse(form)
    D = 2**60
    A = [_stable(P.astype(float) / 2**50, random_, D) for _ in range(cells)]
    name = "Large.v"
    text = ["From Coq Require Import List.", "From Bignums Require Import BigZ.", f"Require Import {' '.join(THEORY)}."]
    text += ["Import ListNotations. Open Scope bigZ_scope. Open Scope list_scope."]
    for symbol, value in (("A", A), ("P", form), ("W", W)):
        text.append(f"Definition {symbol} := {literal(value)}.")
    text.append(f"Time Eval vm_compute in (controller_proved {n} {D} 0 A [] [] P W {d}).")
    (folder / name).write_text("\n".join(text), encoding="utf-8")
    begin = time.perf_counter()
    done = subprocess.run([COQC, name], cwd=folder, capture_output=True, text=True, check=False)
    said = " ".join(done.stdout.split()) or done.stderr[:300]
    console.print(f"({n}, {cells}): {said}; {time.perf_counter() - begin:.1f} s in all")
    return "= true" not in done.stdout


def _stable(P: Array, random_: np.random.Generator, D: int) -> list[list[int]]:
    """Return A D for a random A with A P + P A^T < 0."""
    n = len(P)
    X, Y = random_.standard_normal((2, n, n))
    A = np.linalg.solve(P, (-(X @ X.T / n + np.eye(n)) / 2 + (Y - Y.T)).T).T
    return [[round(Fraction(float(v)) * D) for v in row] for row in A]


def main(arguments: argparse.Namespace) -> int:
    """Do what is asked for, and return how much of it failed."""
    console = Console(width=140)
    if shutil.which(COQC) is None:
        console.print("There is no coqc here: it is left out (Debian: apt install coq libcoq-bignums)")
        return 0
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if arguments.runs:
            failed += runs(folder, arguments.runs, console)
        if arguments.changed:
            failed += changed(folder, arguments.changed, console)
        if arguments.size:
            compiled(folder, example(folder), "example")
            n, cells = arguments.size
            failed += size(folder, n, cells, console)
    return failed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="?", type=Path)
    parser.add_argument("--changed", type=int)
    parser.add_argument("--size", type=int, nargs=2)
    sys.exit(bool(main(parser.parse_args())))
