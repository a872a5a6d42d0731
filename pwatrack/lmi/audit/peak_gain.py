"""Peak gains: an upper bound of the integral of |c e^(Mt) g|, in whole numbers.

On a step h from z, f = c e^(Mt) z differs from its chord by h^2 / 8 times the mean of |f''| at most, in the mean of its
size. That is at most h^(3/2) / 8 (z^T P z - z'^T P z')^(1/2), z' = e^(Mh) z, where M^T P + P M + w^T w < 0, w = c M^2.
After the last step V = z^T Q^-1 z falls as exp(-a t), and |c z| <= (c Q c^T V)^(1/2). Numbers are multiples of 2^-BITS,
in coordinates in which Q has a diagonal of about 1. How far z may be off is kept as V^(1/2), which no step enlarges.
"""

from fractions import Fraction
from math import ceil, isqrt, lcm
from typing import Any

from .balls import Ball, falls
from .matrices import AuditFault, Matrix, bits, inverted, product, spend, total, transposed
from .reading import number, packed

BITS = 640  # of numbers: well beyond the 400 to which the series is known
_TERMS = 80  # of the exponential series, where the largest row sum is at most 1/2
_MOST_STEPS, _MOST_DOUBLINGS, _MOST_EXPONENT = 20_000, 100, 2_000  # of a walk that is read
Rounded = tuple[list[list[int]], int]  # multiples of 2^-BITS, and by how many of them an entry may be off


def peak_bound(M: Matrix, g: Matrix, c: Matrix, part: Any, peak: Any) -> Fraction:
    """Return an upper bound of the peak gain, after checking P; that Q and a belong to M has been checked."""
    (Q, powers), (P, _), rate = packed(part["Q"]), packed(peak["P"]), number(part["a"])
    w = product(product(c, M), M)
    if not falls(Ball(transposed(M)), P, [], product(transposed(w), w)):
        raise AuditFault("P of a peak gain is not what it should be")
    scale = [power * 2**20 for power in powers]
    back = [1 / v for v in scale]
    M, g = scaled(M, back, scale), scaled(g, back, [Fraction(1)])
    c, P, Q = scaled(c, [Fraction(1)], scale), scaled(P, scale, scale), scaled(Q, back, back)
    unit, steps = peak["unit"], peak["steps"]
    if abs(unit) > _MOST_EXPONENT or any(not 0 <= k <= _MOST_DOUBLINGS or count < 1 for k, count in steps):
        raise AuditFault("a step of a peak gain is too long or too short")
    if sum(count for _, count in steps) > _MOST_STEPS:
        raise AuditFault("a peak gain has too many steps")
    flows = [exponential(scaled(M, [Fraction(2) ** unit] * len(M), [Fraction(1)] * len(M)))]
    while len(flows) <= max((k for k, _ in steps), default=0):
        flows.append(multiplied(flows[-1], flows[-1]))
    walk = PeakWalk(g, c[0], P, Q)
    found, value, energy = Fraction(0), walk.value, walk.energy
    for k, count in steps:
        h = Fraction(2) ** (unit + k)
        for _ in range(count):
            off = walk.off, walk.energy_off
            walk.step(flows[k])
            drop = energy - walk.energy + off[1] + walk.energy_off
            mean = chord(value, walk.value) + walk.row_size * (off[0] + walk.off) / 2
            found += Fraction(ceil((h * mean + h * h * root(h * drop) / 8) * (1 << BITS)), 1 << BITS)
            value, energy = walk.value, walk.energy
    return found + 2 / rate * walk.row_size * walk.size


class PeakWalk:
    """z on its way, with c z and z^T P z, and how far they may be off."""

    def __init__(self, g: Matrix, c: list[Fraction], P: Matrix, Q: Matrix) -> None:
        self.c, self.inverse, self.n = c, inverted(Q), len(Q)
        self.common = lcm(*(v.denominator for row in P for v in row))
        self.P = [[int(v * self.common) for v in row] for row in P]
        self.row_size = root(product(product([c], Q), transposed([c]))[0][0])
        self.spread = root(total([abs(v) for row in self.inverse for v in row]))  # of entries up to 1
        self.widest = max(root(Q[j][j]) for j in range(self.n))
        self.weight = self.n**2 * max(abs(v) for row in P for v in row)
        self.z = [(v.numerator << BITS) // v.denominator for (v,) in g]
        self.off = self.spread / (1 << BITS)
        self.bits = BITS + bits([*c, *(v for row in P for v in row)])

    def step(self, flow: Rounded) -> None:
        """Go on by one step."""
        numbers, open_ = flow
        spend(20 + self.n * (1 + self.n / 5), self.bits)
        added_off = self.n * open_ * max(map(abs, self.z)) / Fraction(1 << BITS) + 1
        self.z = [sum(map(int.__mul__, row, self.z)) >> BITS for row in numbers]
        self.off += self.spread * added_off / (1 << BITS)
        self.off = Fraction((self.off.numerator << 2 * BITS) // self.off.denominator + 1, 1 << 2 * BITS)

    @property
    def value(self) -> Fraction:
        """Return c z."""
        return total([a * v for a, v in zip(self.c, self.z, strict=True)]) / (1 << BITS)

    @property
    def energy(self) -> Fraction:
        """Return z^T P z."""
        total = sum(x * sum(map(int.__mul__, row, self.z)) for row, x in zip(self.P, self.z, strict=True))
        return Fraction(total, self.common << 2 * BITS)

    @property
    def energy_off(self) -> Fraction:
        """Return by how much that may be off."""
        largest, off = Fraction(max(map(abs, self.z)), 1 << BITS), self.widest * self.off
        return self.weight * off * (2 * largest + off)

    @property
    def size(self) -> Fraction:
        """Return what V^(1/2) is at most."""
        z = [Fraction(v, 1 << BITS) for v in self.z]
        rows = zip(self.inverse, z, strict=True)
        return root(total([v * x * y for row, x in rows for v, y in zip(row, z, strict=True)])) + self.off


def exponential(X: Matrix) -> Rounded:
    """Return e^X by its series."""
    n = len(X)
    if max(sum(map(abs, row)) for row in X) > Fraction(1, 2):
        raise AuditFault("the shortest step of a peak gain is too long")
    A: Rounded = [[(v.numerator << BITS) // v.denominator for v in row] for row in X], 1
    term: Rounded = [[(j == k) << BITS for k in range(n)] for j in range(n)], 0
    total, off = [list(row) for row in term[0]], 0
    for k in range(1, _TERMS):
        numbers, error = multiplied(term, A)
        term = [[v // k for v in row] for row in numbers], error // k + 2
        total = [[v + t for v, t in zip(one, two, strict=True)] for one, two in zip(total, term[0], strict=True)]
        off += term[1]
    return total, off + (1 << BITS - 400)  # what is left of the series is below 2^-80 / 80!


def multiplied(X: Rounded, Y: Rounded) -> Rounded:
    """Return X Y."""
    (A, a), (B, b) = X, Y
    columns, rows = [*zip(*B, strict=True)], max(sum(map(abs, row)) for row in A)
    spend(len(B) ** 3 / 4, max(map(int.bit_length, (v for row in (*A, *B) for v in row))) // 4)
    numbers = [[sum(map(int.__mul__, row, column)) >> BITS for column in columns] for row in A]
    across = max(sum(map(abs, column)) for column in columns)
    return numbers, (rows * b + across * a + len(B) * a * b >> BITS) + 2


def scaled(X: Matrix, left: list[Fraction], right: list[Fraction]) -> Matrix:
    """Return the entries X_jk left_j right_k."""
    return [[v * a * b for v, b in zip(row, right, strict=True)] for row, a in zip(X, left, strict=True)]


def chord(one: Fraction, other: Fraction) -> Fraction:
    """Return the mean size of a line from one value to another."""
    size = abs(one) + abs(other)
    return size / 2 if one * other >= 0 else (one * one + other * other) / size / 2


def root(value: Fraction) -> Fraction:
    """Return a number that is not below the square root, and near it."""
    if value <= 0:
        return Fraction(0)
    shift = 128 - (value.numerator.bit_length() - value.denominator.bit_length()) // 2
    scaled_ = value * Fraction(4) ** shift
    return (isqrt(scaled_.numerator // scaled_.denominator + 1) + 1) / Fraction(2) ** shift
