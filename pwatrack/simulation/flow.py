"""An autonomous piecewise linear flow ż = F(mode) z; its last coordinate is the constant 1."""

from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.control.program import SampledController
from pwatrack.model.pwa import PWASystem

Mode = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class SwitchedPart:
    """A part of the flow that has cells of its own: the plant, the observer, the generator."""

    name: str  # for events and reports
    cells: tuple[str, ...]  # names of its l cells
    guards: Array  # rows g with g z = 0 on a hyperplane, (k, N)
    signs: IntArray  # side of each guard that each cell is on, (l, k)
    F: Array  # what it adds to ż in each cell, (l, N, N)

    @staticmethod
    def of(name: str, plant: PWASystem, state: Array, F: Array) -> "SwitchedPart":
        """Return a part that is switched by the cells of a plant, with the state that the given rows read, (n, N)."""
        guards = plant.partition.H @ state
        guards[:, -1] += plant.partition.h
        return SwitchedPart(name=name, cells=plant.cell_names, guards=guards, signs=plant.partition.signs, F=F)


@dataclass(frozen=True)
class Clock:
    """At every multiple of its sample time a program measures, and some of its numbers become entries of z."""

    program: SampledController
    measured: Array  # rows of what it measures, (q, N)
    quantum: Array  # what that is a whole multiple of; 0 for any value, (q,)
    source: IntArray  # which numbers of the program's memory are in z, (V,)
    place: IntArray  # and where
    eta: IntArray  # where its η̂ begins in z, if that goes on there by itself, (0 or p,)


@dataclass(frozen=True, kw_only=True)
class Flow:
    """ζ' = (F0 + Σ_p F_p[mode_p]) ζ, continuous in ζ = z − counted z; mode_p is the cell of part p.

    What follows something large is counted from it: rounding is then relative to how far it is away, not to both.
    `counted` are the rows of z that some entries are counted from, (N, N); they read only entries that are counted
    from none, or from such. None: ζ = z.
    """

    F0: Array  # what does not switch, (N, N)
    parts: tuple[SwitchedPart, ...]
    clock: Clock | None = None  # what makes z jump, if anything does
    counted: Array | None = None

    def matrix(self, mode: Mode) -> Array:
        """Return F(mode), (N, N)."""
        return sum((part.F[cell] for part, cell in zip(self.parts, mode, strict=True)), self.F0)

    def relative(self, z: Array) -> Array:
        """Return ζ of states z, (…, N)."""
        return z if self.counted is None else z - z @ self.counted.T

    def absolute(self, zeta: Array) -> Array:
        """Return z of ζ, (…, N)."""
        return zeta if self.counted is None else zeta + (zeta + zeta @ self.counted.T) @ self.counted.T

    def rows(self, rows: Array) -> Array:
        """Return the rows that read from ζ what the given ones, (q, N), read from z."""
        return rows if self.counted is None else rows + (rows + rows @ self.counted) @ self.counted

    def guards(self) -> Array:
        """Return all guards of all parts, (K, N)."""
        return np.vstack([part.guards for part in self.parts])

    def sides(self, mode: Mode) -> IntArray:
        """Return the side of every guard that the mode is on, (K,); 0 where the guard does not bound it."""
        return np.concatenate([part.signs[cell] for part, cell in zip(self.parts, mode, strict=True)])

    def scaled(self, d: Array) -> "Flow":
        """Return the flow of D⁻¹ z, D = diag(d), with the clock of z; exact for powers of two."""
        return replace(
            self,
            F0=self.F0 / d[:, None] * d,
            parts=tuple(replace(p, guards=p.guards * d, F=p.F / d[:, None] * d) for p in self.parts),
            counted=None if self.counted is None else self.counted / d[:, None] * d,
        )

    def size(self) -> Array:
        """Return entrywise bounds on |F| over all modes, (N, N)."""
        return sum((np.abs(part.F).max(axis=0) for part in self.parts), np.abs(self.F0))
