"""The desired trajectory x_d(t) with its feedforward u_ff(t), as the machine makes it."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.errors import Problem
from pwatrack.model.reference import Exosystem


@dataclass(frozen=True, kw_only=True)
class Preview:
    """What is known of a bounded η(t) that was worked out beforehand.

    Attributes:
        names: What each η is.
        residual: sup |η' − (15)| of what is played back, for each η, in its unit per second.
        terms: The largest sum of the sizes of the terms of (15), likewise.
        lead: How long, in s, before the reference first moves η leaves its rest, by more than 1e-3 of its way;
            None where the reference does not begin at rest.
    """

    names: tuple[str, ...]
    residual: Array
    terms: Array
    lead: float | None


@dataclass(frozen=True, kw_only=True)
class DesiredTrajectory:
    """A filter with state η̂ driven by an exosystem with state w; s = (η̂, w, 1).

    In the cell of x_d:  η̂' = rate s,  x_d = x_d s,  u_ff = u_ff s.

    Attributes:
        exosystem: Where w comes from.
        names: What each η̂ is.
        to_eta, eta_offset: η = to_eta x + eta_offset is the plant's part that η̂ is for, (p, n) and (p,).
        rate: (l, p, S) where S = p + len(w) + 1.
        x_d: (n, S).
        u_ff: (l, m, S).
        eta0: η̂(0) where it is fixed by the trajectory, else None.
        preview: What is known of the η that x_d is made of, where it was worked out beforehand.
        until: Up to when, in s, (3) was decided for x_d in closed form; None: for all times.
        bounded: Whether x_d is proved to stay bounded.
        growth: How x_d is seen to grow without bound, or to leave the periodic solution that it was to be, where it is.
    """

    exosystem: Exosystem
    names: tuple[str, ...]
    to_eta: Array
    eta_offset: Array
    rate: Array
    x_d: Array
    u_ff: Array
    eta0: Array | None = None
    preview: Preview | None = None
    until: float | None = None
    bounded: bool = True
    growth: Problem | None = None


def output_trajectory(generator: TrajectoryGenerator, y_d: Exosystem) -> DesiredTrajectory:
    """Return x̂_d of (15) and û_ff of (16) for a reference y_d, any η̂(0)."""
    r, form = generator.r, generator.form
    cells, p = generator.A_eta.shape[:2]
    n, s = len(form.T), len(y_d.w0)
    w, size = slice(p, p + s), p + s + 1

    xi_d = np.zeros((r + 1, size))  # ξ_d and y_d⁽ʳ⁾
    xi_d[:, w] = y_d.derivative_rows(r)[:, 0]
    X_xi, X_eta, x_0 = generator.state()
    x_d = X_xi @ xi_d[:r]
    x_d[:, :p] += X_eta
    x_d[:, -1] += x_0
    F_xi, F_eta, f = generator.feedforward()
    u_ff = F_xi @ xi_d
    u_ff[:, :p] += F_eta
    u_ff[:, -1] += f
    rate = generator.B_eta @ xi_d
    rate[:, :, :p] += generator.A_eta
    rate[:, :, -1] += generator.b_eta
    return DesiredTrajectory(
        exosystem=y_d,
        names=form.eta_names,
        to_eta=form.T[r:].reshape(n - r, n),
        eta_offset=form.offset[r:],
        rate=rate.reshape(cells, p, size),
        x_d=x_d,
        u_ff=u_ff[:, None, :],
    )
