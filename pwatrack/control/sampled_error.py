"""The errors of a loop that is sampled: between ticks for any switching, and what a tick makes of them.

At a tick t_k the program corrects x̂ and ŝ by M (C x̂ − y), and holds u = K (x̂ − x_d) + u_ff for h. From there it
predicts x̃: in each of r substeps with the affine law of the cell a in which x̃ is when it begins, at p. For

    e = x − x_d,   ν = K (x̂ − x_d) at the tick,   (Δ, σ) = (x̃ − x, ŝ − s),   ρ = R (x̃ − p) − R (x_d(t) − x_d(t_p))

with rows R that span those of all A_a − A_b = G_ab R, and loads s, if any, that are constants at inputs, E = B U, for
which u_ff has − U ŝ,

    e' = A_i e + B ν − E σ + B ω,      ν' = 0,
    (Δ, σ)' = [A_j, E; 0, 0] (Δ, σ) + (G_ab (ρ + R (x_d(t) − x_d(t_p))), 0),      ρ' = R (e' + Δ').

The field f of all cells has f(x) − f(x_d) = A_i (x − x_d) with A_i in the hull of the cells, likewise for x̃ and x; and
f_a(x̃) − f(x̃) = (A_a − A_b)(x̃ − p), since f_a(p) = f(p). i, j and (a, b) are any. After a substep ρ⁺ = 0; after a tick,
with noise n beside C Δ,

    e⁺ = e,   (Δ, σ)⁺ = (Δ, σ) + M C Δ,   ν⁺ = K (e⁺ + Δ⁺),   ρ⁺ = 0.

ω = u_ff as it is held less u_ff(t), what the reference moves in a substep, disturbances, n and what the steps of the
generator leave of (15) act from outside. Of other loads ŝ would move x_d, and with it ω: nothing is said of these.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import permutations

import numpy as np

from pwatrack.ball_matrix import BallMatrix, above, beside, different
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.vertices import held_rows, outermost
from pwatrack.lmi.clocked import Clocked
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import identity, pivots
from pwatrack.real import Real

_MOST_CELLS = 200  # of a hull, that are looked at one by one


@dataclass(frozen=True, kw_only=True)
class SampledErrors:
    """What (e, ν, Δ, σ, ρ) of a sampled loop obey.

    Attributes:
        plant: What runs, and what the program predicts.
        gains: Of the program.
        cells: A_i that have those of all cells in their hull.
        changes: A_a − A_b, likewise.
        R: Rows that span the rows of these, each with a column in which it alone is 1.
    """

    plant: PWASystem
    gains: SampledGains
    cells: Sequence[BallMatrix]
    changes: Sequence[BallMatrix]
    R: BallMatrix

    @staticmethod
    def least_work(plant: PWASystem, gains: SampledGains) -> int:
        """Return what inequalities times the square of their order are at least, without looking for changes.

        There are as many of these as cells at least: a hull of differences has no fewer corners than the hull.
        """
        cells = len(plant.hull) if len(plant.hull) > _MOST_CELLS else len(cells_of(plant))
        parts = gains.substeps if cells > 1 else 1
        return 2 * parts * cells**3 * (sum(plant.B.shape) + plant.observed.C.shape[1] + (cells > 1)) ** 2

    @classmethod
    def of(cls, plant: PWASystem, gains: SampledGains) -> "SampledErrors":
        """Find cells and changes that the others are means of."""
        cells = cells_of(plant)
        changes = outermost([one - other for one, other in permutations(cells, 2)])
        R = held_rows(changes, plant.B.shape[0])
        return cls(plant=plant, gains=gains, cells=cells, changes=changes, R=R)

    @property
    def order(self) -> int:
        """How many errors there are."""
        return sum(self.plant.B.shape) + self.plant.observed.C.shape[1] + self.R.shape[0]

    @property
    def parts(self) -> int:
        """Substeps that make a difference."""
        return self.gains.substeps if self.changes else 1

    @property
    def inequalities(self) -> int:
        """Between ticks, for one segment in each substep."""
        return 2 * self.parts * len(self.cells) ** 2 * max(1, len(self.changes))

    @property
    def clocked(self) -> Clocked:
        """They as a system with a clock."""
        plant, R = self.plant, self.R
        (n, m), N, q = plant.B.shape, plant.observed.C.shape[1], R.shape[0]
        seen = [plant.loads.observed(A) for A in self.cells] if plant.loads is not None else self.cells
        flows = list[BallMatrix]()
        B, E = plant.exact.B, _zero(n, N) if plant.loads is None else beside(_zero(n, n), plant.loads.E)
        for A_i in self.cells:
            e = reduce(beside, (A_i, B, _zero(n, N) - E, _zero(n, q)))
            for A_j in seen:
                for change in self.changes or [_zero(n, n)]:
                    pushed = above(change.part(range(n), pivots(R.centre)), _zero(N - n, q))
                    Delta = reduce(beside, (_zero(N, n + m), A_j, pushed))
                    moved = R @ (e + Delta.part(range(n), range(n + m + N + q)))
                    flows.append(reduce(above, (e, _zero(m, n + m + N + q), Delta, moved)))
        return Clocked(
            F=different(flows),
            J=[_tick(plant, self.gains, q)],
            period=Real.of(self.gains.sample_time).centre,
            parts=self.parts,
            between=_substep(n + m + N, q) if self.parts > 1 else None,
            blocks=(n + m, N, *[1] * q),
        )


def cells_of(plant: PWASystem) -> list[BallMatrix]:
    """Return A_i of the cells that have those of all cells in their hull."""
    return outermost([plant.exact.A[i] for i in plant.hull])


def _tick(plant: PWASystem, gains: SampledGains, q: int) -> BallMatrix:
    """Return what a tick makes of (e, ν, Δ, σ, ρ)."""
    (n, m), observed = plant.B.shape, plant.observed
    N = observed.C.shape[1]
    K, M = BallMatrix.of(gains.K), BallMatrix.of(gains.M)
    corrected = BallMatrix(identity(N)) + M @ observed.C
    held = reduce(beside, (K, _zero(m, m), K @ corrected.part(range(n), range(N)), _zero(m, q)))
    e = beside(BallMatrix(identity(n)), _zero(n, m + N + q))
    Delta = reduce(beside, (_zero(N, n + m), corrected, _zero(N, q)))
    return reduce(above, (e, held, Delta, _zero(q, n + m + N + q)))


def _substep(kept: int, q: int) -> BallMatrix:
    """Return what the end of a substep makes of them."""
    same = beside(BallMatrix(identity(kept)), _zero(kept, q))
    return above(same, _zero(q, kept + q))


def _zero(rows: int, columns: int) -> BallMatrix:
    return BallMatrix.of(np.zeros((rows, columns)), (rows, columns))
