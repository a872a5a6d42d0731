"""The errors of a loop that is sampled: between ticks for any switching, and what a tick makes of them.

At a tick t_k the program corrects x̂ and ŝ by M (C x̂ − y), and what it puts out is held for h. From there it predicts x̃:
in each of r substeps with the affine law of the cell a in which x̃ is when it begins, at p. Where inputs are d samples
late it predicts d times more, with the inputs that wait. With (x̃_i, s̃_i), what was predicted for now from the tick i
ago, and loads s, if any, that are constants at inputs, E = B U, what acts is u = K (x̃_d − x_d(t_k)) − U s̃_d + u_ff. For

    e = x − x_d,   ν = K (x̃_d − x_d) at the tick,   (Δ_i, σ_i) = (x̃_i − x, s̃_i − s),
    ρ_i = R (x̃_i − p_i) − R (x_d(t) − x_d(t_p))

and i = 0 … max(d, 1) − 1, with rows R that span those of all A_a − A_b = G_ab R,

    e' = A_i e + B ν − E σ_0 + B ω,      ν' = 0,
    (Δ, σ)' = [A_j, E; 0, 0] (Δ, σ) + (G_ab (ρ + R (x_d(t) − x_d(t_p))), 0),      ρ' = R (e' + Δ').

A_i and A_j are any in the hull of the cells, and (a, b) any; j and (a, b) for each prediction. After a substep ρ⁺ = 0;
after a tick, with noise n beside C Δ_0,

    e⁺ = e,   (Δ_0, σ_0)⁺ = (Δ_0, σ_0) + M C Δ_0,   (Δ_i, σ_i)⁺ = (Δ_{i−1}, σ_{i−1}),   ρ⁺ = 0,
    ν⁺ = K (e + Δ_0⁺) without delay,   ν⁺ = K (e + Δ_{d−1}) − U σ_{d−1} with it.

With delay ν has −U σ_d of its tick, and e' no − E σ_0. Where a tick comes λ h after the one before, in the time of the
program, which is h from tick to tick, e' is λ times that, and Δ' has 1 − λ times that more. Where another plant of a
box runs, e' has A_i(p) and B_p, for the same i, and Δ' has A_i e + B ν less that: see `claims.robust`. Where the
program predicts all cells of a plant whose design has merged ones, i is of the merged ones, and j, a, b of all. The
rest, as ω = u_ff as it is held less u_ff(t), acts from outside: see `sampled_disturbances`.

Other loads move x_d and η̂ too: e' has (c_aj − A_i D_j) ε and not −E σ_0, with x_d and u_ff of the true s, and z has ε
and δ more, held as ν is: see `estimated_loads`. At a tick

    ε⁺ = (σ_0⁺ or with delay σ_{d−1}, δ),   ν⁺ = K (e + Δ_0⁺ or Δ_{d−1} − D_j ε⁺) + u_a Q(F_a) F_j ε⁺,
    δ⁺ = [ε⁺ + P(F_a) F_j ε⁺]_η
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, reduce
from itertools import product
from math import prod

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, above, beside, different, zero
from pwatrack.control.estimated_loads import OnEstimates
from pwatrack.control.headroom import Starts
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.vertices import Box, boxes, differences, factors, held_rows, outermost, outermost_cells
from pwatrack.lmi.clocked import Clocked
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.rational import identity, pivots, rational
from pwatrack.real import Real


@dataclass(frozen=True, kw_only=True)
class SampledErrors:
    """What z = (e, ν, (Δ_i, σ_i) …, ρ_i …) of a sampled loop obeys."""

    plant: PWASystem  # what runs; the program predicts it, or where it is `watched` that one
    gains: SampledGains  # of the program
    cells: Sequence[BallMatrix]  # A_i that have those of all cells in their hull
    seen: Sequence[BallMatrix]  # A_j of what is predicted, likewise
    changes: Sequence[Box]  # A_a − A_b of these, in boxes; none where all are one
    R: BallMatrix  # rows that span the rows of these, each with a column in which it alone is 1
    # columns E_k, (n, 1), by which what is merged in it enters ẋ where it runs, and how large that is at most
    deviations: Sequence[tuple[BallMatrix, float]] = ()
    # how x_d and u_ff depend on ŝ and η̂; None where no load is estimated, or all are constants at inputs
    estimates: OnEstimates | None = None
    # matrices of plants that may run in place of it, they and their means; none where it runs itself
    corners: Sequence[Matrices] = ()
    # columns z, (order, 1), of which what z is before the first tick of a run, or before that at which its first late
    # input acts, is a mean, of any sign; None where that is not known
    starts: Sequence[BallMatrix] | None = None
    # of the signals of the plant, in which forms are looked for; None where those of no file are known
    sizes: Sizes | None = None
    few: int = 16  # corners of boxes of flows, up to which each is looked at: what is found is a little better then

    @classmethod
    def of(
        cls, plant: PWASystem, gains: SampledGains, estimates: OnEstimates | None = None, sizes: Sizes | None = None
    ) -> "SampledErrors":
        """Find cells and changes that the others are means of."""
        cells = outermost_cells(plant)
        seen = cells if plant.watched is None else outermost_cells(plant.watched)
        changes = differences(seen)
        R = held_rows(changes if plant.watched is None else [*changes, *differences(cells)], plant.B.shape[0])
        return cls(
            plant=plant,
            gains=gains,
            cells=cells,
            seen=seen,
            changes=changes,
            R=R,
            estimates=estimates,
            sizes=sizes,
        )

    @property
    def predicted(self) -> int:
        """How many predictions for now, from ticks one after the other, still matter."""
        return max(1, self.gains.delay)

    @property
    def order(self) -> int:
        """How many errors there are."""
        return sum(self.widths)

    @cached_property
    def widths(self) -> tuple[int, ...]:
        """Of e, ν, each (Δ_i, σ_i), each ρ_i, and of ε and δ where x_d or u_ff depends on estimates."""
        (n, m), N, q = self.plant.B.shape, self.plant.observed.C.shape[1], self.R.shape[0]
        return n, m, *[N] * self.predicted, *[q] * self.predicted, *self.more

    @property
    def more(self) -> tuple[int, ...]:
        """How many entries ε and δ have."""
        return () if self.estimates is None else (self.estimates.order, self.estimates.eta)

    def before(self, starts: Starts) -> Array:
        """Return G of z before the first tick, (order, k), of errors from an x_d without loads on.

        Where inputs are late it is that before the tick at which the first one acts.
        """
        if starts.z is not None:
            return starts.z
        (n, m, *_), k = self.widths, starts.e.shape[1]
        delta, load = (np.zeros((0, k)) if X is None else X for X in (starts.delta, starts.load))
        e = starts.e if self.estimates is None or not len(load) else starts.e + self.estimates.X.floats @ load
        behind = np.zeros((self.order - n - m - len(delta) - len(load), k))
        return np.vstack([e, np.zeros((m, k)), delta, load, behind])

    @property
    def parts(self) -> int:
        """Substeps that make a difference."""
        return self.gains.substeps if self.changes else 1

    @cached_property
    def mean(self) -> BallMatrix:
        """A₀, the mean of the A_i that have all others in their hull."""
        return reduce(BallMatrix.__add__, self.cells).times(Fraction(1, len(self.cells)))

    @property
    def followed(self) -> BallMatrix:
        """Rows of what the nominal loop is off x_d, by which A less A₀ acts: R, or all where another plant runs."""
        return BallMatrix(identity(self.plant.B.shape[0])) if self.corners else self.R

    @cached_property
    def differing(self) -> list[int]:
        """Rows of what is followed in whose columns some A differs from the mean."""
        cells = [A for corner in self.corners for A in corner.A] or self.cells
        rows, off = range(self.plant.B.shape[0]), [A - self.mean for A in cells]
        columns = [[X.part(rows, [j]) for X in off] for j in pivots(self.followed.centre)]
        return [k for k, each in enumerate(columns) if any(X.radius or any(X.centre.entries()) for X in each)]

    @property
    def paces(self) -> list[Fraction]:
        """λ: the shortest and the longest time between ticks, as a share of h."""
        h, jitter = Real.of(self.gains.sample_time).centre, Real.of(self.gains.jitter).centre
        return [1 - jitter / h, 1 + jitter / h] if jitter else [Fraction(1)]

    @property
    def clocked(self) -> Clocked:
        """They as a system with a clock, in the time of the program."""
        (n, m, *others), held, rest = self.widths, self.predicted * self.R.shape[0], sum(self.more)
        ends = BallMatrix.of(np.diag([1.0] * (self.order - held - rest) + [0.0] * held + [1.0] * rest))
        F, edges = zip(*(each for pace in self.paces for each in self._flows(pace)), strict=True)
        U, V = zip(*(_factors(D, self.order) for D in edges), strict=True)
        found = Clocked(
            F=F,
            U=U,
            V=V,
            J=self.ticks,
            period=Real.of(self.gains.sample_time).centre,
            parts=self.parts,
            between=ends if self.parts > 1 else None,
            blocks=(n + m, *others[: self.predicted], *[1] * held, *[rest] * bool(rest)),
            sizes=self._sizes(self.sizes) if self.sizes is not None else (),
        )
        return found if self.flows[1] else replace(found, F=different(list(found.vertices)), U=(), V=())

    @property
    def flows(self) -> tuple[int, int]:
        """How many boxes of flows there are, and the edges of each; few corners are a box each, without edges."""
        count, edges = len(self.paces) * prod(map(len, self.free)), sum(len(one.edges) for one, *_ in self.free)
        corners = count * 2**edges
        return (count, edges) if corners > self.few else (corners, 0)

    def _sizes(self, of: Sizes) -> tuple[float, ...]:
        """Return the sizes of z: what moves, in a row of R, as much as all states; of an estimate what moves one."""
        Delta, rho = np.concatenate([of.state, of.load]), np.abs(self.R.floats) @ of.state
        z = [of.state, of.input, *[Delta] * self.predicted, *[rho] * self.predicted]
        if self.estimates is not None:
            x_d = np.abs([D.floats for _, D in self.estimates.hull]).max(axis=0)
            shares = (x_d / of.state[:, None]).max(axis=0)
            own = np.concatenate([of.load, np.ones(self.estimates.eta)])
            epsilon = 1 / np.where(shares > 0, shares, 1 / own)
            z += [epsilon, epsilon[len(epsilon) - self.estimates.eta :]]
        return tuple(np.concatenate(z).tolist())

    @cached_property
    def free(self) -> list[list[Box]]:
        """What differs between flows, each by itself: e', twice, then of each prediction A_j and G."""
        seen, at = boxes(self.seen), pivots(self.R.centre)
        pushes = [box.part(range(self.plant.B.shape[0]), at) for box in self.changes]
        return [boxes(self.driven), *[seen, pushes or [Box(zero(self.plant.B.shape[0], 0))]] * self.predicted]

    def _flows(self, pace: Fraction) -> Iterator[tuple[BallMatrix, list[BallMatrix]]]:
        """Yield what they obey between ticks that are a share of h apart: middles, and the edges of each box."""
        loads, nothing = self.plant.loads, [box.middle.times(Fraction(0)) for box, *_ in self.free]
        for chosen in product(*self.free):
            edges = list[BallMatrix]()
            for k, box in enumerate(chosen):
                alone = ([*nothing[:k], BallMatrix(D), *nothing[k + 1 :]] for D in box.edges)
                edges += [self._flow(pace, parts[0], parts[1::2], parts[2::2]) for parts in alone]
            rows, *predicted = (box.middle for box in chosen)
            seen = [A if loads is None else loads.observed(A) for A in predicted[::2]]
            yield self._flow(pace, rows, seen, predicted[1::2]), edges

    def _flow(
        self, pace: Fraction, rows: BallMatrix, seen: Sequence[BallMatrix], pushes: Sequence[BallMatrix]
    ) -> BallMatrix:
        """Return F with this e', once as it is and once as the program takes it, A_j and G; it is linear in them."""
        d, (n, m, N, *_), columns = self.predicted, self.widths, range(self.order)
        e, known = rows.part(range(n), columns), rows.part(range(n, 2 * n), columns)
        late = above(known - e.times(pace), zero(N - n, self.order))
        Delta, rho = list[BallMatrix](), list[BallMatrix]()
        for i, (A_j, push) in enumerate(zip(seen, pushes, strict=True)):
            whole = A_j if A_j.shape[0] == N else above(beside(A_j, zero(n, N - n)), zero(N - n, N))
            row = self._row(N, {2 + i: whole, 2 + d + i: above(push, zero(N - n, push.shape[1]))})
            Delta.append(row + late)
            rho.append(self.R @ (known + row.part(range(n), columns)))
        return above(e.times(pace), zero(m, self.order), *Delta, *rho, zero(sum(self.more), self.order))

    @cached_property
    def driven(self) -> list[BallMatrix]:
        """e' where ticks are h apart, and below it what the program takes it for, (2 n, order) each."""
        (n, _, N, *_), B, loads, at = self.widths, self.plant.exact.B, self.plant.loads, 2 + 2 * self.predicted
        if self.corners:
            each = [(A_c, c.B, A_i) for c in self.corners for A_c, A_i in zip(c.A, self.plant.exact.A, strict=True)]
            return outermost(
                [above(self._row(n, {0: A_c, 1: B_c}), self._row(n, {0: A, 1: B})) for A_c, B_c, A in each]
            )
        if self.estimates is not None:
            pairs = product(self.cells, self.estimates.moves)
            rows = [self._row(n, {0: A_i, 1: B, at: c - A_i @ D}) for A_i, (c, D) in pairs]
        else:
            minus = {} if loads is None or self.gains.delay else {2: zero(n, N) - beside(zero(n, n), loads.E)}
            rows = [self._row(n, {0: A_i, 1: B} | minus) for A_i in self.cells]
        return [above(row, row) for row in rows]

    @property
    def ticks(self) -> list[BallMatrix]:
        """What a tick makes of them, J: several where x_d or u_ff depends on estimates."""
        d, (n, _, N, *_), eye = self.predicted, self.widths, BallMatrix(identity(self.widths[2]))
        corrected = eye + BallMatrix.of(self.gains.M) @ self.plant.observed.C
        seen = self._row(N, {1 + d: eye} if self.gains.delay else {2: corrected})  # what the input is made of
        Delta = [self._row(N, {2: corrected}), *(self._row(N, {1 + i: eye}) for i in range(1, d))]
        e, rho = self._row(n, {0: BallMatrix(identity(n))}), zero(d * self.R.shape[0], self.order)
        last = BallMatrix(identity(sum(self.more[1:])))
        delta = self._row(last.shape[0], {len(self.widths) - 1: last} if self.more else {})
        return [above(e, nu, *Delta, rho, rest) for nu, rest in self.put_out(e, seen, delta)]

    def put_out(self, e: BallMatrix, seen: BallMatrix, delta: BallMatrix) -> list[tuple[BallMatrix, BallMatrix]]:
        """Return ν after a tick, and below each other ε and δ, from e, the (Δ, σ) it is made of and δ, as columns."""
        K, (n, m, N, *_), columns = BallMatrix.of(self.gains.K), self.widths, range(e.shape[1])
        nu, sigma = K @ (e + seen.part(range(n), columns)), seen.part(range(n, N), columns)
        if self.estimates is None:
            if self.gains.delay and self.plant.loads is not None:
                U = BallMatrix.of(np.eye(m)[:, list(self.plant.load_inputs)])
                nu = nu - U @ sigma
            return [(nu, zero(0, len(columns)))]
        found, epsilon = list[tuple[BallMatrix, BallMatrix]](), above(sigma, delta)
        for D, more, after in self._held:
            found.append((nu - (K @ D - more) @ epsilon, above(epsilon, after @ epsilon)))
        return found

    @cached_property
    def _held(self) -> list[tuple[BallMatrix, BallMatrix, BallMatrix]]:
        assert self.estimates is not None
        return self.estimates.vertices(Real.of(self.gains.sample_time).centre)

    def _row(self, height: int, blocks: Mapping[int, BallMatrix]) -> BallMatrix:
        """Return rows on z that are 0 but for some blocks."""
        return beside(*(blocks.get(k, zero(height, width)) for k, width in enumerate(self.widths)))


def _factors(edges: Sequence[BallMatrix], order: int) -> tuple[BallMatrix, BallMatrix]:
    """Return U and V with a column and a row for each edge u vᵀ."""
    pairs = [factors(D.centre) for D in edges]
    U, V = (BallMatrix(rational([pair[k] for pair in pairs], (len(pairs), order))) for k in (0, 1))
    return U.transpose(), V
