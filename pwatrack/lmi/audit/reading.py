"""Numbers and matrices of a file."""

import re
from fractions import Fraction
from functools import lru_cache
from typing import Any

from .balls import Ball
from .matrices import Fault, Matrix, transposed

FORMAT = "pwatrack certificate 11"  # of the file

_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?(e-?[0-9]{1,4})?(/0*[1-9][0-9]*)?")
_LARGEST = 100_000  # characters of a number, and binary exponent
_fraction = lru_cache(2**16)(Fraction)  # the entries of many cells are written alike


def number(value: Any) -> Fraction:
    """Return a number of the file as the decimal or fraction it is written as."""
    if isinstance(value, str) and len(value) < _LARGEST and _NUMBER.fullmatch(value):
        return _fraction(value)
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() < _LARGEST:
        return Fraction(value)
    raise Fault(f"not a number: {str(value)[:40]}")


def place(k: Any, count: int) -> int:
    """Return the place of something among so many, counted from 0."""
    if type(k) is not int or not 0 <= k < count:
        raise Fault(f"there is no {str(k)[:40]} among {count}")
    return k


def matrix(rows: Any) -> Matrix:
    """Return a matrix of the file."""
    return [[number(v) for v in row] for row in rows]


def ball(rows: Any, radius: Any) -> Ball:
    """Return a matrix of the file with its radius; [] for none."""
    R = matrix(radius) if radius else []
    if any(v < 0 for row in R for v in row):
        raise Fault("a radius is negative")
    return matrix(rows), R


def packed(content: Any) -> tuple[Matrix, list[Fraction]]:
    """Return the symmetric matrix integers_jk * 2**(exponents_j + exponents_k), and the powers of two."""
    exponents = [int(e) for e in content["exponents"]]
    if any(abs(e) > _LARGEST for e in exponents):
        raise Fault("an exponent is too large to be read")
    powers = [Fraction(2) ** e for e in exponents]
    rows = zip(content["integers"], powers, strict=True)
    P = [[number(v) * a * b for v, b in zip(row, powers, strict=True)] for row, a in rows]
    if transposed(P) != P:
        raise Fault("P or Q is not symmetric")
    return P, powers
