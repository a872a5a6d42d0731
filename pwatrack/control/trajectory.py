"""The desired trajectory x_d(t) with its feedforward u_ff(t), as the machine makes it; how well its breaks are timed.

None of the pieces of a reference begins at exactly the time that is meant: times are rounded.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import EPS, TINY, Array, IntArray
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.errors import Problem
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Exosystem

_MOST_DOUBLINGS = 60  # of a fraction of the fastest time constant: no plant has slower ones


@dataclass(frozen=True, kw_only=True)
class NoncausalTrajectory:
    """What is known of a bounded η(t) that was worked out beforehand."""

    names: tuple[str, ...]  # what each η is
    residual: Array  # above |η' − (15)| of what is played back at all times, for each η, in its unit per second
    left: Exosystem  # η' − (15) itself over time, one signal per η
    terms: Array  # the largest sum of the sizes of the terms of (15) at the starts of polynomials, likewise
    times: Array  # when, in s, η jumps from one polynomial to the next, (K,)
    jumps: Array  # by how much each does, (K, p)
    # how long, in s, before the reference first moves η leaves its rest, by more than 1e-3 of its way; None where the
    # reference does not begin at rest
    lead: float | None

    @property
    def share(self) -> float:
        """How far η' is off (15) at most, as a share of its terms, with jumps as ways over the polynomials before."""
        ways = self.jumps / np.diff(self.times, prepend=0.0)[:, None]
        off = self.residual + ways.max(axis=0, initial=0.0)
        return float((off / np.maximum(self.terms, TINY)).max(initial=0.0))

    def measured(self, each: Array, rate: float) -> float:
        """Return what residual and jumps leave of a measure W that has W' ≤ −rate W of what is off.

        W' is at most Σ residual_k each_k more than that, and W grows by Σ jump_k each_k at most where η jumps; `each`
        is W of what 1 of each η makes of x_d, in each cell, (l, p).
        """
        kicks = (self.jumps @ each.T).max(axis=1, initial=0.0)
        most = W = 0.0
        for kick, fall in zip(kicks.tolist(), np.exp(-rate * np.diff(self.times, prepend=0.0)).tolist(), strict=True):
            W = W * fall + kick
            most = max(most, W)
        return float((each @ self.residual).max()) / rate + most


@dataclass(frozen=True, kw_only=True)
class DesiredTrajectory:
    """A filter with state η̂ driven by an exosystem with state w; s = (η̂, w, 1).

    In the cell of x_d:  η̂' = rate s,  x_d = x_d s,  u_ff = u_ff s. x_d is continuous; where a last derivative of the
    output is piecewise affine (see `NormalForm`), its rows depend on the cell, and u_ff jumps from cell to cell.
    """

    exosystem: Exosystem  # where w comes from
    names: tuple[str, ...]  # what each η̂ is
    to_eta: Array  # η = to_eta x + eta_offset is the plant's part that η̂ is for, (p, n)
    eta_offset: Array  # (p,)
    rate: Array  # (l, p, S) where S = p + len(w) + 1
    x_d: Array  # (l, n, S)
    u_ff: Array  # (l, m, S)
    guards: Array  # rows g with g s = 0 where a cell ends, (k, S)
    signs: IntArray  # side of each of these that a cell is on, 0 where that does not bound it, (l, k)
    # s' = turns s that x_d is made for where s turns otherwise, by the residual of what is played back, (l, S, S)
    turns: Array | None = None
    generator: TrajectoryGenerator | None = None  # the filter, where it is (15): for output tracking only
    eta0: Array | None = None  # η̂(0) where it is fixed by the trajectory, else None
    preview: NoncausalTrajectory | None = None  # of the η that x_d is made of, if worked out beforehand
    until: float | None = None  # up to when, in s, (3) was decided for x_d in closed form; None: for all times
    bounded: bool = True  # whether x_d is proved to stay bounded
    growth: Problem | None = None  # how x_d is seen to grow without bound, or to leave its periodic solution

    def state(self, s: Array) -> Array:
        """Return x_d (n,) for s = (η̂, w, 1), (S,)."""
        inside = (self.signs * np.sign(self.guards @ s) >= 0).all(axis=1)
        return np.asarray(self.x_d[int(np.argmax(inside))] @ s)

    @classmethod
    def linear(cls, plant: PWASystem, *, exosystem: Exosystem, x_d: Array, **rest: Any) -> "DesiredTrajectory":
        """Return the trajectory whose x_d has the same rows (n, S) in all cells: then these are cut by the plant's.

        Without more, nothing is filtered.
        """
        cells, n = plant.A.shape[:2]
        rate = np.zeros((cells, 0, len(exosystem.w0) + 1))
        nothing: dict[str, Any] = {"names": (), "to_eta": np.zeros((0, n)), "eta_offset": np.zeros(0), "rate": rate}
        guards = plant.partition.H @ x_d
        guards[:, -1] += plant.partition.h
        rows, signs = np.broadcast_to(x_d, (cells, *x_d.shape)), plant.partition.signs
        return cls(exosystem=exosystem, x_d=rows, guards=guards, signs=signs, **(nothing | rest))


def output_trajectory(generator: TrajectoryGenerator, y_d: Exosystem) -> DesiredTrajectory:
    """Return x̂_d of (15) and û_ff of (16) for references y_d, one per tracked output, any η̂(0)."""
    form, r = generator.form, generator.form.r
    p, n, s = generator.A_eta.shape[1], form.T.shape[1], len(y_d.w0)
    w, size = slice(p, p + s), p + s + 1

    rows = y_d.derivative_rows(max(form.degrees))
    xi_d = np.zeros((r + len(form.degrees), size))  # ξ_d and y_d⁽ʳ⁾
    xi_d[:r, w] = np.vstack([rows[:degree, j] for j, degree in enumerate(form.degrees)])
    xi_d[r:, w] = [rows[degree, j] for j, degree in enumerate(form.degrees)]
    T, X, boundary = form.T_inverse, form.right_inverse, form.boundary

    def made(on_xi: Array, on_eta: Array, constant: Array) -> Array:
        """Return rows on s of rows on ξ_d (and y_d⁽ʳ⁾), on η̂ and of a constant."""
        found = np.asarray(on_xi @ xi_d[: on_xi.shape[-1]])
        found[..., :p] += on_eta
        found[..., -1] += constant
        return found

    # (16): û_ff = F_ξ [ξ_d; y_d⁽ʳ⁾] + F_η η̂ + f
    F_xi, f = np.concatenate([-X @ form.alpha, X], axis=2), -np.einsum("lmp,lp->lm", X, form.gamma)
    return DesiredTrajectory(
        generator=generator,
        exosystem=y_d,
        names=form.eta_names,
        to_eta=form.T[0, r:].reshape(n - r, n),
        eta_offset=form.offset[0, r:],
        rate=made(generator.B_eta, generator.A_eta, generator.b_eta),
        x_d=made(T[:, :, :r], T[:, :, r:], -np.einsum("lij,lj->li", T, form.offset)),
        u_ff=made(F_xi, -(X @ form.beta), f),
        guards=made(boundary.H[:, :r], boundary.H[:, r:], boundary.h),
        signs=boundary.signs,
    )


def timing_error(plant: PWASystem, K: Array, trajectory: DesiredTrajectory, *, outputs: Array) -> tuple[float, float]:
    """Estimate the tracking error that the rounding of break times makes, relative to the reference, and its time.

    A break at t is known to ε t only. The plant follows the old piece for that much longer, and then is off by
    ẋ_d(t) ε t; from there the error runs as e^{(A_i + BK)t}, which is followed here at times 1, 2, 4, … of a fraction
    of the fastest time constant. What of x shall follow is `outputs` (q, n): C, or I for state tracking.
    """
    system, p = trajectory.exosystem, trajectory.rate.shape[1]
    if not system.resets:
        return 0.0, 0.0
    rows = trajectory.x_d[:, :, p:-1]
    times, jumps = [0.0], [np.zeros(len(plant.B))]
    for resets in system.resets:
        t, where, rates = resets.t, resets.where, system.states(resets.t) @ system.S.T
        for X in np.unique(rows, axis=0):
            off = rates[:, where] @ X[:, where].T * (EPS * t[:, None])  # ẋ_d ε t
            for k in sorted(set(np.abs(off).argmax(axis=0).tolist())):
                times.append(float(t[k]))
                jumps.append(off[k])
    breaks = np.unique(np.append(0.0, system.breaks))
    wanted = system.states(breaks) @ (outputs @ rows[0]).T
    swing, most = np.ptp(wanted, axis=0), np.abs(wanted).max(axis=0)
    rests = np.where(most > 0, most, np.inf)  # of one that rests its size is where, if not at 0
    size = np.where(swing > EPS * most, swing, rests)
    with np.errstate(all="ignore"):
        relative = _largest(plant, K, outputs, np.array(jumps).T) / size[:, None]
    relative = np.where(np.isnan(relative), 0.0, relative)  # nothing off, and nothing wanted
    k = int(np.argmax(relative.max(axis=0)))
    return float(relative[:, k].max()), times[k]


def _largest(plant: PWASystem, K: Array, outputs: Array, starts: Array) -> Array:
    """Return the largest entries of outputs e^{(A_i + BK)t} starts, about, over all t and cells, (q, starts)."""
    found = np.abs(outputs @ starts)
    for A in plant.A + plant.B @ K:
        speed = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
        if not 0 < speed < np.inf:
            continue
        step = expm(0.25 / speed * A)
        for _ in range(_MOST_DOUBLINGS):
            found = np.maximum(found, np.abs(outputs @ step @ starts))
            if not 1e-3 < np.abs(step).max() < 1e30:
                break
            step = step @ step
    return found
