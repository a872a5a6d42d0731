"""What a bounded scalar can do to a linear system: its peak gain, enclosed in ball arithmetic.

Let z' = M z + g d from z = 0, with one matrix M, all of whose eigenvalues λ_k decay. Then |c z| ≤ γ sup |d| with

    γ = ∫ |s(t)| dt,      s(t) = c e^(M t) g = Σ r_k e^(λ_k t),

and no smaller number does: d(t) = sign s(T − t) comes as near to it as is wanted. λ_k and r_k are enclosed by FLINT.
With S(t) = Σ r_k e^(λ_k t) / λ_k the integral over [a, b] is |S(b) − S(a)| where s keeps its sign, which it does if
|s(m)| > |s'(m)| h + h² sup |s''| / 2 in the middle m, h = (b − a) / 2; elsewhere that is a lower bound and
(b − a) sup |s| an upper one. Intervals are halved where the two are furthest apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Any

import flint
import numpy as np

from pwatrack.ball_matrix import BallMatrix
from pwatrack.rational import working_bits

_BITS = 192  # of the balls: modes far apart in speed lose many of them
_LONG = 24.0  # time constants of the slowest mode: what comes after is e^−24 of it
_NEAR = 2e-3  # of the gain, how far its bounds may be apart
_MOST = 400  # times that intervals are halved


@dataclass(frozen=True)
class _Modes:
    """λ_k of one matrix and e^(λ_k t) at the times that were looked at."""

    rates: list[Any]
    seen: dict[float, list[Any]] = field(default_factory=dict)

    def at(self, t: float) -> list[Any]:
        """Return e^(λ_k t)."""
        if t not in self.seen:
            self.seen[t] = [(rate * flint.arb(t)).exp() for rate in self.rates]
        return self.seen[t]


def peak_gains(M: BallMatrix, g: BallMatrix, forms: BallMatrix) -> list[tuple[float, float]] | None:
    """Return the peak gain from d to each form, between a lower and an upper bound.

    Args:
        M: (N, N).
        g: (N, 1).
        forms: The rows c, (s, N).

    Returns:
        One pair for each row; None where eigenvalues cannot be told apart, or one does not decay.

    Example: |z| ≤ 3 / 2 sup |d| for z' = −2 z + 3 d.

        >>> found = peak_gains(*(BallMatrix.of([[v]]) for v in (-2, 3, 1)))
        >>> found[0][0] <= 1.5 <= found[0][1] < 1.5 * 1.003
        True
    """
    with working_bits(_BITS):
        matrix = _complex(M)
        try:
            rates, vectors = matrix.eig(right=True)
            weights = vectors.solve(_complex(g))
        except (ValueError, ZeroDivisionError):
            return None
        if not all(rate.real < 0 for rate in rates):
            return None
        modes, seen = _Modes(rates), _complex(forms) * vectors
        N = len(rates)
        return [_enclosed(modes, [seen[j, k] * weights[k, 0] for k in range(N)]) for j in range(forms.shape[0])]


def _enclosed(modes: _Modes, residues: Sequence[Any]) -> tuple[float, float]:
    """Return a lower and an upper bound of ∫ |Σ r_k e^(λ_k t)| dt."""
    rates = modes.rates
    end = float(np.ldexp(1.0, int(np.ceil(np.log2(_LONG / min(-float(rate.real.mid()) for rate in rates))))))
    rest = sum(
        (abs(r) * abs(e) / -rate.real for r, e, rate in zip(residues, modes.at(end), rates, strict=True)), flint.arb(0)
    )
    heap = list[tuple[float, float, float, Any, Any]]()
    _add(heap, modes, residues, 0.0, end)
    for _ in range(_MOST):
        apart, total = sum(-entry[0] for entry in heap), sum(float(entry[3].mid()) for entry in heap)
        if apart <= _NEAR / 2 * total:
            break
        _, a, b, _, _ = heappop(heap)
        _add(heap, modes, residues, a, (a + b) / 2)
        _add(heap, modes, residues, (a + b) / 2, b)
    low = sum((entry[3] for entry in heap), flint.arb(0))
    high = sum((entry[4] for entry in heap), rest)
    return max(float(np.nextafter(float(low.lower()), -np.inf)), 0.0), float(np.nextafter(float(high.upper()), np.inf))


def _add(heap: list[tuple[float, float, float, Any, Any]], modes: _Modes, r: Sequence[Any], a: float, b: float) -> None:
    """Put an interval on the heap, with how far its bounds are apart, and both of them."""
    first, last, middle, rates = modes.at(a), modes.at(b), modes.at((a + b) / 2), modes.rates
    h = flint.arb((b - a) / 2)
    moved = abs(sum(((y - x) * v / p for x, y, v, p in zip(first, last, r, rates, strict=True)), flint.acb(0)).real)
    here = abs(sum((e * v for e, v in zip(middle, r, strict=True)), flint.acb(0)).real)
    slope = abs(sum((e * v * p for e, v, p in zip(middle, r, rates, strict=True)), flint.acb(0)).real)
    sizes = [abs(e) * abs(v) for e, v in zip(first, r, strict=True)]
    curve = sum((size * abs(p) ** 2 for size, p in zip(sizes, rates, strict=True)), flint.arb(0))
    away = slope * h + h * h * curve / 2
    if here > away:
        high = moved
    else:
        most, least = sum(sizes, flint.arb(0)), here + away
        high = 2 * h * (most if most < least else least)
    apart = 0.0 if here > away else max(float(high.upper()) - float(moved.lower()), 0.0)
    heappush(heap, (-apart, a, b, moved, high))


def _complex(X: BallMatrix) -> Any:
    """Return a matrix as FLINT's complex balls."""
    rows, columns = X.shape
    entries = [flint.arb(X.centre[j, k]) for j in range(rows) for k in range(columns)]
    if X.radius is not None:
        spread = (flint.arb(X.radius[j, k]) for j in range(rows) for k in range(columns))
        entries = [entry + flint.arb(0, radius.upper()) for entry, radius in zip(entries, spread, strict=True)]
    return flint.acb_mat(rows, columns, [flint.acb(entry) for entry in entries])
