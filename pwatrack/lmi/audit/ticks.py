"""What the errors of a loop that is sampled obey, between ticks and at them, rebuilt from a plant and its gains."""

from fractions import Fraction
from functools import cached_property, reduce
from itertools import permutations
from typing import Any

from .balls import Ball, sides, stacked, unlike
from .bounds import Loop
from .matrices import AuditFault, identity, spend
from .reading import matrix


class AuditedErrors:
    """What the errors (x - x_d, K (x_hat - x_d) at the tick, the observer's, rho) of a sampled loop obey.

    Between ticks e' = A_i e + B nu - E sigma; the observer's error obeys A_j, and G rho in the rows of x, where G R is
    how A of the cell in which a substep begins differs from that of any other; nu' = 0 and rho' = R (e' + Delta'). A
    tick corrects the observer's error by M C, takes nu = K (e + Delta) anew, and rho = 0. Loads are constants.
    """

    def __init__(self, content: Any, loop: Loop) -> None:
        self.plant = plant = loop.plant
        square = loop.X is None or len(plant.tracked[0]) == len(plant.B[0][0])
        if plant.loads is not None and (plant.at_inputs() and not square):
            raise AuditFault("loads do not only act at inputs, one for each tracked output")
        self.K, self.M, self.R = (Ball(matrix(content[name])) for name in ("K", "M", "rows"))
        self.n, self.m, self.N = len(plant.B[0]), len(plant.B[0][0]), len(plant.seen_A[0][0])
        sizes_ = {"K": (self.K, self.m, self.n), "M": (self.M, self.N, len(plant.C[0]))}
        for name, ((X, _), rows, columns) in sizes_.items():
            if len(X) != rows or any(len(row) != columns for row in X):
                raise AuditFault(f"{name} of the sampled loop does not fit the plant")
        if len(self.R[0]) > self.n or any(len(row) != self.n for row in self.R[0]):
            raise AuditFault("the rows of the sampled loop do not fit the plant")
        self.kept = self.n + self.m + self.N
        self.order = self.kept + len(self.R[0])
        self.cells = outermost(plant.A)
        self.changes = outermost([one - other for one, other in permutations(self.cells, 2)])
        self.read = [self.gain(change) for change in self.changes]
        if self.R[0] and not self.changes:
            raise AuditFault("the rows of the sampled loop do not span the differences of its cells")

    def gain(self, change: Ball) -> Ball:
        """Return G with G R = A_a - A_b, where R has for each row a column in which it alone is 1."""
        columns = list(zip(*self.R[0], strict=True))
        units = [[Fraction(int(j == k)) for j in range(len(self.R[0]))] for k in range(len(self.R[0]))]
        if any(tuple(unit) not in columns for unit in units):
            raise AuditFault("the rows of the sampled loop are not in their echelon form")
        at = [columns.index(tuple(unit)) for unit in units]
        G = Ball(*([[row[k] for k in at] for row in X] for X in change))
        alone = all(sum(map(bool, row)) == 1 for row in self.R[0]) or not change.radius
        if not at or not alone or not within(change, G @ self.R):
            raise AuditFault("the rows of the sampled loop do not span the differences of its cells")
        return G

    @cached_property
    def flows(self) -> list[Ball]:
        """What they obey between ticks, for all cells of x, of x_hat and of its prediction."""
        plant, q = self.plant, len(self.R[0])
        shift = zero(self.n, self.N)
        if plant.loads is not None:
            shift = sides(zero(self.n, self.n), -plant.loads[0])
        held, found = zero(self.m, self.order), list[Ball]()
        for A_i in self.cells:
            e = joined([A_i, plant.B, shift, zero(self.n, q)])
            for A_j in self.seen:
                for G in self.read or [zero(self.n, 0)]:
                    pushed = stacked(G, zero(self.N - self.n, q)) if self.n < self.N else G
                    Delta = joined([zero(self.N, self.n + self.m), A_j, pushed])
                    moved = [self.R @ (e + top(Delta, self.n))] if q else []
                    found.append(reduce(stacked, [e, held, Delta, *moved]))
        return [F for _, F in unlike(found)]

    @property
    def seen(self) -> list[Ball]:
        """What the observer's error obeys between ticks, without what its prediction adds."""
        loads = self.plant.loads
        if loads is None:
            return self.cells
        E, S = loads
        return [stacked(sides(A, E), sides(zero(self.N - self.n, self.n), S)) for A in self.cells]

    @cached_property
    def tick(self) -> Ball:
        """What a tick makes of them."""
        n, m, N, q = self.n, self.m, self.N, len(self.R[0])
        corrected = Ball(identity(N, 1)) + self.M @ self.plant.seen_C
        e = sides(Ball(identity(n, 1)), zero(n, m + N + q))
        held = joined([self.K, zero(m, m), self.K @ top(corrected, n), zero(m, q)])
        Delta = joined([zero(N, n + m), corrected, zero(N, q)])
        return reduce(stacked, [e, held, Delta, *([zero(q, self.order)] if q else [])])

    @cached_property
    def substep(self) -> Ball:
        """What the end of a substep makes of them: rho = 0."""
        return Ball([[Fraction(int(j == k < self.kept)) for k in range(self.order)] for j in range(self.order)])


def outermost(matrices: list[Ball]) -> list[Ball]:
    """Return different matrices without those between two others: the hull stays what it is."""
    found = [ball for _, ball in unlike(matrices)]
    if any(R for _, R in found):
        return found
    points = [[v for row in X for v in row] for X, _ in found]
    return [ball for ball, point in zip(found, points, strict=True) if not between(point, points)]


def between(point: list[Fraction], points: list[list[Fraction]]) -> bool:
    """Say whether a point lies between two others: in opposite directions from it."""
    seen = set[tuple[Fraction, ...]]()
    for other in points:
        spend(2 * len(point))
        change = [v - w for v, w in zip(other, point, strict=True)]
        size = next((abs(v) for v in change if v), None)
        if size is None:
            continue
        direction = tuple(v / size for v in change)
        if tuple(-v for v in direction) in seen:
            return True
        seen.add(direction)
    return False


def within(one: Ball, other: Ball) -> bool:
    """Say whether all of one ball is in the other of the same centre."""
    (X, R), (Y, S) = one, other
    pairs = zip((v for row in R for v in row), (v for row in S for v in row), strict=True) if R and S else ()
    return X == Y and (not R or bool(S)) and all(v <= w for v, w in pairs)


def joined(balls: list[Ball]) -> Ball:
    """Return matrices side by side, but for those without columns."""
    return reduce(sides, [ball for ball in balls if ball.centre and ball.centre[0]])


def top(ball: Ball, count: int) -> Ball:
    """Return the first rows."""
    return Ball(*(X[:count] for X in ball))


def zero(rows: int, columns: int) -> Ball:
    """Return 0."""
    return Ball([[Fraction(0)] * columns for _ in range(rows)])
