"""The modes of a matrix: frequency, damping, time constant."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array

NOTHING = 1e-12  # of the fastest eigenvalue: one that is less is that of an integrator


@dataclass(frozen=True, kw_only=True)
class Mode:
    """A mode of a matrix: one eigenvalue, or a pair of conjugate ones."""

    frequency: float  # |λ| in rad/s, 0 of an integrator
    damping: float  # −Re λ / |λ|: 1 where it does not oscillate, 0 where it is not damped, below 0 where it runs away
    time_constant: float  # −1 / Re λ in s: negative where it runs away, infinite where it is not damped


def modes(A: Array) -> list[Mode]:
    """Return the modes of x' = A x, the slowest first.

    Example: a mass on a spring with a tenth of critical damping.

        >>> (found,) = modes(np.array([[0.0, 1.0], [-4.0, -0.4]]))
        >>> print(f"{found.frequency:.3g} {found.damping:.3g} {found.time_constant:.3g}")
        2 0.1 5
    """
    values = np.linalg.eigvals(A).astype(complex)
    rounding, found = NOTHING * float(np.abs(values).max(initial=0.0)), list[Mode]()
    for value in sorted(values.tolist(), key=abs):
        if value.imag < 0:
            continue
        size, real = abs(value), 0.0 if abs(value.real) <= rounding else value.real
        if size <= rounding:
            found.append(Mode(frequency=0.0, damping=0.0, time_constant=np.inf))
        else:
            constant = -1 / real if real else np.inf
            found.append(Mode(frequency=float(f"{size:.12g}"), damping=-real / size + 0.0, time_constant=constant))
    return found
