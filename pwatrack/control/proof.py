"""The exact proofs of a design, for the gains and matrices as they are printed."""

from collections.abc import Sequence

from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.synthesis import Design
from pwatrack.errors import Problem, Undecided
from pwatrack.lmi.certificate import Certificate
from pwatrack.lmi.exact import Proof, prove_exactly
from pwatrack.lmi.rational import Rational, decimals
from pwatrack.model.pwa import PWASystem


def prove_design(plant: PWASystem, design: Design, generator: TrajectoryGenerator | None) -> tuple[Proof, ...]:
    """Prove (8), (9) and, with a generator, (17) exactly.

    Raises:
        Undecided: If a certificate that holds in floating point could not be proved exactly.

    Example:
        >>> from pwatrack import design, load_spec
        >>> [proof.of for proof in design(load_spec("specs/two_mass_backlash.yaml")).proofs]
        ['controller', 'observer', 'generator']
    """
    B, C, K, L = (decimals(X) for X in (plant.B, plant.C, design.K, design.L))
    A = [decimals(A_i) for A_i in plant.A]
    proofs = [
        _prove("controller", [A_i + B * K for A_i in A], design.controller),
        _prove("observer", [(A_i + L * C).transpose() for A_i in A], design.observer),
    ]
    if generator is not None and generator.A_eta.shape[1]:
        proofs.append(_prove("generator", [decimals(A_i.T) for A_i in generator.A_eta], generator.certificate))
    return tuple(proofs)


def _prove(of: str, M: Sequence[Rational], certificate: Certificate) -> Proof:
    proof = prove_exactly(of, M, certificate.P, certificate.rate)
    if proof is None:
        raise Undecided(
            Problem(
                message=f"{of}: a solution was found in floating point, but it could not be proved exactly",
                subject=("design",),
                hint="the case is marginal; ask for less, or try the other solver",
            )
        )
    return proof
