"""The trajectory generator (15) with its feedforward (16), and the shift that gives Assumption 2."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array, readonly
from pwatrack.control.convergence import prove_convergence
from pwatrack.control.refusal import conflict_text
from pwatrack.errors import Infeasible, ProblemPart, Remedy, Undecided, Way
from pwatrack.lmi.dichotomy import Dichotomy, NoDichotomy, prove_dichotomy, refute_dichotomy
from pwatrack.lmi.inequality import GENERATOR
from pwatrack.lmi.infeasibility import Impossibility, Refutation
from pwatrack.lmi.polynomial import Found
from pwatrack.model.normal_form import NormalForm

_RANK = 1e-12  # of the largest singular value: smaller ones are rounding
_MISSED = 1e-9  # of the largest entry: an equation of Assumption 2 that is missed by more has no solution


@dataclass(frozen=True, kw_only=True)
class TrajectoryGenerator:
    """The PWA filter (15): η̂' = A_ηi η̂ + b_ηi + B_ηi [ξ_d; y_d⁽ʳ⁾], and û_ff of (16)."""

    form: NormalForm  # the normal form (11) it is made from; its cells are those of the plant at x̂_d
    A_eta: Array  # (l, n − r, n − r)
    b_eta: Array  # (l, n − r)
    B_eta: Array  # (l, n − r, r + p) for p outputs
    shift: Array | None  # M (n − r, r) such that η = η̄ + M ξ_d satisfies Assumption 2, or None if there is none
    certificate: Found | Dichotomy  # what shows (17): a common P, or a polynomial that takes its place

    @property
    def played_back(self) -> bool:
        """Whether (15) has unstable modes: its bounded solution is worked out beforehand, by stable inversion."""
        return isinstance(self.certificate, Dichotomy)

    @property
    def rate(self) -> float:
        """That of (17), in 1/s; of a generator that runs."""
        assert not isinstance(self.certificate, Dichotomy)
        return self.certificate.rate


def trajectory_generator(form: NormalForm, *, preview: bool = True) -> TrajectoryGenerator:
    """Build the generator and prove that its dynamics converge: (17); or (17±), for a reference known beforehand.

    As u does not enter η̇ in this form, (14) reads A_ηi = Ψ_i, B_ηi = [χ_i 0], b_ηi = σ_i. Raises Infeasible if (17) is
    proved to have no solution, the zero dynamics do not converge; and, for a reference known beforehand, (17±) too;
    Undecided if one of them is neither proved nor proved impossible.
    """
    unused = np.zeros((*form.chi.shape[:2], len(form.degrees)))
    return TrajectoryGenerator(
        form=form,
        A_eta=form.Psi,
        b_eta=form.sigma,
        B_eta=readonly(np.concatenate([form.chi, unused], axis=2)),
        shift=assumption_2_shift(form.Psi, form.chi),
        certificate=_proved(form, preview=preview),
    )


def _proved(form: NormalForm, *, preview: bool) -> Found | Dichotomy:
    """Return a proof of (17), or where cells are not stable by themselves of (17±); if all are, that is (17)."""
    exact = [GENERATOR.exact(X) for X in form.exact.A_eta]
    try:
        return prove_convergence(
            GENERATOR.oriented(form.Psi),
            exact=exact,
            claim="(17), convergence of the zero dynamics,",
            cells=form.plant.cell_names,
            role=GENERATOR,
            subject=(ProblemPart.CELLS,),
            hint="the zero dynamics do not converge (non-minimum phase): another output may do",
            remedy=Remedy(Way.STATE_TRACKING),
        )
    except Infeasible as refusal:
        against = refusal.evidence.refutation if isinstance(refusal.evidence, Impossibility) else None
        stuck = isinstance(against, Refutation) and against.eigenvalues  # else a P of any sign would be one of (17)
        if not (preview and stuck):
            raise
        found = prove_dichotomy(GENERATOR, exact)
        if found is not None:
            return found
        none = refute_dichotomy(GENERATOR, exact)
        told = [problem.followed(_no_preview(none, form.plant.cell_names)) for problem in refusal.problems]
        if none is None:
            raise Undecided(*told) from None
        raise Infeasible(*told, evidence=Impossibility(role=GENERATOR, rate=0.0, refutation=none)) from None


def _no_preview(against: NoDichotomy | None, cells: Sequence[str]) -> str:
    """Say why a reference that is known beforehand does not help, or that this is not known."""
    if against is None:
        return (
            "; whether a P of any sign does, (17±), for a reference known beforehand, is undecided: found neither one "
            "nor a proof that none exists"
        )
    said = "; and no P of any sign, (17±), exists: "
    if against.unstable:
        (few, many), (fewer, more) = against.unstable, against.unstable.values()
        return (
            f"{said}{fewer} of the eigenvalues in cell '{cells[few]}' have positive real parts, {more} in cell "
            f"'{cells[many]}'"
        )
    if len(against.Z) == 1:
        return f"{said}an eigenvalue in cell '{cells[next(iter(against.Z))]}' is on the imaginary axis"
    return f"{said}{conflict_text(against, cells)}"


def assumption_2_shift(A_eta: Array, B_xi: Array) -> Array | None:
    """Return the least M with A_ηi M + B_ηi equal in all cells, or None if there is none.

    With η = η̄ + M ξ_d the input matrices of (14) become A_ηi M + B_ηi^ξ (and
    −M on ξ̇_d), so Assumption 2 holds for η̄; the paper's (21) is the case M = [1 0; 0 0].
    B_xi is the part of B_η that acts on ξ_d, (l, p, r).
    """
    p, r = B_xi.shape[1:]
    if not p or len(A_eta) == 1:
        return readonly(np.zeros((p, r)))
    left = (A_eta[1:] - A_eta[0]).reshape(-1, p)
    right = (B_xi[0] - B_xi[1:]).reshape(-1, r)
    M = np.linalg.lstsq(left, right, rcond=_RANK)[0]
    size = np.abs(B_xi).max(initial=0.0)
    if np.abs(left @ M - right).max(initial=0.0) > _MISSED * size:
        return None
    return readonly(M + 0.0)
