"""What the errors of a loop that is sampled obey, between ticks and at them, rebuilt from a plant and its gains."""

from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property, partial, reduce
from itertools import product
from math import prod
from typing import Any

from .balls import Ball, outermost, sides, stacked, unlike, within, zero
from .bounds import Loop
from .boxes import AuditedBox, boxes, differences
from .estimates import DIGITS, Estimates, short
from .matrices import AuditFault, Matrix, identity
from .plant import AuditedPlant
from .reading import matrix, number

MOST_LATE = 10  # samples: as late as inputs may be
MOST_FLOWS = 100_000  # more would take days


class AuditedErrors:
    """What the errors (x - x_d, nu, the observer's, rho) of a sampled loop obey.

    The observer's are those of what was predicted for now from the last max(delay, 1) ticks, each with a rho. In the
    time of the program e' is pace times d = A_i e + B nu - E sigma, pace the time between two ticks as a share of the
    sample time; where the program predicts all cells and the plant of the design has merged ones, A_j and G are of all
    cells; each observer's error obeys A_j, with G rho in the rows of x, where G R is how A of the cell in which a
    substep begins differs from that of any other, and with (1 - pace) d; nu' = 0; rho' = R of how e and the observer's
    error change. A tick corrects the last prediction by M C, the others get older, nu = K (e + Delta) anew for the
    prediction that is delay ticks old, and rho = 0. Loads that are constants at inputs, E = B U, one for each tracked
    output, act on u alone: with delay, nu has - U sigma of that prediction, and d has no sigma. Of others x_d is that
    of the true loads, and d has (c_aj - A_i D_j) epsilon in place of it, epsilon and delta held: see `estimates`. A
    tick makes epsilon of the sigma that nu is made of and of delta; nu has - K D_j epsilon and what is held more,
    and delta is what eta_hat is off one sample later. Where one of some corners runs, d has its A_i and B, and each
    observer's error A_i e + B nu less that more, for the same i.
    """

    def __init__(
        self, content: Any, loop: Loop, watched: AuditedPlant | None = None, corners: Sequence[AuditedPlant] = ()
    ) -> None:
        self.plant, self.watched, self.corners = loop.plant, watched is not None, corners
        plant = loop.plant
        square = loop.X is None or len(plant.tracked[0]) == len(plant.B[0][0])
        self.at, self.estimates = plant.matched() if square else [], None
        if plant.loads is not None and not self.at:
            self.estimates = Estimates(plant, loop.X, loop.generator)
        self.K, self.M, self.R = (Ball(matrix(content[name])) for name in ("K", "M", "rows"))
        self.n, self.m, self.N = len(plant.B[0]), len(plant.B[0][0]), len(plant.seen_A[0][0])
        self.E = Ball(matrix(content["E"] or [["0"] * self.m] * self.N))
        shapes = (self.K, self.m, self.n), (self.M, self.N, len(plant.C[0])), (self.E, self.N, self.m)
        for name, ((X, _), rows, columns) in zip("KME", shapes, strict=True):
            if len(X) != rows or any(len(row) != columns for row in X):
                raise AuditFault(f"{name} of the sampled loop does not fit the plant")
        if len(self.R[0]) > self.n or any(len(row) != self.n for row in self.R[0]):
            raise AuditFault("the rows of the sampled loop do not fit the plant")
        if not 0 <= content["delay"] <= MOST_LATE:
            raise AuditFault("the inputs of the sampled loop are too late")
        self.late, share = content["delay"] > 0, number(content["jitter"]) / number(content["sample_time"])
        self.paces = [1 - share, 1 + share] if share else [Fraction(1)]
        self.predicted = max(1, content["delay"])
        self.widths = [self.n, self.m, *[self.N] * self.predicted, *[len(self.R[0])] * self.predicted]
        self.kept, self.held = sum(self.widths[: 2 + self.predicted]), sum(self.widths)
        self.p = 0 if self.estimates is None else self.estimates.p
        if self.estimates is not None:
            self.widths += [self.estimates.k + self.p, self.p]
            if share and any(map(any, self.estimates.S[0])):
                raise AuditFault("ticks come early and late, and a load oscillates")
        self.order, self.period = sum(self.widths), number(content["sample_time"])
        self.cells = outermost(plant.A)
        self.own = self.cells if watched is None else outermost(watched.A)
        changes = differences(self.own)
        self.parts = content["substeps"] if changes else 1
        self.read = [change.image(self.gain) for change in changes]
        if self.R[0] and not changes:
            raise AuditFault("the rows of the sampled loop do not span the differences of its cells")
        for change in differences(self.cells) if self.watched else []:
            change.image(self.gain)

    def gain(self, change: Ball) -> Ball:
        """Return G with G R = A_a - A_b, where R has for each row a column in which it alone is 1."""
        at = self.at_rows
        G = Ball(*([[row[k] for k in at] for row in X] for X in change))
        alone = all(sum(map(bool, row)) == 1 for row in self.R[0]) or not change.radius
        if not at or not alone or not within(change, G @ self.R):
            raise AuditFault("the rows of the sampled loop do not span the differences of its cells")
        return G

    @cached_property
    def at_rows(self) -> list[int]:
        """For each row of R a column in which it alone is 1."""
        columns = list(zip(*self.R[0], strict=True))
        units = [tuple(row) for row in identity(len(self.R[0]), 1)]
        if any(unit not in columns for unit in units):
            raise AuditFault("the rows of the sampled loop are not in their echelon form")
        return [columns.index(unit) for unit in units]

    @property
    def U(self) -> Ball:
        """Of which input each load that only acts there is a part."""
        return Ball([[Fraction(k == at) for at in self.at] for k in range(self.m)])

    @property
    def followed(self) -> list[int]:
        """Entries of what the nominal loop is off x_d that act: all where one of some corners runs."""
        return [*range(self.n)] if self.corners else self.at_rows

    @cached_property
    def mean(self) -> Ball:
        """The mean of the A_i that have all others in their hull, for the nominal loop."""
        return reduce(Ball.__add__, self.cells).times(Fraction(1, len(self.cells)))

    @cached_property
    def flows(self) -> list[AuditedBox]:
        """What they obey between ticks, for all cells of x, of each x_hat and its prediction."""
        read = self.read or [AuditedBox(zero(self.n, 0), [])]
        free = [boxes(self.driven()), *[boxes(self.own), read] * self.predicted]
        if len(self.paces) * prod(map(len, free)) > MOST_FLOWS:
            raise AuditFault("the flows of the sampled loop are too many")
        found, nothing = list[AuditedBox](), [box.middle.times(Fraction(0)) for box, *_ in free]
        for pace, chosen in product(self.paces, product(*free)):
            edges = list[Matrix]()
            for k, box in enumerate(chosen):
                alone = ([*nothing[:k], Ball(D), *nothing[k + 1 :]] for D in box.edges)
                edges += [self.flow(pace, parts, Fraction(0)).centre for parts in alone]
            found.append(AuditedBox(self.flow(pace, [box.middle for box in chosen], Fraction(1)), edges))
        return found

    def opened(self, edges: int) -> list[AuditedBox]:
        """Return the boxes of flows, which have so many edges, or all corners of them if that is none."""
        return self.flows if edges or not self.flows[0].edges else self.corners_of_flows

    @cached_property
    def corners_of_flows(self) -> list[AuditedBox]:
        """All corners of the boxes of flows, each alone."""
        if len(self.flows) * 2 ** len(self.flows[0].edges) > MOST_FLOWS:
            raise AuditFault("the flows of the sampled loop are too many")
        return [AuditedBox(F, []) for _, F in unlike([F for box in self.flows for F in box.corners])]

    def flow(self, pace: Fraction, parts: list[Ball], loads: Fraction) -> Ball:
        """Return F of the rows of d, twice, then of A_j and G of each prediction; it is linear in all."""
        d, below = self.predicted, self.N - self.n
        e, known = parts[0].rows(0, self.n), parts[0].rows(self.n, 2 * self.n)
        late, own = stacked(known - e.times(pace), zero(below, self.order)), list[Ball]()
        for i, (A_j, G) in enumerate(zip(parts[1::2], parts[2::2], strict=True)):
            pushed = stacked(G, zero(below, len(self.R[0])))
            own.append(self.row(self.N, {2 + i: self.seen(A_j, loads), 2 + d + i: pushed}))
        rho = [self.R @ (known + X.rows(0, self.n)) for X in own]
        rest = zero(self.order - self.held, self.order)
        return stacked(e.times(pace), zero(self.m, self.order), *(X + late for X in own), *rho, rest)

    def seen(self, A: Ball, loads: Fraction) -> Ball:
        """Return what the observer's error obeys between ticks, without what its prediction adds; so much of loads."""
        if self.plant.loads is None:
            return A
        E, S = (X.times(loads) for X in self.plant.loads)
        return stacked(sides(A, E), sides(zero(self.N - self.n, self.n), S))

    def driven(self) -> list[Ball]:
        """Return the rows of d, and below them what the program takes it for."""
        if self.corners:
            cells = [(A_c, c.B, A) for c in self.corners for A_c, A in zip(c.A, self.plant.A, strict=True)]
            row = partial(self.row, self.n)
            return outermost([stacked(row({0: A_c, 1: B}), row({0: A, 1: self.plant.B})) for A_c, B, A in cells])
        return [stacked(row, row) for row in self.known()]

    def known(self) -> list[Ball]:
        """Return the rows of d where the plant of the design runs."""
        B, at = self.plant.B, 2 + 2 * self.predicted
        if self.estimates is not None:
            pairs = product(self.cells, self.estimates.moves)
            return [self.row(self.n, {0: A, 1: B, at: c - A @ D}) for A, (c, D) in pairs]
        sigma = {}
        if self.plant.loads is not None and not self.late:
            sigma = {2: sides(zero(self.n, self.n), -self.plant.loads[0])}
        return [self.row(self.n, {0: A, 1: B} | sigma) for A in self.cells]

    @cached_property
    def ticks(self) -> list[Ball]:
        """What a tick makes of them, with all that may be held where x_d or u_ff depends on estimates."""
        d, eye = self.predicted, Ball(identity(self.N, 1))
        corrected = eye + self.M @ self.plant.seen_C
        seen = self.row(self.N, {1 + d: eye} if self.late else {2: corrected})
        delta = self.row(self.p, {len(self.widths) - 1: Ball(identity(self.p, 1))})
        e, first = self.row(self.n, {0: Ball(identity(self.n, 1))}), self.row(self.N, {2: corrected})
        older, rho = [self.row(self.N, {1 + i: eye}) for i in range(1, d)], zero(self.held - self.kept, self.order)
        found = [stacked(e, nu, first, *older, rho, rest) for nu, rest in self.put_out(e, seen, delta)]
        return found if self.estimates is None else [short(J, DIGITS) for J in found]

    def put_out(self, e: Ball, seen: Ball, delta: Ball) -> list[tuple[Ball, Ball]]:
        """Return nu, and epsilon and delta after it, made of e, of an observer's error and of delta before it."""
        nu = self.K @ (e + seen.rows(0, self.n))
        sigma = seen.rows(self.n, self.N)
        if self.estimates is None:
            return [(nu - self.U @ sigma if self.late and self.at else nu, delta)]
        epsilon = stacked(sigma, delta)
        found = list[tuple[Ball, Ball]]()
        for D, more, after in self.estimates.vertices(self.period):
            found.append((nu - (self.K @ D - more) @ epsilon, stacked(epsilon, after @ epsilon)))
        return found

    def row(self, height: int, blocks: dict[int, Ball]) -> Ball:
        """Return rows on them that are 0 but for some blocks."""
        return sides(*(blocks.get(k, zero(height, width)) for k, width in enumerate(self.widths)))

    @cached_property
    def substep(self) -> Ball:
        """What the end of a substep makes of them: rho = 0."""
        rows = enumerate(identity(self.order, 1))
        return Ball([[v * (k < self.kept or k >= self.held) for v in row] for k, row in rows])
