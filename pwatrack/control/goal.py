"""What an engineer asks of a gain."""

from dataclasses import dataclass
from numbers import Real
from typing import Literal

import numpy as np

from pwatrack.arrays import Array
from pwatrack.errors import InvalidSpec, Problem


def _positive(**numbers: object) -> None:
    problems = [
        Problem(message=f"{name} is a positive number, not {value!r}")
        for name, value in numbers.items()
        if not isinstance(value, Real) or isinstance(value, bool) or not 0 < float(value) < np.inf
    ]
    if problems:
        raise InvalidSpec(*problems)


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """The gain is known and only to be proved.

    Attributes:
        gain: K, or L, as it stands in (10) and (18).
    """

    gain: Array


@dataclass(frozen=True, kw_only=True)
class AtLeast:
    """The LQR, or Kalman, gain with unit weights in sizes, of the plant with the rate added to A.

    Attributes:
        rate: Decay rate in 1/s that is to be reached; 0 where any will do.
        bound: On the norm of the gain in sizes, see `Task.norm`: where that gain is larger, the smallest one that
            is found is taken.
        within: "limits" where no limit of an input is to be reached; "region" where errors are to go to 0 from as much
            of the starts as can be, with inputs at their limits.

    Raises:
        InvalidSpec: If a number is not a positive one (a rate may be 0, a bound infinite).
    """

    rate: float = 0.0
    bound: float = np.inf
    within: Literal["limits", "region"] | None = None

    def __post_init__(self) -> None:
        _positive(rate=self.rate or 1.0, gain=1.0 if self.bound == np.inf else self.bound)


@dataclass(frozen=True, kw_only=True)
class Smallest:
    """The smallest gain that is found for a rate.

    Attributes:
        rate: In 1/s; 0 where any will do.
    """

    rate: float = 0.0

    def __post_init__(self) -> None:
        _positive(rate=self.rate or 1.0)


@dataclass(frozen=True, kw_only=True)
class Fastest:
    """The largest rate that is found.

    Attributes:
        bound: On the norm of the gain in sizes, see `Task.norm`.
        within: "limits" where no limit of an input is to be reached.
    """

    bound: float = np.inf
    within: Literal["limits"] | None = None

    def __post_init__(self) -> None:
        _positive(gain=1.0 if self.bound == np.inf else self.bound)


@dataclass(frozen=True, kw_only=True, eq=False)
class LeastCost:
    """The gain of the least bound of a quadratic cost.

    Attributes:
        Q, R: Weights of ∫(eᵀQe + vᵀRv) dt, (n, n) and (m, m); for the observer the covariance densities
            of noise on the states (n, n) and on the measurement (q, q).
    """

    Q: Array
    R: Array


Goal = Given | AtLeast | Smallest | Fastest | LeastCost
DEFAULT = AtLeast()


def demands(goal: Goal) -> tuple[float, float]:
    """Return the rate in 1/s that a goal wants at least, and the norm that its gain may have at most.

    Example:
        >>> demands(AtLeast(rate=2)), demands(Fastest(bound=5))
        ((2.0, inf), (0.0, 5.0))
    """
    return float(getattr(goal, "rate", 0.0)), float(getattr(goal, "bound", np.inf))
