"""Continuous piecewise affine systems, eq. (1)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array, balancing, readonly
from pwatrack.errors import OutsideTheory, Problem
from pwatrack.model.cells import Facet, Partition


@dataclass(frozen=True, kw_only=True)
class PWASystem:
    """The system ẋ = A_i x + b_i + B u for x ∈ Λ_i, y = C x: eq. (1).

    An instance is continuous and its cells cover ℝⁿ: `create` proves both.

    Attributes:
        partition: The l cells in ℝⁿ.
        A: (l, n, n), in 1/s times the units of the states.
        b: (l, n).
        B: (n, m).
        C: (q, n).
        states, inputs, outputs: Names, for reports.
        remarks: What was noticed while it was built, and changes nothing.

    Example: a mass against a one-sided spring of stiffness 4.

        >>> contact = PWASystem.create(
        ...     partition=Partition.create(H=[[1.0, 0.0]], h=[0.0], signs=[[-1], [1]], names=["free", "touching"]),
        ...     A=[[[0, 1], [-1, -1]], [[0, 1], [-5, -1]]], b=[[0, 0], [0, 0]], B=[[0], [1]], C=[[1, 0]])
        >>> contact.field(np.array([0.5, 0.0]), np.array([0.0])).tolist()
        [0.0, -2.5]
    """

    partition: Partition
    A: Array
    b: Array
    B: Array
    C: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    @classmethod
    def create(
        cls,
        *,
        partition: Partition,
        A: object,
        b: object,
        B: object,
        C: object,
        states: Sequence[str] = (),
        inputs: Sequence[str] = (),
        outputs: Sequence[str] = (),
        tolerance: float = 1e-9,
    ) -> "PWASystem":
        """Build the system and prove that it belongs to the class of eq. (1).

        Args:
            tolerance: Largest jump of the vector field across a facet that is
                taken for rounding, relative to the entries of A and b there.

        Raises:
            ValueError: If the shapes do not fit.
            OutsideTheory: If cells overlap or leave a hole, or the vector
                field jumps: one problem per facet.
        """
        n, cells = partition.H.shape[1], len(partition.names)
        A_, b_ = readonly(A, shape=(cells, n, n), name="A"), readonly(b, shape=(cells, n), name="b")
        B_, C_ = readonly(B, shape=(n, None), name="B"), readonly(C, shape=(None, n), name="C")
        partition.check()
        system = cls(
            partition=partition,
            A=A_,
            b=b_,
            B=B_,
            C=C_,
            states=tuple(states) or _numbered("x", n),
            inputs=tuple(inputs) or _numbered("u", B_.shape[1]),
            outputs=tuple(outputs) or _numbered("y", C_.shape[0]),
        )
        system._check_continuity(tolerance)
        return system._without(partition.empty_cells)

    @property
    def cell_names(self) -> tuple[str, ...]:
        """Names of the l cells."""
        return self.partition.names

    def field(self, x: Array, u: Array) -> Array:
        """Return ẋ (n,) at state x (n,) under input u (m,): eq. (1)."""
        i = self.partition.locate(x)
        result: Array = self.A[i] @ x + self.b[i] + self.B @ u
        return result

    def jump(self, facet: Facet) -> tuple[Array, Array]:
        """Return what is left of A_i − A_j − g Hᵀ (n, n) and b_i − b_j − g h (n,) on a facet.

        Both vanish for a suitable g exactly where the field is continuous
        across the facet; g is read off the column where H is largest.
        """
        H, h = self.partition.H[facet.k], self.partition.h[facet.k]
        dA, db = self.A[facet.i] - self.A[facet.j], self.b[facet.i] - self.b[facet.j]
        pivot = int(np.argmax(np.abs(H)))
        g = dA[:, pivot] / H[pivot]
        return dA - np.outer(g, H), db - g * h

    def hyperplane_text(self, k: int) -> str:
        """Return hyperplane k as an equation in the names of the states.

        Example: `'z2 - z1 = 0.05'`.
        """
        return f"{linear_form_text(self.partition.H[k], self.states)} = {-self.partition.h[k] + 0.0:.6g}"

    def _without(self, cells: Sequence[int]) -> "PWASystem":
        if not cells:
            return self
        kept = [i for i in range(len(self.A)) if i not in cells]
        return replace(
            self,
            partition=self.partition.without(cells),
            A=readonly(self.A[kept]),
            b=readonly(self.b[kept]),
            remarks=tuple(f"cell '{self.cell_names[i]}' has no interior and is left out" for i in cells),
        )

    def _check_continuity(self, tolerance: float) -> None:
        scale = balancing(self.A)
        problems = []
        for facet in self.partition.facets:
            jump_A, jump_b = self.jump(facet)
            both = [facet.i, facet.j]
            size_A = np.abs(self.A[both] / scale[:, None] * scale).max()
            size_b = np.abs(np.vstack([self.b[both], self.b[facet.i] - self.b[facet.j] - jump_b]) / scale).max()
            rest_A = np.abs(jump_A / scale[:, None] * scale).max()
            rest_b = np.abs(jump_b / scale).max()
            H, h = self.partition.H[facet.k] * scale, self.partition.h[facet.k]
            rounding = 64 * np.finfo(np.float64).eps * size_A * abs(h) / np.abs(H).max()  # of g h, as g carries A's
            too_much_A, too_much_b = rest_A > tolerance * size_A, rest_b > tolerance * size_b + rounding
            if too_much_A or too_much_b:
                problems.append(
                    self._jump_problem(
                        facet,
                        jump_A if too_much_A else np.zeros_like(jump_A),
                        jump_b,
                        max(rest_A / size_A if size_A else 0.0, rest_b / size_b if size_b else 0.0),
                        tolerance,
                    )
                )
        if problems:
            raise OutsideTheory(*problems)

    def _jump_problem(self, facet: Facet, jump_A: Array, jump_b: Array, relative: float, tolerance: float) -> Problem:
        if jump_A.any():
            row, column = np.unravel_index(np.argmax(np.abs(jump_A)), jump_A.shape)
            figure = (
                f"A jumps by {abs(jump_A[row, column]):.6g} (row '{self.states[row]}', column '{self.states[column]}')"
            )
        else:
            row = np.argmax(np.abs(jump_b))
            figure = f"b jumps by {abs(jump_b[row]):.6g} (row '{self.states[row]}')"
        one, other = self.cell_names[facet.i], self.cell_names[facet.j]
        return Problem(
            message=f"cells '{one}' and '{other}' disagree on {self.hyperplane_text(facet.k)}: "
            f"{figure}, {relative:.1e} of the largest entry; the field must be continuous (eq. (1))",
            subject=("system", "cells", facet.i, "A" if jump_A.any() else "b"),
            hint="correct the cell; for data rounded in print, 'tolerance: {continuity: …}' accepts a larger jump "
            f"(in force: {tolerance:g})",
        )


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
