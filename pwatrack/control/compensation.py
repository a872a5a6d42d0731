"""What makes up for unknown loads in the desired trajectory, and how the errors of their estimates drive it.

With ẋ = f(x) + B u + E s, ṡ = S s, the observer runs x̂ and ŝ. With g_0 = 0, g_{k+1} = c_k E + g_k S for each output,
G = [g; 0], X = −T_i⁻¹ G and W_i = T_i (A_i X + E) + G S the desired trajectory takes x_d + X ŝ, u_ff − (right inverse
of D_i) W_i[last] ŝ and η̂' + W_i[η] ŝ. Then e = x − x_d and σ = ŝ − s have

    e' = (Â + B K) e + [B K − X L_s C, −E] (Δ, σ).

It is derived in `docs/theory/beyond.md`, *Unknown loads*. For state tracking x_d is given: loads must be matched then
(E = B U), X = 0 and u_ff − U ŝ. Where η is worked out beforehand, η + H ŝ is played in its place, and G = [g; −H].
"""

from dataclasses import dataclass

import flint
import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, above, beside, different, each, zero
from pwatrack.control.realisable import pseudo_inverse
from pwatrack.errors import OutsideTheory, ProblemPart
from pwatrack.model.loads import Loads
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import Rational, on_entries


@dataclass(frozen=True, kw_only=True)
class Compensation:
    """What the estimates ŝ of the loads add to the desired trajectory, by the cell of x_d."""

    X: BallMatrix  # x_d + X ŝ, (n, p), exactly
    u_ff: Array  # u_ff + u_ff[i] ŝ, (l, m, p)
    rate: Array  # η̂' + rate[i] ŝ, (l, n − r, p); without rows where x_d is given
    guards: Array  # what ŝ adds to where the cells of x_d end, (k, p): see `DesiredTrajectory`

    @property
    def alone(self) -> bool:
        """Whether ŝ changes nothing but u_ff."""
        return not (any(self.X.centre.entries()) or self.X.radius is not None or self.rate.any())


def compensation(
    plant: PWASystem, form: NormalForm | None, filtered: int, *, played_back: bool = False
) -> Compensation:
    """Return what makes up for the loads, for output tracking with the normal form and so many η̂.

    Raises OutsideTheory if a load moves a derivative of the output that is another form of the state in other cells.
    """
    (n, m), cells, loads = plant.B.shape, len(plant.A), plant.loads
    p = 0 if loads is None else loads.E.shape[1]
    nothing = zero(n, p)
    if loads is None or form is None:
        needed = np.zeros((m, p)) if loads is None else -pseudo_inverse(plant.B) @ loads.E.floats
        guards = np.zeros((len(plant.partition.h if form is None else form.boundary.h), p))
        u_ff = np.broadcast_to(needed, (cells, m, p))
        return Compensation(X=nothing, u_ff=u_ff, rate=np.zeros((cells, filtered, p)), guards=guards)
    T, exact = form.exact.T, form.plant.exact
    G = loads_in_derivatives(loads, form)
    if played_back:
        G = above(G.part(range(form.r), range(p)), BallMatrix(-resting(loads, form)))
    shifts = different(each(lambda inverse: nothing - inverse @ G, form.exact.inverse))
    if len(shifts) > 1:
        ends = dict(zip(form.plant.tracked_names, np.cumsum(form.degrees) - 1, strict=True))
        bent = [name for name, piecewise in zip(ends, form.piecewise, strict=True) if piecewise]
        moved = [name for name in bent if G.floats[ends[name]].any()]
        raise OutsideTheory(
            f"unknown loads {', '.join(loads.names)} move the last derivative of '{(moved or bent)[0]}' before "
            "the inputs do, and it is another form of the state in other cells: nothing is proved of that",
            subject=(ProblemPart.ESTIMATE,),
            hint="estimate loads that enter where inputs do",
        )
    X = shifts[0]
    W = np.array([(T_i @ (A_i @ X + loads.E) + G @ loads.S).floats for T_i, A_i in zip(T, exact.A, strict=True)])
    last = np.cumsum(form.degrees) - 1
    return Compensation(
        X=X,
        u_ff=-form.right_inverse @ W[:, last],
        rate=W[:, form.r : form.r + filtered],
        guards=-form.boundary.H @ G.floats,
    )


def beside_given(plant: PWASystem, X: BallMatrix) -> Compensation:
    """Return what makes up for the loads where x_d and its derivative are given for none of them.

    In the cell of x_d + X ŝ: B u_ff = ẋ_d + X S ŝ − A_i (x_d + X ŝ) − b_i − E ŝ.
    """
    loads, shift = plant.loads, X.floats
    if loads is None:
        return compensation(plant, None, 0)
    needed = shift @ loads.S.floats - plant.A @ shift - loads.E.floats
    return Compensation(
        X=X,
        u_ff=pseudo_inverse(plant.B) @ needed,
        rate=np.zeros((len(plant.A), 0, shift.shape[1])),
        guards=plant.partition.H @ shift,
    )


def check_played_back(form: NormalForm) -> None:
    """Refuse loads that act on an η that is worked out beforehand, in other ways in other cells."""
    loads = form.plant.loads
    if loads is None:
        return
    rate = np.abs(compensation(form.plant, form, len(form.eta_names), played_back=True).rate).max(axis=0)
    for load, states in zip(loads.each, loads.groups, strict=True):
        acts = rate[:, list(states)].max(axis=1)
        if acts.any():
            raise OutsideTheory(
                f"the load {load.name} acts on η = {form.eta_names[int(acts.argmax())]}, internal dynamics "
                "that have unstable modes: x_d is worked out beforehand, and what the estimate, which is not known "
                "then, would add to it is not the same in all cells",
                subject=(ProblemPart.ESTIMATE,),
                hint="a load that acts as an input does, or another output",
            )


def loads_in_derivatives(loads: Loads, form: NormalForm) -> BallMatrix:
    """Return G: what the loads add to ξ, g_0 … g_{r−1} of each output, and to η, nothing, (n, p)."""
    n, p = loads.E.shape
    nothing, T, G = zero(1, p), form.exact.T[0], list[BallMatrix]()
    for r in form.degrees:
        G.append(nothing)
        for _ in range(r - 1):
            G.append(T.part([len(G) - 1], range(n)) @ loads.E + G[-1] @ loads.S)
    return above(*G, *[nothing] * (n - form.r))


def resting(loads: Loads, form: NormalForm) -> Rational:
    """Return H (n − r, p) with η_ref + H s for η where loads act, if all cells have the same; 0 where there is none.

    It is that of the first cell, for numbers that are exact.
    """
    r, n, p = form.r, form.r + len(form.eta_names), loads.S.shape[0]
    q, nothing = n - r, flint.fmpq_mat(n - r, p)
    if not q or not form.plant.exact.exact or loads.E.radius is not None or loads.S.radius is not None:
        return nothing
    G, T, A_eta = loads_in_derivatives(loads, form).centre, form.exact.T[0].centre, form.exact.A_eta[0].centre
    A, E, S = form.plant.exact.A[0].centre, loads.E.centre, loads.S.centre
    W = on_entries(T * (E - A * form.exact.inverse[0].centre * G) + G * S, range(r, n), range(p))
    unknowns = [(j, k) for k in range(p) for j in range(q)]
    rows = flint.fmpq_mat(q * p, q * p)
    for at, (j, k) in enumerate(unknowns):
        for i in range(q):
            rows[at, k * q + i] += A_eta[j, i]
        for i in range(p):
            rows[at, i * q + j] -= S[i, k]
    try:
        found = rows.solve(flint.fmpq_mat(q * p, 1, [-W[j, k] for j, k in unknowns]))
    except ZeroDivisionError:
        return nothing
    return flint.fmpq_mat(q, p, [found[k * q + j, 0] for j in range(q) for k in range(p)])


def coupling(plant: PWASystem, K: BallMatrix, L: BallMatrix, X: BallMatrix) -> BallMatrix:
    """Return the matrix by which the observer's errors (Δ, σ) drive e, (n, n + p): B K without loads."""
    BK, loads, n = plant.exact.B @ K, plant.loads, plant.exact.B.shape[0]
    if loads is None:
        return BK
    gain = L.part(range(n, L.shape[0]), range(L.shape[1]))
    return beside(BK - X @ gain @ plant.exact.C, zero(*loads.E.shape) - loads.E)
