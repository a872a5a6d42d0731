"""Polynomials of even degree in place of a common P."""

from fractions import Fraction
from math import comb, factorial, prod
from typing import Any

from .balls import Ball, falls, unlike
from .matrices import AuditFault, Matrix, definite, identity, spend
from .reading import matrix, number, packed

Exponents = tuple[int, ...]


def polynomial(matrices: list[Ball], _: Matrix, proof: Any, __: Any) -> list[str]:
    """Return what is wrong with one proof by V = m^T P m, m the monomials of degree d of z = T e."""
    rate, degree, T = number(proof["rate"]), number(proof["degree"]), matrix(proof["T"])
    P, powers = packed(proof["P"])
    n, d = len(T), int(degree / 2)
    if degree != 2 * d or not 0 < d <= len(P) or comb(n + d - 1, d) != len(P):
        raise AuditFault("P is not of the order of the monomials of half the degree")
    if not matrices or any(len(M) != n for M, _ in matrices) or not definite(P):
        return ["P is not positive definite, or T not of the order of the matrices"]
    faults = [] if rate > 0 else ["the rate must be positive"]
    monomials, back = exponents(n, d), Ball(T).inverse()
    different = unlike(matrices if proof["of"] == "controller" else [M.T for M in matrices])
    if len(proof["N"]) != len(different):
        raise AuditFault("there is not one N for each different matrix")
    for (i, M), content in zip(different, proof["N"], strict=True):
        F = Ball(*(lifted(X, monomials) for X in Ball(T) @ M @ back))
        N = packed(content)[0]
        if not vanishes(N, monomials):
            faults.append(f"m^T N m is not 0 for M_{i + 1}")
        if not falls(F.T, P, powers, N, rate=d * rate):
            faults.append(f"the inequality fails for M_{i + 1}")
    return faults


def exponents(n: int, d: int) -> list[Exponents]:
    """Return those of all monomials of degree d in n variables, falling."""
    if n == 1:
        return [(d,)]
    return [(k, *rest) for k in range(d, -1, -1) for rest in exponents(n - 1, d - k)]


def lifted(A: Matrix, monomials: list[Exponents]) -> Matrix:
    """Return F with m' = F m for z' = A z: (z^a)' is the sum of a_j A_jk z^a z_k / z_j; of radii, those of F."""
    if not A:
        return []
    at = {a: place for place, a in enumerate(monomials)}
    spend(len(monomials) * len(A) * (len(A) + len(monomials) / 4))
    F = identity(len(monomials), 0)
    for a, line in zip(monomials, F, strict=True):
        for j, power in enumerate(a):
            for k in range(len(a)) if power else ():
                b = list(a)
                b[j] -= 1
                b[k] += 1
                line[at[tuple(b)]] += power * A[j][k]
    return F


def coefficients(row: list[Fraction], monomials: list[Exponents]) -> list[Fraction]:
    """Return the coefficients of (row z)^d."""
    spend(len(monomials) * len(row) * 4)
    powers = [[v**k for k in range(sum(monomials[0]) + 1)] for v in row]
    return [
        factorial(sum(a)) // prod(map(factorial, a)) * prod((powers[j][k] for j, k in enumerate(a)), start=Fraction(1))
        for a in monomials
    ]


def substituted(X: Matrix, monomials: list[Exponents], others: list[Exponents]) -> Matrix:
    """Return S with m(X v) = S m(v) for the monomials of as many variables as X has rows, and as it has columns."""
    found = list[list[Fraction]]()
    for a in monomials:
        terms: dict[Exponents, Fraction] = {(0,) * len(X[0]): Fraction(1)}
        for row in [row for row, times in zip(X, a, strict=True) for _ in range(times)]:
            before, terms = terms, {}
            spend(len(before) * len(row) * 4)
            for b, value in before.items():
                for k, factor in enumerate(row):
                    c = (*b[:k], b[k] + 1, *b[k + 1 :])
                    terms[c] = terms.get(c, Fraction(0)) + value * factor
        found.append([terms.get(b, Fraction(0)) for b in others])
    return found


def vanishes(N: Matrix, monomials: list[Exponents]) -> bool:
    """Say whether m^T N m is 0 for all z: the coefficients of each product of two monomials add up to 0."""
    total: dict[Exponents, Fraction] = {}
    for a, line in zip(monomials, N, strict=True):
        spend(len(line) * (1 + len(a) / 4))
        for b, value in zip(monomials, line, strict=True):
            both = tuple(s + t for s, t in zip(a, b, strict=True))
            total[both] = total.get(both, Fraction(0)) + value
    return not any(total.values())
