"""What the program makes of estimates of loads in x_d, u_ff and η̂, and what errors of these do to a sampled loop.

Let ε be what v = (ŝ, η̂) of a tick is more than that of the true loads, and j a mean of the cells on the way. Then x_d
is more by D_j ε, D_j = [X, N_j], v' by F_j ε, F_j = [S, 0; W_j, A_ηj], and in the cell a of x_d

    B u_ff by (c_aj − A_j D_j) ε, c_aj = [X S − E, 0] + N_a [F_j]_η,     x − x_d is driven by (c_aj − A_i D_j) ε,

beside what acts from outside. One sample later v is v + P(F_a) v', and the mean of u_ff, which is held, is u_ff + u_a
Q(F_a) v', u_a the rows of u_ff on v, P(F) = ∫ e^(F τ) dτ over h and Q(F) = ∫ (h − τ) e^(F τ) dτ / h. It is derived in
`docs/theory/beyond.md`, *A loop that is sampled*, under loads elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import flint
import numpy as np

from pwatrack.ball_matrix import BallMatrix, above, absolute, beside, different, each, places, zero
from pwatrack.control.vertices import outermost
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import fraction_of, identity, number

_BITS = 100  # of the entries of an integral and its terms, which may cancel; what rounds them is in its radius
_MORE = 1 + Fraction(1, 2**60)  # times a radius that is rounded
_TAIL = Fraction(1, 2**80)  # share of h below which the rest of a sum may be
Cell = tuple[BallMatrix, BallMatrix]  # F_a in 1/s, (k + p, k + p), and u_a, (m, k + p)
Mean = tuple[BallMatrix, BallMatrix]  # F_j or c_aj, in 1/s, (·, k + p), and D_j, (n, k + p)


@dataclass(frozen=True, kw_only=True)
class OnEstimates:
    """How x_d, v' and u_ff depend on v = (ŝ, η̂) of k and p entries; p = 0 where no load acts on η."""

    loads: int  # k
    moves: Sequence[Mean]  # c_aj and D_j: all others are means of these
    cells: Sequence[Cell]  # F_a and u_a of all cells that differ
    hull: Sequence[Mean]  # F_j and D_j: all others are means of these

    @classmethod
    def of(cls, plant: PWASystem, form: NormalForm | None, X: BallMatrix, filtered: int) -> "OnEstimates | None":
        """Return it for x_d + X ŝ and so many η̂; None where no load is estimated, or all are constants at inputs.

        Then ŝ acts on u alone, by −U ŝ. It is not for what `refused` says something of.
        """
        loads, (n, m) = plant.loads, plant.B.shape
        if loads is None or at_inputs(plant, form):
            return None
        k, S = loads.S.shape[0], loads.S
        if form is None:
            cells = [(S, zero(m, k) - _matched(plant))]
            return cls(loads=k, moves=[(zero(n, k) - loads.E, X)], cells=cells, hull=[(S, X)])
        A, T, inverse, Z = plant.exact.A, form.exact.T, form.exact.inverse, form.exact.directions
        push, last = loads.E - X @ S, (np.cumsum(form.degrees) - 1).tolist()
        own = T[0].part(range(form.r, form.r + filtered), range(n))
        if not any(row.radius or any(row.centre.entries()) for row in (own @ (A_i @ X + push) for A_i in different(A))):
            own = zero(0, n)
        p = own.shape[0]
        eta = each(lambda back: back.part(range(n), range(form.r, form.r + p)), inverse)

        def law(i: int) -> tuple[BallMatrix, BallMatrix, BallMatrix]:
            """Return F, u and D of a cell."""
            D, C = beside(X, eta[i]), T[i].part(last, range(n))
            rate = A[i] @ D + beside(push, zero(n, p))
            u = zero(m, k + p) - Z @ (C @ plant.exact.B @ Z).inverse() @ C @ rate
            return above(beside(S, zero(k, p)), own @ rate), u, D

        laws, one = [law(i) for i in places(A)], len(different(T)) == 1
        hull = _means([law(i)[::2] for i in plant.hull] if one else [(F, D) for F, _, D in laws])
        alone = beside(zero(n, k) - push, zero(n, p))
        moves = [(alone + N @ F.part(range(k, k + p), range(k + p)), D) for N in outermost(eta) for F, D in hull]
        return cls(loads=k, moves=_means(moves), cells=[(F, u) for F, u, _ in laws], hull=hull)

    @property
    def order(self) -> int:
        """How many entries v has."""
        return self.hull[0][0].shape[0]

    @property
    def eta(self) -> int:
        """How many η̂ count."""
        return self.order - self.loads

    @property
    def X(self) -> BallMatrix:
        """What x_d is more by for each ŝ, (n, k)."""
        D = self.hull[0][1]
        return D.part(range(D.shape[0]), range(self.loads))

    def vertices(self, h: Fraction) -> list[tuple[BallMatrix, BallMatrix, BallMatrix]]:
        """Return rows on ε: D_j, what is held beside u_ff at the tick, and δ after a sample of length h (s)."""
        found, eye, columns = list[BallMatrix](), BallMatrix(identity(self.order)), range(self.order)
        for F_a, u_a in self.cells:
            P, Q = integrals(F_a, h)
            mean = u_a @ Q
            found += [above(D, mean @ F, (eye + P @ F).part(columns[self.loads :], columns)) for F, D in self.hull]
        n, m = self.hull[0][1].shape[0], self.cells[0][1].shape[0]
        x, u, eta = range(n), range(n, n + m), range(n + m, n + m + self.eta)
        return [(X.part(x, columns), X.part(u, columns), X.part(eta, columns)) for X in different(found)]

    def turned(self, h: float) -> float:
        """Return how large h times F is at most, h in s, in the largest sum of a row."""
        return h * max(float(np.abs(F.floats).sum(axis=1).max()) for F, _ in self.cells)


def at_inputs(plant: PWASystem, form: NormalForm | None) -> bool:
    """Say whether all loads are constants added to inputs, one for each tracked output where outputs are tracked."""
    square = form is None or len(plant.tracked) == plant.B.shape[1]
    return square and bool(plant.load_inputs)


def refused(plant: PWASystem, form: NormalForm | None, jitter: float) -> str:
    """Return why nothing is said of a program with loads that it estimates; "" where it is."""
    loads, B = plant.loads, plant.exact.B
    if loads is None or at_inputs(plant, form):
        return ""
    known = B.radius is None and loads.E.radius is None and B.centre.rank() == B.shape[1]
    if form is None and not (known and B.centre * _matched(plant).centre == loads.E.centre):
        return "loads that are estimated do not act at inputs, known exactly, while x_d is given"
    oscillates = jitter and any(loads.S.centre.entries())
    return "ticks come early and late, and a load that is estimated oscillates" if oscillates else ""


def _matched(plant: PWASystem) -> BallMatrix:
    """Return the U that is to have B U = E, if any has."""
    assert plant.loads is not None
    B = plant.exact.B.centre
    return BallMatrix((B.transpose() * B).inv() * B.transpose() * plant.loads.E.centre)


def _means(pairs: Sequence[Mean]) -> list[Mean]:
    """Return those that have all others in their hull, each pair as one."""
    rows = pairs[0][0].shape[0]
    whole, columns = outermost([above(*pair) for pair in pairs]), range(pairs[0][0].shape[1])
    return [(X.part(range(rows), columns), X.part(range(rows, X.shape[0]), columns)) for X in whole]


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
    known = [Fraction(0)] * len(entries) if X.radius is None else [fraction_of(v) for v in X.radius.entries()]
    shown = [_rounded(v) for v in entries]
    radius = [_rounded(abs(v - w) + r) * _MORE for v, w, r in zip(entries, shown, known, strict=True)]
    centre, around = (flint.fmpq_mat(*X.shape, [number(v) for v in some]) for some in (shown, radius))
    return BallMatrix(centre, around if any(radius) else None)


def _rounded(v: Fraction) -> Fraction:
    """Return a fraction of few digits that is near."""
    unit = Fraction(2) ** (v.numerator.bit_length() - v.denominator.bit_length() - _BITS)
    return round(v / unit) * unit
