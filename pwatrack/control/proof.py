"""The exact proofs of a design, for the gains and matrices as they are printed."""

from collections.abc import Sequence

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, different, each, stack
from pwatrack.control.convergence import least_overshoot_certificate, well_conditioned
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.refusal import other_solver
from pwatrack.control.synthesis import Gains
from pwatrack.control.task import Task
from pwatrack.errors import ProblemPart, Undecided
from pwatrack.lmi.dichotomy import Dichotomy
from pwatrack.lmi.exact import Certificate, Proof, prove_exactly
from pwatrack.lmi.inequality import CONTROLLER, GENERATOR, OBSERVER, Role
from pwatrack.lmi.pair import MANY_STATES
from pwatrack.lmi.polynomial import AnyProof, Found, PolynomialLyapunov, exactly
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.rational import floats

_KEPT = 0.9  # of the best rate: about here overshoot / rate, by which disturbances are amplified, is least


def prove_design(
    plant: PWASystem, design: Gains, generator: TrajectoryGenerator | None, *, sizes: Sizes | None = None
) -> tuple[AnyProof, ...]:
    """Prove (8), (9) and, with a generator, (17) exactly: each for its best rate, and for a small overshoot.

    The P of the best rate is ill-conditioned, so it promises little for short times and for changed matrices. A second
    P gives up a tenth of the rate for the least condition number in sizes, and another tenth for a margin. Where no
    such proof is found the first stands alone. Raises Undecided if a certificate that holds in floating point could not
    be proved exactly.
    """
    sizes, proofs = sizes or Sizes.of(plant), []
    for role, gain, certificate in ((CONTROLLER, design.K, design.controller), (OBSERVER, design.L, design.observer)):
        task = Task.of(plant, role, sizes=sizes)
        closed, hull = task.exactly_closed(role.oriented(gain)), (plant if role is CONTROLLER else plant.model).hull
        proofs += prove_inequality(role, closed, certificate, hull=hull, sizes=task.scale.state)
    if generator is not None and generator.A_eta.shape[1] and not isinstance(generator.certificate, Dichotomy):
        form, M = generator.form, each(GENERATOR.exact, generator.form.exact.A_eta)
        internal = np.sqrt((form.T[0, form.r :] ** 2) @ sizes.state**2)
        proofs += prove_inequality(GENERATOR, M, generator.certificate, hull=form.hull, sizes=1 / internal)
    return tuple(proofs)


def prove_inequality(
    role: Role,
    M: Sequence[BallMatrix],
    certificate: Found,
    *,
    hull: Sequence[int] | None = None,
    sizes: Array | None = None,
) -> list[AnyProof]:
    """Return the proof of the best rate and, if there is one, that of a small overshoot; a polynomial has one proof.

    The certificate shows it in floating point. Those at the places `hull` have all M_i in their hull: what is affine in
    M_i is proved for these, but a polynomial has an N_i of its own for each. Sizes are of the states, (n,).
    """
    M = different(M if hull is None or isinstance(certificate, PolynomialLyapunov) else [M[i] for i in hull])
    best = exactly(role, M, certificate)
    if best is None:
        raise Undecided(
            f"{role.name}: a solution was found in floating point, but it could not be proved exactly",
            subject=(ProblemPart.DESIGN,),
            hint="the case is marginal: ask for less, or try the other solver",
            remedy=other_solver(),
        )
    if isinstance(certificate, PolynomialLyapunov):
        return [best]
    second = _small_overshoot(role, M, certificate, sizes)
    return [best] if second is None else [best, second]


def _small_overshoot(
    role: Role, M: Sequence[BallMatrix], certificate: Certificate, sizes: Array | None
) -> Proof | None:
    """Return a proof of a small overshoot for the M_i, each different, if there is one."""
    rate = _KEPT * certificate.rate
    if certificate.M.shape[1] >= MANY_STATES and len(M) == 2:
        apart = floats(M[1].centre - M[0].centre)
        P = well_conditioned(stack(M), rate, apart=apart, sizes=sizes)
        return None if P is None else prove_exactly(role, M, P, _KEPT * rate)
    found = least_overshoot_certificate(certificate.M, rate, sizes=sizes, start=certificate.P)
    return None if found is None else prove_exactly(role, M, found.P, _KEPT * found.rate)
