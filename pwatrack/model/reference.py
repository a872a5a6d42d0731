"""The reference y_d and its derivatives as the output of a linear exosystem."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, expm

from pwatrack.arrays import Array, readonly


@dataclass(frozen=True, kw_only=True)
class Reference:
    """y_d(t) = Q w(t), where ẇ = S w and w(0) = w0.

    Every derivative is again linear in w: y_d⁽ᵏ⁾ = Q Sᵏ w.

    Attributes:
        S: (p, p), in 1/s.
        Q: (p,).
        w0: (p,).
        period: In s, or None if y_d is constant or not periodic.
        amplitude: The largest |y_d| that can occur.

    Example:
        >>> y_d = sinusoids(constant=1.0, amplitudes=[2.0], frequencies=[np.pi], phases=[0.0])
        >>> round(float(y_d(0.5)), 12), round(float(y_d(1.0, derivative=1)), 12)
        (3.0, -6.28318530718)
    """

    S: Array
    Q: Array
    w0: Array
    period: float | None
    amplitude: float

    def derivative_rows(self, r: int) -> Array:
        """Return Q, Q S, …, Q Sʳ as a matrix (r + 1, p)."""
        rows = [self.Q]
        for _ in range(r):
            rows.append(rows[-1] @ self.S)
        return np.array(rows)

    def __call__(self, t: float, derivative: int = 0) -> float:
        """Return the derivative of the given order of y_d at time t in s."""
        return float(self.derivative_rows(derivative)[-1] @ expm(self.S * t) @ self.w0)


def sinusoids(
    *, constant: float, amplitudes: Sequence[float], frequencies: Sequence[float], phases: Sequence[float]
) -> Reference:
    """Return y_d(t) = constant + Σ amplitude_k sin(frequency_k t + phase_k).

    Args:
        constant: The mean, in the unit of the output.
        amplitudes: One per sinusoid, in the unit of the output.
        frequencies: In rad/s, positive.
        phases: In rad.
    """
    blocks = [np.zeros((1, 1))] + [np.array([[0.0, w], [-w, 0.0]]) for w in frequencies]
    outputs = [[1.0]] + [[1.0, 0.0] for _ in frequencies]
    starts = [[float(constant)]] + [[a * np.sin(p), a * np.cos(p)] for a, p in zip(amplitudes, phases, strict=True)]
    return Reference(
        S=readonly(block_diag(*blocks)),
        Q=readonly(np.concatenate(outputs)),
        w0=readonly(np.concatenate(starts)),
        period=_common_period(frequencies),
        amplitude=abs(float(constant)) + sum(abs(a) for a in amplitudes),
    )


def _common_period(frequencies: Sequence[float]) -> float | None:
    """Return the least common period of sinusoids whose frequencies have ratios with denominators up to 1000."""
    from fractions import Fraction

    if not len(frequencies):
        return None
    first = frequencies[0]
    ratios = [Fraction(f / first).limit_denominator(1000) for f in frequencies]
    if any(abs(float(q) * first - f) > 1e-12 * f for q, f in zip(ratios, frequencies, strict=True)):
        return None
    turns = int(np.lcm.reduce([q.denominator for q in ratios]))
    count = int(np.gcd.reduce([int(q * turns) for q in ratios]))
    return float(2 * np.pi / first * turns / count)
