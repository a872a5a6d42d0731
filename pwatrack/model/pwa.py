"""Continuous piecewise affine systems, eq. (1)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.arrays import Array, number_text, readonly
from pwatrack.ball_matrix import BallMatrix, each, places, stack
from pwatrack.ball_matrix import beside as sides
from pwatrack.errors import OutsideTheory, Problem, ProblemPart, Remedy, Way
from pwatrack.model.cells import Partition
from pwatrack.model.contact import Contact
from pwatrack.model.continuity import Discontinuity, Discontinuous, Repair, repaired
from pwatrack.model.loads import Loads
from pwatrack.model.nonlinearity import Nonlinearity, ScalarForm
from pwatrack.rational import beside, on_entries

_ONE_BEND = 1e-9  # of the largest entry of two A: what their difference is more than g Hᵀ, and counts as rounding
ROUNDING = 1e-12  # of the terms of a row at a facet: a jump up to this is one of the data's own rounding


@dataclass(frozen=True, kw_only=True)
class Matrices:
    """A_i, b_i, B, C and the tracked rows as written: exactly, or with a ball around each irrational entry."""

    A: tuple[BallMatrix, ...]  # (n, n), one per cell
    b: tuple[BallMatrix, ...]  # (n, 1), likewise
    B: BallMatrix  # (n, m)
    C: BallMatrix  # (q, n)
    tracked: BallMatrix  # what is to follow a reference, (p, n)

    @property
    def exact(self) -> bool:
        """Whether no entry is irrational."""
        return all(X.radius is None for X in (*self.A, *self.b, self.B, self.C, self.tracked))


@dataclass(frozen=True, kw_only=True)
class Observed:
    """What an observer runs: the plant, or the plant and its loads as one system."""

    A: tuple[BallMatrix, ...]  # (N, N), one per cell
    C: BallMatrix  # (q, N)


@dataclass(frozen=True, kw_only=True)
class PWASystem:
    """The system ẋ = A_i x + b_i + B u for x ∈ Λ_i: eq. (1), with two outputs.

    y = C x is what is measured, for the observer (9). What follows a reference, in (11)–(17), are other linear forms
    of the state, or the same: neither needs to be part of the other.

    An instance is continuous and its cells cover ℝⁿ: `create` proves both.

    Example: a mass against a one-sided spring of stiffness 4.

        >>> contact = PWASystem.create(
        ...     partition=Partition.create(H=[[1.0, 0.0]], h=[0.0], signs=[[-1], [1]], names=["free", "touching"]),
        ...     A=[[[0, 1], [-1, -1]], [[0, 1], [-5, -1]]], b=[[0, 0], [0, 0]], B=[[0], [1]], C=[[1, 0]])
        >>> contact.field(np.array([0.5, 0.0]), np.array([0.0])).tolist()
        [0.0, -2.5]
    """

    partition: Partition  # the l cells in ℝⁿ
    exact: Matrices  # A_i, b_i, B, C and the tracked rows: the numbers that proofs are about
    states: tuple[str, ...]  # names, for reports
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    tracked_names: tuple[str, ...]  # one that is the name of an output is that output
    repair: Repair | None = None  # by how much these differ from those given, which jump at a facet by rounding
    loads: Loads | None = None  # unknown loads E s that act on it beside these, where an observer shall estimate some
    written: ScalarForm | None = None  # the field as a sum of scalar elements, where it was written so
    elements: tuple[Nonlinearity | Contact, ...] = ()  # as it was written, where it was written with any
    watched: "PWASystem | None" = None  # that of which this one has merged cells, where the observer runs it
    remarks: tuple[str, ...] = ()  # what was noticed while it was built, and changes nothing

    @classmethod
    def create(
        cls,
        *,
        partition: Partition,
        A: Any,
        b: Any,
        B: object,
        C: object,
        tracked: object = None,
        states: Sequence[str] = (),
        inputs: Sequence[str] = (),
        outputs: Sequence[str] = (),
        tracked_names: Sequence[str] = (),
        tolerance: float = ROUNDING,
        continuous: bool = False,
    ) -> "PWASystem":
        """Build the system and prove that it belongs to the class of eq. (1).

        A, b, B, C and what is tracked (None: all that is measured) are nested sequences or arrays of `Real`, fractions,
        or doubles, which count as the decimals that they print as; or `BallMatrix`, b_i as a column. A jump of a row of
        the field across a facet up to the tolerance, of the terms of that row at a point of the facet of typical size,
        is taken for rounding, and repaired. What is `continuous` by construction is not decided again.

        Raises ValueError if the shapes do not fit; OutsideTheory if cells overlap or leave a hole, or the field jumps.
        """
        n, cells = partition.H.shape[1], len(partition.names)
        partition.check()
        for name, values in (("A", A), ("b", b)):
            if len(values) != cells:
                raise ValueError(f"{name} has {len(values)} matrices, expected {cells}, one per cell")
        given = [_matrix(rows, (n, n), "A") for rows in A]
        columns = (v if isinstance(v, BallMatrix) else [[entry] for entry in v] for v in b)
        offsets = [_matrix(column, (n, 1), "b") for column in columns]
        measured = _matrix(C, (None, n), "C")
        empty = partition.empty_cells
        kept = sorted(set(range(cells)).difference(empty))
        exact = Matrices(
            A=tuple(given[i] for i in kept),
            b=tuple(offsets[i] for i in kept),
            B=_matrix(B, (n, None), "B"),
            C=measured,
            tracked=measured if tracked is None else _matrix(tracked, (None, n), "tracked"),
        )
        named = tuple(outputs) or _numbered("y", measured.shape[0])
        own = named if exact.tracked is measured else _numbered("w", exact.tracked.shape[0])
        left_out = (f"cell '{partition.names[i]}' has no interior and is left out" for i in empty)
        system = cls(
            partition=partition.without(set(empty)) if empty else partition,
            exact=exact,
            states=tuple(states) or _numbered("x", n),
            inputs=tuple(inputs) or _numbered("u", exact.B.shape[1]),
            outputs=named,
            tracked_names=tuple(tracked_names) or own,
            remarks=(*partition.remarks, *left_out),
        )
        return system if continuous else system._continuous(tolerance)

    @cached_property
    def A(self) -> Array:
        """A_i, (l, n, n), in 1/s times the units of the states; the doubles nearest to `exact`, as are all these."""
        return stack(self.exact.A)

    @cached_property
    def b(self) -> Array:
        """b_i, (l, n)."""
        return stack(self.exact.b)[:, :, 0]

    @property
    def B(self) -> Array:
        """Of the inputs, (n, m)."""
        return self.exact.B.floats

    @property
    def C(self) -> Array:
        """What is measured, (q, n)."""
        return self.exact.C.floats

    @property
    def tracked(self) -> Array:
        """What is to follow a reference, (p, n)."""
        return self.exact.tracked.floats

    @property
    def model(self) -> "PWASystem":
        """What the observer runs, but for its loads."""
        return self.watched or self

    @cached_property
    def hull(self) -> tuple[int, ...]:
        """Cells that have the A_i of all cells in their hull, exactly: what is affine in A_i and holds there holds."""
        written, A = self.written, self.exact.A
        cells = written.corners if written is not None and written.product else range(len(A))
        return tuple(cells[k] for k in places([A[i] for i in cells]))

    @cached_property
    def observed(self) -> Observed:
        """What the observer runs, as matrices."""
        A, C, loads = self.model.exact.A, self.exact.C, self.loads
        if loads is None:
            return Observed(A=A, C=C)
        shape = C.shape[0], loads.E.shape[1]
        return Observed(A=tuple(each(loads.observed, A)), C=sides(C, BallMatrix.of(np.zeros(shape), shape)))

    @cached_property
    def load_inputs(self) -> tuple[int, ...]:
        """The input that each load is added to, if all are constants at inputs; else none."""
        return () if self.loads is None else self.loads.inputs(self.exact.B) or ()

    @property
    def cell_names(self) -> tuple[str, ...]:
        """Names of the l cells."""
        return self.partition.names

    def field(self, x: Array, u: Array) -> Array:
        """Return ẋ (n,) at state x (n,) under input u (m,): eq. (1)."""
        i = self.partition.locate(x)
        result: Array = self.A[i] @ x + self.b[i] + self.B @ u
        return result

    def hyperplane_text(self, k: int) -> str:
        """Return hyperplane k as an equation in the names of the states, such as `z2 - z1 = 0.05`."""
        H, h = self.partition.H[k], self.partition.h[k]
        H, h = (-H, -h) if H.max() <= 0 else (H, h)
        return f"{linear_form_text(H, self.states)} = {-h + 0.0:.6g}"

    def _continuous(self, tolerance: float) -> "PWASystem":
        n, exact = self.A.shape[1], self.exact
        given = [beside([A_i.centre, b_i.centre]) for A_i, b_i in zip(exact.A, exact.b, strict=True)]
        try:
            cells, repair = repaired(self.partition, given, self.B.shape[1], tolerance)
        except Discontinuous as error:
            worst_first = sorted(error.args, key=lambda jump: -jump.relative)
            raise OutsideTheory(*(self._jump_problem(jump, tolerance) for jump in worst_first)) from None
        if repair is None:
            return self
        A, b = (
            tuple(
                BallMatrix(on_entries(F, range(n), columns), old.radius) for F, old in zip(cells, before, strict=True)
            )
            for columns, before in ((range(n), exact.A), ([n], exact.b))
        )
        remark = (
            f"the data jump at facets by rounding, {repair.size}: proofs and simulation are about the continuous plant "
            "next to them"
        )
        return replace(
            self, exact=replace(exact, A=A, b=b), written=None, repair=repair, remarks=(*self.remarks, remark)
        )

    def _jump_problem(self, jump: Discontinuity, tolerance: float) -> Problem:
        facet, in_A = jump.facet, bool(jump.A.any())
        if in_A:
            row, column = np.unravel_index(np.argmax(np.abs(jump.A)), jump.A.shape)
            figure = (
                f"A jumps by {abs(jump.A[row, column]):.6g} (row '{self.states[row]}', column '{self.states[column]}')"
            )
        else:
            row = np.argmax(np.abs(jump.b))
            figure = f"b jumps by {abs(jump.b[row]):.6g} (row '{self.states[row]}')"
        one, other = self.cell_names[facet.i], self.cell_names[facet.j]
        remedy = Remedy(Way.TOLERANCE, (tolerance,))
        hint = "correct the cell; for data rounded in print, a larger tolerance accepts a larger jump"
        H, h = self.partition.H[facet.k], float(self.partition.h[facet.k])
        origin_at_i = self.partition.signs[facet.i, facet.k] * h > 0
        pair = (facet.j, facet.i) if origin_at_i else (facet.i, facet.j)  # first the one without the origin
        for cell, neighbour in (pair, pair[::-1]):
            b = continuous_offset(self.A[cell], self.A[neighbour], self.b[neighbour], H, h)
            if b is not None and not (self.b[cell].any() and self.b[neighbour].any()):  # else either may be wrong
                entries, name = ", ".join(number_text(value, ".9g") for value in b), self.cell_names[cell]
                hint = f"b = ({entries}) in cell '{name}' would mend it"
                remedy = Remedy(Way.OFFSET, (entries, name))
                break
        return Problem(
            message=f"cells '{one}' and '{other}' disagree on {self.hyperplane_text(facet.k)}: {figure}, "
            f"{jump.relative:.1e} of that equation's terms there; the field must be continuous (eq. (1))",
            subject=(ProblemPart.CELLS, facet.i, ProblemPart.A if in_A else ProblemPart.b),
            hint=hint,
            remedy=remedy,
        )


def _matrix(rows: Any, shape: tuple[int | None, int | None], name: str) -> BallMatrix:
    ball = isinstance(rows, BallMatrix)
    found = rows.shape if ball else (len(rows), len(rows[0]) if len(rows) else (shape[1] or 0))
    fits = all(w is None or w == got for w, got in zip(shape, found, strict=True))
    if not fits or not (ball or all(len(row) == found[1] for row in rows)):
        raise ValueError(f"{name} has shape {found}, expected {shape}")
    return rows if ball else BallMatrix.of(rows, found)


def continuous_offset(A_i: Array, A_j: Array, b_j: Array, H: Array, h: float) -> Array | None:
    """Return the b_i (n,) with A_i x + b_i = A_j x + b_j wherever H x + h = 0, or None if there is none.

    There is one exactly where A_i − A_j = g Hᵀ for some g; it is b_j + g h.
    """
    change = A_i - A_j
    pivot = int(np.argmax(np.abs(H)))
    g = change[:, pivot] / H[pivot]
    size = max(np.abs(A_i).max(), np.abs(A_j).max())
    if np.abs(change - np.outer(g, H)).max() > _ONE_BEND * size:
        return None
    return readonly(b_j + g * h + 0.0)


def linear_form_text(row: Array, names: Sequence[str]) -> str:
    """Return a linear form as text.

    Example:
        >>> linear_form_text(np.array([-1.0, 0.0, 2.5]), ["z1", "v1", "z2"])
        '2.5*z2 - z1'
    """
    text = ""
    least = 1e-12 * np.abs(row).max(initial=0.0)
    terms = [(value, name) for value, name in zip(row, names, strict=True) if abs(value) > least]
    for value, name in sorted(terms, key=lambda term: term[0] < 0):
        size = "" if abs(value) == 1 else f"{abs(value):.6g}*"
        sign = ("-" if value < 0 else "") if not text else (" - " if value < 0 else " + ")
        text += f"{sign}{size}{name}"
    return text or "0"


def _numbered(letter: str, count: int) -> tuple[str, ...]:
    return (letter,) if count == 1 and letter != "x" else tuple(f"{letter}{k + 1}" for k in range(count))
