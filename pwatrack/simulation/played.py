"""What is played back: polynomials beside an exosystem, the cells x_d visits on them, and what is left over of (15)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev

from pwatrack.arrays import EPS, Array, IntArray
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.model.reference import Exosystem, exosystem
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.simulation.curve import MOST_TURN, Curve, InternalDynamics, Looked

DEGREE = 9  # of the polynomials that are played back
_INSTANT = 1e-9  # of a piece: a shorter stay beyond a facet adds nothing that a simulation could show


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """N polynomials in time since their starts in s, (N, p, degree + 1), each of so long and in the stay `of`."""

    start: Array
    length: Array
    c: Array
    of: IntArray

    @staticmethod
    def joined(parts: "Sequence[Pieces]") -> "Pieces":
        """Return all of them, in order of time."""
        found = {name: np.concatenate([getattr(part, name) for part in parts]) for name in Pieces.__annotations__}
        order = np.argsort(found["start"], kind="stable")
        return Pieces(**{name: values[order] for name, values in found.items()})

    def cut(self, fastest: float) -> "Pieces":
        """Return pieces so short that nothing of such a rate turns much on them; `of` is the piece each is from."""
        count = np.maximum(1, np.ceil(self.length * fastest / MOST_TURN)).astype(np.int64)
        of = np.repeat(np.arange(len(count)), count)
        length = self.length[of] / count[of]
        since = (np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)) * length
        c, moved = self.c[of].astype(np.longdouble), np.array(since, dtype=np.longdouble)[:, None]
        for k in range(c.shape[2] - 1):  # Horner's rule for each derivative
            for j in range(c.shape[2] - 2, k - 1, -1):
                c[:, :, j] += moved * c[:, :, j + 1]
        return Pieces(start=self.start[of] + since, length=length, c=c.astype(np.float64), of=of)


@dataclass(frozen=True, kw_only=True)
class Played:
    """Pieces as they are played back, some turns of them, in units given.

    Attributes:
        signals: One per η.
        start: When each piece begins, of all turns, in s.
        looked: In which cells x_d is on the pieces of one turn, and how well (15) is satisfied, in the worst turn.
        terms: The largest sum of the sizes of the terms of (15) at starts of pieces, (p,).
        left: ρ = η' − (15) over time, one signal per η, in polynomials.
    """

    signals: tuple[Signal, ...]
    start: Array
    looked: Looked
    terms: Array
    left: Exosystem

    @staticmethod
    def of(trajectory: DesiredTrajectory, pieces: Pieces, turns: int, period: float) -> "Played":
        """Look at what is played back of a trajectory."""
        system, p = trajectory.exosystem, trajectory.rate.shape[1]
        field = InternalDynamics(rate=trajectory.rate, guards=trajectory.guards, signs=trajectory.signs, S=system.S)
        start = np.concatenate([k * period + pieces.start for k in range(turns)])
        cut = pieces.cut(float(np.abs(system.rates).max(initial=0.0)))
        w = states_at(system, cut.start)
        off = np.zeros(w.shape)
        for k in range(turns):
            begin = (k * period + pieces.start)[cut.of] + (cut.start - pieces.start[cut.of]).astype(np.longdouble)
            true = states_at(system, begin)
            phase = np.multiply.outer(np.abs(begin), np.abs(system.rates)) * np.finfo(np.longdouble).eps
            apart = np.abs(true - w) + EPS * np.abs(true) + phase * np.abs(true).max(initial=0.0)
            off = np.maximum(off, apart.astype(np.float64))
        number = np.arange(len(cut.start))
        looked = field.look(
            Curve(start=cut.start, length=cut.length, c=cut.c, w=w.astype(np.float64), off=off, of=number), sharp=True
        )
        z = np.hstack([cut.c[:, :, 0], w.astype(np.float64), np.ones((len(cut.c), 1))])
        cells = looked.cells()
        at = np.searchsorted(looked.start, cut.start)
        terms = np.einsum("nps,ns->np", np.abs(trajectory.rate[cells[at]]), np.abs(z)).max(axis=0)
        return Played(
            signals=tuple(_signal(start, np.tile(pieces.c[:, k], (turns, 1))) for k in range(p)),
            start=start,
            looked=looked,
            terms=terms,
            left=_left(trajectory, pieces, cut, looked, turns, period),
        )


def states_at(system: Exosystem, t: Array) -> Any:
    """Return w at some times in s in extended precision, (K, s)."""
    return system.states(np.asarray(t, dtype=np.longdouble))


def _signal(starts: Array, c: Array) -> Signal:
    """Return the signal of polynomials, (N, degree + 1), from such times on."""
    return Signal(tuple(starts.tolist()), tuple(ExponentialPolynomial.polynomial(row) for row in c))


def _left(
    trajectory: DesiredTrajectory, pieces: Pieces, cut: Pieces, looked: Looked, turns: int, period: float
) -> Exosystem:
    """Return ρ = η' − (15) over time, in polynomials between the times at which x_d changes its cell or polynomial.

    It is a difference of large terms, so it is taken with more digits, at Chebyshev points.
    """
    system, cells, interpolation = trajectory.exosystem, looked.cells(), FIT
    piece = cut.of[looked.of]
    long = looked.length > _INSTANT * pieces.length[piece]
    cells, piece, begin = cells[long], piece[long], looked.start[long]
    new = np.append(True, (np.diff(cells) != 0) | (np.diff(piece) != 0))
    cells, piece, begin = cells[new], piece[new], begin[new]
    since = np.where(np.append(True, np.diff(piece) != 0), 0.0, begin - pieces.start[piece])
    until = np.append(since[1:], 0.0)
    until = np.where(np.append(np.diff(piece) != 0, True), pieces.length[piece], until)
    half = (until - since) / 2  # where a polynomial of the next degree is nearly one of this
    since, piece, cells, half = (np.repeat(v, 2) for v in (since, piece, cells, half))
    since[1::2] += half[1::2]
    points = interpolation.points[: interpolation.count]
    tau = since[:, None].astype(np.longdouble) + half[:, None] * points
    eta = slope = np.zeros((*tau.shape, pieces.c.shape[1]), dtype=np.longdouble)
    for c in pieces.c[piece].transpose(2, 0, 1)[::-1]:  # Horner's rule
        slope, eta = slope * tau[:, :, None] + eta, eta * tau[:, :, None] + c[:, None]
    starts, found = [], []
    for k in range(turns):
        begin = k * period + pieces.start
        t = begin[piece, None] + tau
        w = states_at(system, t.ravel()).reshape(*t.shape, -1)
        z = np.concatenate([eta, w, np.ones((*t.shape, 1))], axis=2)
        rho = slope - np.einsum("nps,nts->ntp", trajectory.rate[cells], z)
        found.append(interpolation.through(rho.astype(np.float64), half))
        starts.append(begin[piece] + since)
    all_ = np.concatenate(found)
    return exosystem([_signal(np.concatenate(starts), all_[:, k]) for k in range(all_.shape[1])])


def jumps_of(pieces: Pieces, turns: int) -> Array:
    """Return by how much polynomials that follow each other, some turns of them, jump from one to the next, (K, p)."""
    c, span = pieces.c, pieces.length[:, None]
    last = (c * span[:, :, None] ** np.arange(c.shape[2])).sum(axis=2)
    jumps = np.abs(np.roll(c[:, :, 0], -1, axis=0) - last)
    return np.asarray(jumps[np.arange(turns * len(c) - 1) % len(c)])


class Interpolation:
    """Polynomials through values at Chebyshev points, as powers of the time since the left end."""

    def __init__(self, degree: int) -> None:
        unit = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
        between = np.cos(np.pi * np.arange(degree + 2) / (degree + 1))
        self.count, self.points = degree + 1, (1 + np.concatenate([unit, between])) / 2
        self._series = np.linalg.inv(chebyshev.chebvander(unit, degree))  # from values to a Chebyshev series
        self._others = chebyshev.chebvander(between, degree)
        shifted = [Chebyshev.basis(k, domain=[0, 1]).convert(kind=Polynomial).coef for k in range(degree + 1)]
        self._powers = np.array([np.pad(c, (0, degree + 1 - len(c))) for c in shifted]).T

    def __call__(self, seen: Array, span: Array) -> tuple[Array, Array]:
        """Return coefficients (N, p, degree + 1) for values (N, points, p), and by how much they miss others, (N,)."""
        known, others = seen[:, : self.count], seen[:, self.count :]
        off = np.abs(self._others @ (self._series @ known) - others).max(axis=(1, 2))
        return self.through(known, span), np.asarray(off)

    def through(self, known: Array, span: Array) -> Array:
        """Return the coefficients of polynomials through values at the first points, (N, count, p)."""
        powers = (self._powers @ (self._series @ known)).transpose(0, 2, 1)
        return np.asarray(powers / span[:, None, None] ** np.arange(self.count))


FIT = Interpolation(DEGREE)
