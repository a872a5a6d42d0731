"""What is played back: polynomials beside an exosystem, the cells x_d visits on them, and what is left over of (15)."""

from typing import Any

import numpy as np

from pwatrack.arrays import EPS, Array
from pwatrack.control.trajectory import DesiredTrajectory, NoncausalTrajectory
from pwatrack.model.reference import Exosystem, exosystem
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.simulation.curve import FIT, InternalDynamics, Looked, Pieces

_INSTANT = 1e-9  # of a piece: a shorter stay beyond a facet adds nothing that a simulation could show


def played(
    trajectory: DesiredTrajectory, pieces: Pieces, turns: int, period: float
) -> tuple[tuple[Signal, ...], NoncausalTrajectory]:
    """Return pieces as they are played back, some turns of them, in units given, one signal per η, and their measures.

    In which cells x_d is on them is looked for in one turn, and how well (15) is satisfied in the worst one.
    """
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
    looked = field.look(cut, w.astype(np.float64), off, sharp=True)
    z = np.hstack([cut.c[:, :, 0], w.astype(np.float64), np.ones((len(cut.c), 1))])
    cells = looked.cells()[np.searchsorted(looked.start, cut.start)]
    return tuple(_signal(start, np.tile(pieces.c[:, k], (turns, 1))) for k in range(p)), NoncausalTrajectory(
        names=trajectory.names,
        residual=looked.residual.max(axis=0),
        terms=np.einsum("nps,ns->np", np.abs(trajectory.rate[cells]), np.abs(z)).max(axis=0),
        left=_left(trajectory, pieces, cut, looked, turns, period),
        times=start[1:],
        jumps=_jumps(pieces, turns),
        lead=None,
    )


def states_at(system: Exosystem, t: Array) -> Any:
    """Return w at some times in s in extended precision, (K, s)."""
    return system.states(np.asarray(t, dtype=np.longdouble))


def _signal(starts: Array, c: Array) -> Signal:
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


def _jumps(pieces: Pieces, turns: int) -> Array:
    """Return by how much polynomials that follow each other, some turns of them, jump from one to the next, (K, p)."""
    c, span = pieces.c, pieces.length[:, None]
    last = (c * span[:, :, None] ** np.arange(c.shape[2])).sum(axis=2)
    jumps = np.abs(np.roll(c[:, :, 0], -1, axis=0) - last)
    return np.asarray(jumps[np.arange(turns * len(c) - 1) % len(c)])
