"""What an engineer asks of a gain."""

from dataclasses import dataclass
from numbers import Real
from typing import Literal

import numpy as np

from pwatrack.arrays import Array
from pwatrack.errors import InvalidSpec, Problem


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What K, or Lᵀ, is to achieve. With nothing asked it is the LQR, or Kalman, gain with unit weights.

    Attributes:
        given: The gain itself, (m, n): only to be proved.
        rate: Decay rate in 1/s that is to be reached at least, or "largest".
        gain: Bound on the spectral norm of the gain in the units given, or "smallest" for a given rate.
        Q, R: Weights of ∫(eᵀQe + vᵀRv) dt, (n, n) and (m, m); for the observer the covariance densities
            of noise on the states and on the measurement.

    Raises:
        InvalidSpec: If a rate or gain is neither such a word nor a positive finite number, or Q stands without R.

    Example:
        >>> Goal(rate=1, gain="smallest").least_rate
        1.0
    """

    given: Array | None = None
    rate: float | Literal["largest"] | None = None
    gain: float | Literal["smallest"] | None = None
    Q: Array | None = None
    R: Array | None = None

    def __post_init__(self) -> None:
        problems = []
        for name, value, word in (("rate", self.rate, "largest"), ("gain", self.gain, "smallest")):
            number = isinstance(value, Real) and not isinstance(value, bool) and np.isfinite(value) and value > 0
            if not (value is None or number or (isinstance(value, str) and value == word)):
                problems.append(Problem(message=f"{name} is a positive number or '{word}', not {value!r}"))
        if (self.Q is None) != (self.R is None):
            problems.append(Problem(message="a cost has both weights, Q and R"))
        if problems:
            raise InvalidSpec(*problems)

    @property
    def least_rate(self) -> float:
        """The rate that must be reached; 0 where none is asked."""
        return 0.0 if self.rate is None or self.rate == "largest" else float(self.rate)

    @property
    def bound(self) -> float:
        """The bound on the norm of the gain; infinite where none is asked."""
        return float("inf") if self.gain is None or self.gain == "smallest" else float(self.gain)

    @property
    def fastest(self) -> bool:
        """Whether the largest rate is asked, which is also what a bound alone means."""
        return self.rate == "largest" or (self.rate is None and self.gain is not None)


DEFAULT = Goal()
