"""How what acts on a sampled loop enters its errors z = (e, ν, Δ, σ, ρ), and how signals are read off these.

Let ω be u as it is put out less ν less u_ff(t). The nominal loop, of the mean A₀ of the cells
and without noise, has e₀' = A₀ e₀ + B (K e₀(t_k) + ω), e₀(0) = 0, all of which is known from the reference. With t_p
where a substep began, z less (e₀, K e₀(t_k), 0, 0, R (e₀ − e₀(t_p))) obeys the same as z, with (A_i − A₀) e₀ in place
of B ω, and with R (e₀ − e₀(t_p)) beside what R x_d moves. Rows of A_i − A₀ are in the span of R, which has a column in
which one row alone is 1: with the unit vectors ε_k of these columns (A_i − A₀) e₀ = Σ_k (A_i − A₀) ε_k R_k e₀. So what
is left is driven, with `sampled_error`, by scalars, each as large as it likes:

    ("disturbance", k)   d in the k-th state equation: e' + d ε_k and all Δ' − d ε_k, so that ρ' is what it was
    ("deviation", k)     likewise with E_k in place of ε_k: what merging leaves out of the k-th element; where all cells
                         are predicted, in e' and all ρ' alone
    ("noise", k)         d on the k-th output as it is measured at a tick: (Δ, σ)⁺ − M ε_k d, ν⁺ − K M ε_k d; where
                         inputs are late only (Δ_0, σ_0)⁺
    ("input", k)         d on the k-th input as it is put out: it acts beside ν_k
    ("nominal", k)       R_k e₀: it acts by F_i − F₀
    ("drawn", k)         d in e_k' alone, so that ρ' has R ε_k d
    ("cell", k)          d on the k-th input as it is put out, as ("input", k) is
    ("eta", k)           d on the k-th entry of δ at a tick
    ("load", k)          d on the k-th entry of s just before a tick: (e, σ_i) − (X ε_k, ε_k) d, then the tick
    ("moved", k)         R_k ((x_d + e₀)(t) − (x_d + e₀)(t_p)) in a substep: it acts beside ρ_k, of all predictions

Where λ times as much time passes as the program counts, in which e' is λ times as large and Δ' has (1 − λ) of it more,
(λ − 1) ((x_d + e₀)' − Σ_k A₀ ε_k R_k e₀) is one more disturbance, and others are λ times as large.

V of a tube (see `lmi.clocked_tubes`) has V' ≤ −a V + a d², or V⁺ ≤ (1 − b) V + b d² at ticks: so it is at most the mean
square of d with weights that fade, which `level` adds up; or V^½' ≤ −(a / 2) V^½ + |d| of what is summed.

What moved drives by A_a − A_b, of the cells of the prediction as its substep began and now: by nothing in a substep in
which both are on one side of every plane. "drawn", "cell" and "eta" are of estimates of loads, see
`simulation.acting_estimates`: they are there in a sample only if these move x_d across a plane from where it is in it.
"load" is of loads that step, see `simulation.loads_along`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy  # whose parts are imported where they are used

from pwatrack.arrays import OVER_POWERS, Array
from pwatrack.ball_matrix import BallMatrix, above, zero
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.lmi.clocked_tubes import Drive, Tube
from pwatrack.rational import identity, pivots


@dataclass(frozen=True, kw_only=True)
class Acting:
    """What acts in a run, in each of its K substeps.

    Attributes:
        squares: The mean of d² of each channel, but for those that are 0, (K,); of noise d² at the tick before.
        means: The mean of |d| of those that may be summed, likewise.
        beside: How large at most that is which signals have beside c z, (K,): that of the nominal loop.
        planes: Normals of the planes between cells, (P, n).
        near: How near x_d + e₀ comes to each of them, in H x, (K, P).
        apart: How near x_d comes to each of them in the sample, and that of the program at its tick, likewise.
        loads: How large those get that step, and are constants in between, (k,); 0 of others.
        changes: By how much what is held along x_d + e₀ changes from tick to tick at most, from 0 on, (m,).
        along: Between what numbers of the program are with x̂ = x = x_d + e₀, (k, 2) each: x_hat, y, u as it is held;
            x_d, u_ff, eta_hat and w at ticks.
    """

    squares: Mapping[Channel, Array]
    means: Mapping[Channel, Array]
    beside: Mapping[Form, Array]
    planes: Array
    near: Array
    apart: Array
    changes: Array
    loads: Array
    along: Mapping[str, Array] = field(default_factory=dict)


def level(acts: Acting, channel: Channel, tube: Tube, gains: SampledGains, where: Array | float = 1.0) -> Array:
    """Return what V^½ is at most in each substep, from V = 0 on, (K,).

    Args:
        acts: What acts.
        channel: Which of it the tube is of.
        tube: Its tube.
        gains: Of the program.
        where: 0 for substeps in which it is known not to act, (K,).
    """
    step, d = gains.sample_time / gains.substeps, acts.squares[channel] * where
    if tube.summed and tube.b:
        ticks = scipy.signal.lfilter([1.0], [1.0, -np.sqrt(1 - tube.b)], np.sqrt(d[:: gains.substeps]))
        return np.asarray(np.repeat(ticks, gains.substeps)[: len(d)] * OVER_POWERS)
    if channel[0] in ("noise", "eta"):
        ticks = scipy.signal.lfilter([tube.b], [1.0, tube.b - 1.0], d[:: gains.substeps])
        return np.asarray(np.sqrt(np.repeat(ticks, gains.substeps)[: len(d)]) * OVER_POWERS)
    if tube.summed:
        return faded(acts.means[channel] * where * step, tube.a / 2 * step)
    return np.asarray(np.sqrt(faded(tube.a * d * step, tube.a * step)))


def faded(added: Array, fall: float) -> Array:
    """Return what is there in each substep at most, where some is added in each and what is there falls by e^−fall.

    Example:
        >>> faded(np.array([1.0, 0.0, 1.0]), np.log(2)).round(2).tolist()
        [1.0, 1.0, 1.5]
    """
    after = scipy.signal.lfilter([1.0], [1.0, -np.exp(-fall)], added)
    return np.asarray((np.append(0.0, after[:-1]) + added) * OVER_POWERS)


def driven(errors: SampledErrors, channel: Channel) -> Drive:
    """Return how 1 of what acts enters z; what is measured counts with the other sign."""
    (kind, k), (n, m, N, *_), d, order = channel, errors.widths, errors.predicted, errors.order
    nothing, first, rest = zero(order, 1), n + m + d * N, zero(sum(errors.more), 1)
    if kind == "noise":
        M, nothing_yet = BallMatrix.of(errors.gains.M[:, [k]]), zero(sum(errors.more[1:]), 1)
        put_out = errors.put_out(zero(n, 1), zero(N, 1) if errors.gains.delay else M, nothing_yet)
        others = zero(order - n - m - N - sum(errors.more), 1)
        kicks = [above(zero(n, 1), nu, M, others, rest) for nu, rest in put_out]
        return Drive(held=nothing, between=nothing, ticks=kicks)
    if kind == "eta":
        kick = _unit(order, order - errors.more[-1] + k)
        return Drive(held=nothing, between=nothing, ticks=[kick] * len(errors.ticks))
    if kind == "load":
        own, X = _unit(N, n + k), zero(n, 1) if errors.estimates is None else errors.estimates.X.part(range(n), [k])
        step = above(X, zero(m, 1), *d * [own], zero(order - first, 1))
        return Drive(held=nothing, between=nothing, ticks=[J @ step for J in errors.ticks])
    if kind in ("disturbance", "deviation", "drawn"):
        one = errors.deviations[k][0] if kind == "deviation" else _unit(n, k)
        if kind == "drawn" or (kind == "deviation" and errors.plant.watched is not None):
            return Drive(held=nothing, between=above(one, zero(m + d * N, 1), *d * [errors.R @ one], rest))
        off = above(zero(n, 1) - one, zero(N - n, 1))
        return Drive(held=nothing, between=above(one, zero(m, 1), *d * [off], zero(order - first, 1)))
    if kind == "nominal":
        at = pivots(errors.followed.centre)[k]
        column = errors.mean.part(range(n), [at])
        nominal = above(column, zero(m + d * N, 1), *d * [errors.R @ column], rest)
        return Drive(held=_unit(order, at), between=nothing - nominal)
    if kind in ("input", "cell"):
        return Drive(held=_unit(order, n + k), between=nothing)
    return Drive(held=above(zero(first, 1), *d * [_unit(errors.R.shape[0], k)], rest), between=nothing)


def row(errors: SampledErrors, form: Form) -> BallMatrix:
    """Return c, (1, order): of an input it reads ν, to which ω adds; of what is predicted the newest."""
    kind, k = form
    n, m, *_ = errors.widths
    if kind == "output":
        c = errors.plant.exact.tracked.part([k], range(n)).transpose()
        return above(c, zero(errors.order - n, 1)).transpose()
    place = {"state": 0, "input": n, "estimate": n + m}[kind] + k
    return _unit(errors.order, place).transpose()


def across(errors: SampledErrors, H: Array) -> Array:
    """Return of each prediction the rows that read H (x̃ − x_d) off z, (d, P, order), for rows H on x."""
    n, m, N, *_ = errors.widths
    rows = np.zeros((errors.predicted, len(H), errors.order))
    for i, each in enumerate(rows):
        each[:, :n], each[:, n + m + i * N :][:, :n] = H, H
    return rows


def shifted(errors: SampledErrors, H: Array) -> Array:
    """Return rows that read by how much estimates move x_d in H x off z, for each D_j, (J, P, order)."""
    D = [] if errors.estimates is None else [D.floats for _, D in errors.estimates.hull]
    rows = np.zeros((len(D), len(H), errors.order))
    for each, D_j in zip(rows, D, strict=True):
        at = errors.order - sum(errors.more)
        each[:, at : at + D_j.shape[1]] = H @ D_j
    return rows


def _unit(size: int, k: int) -> BallMatrix:
    return BallMatrix(identity(size)).part(range(size), [k])
