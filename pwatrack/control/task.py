"""The inequality for one gain: (8) for K, or (9) transposed for Lᵀ."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, different, each, stack
from pwatrack.lmi.exact import RATE_GIVEN, Certificate, likely_rate, of_proof, prove, prove_exactly
from pwatrack.lmi.inequality import CONTROLLER, Role
from pwatrack.lmi.presolve import distinct
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.rational import Rational

_SHARES = (1.0, 0.1, 1e-2, 1e-3)  # of the rate that floating point shows, tried in exact numbers


@dataclass(frozen=True, kw_only=True)
class Task:
    """Find K with sym((A_i + B K) P) ≺ 0 in every cell: (8), or (9) transposed."""

    A: Array  # (l, n, n)
    B: Array  # (n, m)
    exact: tuple[Sequence[BallMatrix], BallMatrix] | None = None  # for proofs; None: A and B as they print
    role: Role = CONTROLLER  # which of the two it is
    cells: Sequence[str]  # names of the l cells
    states: Sequence[str] = ()  # names of the states of the plant, the first of the n
    sizes: Sizes | None = None  # of states and inputs, for (9) of the transposed plant; None: what balances it

    @classmethod
    def of(cls, plant: PWASystem, role: Role, *, sizes: Sizes | None = None) -> "Task":
        """Return (8), or (9) as (8) for the transposed plant: K there is Lᵀ here."""
        sizes, seen = sizes or Sizes.of(plant), plant.observed
        A, B = (plant.exact.A, plant.exact.B) if role is CONTROLLER else (seen.A, seen.C)
        return cls(
            A=role.oriented(stack(A)),
            B=role.oriented(B.floats),
            exact=(each(role.exact, A), role.exact(B)),
            role=role,
            cells=(plant if role is CONTROLLER else plant.model).cell_names,
            states=plant.states,
            sizes=sizes if role is CONTROLLER else sizes.dual(),
        )

    @cached_property
    def scale(self) -> Sizes:
        """The sizes of states and inputs."""
        return self.sizes or Sizes.balanced(self.A, self.B)

    @property
    def gain_unit(self) -> float:
        """What the norm of a gain in sizes is counted in: 1, or 1/s for L, which turns outputs into rates."""
        return 1.0 if self.role is CONTROLLER else self.scale.speed

    def norm(self, K: Array) -> float:
        """Return how large a gain (m, n) is: ‖E⁻¹ K S‖ with the sizes S and E; of L ‖S⁻¹ L E‖ in 1/s."""
        return float(np.linalg.norm(self.scale.gain(K), 2)) * self.gain_unit

    @cached_property
    def balls(self) -> tuple[Sequence[BallMatrix], BallMatrix]:
        """A_i and B in the numbers that proofs are about."""
        n, m = self.B.shape
        return self.exact or ([BallMatrix.of(A_i, (n, n)) for A_i in self.A], BallMatrix.of(self.B, (n, m)))

    @property
    def centres(self) -> tuple[list[Rational], Rational]:
        """The middle of each ball, about which a proof that there is no gain speaks."""
        return [A_i.centre for A_i in self.balls[0]], self.balls[1].centre

    def closed(self, K: Array) -> Array:
        """Return A_i + B K, (l, n, n)."""
        return np.asarray(self.A + self.B @ K)

    @cached_property
    def _different(self) -> Array:
        return distinct(self.A)[0]

    def unlike(self, K: Array) -> Array:
        """Return the different ones of these, (d, n, n), in an order of their own."""
        return np.asarray(self._different + self.B @ K)

    def exactly_closed(self, K: Array) -> list[BallMatrix]:
        """Return A_i + B K in the numbers that proofs are about, K as printed."""
        A, B = self.balls
        gain = B @ BallMatrix.of(K, (K.shape[0], K.shape[1]))
        return each(lambda A_i: A_i + gain, A)

    def reached(self, K: Array, P: Array, rate: float) -> Certificate | None:
        """Return the certificate that P gives for a gain, if it shows a rate (1/s)."""
        found = prove(self.unlike(K), P) if np.isfinite(K).all() else None
        return found if found is not None and reaches(found, rate) else None

    def reached_exactly(self, K: Array, P: Array) -> Certificate | None:
        """Return the certificate that P gives in exact numbers, where it is too ill-conditioned for floating point."""
        rate = likely_rate(self.closed(K), P)
        if not rate > 0:
            return None
        M = different(self.exactly_closed(K))
        proofs = (prove_exactly(self.role, M, P, rate * share) for share in _SHARES)
        proof = next((proof for proof in proofs if proof is not None), None)
        return None if proof is None else of_proof(self.closed(K), proof)


def reaches(certificate: Certificate, rate: float) -> bool:
    """Say whether the exact proof, which gives up a little, will still show the rate."""
    return certificate.rate * (1 - 2 * RATE_GIVEN) >= rate
