"""What an engineer asks of a gain."""

from dataclasses import dataclass
from typing import Literal

from pwatrack.arrays import Array


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What K, or Lᵀ, is to achieve. With nothing asked, a gentle gain is found that needs no tuning.

    Attributes:
        given: The gain itself, (m, n): only to be proved.
        rate: Decay rate in 1/s that is to be reached at least, or "largest".
        gain: Bound on the spectral norm of the gain in the units given, or "smallest" for a given rate.
        Q, R: Weights of ∫(eᵀQe + vᵀRv) dt, (n, n) and (m, m); for the observer the covariance densities
            of noise on the states and on the measurement.

    Example:
        >>> Goal(rate=0.1, gain="smallest").least_rate
        0.1
    """

    given: Array | None = None
    rate: float | Literal["largest"] | None = None
    gain: float | Literal["smallest"] | None = None
    Q: Array | None = None
    R: Array | None = None

    @property
    def least_rate(self) -> float:
        """The rate that must be reached; 0 where none is asked."""
        return self.rate if isinstance(self.rate, float) else 0.0

    @property
    def bound(self) -> float:
        """The bound on the norm of the gain; infinite where none is asked."""
        return self.gain if isinstance(self.gain, float) else float("inf")

    @property
    def fastest(self) -> bool:
        """Whether the largest rate is asked, which is also what a bound alone means."""
        return self.rate == "largest" or (self.rate is None and self.gain is not None)


DEFAULT = Goal()
