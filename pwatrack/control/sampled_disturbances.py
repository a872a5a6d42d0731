"""How what acts on a sampled loop enters its errors z = (e, ν, Δ, σ, ρ), and how signals are read off these.

Let ω be u as it is put out less K (x̂ − x_d) at the tick less u_ff(t), and W(t) the integral since the tick of ω less
its mean until the next one: W = 0 at ticks. With W(t_p) where a substep began, z less (B W, 0, 0, 0, R B (W − W(t_p)))
obeys the same, but that B W acts beside e in place of what W' did, and R B (W − W(t_p)) beside ρ. So, with
`sampled_error`, each as large as it likes:

    ("disturbance", k)   d in the k-th state equation: e' + d ε_k and Δ' − d ε_k, so that ρ' is what it was
    ("noise", k)         d on the k-th output as it is measured at a tick: (Δ, σ)⁺ − M ε_k d, ν⁺ − K M ε_k d
    ("input", k)         the mean of ω_k from tick to tick: it acts beside ν_k
    ("ripple", k)        W_k: B ε_k W_k acts beside e, and is a part of it
    ("moved", k)         R_k (x_d(t) + B W(t) − x_d(t_p) − B W(t_p)) in a substep: it acts beside ρ_k
"""

from collections.abc import Mapping
from dataclasses import dataclass

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, above, zero
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.lmi.clocked_tubes import Drive
from pwatrack.rational import identity


@dataclass(frozen=True, kw_only=True)
class Acting:
    """What acts in a run.

    Attributes:
        sizes: How large each channel gets, but for those that are 0.
        off: How large each ω_k gets, (m,).
    """

    sizes: Mapping[Channel, float]
    off: Array


def driven(errors: SampledErrors, channel: Channel) -> Drive:
    """Return how 1 of what acts enters z; what is measured counts with the other sign."""
    kind, k = channel
    n, m, N, q = _sizes(errors)
    nothing = zero(n + m + N + q, 1)
    if kind == "noise":
        M = BallMatrix.of(errors.gains.M[:, [k]])
        kick = BallMatrix.of(errors.gains.K) @ M.part(range(n), [0])
        return Drive(held=nothing, between=nothing, ticks=above(zero(n, 1), kick, M, zero(q, 1)))
    if kind == "disturbance":
        one = _unit(n, k)
        return Drive(held=nothing, between=above(one, zero(m, 1), zero(n, 1) - one, zero(N - n + q, 1)))
    if kind == "ripple":
        return Drive(held=above(errors.plant.exact.B.part(range(n), [k]), zero(m + N + q, 1)), between=nothing)
    place = n + k if kind == "input" else n + m + N + k
    return Drive(held=_unit(n + m + N + q, place), between=nothing)


def row(errors: SampledErrors, form: Form) -> BallMatrix:
    """Return c, (1, order): of an input it reads ν, to which ω adds; of e, to which B W does."""
    kind, k = form
    n, m, N, q = _sizes(errors)
    if kind == "output":
        c = errors.plant.exact.tracked.part([k], range(n)).transpose()
        return above(c, zero(m + N + q, 1)).transpose()
    place = {"state": 0, "input": n, "estimate": n + m}[kind] + k
    return _unit(n + m + N + q, place).transpose()


def _sizes(errors: SampledErrors) -> tuple[int, int, int, int]:
    """Return how many entries e, ν, (Δ, σ) and ρ have."""
    (n, m), N = errors.plant.B.shape, errors.plant.observed.C.shape[1]
    return n, m, N, errors.R.shape[0]


def _unit(size: int, k: int) -> BallMatrix:
    return BallMatrix(identity(size)).part(range(size), [k])
