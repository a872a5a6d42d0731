"""What the program makes of estimates of loads in x_d, u_ff and η̂, and what errors of these do to a sampled loop.

Let x_d, u_ff and η be those of the true loads s, in continuous time, (15) and (16) with `control.compensation`; no last
derivative of a tracked output is to be piecewise affine. Of v = (ŝ, η̂), as the program has it at a tick, x_d is more by
[X, N] ε than that of the true loads, with ε = (ŝ − s, η̂ − η); v' and u_ff are continuous functions of v, with the rows
F_j = [S, 0; W_j, A_ηj] and u_j in cell j. In a sample the program goes on by the law of the cell a in which x_d is at
its begin: η̂ one sample later, and the mean of u_ff, which is held, are

    v + P(F_a) v',   u_ff + u_a Q(F_a) v',   P(F) = ∫ e^(F τ) dτ over h,   Q(F) = ∫ (h − τ) e^(F τ) dτ / h

Between v and that of the true loads v' differs by F_j ε and u_ff by u_j ε, for one mean j of the cells. So u is more by

    u_j ε + u_a Q(F_a) F_j ε,   and   δ⁺ = δ + [P(F_a) F_j ε]_η   for δ = η̂ − η

for any cell a and any j, but for (u_a Q(F_a) − u_b Q(F_b)) v' and the like, with v' and the cell b of the true loads:
that acts from outside, and is 0 where the reference is at rest. With q = [X, N] ε, held, the field of all cells has
f(x) − f(x_d) = A_i (x − x_d − q) + A_j q, where j is that of u_j but for what A_j − A_k makes of how far x_d moved
since the tick, which acts from outside too. So x − x_d is driven by (A_j − A_i) q + B u_j ε = (c_j − A_i [X, N]) ε.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import flint
import numpy as np

from pwatrack.ball_matrix import BallMatrix, above, absolute, beside, different, zero
from pwatrack.control.vertices import outermost, outermost_cells
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import fraction_of, identity, number

_BITS = 100  # of the entries of an integral and its terms, which may cancel; what rounds them is in its radius
_MORE = 1 + Fraction(1, 2**60)  # times a radius that is rounded
_TAIL = Fraction(1, 2**80)  # share of h below which the rest of a sum may be
_NOT_AT_INPUTS = "loads that are estimated do not act at inputs, known exactly, while x_d is given"
_BENT = "loads that are estimated move x_d, and a last derivative of what is tracked differs between cells"
_LATE = "ticks come early and late, and a load that is estimated oscillates"
Cell = tuple[BallMatrix, BallMatrix]  # F_a in 1/s, (k + p, k + p), and u_a, (m, k + p)


@dataclass(frozen=True, kw_only=True)
class OnEstimates:
    """How x_d, v' and u_ff depend on v = (ŝ, η̂) of k and p entries; p = 0 where no load acts on η.

    Attributes:
        loads: k.
        x_d: [X, N], (n, k + p).
        moves: c_j = A_j [X, N] + B u_j, (n, k + p), in 1/s: all others are means of these.
        cells: F_a and u_a of all cells that differ.
        hull: F_j, (k + p, k + p), in 1/s: all others are means of these.
    """

    loads: int
    x_d: BallMatrix
    moves: Sequence[BallMatrix]
    cells: Sequence[Cell]
    hull: Sequence[BallMatrix]

    @classmethod
    def of(cls, plant: PWASystem, form: NormalForm | None, X: BallMatrix, filtered: int) -> "OnEstimates | None":
        """Return it for x_d + X ŝ and so many η̂; None where no load is estimated, or all are constants at inputs.

        Then ŝ acts on u alone, by −U ŝ. It is not for what `refused` says something of.
        """
        loads, (n, m) = plant.loads, plant.B.shape
        if loads is None or at_inputs(plant, form):
            return None
        k, S, B = loads.S.shape[0], loads.S, plant.exact.B
        if form is None:
            u = zero(m, k) - _matched(plant)
            return cls(loads=k, x_d=X, moves=[B @ u], cells=[(S, u)], hull=[S])
        T, Z, push = form.exact.T[0], form.exact.directions, loads.E - X @ S
        last, eta = (np.cumsum(form.degrees) - 1).tolist(), range(form.r, form.r + filtered)
        C, own = T.part(last, range(n)), T.part(eta, range(n))
        right = Z @ (C @ B @ Z).inverse()
        driven = [own @ (A @ X + push) for A in different(plant.exact.A)]
        if not any(row.radius or any(row.centre.entries()) for row in driven):
            own, eta = zero(0, n), range(0)
        whole, p = beside(X, form.exact.inverse[0].part(range(n), eta)), len(eta)

        def law(A: BallMatrix) -> Cell:
            rate = A @ whole + beside(push, zero(n, p))
            return above(beside(S, zero(k, p)), own @ rate), zero(m, k + p) - right @ C @ rate

        outer = outermost_cells(plant)
        return cls(
            loads=k,
            x_d=whole,
            moves=outermost([A @ whole + B @ law(A)[1] for A in outer]),
            cells=[law(A) for A in different(plant.exact.A)],
            hull=different([law(A)[0] for A in outer]),
        )

    @property
    def eta(self) -> int:
        """How many η̂ count."""
        return self.x_d.shape[1] - self.loads

    def vertices(self, h: Fraction) -> list[BallMatrix]:
        """Return rows on ε: what is held beside u_j ε, and δ after a sample of length h (s), (m + p, k + p) each."""
        size, found = self.x_d.shape[1], list[BallMatrix]()
        eye, eta = BallMatrix(identity(size)), range(self.loads, size)
        for F_a, u_a in self.cells:
            P, Q = integrals(F_a, h)
            mean = u_a @ Q
            found += [above(mean @ F_j, (eye + P @ F_j).part(eta, range(size))) for F_j in self.hull]
        return different(found)

    def turned(self, h: float) -> float:
        """Return how large h times F is at most, h in s, in the largest sum of a row."""
        return h * max(float(np.abs(F.floats).sum(axis=1).max()) for F, _ in self.cells)


def at_inputs(plant: PWASystem, form: NormalForm | None) -> bool:
    """Say whether all loads are constants added to inputs, one for each tracked output where outputs are tracked."""
    square = form is None or len(plant.tracked) == plant.B.shape[1]
    return square and plant.loads is not None and plant.loads.inputs(plant.exact.B) is not None


def refused(plant: PWASystem, form: NormalForm | None, jitter: float) -> str:
    """Return why nothing is said of a program with loads that it estimates; "" where it is."""
    loads = plant.loads
    if loads is None or at_inputs(plant, form):
        return ""
    if form is None and not _is_matched(plant):
        return _NOT_AT_INPUTS
    if form is not None and any(form.piecewise):
        return _BENT
    return _LATE if jitter and any(loads.S.centre.entries()) else ""


def _matched(plant: PWASystem) -> BallMatrix:
    """Return the U that is to have B U = E, if any has."""
    assert plant.loads is not None
    B = plant.exact.B.centre
    return BallMatrix((B.transpose() * B).inv() * B.transpose() * plant.loads.E.centre)


def _is_matched(plant: PWASystem) -> bool:
    loads, B = plant.loads, plant.exact.B
    assert loads is not None
    known = B.radius is None and loads.E.radius is None
    return known and B.centre.rank() == B.shape[1] and B.centre * _matched(plant).centre == loads.E.centre


def integrals(F: BallMatrix, h: Fraction) -> tuple[BallMatrix, BallMatrix]:
    """Return P = ∫ e^(F τ) dτ and Q = ∫ (h − τ) e^(F τ) dτ / h over a sample of h s.

    These are the sums of F^k h^(k + 1) / (k + 1)! and of F^k h^(k + 1) / (k + 2)!. With f the largest sum of a row of
    h |F|, all terms from the K-th on together have no entry above h f^K / (K + 1)! / (1 − f / (K + 2)).

    Example: e^−1 of a decay.

        >>> P, Q = integrals(BallMatrix.of([[-1]]), Fraction(1))
        >>> P.floats.round(6).tolist(), Q.floats.round(6).tolist()
        ([[0.632121]], [[0.367879]])
    """
    size = absolute(F.centre) if F.radius is None else absolute(F.centre) + F.radius
    f = h * max((sum(map(fraction_of, row), Fraction(0)) for row in size.tolist()), default=Fraction(0))
    term, k, left = BallMatrix(identity(F.shape[0])).times(h), 0, h
    P, Q = zero(*F.shape), zero(*F.shape)
    while k < f or left > h * _TAIL:
        P, Q, k = P + term, Q + term.times(Fraction(1, k + 2)), k + 1
        term = _short((term @ F).times(h / (k + 1)))
        left = left * f / (k + 1)
    left = left / (1 - f / (k + 2))
    return _within(P, left), _within(Q, left)


def _within(X: BallMatrix, open_: Fraction) -> BallMatrix:
    """Return a matrix with as much more left open of each entry."""
    ones = flint.fmpq_mat(*X.shape, [number(open_)] * (X.shape[0] * X.shape[1]))
    return _short(X + BallMatrix(zero(*X.shape).centre, ones))


def _short(X: BallMatrix) -> BallMatrix:
    """Return a ball around a matrix, with entries of few digits."""
    entries = [fraction_of(v) for v in X.centre.entries()]
    shown = [_rounded(v) for v in entries]
    off = [abs(v - w) for v, w in zip(entries, shown, strict=True)]
    radius = off if X.radius is None else [v + fraction_of(w) for v, w in zip(off, X.radius.entries(), strict=True)]
    radius = [_rounded(v) * _MORE for v in radius]
    centre, around = (flint.fmpq_mat(*X.shape, [number(v) for v in some]) for some in (shown, radius))
    return BallMatrix(centre, around if any(radius) else None)


def _rounded(v: Fraction) -> Fraction:
    """Return a fraction of few digits that is near."""
    unit = Fraction(2) ** (v.numerator.bit_length() - v.denominator.bit_length() - _BITS)
    return round(v / unit) * unit
