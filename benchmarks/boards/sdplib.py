"""Programs of SDPLIB: bounds of the optimum from both sides, exact, beside those that VSDP reports.

    python -m benchmarks.boards.sdplib FOLDER-OR-FILES [--vsdp SDPLIB_SYS1.csv] [--seconds 300] [--out runs/boards]

A file (`.dat-s`, SDPA's sparse format) says: minimise cᵀx with X = Σ x_i F_i − F_0 ⪰ 0, and, dual to it, maximise
tr F_0 Y with tr F_i Y = c_i, Y ⪰ 0. Its decimals are taken as they are written. Our form, P and Y under one inequality
for each cell, is not this one, but several blocks with entries at will. So CVXOPT is asked here; iterates before its
last are further inside, and points between the last of these and the very last are tried. The proofs are those of
`pwatrack.rational`:

- from above: x rounded to short decimals; X ≻ 0 is decided in balls, and cᵀx is a fraction;
- from below: Y moved to tr F_i Y = c_i by the least W of √Y W √Y, which changes small eigenvalues little, and then,
  exactly, by a combination of the F_i with fractions; Y ≻ 0 is decided in balls, and tr F_0 Y is a fraction.

A side has no bound where no such point is found: where there is no interior, all points that satisfy everything in
exact numbers lie on a boundary, which rounding misses.
"""

import argparse
import csv
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.boards.limited import machine, run, table
from pwatrack.arrays import EPS, Array
from pwatrack.rational import is_positive_definite, rational

FURTHER = (0.0, 1.0, 10.0)  # that an x is moved inside, beside the X that an iterate should have
NEARER = 3  # times that Y is moved before it is moved exactly
MOST, NEAR = 40, 1e-10  # iterations; tolerances of a solver, which often ends before it is that near
SHARES = (0.0, *(10.0 ** np.arange(-4, 0)), 0.25, 0.5, 1.0)  # of the way from a last iterate to one that is inside
SHORT = 10**18  # x and Y are multiples of its reciprocal
Entry = tuple[int, int, int, Fraction]  # block, row, column ≥ row, value


@dataclass(frozen=True)
class Program:
    """Minimise cᵀx with Σ x_i F_i − F_0 ⪰ 0.

    Attributes:
        c: (m,).
        blocks: Orders of the blocks; what is diagonal is so many blocks of order 1.
        F: Entries of F_0, F_1, …, F_m, on and above the diagonal.
    """

    c: tuple[Fraction, ...]
    blocks: tuple[int, ...]
    F: tuple[tuple[Entry, ...], ...]

    @cached_property
    def starts(self) -> Any:
        """Where each block begins in a vector of upper triangles, column by column, and their end."""
        return np.cumsum([0, *(n * (n + 1) // 2 for n in self.blocks)])

    def place(self, block: int, row: int, column: int) -> int:
        """Return where an entry is in that vector."""
        return int(self.starts[block]) + column * (column + 1) // 2 + row


@dataclass(frozen=True)
class Iterate:
    """Where a solver is: its word for it, its number, cᵀx, x, and Y and S as vectors of upper triangles."""

    word: str
    number: int
    value: float
    x: Array
    Y: Array
    S: Array


def read(path: Path) -> Program:
    r"""Return the program of a file; a ValueError names what is amiss.

    Example: one variable, a block of order 2 and a diagonal one.

        >>> from tempfile import mkdtemp
        >>> file = Path(mkdtemp()) / "a.dat-s"
        >>> _ = file.write_text('"a comment\n1\n2\n{2, -1}\n0.5\n0 1 1 2 1\n1 1 1 1 1\n1 2 1 1 3e-1\n')
        >>> found = read(file)
        >>> found.blocks, found.c, found.F[1][1]
        ((2, 1), (Fraction(1, 2),), (1, 0, 0, Fraction(3, 10)))
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if line.strip() and line.lstrip()[0] not in '"*']
    try:
        m, orders = int(_words(lines[0])[0]), [int(v) for v in _words(lines[2])]
        c = tuple(Fraction(v) for v in _words(lines[3]))
        first = np.cumsum([0, *(1 if n > 0 else -n for n in orders)]).tolist()
        F: list[list[Entry]] = [[] for _ in range(m + 1)]
        for line in lines[4:]:
            words = _words(line)
            k, block, row, column = (int(v) for v in words[:4])
            row, column = sorted((row - 1, column - 1))
            value, whole = Fraction(words[4]), orders[block - 1] > 0
            F[k].append((first[block - 1], row, column, value) if whole else (first[block - 1] + row, 0, 0, value))
    except (IndexError, ValueError, ZeroDivisionError) as error:
        raise ValueError(f"{path}: no program of SDPA's sparse format: {error}") from None
    if len(c) != m or len(orders) != int(_words(lines[1])[0]):
        raise ValueError(
            f"{path}: {m} variables and {lines[1].strip()} blocks, but {len(c)} and {len(orders)} are given"
        )
    blocks = [n for order in orders for n in ([order] if order > 0 else [1] * -order)]
    return Program(c, tuple(blocks), tuple(tuple(e for e in entries if e[3]) for entries in F))


def _words(line: str) -> list[str]:
    return line.translate(str.maketrans(",(){}", "     ")).split()


class Sides:
    """Both sides of one program."""

    def __init__(self, program: Program) -> None:
        from cvxopt import matrix, spmatrix

        self.program, m = program, len(program.c)
        self.c = matrix([float(v) for v in program.c])
        self.G, self.h = [], []
        for block, n in enumerate(program.blocks):
            entries = [(k, *e[1:]) for k, F in enumerate(program.F) for e in F if e[0] == block]
            both = [(k, j, i, v) for k, i, j, v in entries if i != j] + entries
            left = [(-float(v), i + n * j, k - 1) for k, i, j, v in both if k]
            self.G.append(
                spmatrix(*map(list, zip(*left, strict=True)), (n * n, m)) if left else spmatrix([], [], [], (n * n, m))
            )
            right = matrix(0.0, (n, n))
            for k, i, j, v in both:
                if not k:
                    right[i, j] = -float(v)
            self.h.append(right)
        self.last = self.after(MOST)
        self.unit = max(1.0, abs(self.last.value))

    def after(self, iterations: int) -> "Iterate":
        """Return where CVXOPT is after so many iterations, or where it ended before."""
        from cvxopt import solvers

        options = {"show_progress": False, "maxiters": iterations, "feastol": NEAR, "abstol": NEAR, "reltol": NEAR}
        try:
            found = solvers.sdp(self.c, Gs=self.G, hs=self.h, options=options)
        except (ArithmeticError, ValueError):  # it got stuck in the last of them
            return self.after(iterations - 1)
        if found["x"] is None or found["zs"] is None:  # it says that there is no x, or that cᵀx has no bound
            return Iterate(found["status"], 0, np.nan, np.zeros(len(self.c)), np.zeros(0), np.zeros(0))
        Y, S = (self.upper(found[name]) for name in ("zs", "ss"))
        value = float(found["primal objective"] or 0.0)
        return Iterate(found["status"], int(found["iterations"]), value, np.array(found["x"]).ravel(), Y, S)

    def upper(self, blocks: Sequence[Any]) -> Array:
        """Return lower triangles of matrices of CVXOPT as a vector of upper ones."""
        Y = np.zeros(int(self.program.starts[-1]))
        for block, (n, Z) in enumerate(zip(self.program.blocks, blocks, strict=True)):
            whole = np.array(Z).reshape(n, n, order="F")
            whole = np.tril(whole) + np.tril(whole, -1).T
            for j in range(n):
                Y[self.program.place(block, 0, j) : self.program.place(block, j, j) + 1] = whole[: j + 1, j]
        return Y

    def bounds(self) -> tuple[Fraction | None, Fraction | None]:
        """Return exact bounds from below and above, from the last iterates that are inside and those after them."""
        below = above = moved = None
        for number in range(self.last.number, 0, -1):
            at = self.last if number == self.last.number else self.after(number)
            below = self.nearer(at.Y, self.last.Y, self.below) if below is None else below
            above = self.nearer(at.x, self.last.x, self.above) if above is None else above
            for further in FURTHER if moved is None and above is None else ():
                moved = moved or self.nearer(self.inward(at, further), self.last.x, self.above)
            if below is not None and above is not None:
                break
        return below, min((value for value in (above, moved) if value is not None), default=None)

    def nearer(self, inside: Array, best: Array, bound: Callable[[Array], Fraction | None]) -> Fraction | None:
        """Return the bound of the point nearest to the best one, on the way there from one inside, if that has one."""
        found = bound(inside)
        if found is not None:
            nearer = (bound(best + share * (inside - best)) for share in SHARES)
            found = next((value for value in nearer if value is not None), found)
        return found

    def inward(self, at: "Iterate", further: float) -> Array:
        """Return an x near an iterate whose X is as nearly (1 + further) S as can be, S what it should be.

        X of the iterate itself is S but for a residual, which may be more than the least eigenvalue of S.
        """
        roots = [np.asarray(np.linalg.pinv(root), dtype=np.float64) for root in self.roots(at.S)]
        unit, wanted = np.sqrt(self.weights), (1 + further) * at.S - at.x @ self.plain - self.upper(self.h)
        A = self.turned(self.plain, roots) * unit
        scale = 1 / np.maximum(np.linalg.norm(A, axis=1), 1e-300)
        step = np.linalg.lstsq((scale[:, None] * A).T, self.turned(wanted[None], roots)[0] * unit, rcond=EPS)[0]
        return np.asarray(at.x + scale * step)

    def above(self, x: Array) -> Fraction | None:
        """Return cᵀx if X ≻ 0, else None."""
        exact = short(x)
        if not self.inside(self.combined([Fraction(-1), *exact])):
            return None
        return sum((c * v for c, v in zip(self.program.c, exact, strict=True)), Fraction(0))

    def below(self, Y: Array) -> Fraction | None:
        """Return tr F_0 Y of the Y with tr F_i Y = c_i that is nearest, if it is positive definite, else None."""
        exact = self.moved(Y)
        return self.product(self.program.F[0], exact) if exact is not None and self.inside(exact) else None

    def moved(self, near: Array) -> list[Fraction] | None:
        """Return a Y with tr F_i Y = c_i exactly, near one that misses it; None where the F_i depend on each other."""
        Y, roots, unit = short(near), self.roots(near), np.sqrt(self.weights)
        A = self.turned(self.plain, roots) * unit
        scale = 1 / np.maximum(np.linalg.norm(A, axis=1), 1e-300)
        for _ in range(NEARER):
            rest = scale * np.array([float(v) for v in self.missed(Y)])
            found = np.linalg.lstsq(scale[:, None] * A, rest, rcond=EPS)[0] / unit
            Y = [y + step for y, step in zip(Y, short(self.turned(found[None], roots)[0]), strict=True)]
        rest = self.missed(Y)
        try:
            exact = self.gram.solve(rational([[r] for r in rest], (len(rest), 1)))
        except ZeroDivisionError:
            return None
        steps = self.combined([Fraction(0), *(Fraction(int(v.p), int(v.q)) for v in exact.entries())])
        return [y + s for y, s in zip(Y, steps, strict=True)]

    def missed(self, Y: Sequence[Fraction]) -> list[Fraction]:
        """Return c_i − tr F_i Y, exactly."""
        return [c - self.product(F, Y) for c, F in zip(self.program.c, self.program.F[1:], strict=True)]

    @cached_property
    def plain(self) -> Array:
        """F_1 to F_m as vectors of upper triangles, (m, …)."""
        found = np.zeros((len(self.program.c), int(self.program.starts[-1])))
        for row, F in zip(found, self.program.F[1:], strict=True):
            for block, j, k, value in F:
                row[self.program.place(block, j, k)] = float(value)
        return found

    @cached_property
    def weights(self) -> Array:
        """How often each entry of an upper triangle is in its matrix."""
        found = np.full(int(self.program.starts[-1]), 2.0)
        for block, n in enumerate(self.program.blocks):
            found[[self.program.place(block, k, k) for k in range(n)]] = 1.0
        return found

    def roots(self, Y: Array) -> list[Array]:
        """Return the root of each block of Y, what is negative in it left out."""
        found = []
        for whole in self.wholes(Y[None]):
            values, Q = np.linalg.eigh(whole[0])
            found.append((Q * np.sqrt(np.maximum(values, 0.0))) @ Q.T)
        return found

    def wholes(self, X: Array) -> Iterator[Array]:
        """Yield the matrices of each block, (k, n, n), of vectors of upper triangles, (k, …)."""
        for block, n in enumerate(self.program.blocks):
            whole, (k, j) = np.zeros((len(X), n, n)), np.tril_indices(n)
            whole[:, j, k] = whole[:, k, j] = X[:, slice(*self.program.starts[block : block + 2])]
            yield whole

    def turned(self, X: Array, roots: Sequence[Array]) -> Array:
        """Return root X root of each of the vectors X, (k, …), likewise."""
        parts = []
        for whole, root in zip(self.wholes(X), roots, strict=True):
            k, j = np.tril_indices(len(root))
            parts.append((root @ whole @ root)[:, j, k])
        return np.concatenate(parts, axis=1)

    @cached_property
    def gram(self) -> Any:
        """All tr F_i F_j, exactly."""
        rows = [{self.program.place(*e[:3]): e[3] * (1 if e[1] == e[2] else 2) for e in F} for F in self.program.F[1:]]
        plain = [[(self.program.place(*e[:3]), e[3]) for e in F] for F in self.program.F[1:]]
        m = len(rows)
        entries = [[sum((row[p] * v for p, v in other if p in row), Fraction(0)) for other in plain] for row in rows]
        return rational(entries, (m, m))

    def combined(self, factors: Sequence[Fraction]) -> list[Fraction]:
        """Return Σ factor_k F_k, k from 0, as a vector of upper triangles."""
        found = [Fraction(0)] * int(self.program.starts[-1])
        for factor, F in zip(factors, self.program.F, strict=True):
            for block, row, column, value in F if factor else ():
                found[self.program.place(block, row, column)] += factor * value
        return found

    def product(self, F: Sequence[Entry], Y: Sequence[Fraction]) -> Fraction:
        """Return tr F Y."""
        terms = (e[3] * Y[self.program.place(*e[:3])] * (1 if e[1] == e[2] else 2) for e in F)
        return sum(terms, Fraction(0))

    def inside(self, X: Sequence[Fraction]) -> bool:
        """Decide whether all blocks are positive definite."""
        for block, n in enumerate(self.program.blocks):
            upper = [[X[self.program.place(block, min(j, k), max(j, k))] for k in range(n)] for j in range(n)]
            if not is_positive_definite(rational(upper, (n, n))):
                return False
        return True


def short(values: Array) -> list[Fraction]:
    """Return short decimals near these numbers."""
    return [Fraction(round(Fraction(v) * SHORT), SHORT) for v in values.tolist()]


def bounded(path: Path) -> dict[str, Any]:
    """Return what is found of a file, as a mapping of numbers and texts."""
    began = time.process_time()
    sides = Sides(read(path))
    below, above = sides.bounds()
    found = {"word": sides.last.word, "value": sides.last.value, "seconds": time.process_time() - began}
    found |= {"below": None if below is None else float(below), "above": None if above is None else float(above)}
    return found | ({"apart": float(above - below) / sides.unit} if above is not None and below is not None else {})


def theirs(path: Path | None) -> dict[str, str]:
    """Return which solvers have bounds from both sides in VSDP's table, with their best difference, by program."""
    if path is None:
        return {}
    found = dict[str, list[tuple[float, str]]]()
    with path.open(newline="", encoding="utf-8") as lines:
        for row in csv.DictReader(lines):
            both = found.setdefault(row["name"], [])
            apart = float(row["mu_fU_fL"])
            if np.isfinite(apart):
                both.append((apart, row["sname"]))
    return {name: f"{min(both)[0]:.0e} ({len(both)} of 4)" if both else "none of 4" for name, both in found.items()}


def rows(paths: Sequence[Path], vsdp: dict[str, str], seconds: float, gibibytes: float) -> Iterator[list[str]]:
    """Yield a row of the table for each file, each in a process of its own."""
    for path in paths:
        code = f"from benchmarks.boards import sdplib; sdplib.alone({str(path)!r})"
        ended = run([sys.executable, "-c", code], seconds=seconds, gibibytes=gibibytes)
        name = path.name.split(".")[0]
        if ended.code:
            what = "no time left" if ended.stopped else (ended.text.strip().splitlines() or ["no memory left"])[-1][:80]
            yield [name, what, *["–"] * 3, vsdp.get(name, "–"), f"{ended.seconds:.1f}"]
            continue
        found = json.loads(ended.text.splitlines()[-1])
        sides = (f"{found[s]:.9g}" if found[s] is not None else "none" for s in ("below", "above"))
        apart = f"{found['apart']:.0e}" if "apart" in found else "–"
        yield [
            name,
            f"{found['value']:.9g}, {found['word']}",
            *sides,
            apart,
            vsdp.get(name, "–"),
            f"{found['seconds']:.1f}",
        ]


def alone(path: str) -> None:
    """Print what `rows` reads."""
    sys.stdout.write(json.dumps(bounded(Path(path))) + "\n")


def main() -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, help="files, or folders of them")
    parser.add_argument("--vsdp", type=Path, help="VSDP's table of SDPLIB, as CSV")
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--gibibytes", type=float, default=4.0)
    parser.add_argument("--out", type=Path, default=Path("runs/boards"))
    given = parser.parse_args()
    parts = [sorted(path.glob("*.dat-s")) if path.is_dir() else [path] for path in given.paths]
    found = list[list[str]]()
    for row in rows([path for part in parts for path in part], theirs(given.vsdp), given.seconds, given.gibibytes):
        sys.stderr.write("  ".join(row) + "\n")
        found.append(row)
    columns = ["program", "CVXOPT", "from below", "from above", "apart", "VSDP apart", "s"]
    text = table(f"SDPLIB, {machine()}", columns, found)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "sdplib.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
