"""How what acts on a sampled loop enters its errors z = (e, ν, Δ, σ, ρ), and how signals are read off these.

With `sampled_error`, each as large as it likes:

    ("disturbance", k)   d in the k-th state equation: e' + d ε_k and Δ' − d ε_k, so that ρ' is what it was
    ("noise", k)         d on the k-th output as it is measured at a tick: (Δ, σ)⁺ − M ε_k d, ν⁺ − K M ε_k d
    ("input", k)         ω_k, u as it is put out less K (x̂ − x_d) at the tick less u_ff(t): it acts beside ν_k
    ("moved", k)         R_k (x_d(t) − x_d(t_p)) in a substep that begins at t_p: it acts beside ρ_k
"""

import numpy as np

from pwatrack.ball_matrix import BallMatrix, above
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.lmi.clocked_tubes import Drive
from pwatrack.rational import identity


def driven(errors: SampledErrors, channel: Channel) -> Drive:
    """Return how 1 of what acts enters z; what is measured counts with the other sign."""
    kind, k = channel
    n, m, N, q = _sizes(errors)
    nothing = _column([_zero(n + m + N + q)])
    if kind == "noise":
        M = BallMatrix.of(errors.gains.M[:, [k]])
        kick = BallMatrix.of(errors.gains.K) @ M.part(range(n), [0])
        return Drive(held=nothing, between=nothing, ticks=_column([_zero(n), kick, M, _zero(q)]))
    if kind == "disturbance":
        one = _unit(n, k)
        return Drive(held=nothing, between=_column([one, _zero(m), _zero(n) - one, _zero(N - n + q)]))
    place = n + k if kind == "input" else n + m + N + k
    return Drive(held=_unit(n + m + N + q, place), between=nothing)


def row(errors: SampledErrors, form: Form) -> BallMatrix:
    """Return c, (1, order): of an input it reads ν, to which ω adds."""
    kind, k = form
    n, m, N, q = _sizes(errors)
    if kind == "output":
        c = errors.plant.exact.tracked.part([k], range(n)).transpose()
        return _column([c, _zero(m + N + q)]).transpose()
    place = {"state": 0, "input": n, "estimate": n + m}[kind] + k
    return _unit(n + m + N + q, place).transpose()


def _sizes(errors: SampledErrors) -> tuple[int, int, int, int]:
    """Return how many entries e, ν, (Δ, σ) and ρ have."""
    (n, m), N = errors.plant.B.shape, errors.plant.observed.C.shape[1]
    return n, m, N, errors.R.shape[0]


def _column(parts: list[BallMatrix]) -> BallMatrix:
    return above(*parts)


def _unit(size: int, k: int) -> BallMatrix:
    return BallMatrix(identity(size)).part(range(size), [k])


def _zero(size: int) -> BallMatrix:
    return BallMatrix.of(np.zeros((size, 1)), (size, 1))
