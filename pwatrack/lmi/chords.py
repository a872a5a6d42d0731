"""The peak gain of one linear system, enclosed: what a bounded scalar can do to a signal at most, ∫ |c e^(Mt) g| dt.

On a step h from z, f(t) = c e^(Mt) z differs from its chord by at most h²/8 ∫ |f''| in the mean of its size, so
∫ |f| ≤ ∫ |chord| + h^(5/2)/8 (∫ f''²)^(1/2). With w = c M² and MᵀP + P M + wᵀw ≺ 0 the last integral is at most
zᵀP z − z₊ᵀP z₊, z₊ = e^(Mh) z. What is left after the last step is bounded by an ellipsoid, V = zᵀQ⁻¹z, V' ≤ −a V:
∫ |c z| ≤ 2/a √(c Q cᵀ) √V. Steps are h = 2^unit 2^k, with k growing as fast modes die out; e^(Mh) is enclosed by balls.
"""

from dataclasses import dataclass
from fractions import Fraction
from itertools import groupby
from typing import Any

import flint
import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.ellipsoid import Ellipsoid
from pwatrack.lmi.exact import BITS, unpacked
from pwatrack.rational import Rational, floats, fraction_of, is_positive_definite, rational, working_bits

_STEP, _TAIL = 1e-5, 1e-3  # of the ellipsoid's size: what one step, and the end, may be off
_MOST_STEPS, _MOST_ORDER = 2500, 16  # of a walk: some seconds in the auditor
_PRECISION = 300  # bits of the balls
_DIGITS = 110  # bits of P
_INSIDE = Fraction(1, 2**60)  # of the square of w: by so much P is inside its inequality
_ABOVE = Fraction(1_000_001, 1_000_000)  # so that other balls come to no more


@dataclass(frozen=True, kw_only=True)
class PeakGain:
    """∫ |c e^(Mt) g| dt ≤ size, proved.

    Attributes:
        unit: The shortest step is 2^unit s.
        steps: One after the other: k, and how many steps of 2^(unit + k) s.
        integers, exponents: P_jk = integers_jk · 2^(exponents_j + exponents_k).
        size: Rounded up.
    """

    unit: int
    steps: tuple[tuple[int, int], ...]
    integers: tuple[tuple[int, ...], ...]
    exponents: tuple[int, ...]
    size: float


def peak_gain(M: BallMatrix, g: BallMatrix, c: BallMatrix, ellipsoid: Ellipsoid) -> PeakGain | None:
    """Return the peak gain of z' = M z + g d, of c z; None where it takes too many steps or an entry is irrational.

    Args:
        M: (N, N), stable.
        g: (N, 1).
        c: (1, N).
        ellipsoid: Of M, g and c.

    Example: a damped oscillator, ∫ |e^(−t) sin 3t| / 3 dt.

        >>> from pwatrack.lmi.ellipsoid import Inner, ellipsoid
        >>> M, g, c = (BallMatrix.of(X) for X in ([[0, 1], [-10, -2]], [[0], [1]], [[1, 0]]))
        >>> around = ellipsoid([M], g, c, [Inner(Q=np.array([[1, -0.9], [-0.9, 10]]), most=0.5)])
        >>> 1 < peak_gain(M, g, c, around).size / float(0.1 / np.tanh(np.pi / 6)) < 1.01
        True
    """
    if any(X.radius is not None for X in (M, g, c)) or M.shape[0] > _MOST_ORDER:
        return None
    powers = [e + BITS // 2 for e in ellipsoid.exponents]  # in these coordinates Q has a diagonal of about 1
    scale = [Fraction(2) ** e for e in powers]
    exact = _scaled(M.centre, [1 / s for s in scale], scale)
    column, row = _scaled(g.centre, [1 / s for s in scale], [Fraction(1)]), _scaled(c.centre, [Fraction(1)], scale)
    Q = _scaled(unpacked(ellipsoid.integers, ellipsoid.exponents), [1 / s for s in scale], [1 / s for s in scale])
    planned = _plan(floats(exact), floats(column)[:, 0], floats(row)[0], floats(Q), ellipsoid)
    if planned is None:
        return None
    unit, steps = planned
    P, digits = _observed(exact, row)
    w = row * exact * exact
    MP = exact.transpose() * P
    if not is_positive_definite(-(MP + MP.transpose() + w.transpose() * w)):
        return None
    total = _enclosed(exact, column, row, P, Q, Fraction(repr(ellipsoid.a)), unit, steps)
    return PeakGain(
        unit=unit,
        steps=tuple((k, len([*same])) for k, same in groupby(steps)),
        integers=tuple(tuple(int(v * 4**digits) for v in map(fraction_of, line)) for line in P.tolist()),
        exponents=tuple(-e - digits for e in powers),
        size=float(np.nextafter(float(total * _ABOVE), np.inf)),
    )


def _scaled(X: Rational, left: list[Fraction], right: list[Fraction]) -> Rational:
    lines = zip(X.tolist(), left, strict=True)
    rows = [[fraction_of(v) * a * b for v, b in zip(line, right, strict=True)] for line, a in lines]
    return rational(rows, (X.nrows(), X.ncols()))


def _plan(M: Array, g: Array, c: Array, Q: Array, ellipsoid: Ellipsoid) -> tuple[int, list[int]] | None:
    """Return the exponent of the shortest step, and of each step how many times it is doubled."""
    size, a = ellipsoid.sizes[0], ellipsoid.a
    unit = int(np.floor(np.log2(0.49 / float(np.abs(M).sum(axis=1).max()))))
    longest = min(max(int(np.ceil(np.log2(2 / a) - unit)), 0), 60)
    flows = [expm(M * 2.0 ** (unit + k)) for k in range(longest + 1)]
    w = c @ M @ M
    P = solve_continuous_lyapunov(M.T, -np.outer(w, w))
    last, inverse = 2 / a * float(np.sqrt(c @ Q @ c)), np.linalg.inv(Q)
    z, steps = g, list[int]()
    while last * float(np.sqrt(max(float(z @ inverse @ z), 0.0))) > _TAIL * size:
        if len(steps) == _MOST_STEPS or not np.isfinite(z).all():
            return None
        for k in range(min(steps[-1] + 1, longest) if steps else 0, -1, -1):
            after = flows[k] @ z
            off = 2.0 ** (2.5 * (unit + k)) / 8 * np.sqrt(max(float(z @ P @ z - after @ P @ after), 0.0))
            if off <= _STEP * size:
                break
        z = after
        steps.append(k)
    return unit, steps


def _observed(M: Rational, c: Rational) -> tuple[Rational, int]:
    """Return P with MᵀP + P M + wᵀw a little below 0, w = c M², and the power of 4 that makes its entries whole."""
    n, w = M.nrows(), c * M * M
    square = w.transpose() * w
    more = _INSIDE * sum((fraction_of(square[j, j]) for j in range(n)), Fraction(0))
    right = [-fraction_of(square[j, k]) - more * (j == k) for j in range(n) for k in range(n)]
    system = [[Fraction(0)] * (n * n) for _ in range(n * n)]
    for j in range(n):
        for k in range(n):
            for i in range(n):
                system[n * j + k][n * i + k] += fraction_of(M[i, j])
                system[n * j + k][n * j + i] += fraction_of(M[i, k])
    with working_bits(_PRECISION):
        solution = flint.arb_mat(rational(system, (n * n, n * n))).solve(
            flint.arb_mat(rational([[v] for v in right], (n * n, 1)))
        )
        found = [_dyadic(solution[j, 0].mid()) for j in range(n * n)]
    largest = max(map(abs, found))
    digits = _DIGITS - (largest.numerator.bit_length() - largest.denominator.bit_length()) // 2
    whole = [round(v * Fraction(4) ** digits) / Fraction(4) ** digits for v in found]
    rows = [[whole[n * min(j, k) + max(j, k)] for k in range(n)] for j in range(n)]
    return rational(rows, (n, n)), digits


def _enclosed(
    M: Rational, g: Rational, c: Rational, P: Rational, Q: Rational, a: Fraction, unit: int, steps: list[int]
) -> Fraction:
    """Return an upper bound of the integral, by balls."""
    with working_bits(_PRECISION):
        flows = [(flint.arb_mat(M) * flint.arb(2) ** unit).exp()]
        while len(flows) <= max(steps, default=0):
            flows.append(flows[-1] * flows[-1])
        row, weight, z = flint.arb_mat(c), flint.arb_mat(P), flint.arb_mat(g)
        value, energy, total = (row * z)[0, 0], (z.transpose() * weight * z)[0, 0], flint.arb(0)
        for k in steps:
            z = flows[k] * z
            following, less = (row * z)[0, 0], (z.transpose() * weight * z)[0, 0]
            h, drop = flint.arb(2) ** (unit + k), energy - less
            total += h * _chord(value, following)
            total += h**2 * (h * flint.arb(max(drop.upper(), flint.arb(0)))).sqrt() / 8
            value, energy = following, less
        inverse = flint.arb_mat(Q.inv())
        left = (z.transpose() * inverse * z)[0, 0].abs_upper() * (row * flint.arb_mat(Q) * row.transpose())[0, 0]
        total += 2 * left.sqrt() / flint.arb(flint.fmpq(a.numerator, a.denominator))
        return _dyadic(total.abs_upper())


def _dyadic(value: Any) -> Fraction:
    """Return an exact number as a fraction."""
    mantissa, exponent = value.man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


def _chord(one: Any, other: Any) -> Any:
    """Return the mean size of a line from one value to another: (x² + y²) / (|x| + |y|) / 2 where it crosses 0."""
    x, y = flint.arb(one.mid()), flint.arb(other.mid())
    mean = (abs(x) + abs(y)) / 2 if not x * y < 0 else (x * x + y * y) / (abs(x) + abs(y)) / 2
    return mean + (flint.arb(one.rad()) + flint.arb(other.rad())) / 2
