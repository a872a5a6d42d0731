"""What a bounded scalar can do to a linear system: its peak gain, enclosed, and a proof that the auditor can walk.

Let z' = M z + g d from z = 0, with one matrix M, all of whose eigenvalues λ_k decay. Then |c z| ≤ γ sup |d| with

    γ = ∫ |s(t)| dt,      s(t) = c e^(M t) g = Σ r_k e^(λ_k t),

and no smaller number does. λ_k and r_k are enclosed by FLINT. With S(t) = Σ r_k e^(λ_k t) / λ_k the integral over
[a, b] is |S(b) − S(a)| where s keeps its sign, which it does if |s(m)| > |s'(m)| h + h² sup |s''| / 2 in the middle m,
h = (b − a) / 2; elsewhere that is a lower bound and (b − a) sup |s| an upper one. Intervals are halved where the two
are furthest apart.

A proof needs no eigenvalues: it goes along chords, as in `docs/theory/beyond.md`, *Bounds, one signal at a time*, in
steps of 2^unit 2^k s, with k growing as fast modes die out. e^(Mh) is enclosed by balls.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from heapq import heappop, heappush
from itertools import groupby
from typing import Any

import flint
import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.ellipsoid import InvariantEllipsoid
from pwatrack.lmi.exact import BITS, Packed
from pwatrack.rational import (
    Rational,
    diagonal,
    dyadic,
    floats,
    fraction_of,
    identity,
    is_positive_definite,
    lyapunov_map,
    middle,
    number,
    symmetric,
)

_BITS = 192  # of the balls: modes far apart in speed lose many of them
_LONG = 24.0  # time constants of the slowest mode: what comes after is e^−24 of it
_NEAR = 2e-3  # of the gain, how far its bounds may be apart
_MOST = 400  # times that intervals are halved
_STEP, _TAIL = 1e-5, 1e-3  # of the ellipsoid's size: what one step, and the end, may be off
_MOST_STEPS, _MOST_ORDER = 2500, 16  # of a walk: some seconds in the auditor
_PRECISION = 300  # bits of the balls
_DIGITS = 110  # bits of P
_INSIDE = Fraction(1, 2**60)  # of the square of w: by so much P is inside its inequality
_ABOVE = Fraction(1_000_001, 1_000_000)  # so that other balls come to no more


def peak_gains(M: BallMatrix, g: BallMatrix, forms: BallMatrix) -> list[tuple[float, float]] | None:
    """Return the peak gain from d to each form, a row c, between a lower and an upper bound.

    None where eigenvalues cannot be told apart, or one does not decay.
    """
    with flint.ctx.workprec(_BITS):
        matrix = _complex(M)
        try:
            rates, vectors = matrix.eig(right=True)
            weights = vectors.solve(_complex(g))
        except (ValueError, ZeroDivisionError):
            return None
        if not all(rate.real < 0 for rate in rates):
            return None
        seen, at = _complex(forms) * vectors, cache(lambda t: [(rate * flint.arb(t)).exp() for rate in rates])
        N = len(rates)
        return [_between(rates, at, [seen[j, k] * weights[k, 0] for k in range(N)]) for j in range(forms.shape[0])]


def _between(rates: Sequence[Any], at: Callable[[float], list[Any]], r: Sequence[Any]) -> tuple[float, float]:
    """Return a lower and an upper bound of ∫ |Σ r_k e^(λ_k t)| dt; `at` has the e^(λ_k t), each worked out once."""
    end = float(np.ldexp(1.0, int(np.ceil(np.log2(_LONG / min(-float(rate.real.mid()) for rate in rates))))))
    rest = sum((abs(v) * abs(e) / -rate.real for v, e, rate in zip(r, at(end), rates, strict=True)), flint.arb(0))
    heap = list[tuple[float, float, float, Any, Any]]()  # how far bounds are apart, the interval, and both of them

    def add(a: float, b: float) -> None:
        first, last, middle = at(a), at(b), at((a + b) / 2)
        h = flint.arb((b - a) / 2)
        moved = abs(sum(((y - x) * v / p for x, y, v, p in zip(first, last, r, rates, strict=True)), flint.acb(0)).real)
        here = abs(sum((e * v for e, v in zip(middle, r, strict=True)), flint.acb(0)).real)
        slope = abs(sum((e * v * p for e, v, p in zip(middle, r, rates, strict=True)), flint.acb(0)).real)
        sizes = [abs(e) * abs(v) for e, v in zip(first, r, strict=True)]
        curve = sum((size * abs(p) ** 2 for size, p in zip(sizes, rates, strict=True)), flint.arb(0))
        away = slope * h + h * h * curve / 2
        apart, high = 0.0, moved
        if not here > away:
            most, least = sum(sizes, flint.arb(0)), here + away
            high = 2 * h * (most if most < least else least)
            apart = max(float(high.upper()) - float(moved.lower()), 0.0)
        heappush(heap, (-apart, a, b, moved, high))

    add(0.0, end)
    for _ in range(_MOST):
        apart, total = sum(-entry[0] for entry in heap), sum(float(entry[3].mid()) for entry in heap)
        if apart <= _NEAR / 2 * total:
            break
        _, a, b, _, _ = heappop(heap)
        add(a, (a + b) / 2)
        add((a + b) / 2, b)
    low = sum((entry[3] for entry in heap), flint.arb(0))
    high = sum((entry[4] for entry in heap), rest)
    return max(float(np.nextafter(float(low.lower()), -np.inf)), 0.0), float(np.nextafter(float(high.upper()), np.inf))


def _complex(X: BallMatrix) -> Any:
    entries = [flint.arb(v) for v in X.centre.entries()]
    if X.radius is not None:
        spread = [flint.arb(0, flint.arb(v).upper()) for v in X.radius.entries()]
        entries = [entry + radius for entry, radius in zip(entries, spread, strict=True)]
    return flint.acb_mat(*X.shape, [flint.acb(entry) for entry in entries])


@dataclass(frozen=True, kw_only=True)
class PeakGain(Packed):
    """∫ |c e^(Mt) g| dt ≤ size, proved."""

    unit: int  # the shortest step is 2^unit s
    steps: tuple[tuple[int, int], ...]  # one after the other: k, and how many steps of 2^(unit + k) s
    size: float  # rounded up


def peak_gain(M: BallMatrix, g: BallMatrix, c: BallMatrix, ellipsoid: InvariantEllipsoid) -> PeakGain | None:
    """Return the peak gain of z' = M z + g d, of c z; None where it takes too many steps or an entry is irrational.

    M is stable, and the ellipsoid is that of M, g and c.
    """
    if any(X.radius is not None for X in (M, g, c)) or M.shape[0] > _MOST_ORDER:
        return None
    powers = [e + BITS // 2 for e in ellipsoid.exponents]  # in these coordinates Q has a diagonal of about 1
    scale = diagonal([Fraction(2) ** e for e in powers])
    inverse = scale.inv()
    exact, column, row = inverse * M.centre * scale, inverse * g.centre, c.centre * scale
    Q = inverse * ellipsoid.P * inverse
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


def _plan(M: Array, g: Array, c: Array, Q: Array, ellipsoid: InvariantEllipsoid) -> tuple[int, list[int]] | None:
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
    right = -square - identity(n) * number(_INSIDE * sum((fraction_of(square[j, j]) for j in range(n)), Fraction(0)))
    column = flint.fmpq_mat([[right[j, k]] for j in range(n) for k in range(j, n)])
    with flint.ctx.workprec(_PRECISION):
        found = middle(flint.arb_mat(lyapunov_map(M)).solve(flint.arb_mat(column))).entries()
    largest = max(map(abs, found))
    digits = _DIGITS - (int(largest.p).bit_length() - int(largest.q).bit_length()) // 2
    scale = Fraction(4) ** digits
    return symmetric([number(round(fraction_of(v) * scale) / scale) for v in found], n), digits


def _enclosed(
    M: Rational, g: Rational, c: Rational, P: Rational, Q: Rational, a: Fraction, unit: int, steps: list[int]
) -> Fraction:
    with flint.ctx.workprec(_PRECISION):
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
        total += 2 * left.sqrt() / flint.arb(number(a))
        return dyadic(total.abs_upper())


def _chord(one: Any, other: Any) -> Any:
    """Return the mean size of a line from one value to another: (x² + y²) / (|x| + |y|) / 2 where it crosses 0."""
    x, y = flint.arb(one.mid()), flint.arb(other.mid())
    mean = (abs(x) + abs(y)) / 2 if not x * y < 0 else (x * x + y * y) / (abs(x) + abs(y)) / 2
    return mean + (flint.arb(one.rad()) + flint.arb(other.rad())) / 2
