"""What an engineer asks of a gain."""

from dataclasses import dataclass
from numbers import Real
from typing import Literal

import numpy as np

from pwatrack.arrays import Array
from pwatrack.errors import InvalidSpec, Problem


class _Checked:
    """A goal with a rate or a bound, which are positive numbers; a rate may be 0, a bound infinite."""

    def __post_init__(self) -> None:
        rate, bound = getattr(self, "rate", 0.0), getattr(self, "bound", np.inf)
        problems = [
            Problem(message=f"{name} is a positive number, not {value!r}")
            for name, value in (("rate", rate or 1.0), ("gain", 1.0 if bound == np.inf else bound))
            if not isinstance(value, Real) or isinstance(value, bool) or not 0 < float(value) < np.inf
        ]
        if problems:
            raise InvalidSpec(*problems)


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """The gain is known and only to be proved."""

    gain: Array  # K, or L, as it stands in (10) and (18)


@dataclass(frozen=True, kw_only=True)
class AtLeast(_Checked):
    """The LQR, or Kalman, gain with unit weights in sizes, of the plant with the rate added to A.

    Raises InvalidSpec if a number is not a positive one (a rate may be 0, a bound infinite).
    """

    rate: float = 0.0  # decay rate in 1/s that is to be reached; 0 where any will do
    # on the norm of the gain in sizes, see `Task.norm`: where that gain is larger, the smallest one that is found is
    # taken
    bound: float = np.inf
    # "limits" where no limit of an input is to be reached; "region" where errors are to go to 0 from as much of the
    # starts as can be, with inputs at their limits
    within: Literal["limits", "region"] | None = None


@dataclass(frozen=True, kw_only=True)
class Smallest(_Checked):
    """The smallest gain that is found for a rate."""

    rate: float = 0.0  # in 1/s; 0 where any will do


@dataclass(frozen=True, kw_only=True)
class Fastest(_Checked):
    """The largest rate that is found."""

    bound: float = np.inf  # on the norm of the gain in sizes, see `Task.norm`
    within: Literal["limits"] | None = None  # "limits" where no limit of an input is to be reached


@dataclass(frozen=True, kw_only=True, eq=False)
class LeastCost:
    """The gain of the least bound of a quadratic cost."""

    # weights of ∫(eᵀQe + vᵀRv) dt, (n, n) and (m, m); for the observer the covariance densities of noise on the states
    # (n, n) and on the measurement (q, q)
    Q: Array
    R: Array


Goal = Given | AtLeast | Smallest | Fastest | LeastCost
DEFAULT = AtLeast()


def demands(goal: Goal) -> tuple[float, float]:
    """Return the rate in 1/s that a goal wants at least, and the norm that its gain may have at most."""
    return float(getattr(goal, "rate", 0.0)), float(getattr(goal, "bound", np.inf))
