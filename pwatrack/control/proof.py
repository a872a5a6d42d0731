"""The exact proofs of a design, for the gains and matrices as they are printed."""

from collections.abc import Sequence
from fractions import Fraction

from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.synthesis import Design
from pwatrack.errors import Problem, Undecided
from pwatrack.lmi.certificate import Certificate
from pwatrack.lmi.exact import Proof, decimals, prove_exactly
from pwatrack.model.pwa import PWASystem

Exact = list[list[Fraction]]


def prove_design(plant: PWASystem, design: Design, generator: TrajectoryGenerator | None) -> tuple[Proof, ...]:
    """Prove (8), (9) and, with a generator, (17) exactly.

    Raises:
        Undecided: If a certificate that holds in floating point could not be proved exactly.

    Example:
        >>> from pwatrack import design, load_spec
        >>> [proof.of for proof in design(load_spec("specs/two_mass_backlash.yaml")).proofs]
        ['controller', 'observer', 'generator']
    """
    A, B, C = [decimals(A_i) for A_i in plant.A], decimals(plant.B), decimals(plant.C)
    BK, LC = _product(B, decimals(design.K)), _product(decimals(design.L), C)
    proofs = [
        _prove("controller", [_sum(A_i, BK) for A_i in A], design.controller),
        _prove("observer", [_transposed(_sum(A_i, LC)) for A_i in A], design.observer),
    ]
    if generator is not None and generator.A_eta.shape[1]:
        A_eta = [_transposed(decimals(A_i)) for A_i in generator.A_eta]
        proofs.append(_prove("generator", A_eta, generator.certificate))
    return tuple(proofs)


def _prove(of: str, M: Sequence[Exact], certificate: Certificate) -> Proof:
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


def _product(X: Exact, Y: Exact) -> Exact:
    return [[sum((a * b for a, b in zip(row, c, strict=True)), Fraction(0)) for c in _transposed(Y)] for row in X]


def _sum(X: Exact, Y: Exact) -> Exact:
    return [[a + b for a, b in zip(one, two, strict=True)] for one, two in zip(X, Y, strict=True)]


def _transposed(X: Exact) -> Exact:
    return [list(column) for column in zip(*X, strict=True)]
