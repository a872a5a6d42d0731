"""The exact proofs of a design, for the gains and matrices as they are printed."""

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import Array
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.synthesis import Design
from pwatrack.errors import Problem, Undecided
from pwatrack.lmi.certificate import Certificate
from pwatrack.lmi.exact import Proof, decimals, prove_exactly
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
    A, B, C, K, L = (_exact(X) for X in (plant.A, plant.B, plant.C, design.K, design.L))
    proofs = [
        _prove("controller", A + B @ K, design.controller),
        _prove("observer", (A + L @ C).swapaxes(1, 2), design.observer),
    ]
    if generator is not None and generator.A_eta.shape[1]:
        proofs.append(_prove("generator", _exact(generator.A_eta).swapaxes(1, 2), generator.certificate))
    return tuple(proofs)


def _prove(of: str, M: NDArray[np.object_], certificate: Certificate) -> Proof:
    proof = prove_exactly(of, M.tolist(), certificate.P, certificate.rate)
    if proof is None:
        raise Undecided(
            Problem(
                message=f"{of}: a solution was found in floating point, but it could not be proved exactly",
                subject=("design",),
                hint="the case is marginal; ask for less, or try the other solver",
            )
        )
    return proof


def _exact(X: Array) -> NDArray[np.object_]:
    """Return a matrix or a stack of them as the decimals it is printed as, for exact sums and products."""
    rows = decimals(X.reshape(-1, X.shape[-1]))
    return np.array(rows, dtype=object).reshape(X.shape)
