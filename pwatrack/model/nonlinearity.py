"""Scalar piecewise linear elements φ(s), s = row · x + constant, and the cells they make of the state space."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.model.cells import Partition


@dataclass(frozen=True, kw_only=True)
class PiecewiseLinear:
    """A continuous scalar function φ, linear between breakpoints.

    Attributes:
        breakpoints: Increasing, k of them.
        slopes: k + 1 of them, from left to right.
        value: φ at the first breakpoint.
        segments: A name for each of the k + 1 segments.

    Example:
        >>> clip = saturation(lower=-1.0, upper=2.0, slope=3.0)
        >>> [clip(s) for s in (-5.0, 0.5, 9.0)]
        [-3.0, 1.5, 6.0]
    """

    breakpoints: tuple[float, ...]
    slopes: tuple[float, ...]
    value: float
    segments: tuple[str, ...]

    def __call__(self, s: float) -> float:
        """Return φ(s)."""
        k = int(np.searchsorted(self.breakpoints, s))
        return self.slopes[k] * s + self.intercepts[k]

    @property
    def intercepts(self) -> tuple[float, ...]:
        """The c_k with φ(s) = slopes[k] s + c_k on segment k."""
        found = [self.value - self.slopes[0] * self.breakpoints[0]]
        for k, s in enumerate(self.breakpoints):
            found.append(found[-1] + (self.slopes[k] - self.slopes[k + 1]) * s)
        return tuple(found)


def dead_zone(*, lower: float, upper: float, lower_slope: float = 1.0, upper_slope: float = 1.0) -> PiecewiseLinear:
    """Return φ = 0 between lower and upper, and a line from there on either side: gaps, backlash springs, stops."""
    _increasing(lower, upper)
    return PiecewiseLinear(
        breakpoints=(lower, upper),
        slopes=(lower_slope, 0.0, upper_slope),
        value=0.0,
        segments=("below", "inside", "above"),
    )


def saturation(*, lower: float, upper: float, slope: float = 1.0) -> PiecewiseLinear:
    """Return φ(s) = slope · clip(s, lower, upper)."""
    _increasing(lower, upper)
    return PiecewiseLinear(
        breakpoints=(lower, upper),
        slopes=(0.0, slope, 0.0),
        value=slope * lower,
        segments=("low", "linear", "high"),
    )


def spring(*, start: float = 0.0, slope: float = 1.0) -> PiecewiseLinear:
    """Return φ(s) = slope · max(0, s − start): a one-sided spring, a ReLU, an ideal diode."""
    return PiecewiseLinear(breakpoints=(start,), slopes=(0.0, slope), value=0.0, segments=("off", "on"))


def absolute(*, slope: float = 1.0) -> PiecewiseLinear:
    """Return φ(s) = slope · |s|."""
    return PiecewiseLinear(breakpoints=(0.0,), slopes=(-slope, slope), value=0.0, segments=("negative", "positive"))


def piecewise_linear(
    *, breakpoints: Sequence[float], slopes: Sequence[float], value: float | None = None
) -> PiecewiseLinear:
    """Return φ with free breakpoints and slopes; without `value` at the first breakpoint, φ(0) = 0.

    Raises:
        ValueError: If the breakpoints do not increase or there is not one slope more than breakpoints.
    """
    _increasing(*breakpoints)
    if not breakpoints:
        raise ValueError("at least one breakpoint is expected")
    if len(slopes) != len(breakpoints) + 1:
        raise ValueError(f"{len(slopes)} slopes for {len(breakpoints)} breakpoints, expected one more than breakpoints")
    names = tuple(f"segment {k + 1}" for k in range(len(slopes)))
    function = PiecewiseLinear(breakpoints=tuple(breakpoints), slopes=tuple(slopes), value=0.0, segments=names)
    if value is None:
        value = -function(0.0)
    return PiecewiseLinear(breakpoints=tuple(breakpoints), slopes=tuple(slopes), value=value, segments=names)


@dataclass(frozen=True, kw_only=True)
class Nonlinearity:
    """Adds direction · φ(row · x + constant) to ẋ.

    Attributes:
        name: For the names of the cells.
        function: φ.
        row, constant: The linear form, (n,) and a scalar.
        direction: (n,).
    """

    name: str
    function: PiecewiseLinear
    row: Array
    constant: float
    direction: Array


def generate_cells(A: Array, b: Array, nonlinearities: Sequence[Nonlinearity]) -> tuple[Partition, Array, Array]:
    """Return the cells, A (l, n, n) and b (l, n) of ẋ = A x + b + Σ direction φ(row · x + constant).

    One cell for each combination of segments that has an interior.
    """
    H = [n.row for n in nonlinearities for _ in n.function.breakpoints]
    h = [n.constant - s for n in nonlinearities for s in n.function.breakpoints]
    combinations: list[tuple[int, ...]] = [()]
    trial = _Arrangement(np.array(H).reshape(-1, len(A)), np.array(h), nonlinearities)
    for _ in nonlinearities:
        grown = [(*c, k) for c in combinations for k in range(trial.segments(len(c)))]
        combinations = [c for c in grown if trial.exists(c)]
    signs = np.array([trial.signs(c) for c in combinations]).reshape(len(combinations), len(h))
    names = [", ".join(_names(n, k) for n, k in zip(nonlinearities, c, strict=True)) for c in combinations]
    stack_A, stack_b = np.repeat(A[None], len(combinations), 0), np.repeat(b[None], len(combinations), 0)
    for i, combination in enumerate(combinations):
        for n, k in zip(nonlinearities, combination, strict=True):
            slope, intercept = n.function.slopes[k], n.function.intercepts[k]
            stack_A[i] += slope * np.outer(n.direction, n.row)
            stack_b[i] += (slope * n.constant + intercept) * n.direction
    if not nonlinearities:
        names = ["everywhere"]
    return Partition.create(H=trial.H, h=h, signs=signs, names=names), stack_A, stack_b


class _Arrangement:
    """The hyperplanes of all breakpoints, and which combinations of segments exist."""

    def __init__(self, H: Array, h: Array, nonlinearities: Sequence[Nonlinearity]) -> None:
        self.H = H
        self.nonlinearities = nonlinearities
        self.everything = Partition(H=H, h=h, signs=np.zeros((1, len(h)), dtype=np.int64), names=("",))

    def segments(self, position: int) -> int:
        return len(self.nonlinearities[position].function.slopes)

    def signs(self, combination: tuple[int, ...]) -> IntArray:
        rows: list[int] = []
        for n, k in zip(self.nonlinearities, combination, strict=False):
            count = len(n.function.breakpoints)
            rows += [1 if j < k else -1 for j in range(count)]
        return np.array(rows + [0] * (len(self.H) - len(rows)), dtype=np.int64)

    def exists(self, combination: tuple[int, ...]) -> bool:
        return self.everything.interior_point(self.signs(combination)) is not None


def _names(nonlinearity: Nonlinearity, segment: int) -> str:
    return f"{nonlinearity.name} {nonlinearity.function.segments[segment]}"


def _increasing(*values: float) -> None:
    for left, right in itertools.pairwise(values):
        if not left < right:
            raise ValueError(f"{left:g} and {right:g} are not in increasing order")
