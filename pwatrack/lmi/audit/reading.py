"""Numbers and matrices of a file."""

import json
import re
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from typing import Any

from .balls import Ball
from .matrices import AuditFault, Matrix, spend, transposed

FORMAT = "pwatrack certificate 24"  # of the file: 24 has exactly the keys below, and one form of each number

_NUMBER = re.compile(r"-?[0-9]{1,4000}(\.[0-9]{1,40})?(e-?[0-9]{1,3})?|-?[0-9]{1,4000}/[0-9]{1,4000}")
_LARGEST = 2_000  # binary exponent: beyond those of doubles


def parsed(text: str, decimals: Any = str) -> Any:
    """Return what JSON holds, its decimals as they are written, or as doubles; each key of an object once."""
    return json.loads(text, parse_float=decimals, parse_constant=str, object_pairs_hook=_object)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs) or not all(map(str.isprintable, found)):
        twice = next((key for k, (key, _) in enumerate(pairs) if key in dict(pairs[:k])), None)
        raise AuditFault("a key is no text on one line" if twice is None else f"the key {twice!r} is there twice")
    return found


@lru_cache(2**16)  # the entries of many cells are written alike
def _fraction(value: str) -> Fraction:
    """Return a number that is written as there is one way to: the shortest decimal of a double, or a fraction."""
    if not _NUMBER.fullmatch(value):
        raise AuditFault(f"not a number: {ascii(value)[:40]}")
    found = Fraction(value)
    shown = repr(float(found)).removesuffix(".0").replace("e+", "e") if abs(found) < 1e300 else ""
    if value != (shown if shown and Fraction(shown) == found else str(found)):
        raise AuditFault(f"not a number as it is to be written: {value[:40]}")
    return found


def number(value: Any) -> Fraction:
    """Return a number of the file as the decimal or fraction it is written as."""
    spend(1)
    if type(value) not in (str, int):
        raise AuditFault(f"not a number: {ascii(value)[:40]}")
    return _fraction(value) if isinstance(value, str) else Fraction(value)


def place(k: Any, count: int) -> int:
    """Return the place of something among so many, counted from 0."""
    if type(k) is not int or not 0 <= k < count:
        raise AuditFault(f"there is no {str(k)[:40]} among {count}")
    return k


def distinct(things: list[Any], what: str) -> None:
    """Raise a fault if one thing is there twice."""
    if any(one == other for one, other in pairwise(sorted(things))):
        raise AuditFault(f"{what} is there twice")


def matrix(rows: Any) -> Matrix:
    """Return a matrix of the file."""
    return [[number(v) for v in row] for row in rows]


def symmetric(rows: Any, name: str) -> Matrix:
    """Return a symmetric matrix of the file."""
    X = matrix(rows)
    if transposed(X) != X:
        raise AuditFault(f"{name} is not symmetric")
    return X


def ball(rows: Any, radius: Any) -> Ball:
    """Return a matrix of the file with its radius; [] for none."""
    R = matrix(radius) if radius else []
    if any(v < 0 for row in R for v in row):
        raise AuditFault("a radius is negative")
    centre = matrix(rows)
    if R and [*map(len, R)] != [*map(len, centre)]:
        raise AuditFault("a radius is not of the shape of its matrix")
    return Ball(centre, R)


def packed(content: Any) -> tuple[Matrix, list[Fraction]]:
    """Return the symmetric matrix integers_jk * 2**(exponents_j + exponents_k), and the powers of two."""
    if any(abs(e) > _LARGEST for e in content["exponents"]):
        raise AuditFault("an exponent is too large to be read")
    powers = [Fraction(2) ** e for e in content["exponents"]]
    rows = zip(symmetric(content["integers"], "P or Q"), powers, strict=True)
    return [[v * a * b for v, b in zip(row, powers, strict=True)] for row, a in rows], powers


def amount(count: int, what: str, several: str = "") -> str:
    """Return how many of something there are."""
    return f"{count} {what if count == 1 else several or what + 's'}"
