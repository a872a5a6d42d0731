"""The plant of a certificate, and the matrices that proofs speak of."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from .balls import Ball, sides, stacked, zero
from .cells import Cells
from .elements import Elements
from .matrices import AuditFault, Matrix, rank, spend, transposed
from .reading import ball, distinct, place
from .shape import CELLS, by_cell, kind


class AuditedPlant:
    """x' = A_i x + b_i + B u in cell i; y = C x is measured, the tracked rows are to follow a reference.

    Its cells are all listed, or it is written by elements. Then A and b are about the corners of the box of slopes, in
    whose hull all A_i are, and about cells that are named. Rows c with c A_i the same at all corners have c g = 0 for
    what changes by g s there: so c A_i and c b_i are the same in all cells.
    """

    def __init__(self, content: Any, named: Sequence[int] = ()) -> None:
        radius = content["radius"]
        self.B, self.C, self.tracked = (ball(content[name], radius[name]) for name in ("B", "C", "tracked_rows"))
        self.elements = Elements(content) if "elements" in content else None
        if self.elements is None:
            self.cells, self.names = Cells(content), content["cells"]
            self.A, self.b = self.listed(content)
            self.count, self.named = len(self.names), [*range(len(self.names))]
        else:
            if radius["A"] or radius["b"]:
                raise AuditFault("the numbers of elements are exact")
            self.cells, self.names = Cells({"H": [], "h": [], "signs": []}), []
            self.A, self.b = self.elements.fields([*self.elements.corners, *map(self.elements.segments, named)])
            self.count, self.named = self.elements.count, [*named]  # the last of A are theirs
        self.loads: tuple[Ball, Ball] | None = None
        self.seconds = set[int]()  # states of loads that are the second of a sinusoid
        self.seen_A, self.seen_C = self.A, self.C
        if content["loads"] is not None:
            self.estimate(content["loads"])
        n, rows = len(self.B[0]), {len(row) for row in (*self.C[0], *self.tracked[0])}
        ports = {"states": n, "inputs": len(self.B[0][0]) if n else 0, "outputs": len(self.C[0])}
        for name, count in (ports | {"tracked": len(self.tracked[0])}).items():
            distinct(content[name], f"one of the {name}")
            if len(content[name]) != count:
                raise AuditFault(f"there are not as many {name} as names")
        sizes = {(len(X), len(row)) for X, _ in self.A for row in X}
        fits = n and self.A and sizes == {(n, n)} and rows == {n}
        if not fits or any([len(row) for row in X] != [1] * n for X, _ in self.b):
            raise AuditFault("the matrices of the plant do not fit together")

    def listed(self, content: Any) -> tuple[list[Ball], list[Ball]]:
        """Return A_i and b_i of cells that are all listed."""
        radius, cells, (planes, signs) = content["radius"], content["cells"], (self.cells.planes, self.cells.signs)
        lists = [content[name] for name in ("A", "b", "signs")] + [radius[name] for name in ("A", "b") if radius[name]]
        fits = all(len(X) == len(cells) for X in lists) and all(len(row) == len(planes) for row in signs)
        if not fits or any(len(plane) != len(self.B[0]) + 1 for plane in planes):
            raise AuditFault("the matrices of the plant do not fit together")
        if len({plane[:2] for plane in self.cells.parallel}) != len(planes):
            raise AuditFault("two hyperplanes are one")
        A, b = ([ball(X, radius[name] and radius[name][i]) for i, X in enumerate(content[name])] for name in ("A", "b"))
        return A, b

    def name(self, i: int) -> str:
        """Return what a cell is called."""
        return self.names[i] if self.elements is None else self.elements.name(i)

    def placed(self, proof: Any) -> Any:
        """Return a proof of impossibility by the places of matrices in A, not by cells; any other as it is."""
        before = len(self.A) - len(self.named)
        found = {str(before + self.named.index(int(i))): value for i, value in by_cell(proof).items()}
        return proof | {CELLS[kind(proof)]: found} if found else proof

    def estimate(self, content: Any) -> None:
        """Take in the loads E s, s' = S s, that the observer estimates: it runs plant and loads as one system."""
        E, S = (ball(content[name], content["radius"][name]) for name in ("E", "S"))
        n, p = len(self.B[0]), len(S[0])
        if not p or len(E[0]) != n or {len(row) for row in (*E[0], *S[0])} != {p}:
            raise AuditFault("the loads do not fit to the plant")
        self.loads = E, S
        self.seconds = set(range(p)) - {place(k, p) for k in content["where"]}
        if len(content["names"]) != len(content["where"]):
            raise AuditFault("there are not as many loads as names")
        self.seen_A = [stacked(sides(A, E), sides(zero(p, n), S)) for A in self.A]
        self.seen_C = sides(self.C, zero(len(self.C[0]), p))

    def unmatched(self) -> bool:
        """Say whether some load enters where no input does: nothing makes up for it while all of x_d is given."""
        return self.loads is not None and rank(sides(Ball(self.B[0]), Ball(self.loads[0][0]))[0]) != rank(self.B[0])

    def at_inputs(self) -> list[int]:
        """Return the input that each load is added to: all have to be constants there, exactly."""
        found = self.matched()
        if not found:
            raise AuditFault("the loads are no constants at inputs, exactly")
        return found

    def matched(self) -> list[int]:
        """Return the input that each load is added to, if all are constants at inputs, exactly; else none."""
        if self.loads is None:
            return []
        (E, open_E), (S, open_S), (B, open_B) = *self.loads, self.B
        columns, entered = transposed(B), transposed(E)
        exact = not (open_E or open_S or open_B or any(map(any, S)) or rank(B) < len(columns))
        return [columns.index(column) for column in entered] if exact and all(e in columns for e in entered) else []

    def problem(self, of: str, K: Any, L: Any, A_eta: Any) -> tuple[list[Ball], Matrix]:
        """Return the matrices M_i that a proof speaks of, and B where the gain is free (else an empty one)."""
        if of == "plant":
            return [A.T for A in self.A], []
        if of == "generator":
            return [A.T for A in A_eta], []
        A, B, gain = (self.A, self.B, K)
        if of != "controller":
            A, B, gain = [A.T for A in self.seen_A], self.seen_C.T, L
        if gain is None:
            return A, B[0]
        BK = B @ Ball(gain if of == "controller" else transposed(gain))
        return [A_i + BK for A_i in A], []

    def faults(self) -> list[str]:
        """Return where cells overlap, where none is, and where the field jumps."""
        return self.cells.faults(self.jumps) if self.elements is None else []

    def jumps(self, i: int, j: int, plane: list[Fraction]) -> bool:
        """Say whether [A_i b_i] - [A_j b_j] is no g [H h]."""
        pivot = next(p for p, v in enumerate(plane) if v)
        spend(len(plane) ** 2)
        for a, b, c, d in zip(self.A[i][0], self.A[j][0], self.b[i][0], self.b[j][0], strict=True):
            if (a, c) == (b, d):
                continue
            row = [v - w for v, w in zip((*a, *c), (*b, *d), strict=True)]
            if any(v * plane[pivot] != row[pivot] * p for v, p in zip(row, plane, strict=True)):
                return True
        return False


def at_centres(content: Any) -> str:
    """Return what is said of a claim that is decided for the middle of what numbers may be; "" if they are exact."""
    open_ = [content["plant"], *([content["plant"]["loads"]] if content["plant"]["loads"] else [])]
    inexact = any(any(part["radius"].values()) for part in open_)
    return ", at the centres of the balls that its numbers lie in" if inexact else ""
