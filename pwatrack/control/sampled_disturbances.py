"""How what acts on a sampled loop enters its errors z = (e, ν, Δ, σ, ρ), and how signals are read off these.

With ω, u as it is put out less ν less u_ff(t), the nominal loop, of the mean A₀ of the cells and without noise, has
e₀' = A₀ e₀ + B (K e₀(t_k) + ω), e₀(0) = 0: it is known from the reference. z less that of it obeys `sampled_error`,
see *What ω does* in `docs/theory/beyond.md`, driven by scalars, each as large as it likes; ε_k is the unit vector of a
column in which row k of R alone is 1:

    ("disturbance", k)   d in the k-th state equation: e' + d ε_k and all Δ' − d ε_k, so that ρ' is what it was
    ("deviation", k)     likewise with E_k in place of ε_k: what merging leaves out of the k-th element; where all cells
                         are predicted, in e' and all ρ' alone
    ("noise", k)         d on the k-th output as it is measured at a tick: (Δ, σ)⁺ − M ε_k d, ν⁺ − K M ε_k d; where
                         inputs are late only (Δ_0, σ_0)⁺
    ("input", k)         d on the k-th input as it is put out: it acts beside ν_k
    ("nominal", k)       R_k e₀: it acts by F_i − F₀
    ("nominal", p + k)   (λ − 1) R_k e₀ of p rows: e' + A₀ ε_k d and all Δ' − A₀ ε_k d
    ("swap", k)          the k-th input of the nominal loop at τ less that at t: e' + λ B ε_k d and all Δ' − λ B ε_k d
    ("predicted", i n + k)  d in the k-th row of Δ_i' and in ρ_i' by R ε_k
    ("drawn", k)         d in e_k' alone, so that ρ' has R ε_k d
    ("cell", k)          d on the k-th input as it is put out, as ("input", k) is
    ("eta", k)           d on the k-th entry of δ at a tick
    ("start", k)         d times what z may be before the first tick of a run, or before that of its first late input
    ("load", k)          d on the k-th entry of s just before a tick: (e, σ_i) − (X ε_k, ε_k) d, then the tick
    ("rounding", 0)      what rounding adds, as far as V^½ = 1 of each of its tubes: see `export.rounding`
    ("moved", k)         R_k ((x_d + e₀)(t) − (x_d + e₀)(t_p)) in a substep: it acts beside ρ_k, of all predictions

Where λ times as much time passes as the program counts, disturbances are λ times as large; what ticks off their times
add is in `control.off_time`. V of a tube (see `lmi.clocked_tubes`) has V' ≤ −a V + a d², or V⁺ ≤ (1 − b) V + b d² at
ticks: so it is at most the mean square of d with weights that fade, which `level` adds up; or V^½' ≤ −(a / 2) V^½ + |d|
of what is summed. Several that all act between ticks, or all at them, may have one tube together: then d² is the sum of
their squares, each in a size of its own. "moved" is 0 in a substep in which the prediction stays on one side of every
plane; "drawn", "cell" and "eta" are of estimates of loads, see `simulation.acting_estimates`, and "load" of loads that
step, see `simulation.loads_along`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import ceil

import numpy as np
import scipy  # whose parts are imported where they are used
from scipy.linalg import lapack

from pwatrack.arrays import OVER_POWERS, Array
from pwatrack.ball_matrix import BallMatrix, above, zero
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.lmi.clocked_tubes import Drive, Tube
from pwatrack.rational import identity, pivots
from pwatrack.real import Real

ROUNDING = 1e-11  # of the size of what it is a difference of: what differs by less differs by rounding

SUMMED = "load", "start", "swap"  # what has no tube but one of its sum


@dataclass(frozen=True, kw_only=True)
class LateStart:
    """Where the errors of a sampled loop are just before its first input acts, and what there was before."""

    z: Array  # without noise, (order,)
    off: Array  # how far z is from that at most, beside what noise adds, (order,)
    moved: Array  # how far x − x_d goes at most till the first input acts, which may be early or late, (n,)
    missed: Array  # how much more is measured off before, by ticks off their times, (q,)
    beside: Mapping[Form, Array]  # how large signals are at most in each substep before, likewise
    along: Mapping[str, Array]  # between what numbers of the program are there, with what noise adds, (k, 2) each
    clear: float  # how many sizes (x̂, ŝ) may be off more in each substep, and is in the same cells

    @property
    def substeps(self) -> int:
        """How many there are before."""
        return len(next(iter(self.beside.values())))


@dataclass(frozen=True, kw_only=True)
class Acting:
    """What acts in a run, in each of its K substeps."""

    # the mean of d² of each channel, but for those that are 0, (K,); of noise d² at the tick before, of swaps the
    # square of the mean of |d|
    squares: Mapping[Channel, Array]
    means: Mapping[Channel, Array]  # the mean of |d| of those that may be summed, likewise
    # how large at most that is which signals have beside c z, (K,): that of the nominal loop
    beside: Mapping[Form, Array]
    planes: Array  # normals of the planes between cells, (P, n)
    near: Array  # how near x_d + e₀ comes to each of them, in H x, (K, P)
    apart: Array  # how near x_d comes to each of them in the sample, and that of the program at its tick, likewise
    changes: Array  # by how much what is held along x_d + e₀ changes from tick to tick at most, from 0 on, (m,)
    loads: Array  # how large those get that step, and are constants in between, (k,); 0 of others
    # between what numbers of the program are with x̂ = x = x_d + e₀, (k, 2) each: x_hat, y, u as it is held; x_d, u_ff,
    # eta_hat and w at ticks; s_hat. Of loads at inputs u and u_ff have what these take off.
    along: Mapping[str, Array] = field(default_factory=dict)
    # how the run begins as its inputs are late; None where they are not, or that is not known
    late: LateStart | None = None

    def after(self, late: LateStart) -> "Acting":
        """Return what acts from a start on that all but noise before it is in, and what there is before."""
        since = np.arange(len(self.near)) >= late.substeps
        squares, means = (
            {channel: each if channel[0] == "noise" else each * since for channel, each in sizes.items()}
            for sizes in (self.squares, self.means)
        )
        for k, more in enumerate(late.missed.tolist()):
            off = np.sqrt(squares.get(("noise", k), np.zeros(len(since)))) + more * ~since
            squares["noise", k] = off**2
        squares = {channel: each for channel, each in squares.items() if each.any()}
        return replace(self, squares=squares, means=means, late=late)

    def together(self, sizes: Mapping[Channel, float], tube: Tube, where: Mapping[str, Array]) -> Array:
        """Return what acts on a tube of some channels, each in a size of its own, in each substep, as for `level`.

        Those of some kinds act only where that is said, (K,).
        """
        total = np.zeros(len(self.near))
        for channel, size in sizes.items():
            each = self.means[channel] if tube.summed and not tube.b else self.squares[channel]
            share = size if tube.summed and not tube.b else size**2
            total += each * where.get(channel[0], 1.0) / share
        return np.asarray(np.sqrt(total) if tube.summed and tube.b else total)

    def noise(self, outputs: int) -> Array:
        """Return how much is measured off at most at any tick, of so many outputs."""
        return np.array([float(np.sqrt(self.squares.get(("noise", k), np.zeros(1)).max())) for k in range(outputs)])


def joined(ends: Array, more: Array) -> Array:
    """Return between what numbers are that are within some ends, (k, 2), or within others."""
    return np.column_stack([np.minimum(ends[:, 0], more[:, 0]), np.maximum(ends[:, 1], more[:, 1])])


def level(d: Array, tube: Tube, gains: SampledGains) -> Array:
    """Return what V^½ of a tube is at most in each substep, from V = 0 on, (K,).

    `d` is what acts in each: the mean square, or of what is summed its mean, at ticks it itself, (K,).
    """
    step = gains.sample_time / gains.substeps
    if tube.b:
        share = np.sqrt(1 - tube.b) if tube.summed else 1.0 - tube.b
        ticks = _kept((1.0 if tube.summed else tube.b) * d[:: gains.substeps], float(share))
        each = np.repeat(ticks, gains.substeps)[: len(d)]
        return np.asarray((each if tube.summed else np.sqrt(each)) * OVER_POWERS)
    if tube.summed:
        return faded(d * step, tube.a / 2 * step)
    return np.asarray(np.sqrt(faded(tube.a * d * step, tube.a * step)))


def faded(added: Array, fall: float) -> Array:
    """Return what is there in each substep at most, where some is added in each and what is there falls by e^−fall.

    Example:
        >>> faded(np.array([1.0, 0.0, 1.0]), np.log(2)).round(2).tolist()
        [1.0, 1.0, 1.5]
    """
    after = _kept(added, float(np.exp(-fall)))
    return np.asarray((np.append(0.0, after[:-1]) + added) * OVER_POWERS)


def _kept(added: Array, share: float) -> Array:
    """Return what is there after each of some additions, of which this share of what was there before is kept."""
    band = np.array([np.ones(len(added)), np.full(len(added), -share)])
    return np.asarray(lapack.dtbtrs(band, added[:, None], uplo="L")[0][:, 0])


def driven(errors: SampledErrors, channel: Channel) -> Drive:
    """Return how 1 of what acts enters z; what is measured counts with the other sign."""
    (kind, k), (n, m, N, *_), d, order = channel, errors.widths, errors.predicted, errors.order
    nothing, first, rest = zero(order, 1), n + m + d * N, zero(sum(errors.more), 1)
    if kind == "noise":
        return Drive(held=nothing, between=nothing, ticks=corrected(errors, BallMatrix.of(errors.gains.M[:, [k]])))
    if kind == "eta":
        kick = _unit(order, order - errors.more[-1] + k)
        return Drive(held=nothing, between=nothing, ticks=[kick] * len(errors.ticks))
    if kind == "start":
        assert errors.starts is not None
        return Drive(held=nothing, between=nothing, ticks=[J @ errors.starts[k] for J in errors.ticks])
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
        at = pivots(errors.followed.centre)
        column, late = errors.mean.part(range(n), [at[k % len(at)]]), k >= len(at)
        if late:
            own = above(zero(n, 1) - column, zero(N - n, 1))
            return Drive(held=nothing, between=above(column, zero(m, 1), *d * [own], zero(order - first, 1)))
        nominal = above(column, zero(m + d * N, 1), *d * [errors.R @ column], rest)
        return Drive(held=_unit(order, at[k]), between=nothing - nominal)
    if kind == "swap":
        column = errors.plant.exact.B.part(range(n), [k])
        own = above(column, zero(N - n, 1))
        known = above(zero(n + m, 1), *d * [own], *d * [errors.R @ column], rest)
        return Drive(held=_unit(order, n + k), between=nothing - known)
    if kind == "predicted":
        i, k = divmod(k, n)
        Delta, rho = ([zero(rows, 1)] * d for rows in (N, errors.R.shape[0]))
        Delta[i], rho[i] = _unit(N, k), errors.R @ _unit(n, k)
        return Drive(held=nothing, between=above(zero(n + m, 1), *Delta, *rho, rest))
    if kind in ("input", "cell"):
        return Drive(held=_unit(order, n + k), between=nothing)
    return Drive(held=above(zero(first, 1), *d * [_unit(errors.R.shape[0], k)], rest), between=nothing)


def corrected(errors: SampledErrors, more: BallMatrix) -> list[BallMatrix]:
    """Return what z is more after a tick at which (x̂, ŝ) becomes `more`, (N, k), than it should, (order, k) each."""
    (n, m, N, *_), k = errors.widths, more.shape[1]
    put_out = errors.put_out(zero(n, k), zero(N, k) if errors.gains.delay else more, zero(sum(errors.more[1:]), k))
    others = zero(errors.order - n - m - N - sum(errors.more), k)
    return [above(zero(n, k), nu, more, others, rest) for nu, rest in put_out]


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


def drives(errors: SampledErrors, inputs: Sequence[int]) -> Array:
    """Return the rows on z that read u − u_ff of some inputs, and what is taken off for loads, (inputs, order)."""
    rows = np.zeros((len(inputs), errors.order)) if errors.gains.delay else beside_loads(errors, inputs)
    rows[range(len(inputs)), [len(errors.plant.B) + k for k in inputs]] = 1.0
    return rows


def begun(errors: SampledErrors, acts: Acting, late: LateStart) -> Array:
    """Return what z is a mean of as the first input acts, which is late, of any sign, (order, k).

    Of what x − x_d goes as it is off its time, and of e₀, which begins at its time, all x̃ − x have the other sign.
    """
    (n, m, N, *_), gains = errors.widths, errors.gains
    columns, theta, K = [late.z[:, None], np.diag(late.off)], gains.jitter / 2, late.substeps
    if theta:
        near = ceil(theta / gains.sample_time * gains.substeps)
        inputs = [acts.beside[form][K : K + near + 1].max(initial=0.0) for form in (("input", k) for k in range(m))]
        B, A0 = np.abs(errors.plant.B), np.abs(errors.mean.floats)
        away = late.moved + scipy.linalg.expm(A0 * theta) @ B @ np.array(inputs) * theta * OVER_POWERS
        own = np.zeros((errors.order, n))
        own[:n] = np.diag(away)
        for i in range(errors.predicted):
            own[n + m + i * N :][:n] = -np.diag(away)
        columns.append(own)
    return np.hstack(columns)


def cut_off(errors: SampledErrors) -> BallMatrix:
    """Return what z is moved by for 1 that is cut off an input, (order, m): x̂ and ŝ by E, and ν so that it is so."""
    n, m, N, *_ = errors.widths
    moved = np.zeros((errors.order, m))
    moved[n + m : n + m + N] = errors.gains.into
    into, nu = BallMatrix.of(moved), BallMatrix.of(np.eye(errors.order)[:, n : n + m])
    return into + nu @ (BallMatrix.of(np.eye(m)) - BallMatrix.of(drives(errors, range(m))) @ into)


def beside_loads(errors: SampledErrors, inputs: Sequence[int]) -> Array:
    """Return what is taken off ν for loads, where it is not in ν: see `sampled_error`."""
    (n, m, *_), rows = errors.widths, np.zeros((len(inputs), errors.order))
    for place, at in enumerate(errors.plant.load_inputs):
        rows[[j for j, k in enumerate(inputs) if k == at], n + m + n + place] = -1.0
    return rows


def numbers(errors: SampledErrors) -> dict[str, list[Array]]:
    """Return rows that read off z how far numbers of a program are off what they are along x_d + e₀, (A, k, order).

    Any of the A may be; where there are several such rows, what they read adds up. Loads are the true ones along x_d.
    """
    (n, m, N, *_), order, of = errors.widths, errors.order, errors.estimates
    every, p = range(m), N - n
    found = {"y": [np.hstack([errors.plant.C, np.zeros((len(errors.plant.C), order - n))])[None]]}
    found |= {"x_hat": [across(errors, np.eye(n))], "u": [drives(errors, every)[None]]}
    if p:
        found["s_hat"] = [np.array([np.eye(p, order, n + m + i * N + n) for i in range(errors.predicted)])]
        found["u_ff"] = [beside_loads(errors, every)[None]]
    if of is None:
        return found
    at, push, h = order - sum(errors.more), np.linalg.pinv(errors.plant.B), Real.of(errors.gains.sample_time).centre

    def of_estimates(rows: list[Array]) -> Array:
        return np.pad(rows, ((0, 0), (0, 0), (at, order - at - of.order)))

    tick = of_estimates([push @ (c - A @ D).floats for A, (c, D) in product(errors.cells, of.moves)])
    held = of_estimates([more.floats for _, more, _ in of.vertices(h)])
    found |= {"x_d": [shifted(errors, np.eye(n))], "u": [np.eye(m, order, n)[None], tick], "u_ff": [tick, held]}
    last = np.arange(of.eta)
    eta = np.eye(order)[[at + of.loads + last, order - of.eta + last]]
    return found | {"eta_hat": [eta]} if of.eta else found


def _unit(size: int, k: int) -> BallMatrix:
    return BallMatrix(identity(size)).part(range(size), [k])
